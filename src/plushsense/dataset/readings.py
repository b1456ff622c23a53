"""Measure what the sensors of a data set read: mean and spread of each channel, and gravity at rest."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.dataset.importing.proposals import find_sensors, length_at_rest
from plushsense.dataset.store import Dataset

_MOST = 2.0**33  # steps; values beyond it cannot come from 32-bit integers


@dataclass(frozen=True)
class GravityReading:
    """Gravity as one accelerometer reads it: zero and 1 g of its three axes.

    Attributes:
        axes: names of its three channels.
        zero: value of each axis that stands for zero, in integer steps.
        one_g: length of the values less their zero, in integer steps.
        is_estimated: whether the recordings do not determine it, as where the sensor was not turned: then it is the
            median of the stillest blocks, with the zero of the layout.
    """

    axes: tuple[str, ...]
    zero: tuple[float, ...]
    one_g: float
    is_estimated: bool


@dataclass(frozen=True)
class Readings:
    """Mean and standard deviation of the valid values of each channel (C,) in integer steps, and accelerometers.

    ``rest`` lacks accelerometers whose recordings show no gravity, as where it was subtracted.
    """

    mean: tuple[float, ...]
    spread: tuple[float, ...]
    rest: tuple[GravityReading, ...] = ()

    @classmethod
    def of(cls, dataset: Dataset, people: Iterable[str]) -> Readings:
        """Measure the recordings in use of some people."""
        dataset, layout = dataset.only_people(people), dataset.layout
        low, high = layout.valid_min_int, layout.valid_max_int
        n, total, squares = (np.zeros(layout.n_channels) for _ in range(3))
        origin = None
        for recording in dataset.used:
            values = dataset.read(recording).values
            valid = (values >= low) & (values <= high)
            # Small numbers, so that squares lose no digits.
            origin = values[0] if origin is None else origin
            moved = np.where(valid, values - origin, 0).astype(np.float64)
            n, total, squares = n + valid.sum(axis=0), total + moved.sum(axis=0), squares + (moved**2).sum(axis=0)
        mean = total / np.maximum(n, 1)
        spread = np.sqrt(np.maximum(squares / np.maximum(n, 1) - mean**2, 0.0))
        return cls(_rounded(mean + (0 if origin is None else origin)), _rounded(spread), tuple(_rest(dataset)))

    def problem(self, layout: Layout) -> str:
        """Return why these cannot be the readings of a layout, "" if they can."""
        c = layout.n_channels
        numbers = [*self.mean, *self.spread, *(v for rest in self.rest for v in (*rest.zero, rest.one_g))]
        if len(self.mean) != c or len(self.spread) != c or any(len(rest.zero) != 3 for rest in self.rest):
            return f"{len(self.mean)} means and {len(self.spread)} spreads, but the layout has {c} channels"
        if any(abs(v) > _MOST for v in numbers) or min((*self.spread, *(rest.one_g for rest in self.rest))) < 0.0:
            return "a number out of range"
        if not {rest.axes for rest in self.rest} <= set(layout.accelerometers):
            return "an accelerometer that the layout does not have"
        return ""


def _rest(dataset: Dataset) -> Iterable[GravityReading]:
    layout = dataset.layout
    sensors = find_sensors(dataset)
    for axes in (group for group in layout.accelerometers if len(group) == 3):
        # Without self-calibration, a model has one scale for all sensors: that of most sessions.
        found = sorted((s for s in sensors if s.axes == axes), key=lambda s: -len(s.sessions))
        at = [layout.index(name) for name in axes]
        if found:
            steps = [layout.channels[i].step for i in at]
            zero = [found[0].zero[name] / step for name, step in zip(axes, steps, strict=True)]
            yield GravityReading(axes, _rounded(zero), _rounded([found[0].radius / steps[0]])[0], len(found) > 1)
        elif length := length_at_rest(dataset, at):
            yield GravityReading(axes, _rounded(layout.zero_int[at]), _rounded([length])[0], True)


def _rounded(numbers: Iterable[float] | NDArray[Any]) -> tuple[float, ...]:
    """Return numbers with nine digits, which are the same on every machine."""
    return tuple(float(f"{n:.9g}") for n in numbers)
