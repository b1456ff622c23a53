"""What a network reads: derived channels in integers, and the scaling to floats.

The order is fixed: raw integers → even samples → derived channels, all in integers → per-channel offset and scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.signal import MAGNITUDE_FRACTION_BITS, Layout, magnitude_limit


def magnitude(parts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Floor of 16 · √(Σ v²), the magnitude with 4 fraction bits, exact in integers.

    Args:
        parts: (..., n) integers; the sum of squares is held in 64 bits, the result in 32.

    Raises:
        BadInput: for a component beyond `magnitude_limit`.
    """
    limit = magnitude_limit(parts.shape[-1])
    if parts.size and int(np.abs(parts).max()) > limit:
        raise BadInput(f"A magnitude of values beyond ±{limit} does not fit 32 bits: narrow the channels' valid range.")
    total = (parts * parts).sum(axis=-1) << (2 * MAGNITUDE_FRACTION_BITS)
    root = np.floor(np.sqrt(total.astype(np.float64))).astype(np.int64)
    # The float root of a 64-bit number may be off by one either way.
    root -= root * root > total
    root += (root + 1) * (root + 1) <= total
    return np.asarray(root, dtype=np.int64)


def inputs(values: NDArray[np.int64], layout: Layout) -> NDArray[np.int64]:
    """The network's channels from measured ones: (T, C) → (T, F), integers."""
    derived = {d.name: d for d in layout.derived}
    columns = []
    for name in layout.inputs:
        if name in derived:
            columns.append(magnitude(values[:, [layout.index(part) for part in derived[name].of]]))
        else:
            columns.append(values[:, layout.index(name)])
    return np.stack(columns, axis=1)


class SampleInputs:
    """The same for one sample at a time, in plain integers: a live stream cannot afford array set-up a sample."""

    def __init__(self, layout: Layout) -> None:
        derived = {d.name: tuple(layout.index(part) for part in d.of) for d in layout.derived}
        self._plan = [derived.get(n) or layout.index(n) for n in layout.inputs]

    def __call__(self, sample: Sequence[int] | NDArray[np.int64]) -> list[int]:
        """The F inputs of one sample (C,)."""
        values = sample if type(sample) is list else [int(v) for v in sample]
        shift = 2 * MAGNITUDE_FRACTION_BITS
        return [
            values[part] if isinstance(part, int) else math.isqrt(sum([values[i] ** 2 for i in part]) << shift)
            for part in self._plan
        ]


@dataclass(frozen=True)
class Scaler:
    """``(value - offset) * scale`` a channel; both (F,) float64."""

    offset: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def fit(cls, x: NDArray[np.integer[Any]]) -> Scaler:
        """The z-score of windows (N, F, T), from training people only; a constant channel is only shifted."""
        mean = np.asarray(np.mean(x, axis=(0, 2), dtype=np.float64))
        spread = np.empty_like(mean)
        for channel in range(x.shape[1]):
            spread[channel] = np.std(x[:, channel, :], dtype=np.float64)
        return cls(mean, np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0), 1.0))

    def apply(self, x: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Windows (N, F, T) as a network reads them."""
        scaled = (x - self.offset[:, None]) * self.scale[:, None]
        return scaled.astype(np.float32)

    def apply_sample(self, sample: Sequence[int] | NDArray[np.int64]) -> NDArray[np.float32]:
        """One sample (F,) as a network reads it."""
        scaled = (np.asarray(sample, dtype=np.float64) - self.offset) * self.scale
        return scaled.astype(np.float32)

    def to_dict(self) -> dict[str, list[float]]:
        """Plain values, ready for JSON."""
        return {"offset": self.offset.tolist(), "scale": self.scale.tolist()}

    @classmethod
    def from_dict(cls, table: dict[str, list[float]]) -> Scaler:
        """A scaler from plain values."""
        return cls(np.array(table["offset"], dtype=np.float64), np.array(table["scale"], dtype=np.float64))
