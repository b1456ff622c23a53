"""Recurrent networks: they learn, repeat themselves, and are as large as they say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load, save

from plushsense.core.errors import TrainingError
from plushsense.training.recurrent import fit_recurrent
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

Make = Callable[..., WindowSet]
SPEC = TrainSpec(epochs=12, batch=16, learning_rate=0.01, halve_every=None, patience=None, device="cpu")


@pytest.mark.parametrize("both_ways", [False, True])
def test_it_learns_and_the_seed_decides(made: Make, both_ways: bool) -> None:
    train, test = made(90), made(30, seed=8)
    once, again = (fit_recurrent(train, SPEC, 40, both_ways=both_ways, units=16) for _ in range(2))
    read = once(test)
    assert read.shape == (30, 3) and read.dtype == np.float32
    assert read.sum(axis=1) == pytest.approx(np.ones(30), abs=1e-5)
    # Guessing gets a third.
    assert (read.argmax(axis=1) == test.y).mean() > 0.6
    assert np.array_equal(read, again(test))
    other = fit_recurrent(train, replace(SPEC, epochs=2, seed=1), 40, both_ways=both_ways, units=16)
    few = fit_recurrent(train, replace(SPEC, epochs=2), 40, both_ways=both_ways, units=16)
    assert not np.array_equal(other(test), few(test))
    # Only the end of a window is read.
    longer = replace(test, x=np.concatenate([test.x[:, :, ::-1] * 3, test.x], axis=2))
    assert np.array_equal(once(longer), read)
    assert once(test.take(np.zeros(0, dtype=np.int64))).shape == (0, 3)


def test_its_size_is_that_of_its_weights(made: Make) -> None:
    reader = fit_recurrent(made(30), replace(SPEC, epochs=1), 40, units=8)
    # Four gates of 8 units that read 2 channels and 8 states, with two biases each; 3 classes of 8 and a bias.
    assert sum(p.numel() for p in reader.net.parameters()) == 4 * 8 * (2 + 8 + 2) + 3 * 9
    weights = {name: tensor.numpy() for name, tensor in reader.net.state_dict().items()}
    assert reader.size_bytes == len(save(load(save(weights)))) > 4 * (4 * 8 * 12 + 27)


def test_the_schedule_counts(made: Make) -> None:
    train, test = made(60), made(20, seed=3)
    falling = fit_recurrent(train, replace(SPEC, epochs=4, halve_every=1), 40, units=8)
    steady = fit_recurrent(train, replace(SPEC, epochs=4), 40, units=8)
    assert not np.array_equal(falling(test), steady(test))


def test_what_is_refused(made: Make) -> None:
    with pytest.raises(TrainingError, match="no windows to train on"):
        fit_recurrent(made(30).take(np.zeros(0, dtype=np.int64)), SPEC, 40)
