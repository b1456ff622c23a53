"""Calibration: by hand, and a temperature that is found again."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.scoring.calibration import cross_fitted_temperature, fit_temperature, reliability, with_temperature


def test_calibration_error_by_hand() -> None:
    p = np.array([[0.95, 0.05], [0.95, 0.05], [0.65, 0.35], [0.35, 0.65]])
    found = reliability(p, np.array([0, 1, 0, 1]))
    # Two predictions at 0.95 of which one is right, two at 0.65 that are both right.
    assert found["ece"] == pytest.approx(0.5 * 0.45 + 0.5 * 0.35)
    assert found["log_loss"] == pytest.approx(-np.log(0.95 * 0.05 * 0.65 * 0.65) / 4)
    assert found["accuracy"] == 0.75 and found["confidence"] == pytest.approx(0.8)
    assert [b["n"] for b in found["bins"]] == [0, 0, 0, 0, 0, 0, 2, 0, 0, 2]
    assert found["bins"][0] == {"low": 0.0, "high": 0.1, "n": 0, "confidence": None, "accuracy": None}
    assert [(b["low"], b["high"]) for b in found["bins"]] == [(k / 10, (k + 1) / 10) for k in range(10)]
    with pytest.raises(BadInput, match="at least one prediction"):
        reliability(np.zeros((0, 3)), np.zeros(0, np.int64))


def test_the_temperature_of_a_network_that_is_too_sure_is_found() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (4000, 5))
    true = with_temperature(np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True), 1.0)
    truth = np.array([rng.choice(5, p=row) for row in true])
    sure = with_temperature(true, 0.5)
    assert fit_temperature(sure, truth) == pytest.approx(2.0, rel=0.1)
    group = np.repeat(np.array(["A", "B", "C", "D"]), 1000)
    scaled, temperatures = cross_fitted_temperature(sure, truth, group)
    assert set(temperatures) == {"A", "B", "C", "D"}
    assert scaled.argmax(axis=1).tolist() == sure.argmax(axis=1).tolist()
    assert reliability(scaled, truth)["ece"] < 0.5 * reliability(sure, truth)["ece"]
    # The temperature of a group is that of the others: here only D is too sure.
    mixed = np.where((group == "D")[:, None], sure, true)
    temperatures = cross_fitted_temperature(mixed, truth, group)[1]
    assert temperatures["D"] == fit_temperature(mixed[:3000], truth[:3000]) < temperatures["A"]
    # A group alone has nobody to fit a temperature on.
    assert np.allclose(cross_fitted_temperature(sure, truth, np.full(4000, "A"))[0], sure, atol=1e-6)
