"""What a network means: windows against a slow oracle, the stepper against windows."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import NORMS, PADDINGS, PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.models.reference import Network, random_weights, softmax

pytestmark = pytest.mark.slow

SMALL = {"channels": 3, "classes": 4, "window": 40}


def small(padding: str = "stream", norm: str = "batch", seed: int = 1, pooling: str = "mean") -> Network:
    arch = Arch.parse("4d1_3d2_2d5", (5, 4, 6), padding=padding, norm=norm, pooling=pooling, **SMALL)
    return Network(arch, random_weights(arch, seed))


def windows(network: Network, n: int, extra: int = 0, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=(n, network.arch.channels, network.arch.span + extra))


def oracle(arch: Arch, weights: dict[str, NDArray[np.float32]], window: NDArray[np.float64]) -> list[float]:
    """One window (C, T) through the definition, tap by tap."""
    z = window
    for i, layer in enumerate(arch.layers):
        if arch.padding == "mirror":
            z = np.pad(z, ((0, 0), (layer.reach, 0)), mode="reflect")
        elif arch.padding == "causal":
            z = np.pad(z, ((0, 0), (layer.reach, 0)))
        kernel, bias = weights[f"conv{i}.weight"], weights[f"conv{i}.bias"]
        out = np.zeros((layer.filters, z.shape[1] - layer.reach))
        for f in range(layer.filters):
            for t in range(out.shape[1]):
                taps = [kernel[f, :, k] @ z[:, t + k * layer.dilation] for k in range(layer.kernel)]
                out[f, t] = max(sum(taps) + bias[f], 0.0)
        if arch.norm == "none":
            z = out
            continue
        if arch.norm == "batch":
            mean, var = weights[f"norm{i}.mean"][:, None], weights[f"norm{i}.var"][:, None]
        else:
            mean, var = out.mean(axis=0), out.var(axis=0)
        z = (out - mean) / np.sqrt(var + 1e-5)
        z = z * weights[f"norm{i}.gain"][:, None] + weights[f"norm{i}.shift"][:, None]
    pooled = z.mean(axis=1)
    if arch.pooling != "mean":
        steps = [[part.mean() for part in np.split(row, arch.blocks)] for row in z]
        pooled = np.append(pooled, [np.mean([abs(m - np.mean(row)) for m in row]) for row in steps])
    return list(weights["dense.weight"] @ pooled + weights["dense.bias"])


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize(("padding", "pooling"), [*((p, "mean") for p in PADDINGS), ("stream", "mean+deviation")])
def test_forward_is_the_definition(padding: str, pooling: str, norm: str) -> None:
    network = small(padding, norm, pooling=pooling)
    weights = random_weights(network.arch, 1)
    x = windows(network, 2)
    expected = np.array([oracle(network.arch, weights, w) for w in x])
    np.testing.assert_allclose(network.forward(x), expected, atol=1e-6)
    for name, tensor in weights.items():
        moved = {**weights, name: tensor + np.float32(0.01)}
        change = np.abs(Network(network.arch, moved).forward(x) - expected).max()
        assert change > 1e-5, f"{name} has no effect"


def test_forward_reads_the_last_span_and_any_number_of_windows() -> None:
    network = small()
    x = windows(network, 3, extra=17)
    np.testing.assert_array_equal(network.forward(x), network.forward(x[:, :, 17:]))
    assert network.forward(x[:0]).shape == (0, 4)
    np.testing.assert_allclose(network.probabilities(x).sum(axis=1), 1.0)
    assert np.isfinite(softmax(np.array([1e4, -1e4]))).all()


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("symbol", PAPER_ARCHITECTURES)
def test_stream_equals_windows_around_the_warm_up(symbol: str, norm: str) -> None:
    arch = Arch.parse(symbol, PAPER_FILTERS[1], norm=norm)
    network = Network(arch, random_weights(arch, 3))
    stream = np.random.default_rng(4).normal(size=(arch.span + 22, arch.channels))
    stepper = network.stepper()
    early = [stepper.step(sample) for sample in stream[: arch.span - 1]]
    assert all(logits is None for logits in early)
    assert stepper.state == "warming"
    due = {n: stepper.step(stream[n - 1]) for n in range(arch.span, len(stream) + 1)}
    assert stepper.state == "ready"
    decided = {n: logits for n, logits in due.items() if logits is not None}
    assert list(decided) == list(range(arch.span, len(stream) + 1, arch.step))
    expected = network.forward(np.stack([stream[n - arch.span : n].T for n in decided]))
    np.testing.assert_allclose(list(decided.values()), expected, atol=1e-9)


@settings(max_examples=40)
@given(st.sampled_from(PADDINGS), st.lists(st.integers(0, 700), max_size=6), st.sampled_from((1, 4, 5)))
def test_blocks_of_any_size_decide_alike(padding: str, sizes: list[int], step: int) -> None:
    arch = Arch.parse("4d1_3d2_2d5", (5, 4, 6), padding=padding, step=step, **SMALL)
    network = Network(arch, random_weights(arch, 1))
    stream = np.random.default_rng(5).normal(size=(sum(sizes), 3))
    stepper, at, found = network.stepper(), 0, []
    for size in sizes:
        found.extend(stepper.push(stream[at : at + size]))
        at += size
    ends = range(arch.span, len(stream) + 1, step)
    assert len(found) == len(ends)
    if found:
        expected = network.forward(np.stack([stream[n - arch.span : n].T for n in ends]))
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("padding", PADDINGS)
def test_step_and_push_mix_and_reset_starts_anew(padding: str) -> None:
    network = small(padding)
    stream = np.random.default_rng(6).normal(size=(150, 3))
    fresh = network.stepper().push(stream)
    used = network.stepper()
    used.push(1e3 * stream[:77])
    used.reset()
    assert (used.seen, used.state) == (0, "warming")
    mixed = list(used.push(stream[:31]))
    mixed += [logits for sample in stream[31:90] if (logits := used.step(sample)) is not None]
    mixed.extend(used.push(stream[90:]))
    np.testing.assert_allclose(mixed, fresh, atol=1e-9)
    assert used.seen == 150


def test_a_million_samples_do_not_drift() -> None:
    network = small()
    span, stepper, decisions = network.arch.span, network.stepper(), 0
    rng = np.random.default_rng(7)
    for block in range(100):
        # A burst as of a broken sensor: what a running float sum would never forget.
        stream = rng.normal(size=(10_000, 3)) * (1e9 if block % 10 == 3 else 1.0)
        found = stepper.push(stream)
        decisions += len(found)
        if block % 33 == 0:
            last = (stepper.seen - span) % network.arch.step
            end = len(stream) - last
            expected = network.forward(stream[end - span : end].T[None])[0]
            np.testing.assert_allclose(found[-1], expected, atol=1e-9)
    assert stepper.seen == 1_000_000
    assert decisions == (1_000_000 - span) // network.arch.step + 1


def test_a_value_that_is_not_finite_passes() -> None:
    network = small()
    stream = np.random.default_rng(8).normal(size=(300, 3))
    clean = np.array(network.stepper().push(stream))
    broken = stream.copy()
    broken[100, 1] = np.nan
    found = np.array(network.stepper().push(broken))
    spoilt = ~np.isfinite(found).all(axis=1)
    ends = network.arch.span + network.arch.step * np.arange(len(found))
    sees = (ends > 100) & (ends - network.arch.span <= 100)
    np.testing.assert_array_equal(spoilt, sees)
    np.testing.assert_allclose(found[~spoilt], clean[~spoilt], atol=1e-9)


@pytest.mark.parametrize("shape", [(2, 3, 10), (2, 4, 60), (3, 60)])
def test_windows_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(BadInput, match=r"do not fit 4d1_3d2_2d5.*3 channels"):
        small().forward(np.zeros(shape))


def test_samples_of_another_width_are_refused() -> None:
    stepper = small().stepper()
    with pytest.raises(BadInput, match="3 channels"):
        stepper.step(np.zeros(4))
    with pytest.raises(BadInput, match="3 channels"):
        stepper.push(np.zeros((5, 4)))
    assert stepper.seen == 0


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"conv1.bias": None}, "lack 'conv1.bias'"),
        ({"conv9.bias": np.zeros(3)}, "hold 'conv9.bias'"),
        ({"dense.bias": np.zeros(5)}, r"shape \(5,\).* needs \(4,\)"),
        ({"norm0.gain": np.full(5, np.nan)}, "'norm0.gain' hold a value that is not finite"),
        ({"norm0.var": np.full(5, -1.0)}, "negative variance"),
    ],
)
def test_weights_of_another_network_are_refused(change: dict[str, Any], why: str) -> None:
    arch = small().arch
    weights = {k: v for k, v in (random_weights(arch, 1) | change).items() if v is not None}
    with pytest.raises(BundleError, match=why):
        Network(arch, weights)


def test_features_are_what_the_dense_layer_reads() -> None:
    arch = Arch.parse("14d1_19d2_19d4", (8, 12, 16))
    network = Network(arch, random_weights(arch, 1))
    x = np.random.default_rng(0).normal(size=(3, 11, 250))
    assert network.features(x).shape == (3, 16)
    assert (network.classify(network.features(x)) == network.forward(x)).all()


def test_no_pytorch_on_the_way() -> None:
    code = "import sys, plushsense.models.bundle; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
