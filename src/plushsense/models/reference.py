"""What a network means, in NumPy floats: the answer to a window, and the same answer sample by sample.

Everything is computed in float64 from float32 weights, time-major inside. ``Network.forward`` reads windows;
a ``Stepper`` reads a stream and keeps what the next decision still needs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import NORM_EPSILON, Arch, ConvLayer, reflected
from plushsense.models.state import CHUNK, Floats, Pool, Ring

Weights = Mapping[str, NDArray[np.float32]]

_TAPS_BYTES = 2 << 20


def softmax(logits: NDArray[np.floating[Any]]) -> Floats:
    """Probabilities from logits over the last axis."""
    shifted = np.exp(np.asarray(logits, dtype=np.float64) - np.max(logits, axis=-1, keepdims=True))
    return np.asarray(shifted / shifted.sum(axis=-1, keepdims=True))


def check_weights(arch: Arch, weights: Mapping[str, NDArray[Any]]) -> None:
    """Refuse weights that are not those of ``arch``: BundleError naming the first that does not fit."""
    shapes = arch.weight_shapes
    for name in weights:
        if name not in shapes:
            raise BundleError(f"The weights hold '{name}', which {arch.symbol} does not have: is this another network?")
    for name, shape in shapes.items():
        if name not in weights:
            raise BundleError(f"The weights lack '{name}', which {arch.symbol} needs: is this another network?")
        found = weights[name]
        if found.shape != shape:
            raise BundleError(f"The weights '{name}' have the shape {found.shape}; {arch.symbol} needs {shape}.")
        if not np.isfinite(found).all():
            raise BundleError(f"The weights '{name}' hold a value that is not finite: train again.")
        if name.endswith(".var") and (found < 0).any():
            raise BundleError(f"The weights '{name}' hold a negative variance: train again.")


@dataclass(frozen=True)
class _Block:
    """One layer ready to compute: ``matrix`` (kernel · channels, filters), taps outermost."""

    layer: ConvLayer
    matrix: Floats
    bias: Floats
    gain: Floats
    shift: Floats
    per_step: bool

    @classmethod
    def of(cls, arch: Arch, i: int, weights: Weights) -> _Block:
        layer, read = arch.layers[i], arch.inputs[i]
        matrix = weights[f"conv{i}.weight"].transpose(2, 1, 0).reshape(layer.kernel * read, layer.filters)
        bias, gain, shift = (
            weights[name].astype(np.float64) for name in (f"conv{i}.bias", f"norm{i}.gain", f"norm{i}.shift")
        )
        if arch.norm == "batch":
            gain = gain / np.sqrt(weights[f"norm{i}.var"].astype(np.float64) + NORM_EPSILON)
            shift = shift - weights[f"norm{i}.mean"] * gain
        return cls(layer, matrix.astype(np.float64), bias, gain, shift, arch.norm == "layer")

    def rectified(self, taps: Floats) -> Floats:
        """Convolution and ReLU: taps (n, kernel · channels) → (n, filters)."""
        out = taps @ self.matrix
        out += self.bias
        return np.maximum(out, 0.0, out=out)

    def __call__(self, taps: Floats) -> Floats:
        """The whole block: taps (n, kernel · channels) → (n, filters)."""
        out = self.rectified(taps)
        if self.per_step:
            out -= out.mean(axis=-1, keepdims=True)
            out /= np.sqrt((out * out).mean(axis=-1, keepdims=True) + NORM_EPSILON)
        out *= self.gain
        out += self.shift
        return out


def taps_of(x: Floats, layer: ConvLayer) -> Floats:
    """What each position of a layer reads: (N, T, C) → (N, T − reach, kernel, C), a view."""
    x = np.ascontiguousarray(x)
    n, t, c = x.shape
    batch, row, item = x.strides
    shape = (n, t - layer.reach, layer.kernel, c)
    return np.ndarray(shape, np.float64, x, 0, (batch, row, layer.dilation * row, item))


def _padded(x: Floats, arch: Arch, reach: int) -> Floats:
    if arch.padding == "mirror":
        return x[:, reflected(x.shape[1], reach)]
    if arch.padding == "causal":
        return np.concatenate([np.zeros((len(x), reach, x.shape[2])), x], axis=1)
    return x


def _through(x: Floats, block: _Block, arch: Arch) -> Floats:
    """One block over whole windows, (N, T, C) → (N, T', filters), a few windows at a time."""
    taps = taps_of(_padded(x, arch, block.layer.reach), block.layer)
    n, t, width = len(taps), taps.shape[1], len(block.matrix)
    out = np.empty((n, t, block.layer.filters))
    group = max(1, _TAPS_BYTES // (8 * t * width))
    for at in range(0, n, group):
        part = taps[at : at + group]
        out[at : at + group] = block(part.reshape(-1, width)).reshape(len(part), t, -1)
    return out


class Network:
    """An architecture with its weights, ready to answer.

    Raises:
        BundleError: when the weights are not those of the architecture.
    """

    def __init__(self, arch: Arch, weights: Weights) -> None:
        check_weights(arch, weights)
        self.arch = arch
        self.blocks = tuple(_Block.of(arch, i, weights) for i in range(len(arch.layers)))
        self._dense = weights["dense.weight"].T.astype(np.float64)
        self._bias = weights["dense.bias"].astype(np.float64)

    def forward(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Logits (N, K) of scaled windows (N, C, T); the last ``arch.span`` samples are read.

        Raises:
            BadInput: for windows of another shape, or shorter than the span.
        """
        return self.classify(self.features(x))

    def features(self, x: NDArray[np.floating[Any]]) -> Floats:
        """What the dense layer reads of scaled windows (N, C, T): means over time (N, F).

        Raises:
            BadInput: as `forward`.
        """
        check_windows(self.arch, x.shape)
        z: Floats = np.ascontiguousarray(x[:, :, x.shape[2] - self.arch.span :].transpose(0, 2, 1), dtype=np.float64)
        for block in self.blocks:
            z = _through(z, block, self.arch)
        return np.asarray(z.mean(axis=1))

    def rectified(self, x: NDArray[np.floating[Any]]) -> list[Floats]:
        """What each layer's ReLU gives, before normalisation, of scaled windows (N, C, T): [(N, T', F)]; `stream`."""
        z: Floats = np.ascontiguousarray(x.transpose(0, 2, 1), dtype=np.float64)
        seen = []
        for block in self.blocks:
            taps = taps_of(z, block.layer)
            seen.append(block.rectified(taps.reshape(-1, len(block.matrix))).reshape(*taps.shape[:2], -1))
            z = seen[-1] * block.gain + block.shift
        return seen

    def classify(self, pooled: Floats) -> Floats:
        """The dense layer: means over time (N, F) → logits (N, K)."""
        return np.asarray(pooled @ self._dense + self._bias)

    def probabilities(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Class probabilities (N, K) of scaled windows (N, C, T)."""
        return softmax(self.forward(x))

    def stepper(self) -> Stepper:
        """A reader of one stream, warming."""
        return _Streaming(self) if self.arch.padding == "stream" else _Recomputing(self)


def check_windows(arch: Arch, shape: tuple[int, ...]) -> None:
    """Refuse windows that are not (N, ``arch.channels``, at least ``arch.span``)."""
    if len(shape) != 3 or shape[1] != arch.channels or shape[2] < arch.span:
        raise BadInput(
            f"Windows of the shape {tuple(shape)} do not fit {arch.symbol}: it reads (windows, "
            f"{arch.channels} channels, at least {arch.span} samples)."
        )


class Stepper(ABC):
    """Reads scaled samples as they come; decides when the span has come, then every ``arch.step`` samples.

    A value that is not finite spoils the decisions that see it and none after.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self.arch = network.arch
        self.seen = 0
        self.reset()

    def step(self, sample: ArrayLike) -> Floats | None:
        """One sample (C,): logits (K,) when a decision is due, else None."""
        one = np.asarray(sample, dtype=np.float64)
        if one.shape != (self.arch.channels,):
            raise BadInput(
                f"A sample of the shape {one.shape} does not fit: {self.arch.symbol} reads "
                f"{self.arch.channels} channels."
            )
        self.seen += 1
        due = self._advance(one[None])
        return due[0] if len(due) else None

    def push(self, samples: ArrayLike) -> list[Floats]:
        """Samples (n, C) at once: the logits of every decision that ``step`` would have made, in order."""
        block = np.asarray(samples, dtype=np.float64)
        if block.ndim != 2 or block.shape[1] != self.arch.channels:
            raise BadInput(
                f"Samples of the shape {block.shape} do not fit: {self.arch.symbol} reads "
                f"(samples, {self.arch.channels} channels)."
            )
        due: list[Floats] = []
        for at in range(0, len(block), CHUNK):
            chunk = block[at : at + CHUNK]
            self.seen += len(chunk)
            due.extend(self._advance(chunk))
        return due

    @property
    def state(self) -> Literal["warming", "ready"]:
        """``warming`` until ``arch.span`` samples have come since the start or the last reset."""
        return "ready" if self.seen >= self.arch.span else "warming"

    def reset(self) -> None:
        """Forget everything: after a gap, a clock reset, a reconnection."""
        self.seen = 0
        self._clear()

    @abstractmethod
    def _clear(self) -> None: ...

    @abstractmethod
    def _advance(self, chunk: Floats) -> Floats:
        """Take at most CHUNK samples in; logits (decisions, K)."""


class _Streaming(Stepper):
    """``stream``: every sample is computed once."""

    def _clear(self) -> None:
        arch = self.arch
        self._rings = [Ring(layer, read) for layer, read in zip(arch.layers, arch.inputs, strict=True)]
        self._pool = Pool(arch.step, arch.pooled // arch.step, arch.filters[-1])

    def _advance(self, chunk: Floats) -> Floats:
        for ring, block in zip(self._rings, self.network.blocks, strict=True):
            taps = ring.feed(chunk)
            if not len(taps):
                return np.empty((0, self.arch.classes))
            chunk = block(taps)
        due = self._pool.feed(chunk)
        return self.network.classify(due) if len(due) else np.empty((0, self.arch.classes))


class _Recomputing(Stepper):
    """``mirror`` and ``causal``: each decision computes the whole window again."""

    def _clear(self) -> None:
        self._ring = Ring(ConvLayer(self.arch.window, 1, 1), self.arch.channels)

    def _advance(self, chunk: Floats) -> Floats:
        windows = self._ring.feed(chunk)
        ends = np.arange(self.seen - len(windows), self.seen) + 1 - self.arch.window
        due = windows[ends % self.arch.step == 0].reshape(-1, self.arch.window, self.arch.channels)
        return self.network.forward(due.transpose(0, 2, 1)) if len(due) else np.empty((0, self.arch.classes))


def random_weights(arch: Arch, seed: int) -> dict[str, NDArray[np.float32]]:
    """Weights such as training leaves: norm statistics that fit, uneven gains, logits of a few units.

    For tests and for measuring; they know no gesture.
    """
    rng = np.random.default_rng(seed)
    weights: dict[str, NDArray[np.float32]] = {}

    def put(name: str, values: NDArray[Any]) -> None:
        weights[name] = values.astype(np.float32)

    x = np.cumsum(rng.normal(size=(6, arch.span, arch.channels)), axis=1)
    x = (x - x.mean(axis=(0, 1))) / x.std(axis=(0, 1)) + 0.3 * rng.normal(size=x.shape)
    for i, (layer, read) in enumerate(zip(arch.layers, arch.inputs, strict=True)):
        f, taps = layer.filters, layer.kernel * read
        put(f"conv{i}.weight", rng.normal(size=(f, read, layer.kernel)) * np.sqrt(2.0 / taps))
        put(f"conv{i}.bias", 0.2 * rng.normal(size=f))
        put(f"norm{i}.gain", np.exp(0.4 * rng.normal(size=f)))
        put(f"norm{i}.shift", 0.3 * rng.normal(size=f))
        if arch.norm == "batch":
            put(f"norm{i}.mean", np.zeros(f))
            put(f"norm{i}.var", np.ones(f))
            block = _Block.of(arch, i, weights)
            rows = block.rectified(taps_of(_padded(x, arch, layer.reach), layer).reshape(-1, taps))
            put(f"norm{i}.mean", rows.mean(axis=0) * np.exp(0.1 * rng.normal(size=f)))
            put(f"norm{i}.var", (rows.var(axis=0) + 1e-3) * np.exp(0.2 * rng.normal(size=f)))
        x = _through(x, _Block.of(arch, i, weights), arch)
    put("dense.weight", 2.0 * rng.normal(size=(arch.classes, arch.filters[-1])) / np.sqrt(arch.filters[-1]))
    put("dense.bias", 0.3 * rng.normal(size=arch.classes))
    return weights
