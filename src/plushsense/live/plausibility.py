"""Compare the frames of a toy with those that a model was trained on, and report what differs, each thing once.

A model reads any numbers that come in its channels. In another unit, from a sensor with another measuring range or at
another rate, they are other movements, and its answers are wrong. Nothing here changes what the model computes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import GRAVITY_FRACTION_BITS, MAGNITUDE_FRACTION_BITS, Layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Frame
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec

BLOCK_S = 1.0
_BLOCKS = 3
"""Blocks that must agree: those at rest, those in sequence in which a channel is out of range, those of the rate."""
_STILL = 0.1
"""Spread of the axes over a block, relative to the length of their mean, up to which the toy rests."""
_OTHER_GRAVITY, _GRAVITY_SUBTRACTED = 1.5, 0.02
# Where gravity of the training is not certain: no training moves so much, and rest without gravity reads less.
_UNCERTAIN = (0.05, 0.25, 2.0)
_OTHER_RATE = 1.25
_SLOW = 0.3
"""Share of the mean square of an acceleration from which its running mean is gravity; 0.43 for energetic gestures."""
_CERTAIN = 3.0
"""How many standard deviations an acceleration of the training must be from 0 to show gravity."""
_UNITS = ((1 / 9.81, "g, not m/s²"), (9.81, "m/s², not g"), (1000.0, "thousandths of the unit"), (0.001, "thousands"))


def gravity_in_training(bundle: Bundle, axes: Sequence[int]) -> tuple[float, bool] | None:
    """Return the length of gravity in the training data, in steps, for the channels ``axes`` of an accelerometer.

    It is that of the bundle's readings, else it follows from the scaling of the inputs: of the gravity itself, else of
    the magnitude, else of the axes.

    Returns:
        The length, and whether it is certain; else it is the root mean square of all accelerations, movement included.
        None if the network reads none of them, or its training data show no gravity, as where it was subtracted.
    """
    layout, scaler = bundle.layout, bundle.scaler
    names = [layout.names[axis] for axis in axes]
    for rest in bundle.readings.rest if bundle.readings else ():
        if rest.axes == tuple(names) and not rest.is_estimated:
            return rest.one_g, True
    derived = {d.of: layout.inputs.index(d.name) for d in layout.derived if d.name in layout.inputs}
    mean, spread = np.asarray(scaler.offset), 1.0 / np.asarray(scaler.scale)
    if not scaler.knows_training(layout):
        return None
    squares = mean**2 + spread**2
    magnitude = next((at for of, at in derived.items() if len(of) > 1 and set(of) == set(names)), None)
    if magnitude is not None:
        if mean[magnitude] <= 0.0:  # not the scaling of lengths, but that of a test
            return None
        length = math.sqrt(squares[magnitude]) / float(1 << MAGNITUDE_FRACTION_BITS)
        return length, bool(mean[magnitude] >= _CERTAIN * spread[magnitude])
    if not set(names) <= set(layout.inputs):
        return None
    square = float(squares[[layout.inputs.index(name) for name in names]].sum())
    if not all((name,) in derived for name in names):
        return math.sqrt(square), False
    held = float(squares[[derived[(name,)] for name in names]].sum()) / 4.0**GRAVITY_FRACTION_BITS
    return (math.sqrt(held), True) if held >= _SLOW * square else None


def ranges_in_training(bundle: Bundle) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest usual value of each channel in steps, (C,) each; infinite if not known.

    They are those of the sensor health, which training fits, else those of the 8-bit inputs.
    """
    layout = bundle.layout
    health = DecideSpec.from_dict(bundle.decision).health
    if health.low:
        return np.array(health.low, dtype=np.float64), np.array(health.high, dtype=np.float64)
    low, high = np.full(layout.n_channels, -np.inf), np.full(layout.n_channels, np.inf)
    edges = [np.asarray(bundle.calibration.get(key, ()), dtype=np.float64) for key in ("low", "high")]
    if any(edge.shape != (layout.n_inputs,) for edge in edges) or bundle.arch.vector is not None:
        return low, high
    first, last = (edge / bundle.scaler.scale + bundle.scaler.offset for edge in edges)
    for at, name in enumerate(layout.names):
        if name in layout.inputs:
            place = layout.inputs.index(name)
            margin, zero = 0.1 * (last[place] - first[place]), layout.zero_int[at]
            low[at], high[at] = first[place] - margin + zero, last[place] + margin + zero
    return low, high


class PlausibilityMonitor:
    """Compares gravity at rest, the range of each channel and the rate with the training, in blocks of a second.

    Args:
        layout: that of the frames, with the model's rate.
        bundle: the model; None: only the rate and the clock are checked.
    """

    def __init__(self, layout: Layout, bundle: Bundle | None) -> None:
        self._layout = layout
        self._size = max(10, layout.samples(BLOCK_S))
        self._frames: list[Frame] = []
        self._clock: list[float] | None = []
        calibrated = {at for sensor in layout.calibrated_sensors for at in sensor}
        self._rest: list[tuple[list[int], float, bool, list[float]]] = []
        self._low, self._high = np.full(layout.n_channels, -np.inf), np.full(layout.n_channels, np.inf)
        if bundle is not None:
            low, high = ranges_in_training(bundle)
            for names in layout.accelerometers:
                axes = [layout.index(name) for name in names]
                # What an axis reads depends on how the toy is held: as much as any of them, in either direction.
                zero = layout.zero_int[axes]
                reach = np.maximum(high[axes] - zero, zero - low[axes]).max()
                low[axes], high[axes] = zero - reach, zero + reach
                expected = gravity_in_training(bundle, axes)
                if expected is not None and not calibrated & set(axes):
                    self._rest.append((axes, *expected, []))
                    calibrated |= set(axes) if expected[1] else set()
            free = [at for at in range(layout.n_channels) if at not in calibrated]
            # A sensor may stay at its end stop, which is one step beyond the limits.
            self._low[free], self._high[free] = low[free] - 1.0, high[free] + 1.0
        self._outside = np.zeros(layout.n_channels, dtype=np.int64)

    def push(self, frames: Iterable[Frame]) -> list[Message]:
        """Add frames; return what differs from the training and was not reported before, usually nothing."""
        self._frames += frames
        found: list[Message] = []
        while len(self._frames) >= self._size:
            block, self._frames = self._frames[: self._size], self._frames[self._size :]
            values = np.array([frame.values for frame in block], dtype=np.float64)
            found += [*self._check_rate(block), *self._check_rest(values), *self._check_range(values)]
        return found

    def _check_rate(self, block: list[Frame]) -> Iterator[Message]:
        if self._clock is None:
            return
        steps = np.diff([frame.device_ms for frame in block])
        forward = steps[steps >= 0]
        # Where frames are stamped several at once, most steps are 0.
        usual = float(np.median(forward)) if len(forward) else 0.0
        self._clock.append(usual or float(forward.mean() if len(forward) else 0.0))
        if len(self._clock) < _BLOCKS:
            return
        period_ms, nominal, self._clock = float(np.median(self._clock)), self._layout.rate_hz, None
        if period_ms <= 0.0:
            yield Message("The toy's clock stands still, so nothing can be recognised: check device_ms.")
            return
        rate = 1000.0 / period_ms
        # Whole milliseconds are not exact at high rates.
        slack = 0.5 / period_ms if period_ms < 10.0 else 0.0
        if not 1.0 / (_OTHER_RATE + slack) <= rate / nominal <= _OTHER_RATE + slack:
            yield Message(
                "The toy sends {rate_2:.3g} frames a second by its clock, but the model reads {nominal:g}: it may "
                "not recognise the gestures; check the rate, and that device_ms counts milliseconds.",
                rate_2=rate,
                nominal=nominal,
                rate=float(f"{rate:.3g}"),
            )

    def _check_rest(self, values: NDArray[np.float64]) -> Iterator[Message]:
        for one in list(self._rest):
            axes, expected, certain, lengths = one
            x = values[:, axes] - self._layout.zero_int[axes]
            length = float(np.linalg.norm(x.mean(axis=0)))
            if math.sqrt(float(x.var(axis=0).sum())) > _STILL * max(length, expected / 2.0):
                continue
            lengths.append(length)
            if len(lengths) < _BLOCKS:
                continue
            self._rest.remove(one)
            found = float(np.median(lengths))
            ratio, (least, little, much) = found / expected, _UNCERTAIN
            if certain and 1.0 / _OTHER_GRAVITY < ratio < _OTHER_GRAVITY:
                continue
            if certain or least < ratio < little or ratio > much:
                yield self._other_gravity(axes, found, expected)

    def _other_gravity(self, axes: list[int], found: float, expected: float) -> Message:
        channel = self._layout.channels[axes[0]]
        reads, read = (_value(channel.in_units(steps)) for steps in (found, expected))
        ratio = found / expected
        unit = next((name for factor, name in _UNITS if 0.8 < ratio / factor < 1.25), "")
        why = f"it seems to send {unit}" if unit else "its unit or measuring range is another"
        if ratio < _GRAVITY_SUBTRACTED:
            why = "gravity seems to be subtracted, or the sensor is dead"
        names = [self._layout.names[axis] for axis in axes]
        return Message(
            "At rest the accelerometer ({channels}) reads {reads}, but in the training it read {read}: {why}. The "
            "gestures will not be recognised: let the toy send what the toys of the training sent.",
            channels=names,
            reads=reads,
            read=read,
            why=why,
        )

    def _check_range(self, values: NDArray[np.float64]) -> Iterator[Message]:
        beyond = (values.max(axis=0) < self._low) | (values.min(axis=0) > self._high)
        self._outside = np.where(beyond, self._outside + 1, 0)
        at = np.flatnonzero(self._outside >= _BLOCKS).tolist()
        if not at:
            return
        parts = [self._range_of(channel, values[:, channel]) for channel in at]
        self._low[at], self._high[at] = -np.inf, np.inf
        self._outside[at] = 0
        yield Message(
            "For {s:g} s {parts}: is it the same sensor, in the same unit and with the same settings? The gestures "
            "may not be recognised.",
            s=_BLOCKS * BLOCK_S,
            parts="; ".join(parts),
            channels=[self._layout.names[channel] for channel in at],
        )

    def _range_of(self, at: int, values: NDArray[np.float64]) -> str:
        channel = self._layout.channels[at]
        low, high = (channel.in_units(steps)[0] for steps in (values.min(), values.max()))
        first, last = (channel.in_units(steps)[0] for steps in (self._low[at] + 1.0, self._high[at] - 1.0))
        unit = channel.in_units(0.0)[1]
        usual = f"{_number(first)} to {_number(last)}{unit} of the training"
        return f"{channel.name} reads {_number(low)} to {_number(high)}{unit}, outside {usual}"


def _value(value: tuple[float, str]) -> str:
    return _number(value[0]) + value[1]


def _number(value: float) -> str:
    """Return a number with four digits; a large one is whole, without a power of ten."""
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
