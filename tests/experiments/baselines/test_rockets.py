"""Rockets learn and repeat themselves, where aeon is installed; where it is not, the sentence says what to do."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from plushsense.core.errors import MissingExtraError
from plushsense.experiments.baselines.models import ROCKETS, RocketFit, rockets
from support.fakes import rhythms

HERE = importlib.util.find_spec("aeon") is not None
SAMPLES = 50


@pytest.mark.skipif(not HERE, reason="aeon is not installed: its numba holds numpy below 2.4")
@pytest.mark.parametrize("name", list(ROCKETS))
def test_a_rocket_learns_and_repeats_itself(name: str) -> None:
    (contender,) = rockets([name], SAMPLES, 0)
    assert isinstance(contender.fit, RocketFit)
    contender.fit.prepare(rhythms())
    test = rhythms(30, seed=9)
    once, again = contender.fit(rhythms(), rhythms(9)), contender.fit(rhythms(), rhythms(9))
    assert (once(test).argmax(axis=1) == test.y).mean() > 0.8
    assert np.array_equal(once(test), again(test)) and once.size_bytes > 10_000


@pytest.mark.skipif(HERE, reason="aeon is installed")
def test_without_aeon_the_command_to_install_it_is_named() -> None:
    with pytest.raises(MissingExtraError, match=r"pip install 'plushsense\[rocket\]'"):
        rockets(["minirocket"], SAMPLES, 0)
    assert rockets([], SAMPLES, 0) == []
