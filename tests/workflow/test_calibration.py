"""Training keeps a calibration of its own people's windows; a bundle of before gets the same from its data set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.errors import ArchError, BundleError, ConfigError
from plushsense.dataset.readings import Readings
from plushsense.dataset.store import Dataset
from plushsense.deploy.quantize import calibration, integer_model
from plushsense.models.bundle import Bundle
from plushsense.windows.cut import WindowSpec
from plushsense.workflow.export import calibrated_on
from plushsense.workflow.preparation import choose_classes, windows_for

pytestmark = pytest.mark.apart("trainings")


def test_training_calibrates_on_the_windows_it_trained_on_and_no_others(dataset: Dataset) -> None:
    bundle = ps.train(dataset, epochs=1, filters=(4, 4, 4), patience=9).bundle
    spec = WindowSpec(**bundle.windowing)
    windows = windows_for(dataset.with_inputs(bundle.layout), bundle.arch, spec, choose_classes(dataset, "all"))
    trained_on = np.isin(windows.subject, bundle.provenance["subjects"])
    assert 0 < trained_on.sum() < len(windows), "somebody was held back"

    def of(mask: np.ndarray) -> dict[str, object]:
        return calibration(bundle.arch, bundle.weights, bundle.scaler, windows.integers[mask])

    assert bundle.calibration == of(trained_on)
    assert bundle.calibration != of(np.ones(len(windows), dtype=bool)), "held-back people would show"
    again = calibrated_on(replace(bundle, calibration={}), dataset)
    assert again.calibration == bundle.calibration
    assert integer_model(again).to_bytes() == integer_model(bundle).to_bytes()
    assert bundle.readings == Readings.of(dataset, bundle.provenance["subjects"])
    assert calibrated_on(replace(bundle, readings=None), dataset).readings == bundle.readings


def test_data_of_other_content_is_used_with_a_word_and_of_other_people_refused(dataset: Dataset) -> None:
    bundle = replace(ps.train(dataset, epochs=1, filters=(4, 4, 4)).bundle, calibration={})
    said: list[str] = []
    origin = bundle.provenance
    other = replace(bundle, provenance=origin | {"dataset_hash": "0", "subjects": [*origin["subjects"], "P99"]})
    assert calibrated_on(other, dataset, said.append).calibration
    assert any("content" in line for line in said) and any("P99" in line for line in said)
    with pytest.raises(BundleError, match="has no window of the 1 person"):
        calibrated_on(replace(bundle, provenance=origin | {"subjects": ["P99"]}), dataset)
    with pytest.raises(BundleError, match="belongs to an export.*plushsense train wrote"):
        calibrated_on(bundle.without_people(), dataset)
    with pytest.raises(BundleError, match="does not name the people of its training windows|which calibration needs"):
        calibrated_on(replace(bundle, provenance=origin | {"split": "windows:holdout"}), dataset)


def test_fine_tuning_for_8_bits_keeps_the_ranges_it_was_made_for(dataset: Dataset, tmp_path: Path) -> None:
    said: list[str] = []
    plain = ps.train(dataset, epochs=4, filters=(4, 4, 4), warn=said.append)
    tuned = ps.train(dataset, epochs=4, filters=(4, 4, 4), quantize_aware=2)
    assert tuned.bundle.calibration == plain.bundle.calibration
    assert not np.array_equal(tuned.bundle.weights["dense.weight"], plain.bundle.weights["dense.weight"])
    assert (plain.bundle.provenance["quantize_aware"], tuned.bundle.provenance["quantize_aware"]) == (0, 2)
    again = Bundle.load(tuned.save(tmp_path / "m.plush"))
    assert integer_model(again).to_bytes() == integer_model(tuned.bundle).to_bytes()
    told: list[str] = []
    assert calibrated_on(tuned.bundle, dataset, told.append) is tuned.bundle and "is kept" in told[0]
    for one in (plain, tuned):
        found = one.scores.int8
        assert found is not None and 0.5 < found.agreement <= 1 and 0 <= found.macro_f1 <= 1
    poor = plain.scores.int8.agreement < 0.95
    assert any("--quantize-aware" in line for line in said) == poor
    assert ps.train(dataset, epochs=1, filters=(4, 4, 4), padding="causal").scores.int8 is None


def test_fine_tuning_what_cannot_be_deployed_is_refused_before_training(dataset: Dataset) -> None:
    with pytest.raises(ArchError, match="causal"):
        ps.train(dataset, epochs=1, filters=(4, 4, 4), padding="causal", quantize_aware=1)
    with pytest.raises(ConfigError, match="quantize_aware is -1"):
        ps.train(dataset, epochs=1, filters=(4, 4, 4), quantize_aware=-1)


def test_many_changed_answers_are_said(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from plushsense.workflow import api

    monkeypatch.setattr(api, "_AGREEMENT", 1.1)
    said: list[str] = []
    ps.train(dataset, epochs=1, filters=(4, 4, 4), warn=said.append)
    assert [line for line in said if "8 bits change" in line and "--quantize-aware 10" in line]
