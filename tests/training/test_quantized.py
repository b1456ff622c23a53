"""Quantization-aware fine-tuning: it computes what the toy computes, and saves a network that plain rounding spoils."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from plushsense.core.errors import TrainingError
from plushsense.deploy.quantize import Ranges, calibration, quantize
from plushsense.models.arch import Arch
from plushsense.models.reference import Network, random_weights
from plushsense.runtime.integer import IntegerNetwork
from plushsense.training.fit import FittedNetwork
from plushsense.training.quantized import Rounded, fine_tune
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler

Make = Callable[..., WindowSet]
Weights = dict[str, np.ndarray]
SPEC = TrainSpec(epochs=10, batch=16, learning_rate=0.015, patience=None, halve_every=None, device="cpu")


def arch(**changes: Any) -> Arch:
    return Arch.parse("5d1_4d3", (6, 5), **({"channels": 2, "classes": 3, "window": 40, "step": 5} | changes))


def deployed(network: Arch, weights: Weights, scaler: Scaler, kept: dict[str, Any]) -> IntegerNetwork:
    return quantize(network, weights, scaler, Ranges.from_dict(kept))


def spoilt(network: Arch) -> Weights:
    """Two channels that are nearly the same get large weights of opposite sign, which cancel but fill the 8 bits."""
    weights = random_weights(network, 3)
    first = weights["conv0.weight"]
    first[:, 0, 0] += 60.0
    first[:, 1, 0] -= 60.0
    return weights


def alike(windows: WindowSet) -> WindowSet:
    """The second channel nearly the first."""
    windows.integers[:, 1] = windows.integers[:, 0] + (windows.integers[:, 1] - 5000) // 50
    return windows


# With reflected samples, more activations lie on the boundary of a rounding.
@pytest.mark.parametrize(("padding", "share"), [("stream", 0.25), ("mirror", 0.5)])
def test_it_computes_what_the_toy_computes(padding: str, share: float, made: Make) -> None:
    network, windows = arch(padding=padding), made(64)
    scaler, weights = Scaler.fit(windows.integers), random_weights(network, 3)
    weights["norm0.gain"][1] *= -1.0
    weights["norm0.gain"][2] = 0.0
    kept = calibration(network, weights, scaler, windows.integers)
    x = windows.integers[:, :, windows.integers.shape[2] - network.span :]
    found = Rounded(network, weights, kept).logits(torch.from_numpy(scaler.apply(x))).numpy()
    wanted = deployed(network, weights, scaler, kept).forward(x) / 256
    floats = Network(network, weights).forward(scaler.apply(x))
    assert np.abs(found - wanted).max() < 0.02, "what is left are the fixed-point scales"
    assert np.abs(found - wanted).max() < share * np.abs(floats - wanted).max()


@pytest.mark.slow
def test_it_saves_a_network_that_plain_rounding_spoils(made: Make) -> None:
    network, windows, strangers = arch(), alike(made(240)), alike(made(150, seed=9))
    scaler, weights = Scaler.fit(windows.integers), spoilt(arch())
    kept = calibration(network, weights, scaler, windows.integers)
    before = {name: w.copy() for name, w in weights.items()}
    losses: list[float] = []
    trained = FittedNetwork(weights, scaler, [], 1, 0.0)
    tuned = fine_tune(windows, network, trained, kept, SPEC, 15, lambda *at: losses.append(at[2]["train_loss"]))
    assert all(np.array_equal(weights[name], before[name]) for name in before), "what was given stays"
    assert len(losses) == 15 and losses[-1] < 0.5 * losses[0]
    teacher = Network(network, weights).forward(scaler.apply(strangers.integers))

    def off(after: Weights) -> tuple[float, float]:
        read = deployed(network, after, scaler, kept).forward(strangers.integers) / 256
        apart = (read - read.mean(axis=1, keepdims=True)) - (teacher - teacher.mean(axis=1, keepdims=True))
        return float((read.argmax(axis=1) == teacher.argmax(axis=1)).mean()), float(np.sqrt((apart**2).mean()))

    (plain, plain_error), (aware, aware_error) = off(weights), off(tuned)
    assert plain < 0.97, "plain rounding is bad here"
    assert aware > plain and aware_error < 0.8 * plain_error, (plain, aware, plain_error, aware_error)
    frozen = [name for name in weights if name.endswith((".mean", ".var"))]
    assert all(np.array_equal(tuned[name], weights[name]) for name in frozen)


def test_the_same_seed_gives_the_same_weights_and_leaves_the_global_seed_alone(made: Make) -> None:
    network, windows = arch(), made(40)
    scaler, weights = Scaler.fit(windows.integers), random_weights(arch(), 3)
    kept = calibration(network, weights, scaler, windows.integers)
    state = torch.get_rng_state()
    one, two = (
        fine_tune(windows, network, FittedNetwork(weights, scaler, [], 1, 0.0), kept, SPEC, 2) for _ in range(2)
    )
    assert torch.equal(state, torch.get_rng_state())
    assert all(np.array_equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize(
    ("changes", "epochs", "said"),
    [
        ({"padding": "causal"}, 1, "cannot be deployed"),
        ({"norm": "layer"}, 1, "cannot be deployed"),
        ({}, 0, "0 epoch"),
    ],
)
def test_what_cannot_be_tuned_is_said(made: Make, changes: dict[str, Any], epochs: int, said: str) -> None:
    network, windows = arch(**changes), made(20)
    scaler, weights = Scaler.fit(windows.integers), random_weights(arch(**changes), 3)
    kept = calibration(network, weights, scaler, windows.integers)
    with pytest.raises(TrainingError, match=said):
        fine_tune(windows, network, FittedNetwork(weights, scaler, [], 1, 0.0), kept, SPEC, epochs)
