"""The vector layer of `plushsense.models.arch.VectorLayer` in NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.models.arch import NORM_EPSILON, Arch, VectorLayer

Floats = NDArray[np.float64]

# Added to squares, so that gradients stay finite where nothing moves.
LENGTH_EPSILON = 1e-6
TURN_EPSILON = 1e-7


class VectorStage:
    """The vector layer of a network, with its weights in float64."""

    def __init__(self, layer: VectorLayer, arch: Arch, weights: Mapping[str, NDArray[Any]]) -> None:
        self.layer = layer
        self._others = arch.channels - layer.axes
        self.weight = weights["vector.weight"].astype(np.float64)
        self.mean = weights["vector.mean"].astype(np.float64)
        self.gain = 1.0 / np.sqrt(weights["vector.var"].astype(np.float64) + NORM_EPSILON)

    def invariants(self, taps: Floats) -> Floats:
        """Compute the outputs (..., M) before standardization from scaled inputs (..., kernel, C), oldest first."""
        newest = taps[..., -1, :]
        gravity = newest[..., -3:]
        up = gravity / np.sqrt((gravity**2).sum(axis=-1, keepdims=True) + LENGTH_EPSILON)
        parts = [newest[..., : self._others]]
        for number, weight in enumerate(self.weight):
            first = self._others + 3 * number
            parts += list(_invariants(weight @ taps[..., first : first + 3], up))
        return np.concatenate(parts, axis=-1)

    def __call__(self, taps: Floats) -> Floats:
        """Compute the outputs (..., M) from scaled inputs (..., kernel, C), oldest first."""
        return (self.invariants(taps) - self.mean) * self.gain


def _invariants(d: Floats, up: Floats) -> tuple[Floats, Floats, Floats]:
    """Return v, n and c (..., K) of the vectors ``d`` (..., K, 3) and the unit vector ``up`` (..., 3)."""
    up = up[..., None, :]
    vertical = (d * up).sum(axis=-1)
    h = d - vertical[..., None] * up
    length = np.sqrt((h**2).sum(axis=-1) + LENGTH_EPSILON)
    turn = (np.cross(h, np.roll(h, -1, axis=-2)) * up).sum(axis=-1)
    return vertical, length, turn * (turn**2 + TURN_EPSILON) ** -0.25
