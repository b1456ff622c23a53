"""Smoothing by a time constant in seconds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.live.decide import DecideSpec, Smoother

A, B = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def test_a_change_reaches_63_percent_after_the_time_constant():
    for step_s in (0.05, 0.01):
        smoother = Smoother(DecideSpec(smoothing_s=0.5), step_s)
        smoother.update(A)
        for _ in range(round(0.5 / step_s)):
            after = smoother.update(B)
        assert after[1] == pytest.approx(1 - math.exp(-1), abs=1e-9)
        assert after.sum() == pytest.approx(1)


def test_the_first_answer_stands_and_a_reset_forgets():
    smoother = Smoother(DecideSpec(smoothing_s=5), 0.05)
    assert smoother.update(A).tolist() == [1, 0]
    assert smoother.update(B)[0] > 0.9
    smoother.reset()
    assert smoother.update(B).tolist() == [0, 1]


def test_zero_is_no_smoothing():
    smoother = Smoother(DecideSpec(smoothing_s=0), 0.05)
    smoother.update(A)
    assert smoother.update(B).tolist() == [0, 1]


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf, 61, True, "0.3", None])
def test_what_is_no_time_constant_is_refused(value):
    with pytest.raises(ConfigError, match="smoothing_s"):
        DecideSpec(smoothing_s=value)


def test_settings_come_back_and_an_unknown_one_names_the_nearest():
    spec = DecideSpec(smoothing_s=0.7)
    assert DecideSpec.from_dict(spec.to_dict()) == spec
    assert DecideSpec.from_dict({}) == DecideSpec()
    with pytest.raises(ConfigError, match="smoothing_s"):
        DecideSpec.from_dict({"smoothing": 0.7})
