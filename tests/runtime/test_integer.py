"""A network in integers: a window and a stream give the same logits, and both what plain loops give."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import Arch, ConvLayer
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.integer import IntegerLayer, IntegerNetwork
from support.integers import INT32, any_network, models, plain_model


def samples_of(model: IntegerModel, n: int, seed: int) -> np.ndarray:
    """Raw samples (n, C) of the inputs: wandering, at times an extreme."""
    rng = np.random.default_rng(seed)
    offset, before = model.network.inputs.offset, model.network.inputs.before
    reach = (1 << (15 + before)) - 1
    x = offset + np.rint(np.cumsum(rng.normal(size=(n, len(offset))), axis=0) / 10 * reach).astype(np.int64)
    x[rng.random(x.shape) < 0.02] = INT32[int(rng.integers(2))]
    return np.clip(x, *INT32)


@settings(max_examples=40)
@given(models(longest=300), st.integers(0, 1 << 30))
def test_a_window_and_a_stream_agree(model: IntegerModel, seed: int) -> None:
    """Whatever the sizes of the pieces in which the stream comes."""
    network, arch, rng = model.network, model.network.arch, np.random.default_rng(seed)
    x = samples_of(model, arch.span + 7 * arch.step + int(rng.integers(arch.step)), seed)
    stepper, got, at = network.stepper(), [], 0
    while at < len(x):
        n = int(rng.choice([1, 2, arch.step, 50, 400]))
        got.extend(stepper.push(x[at : at + n]))
        at += n
        assert stepper.state == ("ready" if at >= arch.span else "warming")
    ends = range(arch.span, len(x) + 1, arch.step)
    windows = np.stack([x[end - arch.span : end].T for end in ends])
    assert np.array_equal(network.forward(windows), np.array(got))
    # Only the last ``span`` samples count, and a toy that forgot begins as a new one.
    assert np.array_equal(network.forward(x.T[None, :, : ends[-1]])[0], got[-1])
    stepper.reset()
    again = stepper.push(x)
    assert np.array_equal(again, got)


@settings(max_examples=15)
@given(models(longest=130), st.integers(0, 1 << 30))
def test_against_loops_of_plain_integers(model: IntegerModel, seed: int) -> None:
    """Every sum on its way fits 32 bits, or wraps once where the C lets it wrap: weights + 128."""
    network, arch = model.network, model.network.arch
    x = samples_of(model, arch.span, seed)
    z = [[int(v) for v in row] for row in network.inputs.apply(x)]
    for layer, part in zip(arch.layers, network.layers, strict=True):
        rows = []
        for at in range(layer.reach, len(z)):
            taps = [z[at - layer.reach + k * layer.dilation] for k in range(layer.kernel)]
            row = []
            for f, bias in enumerate(part.bias.tolist()):
                products = [
                    (a, int(w)) for k, tap in enumerate(taps) for a, w in zip(tap, part.weights[f, :, k], strict=True)
                ]
                total = bias + sum(a * w for a, w in products)
                assert -(1 << 31) <= total < 1 << 31
                wrapped = (bias + sum(a * (w + 128) for a, w in products) - 128 * sum(a for a, _ in products)) % 2**32
                assert (wrapped ^ 1 << 31) - (1 << 31) == total
                row.append(int(part.scale.apply(np.array([total] * len(part.bias)))[f]))
            rows.append(row)
        z = rows
    assert len(z) == arch.pooled
    pooled = [sum(column) for column in zip(*z, strict=True)]
    dense = network.dense
    sums = [
        b + sum(p * int(w) for p, w in zip(pooled, ws, strict=True))
        for b, ws in zip(dense.bias.tolist(), dense.weights, strict=True)
    ]
    assert all(-(1 << 31) <= s < 1 << 31 for s in sums)
    assert network.forward(x.T[None])[0].tolist() == dense.scale.apply(np.array(sums)).tolist()


def test_activations_are_those_of_forward() -> None:
    model = plain_model()
    network, arch = model.network, model.network.arch
    x = samples_of(model, arch.span, 3).T[None]
    seen = network.activations(x)
    assert [each.shape[1:] for each in seen] == [(37, 2), (29, 6), (20, 5)]
    assert np.array_equal(network.dense.apply(seen[-1].sum(axis=1).astype(float)), network.forward(x))


def test_no_windows() -> None:
    network = plain_model().network
    assert network.forward(np.empty((0, 2, network.arch.span), dtype=np.int64)).shape == (0, 3)


def test_scaled_values_are_refused() -> None:
    """A network in integers must not quietly cut the fractions off what was meant for the float one."""
    network = plain_model().network
    x = np.zeros((1, 2, network.arch.span))
    for read in (network.forward, network.activations):
        with pytest.raises(BadInput, match="raw whole numbers, not float64"):
            read(x)
    with pytest.raises(BadInput, match="raw whole numbers"):
        network.stepper().push(x[0].T)
    with pytest.raises(BadInput, match="2 channels"):
        network.stepper().push(np.zeros((4, 3), dtype=np.int64))
    with pytest.raises(BadInput):
        network.forward(np.zeros((1, 2, network.arch.span - 1), dtype=np.int64))


def changed(network: IntegerNetwork, **changes: object) -> IntegerNetwork:
    return dataclasses.replace(network, **changes)  # type: ignore[arg-type]


def test_parts_that_do_not_fit() -> None:
    model = plain_model()
    network = model.network
    first = network.layers[0]
    wide = IntegerLayer(first.weights.astype(np.int64) * 3, first.bias, first.scale)  # type: ignore[arg-type]
    fractions = IntegerLayer(first.weights, first.bias + 0.5, first.scale)
    full = IntegerLayer(first.weights, first.bias + (1 << 31) - 1, first.scale)
    for layer, words in (
        (wide, "weights of int64"),
        (fractions, "biases of float64"),
        (full, "could leave 32 bits"),
        (network.layers[1], "needs \\(6, 2, 5\\)"),
    ):
        with pytest.raises(BundleError, match=words):
            changed(network, layers=(layer, network.layers[1]))
    with pytest.raises(BundleError, match="1 layers"):
        changed(network, layers=network.layers[:1])
    for settings_, words in (({"padding": "causal", "pool": None}, "stream"), ({"norm": "layer"}, "batch")):
        arch = dataclasses.replace(network.arch, **settings_)  # type: ignore[arg-type]
        with pytest.raises(BundleError, match=words):
            changed(network, arch=arch)
    long = Arch((ConvLayer(1, 1, 1),), channels=2, classes=2, window=600, step=258, pool=258)
    with pytest.raises(BundleError, match="at most 257"):
        any_network(long, model.layout, np.random.default_rng(1))
    fits = Arch((ConvLayer(1, 1, 1),), channels=2, classes=2, window=600, step=257, pool=257)
    any_network(fits, model.layout, np.random.default_rng(1))
