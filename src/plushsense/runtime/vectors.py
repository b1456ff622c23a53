"""The vector layer of a deployed network, in 32-bit integers.

This module is the specification that ``deploy/c/plushsense.c`` implements; `plushsense.models.arch.VectorLayer`
explains the outputs. ``>>`` is a floor division, √ is rounded down.

1. Axes: a = x · 2^shift (``>>`` where the shift is negative), after x was clamped so that a is within ±32767.
2. Gravity: shifted, without its sign, until its largest component is in 2^14 … 2^15 − 1; then
   u = ±((|g| << 14) / √(Σ g²)), rounded down; u = 0 if g = 0.
3. Kernels: d = Σ w a over the taps, then ``>> down``, which makes |d| ≤ 2^14.
4. v = (u · d) >> 14; h = d − ((v u) >> 14); n = √(h · h); with h' of the next kernel and t = u · (h × h'), of which
   each term is ``>> 14``: c = ±√|t|.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.models.arch import VectorLayer
from plushsense.models.reference import Floats
from plushsense.runtime.fixed import Ints

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
