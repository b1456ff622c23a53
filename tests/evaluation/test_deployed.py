"""Float beside int8: the figures by hand, person by person, also when the folds come from the journal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.evaluation.crossval import CrossvalSpec, FoldOutput, evaluate
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import JobsSpec
from plushsense.scoring.splits import parse_split
from support.fakes import Deploying, Oracle, study


def test_what_deploying_costs_each_person(tmp_path: Path) -> None:
    found = evaluate(
        study(), study(), parse_split("leave-one-subject-out"), Deploying(str(tmp_path), ("P01",))
    ).to_json()
    assert found["accuracy"]["mean"] == 1.0, "the float figures stay what they are"
    int8 = found["int8"]
    json.dumps(int8, allow_nan=False)
    assert int8["over"] == "subjects"
    assert int8["accuracy"]["mean"] == pytest.approx(5 / 6)
    assert [r["accuracy_loss"] for r in int8["rows"]] == [0, 1, 0, 0, 0, 0]
    assert [r["agreement"] for r in int8["rows"]] == [1, 0, 1, 1, 1, 1]
    assert int8["rows"][1] == {
        "subject": "P01", "windows": 8, "accuracy": 1.0, "accuracy_int8": 0.0, "accuracy_loss": 1.0, "macro_f1": 1.0,
        "macro_f1_int8": 0.0, "macro_f1_loss": 1.0, "agreement": 0.0,
    }  # fmt: skip
    loss = int8["loss"]["macro_f1"]
    assert loss["mean"] == pytest.approx(1 / 6) and loss["sd"] == pytest.approx(np.std([0, 1, 0, 0, 0, 0], ddof=1))
    assert 0 == loss["ci95"][0] < loss["mean"] < loss["ci95"][1] <= 0.5
    # Nobody's windows count in no person's score: 8 of 48 differ, by 0.7 in two classes.
    assert int8["agreement"] == pytest.approx(40 / 48)
    assert int8["probability_difference"] == pytest.approx(0.7 * 8 / 48, abs=1e-6)


def test_folds_where_people_are_not_kept_apart(tmp_path: Path) -> None:
    found = evaluate(study(), study(), parse_split("by-recording:3"), Deploying(str(tmp_path), ("P01",))).to_json()[
        "int8"
    ]
    assert found["over"] == "folds" and len(found["rows"]) == 3
    assert sum(r["windows"] for r in found["rows"]) == 60
    assert found["agreement"] == pytest.approx(52 / 60)


def test_it_comes_back_from_the_journal_and_is_not_made_up_without(tmp_path: Path) -> None:
    journal, work = Journal(tmp_path / "folds"), Deploying(str(tmp_path), ("P02",))
    spec = CrossvalSpec(jobs=JobsSpec(journal=journal), key={"int8": 1})
    first, second = (evaluate(study(), study(), parse_split("by-subject:3"), work, spec).to_json() for _ in range(2))
    assert first == second and "int8" in first
    trained = sum(len(path.read_text()) for path in tmp_path.glob("trained-*"))
    assert trained == 2 * 3, "a second run trains nothing"
    assert "int8" not in evaluate(study(), study(), parse_split("by-subject:3"), Oracle(str(tmp_path))).to_json()


def too_few(train, validation, test, progress, /):
    whole = np.full((len(test), 3), 1 / 3, dtype=np.float32)
    return FoldOutput(whole, deployed=whole[:1])


def test_deployed_probabilities_of_another_shape_are_refused() -> None:
    with pytest.raises(ConfigError, match="deployed of the shape"):
        evaluate(study(), study(), parse_split("by-subject:3"), too_few)
