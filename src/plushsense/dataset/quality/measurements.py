"""Measurements of single recordings for the checks, and the summaries by which recordings are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import ACCELERATION, Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import bridged_ms, stray_rows
from plushsense.dataset.quality.copies import HashedRows
from plushsense.dataset.quality.findings import CheckLimits
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo
from plushsense.recording.takes import measured_rate_hz

NEVER_STOPPED_FACTOR = 10.0
SLOW_FACTOR = 2.5
# If more than this share of steps is almost 0, frames were stamped on arrival, several at once.
_BURSTS = 0.05


# Rows that came late are at most this many, by at most this time; otherwise the clock was set back.
_LATE_ROWS, _LATE_MS = 20, 1000
# Rows that came late leave their place empty: with them, the time is as long as that many rows usually take.
_LEFT_EMPTY = 0.7


def backward_steps(times: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tell resets of a clock from rows that came late, as packets of a radio do that overtake each other.

    Args:
        times: (T,) device time of each row in ms.

    Returns:
        The rows after which the clock was reset, and those after which a row came late.
    """
    back = np.flatnonzero(np.diff(times) < 0)
    if not len(back):
        return back, back
    forward = np.diff(np.sort(times))
    period = float(np.median(forward[forward > 0])) if (forward > 0).any() else 0.0
    late = np.zeros(len(back), dtype=np.bool_)
    begin, seen, top = 0, 0, int(times[0])
    for k, at in enumerate(back.tolist()):
        top, seen = max(top, int(times[seen : at + 1].max())), at + 1
        returned = np.flatnonzero(times[at + 1 : at + 2 + _LATE_ROWS] >= top)
        n = int(returned[0]) if len(returned) else len(times) - at - 1
        around = times[max(begin, at - n - 1) : at + n + 2]
        late[k] = (
            n <= _LATE_ROWS
            and top - int(times[at + 1 : at + 1 + n].min()) <= _LATE_MS
            and int(np.ptp(around)) >= _LEFT_EMPTY * (len(around) - 1) * period
        )
        if not late[k]:
            begin, top = at + 1, int(times[at + 1])
    return back[~late], back[late]


_STILL_ROWS = 20
_FEWEST_ROWS = 5


def rows_at_one_time(times: NDArray[np.int64] | NDArray[np.float64]) -> int:
    """Return how many rows in turn usually have one time (T,), if the clock stands still for so long; else 0.

    A clock stands still if all of at least 5 rows have one time, or the median row shares its time with 20 neighbours.
    Such times have lost digits, as 1.5E+12 in a spreadsheet or seconds since 1970 in float32, or are one for each
    recording or second. Packets of some radios have one time for a few rows.
    """
    edges = [0, *(np.flatnonzero(times[1:] != times[:-1]) + 1).tolist(), len(times)]
    lengths = np.diff(edges)
    usual = int(np.median(np.repeat(lengths, lengths))) if len(times) else 0
    return usual if usual > _STILL_ROWS or usual == len(times) >= _FEWEST_ROWS else 0


def in_order(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices (T,) that bring rows that came late into the order of their times.

    Rows before and after a reset of the clock stay apart.
    """
    rows = np.arange(len(times), dtype=np.int64)
    resets, late = backward_steps(times)
    if not len(late):
        return rows
    parts = np.split(rows, resets + 1)
    return np.concatenate([part[np.argsort(times[part], kind="stable")] for part in parts])


@dataclass(frozen=True)
class Examination:
    """Input of the checks of one recording or stream.

    ``rows_named`` is the number of rows in the file's name (None if there is none), ``usual_rows`` the median number
    over the recordings of the gesture, ``first_row`` the row of the file at which ``frames`` begin. ``malformed``
    counts unreadable lines of the file, ``cut`` is whether its last line is incomplete, ``stream`` if it is a stream.
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
    def stray(self) -> NDArray[np.int64]:
        """Rows with an impossible time between two rows that follow each other, without those that came late."""
        clock = self.frames.device_ms
        stray = stray_rows(clock, self.layout.gap_ms)
        if not len(stray):
            return stray
        first = np.maximum.accumulate(np.where(np.diff(stray, prepend=-2) > 1, stray, 0))  # of several in turn
        return stray[~np.isin(first, backward_steps(clock)[1] + 1)]

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """Device time of each row in ms, (T,), those of `stray` rows evenly between the times around them."""
        return bridged_ms(self.frames.device_ms, self.stray)

    @cached_property
    def steps(self) -> NDArray[np.int64]:
        """Device time from each row to the next in ms, (T − 1,)."""
        return np.diff(self.times)

    @cached_property
    def back(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows after which the device clock was reset, and rows after which a row came late, see `backward_steps`."""
        return backward_steps(self.times)

    @cached_property
    def ordered_steps(self) -> NDArray[np.int64]:
        """Like `steps`, after rows that came late are put in order, so that they leave no gaps."""
        return np.diff(self.times[in_order(self.times)]) if len(self.back[1]) else self.steps

    @cached_property
    def period_ms(self) -> float:
        """Median time between frames by the device clock; 0 for fewer than two."""
        forward = self.steps[self.steps > 0]
        return float(np.median(forward)) if len(forward) else 0.0

    @cached_property
    def in_bursts(self) -> bool:
        """Whether several frames often have nearly the same time stamp, so that single steps mean little."""
        return len(self.steps) >= 10 and float(np.mean(np.abs(self.steps) < 0.25 * self.period_ms)) > _BURSTS

    @cached_property
    def spread_ms(self) -> tuple[float, float]:
        """The 5th and 95th percentile of the time between frames, without lost frames, gaps and clock resets."""
        even = self.steps[(self.steps >= 0) & (self.steps < 1.75 * self.period_ms)]
        low, high = np.percentile(even, (5, 95)) if len(even) else (0.0, 0.0)
        return float(low), float(high)

    @property
    def jitters(self) -> bool:
        """Whether the time between frames varies by more than ``limits.jitter``."""
        low, high = self.spread_ms
        return len(self.steps) >= 20 and (high - low) / 2 > self.limits.jitter * self.period_ms > 0

    @property
    def uneven(self) -> bool:
        """Whether time stamps are uneven, so that only a delay that later frames do not catch up is a gap."""
        return self.in_bursts or self.jitters

    @property
    def gap_ms(self) -> float:
        """Step in ms above which frames are missing; longer for toys with a low frame rate."""
        return max(self.limits.gap_ms, SLOW_FACTOR * self.period_ms)

    @cached_property
    def jumps(self) -> NDArray[np.int64]:
        """Rows after which the device clock leaps ahead by seconds although hardly any time passed on the computer."""
        host = self.frames.host_ms
        far = np.flatnonzero(self.steps > 5000)
        if host is None or not len(far):
            return np.empty(0, dtype=np.int64)
        # Buffered frames arrive late and together, so compare the times some rows before and after.
        before, after = host[np.maximum(far - 20, 0)], host[np.minimum(far + 21, len(host) - 1)]
        return far[(after - before) < 0.5 * self.steps[far]]

    @cached_property
    def gaps(self) -> NDArray[np.int64]:
        """Rows after which frames are missing for longer than `gap_ms`."""
        gaps = np.setdiff1d(np.flatnonzero(self.ordered_steps > self.gap_ms), self.jumps)
        if not self.uneven or not len(gaps):
            return gaps
        # With uneven stamps, a delay that later frames catch up is no gap: compare the duration of the rows around it
        # with their number.
        rate = measured_rate_hz(self.times)
        time, reach = self.times, 15
        low, high = np.maximum(gaps - reach, 0), np.minimum(gaps + 1 + reach, len(time) - 1)
        late = (time[high] - time[low]) - (high - low) * 1000.0 / rate
        return gaps[late > self.gap_ms]

    def row(self, at: int) -> int:
        """Return the number of a row in its file, from 1."""
        return int(at) + self.first_row + 1


def usual_rows(recordings: Iterable[tuple[str, str, int]]) -> dict[str, float]:
    """Return the usual number of rows of each gesture, from triples of gesture, person and rows: their median.

    If over half of at least three people have one beyond `NEVER_STOPPED_FACTOR` times that, as where each also has a
    minute of rest, it is the median of the people's longest: nobody forgot to stop.
    """
    rows: dict[str, dict[str, list[int]]] = {}
    for gesture, person, n in recordings:
        rows.setdefault(gesture, {}).setdefault(person, []).append(n)
    usual = {}
    for gesture, people in rows.items():
        median = float(np.median([n for own in people.values() for n in own]))
        longest = [max(own) for own in people.values()]
        long = sum(n > NEVER_STOPPED_FACTOR * median for n in longest)
        usual[gesture] = float(np.median(longest)) if len(longest) >= 3 and 2 * long > len(longest) else median
    return usual


LEVEL_KINDS = ("capacitive", "proximity")
"""Kinds of channels whose level shows touch; the level of other kinds also changes as the toy is turned."""
NEAR_ZERO = 10
_HOP_S = 0.1
START_HOPS = 3
"""Blocks of 0.1 s at the beginning of a recording, of which a summary keeps the mean."""
_CHUNK_S = 10.0
_NOISE = 2.0
_FEW_STEPS = 4.0
# Least scale of a channel's activity, as a multiple of its noise, so that channels that never move do not count.
_MOVED = 10.0


@dataclass(frozen=True)
class RecordingSummary:
    """Summary of a recording or stream with C channels.

    ``activity`` (B, C) float32 is the range of each channel over 0.2 s, for every block of 0.1 s (``hop`` rows), empty
    for streams; for channels of `LEVEL_KINDS` it is at least the height above the recording's 10th percentile. ``runs``
    (C,) is the length in rows of the longest run of one value, which begins at row ``run_at``; ``top_runs`` and
    ``top_at`` are the same at the highest or lowest value ``top``, which occurs in ``top_rows`` rows. ``spread`` (C,)
    is the range from the 2nd to the 98th percentile, ``lowest`` and ``highest`` the extremes, ``zeros`` counts the rows
    that are 0 and ``near_zeros`` those from 1 to `NEAR_ZERO` steps beside it, ``low`` the 10th percentile, ``lows`` (K,
    C) the 10th percentile of every 10 s of a stream, ``start`` (C,) the mean of the first 0.3 s. ``content`` is a
    hash of the values, b"" for a stream, and ``hashed`` has one of each row, None for a stream.
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
    lowest: NDArray[np.int64]
    highest: NDArray[np.int64]
    zeros: NDArray[np.int64]
    near_zeros: NDArray[np.int64]
    start: NDArray[np.float64]
    content: bytes
    lows: NDArray[np.float64] | None = None
    hashed: HashedRows | None = None

    @property
    def first_row(self) -> int:
        """Row of the recording at which the summarised rows begin."""
        return self.info.start if isinstance(self.info, RecordingInfo) else 0


def _longest(same: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the length and the first row of the longest run of True in each column of ``same`` (T, C)."""
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
    """Summarise ``frames``; invalid values are clipped to the valid range, so that they do not dominate."""
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
    # Without touch such a channel stays at its lowest value, which is not saturation.
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
        info.seconds,
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
        values.min(axis=0),
        values.max(axis=0),
        zeros := (values == 0).sum(axis=0),
        (np.abs(values) <= NEAR_ZERO).sum(axis=0) - zeros,
        values[: START_HOPS * hop].mean(axis=0),
        # Hash the values only, since copies may have other names and clocks.
        b"" if stream else hashlib.sha256(np.ascontiguousarray(frames.values).tobytes()).digest(),
        lows,
        None if isinstance(info, StreamInfo) else HashedRows.of(info, frames.values),
    )


def zeroing_limit(layout: Layout) -> int | None:
    """Return the limit under which the authors' recorder replaces values by 0, in every column; None if there is none.

    ``PlushSamples.pde`` takes values under -2000 for garbage of the capacitive sensors.
    """
    lows = layout.valid_min_int.tolist()
    limit = max((low for low, ch in zip(lows, layout.channels, strict=True) if ch.kind in LEVEL_KINDS), default=0)
    return limit if limit < 0 else None


# Share of rows from which zeros of an accelerometer's axis are more than chance.
_ZEROS = 0.002


@dataclass(frozen=True)
class DatasetSummary:
    """Summaries of all used recordings and of the streams: the input of the checks that compare them."""

    dataset: Dataset
    recordings: Sequence[RecordingSummary]
    streams: Sequence[RecordingSummary]
    limits: CheckLimits

    @cached_property
    def groups(self) -> dict[str, list[RecordingSummary]]:
        """Groups of similar recordings: those of one gesture, and of one person if the gesture is a free choice."""
        groups: dict[str, list[RecordingSummary]] = {}
        for o in self.recordings:
            gesture = self.dataset.gestures.find(gesture_of(o))
            free = gesture is not None and gesture.free_choice
            groups.setdefault(f"{gesture_of(o)}\n{o.info.subject}" if free else gesture_of(o), []).append(o)
        return groups

    @cached_property
    def zeroed(self) -> NDArray[np.bool_]:
        """Axes of an accelerometer (C,) in which 0 probably stands for every value under `zeroing_limit`.

        Such an axis is never lower, and 0 is more frequent than the 20 values beside it together.
        """
        layout = self.dataset.layout
        axes = np.array([ch.kind == ACCELERATION for ch in layout.channels])
        limit = zeroing_limit(layout)
        if limit is None or not axes.any() or not self.recordings:
            return np.zeros(len(axes), dtype=bool)
        lowest = np.min([o.lowest for o in self.recordings], axis=0)
        highest = np.max([o.highest for o in self.recordings], axis=0)
        zeros = np.sum([o.zeros for o in self.recordings], axis=0)
        near = np.sum([o.near_zeros for o in self.recordings], axis=0)
        often = zeros > np.maximum(near, _ZEROS * sum(o.rows for o in self.recordings))
        # A sensor that never reaches the limit on the other side either has no values that could have been replaced.
        reaches = highest[axes].max() > -limit
        return np.asarray(axes & often & (lowest >= limit) & (highest > lowest) & reaches)

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """Activity of each channel at rest, (C,), from the quiet moments of the quietest recordings."""
        quiet = [np.percentile(o.activity, 10, axis=0) for o in self.recordings if len(o.activity)]
        return np.asarray(np.percentile(quiet or np.zeros((1, self.dataset.layout.n_channels)), 5, axis=0))

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """Activity of each channel when it is touched, (C,), by which kinds of channels are made comparable."""
        peaks = [np.percentile(o.activity, 95, axis=0) for o in self.recordings if len(o.activity)]
        high = np.asarray(np.percentile(peaks or np.zeros((1, self.dataset.layout.n_channels)), 90, axis=0), np.float64)
        return np.maximum(high - _NOISE * self.noise, np.maximum(_MOVED * self.noise, 1.0))

    def activity(self, o: RecordingSummary) -> NDArray[np.float64]:
        """Return the activity above the noise in each block of a recording, (B,), combined over all channels."""
        beyond = np.maximum(o.activity - _NOISE * self.noise, 0.0) / self.scale
        return np.asarray(np.sqrt(np.square(beyond).sum(axis=1)))

    @cached_property
    def usual_run_ms(self) -> NDArray[np.float64]:
        """Usual duration of each channel's longest run of one value in ms, (C,): the median over the recordings."""
        return np.asarray(np.median([o.runs * o.period_ms for o in self.recordings], axis=0))

    @cached_property
    def coarse(self) -> NDArray[np.bool_]:
        """Channels (C,) whose noise at rest is mostly below one step, so that one value for a while means nothing."""
        quiet = [np.percentile(o.activity, 10, axis=0) for o in self.recordings if len(o.activity)]
        return np.asarray(np.median(quiet or np.ones((1, self.dataset.layout.n_channels)), axis=0) == 0)

    @cached_property
    def _still(self) -> dict[str, NDArray[np.bool_]]:
        spreads: dict[str, list[NDArray[np.float64]]] = {}
        for o in self.recordings:
            spreads.setdefault(gesture_of(o), []).append(o.spread)
        return {gesture: self.coarse & (np.median(group, axis=0) <= _FEW_STEPS) for gesture, group in spreads.items()}

    def still(self, o: RecordingSummary) -> NDArray[np.bool_]:
        """Return the `coarse` channels (C,) that hardly move in the gesture of a recording; for a stream, none."""
        return self._still.get(gesture_of(o), np.zeros(self.dataset.layout.n_channels, dtype=bool))

    @cached_property
    def usual_top_ms(self) -> NDArray[np.float64]:
        """As `usual_run_ms`, for runs at the highest or lowest value."""
        return np.asarray(np.median([o.top_runs * o.period_ms for o in self.recordings], axis=0))


def gesture_of(o: RecordingSummary) -> str:
    """Return the gesture of a summarised recording; "" for a stream."""
    return o.info.gesture if isinstance(o.info, RecordingInfo) else ""
