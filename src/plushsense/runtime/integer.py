"""Integer network: 8-bit weights and activations, 32-bit sums, fixed-point scales.

This module is the specification of a deployed network; the C in the toy gives the same results bit for bit. Networks
with the padding ``stream`` run sample by sample. With the padding ``mirror``, for which there is no C, every step
computes the whole window again: each layer reads 8-bit activations, reflected before the first. Batch normalisation is
folded into the following layer. Sums are computed in float64, which is fast and represents all possible sums exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import Arch, VectorLayer
from plushsense.models.reference import (
    Floats,
    Stepper,
    WindowRing,
    axes_ring,
    check_windows,
    padded,
    step_sums,
    stream_state,
    tap_layer,
    taps_of,
)
from plushsense.runtime.fixed import Bytes, InputScale, Ints, LogitScale, Requantize

UNIT_BITS = 14
AXIS_LIMIT = 32767
MOST_AXIS_SHIFT = 16
MOST_DOWN = 30


@dataclass(frozen=True, eq=False)
class IntegerVectors:
    """The integer vector layer: ``shift`` (V,), ``weights`` (V, K, taps) int8 and ``down`` (V, K).

    Raises:
        BundleError: if the parts do not fit the layer, or d could exceed its limit.
    """

    layer: VectorLayer
    shift: Ints
    weights: NDArray[np.int8]
    down: Ints

    def __post_init__(self) -> None:
        layer = self.layer
        shape = (layer.vectors, layer.filters, layer.kernel)
        if self.weights.shape != shape or self.down.shape != shape[:2] or self.shift.shape != shape[:1]:
            raise BundleError(f"The integer vector layer has weights {self.weights.shape}; the network needs {shape}.")
        if self.weights.dtype != np.int8:
            raise BundleError(f"The integer vector layer has weights of {self.weights.dtype}: accepted is int8.")
        if int(np.abs(self.shift).max()) > MOST_AXIS_SHIFT or not 0 <= self.down.min() <= self.down.max() <= MOST_DOWN:
            raise BundleError(
                f"The integer vector layer has shifts {self.shift.tolist()} and {self.down.tolist()}: accepted are "
                f"±{MOST_AXIS_SHIFT} and 0 to {MOST_DOWN}."
            )
        if (self.down < down_for(self.weights)).any():
            raise BundleError("A sum of the vector layer could leave its 15 bits: shift it further down.")

    def apply(self, taps: Floats) -> Ints:
        """Compute the outputs (n, M) of raw inputs (n, kernel, C), integers as float64, oldest first."""
        x = taps.astype(np.int64)
        others = x.shape[2] - self.layer.axes
        newest = x[:, -1]
        up = unit(newest[:, -3:])
        parts = [newest[:, :others]]
        for number, shift in enumerate(self.shift.tolist()):
            first = others + 3 * number
            a = scaled_axes(x[:, :, first : first + 3], shift)
            d = (self._matrices[number] @ a.astype(np.float64)).astype(np.int64) >> self.down[number][:, None]
            parts += list(_invariants(d, up))
        return np.concatenate(parts, axis=1)

    @cached_property
    def _matrices(self) -> Floats:
        return self.weights.astype(np.float64)


def down_for(weights: NDArray[np.int8]) -> Ints:
    """Return the smallest shift (V, K) with which no sum of the axes times the weights exceeds 2^14."""
    most = np.abs(weights.astype(np.int64)).sum(axis=2) * AXIS_LIMIT
    shifts = [max(0, int(m - 1).bit_length() - UNIT_BITS) for m in most.ravel()]
    return np.array(shifts, dtype=np.int64).reshape(most.shape)


def scaled_axes(x: Ints, shift: int) -> Ints:
    """Return x · 2^shift, clamped to ± `AXIS_LIMIT`."""
    limit = AXIS_LIMIT >> shift if shift >= 0 else AXIS_LIMIT << -shift
    held = np.minimum(np.maximum(x, -limit), limit)
    return np.asarray(held << shift if shift >= 0 else held >> -shift)


def root(square: Ints) -> Ints:
    """Return the integer square root of numbers below 2^32, for which the root of a float64 is exact."""
    return np.sqrt(square.astype(np.float64)).astype(np.int64)


def unit(gravity: Ints) -> Ints:
    """Return the unit vector (n, 3) in steps of 2^-14 of vectors (n, 3)."""
    size = np.abs(gravity)
    bits = np.frexp(size.max(axis=1).astype(np.float64))[1]  # the bit length of a whole number
    left = (UNIT_BITS + 1 - bits)[:, None]
    size = np.where(left >= 0, size << np.maximum(left, 0), size >> np.maximum(-left, 0))
    length = root((size**2).sum(axis=1))[:, None]
    return np.asarray(np.sign(gravity) * ((size << UNIT_BITS) // np.maximum(length, 1)))


def _invariants(d: Ints, up: Ints) -> tuple[Ints, Ints, Ints]:
    """Return v, n and c (n, K) of the vectors (n, K, 3) and the unit vectors (n, 3)."""
    up = up[:, None]
    v = (d * up).sum(axis=2) >> UNIT_BITS
    h = d - ((v[:, :, None] * up) >> UNIT_BITS)
    x, y, z = np.moveaxis(h, 2, 0)
    other_x, other_y, other_z = np.moveaxis(np.roll(h, -1, axis=1), 2, 0)
    cross = np.stack([y * other_z - z * other_y, z * other_x - x * other_z, x * other_y - y * other_x], axis=2)
    turn = ((cross * up) >> UNIT_BITS).sum(axis=2)
    return v, root((h**2).sum(axis=2)), np.sign(turn) * root(np.abs(turn))


_SUM_LIMIT = (1 << 31) - 1
MOST_REACH = ((1 << 23) - 1) // 255
"""Most that the absolute weights of a filter may add up to, since the toy keeps its sums in 24 bits (without bias)."""


def deployable(arch: Arch) -> bool:
    """Return whether a network can run in integers; `plushsense.deploy.quantize.refuse_undeployable` gives the reasons.

    In C only those with the padding ``stream`` run (`plushsense.runtime.image.refuse_image`).
    """
    return arch.padding != "causal" and arch.norm != "layer"


def rounded_weights(w: Floats) -> NDArray[np.int8]:
    """Round weights (F, C, K) or (F, C), in steps of the 8 bits, to whole numbers within ±127.

    The rounding error of each tap is carried to the next (error diffusion). The errors of a kernel then nearly cancel
    for inputs that change slowly, as touch and its features do, for which errors of the same sign would add up.
    """
    taps = w[..., None] if w.ndim == 2 else w
    whole, carried = np.empty(taps.shape, dtype=np.int8), np.zeros(taps.shape[:2])
    for k in range(taps.shape[2]):
        exact = taps[:, :, k] + carried
        kept = np.clip(np.rint(exact), -127, 127)
        whole[:, :, k], carried = kept, exact - kept
    return whole.reshape(w.shape)


@dataclass(frozen=True, eq=False)
class IntegerLayer:
    """Integer layer: ``weights`` (F, C, K) int8, ``bias`` (F,) int32, ``scale`` from sums to 8-bit activations."""

    weights: NDArray[np.int8]
    bias: Ints
    scale: Requantize

    @cached_property
    def matrix(self) -> Floats:
        """The weights as (K · C, F), taps outermost."""
        f, c, k = self.weights.shape
        return self.weights.transpose(2, 1, 0).reshape(k * c, f).astype(np.float64)

    def apply(self, taps: Floats) -> Floats:
        """Compute activations (n, F), integers as float64, from inputs (n, K · C), taps outermost."""
        return self.scale.apply((taps @ self.matrix).astype(np.int64) + self.bias).astype(np.float64)


@dataclass(frozen=True, eq=False)
class IntegerDense:
    """The last layer: ``weights`` (K, features) int8, ``bias`` (K,) int32, ``scale`` of sums to logits.

    Its inputs are the sums of each filter over the pool, and with the pooling ``mean+deviation`` then twice the sum of
    what the sums of its steps exceed their mean by, which is rounded down.
    """

    weights: NDArray[np.int8]
    bias: Ints
    scale: LogitScale

    @cached_property
    def matrix(self) -> Floats:
        """The weights as (features, K)."""
        return self.weights.T.astype(np.float64)

    def apply(self, pooled: Floats) -> Ints:
        """Compute logits (N, K) in steps of 1/256 from inputs (N, features)."""
        return self.scale.apply((pooled @ self.matrix).astype(np.int64) + self.bias)


@dataclass(frozen=True, eq=False)
class IntegerNetwork:
    """A network in integers.

    Raises:
        BundleError: if the layers do not fit ``arch``, or a sum could exceed 32 bits, or 24 in a convolution.
    """

    arch: Arch
    inputs: InputScale
    layers: tuple[IntegerLayer, ...]
    dense: IntegerDense
    vectors: IntegerVectors | None = None

    def __post_init__(self) -> None:
        arch = self.arch
        if not deployable(arch):
            raise BundleError(
                f"{arch.title} has padding '{arch.padding}' and {arch.norm} normalisation: a network in "
                "integers needs 'stream' or 'mirror', and batch normalisation or none."
            )
        shapes = arch.weight_shapes
        needed = [shapes[f"conv{i}.weight"] for i in range(len(arch.layers))] + [shapes["dense.weight"]]
        parts: list[IntegerLayer | IntegerDense] = [*self.layers, self.dense]
        if (self.vectors and self.vectors.layer) != arch.vector:
            raise BundleError(f"The integer network has another vector layer than {arch.title}.")
        if len(self.inputs) != arch.inputs[0] or len(parts) != len(needed):
            raise BundleError(
                f"The integer network is not {arch.title}: it has {len(self.inputs)} inputs and "
                f"{len(self.layers)} layers."
            )
        for n, (part, shape) in enumerate(zip(parts, needed, strict=True), 1):
            if part.weights.shape != shape or part.bias.shape != shape[:1] or len(part.scale) != shape[0]:
                raise BundleError(
                    f"Layer {n} of the integer network has weights {part.weights.shape}; {arch.title} needs {shape}."
                )
            if part.weights.dtype != np.int8 or part.bias.dtype.kind != "i":
                raise BundleError(
                    f"Layer {n} of the integer network has weights of {part.weights.dtype} and biases of "
                    f"{part.bias.dtype}: accepted are int8 and whole numbers."
                )
            most = 255 * (arch.pooled if part is self.dense else 1)
            reach = np.abs(part.weights.astype(np.int64)).reshape(len(part.bias), -1).sum(axis=1)
            if part is not self.dense and reach.max() > MOST_REACH:
                raise BundleError(f"A sum of layer {n} of {arch.title} could leave 24 bits: use fewer taps or filters.")
            reach *= most
            # In floats, since biases of 64 bits may overflow.
            if part.weights.size and (np.abs(part.bias.astype(np.float64)) + reach).max() > _SUM_LIMIT:
                raise BundleError(f"A sum of layer {n} of {arch.title} could leave 32 bits: use fewer taps or filters.")
        if arch.step > 257:
            raise BundleError(
                f"A step of {arch.step} samples does not fit the toy, with its 16-bit sums of a step: at most 257."
            )

    def forward(self, x: ArrayLike) -> Ints:
        """Compute logits (N, K) in steps of 1/256 of raw integer windows (N, C, T).

        Only the last ``arch.span`` samples are used.

        Raises:
            BadInput: for windows of another shape, shorter than the span, or not of whole numbers.
        """
        x = _whole(x)
        check_windows(self.arch, x.shape)
        return np.concatenate([self._logits(x[at : at + 64]) for at in range(0, len(x), 64)] or [self._none()])

    def _logits(self, x: NDArray[Any]) -> Ints:
        return self.dense.apply(self.sums(x))

    def sums(self, x: NDArray[Any]) -> Floats:
        """Compute the inputs of the dense layer (N, features) of raw windows (N, C, T)."""
        z = self._first(x[:, :, x.shape[2] - self.arch.span :]).astype(np.float64)
        for layer, part in zip(self.arch.layers, self.layers, strict=True):
            taps = taps_of(padded(z, self.arch, layer.reach), layer)
            z = np.stack([part.apply(each.reshape(len(each), -1)) for each in taps])
        return np.asarray(z.sum(axis=1)) if self.arch.pooling == "mean" else self.pooled(step_sums(z, self.arch))

    def pooled(self, sums: Floats) -> Floats:
        """Return the inputs (N, features) of the dense layer from the sums (N, blocks, F) of each step."""
        total = np.asarray(sums.sum(axis=1))
        if self.arch.pooling == "mean":
            return total
        beyond = np.maximum(sums - (total // self.arch.blocks)[:, None], 0.0)
        return np.concatenate([total, 2.0 * beyond.sum(axis=1)], axis=1)

    def _first(self, x: NDArray[Any]) -> Bytes:
        """Return the inputs of the first convolution (N, T', C') of raw windows (N, C, T)."""
        x = x.transpose(0, 2, 1)
        if self.vectors is None:
            return self.inputs.apply(x)
        taps = taps_of(x.astype(np.float64), tap_layer(self.vectors.layer))
        return np.stack([self.inputs.apply(self.vectors.apply(each)) for each in taps])

    def _none(self) -> Ints:
        return np.empty((0, self.arch.classes), dtype=np.int64)

    def activations(self, x: ArrayLike) -> list[Bytes]:
        """Return the inputs of each layer and the output of the last, [(N, T', C')] uint8, of windows (N, C, T)."""
        outputs = [self._first(_whole(x))]
        for layer, part in zip(self.arch.layers, self.layers, strict=True):
            taps = taps_of(padded(outputs[-1].astype(np.float64), self.arch, layer.reach), layer)
            outputs.append(np.stack([part.apply(each.reshape(len(each), -1)) for each in taps]).astype(np.uint8))
        return outputs

    def stepper(self) -> IntegerStepper:
        """Create a stepper for one stream."""
        return IntegerStepper(self) if self.arch.padding == "stream" else IntegerWindowStepper(self)


def _whole(x: ArrayLike) -> NDArray[Any]:
    """Return raw values as an array; raise BadInput if they are not integers, as scaled ones are not."""
    values = np.asarray(x)
    if values.size and values.dtype.kind not in "iu":
        raise BadInput(
            f"A network in integers reads raw whole numbers, not {values.dtype}: give it the samples before scaling."
        )
    return values


class IntegerStepper(Stepper):
    """Computes the network on a stream of raw integers, sample by sample; logits are in steps of 1/256."""

    def __init__(self, network: IntegerNetwork) -> None:
        self.network, self._dense = network, network.dense
        super().__init__(network.arch)

    def patch(self, dense: IntegerDense | None) -> None:
        """Use another dense layer from the next decision on, like ``plush_patch``; None restores the network's own.

        Raises:
            BundleError: for a layer that does not fit the network.
        """
        self._dense = self.network.dense if dense is None else replace(self.network, dense=dense).dense

    def _clear(self) -> None:
        self._rings, self._pool = stream_state(self.arch.trunk, self.network.pooled)
        self._axes = axes_ring(self.arch)

    def _values(self, samples: ArrayLike) -> NDArray[Any]:
        return _whole(samples)

    def _advance(self, chunk: NDArray[Any]) -> Ints:
        vectors = self.network.vectors
        if self._axes is not None and vectors is not None:
            taps = self._axes.feed(chunk.astype(np.float64))
            chunk = vectors.apply(taps.reshape(len(taps), vectors.layer.kernel, self.arch.channels))
        z = self.network.inputs.apply(chunk).astype(np.float64)
        for ring, part in zip(self._rings, self.network.layers, strict=True):
            taps = ring.feed(z)
            if not len(taps):
                return self.network._none()
            z = part.apply(taps)
        return self._dense.apply(self._pool.feed(z))


class IntegerWindowStepper(IntegerStepper):
    """The same for the padding ``mirror``: each decision computes the whole window again."""

    def _clear(self) -> None:
        self._windows = WindowRing(self.arch)

    def _advance(self, chunk: NDArray[Any]) -> Ints:
        # 32-bit values are exact in the ring's float64.
        due = self._windows.feed(chunk.astype(np.float64)).astype(np.int64)
        return self._dense.apply(self.network.sums(due.transpose(0, 2, 1))) if len(due) else self.network._none()
