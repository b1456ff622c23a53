"""One recording or stream under examination: its rows, and what several checks want to know of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.quality.finding import Limits

NEVER_STOPPED_FACTOR = 10.0
SLOW_FACTOR = 2.5
# A clock that stamps frames when they arrive, several at once, gives many of them nearly the same time.
_BURSTS = 0.05


@dataclass(frozen=True)
class Examined:
    """What a check looks at. ``rows_named`` is the count in the file's name, None where it says none;
    ``usual_rows`` the median over the recordings of the gesture.

    ``first_row``: where ``frames`` begin in their file, when something was trimmed. ``malformed`` lines were left out
    of the file; ``cut``: its last line had no end. ``stream``: these are a whole session's.
    """

    frames: Frames
    layout: Layout
    rows_named: int | None
    usual_rows: float | None
    limits: Limits = field(default_factory=Limits)
    first_row: int = 0
    rows_in_file: int | None = None
    malformed: int = 0
    cut: bool = False
    stream: bool = False

    @cached_property
    def steps(self) -> NDArray[np.int64]:
        """Device time from each row to the next in ms, (T − 1,)."""
        return np.diff(self.frames.device_ms)

    @cached_property
    def period_ms(self) -> float:
        """Median time between frames by the device clock; 0 for fewer than two."""
        forward = self.steps[self.steps > 0]
        return float(np.median(forward)) if len(forward) else 0.0

    @cached_property
    def in_bursts(self) -> bool:
        """Whether frames are stamped several at once, so that a single step says little."""
        return len(self.steps) >= 10 and float(np.mean(np.abs(self.steps) < 0.25 * self.period_ms)) > _BURSTS

    @cached_property
    def spread_ms(self) -> tuple[float, float]:
        """The 5th and 95th percentile of the time between frames; lost frames, gaps and resets apart."""
        even = self.steps[(self.steps >= 0) & (self.steps < 1.75 * self.period_ms)]
        low, high = np.percentile(even, (5, 95)) if len(even) else (0.0, 0.0)
        return float(low), float(high)

    @property
    def jitters(self) -> bool:
        """Whether the time between frames varies beyond the limit."""
        low, high = self.spread_ms
        return len(self.steps) >= 20 and (high - low) / 2 > self.limits.jitter * self.period_ms > 0

    @property
    def uneven(self) -> bool:
        """Whether a single step says little, so that only what does not catch up is missing."""
        return self.in_bursts or self.jitters

    @property
    def gap_ms(self) -> float:
        """The step from which on it is a gap: slow toys have longer ones."""
        return max(self.limits.gap_ms, SLOW_FACTOR * self.period_ms)

    @cached_property
    def jumps(self) -> NDArray[np.int64]:
        """Rows after which the device clock leaps ahead by seconds although hardly any time passed on the computer."""
        host = self.frames.host_ms
        far = np.flatnonzero(self.steps > 5000)
        if host is None or not len(far):
            return np.empty(0, dtype=np.int64)
        # What waited in a buffer arrives late and all at once: look at the time around.
        before, after = host[np.maximum(far - 20, 0)], host[np.minimum(far + 21, len(host) - 1)]
        return far[(after - before) < 0.5 * self.steps[far]]

    @cached_property
    def gaps(self) -> NDArray[np.int64]:
        """Rows after which frames are missing for longer than `gap_ms`."""
        found = np.setdiff1d(np.flatnonzero(self.steps > self.gap_ms), self.jumps)
        if not self.uneven or not len(found):
            return found
        # Uneven stamps: a wait after which the frames catch up is none. Where the rows around took as long as
        # their number says, nothing is missing.
        rate = measured_rate_hz(self.frames)
        time, reach = self.frames.device_ms, 15
        low, high = np.maximum(found - reach, 0), np.minimum(found + 1 + reach, len(time) - 1)
        late = (time[high] - time[low]) - (high - low) * 1000.0 / rate
        return found[late > self.gap_ms]

    def row(self, at: int) -> int:
        """The number of a row in its file, from 1."""
        return int(at) + self.first_row + 1


def usual_rows(recordings: Iterable[tuple[str, int]]) -> dict[str, float]:
    """The median number of rows of each gesture, from pairs of gesture and rows."""
    rows: dict[str, list[int]] = {}
    for gesture, n in recordings:
        rows.setdefault(gesture, []).append(n)
    return {gesture: float(np.median(ns)) for gesture, ns in rows.items()}


def measured_rate_hz(frames: Frames) -> float:
    """Frames a second by the device clock, over the stretches without gaps or resets; 0 for fewer than two frames."""
    steps = np.diff(frames.device_ms)
    even = steps[(steps >= 0) & (steps <= 1000)]
    passed = float(even.sum())
    return 1000.0 * len(even) / passed if passed > 0 else 0.0


def seconds_of(frames: Frames) -> float:
    """How long a recording is by the device clock; where it was reset or leapt, one period each."""
    steps = np.diff(frames.device_ms)
    good = (steps >= 0) & (steps <= 5000)
    period = float(np.median(steps[good])) if good.any() else 0.0
    return (float(steps[good].sum()) + period * int((~good).sum())) / 1000.0
