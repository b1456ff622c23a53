"""The clock rule: resample frames of a device to evenly spaced ("even") samples.

A whole recording, a live stream and a toy's chip get identical samples, since all computations are in integers:

1. Each frame is compared with the last one that was not left out. If its device clock is earlier, by at most
   ``layout.gap_ms``, it is left out, as if it had been lost: drivers that stamp the readings of a buffer together are
   often a few ms off. If it is earlier by more, or later by more than ``layout.gap_ms``, it is out of order: it is left
   out, too, but a second such frame in turn starts a new segment, and all state of later computations is then reset. So
   a single impossible clock value is bridged, and a gap or a reset of the clock costs one frame.
2. A value outside the valid range of its channel is replaced by the channel's last valid value in the segment. Frames
   are skipped until every channel has had a valid value.
3. The first frame that is not skipped sets the time of sample 0; sample k is due ``k * period_us`` later. It is
   computed when the first frame at or after its time arrives, by linear interpolation between the two frames around
   it, rounded half up: ``x0 + floor((2 (x1 - x0) (t - t0) + (t1 - t0)) / (2 (t1 - t0)))``. Of several frames with
   equal times, the first ends the interval before them, and the last starts the interval after them.
4. A new segment of rule 1 begins after a *reboot* if, since the frame `STALE_FRAMES` before, of those not left out, the
   clock of the host went on by `LONG_PAUSE_MS` or more, and that of the device by less than half of it, or back: the
   device was off, and may have another sensor now. After a pause, drivers may first give frames that they had kept from
   before it. All that is known of the sensors (`plushsense.windows.self_calibration`) is then forgotten, too; a gap, or
   a clock that was reset without such a pause, leaves it as it is. Frames without a clock of the host, as on a chip,
   show no reboot: ``plush_recalibrate`` tells the C of one.

For a live stream the clock also measures the interval between the frames, as a toy does.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import kept_rows

LONG_PAUSE_MS = 600_000
"""Duration after which another sensor is likely; ``docs/people.md`` has the measurement."""
STALE_FRAMES = 256
"""Number of frames that a driver may keep over a pause: more than fit into 4 KiB."""
_MOST_INTERVAL = (1 << 16) - 1


def burst_ms(n: int, last_ms: int, period_us: int) -> list[int]:
    """Return the times of ``n`` readings, the last at ``last_ms``, like ``plush_push_many``, without those before 0.

    Times between two milliseconds are rounded down, as stamps of a clock are.
    """
    early = [-(-at * period_us // 1000) for at in range(n - 1, -1, -1)]
    return [last_ms - ms for ms in early if ms <= last_ms]


def row_times_us(frames: Frames, layout: Layout) -> NDArray[np.int64]:
    """Return the time (T,) of every row since the first one.

    A clock reset counts as one sample. A row that rule 1 leaves out has the time of the next row that it keeps, or else
    of the last one.
    """
    kept = kept_rows(frames.device_ms, layout.gap_ms)
    clock = frames.device_ms[kept].astype(np.int64)
    step = np.diff(clock, prepend=clock[:1]) * 1000
    times = np.cumsum(np.where(step < 0, layout.period_us, step))
    return times[np.minimum(np.searchsorted(kept, np.arange(len(frames))), len(kept) - 1)]


def is_reboot(before: Frames, after: Frames) -> bool:
    """Return whether a device was rebooted between two recordings, by rule 4; False without a clock of the host."""
    if before.host_ms is None or after.host_ms is None or not len(before) or not len(after):
        return False
    steps = (int(getattr(after, name)[0] - getattr(before, name)[-1]) for name in ("device_ms", "host_ms"))
    return bool(_over_reboot(*steps))


def reboots(device_ms: NDArray[np.int64], host_ms: NDArray[np.int64] | None, gap_ms: float) -> NDArray[np.bool_]:
    """Return which frames (T,), of those that rule 1 keeps, are the first after a reboot."""
    if host_ms is None:
        return np.zeros(len(device_ms), dtype=np.bool_)
    step, before = np.diff(device_ms, prepend=device_ms[:1]), np.maximum(np.arange(len(device_ms)) - STALE_FRAMES, 0)
    steps = (clock - clock[before] for clock in (device_ms, host_ms))
    return np.asarray(((step < 0) | (step > gap_ms)) & _over_reboot(*steps))


def _over_reboot(step_ms: Any, host_step_ms: Any) -> Any:
    return (host_step_ms >= LONG_PAUSE_MS) & (2 * step_ms < host_step_ms)


@dataclass(frozen=True)
class Segment:
    """Evenly spaced samples without a break.

    ``data`` (n, C) are the samples; ``start_us`` is the device time of sample 0; ``first_row`` to ``last_row``
    (exclusive) are the source rows used; ``row_of`` (n,) is the source row that completed each sample; ``invalid`` is
    the number of values outside their valid range; ``rebooted``: whether the device was rebooted since the segment
    before.
    """

    data: NDArray[np.int64]
    start_us: int
    period_us: int
    first_row: int
    last_row: int
    row_of: NDArray[np.int64]
    invalid: int
    rebooted: bool = False

    def __len__(self) -> int:
        return len(self.data)


class SampleClock:
    """The clock rule for a live stream, one frame at a time.

    Attributes:
        restarts: number of segments that a gap or a clock reset began.
        invalid: number of values outside their valid range.
        bad_stamps: number of frames that rule 1 left out, or that have the time of the frame before.
        interpolated: number of samples made up for frames that did not come: of each interval of 1.5 periods or more,
            all but one.
        interval: interval between frames in 1/256 ms, smoothed over 16 of them; at most 255 ms. 0 before the first.
        sparse: whether the interval is more than two periods, so that most samples are made up.
        left_out: whether rule 1 left the newest frame out.
        restarted: whether the newest frame started a new segment because of a gap or a clock reset.
        rebooted: whether it did so after a reboot.
    """

    def __init__(self, layout: Layout) -> None:
        self._low = [int(v) for v in layout.valid_min_int]
        self._high = [int(v) for v in layout.valid_max_int]
        self._period = layout.period_us
        self._gap = layout.gap_ms * 1000
        self.restarts = self.invalid = self.bad_stamps = self.interpolated = 0
        self.interval = 0
        self.left_out = self.restarted = self.rebooted = self.sparse = False
        self._follows = False  # the frame before was in order
        self._seen_us: int | None = None
        self.restart()

    def restart(self) -> None:
        """Start a new segment with the next frame, whatever its time."""
        self._seen_us, self._follows = None, False
        self._recent = deque[tuple[int, int]](maxlen=STALE_FRAMES)  # device and host time of the newest frames
        self.forget()

    def forget(self) -> None:
        """Start a new segment with the next frame."""
        self._empty = True
        self._held: list[int | None] = [None] * len(self._low)
        self._last: tuple[int, list[int]] | None = None
        self._start = 0
        self._made = 0

    @property
    def now_us(self) -> int | None:
        """Device time of the newest sample in microseconds; None before the first."""
        return None if self._made == 0 else self._start + (self._made - 1) * self._period

    def push(self, device_ms: int, values: Sequence[int]) -> list[NDArray[np.int64]]:
        """Add a frame; return the samples, each (C,) int64, that it completes.

        If ``restarted`` is then true, the frame started a new segment: reset later computations before these samples.
        """
        rows = self.samples(values) if self.accept(device_ms) else []
        return [np.array(row, dtype=np.int64) for row in rows]

    def accept(self, device_ms: int, host_ms: int | None = None) -> bool:
        """Apply rules 1 and 4 to the times of the next frame; return False if the frame is left out."""
        time = int(device_ms) * 1000
        step = 0 if self._seen_us is None else time - self._seen_us
        late, in_order = -self._gap <= step < 0, 0 <= step <= self._gap
        self.left_out = late or (self._follows and not in_order)
        self.restarted = not (in_order or self.left_out)
        self.bad_stamps += self.left_out or (step == 0 and self._follows)
        if not late:
            self._follows = not self.left_out
        if not self.left_out:
            self._seen_us, self.rebooted = time, False
            if host_ms is not None:
                if self.restarted and self._recent:
                    before, host_before = self._recent[0]
                    self.rebooted = bool(_over_reboot(int(device_ms) - before, host_ms - host_before))
                self._recent.append((int(device_ms), host_ms))
        return not self.left_out

    def count_from(self, other: SampleClock) -> None:
        """Continue with the counts of another clock."""
        for name in ("restarts", "invalid", "bad_stamps", "interpolated", "interval", "sparse"):
            setattr(self, name, getattr(other, name))

    def samples(self, values: Sequence[int]) -> list[list[int]]:
        """Add the values of the frame that `accept` has just kept; return the samples that it completes.

        They are plain integers, which are faster for a live stream than the arrays of `push`.
        """
        time = self._seen_us
        assert time is not None
        if self.restarted and not self._empty:
            self.restarts += 1
            self.forget()
        self._empty = False
        held = self._held
        for i, (value, low, high) in enumerate(zip(values, self._low, self._high, strict=True)):
            if low <= value <= high:
                held[i] = int(value)
            else:
                self.invalid += 1
        now = [v for v in held if v is not None]
        if len(now) < len(held):
            return []
        if self._last is None:
            self._start, self._made, self._last = time, 1, (time, now)
            self.interval, self.sparse = min(self._period * 256 // 1000, _MOST_INTERVAL), False
            return [now]
        before, old = self._last
        self._last = (time, now)
        made = []
        between = time - before
        self.interval += (min(between // 1000, 255) * 256 - self.interval) >> 4
        self.sparse = 1000 * self.interval > 512 * self._period
        if time > before:
            due = self._start + self._made * self._period
            while due <= time:
                into = 2 * (due - before)
                if into == 2 * between:
                    made.append(now)  # the frame itself
                else:
                    twice = 2 * between
                    made.append([a + ((b - a) * into + between) // twice for a, b in zip(old, now, strict=True)])
                due += self._period
            self._made += len(made)
        if 2 * between >= 3 * self._period:
            self.interpolated += len(made) - 1
        return made


def resample(frames: Frames, layout: Layout) -> list[Segment]:
    """Resample a whole recording; the segments have the same samples as those of a `SampleClock`."""
    rows = kept_rows(frames.device_ms, layout.gap_ms)
    time = frames.device_ms[rows].astype(np.int64) * 1000
    if len(time) == 0:
        return []
    values = frames.values[rows]
    step = np.diff(time)
    breaks = np.flatnonzero((step < 0) | (step > layout.gap_ms * 1000)) + 1
    edges = [0, *breaks.tolist(), len(time)]
    host_ms = None if frames.host_ms is None else frames.host_ms[rows]
    rebooted = reboots(frames.device_ms[rows], host_ms, layout.gap_ms)
    segments, forgets = [], False
    for first, last in itertools.pairwise(edges):
        segment = _segment(time[first:last], values[first:last], layout, rows[first:last])
        forgets |= bool(rebooted[first])
        if segment is not None:
            segments.append(replace(segment, rebooted=forgets))
            forgets = False
    return segments


def whole_recording(frames: Frames, layout: Layout) -> list[Segment]:
    """Return the rows of a recording as one segment of samples, whatever their times say.

    Values outside their valid range are replaced as in `resample`. The authors' scripts cut windows of such samples.
    """
    values, first, invalid = hold_valid(frames.values, layout)
    rows = np.arange(first, len(values), dtype=np.int64)
    if not len(rows):
        return []
    start_us = int(frames.device_ms[first]) * 1000
    return [Segment(values[first:], start_us, layout.period_us, first, len(values), rows, invalid)]


def hold_valid(values: NDArray[np.int64], layout: Layout) -> tuple[NDArray[np.int64], int, int]:
    """Apply rule 2 to the rows of a segment; return (values, first row not skipped, number of invalid values)."""
    good = (values >= layout.valid_min_int) & (values <= layout.valid_max_int)
    if good.all():
        return values, 0, 0
    rows = np.arange(len(values))[:, None]
    source = np.maximum.accumulate(np.where(good, rows, -1), axis=0)
    usable = np.flatnonzero((source >= 0).all(axis=1))
    first = int(usable[0]) if len(usable) else len(values)
    valid_values = np.take_along_axis(values, np.maximum(source, 0), axis=0)
    return valid_values, first, int((~good).sum())


def _segment(
    time: NDArray[np.int64], values: NDArray[np.int64], layout: Layout, rows: NDArray[np.int64]
) -> Segment | None:
    valid_values, first, invalid = hold_valid(values, layout)
    if first >= len(time):
        return None
    time, valid_values, rows = time[first:], valid_values[first:], rows[first:]
    period = layout.period_us
    # Of rows with equal times, the first ends an interval and the last starts the next one.
    opens = np.flatnonzero(np.append(np.diff(time) > 0, True))
    closes = np.insert(opens[:-1] + 1, 0, 0)
    moments = time[closes]
    due = np.arange(time[0], time[-1] + 1, period, dtype=np.int64)
    right = np.searchsorted(moments, due, side="left")
    left = np.maximum(right - 1, 0)
    a = valid_values[opens[left]]
    b = valid_values[closes[right]]
    between = np.maximum(moments[right] - moments[left], 1)[:, None]
    into = (2 * (due - moments[left]))[:, None]
    data = a + ((b - a) * into + between) // (2 * between)
    data[0] = valid_values[0]
    return Segment(
        data,
        int(time[0]),
        period,
        int(rows[0]),
        int(rows[-1]) + 1,
        rows[closes[right]],
        invalid,
    )
