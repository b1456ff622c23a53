"""Reference implementation of the networks in NumPy, for whole windows and, with equal logits, sample by sample.

All values are computed in float64 from float32 weights; internal arrays have time before channels.
``Network.forward`` computes windows; a ``Stepper`` processes a stream and keeps only what later decisions need.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import NORM_EPSILON, Arch, ConvLayer, VectorLayer, reflected
from plushsense.models.vectors import VectorStage

Floats = NDArray[np.float64]

DENSE = ("dense.weight", "dense.bias")
CHUNK = 256  # samples processed at once, few enough for their taps to stay in the cache


class SampleRing:
    """Buffer of the latest samples that a layer still needs.

    Rows move to the front only when the space behind them is used up.
    """

    def __init__(self, layer: ConvLayer, channels: int) -> None:
        self.layer = layer
        self.rows = np.zeros((layer.reach + 2 * CHUNK, channels))
        self.end = 0

    def feed(self, x: Floats) -> Floats:
        """Add rows (n, C); return the taps (m, kernel · C) of the m output positions that they complete."""
        reach = self.layer.reach
        if self.end + len(x) > len(self.rows):
            kept = min(reach, self.end)
            self.rows[:kept] = self.rows[self.end - kept : self.end]
            self.end = kept
        first = max(self.end - reach, 0)
        self.rows[self.end : self.end + len(x)] = x
        self.end += len(x)
        n, c = self.end - reach - first, self.rows.shape[1]
        if n <= 0:
            return np.empty((0, self.layer.kernel * c))
        row = 8 * c
        shape, strides = (n, self.layer.kernel, c), (row, self.layer.dilation * row, 8)
        return np.ndarray(shape, np.float64, self.rows, first * row, strides).reshape(n, -1)


class Pool:
    """Statistics of the last ``blocks`` · ``step`` rows, updated every ``step`` rows.

    It keeps one sum per step. Sums are never subtracted, so that rounding errors do not accumulate. ``statistics`` maps
    sums (m, blocks, F) to the inputs (m, features) of the dense layer.
    """

    def __init__(self, step: int, blocks: int, filters: int, statistics: Callable[[Floats], Floats]) -> None:
        self.step = step
        self.blocks = blocks
        self.statistics = statistics
        self.done = np.empty((0, filters))  # sums of whole steps, at most blocks − 1
        self.open = np.zeros(filters)  # sum of the current, incomplete step
        self.held = 0

    def feed(self, z: Floats) -> Floats:
        """Add rows (n, F); return statistics (m, features) at each step that they complete, once there are enough."""
        if self.held + len(z) < self.step:
            self.open = self.open + z.sum(axis=0)
            self.held += len(z)
            return self.statistics(np.empty((0, self.blocks, z.shape[1])))
        head = self.step - self.held
        whole = (len(z) - head) // self.step
        rest = z[head + whole * self.step :]
        first = self.open + z[:head].sum(axis=0)
        others = z[head : head + whole * self.step].reshape(whole, self.step, z.shape[1]).sum(axis=1)
        sums = np.concatenate([self.done, first[None], others])
        self.open, self.held = rest.sum(axis=0), len(rest)
        self.done = sums[max(len(sums) - self.blocks + 1, 0) :]
        n = len(sums) - self.blocks + 1
        row, item = sums.strides
        shape = (max(n, 0), self.blocks, sums.shape[1])
        return self.statistics(np.ndarray(shape, np.float64, sums, 0, (row, row, item)))


class WindowRing:
    """Buffer of the samples of a window, for networks that compute each window as a whole."""

    def __init__(self, arch: Arch) -> None:
        self.arch = arch
        self._ring = SampleRing(ConvLayer(arch.window, 1, 1), arch.channels)
        self._seen = 0

    def feed(self, x: Floats) -> Floats:
        """Add rows (n, C); return the windows (m, T, C) of the decisions that are then due."""
        windows = self._ring.feed(x)
        self._seen += len(x)
        ends = np.arange(self._seen - len(windows), self._seen) + 1 - self.arch.window
        due: Floats = windows[ends % self.arch.step == 0].reshape(-1, self.arch.window, self.arch.channels)
        return due


Weights = Mapping[str, NDArray[np.float32]]

_TAPS_BYTES = 2 << 20


def softmax(logits: NDArray[np.floating[Any]]) -> Floats:
    """Return the softmax of logits over the last axis."""
    shifted = np.exp(np.asarray(logits, dtype=np.float64) - np.max(logits, axis=-1, keepdims=True))
    return np.asarray(shifted / shifted.sum(axis=-1, keepdims=True))


def check_weights(arch: Arch, weights: Mapping[str, NDArray[Any]]) -> None:
    """Raise BundleError for the first weight that does not fit ``arch``, or has an impossible value."""
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


def divide_logits(weights: Mapping[str, NDArray[np.float32]], by: float) -> dict[str, NDArray[np.float32]]:
    """Return the weights of the network whose logits are those of this one divided by a number."""
    return {**weights, **{name: np.asarray(weights[name] / np.float32(by)) for name in DENSE}}


def affine(arch: Arch, i: int, weights: Weights) -> tuple[Floats, Floats]:
    """Return gain and shift (F,) of the normalisation of layer ``i``, ones and zeros if there is none.

    With batch normalisation, the running mean and variance are included in them.
    """
    if arch.norm == "none":
        return np.ones(arch.layers[i].filters), np.zeros(arch.layers[i].filters)
    gain, shift = (weights[f"norm{i}.{name}"].astype(np.float64) for name in ("gain", "shift"))
    if arch.norm == "batch":
        gain = gain / np.sqrt(weights[f"norm{i}.var"].astype(np.float64) + NORM_EPSILON)
        shift = shift - weights[f"norm{i}.mean"] * gain
    return gain, shift


@dataclass(frozen=True)
class _Block:
    """Float64 parameters of a layer; ``matrix`` is (kernel · channels, filters), channels of a tap adjacent."""

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
        bias = weights[f"conv{i}.bias"].astype(np.float64)
        return cls(layer, matrix.astype(np.float64), bias, *affine(arch, i, weights), arch.norm == "layer")

    def rectified(self, taps: Floats) -> Floats:
        """Compute convolution and ReLU: taps (n, kernel · channels) → (n, filters)."""
        out = taps @ self.matrix
        out += self.bias
        return np.maximum(out, 0.0, out=out)

    def __call__(self, taps: Floats) -> Floats:
        """Compute the whole block: taps (n, kernel · channels) → (n, filters)."""
        out = self.rectified(taps)
        if self.per_step:
            out -= out.mean(axis=-1, keepdims=True)
            out /= np.sqrt((out * out).mean(axis=-1, keepdims=True) + NORM_EPSILON)
        out *= self.gain
        out += self.shift
        return out


def taps_of(x: Floats, layer: ConvLayer) -> Floats:
    """Return, as a view, the samples for each output position of a layer: (N, T, C) → (N, T − reach, kernel, C)."""
    x = np.ascontiguousarray(x)
    n, t, c = x.shape
    batch, row, item = x.strides
    shape = (n, t - layer.reach, layer.kernel, c)
    return np.ndarray(shape, np.float64, x, 0, (batch, row, layer.dilation * row, item))


def padded(x: Floats, arch: Arch, reach: int) -> Floats:
    """Return the inputs of a layer, (N, T, C), with the padding of ``arch`` before them: (N, reach + T, C)."""
    if arch.padding == "mirror":
        return x[:, reflected(x.shape[1], reach)]
    if arch.padding == "causal":
        return np.concatenate([np.zeros((len(x), reach, x.shape[2])), x], axis=1)
    return x


def _through(x: Floats, block: _Block, arch: Arch) -> Floats:
    """Apply one block to whole windows, (N, T, C) → (N, T', filters), a few windows at a time."""
    taps = taps_of(padded(x, arch, block.layer.reach), block.layer)
    n, t, width = len(taps), taps.shape[1], len(block.matrix)
    out = np.empty((n, t, block.layer.filters))
    group = max(1, _TAPS_BYTES // (8 * t * width))
    for at in range(0, n, group):
        part = taps[at : at + group]
        out[at : at + group] = block(part.reshape(-1, width)).reshape(len(part), t, -1)
    return out


class Network:
    """An architecture with its weights, ready to compute.

    Raises:
        BundleError: if the weights do not fit the architecture.
    """

    def __init__(self, arch: Arch, weights: Weights) -> None:
        check_weights(arch, weights)
        self.arch = arch
        self.vectors = None if arch.vector is None else VectorStage(arch.vector, arch, weights)
        self.blocks = tuple(_Block.of(arch, i, weights) for i in range(len(arch.layers)))
        self._dense = weights["dense.weight"].T.astype(np.float64)
        self._bias = weights["dense.bias"].astype(np.float64)

    def forward(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Return logits (N, K) of scaled windows (N, C, T); only the last ``arch.span`` samples are used.

        Raises:
            BadInput: for windows of another shape, or shorter than the span.
        """
        return self.classify(self.features(x))

    def features(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Return the inputs of the dense layer, statistics over time (N, features), for scaled windows (N, C, T).

        Raises:
            BadInput: as in `forward`.
        """
        check_windows(self.arch, x.shape)
        z = self.convolved(x[:, :, x.shape[2] - self.arch.span :])
        for block in self.blocks:
            z = _through(z, block, self.arch)
        return np.asarray(z.mean(axis=1)) if self.arch.pooling == "mean" else self.pooled(step_sums(z, self.arch))

    def pooled(self, sums: Floats) -> Floats:
        """Return the inputs (N, features) of the dense layer from the sums (N, blocks, F) of each step."""
        mean = np.asarray(sums.sum(axis=1) / self.arch.pooled)
        if self.arch.pooling == "mean":
            return mean
        return np.concatenate([mean, np.abs(sums / self.arch.step - mean[:, None]).mean(axis=1)], axis=1)

    def convolved(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Return the inputs of the first convolution (N, T', C') for scaled windows (N, C, T)."""
        z: Floats = np.ascontiguousarray(x.transpose(0, 2, 1), dtype=np.float64)
        return z if self.vectors is None else self.vectors(taps_of(z, tap_layer(self.vectors.layer)))

    def rectified(self, z: Floats) -> list[Floats]:
        """Return the ReLU outputs (N, T', F) of each layer, before normalisation, from the result of `convolved`.

        Not for networks with layer normalisation.
        """
        seen = []
        for block in self.blocks:
            taps = taps_of(padded(z, self.arch, block.layer.reach), block.layer)
            seen.append(block.rectified(taps.reshape(-1, len(block.matrix))).reshape(*taps.shape[:2], -1))
            z = seen[-1] * block.gain + block.shift
        return seen

    def classify(self, pooled: Floats) -> Floats:
        """Apply the dense layer: statistics over time (N, features) → logits (N, K)."""
        return np.asarray(pooled @ self._dense + self._bias)

    def probabilities(self, x: NDArray[np.floating[Any]]) -> Floats:
        """Return class probabilities (N, K) of scaled windows (N, C, T)."""
        return softmax(self.forward(x))

    def stepper(self) -> Stepper:
        """Return a new `Stepper` for one stream."""
        return _Streaming(self) if self.arch.padding == "stream" else _Recomputing(self)


def step_sums(z: Floats, arch: Arch) -> Floats:
    """Return the sums (N, blocks, F) of each step of the pool (N, T', F)."""
    return np.asarray(z.reshape(len(z), arch.blocks, arch.step, z.shape[2]).sum(axis=2))


def check_windows(arch: Arch, shape: tuple[int, ...]) -> None:
    """Raise BadInput unless ``shape`` is (N, ``arch.channels``, at least ``arch.span``)."""
    if len(shape) != 3 or shape[1] != arch.channels or shape[2] < arch.span:
        raise BadInput(
            f"Windows of the shape {tuple(shape)} do not fit {arch.symbol}: it reads (windows, "
            f"{arch.channels} channels, at least {arch.span} samples)."
        )


class Stepper(ABC):
    """Compute logits from a stream: after the first ``arch.span`` samples, then every ``arch.step`` samples.

    ``seen`` is the number of samples since the start or the last reset.
    """

    def __init__(self, arch: Arch) -> None:
        self.arch = arch
        self.reset()

    def step(self, sample: ArrayLike) -> NDArray[Any] | None:
        """Add one sample (C,); return logits (K,) if a decision is due, else None."""
        due = self.push(np.asarray(sample)[None])
        return due[0] if len(due) else None

    def push(self, samples: ArrayLike) -> NDArray[Any]:
        """Add samples (n, C); return the logits (m, K) of the decisions that are due.

        The logits do not depend on how the samples are divided among calls.

        Raises:
            BadInput: for samples of another shape, or with values that the network does not accept.
        """
        block = self._values(samples)
        if block.ndim != 2 or block.shape[1] != self.arch.channels:
            raise BadInput(
                f"Samples of the shape {block.shape} do not fit: {self.arch.symbol} reads "
                f"(samples, {self.arch.channels} channels)."
            )
        due = []
        for at in range(0, len(block), CHUNK):
            chunk = block[at : at + CHUNK]
            self.seen += len(chunk)
            due.append(self._advance(chunk))
        return due[0] if len(due) == 1 else np.concatenate([self._advance(block[:0]), *due])

    @property
    def state(self) -> Literal["warming", "ready"]:
        """``warming`` until ``arch.span`` samples were added since the start or the last reset, then ``ready``."""
        return "ready" if self.seen >= self.arch.span else "warming"

    def reset(self) -> None:
        """Drop all samples, as after a gap, a clock reset or a reconnection."""
        self.seen = 0
        self._clear()

    @abstractmethod
    def _clear(self) -> None: ...

    @abstractmethod
    def _values(self, samples: ArrayLike) -> NDArray[Any]:
        """Return the samples as an array of the type that the network uses."""

    @abstractmethod
    def _advance(self, chunk: NDArray[Any]) -> NDArray[Any]:
        """Add at most CHUNK samples; return logits (decisions, K)."""


class _FloatStepper(Stepper):
    """A stepper for scaled samples. A value that is not finite affects only decisions whose span includes it."""

    def __init__(self, network: Network) -> None:
        self.network = network
        super().__init__(network.arch)

    def _values(self, samples: ArrayLike) -> Floats:
        return np.asarray(samples, dtype=np.float64)


class _Streaming(_FloatStepper):
    """Stepper for the padding ``stream``, in which every layer output is computed once."""

    def _clear(self) -> None:
        self._rings, self._pool = stream_state(self.arch.trunk, self.network.pooled)
        self._axes = axes_ring(self.arch)

    def _advance(self, chunk: Floats) -> Floats:
        if self._axes is not None and self.network.vectors is not None:
            taps = self._axes.feed(chunk)
            chunk = self.network.vectors(taps.reshape(len(taps), self._axes.layer.kernel, self.arch.channels))
        for ring, block in zip(self._rings, self.network.blocks, strict=True):
            taps = ring.feed(chunk)
            if not len(taps):
                return np.empty((0, self.arch.classes))
            chunk = block(taps)
        return self.network.classify(self._pool.feed(chunk))


class _Recomputing(_FloatStepper):
    """Stepper for the paddings ``mirror`` and ``causal``; each decision computes the whole window again."""

    def _clear(self) -> None:
        self._windows = WindowRing(self.arch)

    def _advance(self, chunk: Floats) -> Floats:
        due = self._windows.feed(chunk)
        return self.network.forward(due.transpose(0, 2, 1)) if len(due) else np.empty((0, self.arch.classes))


def tap_layer(layer: VectorLayer) -> ConvLayer:
    """Return a convolution layer that reads the same samples as a vector layer."""
    return ConvLayer(layer.kernel, 1, layer.filters)


def axes_ring(arch: Arch) -> SampleRing | None:
    """Return the buffer before the vector layer of a network; None if it has none."""
    return None if arch.vector is None else SampleRing(tap_layer(arch.vector), arch.channels)


def stream_state(arch: Arch, statistics: Callable[[Floats], Floats]) -> tuple[list[SampleRing], Pool]:
    """Return the state of a ``stream`` network between samples: a buffer before each layer, and the pooling."""
    rings = [SampleRing(layer, read) for layer, read in zip(arch.layers, arch.inputs, strict=True)]
    return rings, Pool(arch.step, arch.blocks, arch.layers[-1].filters, statistics)


def random_weights(arch: Arch, seed: int) -> dict[str, NDArray[np.float32]]:
    """Return random weights with statistics like trained ones, for tests and measurements.

    Normalisation statistics fit the activations, gains are uneven and logits have a size of a few units.
    """
    rng = np.random.default_rng(seed)
    weights: dict[str, NDArray[np.float32]] = {}

    def put(name: str, values: NDArray[Any]) -> None:
        weights[name] = values.astype(np.float32)

    x = np.cumsum(rng.normal(size=(6, arch.span, arch.channels)), axis=1)
    x = (x - x.mean(axis=(0, 1))) / x.std(axis=(0, 1)) + 0.3 * rng.normal(size=x.shape)
    if arch.vector is not None:
        put("vector.weight", rng.normal(size=arch.weight_shapes["vector.weight"]) / np.sqrt(arch.vector.kernel))
        put("vector.mean", np.zeros(arch.inputs[0]))
        put("vector.var", np.ones(arch.inputs[0]))
        seen = VectorStage(arch.vector, arch, weights).invariants(taps_of(x, tap_layer(arch.vector)))
        put("vector.mean", seen.mean(axis=(0, 1)))
        put("vector.var", seen.var(axis=(0, 1)))
        x = VectorStage(arch.vector, arch, weights)(taps_of(x, tap_layer(arch.vector)))
    for i, (layer, read) in enumerate(zip(arch.layers, arch.inputs, strict=True)):
        f, taps = layer.filters, layer.kernel * read
        put(f"conv{i}.weight", rng.normal(size=(f, read, layer.kernel)) * np.sqrt(2.0 / taps))
        put(f"conv{i}.bias", 0.2 * rng.normal(size=f))
        if arch.norm != "none":
            put(f"norm{i}.gain", np.exp(0.4 * rng.normal(size=f)))
            put(f"norm{i}.shift", 0.3 * rng.normal(size=f))
        if arch.norm == "batch":
            put(f"norm{i}.mean", np.zeros(f))
            put(f"norm{i}.var", np.ones(f))
            block = _Block.of(arch, i, weights)
            rows = block.rectified(taps_of(padded(x, arch, layer.reach), layer).reshape(-1, taps))
            put(f"norm{i}.mean", rows.mean(axis=0) * np.exp(0.1 * rng.normal(size=f)))
            put(f"norm{i}.var", (rows.var(axis=0) + 1e-3) * np.exp(0.2 * rng.normal(size=f)))
        x = _through(x, _Block.of(arch, i, weights), arch)
    put("dense.weight", 2.0 * rng.normal(size=(arch.classes, arch.features)) / np.sqrt(arch.features))
    put("dense.bias", 0.3 * rng.normal(size=arch.classes))
    return weights
