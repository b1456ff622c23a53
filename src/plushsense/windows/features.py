"""Compute the inputs of a network: derived channels in integers, scaling to floats, and statistics of windows.

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
from plushsense.core.layouts import MAGNITUDE_FRACTION_BITS, Layout, magnitude_limit


def magnitude(parts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return floor of 16 · √(Σ v²), the magnitude with 4 fraction bits, exact in integers.

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


def network_inputs(values: NDArray[np.int64], layout: Layout) -> NDArray[np.int64]:
    """Return the network's channels (T, F) from measured ones (T, C), in integers."""
    derived = {d.name: d for d in layout.derived}
    columns = []
    for name in layout.inputs:
        if name in derived:
            columns.append(magnitude(values[:, [layout.index(part) for part in derived[name].of]]))
        else:
            columns.append(values[:, layout.index(name)])
    return np.stack(columns, axis=1)


class SampleInputs:
    """Computes `network_inputs` of one sample at a time, in plain integers: faster for a live stream."""

    def __init__(self, layout: Layout) -> None:
        derived = {d.name: tuple(layout.index(part) for part in d.of) for d in layout.derived}
        self._plan = [derived.get(n) or layout.index(n) for n in layout.inputs]

    def __call__(self, sample: Sequence[int] | NDArray[np.int64]) -> list[int]:
        """Return the F inputs of one sample (C,)."""
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
        """Fit the z-score to windows (N, F, T) of training people; a constant channel is only shifted."""
        mean = np.asarray(np.mean(x, axis=(0, 2), dtype=np.float64))
        spread = np.empty_like(mean)
        for channel in range(x.shape[1]):
            spread[channel] = np.std(x[:, channel, :], dtype=np.float64)
        return cls(mean, np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0), 1.0))

    def apply(self, x: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Return windows (N, F, T) scaled, as a network reads them."""
        scaled = (x - self.offset[:, None]) * self.scale[:, None]
        return scaled.astype(np.float32)

    def apply_sample(self, sample: Sequence[int] | NDArray[np.int64]) -> NDArray[np.float32]:
        """Return samples (..., F) scaled, as a network reads them."""
        scaled = (np.asarray(sample, dtype=np.float64) - self.offset) * self.scale
        return scaled.astype(np.float32)

    def to_dict(self) -> dict[str, list[float]]:
        """Return plain values, ready for JSON."""
        return {"offset": self.offset.tolist(), "scale": self.scale.tolist()}

    @classmethod
    def from_dict(cls, table: dict[str, list[float]]) -> Scaler:
        """Return a scaler from plain values."""
        return cls(np.array(table["offset"], dtype=np.float64), np.array(table["scale"], dtype=np.float64))


BANDS_HZ = ((0.0, 1.0), (1.0, 3.0))
NAMES = ("mean", "sd", "min", "max", "rms", "energy", *(f"power {low:g}-{high:g} Hz" for low, high in BANDS_HZ))


def statistics(x: NDArray[np.integer[Any]] | NDArray[np.floating[Any]], rate_hz: float) -> NDArray[np.float64]:
    """Return the statistics (N, 8 C) of windows (N, C, T) at even samples.

    All channels' means first, then all their sd …

    Raises:
        BadInput: for windows without samples.
    """
    if x.ndim != 3 or x.shape[2] == 0:
        raise BadInput(f"Statistics are taken of windows (windows, channels, samples); these have the shape {x.shape}.")
    values = x.astype(np.float64)
    samples = values.shape[2]
    mean = values.mean(axis=2)
    power = np.abs(np.fft.rfft(values - mean[:, :, None], axis=2)) ** 2 * (2.0 / samples**2)
    if samples % 2 == 0:
        # Half the sampling rate has no twin at negative frequencies.
        power[:, :, -1] *= 0.5
    frequency = np.fft.rfftfreq(samples, 1.0 / rate_hz)
    bands = [power[:, :, (frequency >= low) & (frequency < high)].sum(axis=2) for low, high in BANDS_HZ]
    energy = (values**2).sum(axis=2)
    rms = np.sqrt(energy / samples)
    spread, low, high = values.std(axis=2), values.min(axis=2), values.max(axis=2)
    return np.concatenate([mean, spread, low, high, rms, energy, *bands], axis=1)


def statistic_names(channels: Sequence[str]) -> tuple[str, ...]:
    """Return the name of each column of `statistics`: "x mean", "y mean", …."""
    return tuple(f"{channel} {name}" for name in NAMES for channel in channels)
