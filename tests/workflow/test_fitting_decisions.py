"""The decision settings that ``train`` fits and leaves in a bundle, on a small data set."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import plushsense as ps
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.temperature import tempered
from plushsense.workflow.api import validation_predictions

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]
SMALL = ("--filters", "4,4,4", "--epochs", "6")


def test_train_fits_decisions_on_those_who_validate(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    ran = cli("train", dataset.path, *SMALL, "--out", tmp_path / "m.plush", "--json")
    assert ran.status == 0, ran.err
    bundle = ps.load(tmp_path / "m.plush")
    spec = DecideSpec.from_dict(bundle.decision)
    fitted = spec.fitted
    assert fitted["people"] == len(bundle.provenance["validation_subjects"]) == 1
    assert fitted["health"]["people"] == 5
    assert fitted["streams"] == 1 and fitted["answers"]["coverage_left_out"] is None
    assert spec.known_margin is not None and spec.health.low
    assert ran.json["decision"]["fitted"] == fitted
    # Who they are stands in the provenance alone, which an export takes out.
    assert not any(f'"{code}"' in json.dumps(bundle.decision) for code in dataset.subjects)
    ran = cli("train", dataset.path, *SMALL, "--out", tmp_path / "plain.plush", "--no-fit-decisions")
    assert ps.load(tmp_path / "plain.plush").decision["fitted"] == {}
    assert "Decisions fitted" not in ran.out


def test_given_settings_stay_and_train_says_what_it_did(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text("[live]\nsmoothing_s = 0.45\nenter = 0.85\n")
    ran = cli("train", dataset.path, *SMALL, "--config", tmp_path / "run.toml", "--out", tmp_path / "m.plush")
    spec = DecideSpec.from_dict(ps.load(tmp_path / "m.plush").decision)
    assert (spec.smoothing_s, spec.enter) == (0.45, 0.85)
    assert "Decisions fitted on 1 person who were held back" not in ran.out
    assert "Decisions fitted on 1 person who was held back" in ran.out
    gate = spec.fitted["gate"]
    notices = f"it detects {100 * gate['recall']:.0f} % of" if "recall" in gate else gate["reason"]
    assert notices in ran.out, "what the gate's fit found, or why there is none"


def test_where_nobody_is_held_back_the_defaults_stay_and_train_says_so(dataset: Dataset) -> None:
    said: list[str] = []
    trained = ps.train(dataset, preset="search", epochs=1, filters=(4, 4, 4), warn=said.append)
    assert DecideSpec.from_dict(trained.bundle.decision) == DecideSpec()
    assert any("decision settings are the defaults" in line for line in said)


def test_without_a_stream_decisions_are_fitted_on_recordings(recordings: Path, tmp_path: Path) -> None:
    for person in ("P1", "P2", "P3"):
        (tmp_path / "src" / person).mkdir(parents=True)
        for file in (recordings / person).glob("*_*_*.csv"):
            (tmp_path / "src" / person / file.name).write_bytes(file.read_bytes())
    plain = import_recordings(tmp_path / "src", tmp_path / "plain", layout="accel-3").dataset
    fitted = ps.train(plain, epochs=1, filters=(4, 4, 4)).bundle.decision["fitted"]
    assert fitted["streams"] == 0 and "windows" in fitted["answers"]["on"]


def test_a_temperature_is_in_the_weights_before_anything_is_fitted(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    plain, done = (
        ps.train(dataset, filters=(4, 4, 4), epochs=4, temperature=temperature) for temperature in (1.0, 1.5)
    )
    for name, weight in plain.bundle.weights.items():
        divided = weight / np.float32(1.5) if name.startswith("dense.") else weight
        np.testing.assert_array_equal(done.bundle.weights[name], divided)
    assert done.scores.accuracy == plain.scores.accuracy
    one, other = (validation_predictions(t.bundle, dataset).probabilities for t in (done, plain))
    np.testing.assert_allclose(one, tempered(other, 1.5), atol=1e-6)
    # The margin is of logits, which are divided as well.
    assert done.bundle.decision["known_margin"] == pytest.approx(plain.bundle.decision["known_margin"] / 1.5, abs=0.1)
    assert done.bundle.provenance["temperature"] == 1.5 and "temperature" not in plain.bundle.provenance
    ran = cli("train", dataset.path, *SMALL, "--temperature", "0.1", "--out", tmp_path / "m.plush")
    assert ran.status == 2 and "The temperature is 0.1: accepted are 0.14 to 7.4" in ran.err
