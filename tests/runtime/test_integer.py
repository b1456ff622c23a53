"""A network in integers: a window and a stream give the same logits, and both what plain loops give."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import Arch, ConvLayer
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.integer import IntegerLayer, IntegerNetwork, down_for, rounded_weights
from support.integers import INT32, any_network, models, plain_model, vector_model, window_model


def samples_of(model: IntegerModel, n: int, seed: int) -> NDArray[np.int64]:
    """Raw samples (n, C) of the inputs: wandering, at times an extreme; gravity is at times nowhere."""
    rng, arch = np.random.default_rng(seed), model.network.arch
    axes = 0 if arch.vector is None else arch.vector.axes
    offset, before = (
        np.concatenate([column[: arch.channels - axes], np.zeros(axes, dtype=np.int64)])
        for column in (model.network.inputs.offset, model.network.inputs.before)
    )
    reach = (1 << (15 + before)) - 1
    x = offset + np.rint(np.cumsum(rng.normal(size=(n, len(offset))), axis=0) / 10 * reach).astype(np.int64)
    x[rng.random(x.shape) < 0.02] = INT32[int(rng.integers(2))]
    if axes:
        x[:, -3:] = np.clip(x[:, -3:] * int(rng.choice([1, 1, 200])), -(1 << 23), 1 << 23)
        x[rng.random(n) < 0.05, -3:] = 0
    return np.clip(x, *INT32)


@settings(max_examples=40)
@given(models(longest=300) | models(longest=100, window=True), st.integers(0, 1 << 30))
@pytest.mark.slow
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


def test_the_rounding_errors_of_a_kernel_never_add_up() -> None:
    w = np.random.default_rng(1).uniform(-126, 126, size=(30, 20, 9))
    assert (np.abs(np.cumsum(rounded_weights(w) - w, axis=2)) < 0.5 + 1e-9).all()
    assert np.array_equal(rounded_weights(w[:, :, 0]), np.rint(w[:, :, 0])), "the dense layer carries none"


def test_weights_at_the_edge_stay_within_it() -> None:
    w = np.array([[[126.6, 127.0, 127.0, 126.0], [-126.6, -127.0, -127.0, 0.0]]])
    assert rounded_weights(w).tolist() == [[[127, 127, 127, 126], [-127, -127, -127, 0]]]
    assert rounded_weights(-w).tolist() == [[[-127, -127, -127, -126], [127, 127, 127, 0]]]
    w = np.array([[[126.4, 127.0, 127.0, 125.2]]])
    assert rounded_weights(w).tolist() == [[[126, 127, 127, 126]]], "what does not fit is carried further"


def first_of(network: IntegerNetwork, x: NDArray[np.int64]) -> NDArray[np.int64]:
    """What the first layer reads of samples (T, C): them, or the outputs of the vector layer by plain integers."""
    vectors = network.vectors
    if vectors is None:
        return x
    rows, layer = [], vectors.layer
    others = network.arch.channels - layer.axes
    for at in range(layer.reach, len(x)):
        taps = [[int(v) for v in row] for row in x[at - layer.reach : at + 1]]
        up = unit_of(taps[-1][-3:])
        row = taps[-1][:others]
        for v in range(layer.vectors):
            shift = int(vectors.shift[v])
            axes = [[axis(value, shift) for value in tap[others + 3 * v : others + 3 * v + 3]] for tap in taps]
            lifted, lengths, flat, turns = [], [], [], []
            for weights, down in zip(vectors.weights[v].tolist(), vectors.down[v].tolist(), strict=True):
                d = [fits(sum(w * tap[i] for w, tap in zip(weights, axes, strict=True))) >> down for i in range(3)]
                assert max(map(abs, d)) <= 1 << 14
                lifted.append(fits(dot(d, up)) >> 14)
                flat.append([d[i] - (fits(lifted[-1] * up[i]) >> 14) for i in range(3)])
                lengths.append(math.isqrt(fits(dot(flat[-1], flat[-1]))))
            for h, n in zip(flat, [*flat[1:], flat[0]], strict=True):
                cross = [fits(h[i - 2] * n[i - 1] - h[i - 1] * n[i - 2]) for i in range(3)]
                turn = fits(sum(fits(c * u >> 14) for c, u in zip(cross, up, strict=True)))
                turns.append(math.isqrt(abs(turn)) * (1 if turn > 0 else -1))
            row = [*row, *lifted, *lengths, *turns]
        rows.append(row)
    return np.array(rows, dtype=np.int64)


def fits(number: int) -> int:
    assert -(1 << 31) <= number < 1 << 31
    return number


def dot(one: list[int], other: list[int]) -> int:
    return sum(a * b for a, b in zip(one, other, strict=True))


def axis(value: int, shift: int) -> int:
    limit = 32767 * 2**-shift if shift < 0 else 32767 >> shift
    held = max(-limit, min(limit, value))
    return fits(held << shift if shift >= 0 else held >> -shift)


def unit_of(gravity: list[int]) -> list[int]:
    if not any(gravity):
        return [0, 0, 0]
    top = max(map(abs, gravity)).bit_length()
    size = [abs(g) << 15 - top if top <= 15 else abs(g) >> top - 15 for g in gravity]
    length = math.isqrt(dot(size, size))
    return [(s << 14) // length * (-1 if g < 0 else 1) for s, g in zip(size, gravity, strict=True)]


@settings(max_examples=15)
@given(models(longest=130), st.integers(0, 1 << 30))
@pytest.mark.slow
def test_against_loops_of_plain_integers(model: IntegerModel, seed: int) -> None:
    """Every sum on its way fits 32 bits, or wraps once where the C lets it wrap: weights + 128."""
    network, arch = model.network, model.network.arch
    x = samples_of(model, arch.span, seed)
    z = [[int(v) for v in row] for row in network.inputs.apply(first_of(network, x))]
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
    if arch.pooling != "mean":
        steps = [
            [sum(part) for part in zip(*z[at : at + arch.step], strict=True)] for at in range(0, len(z), arch.step)
        ]
        for total, column in zip(tuple(pooled), zip(*steps, strict=True), strict=True):
            assert 0 <= max(column) < 1 << 16
            pooled.append(2 * sum(max(0, one - total // len(column)) for one in column))
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
    model = window_model(window=20)
    x = samples_of(model, 20, 3).T[None]
    seen = model.network.activations(x)
    assert [each.shape[1:] for each in seen] == [(20, 2), (20, 6), (20, 5)]
    assert np.array_equal(model.network.dense.apply(seen[-1].sum(axis=1).astype(float)), model.network.forward(x))


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


def test_a_vector_layer_that_is_another_or_leaves_its_bits_is_refused() -> None:
    network = vector_model().network
    vectors = network.vectors
    assert vectors is not None and changed(network).vectors is vectors
    with pytest.raises(BundleError, match="has another vector layer than"):
        changed(network, vectors=None)
    limit = np.array([16])
    for shift, down in ((limit, vectors.down), (-limit, vectors.down), (vectors.shift, vectors.down * 0 + 30)):
        assert dataclasses.replace(vectors, shift=shift, down=down)
    for changes, words in (
        ({"weights": vectors.weights[:, :1]}, r"has weights \(1, 1, 3\); the network needs \(1, 2, 3\)"),
        ({"down": vectors.down[:, :1]}, "the network needs"),
        ({"shift": np.array([0, 0])}, "the network needs"),
        ({"weights": vectors.weights.astype(np.int16)}, "weights of int16: accepted is int8"),
        ({"shift": limit + 1}, "accepted are ±16 and 0 to 30"),
        ({"shift": -limit - 1}, "accepted are ±16 and 0 to 30"),
        ({"down": vectors.down * 0 + 31}, "accepted are ±16 and 0 to 30"),
        ({"down": vectors.down * 0 - 1}, "accepted are ±16 and 0 to 30"),
        ({"down": vectors.down - 1}, "could leave its 15 bits"),
    ):
        with pytest.raises(BundleError, match=words):
            dataclasses.replace(vectors, **changes)  # type: ignore[arg-type]


def test_the_smallest_shift_of_a_kernel() -> None:
    weights = np.zeros((1, 5, 3), dtype=np.int8)
    weights[0, 1:] = [[0, 1, 0], [1, -1, 0], [-128, -128, -128], [1, 1, 1]]
    # 32767 times the weights: 0, 15 bits, 16, 24 and 17, of which 14 may stay.
    assert down_for(weights).tolist() == [[0, 1, 2, 10, 3]]
