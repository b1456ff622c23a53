"""Confidence of an evaluation: its calibration error over people, and the temperature that is proposed for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.evaluation.confidence import assess_confidence
from plushsense.evaluation.crossval import FoldOutput, evaluate
from plushsense.evaluation.scores import Predictions
from plushsense.models.reference import softmax
from plushsense.scoring.splits import parse_split
from support.fakes import Deploying, Oracle, study


def predictions(times: float, people: int = 12, windows: int = 150, classes: int = 4) -> Predictions:
    """Answers of networks whose logits are ``times`` too large; three people a fold."""
    rng = np.random.default_rng(4)
    n = people * windows
    logits = rng.normal(0, 2, (n, classes))
    truth = (softmax(logits).cumsum(axis=1) < rng.random((n, 1))).sum(axis=1)
    person = np.repeat(np.arange(people), windows)
    return Predictions(
        labels=tuple("abcd"),
        subject=np.array([f"P{p}" for p in person]),
        recording=np.arange(n).astype(str),
        window=np.zeros(n, dtype=np.int64),
        context=np.full(n, "stream"),
        fold=np.array([f"fold {p // 3}" for p in person]),
        truth=truth,
        probabilities=softmax(times * logits).astype(np.float32),
    )


def test_a_temperature_is_proposed_where_it_lowers_the_error() -> None:
    found = assess_confidence(predictions(3.0), None, True)
    assert found.error > 0.15 and found.error_tempered < 0.08
    assert found.temperature == pytest.approx(3.0, rel=0.25)
    low, high = found.ci95
    assert low < found.error < high
    right = assess_confidence(predictions(1.0), None, True)
    assert right.error < 0.05 and right.error_tempered < 0.05 and right.temperature is None


def test_the_temperature_of_a_fold_knows_nothing_of_its_people() -> None:
    whole = predictions(3.0)
    own = whole.fold == "fold 1"
    # Other labels in one fold change the error there, but not what its own probabilities become.
    wrong = replace(whole, truth=np.where(own, (whole.truth + 1) % 4, whole.truth))
    one, other = (assess_confidence(p, None, True) for p in (whole, wrong))
    assert one.error_tempered < other.error_tempered
    alone = replace(whole, fold=np.full(len(whole), "fold 1"))
    assert assess_confidence(alone, None, True).error_tempered is None


def test_resting_windows_do_not_count_and_without_people_there_is_nothing() -> None:
    whole = predictions(2.0)
    resting = whole.subject == "P0"
    mixed = replace(whole, subject=np.where(resting, "none", whole.subject))
    kept = {
        name: getattr(whole, name)[~resting]
        for name in ("subject", "recording", "window", "context", "fold", "truth", "probabilities")
    }
    assert assess_confidence(mixed, None, True) == assess_confidence(replace(whole, **kept), None, True)
    assert assess_confidence(replace(whole, subject=np.full(len(whole), "none")), None, True) is None


@dataclass(frozen=True)
class Boasting:
    """Answers with a confidence of 0.99, and is right for two thirds of a person's windows."""

    def __call__(self, *given: Any) -> FoldOutput:
        test = given[2]
        read = (test.y + (np.arange(len(test)) % 3 == 0)) % 3
        return FoldOutput(np.where(np.eye(3, dtype=bool)[read], 0.99, 0.005).astype(np.float32))


def test_evaluations_say_how_sure_their_networks_are(tmp_path: Path) -> None:
    found = evaluate(study(people=9), study(people=9), parse_split("by-subject:3"), Boasting()).to_json()["confidence"]
    assert found["mean"] == pytest.approx(0.99) and found["error"] == pytest.approx(0.99 - 2 / 3, abs=0.05)
    assert found["temperature"] > 1.3 and found["error_tempered"] < found["error"]
    one = Deploying(str(tmp_path), ("P01",))
    apart = evaluate(study(), study(), parse_split("by-subject:3"), one).to_json()["confidence"]
    # All right at 0.8 in floats; in 8 bits, one person of six is read wrong.
    assert apart["error"] == pytest.approx(0.2) and apart["error_int8"] == pytest.approx(1 / 30, abs=1e-6)
    leaky = evaluate(study(), study(), parse_split("windows:3"), Oracle(str(tmp_path))).to_json()["confidence"]
    assert leaky["temperature"] is None and leaky["error_tempered"] is None and leaky["error"] == pytest.approx(0.2)
