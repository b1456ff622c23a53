"""Measurements of a recording for the checks, and the summary by which recordings are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.quality.findings import CheckLimits
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo
from plushsense.recording.takes import measured_rate_hz

NEVER_STOPPED_FACTOR = 10.0
SLOW_FACTOR = 2.5
# Share of nearly equal stamps from which on frames count as stamped several at once, on arrival.
_BURSTS = 0.05


@dataclass(frozen=True)
class Examination:
    """Rows of a recording or stream under examination.

    ``rows_named`` is the count in the file's name (None if there is none), ``usual_rows`` the median over the
    recordings of the gesture, ``first_row`` the row of the file at which ``frames`` begin. ``malformed`` counts
    unreadable lines of the file, ``cut`` is whether its last line is incomplete, ``stream`` whether it is a stream.
    """

    frames: Frames
    layout: Layout
    rows_named: int | None = None
    usual_rows: float | None = None
    limits: CheckLimits = field(default_factory=CheckLimits)
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
        """Whether frames are stamped several at once, so that single steps carry little information."""
        return len(self.steps) >= 10 and float(np.mean(np.abs(self.steps) < 0.25 * self.period_ms)) > _BURSTS

    @cached_property
    def spread_ms(self) -> tuple[float, float]:
        """The 5th and 95th percentile of the time between frames; lost frames, gaps and resets apart."""
        even = self.steps[(self.steps >= 0) & (self.steps < 1.75 * self.period_ms)]
        low, high = np.percentile(even, (5, 95)) if len(even) else (0.0, 0.0)
        return float(low), float(high)

    @property
    def jitters(self) -> bool:
        """Whether the time between frames varies by more than the limit."""
        low, high = self.spread_ms
        return len(self.steps) >= 20 and (high - low) / 2 > self.limits.jitter * self.period_ms > 0

    @property
    def uneven(self) -> bool:
        """Whether stamps are uneven, so that only delays that are not caught up count as missing frames."""
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
        # Buffered frames arrive late and all at once, so compare the time around them.
        before, after = host[np.maximum(far - 20, 0)], host[np.minimum(far + 21, len(host) - 1)]
        return far[(after - before) < 0.5 * self.steps[far]]

    @cached_property
    def gaps(self) -> NDArray[np.int64]:
        """Rows after which frames are missing for longer than `gap_ms`."""
        gaps = np.setdiff1d(np.flatnonzero(self.steps > self.gap_ms), self.jumps)
        if not self.uneven or not len(gaps):
            return gaps
        # With uneven stamps, a delay that the following frames catch up is no gap: compare the time of the rows
        # around with their number.
        rate = measured_rate_hz(self.frames.device_ms)
        time, reach = self.frames.device_ms, 15
        low, high = np.maximum(gaps - reach, 0), np.minimum(gaps + 1 + reach, len(time) - 1)
        late = (time[high] - time[low]) - (high - low) * 1000.0 / rate
        return gaps[late > self.gap_ms]

    def row(self, at: int) -> int:
        """Return the number of a row in its file, from 1."""
        return int(at) + self.first_row + 1


def usual_rows(recordings: Iterable[tuple[str, int]]) -> dict[str, float]:
    """Return the median number of rows of each gesture, from pairs of gesture and rows."""
    rows: dict[str, list[int]] = {}
    for gesture, n in recordings:
        rows.setdefault(gesture, []).append(n)
    return {gesture: float(np.median(ns)) for gesture, ns in rows.items()}


def duration_s(frames: Frames) -> float:
    """Return the duration of a recording by the device clock; each reset or leap counts as one period."""
    steps = np.diff(frames.device_ms)
    good = (steps >= 0) & (steps <= 5000)
    period = float(np.median(steps[good])) if good.any() else 0.0
    return (float(steps[good].sum()) + period * int((~good).sum())) / 1000.0


LEVEL_KINDS = ("capacitive", "proximity")
"""Kinds of channel whose level shows touch; other channels turn with the toy."""
_HOP_S = 0.1
_CHUNK_S = 10.0
_NOISE = 2.0
# A channel needs activity of this many times its noise to count.
_MOVED = 10.0


@dataclass(frozen=True)
class RecordingSummary:
    """Summary of a recording or stream; C channels.

    ``activity`` (B, C) float32 is the range of each channel over 0.2 s, in blocks of 0.1 s (``hop`` rows); for channels
    of `LEVEL_KINDS` at least the height over the recording's low. ``runs`` (C,) is the longest run of one value in
    rows, from ``run_at``; ``top_runs`` the same at the highest or lowest value ``top``, which occurs in ``top_rows``
    rows. ``spread`` (C,) is the range from the 2nd to the 98th percentile, ``low`` the 10th percentile, and ``lows``
    (K, C) the 10th percentile of every 10 s of a stream.
    """

    info: RecordingInfo | StreamInfo
    rows: int
    seconds: float
    period_ms: float
    hop: int
    activity: NDArray[np.float32]
    runs: NDArray[np.int64]
    run_at: NDArray[np.int64]
    top_runs: NDArray[np.int64]
    top_at: NDArray[np.int64]
    top: NDArray[np.int64]
    top_rows: NDArray[np.int64]
    spread: NDArray[np.float64]
    low: NDArray[np.float64]
    content: bytes
    lows: NDArray[np.float64] | None = None

    @property
    def first_row(self) -> int:
        """Row of the recording at which the examined rows begin."""
        return self.info.start if isinstance(self.info, RecordingInfo) else 0


def _longest(same: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each column of ``same`` (T, C) the longest run of True and its first row."""
    rows = np.arange(len(same))[:, None]
    broken = np.maximum.accumulate(np.where(same, -1, rows), axis=0)
    length = np.where(same, rows - broken, 0)
    end = length.argmax(axis=0)
    longest = length[end, np.arange(same.shape[1])]
    return longest, end - longest + 1


def _activity(values: NDArray[np.float64], hop: int, level: NDArray[np.bool_]) -> NDArray[np.float32]:
    n = max(1, len(values) // hop)
    blocks = values[: n * hop].reshape(n, -1, values.shape[1])
    high, low = blocks.max(axis=1), blocks.min(axis=1)
    moved = high - low
    if n > 1:
        moved = np.maximum(high[:-1], high[1:]) - np.minimum(low[:-1], low[1:])
        moved = np.vstack([moved, moved[-1:]])
    if level.any():
        raised = (high + low)[:, level] / 2
        moved[:, level] = np.maximum(moved[:, level], raised - np.percentile(raised, 10, axis=0))
    return np.asarray(moved, dtype=np.float32)


def summarize(info: RecordingInfo | StreamInfo, frames: Frames, layout: Layout) -> RecordingSummary:
    """Summarise some rows; invalid values are clipped to the valid range, so that one does not hide the rest."""
    values = np.clip(frames.values, layout.valid_min_int, layout.valid_max_int)
    t, c = values.shape
    stream = isinstance(info, StreamInfo)
    steps = np.diff(frames.device_ms)
    forward = steps[(steps > 0) & (steps <= 1000)]
    mean_ms = float(steps[(steps >= 0) & (steps <= 1000)].mean()) if len(forward) else 1000.0 / layout.rate_hz
    hop = max(1, round(_HOP_S * 1000 / max(mean_ms, 1e-3)))
    level = np.array([ch.kind in LEVEL_KINDS for ch in layout.channels])
    same = np.vstack([np.zeros((1, c), dtype=bool), values[1:] == values[:-1]])
    runs, at = _longest(same)
    held_top, top_at = _longest(values == values.max(axis=0))
    held_low, low_at = _longest(values == values.min(axis=0))
    # Without touch a level rests at its lowest value, which is not saturation.
    held_low[level] = 0
    top_at = np.where(held_low > held_top, low_at, top_at)
    top = values[top_at, np.arange(c)]
    low, q2, q98 = np.percentile(values[::10] if stream else values, (10, 2, 98), axis=0)
    lows = None
    if stream:
        rows = max(1, round(_CHUNK_S * 1000 / max(mean_ms, 1e-3)))
        n = t // rows
        lows = np.percentile(values[: n * rows].reshape(n, rows, c)[:, ::5], 10, axis=1) if n else None
    return RecordingSummary(
        info,
        t,
        duration_s(frames),
        mean_ms,
        hop,
        np.zeros((0, c), np.float32) if stream else _activity(values.astype(np.float64), hop, level),
        runs + 1,
        at - 1,
        np.maximum(held_top, held_low),
        top_at,
        top,
        (values == top).sum(axis=0),
        q98 - q2,
        low,
        # Copies under other names or clocks have the same values.
        b"" if stream else hashlib.sha256(np.ascontiguousarray(frames.values).tobytes()).digest(),
        lows,
    )


@dataclass(frozen=True)
class DatasetSummary:
    """Summaries of all used recordings and of the streams, for checks that compare."""

    dataset: Dataset
    recordings: Sequence[RecordingSummary]
    streams: Sequence[RecordingSummary]
    limits: CheckLimits

    @cached_property
    def groups(self) -> dict[str, list[RecordingSummary]]:
        """Recordings that should be alike: of one gesture, and of one person if the gesture is free choice."""
        groups: dict[str, list[RecordingSummary]] = {}
        for o in self.recordings:
            gesture = self.dataset.gestures.find(gesture_of(o))
            free = gesture is not None and gesture.free_choice
            groups.setdefault(f"{gesture_of(o)}\n{o.info.subject}" if free else gesture_of(o), []).append(o)
        return groups

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """Activity of each channel at rest, (C,): the quiet moments of the quietest recordings."""
        quiet = [np.percentile(o.activity, 10, axis=0) for o in self.recordings if len(o.activity)]
        return np.asarray(np.percentile(quiet or np.zeros((1, self.dataset.layout.n_channels)), 5, axis=0))

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """Activity of each channel when it is touched, (C,), which makes channels of all kinds comparable."""
        peaks = [np.percentile(o.activity, 95, axis=0) for o in self.recordings if len(o.activity)]
        high = np.asarray(np.percentile(peaks or np.zeros((1, self.dataset.layout.n_channels)), 90, axis=0), np.float64)
        return np.maximum(high - _NOISE * self.noise, np.maximum(_MOVED * self.noise, 1.0))

    def activity(self, o: RecordingSummary) -> NDArray[np.float64]:
        """Return the activity in each block of a recording over all channels, beyond their noise, (B,)."""
        beyond = np.maximum(o.activity - _NOISE * self.noise, 0.0) / self.scale
        return np.asarray(np.sqrt(np.square(beyond).sum(axis=1)))

    @cached_property
    def usual_run_ms(self) -> NDArray[np.float64]:
        """The median over the recordings of each channel's longest stretch of one value in ms, (C,)."""
        return np.asarray(np.median([o.runs * o.period_ms for o in self.recordings], axis=0))

    @cached_property
    def usual_top_ms(self) -> NDArray[np.float64]:
        """The same for stretches at the highest or lowest value."""
        return np.asarray(np.median([o.top_runs * o.period_ms for o in self.recordings], axis=0))


def gesture_of(o: RecordingSummary) -> str:
    """Return the gesture of a recording's summary; "" for a stream."""
    return o.info.gesture if isinstance(o.info, RecordingInfo) else ""
