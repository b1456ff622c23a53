"""The comparison of 8-bit answers with those in floats: whose windows it reads, and its table."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import exactness
import numpy as np
import pytest

from plushsense.dataset.store import Dataset
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler
from plushsense.workflow.export import calibrated_on, training_windows
from plushsense.workflow.preparation import WHOLE_PEOPLE


def test_ours_is_compared_on_the_windows_of_the_people_who_were_held_out(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arch = Arch.parse("5_4d2", (4, 6), channels=3, classes=len(dataset.gestures))
    people = {"subjects": ["P1", "P2", "P3", "P5"], "validation_subjects": ["P4"]}
    origin = {"split": WHOLE_PEOPLE, "dataset_hash": dataset.hash, **people}
    bundle = Bundle(arch, random_weights(arch, 1), dataset.layout, Scaler(np.zeros(3), np.ones(3)), dataset.gestures)
    bundle = replace(bundle, provenance=origin, windowing={"step_s": 0.5})
    bundle = replace(bundle, scaler=Scaler.fit(training_windows(bundle, dataset)))
    path = calibrated_on(bundle, dataset).save(tmp_path / "m.plush")
    of_one = training_windows(replace(bundle, provenance={**origin, "subjects": ["P4"]}), dataset)
    monkeypatch.setattr(sys, "argv", ["exactness.py", str(path), str(dataset.path), "--only", "none"])
    assert exactness.main() == 0
    found = json.loads(capsys.readouterr().out)
    assert found["people"] == ["P4"]
    assert found["windows"] > len(of_one), "closer together than those of the training"
    row = found["rows"]["PlushSense, int8"]
    assert row["agreement"] > 0.9 and 0 < row["logit_error"] < 0.1

    replace(bundle, provenance={**origin, "validation_subjects": []}).save(tmp_path / "none.plush")
    monkeypatch.setattr(sys, "argv", ["exactness.py", str(tmp_path / "none.plush"), str(dataset.path)])
    assert exactness.main() == 2 and "names nobody who was held out" in capsys.readouterr().err
