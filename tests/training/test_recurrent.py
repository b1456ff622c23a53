"""Recurrent networks: they learn, repeat themselves, and are as large as they say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from plushsense.core.errors import TrainingError
from plushsense.training.recurrent import Recurrent, fit_recurrent
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

Make = Callable[..., WindowSet]
SPEC = TrainSpec(epochs=12, batch=16, learning_rate=0.01, halve_every=None, patience=None, device="cpu")


@pytest.mark.parametrize("both_ways", [False, True])
@pytest.mark.slow
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
    longer = replace(test, integers=np.concatenate([test.integers[:, :, ::-1] * 3, test.integers], axis=2))
    assert np.array_equal(once(longer), read)
    assert once(test.take(np.zeros(0, dtype=np.int64))).shape == (0, 3)


def test_its_size_is_that_of_its_weights(made: Make) -> None:
    reader = fit_recurrent(made(30), replace(SPEC, epochs=1), 40, units=8)
    # Four gates of 8 units that read 2 channels and 8 states, with two biases each; 3 classes of 8 and a bias.
    assert sum(p.numel() for p in reader.net.parameters()) == 4 * 8 * (2 + 8 + 2) + 3 * 9
    weights = {name: tensor.numpy() for name, tensor in reader.net.state_dict().items()}
    assert reader.size_bytes == len(save(load(save(weights)))) > 4 * (4 * 8 * 12 + 27)


@pytest.mark.parametrize("both_ways", [False, True])
def test_the_dense_layer_reads_the_last_state_of_the_last_layer(both_ways: bool) -> None:
    net = Recurrent(2, 3, both_ways, 5, layers=3, dropout=0.5).eval()
    x = torch.randn(4, 2, 20)
    states, _ = net.cell(x.transpose(1, 2))
    # A state forwards is complete at the last sample, one backwards at the first.
    last = torch.cat([states[:, -1, :5], states[:, 0, 5:]], dim=1)
    assert last.shape[1] == (10 if both_ways else 5)
    assert torch.allclose(net(x), net.dense(last), atol=1e-6)


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.filterwarnings("error")
def test_dropout_acts_in_training_only_before_the_dense_layer_and_between_layers(layers: int) -> None:
    net = Recurrent(2, 3, False, 400, layers, 0.5)
    given: list[torch.Tensor] = []
    net.dense.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    x = torch.randn(2, 2, 6)
    for _ in range(2):
        net(x)
    one, other = given
    assert 0.3 < float((one == 0).float().mean()) < 0.7
    # What both leave in is the same, unless a dropout between the layers changed it before.
    both = (one != 0) & (other != 0)
    assert torch.equal(one[both], other[both]) == (layers == 1)
    net.eval()
    assert torch.equal(net(x), net(x)) and not bool((given[-1] == 0).any())


@pytest.mark.slow
def test_units_layers_and_dropout_count_and_the_seed_decides_the_dropout(made: Make) -> None:
    train, test = made(60), made(20, seed=3)
    spec = replace(SPEC, epochs=2)

    def read(layers: int = 2, dropout: float = 0.5, **changes: int) -> bytes:
        trained = fit_recurrent(train, replace(spec, **changes), 40, units=8, layers=layers, dropout=dropout)
        return trained(test).tobytes()

    torch.manual_seed(1)
    once = read()
    torch.manual_seed(2)
    assert once == read()
    assert len({once, read(seed=1), read(layers=1), read(layers=1, dropout=0.0), read(dropout=0.0)}) == 5
    two = fit_recurrent(train, spec, 40, units=8, layers=2, dropout=0.5)
    assert sum(p.numel() for p in two.net.parameters()) == 4 * 8 * (2 + 8 + 2) + 4 * 8 * (8 + 8 + 2) + 3 * 9
    assert two.size_bytes > fit_recurrent(train, spec, 40, units=8).size_bytes + 4 * 4 * 8 * 18


def test_inputs_are_scaled_unless_the_settings_say_not_to(made: Make) -> None:
    read = fit_recurrent(made(30), replace(SPEC, epochs=1, scaling="none"), 40, units=4)
    assert (read.scaler.scale == 1).all() and (read.scaler.offset == 0).all()
    assert (fit_recurrent(made(30), replace(SPEC, epochs=1), 40, units=4).scaler.scale != 1).all()


def test_the_schedule_counts(made: Make) -> None:
    train, test = made(60), made(20, seed=3)
    falling = fit_recurrent(train, replace(SPEC, epochs=4, halve_every=1), 40, units=8)
    steady = fit_recurrent(train, replace(SPEC, epochs=4), 40, units=8)
    assert not np.array_equal(falling(test), steady(test))


def test_what_is_refused(made: Make) -> None:
    with pytest.raises(TrainingError, match="no windows to train on"):
        fit_recurrent(made(30).take(np.zeros(0, dtype=np.int64)), SPEC, 40, units=4)
