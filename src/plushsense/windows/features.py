"""Compute the inputs of a network: derived channels and scaling; also statistics of windows.

Raw values are resampled (`plushsense.windows.clock`), then channels derived, both in integers, then scaled to floats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.layouts import (
    ACCELERATION,
    GRAVITY_FRACTION_BITS,
    GRAVITY_STATE_BITS,
    MAGNITUDE_FRACTION_BITS,
    Layout,
    magnitude_limit,
)
from plushsense.windows.self_calibration import UNIT


def magnitude(parts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return ⌊16 · √(Σ v²)⌋ over the last axis: the magnitude as an exact integer with 4 fraction bits.

    Args:
        parts: (..., n) integers, such that the sum of squares fits 64 bits and the result 32 bits.

    Raises:
        BadInput: if a component is larger than `magnitude_limit`.
    """
    limit = magnitude_limit(parts.shape[-1])
    if parts.size and int(np.abs(parts).max()) > limit:
        raise BadInput(f"A magnitude of values beyond ±{limit} does not fit 32 bits: narrow the channels' valid range.")
    total = (parts * parts).sum(axis=-1) << (2 * MAGNITUDE_FRACTION_BITS)
    root = np.floor(np.sqrt(total.astype(np.float64))).astype(np.int64)
    # The float root of a 64-bit number may be off by one in either direction.
    root -= root * root > total
    root += (root + 1) * (root + 1) <= total
    return np.asarray(root, dtype=np.int64)


class RunningMean:
    """The running mean of one channel, in integers: the component of gravity along one axis of an accelerometer.

    The state has `GRAVITY_STATE_BITS` fraction bits and changes by ``((x << bits) - state) >> shift`` with each sample;
    the shift is that of the layout, but at the first samples the binary logarithm of their number, rounded down, so
    that the mean is soon of the right size. A new segment starts it again. Turns of the toy are followed within about
    two time constants; shaking averages out; in free fall the mean shrinks but keeps its direction.
    """

    def __init__(self, shift: int) -> None:
        self._most = shift
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._samples, self._state = 0, 0

    def push(self, x: int) -> int:
        """Add a sample; return the mean with `GRAVITY_FRACTION_BITS` fraction bits, rounded down."""
        if self._samples < 1 << self._most:
            self._samples += 1
        self._state += ((x << GRAVITY_STATE_BITS) - self._state) >> (self._samples.bit_length() - 1)
        return self._state >> (GRAVITY_STATE_BITS - GRAVITY_FRACTION_BITS)

    def push_all(self, x: NDArray[np.int64]) -> NDArray[np.int64]:
        """Add samples (T,); return the mean after each, as `push` does, but several times faster."""
        begin = min(len(x), (1 << self._most) - self._samples)
        means = np.array([self.push(value) for value in x[:begin].tolist()], dtype=np.int64)
        # From here on the shift is constant.
        shift = self._most
        rest = (x[begin:] << GRAVITY_STATE_BITS).tolist()
        states = accumulate(rest, lambda state, high: state + ((high - state) >> shift), initial=self._state)
        later = np.fromiter(states, np.int64, len(rest) + 1)
        self._state = int(later[-1])
        return np.concatenate([means, later[1:] >> (GRAVITY_STATE_BITS - GRAVITY_FRACTION_BITS)])


def network_inputs(values: NDArray[np.int64], layout: Layout) -> NDArray[np.int64]:
    """Return the unscaled inputs of a network (T, F) from the measured channels (T, C) of a whole segment, in integers.

    The offset of each channel is subtracted first.
    """
    derived = {d.name: d for d in layout.derived}
    values = values - layout.zero_int
    columns = []
    for name in layout.inputs:
        if name not in derived:
            columns.append(values[:, layout.index(name)])
            continue
        parts = values[:, [layout.index(part) for part in derived[name].of]]
        if derived[name].kind == "gravity":
            columns.append(RunningMean(layout.gravity_shift).push_all(parts[:, 0]))
        else:
            columns.append(magnitude(parts))
    return np.stack(columns, axis=1)


_FRACTIONS = {"magnitude": 1 << MAGNITUDE_FRACTION_BITS, "gravity": 1 << GRAVITY_FRACTION_BITS}


class InputUnits(NamedTuple):
    """The inputs of a network as values: the whole numbers of `network_inputs` are ``value * steps - zero``.

    The value of a measured channel is that which the toy sends, that of a derived channel the one computed from such
    values less their offsets. Self-calibrated channels are in units of 1 g, or of their spread. The value of a channel
    derived from channels of different steps is in steps.

    Attributes:
        steps: integer steps in a unit, (F,).
        zero: offset in integer steps, (F,).
        names: name of the unit of each input.
    """

    steps: NDArray[np.float64]
    zero: NDArray[np.float64]
    names: tuple[str, ...]

    @classmethod
    def of(cls, layout: Layout) -> InputUnits:
        """Return the units of a layout's inputs."""
        derived = {d.name: d for d in layout.derived}
        steps, zeros, names = [], [], []
        for name in layout.inputs:
            parts = [layout.index(part) for part in (derived[name].of if name in derived else (name,))]
            units = {_unit_of(layout, part, name in derived) for part in parts}
            step, unit = units.pop() if len(units) == 1 else (1.0, "steps")
            steps.append(step * _FRACTIONS[derived[name].kind] if name in derived else step)
            zeros.append(0 if name in (*derived, *layout.self_calibration) else int(layout.zero_int[parts[0]]))
            names.append(unit)
        return cls(np.array(steps), np.array(zeros, dtype=np.float64), tuple(names))

    def values(self, x: NDArray[np.integer[Any]]) -> NDArray[np.floating[Any]]:
        """Return the values of integer windows (..., F, T).

        They are float32, or float64 where float32 would not tell all steps apart: beyond 2²³ steps.
        """
        peak = max(-int(x.min(initial=0)), int(x.max(initial=0))) + int(np.abs(self.zero).max(initial=0.0))
        out = np.empty(x.shape, dtype=np.float32 if peak <= 1 << 23 else np.float64)
        for at in range(len(self.steps)):
            out[..., at, :] = (x[..., at, :] + self.zero[at]) / self.steps[at]
        return out

    def counted(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Return values (..., F, T) as numbers of steps, the inverse of `values`; they are not rounded."""
        return np.asarray(values * self.steps[:, None] - self.zero[:, None], dtype=np.float64)

    def only(self, at: Sequence[int]) -> InputUnits:
        """Return the units of the inputs at some places."""
        return InputUnits(self.steps[list(at)], self.zero[list(at)], tuple(self.names[i] for i in at))

    def scaler(self, integers: Scaler) -> Scaler:
        """Return the scaling of values that equals the given one of integers."""
        return Scaler((integers.offset + self.zero) / self.steps, integers.scale * self.steps)


def _unit_of(layout: Layout, at: int, is_centred: bool) -> tuple[float, str]:
    """Return the steps in a unit of a measured channel, and the name of the unit."""
    channel = layout.channels[at]
    if channel.name in layout.self_calibration:
        return float(UNIT), "g" if channel.kind == ACCELERATION else "spread"
    if channel.scale == 1.0:
        return 1.0 / channel.step, channel.unit
    value = "value" if is_centred or not channel.offset else f"(value - {channel.offset:g})"
    return 1.0 / channel.step, f"raw: {value} * {channel.scale:g} is in {channel.unit}"


class SampleInputs:
    """The computation of `network_inputs` for single samples, in plain integers, which is faster for a live stream."""

    def __init__(self, layout: Layout) -> None:
        derived = {d.name: d for d in layout.derived}
        self._zeros = layout.zero_int.tolist()
        self._means = {n: RunningMean(layout.gravity_shift) for n, d in derived.items() if d.kind == "gravity"}
        self._sources = [
            (tuple(map(layout.index, derived[n].of)) if n in derived else layout.index(n), self._means.get(n))
            for n in layout.inputs
        ]

    def reset(self) -> None:
        """Start again, as at a new segment."""
        for mean in self._means.values():
            mean.reset()

    def __call__(self, sample: Sequence[int] | NDArray[np.int64]) -> list[int]:
        """Return the F inputs of one sample (C,)."""
        values = [int(v) - zero for v, zero in zip(sample, self._zeros, strict=True)]
        shift = 2 * MAGNITUDE_FRACTION_BITS
        return [
            values[part]
            if isinstance(part, int)
            else mean.push(values[part[0]])
            if mean is not None
            else math.isqrt(sum([values[i] ** 2 for i in part]) << shift)
            for part, mean in self._sources
        ]


_TOGETHER = 32  # windows scaled at once: few enough for their float64 to stay in the cache


@dataclass(frozen=True)
class Scaler:
    """Scaling of each channel, ``(value - offset) * scale``; both are (F,) float64."""

    offset: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def fit(cls, x: NDArray[np.integer[Any]], vectors: Sequence[Sequence[int]] = ()) -> Scaler:
        """Fit zero mean and unit variance to training windows (N, F, T); a constant channel gets the scale 1.

        The axes of each of the ``vectors`` keep their zero, and have one common scale: unit mean square.
        """
        mean = np.asarray(np.mean(x, axis=(0, 2), dtype=np.float64))
        spread = np.empty_like(mean)
        for channel in range(x.shape[1]):
            spread[channel] = np.std(x[:, channel, :], dtype=np.float64)
        for axes in map(list, vectors):
            spread[axes] = np.sqrt(np.mean(spread[axes] ** 2 + mean[axes] ** 2))
            mean[axes] = 0.0
        return cls(mean, np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0), 1.0))

    @classmethod
    def none(cls, units: InputUnits, vectors: Sequence[Sequence[int]] = ()) -> Scaler:
        """Return the scaling with which a network reads the values of `InputUnits`; ``vectors`` as for `fit`."""
        offset, scale = 0.0 - units.zero, 1.0 / units.steps
        for axes in map(list, vectors):
            offset[axes], scale[axes] = 0.0, scale[axes[0]]
        return cls(offset, scale)

    def knows_training(self, layout: Layout) -> bool:
        """Return whether it was fitted to windows, unlike `none` and what earlier versions had in its place."""
        units = InputUnits.of(layout)
        plain_offset = ((self.offset == 0.0) | (self.offset == -units.zero)).all()
        plain_scale = any(np.array_equal(self.scale, one) for one in (1.0 / units.steps, np.ones(len(units.steps))))
        return not (plain_offset and plain_scale)

    def apply(self, x: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Scale windows (N, F, T) for the network."""
        scaled = np.empty(x.shape, dtype=np.float32)
        for at in range(0, len(x), _TOGETHER):
            scaled[at : at + _TOGETHER] = (x[at : at + _TOGETHER] - self.offset[:, None]) * self.scale[:, None]
        return scaled

    def apply_sample(self, sample: Sequence[int] | NDArray[np.int64]) -> NDArray[np.float32]:
        """Scale samples (..., F) for the network."""
        scaled = (np.asarray(sample, dtype=np.float64) - self.offset) * self.scale
        return scaled.astype(np.float32)

    def to_dict(self) -> dict[str, list[float]]:
        """Return plain values, ready for JSON."""
        return {"offset": self.offset.tolist(), "scale": self.scale.tolist()}

    @classmethod
    def from_dict(cls, table: dict[str, list[float]]) -> Scaler:
        """Create a scaler from plain values."""
        return cls(np.array(table["offset"], dtype=np.float64), np.array(table["scale"], dtype=np.float64))


BANDS_HZ = ((0.0, 1.0), (1.0, 3.0))
QUARTERS = 4
NAMES = ("mean", "sd", "min", "max", "rms", "energy", *(f"power {low:g}-{high:g} Hz" for low, high in BANDS_HZ))


def statistics(x: NDArray[np.integer[Any]] | NDArray[np.floating[Any]], rate_hz: float) -> NDArray[np.float64]:
    """Return the statistics ``NAMES`` (N, 8 C) of windows (N, C, T) of even samples.

    The first C columns are the means of all channels, the next C the standard deviations, and so on.

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
        # The bin at half the sampling rate has no counterpart at negative frequencies.
        power[:, :, -1] *= 0.5
    frequency = np.fft.rfftfreq(samples, 1.0 / rate_hz)
    bands = [power[:, :, (frequency >= low) & (frequency < high)].sum(axis=2) for low, high in BANDS_HZ]
    energy = (values**2).sum(axis=2)
    rms = np.sqrt(energy / samples)
    spread, low, high = values.std(axis=2), values.min(axis=2), values.max(axis=2)
    return np.concatenate([mean, spread, low, high, rms, energy, *bands], axis=1)


def statistics_in_order(x: NDArray[np.integer[Any]] | NDArray[np.floating[Any]], rate_hz: float) -> NDArray[np.float64]:
    """Return `statistics` of windows (N, C, T) and of each quarter of them, (N, 32 C): the quarters know the order.

    Quarters, of which windows of fewer than 4 samples have one a sample, have no band powers: they are too short.

    Raises:
        BadInput: for windows without samples.
    """
    whole = statistics(x, rate_hz)
    quarters = np.array_split(x, min(QUARTERS, x.shape[2]), axis=2)
    kept = (len(NAMES) - len(BANDS_HZ)) * x.shape[1]
    return np.concatenate([whole, *(statistics(quarter, rate_hz)[:, :kept] for quarter in quarters)], axis=1)
