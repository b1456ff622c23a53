"""Quality checks of a single recording or stream: its values, rows and clock."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from plushsense.core.row_times import bridged_ms, stray_rows
from plushsense.core.sentences import Message
from plushsense.dataset.quality.findings import CheckLimits, Issue, Severity
from plushsense.dataset.quality.measurements import (
    NEVER_STOPPED_FACTOR,
    Examination,
    in_order,
    rows_at_one_time,
)
from plushsense.devices.base import LossCounter
from plushsense.recording.takes import duration_s, measured_rate_hz

_FEW = 0.01
# A spike is an error at so many times the usual, and a value outside a valid range at so many times the range.
_FAILED, _BEYOND = 1000, 300
_MOVES = 4
_SPIKE_ROWS = 20
_OF_SPREAD = 0.02
_SHOWN = 50
_NIGHT_MS = 6 * 3_600_000
_LEFT_OVER = 3
_STANDSTILL_MS = 5000
_RATE_OVER_S = 3
_FEW_LOST = 3


def _ranges(rows: NDArray[np.int64], s: Examination, length: int = 1) -> tuple[tuple[int, int], ...]:
    """Return a range of ``length`` rows of the file from each of the first `_SHOWN` of ``rows``."""
    return tuple((int(r) + s.first_row, int(r) + s.first_row + length) for r in rows[:_SHOWN])


def _weight(share: float, limits: CheckLimits) -> Severity | None:
    """Return the severity for a share of bad rows; few do no harm, since readers repeat the last valid value."""
    return "error" if share > limits.garbage else "info" if share < _FEW else None


def rows_against_name(s: Examination) -> Iterator[Issue]:
    rows = len(s.frames) if s.rows_in_file is None else s.rows_in_file
    if s.rows_named is not None and s.rows_named != rows:
        yield Issue(Message("holds {rows} rows, but its name states {named}", rows=rows, named=s.rows_named))


def never_stopped(s: Examination) -> Iterator[Issue]:
    if s.usual_rows is not None and len(s.frames) > NEVER_STOPPED_FACTOR * s.usual_rows:
        rows, usual = len(s.frames), round(s.usual_rows)
        yield Issue(
            Message("holds {rows} rows where this gesture usually has {usual}: never stopped?", rows=rows, usual=usual),
            ((s.first_row, s.first_row + len(s.frames)),),
        )


def too_short(s: Examination) -> Iterator[Issue]:
    rows = len(s.frames)
    seconds = duration_s(rows, measured_rate_hz(s.frames.device_ms))
    # A clock that stands still gives no duration.
    if seconds < s.limits.short_s and not rows_at_one_time(s.frames.device_ms):
        yield Issue(Message("holds {rows:row} ({seconds:.2f} s): too short for a gesture", rows=rows, seconds=seconds))


def garbage(s: Examination) -> Iterator[Issue]:
    """Find values outside the valid range."""
    values = s.frames.values
    outside: NDArray[np.bool_] = np.logical_or(values < s.layout.valid_min_int, values > s.layout.valid_max_int)
    rows = outside.any(axis=1)
    if rows.any():
        channels = np.flatnonzero(outside.any(axis=0)).tolist()
        names = [s.layout.names[c] for c in channels]
        n, row = int(outside.sum()), s.row(int(np.argmax(rows)))
        least, most = s.layout.valid_min_int, s.layout.valid_max_int
        beyond = np.maximum(least - values, values - most) > _BEYOND * (most - least)
        yield Issue(
            Message("{n:value} outside the valid range ({channels}; first in row {row})", n=n, channels=names, row=row),
            _ranges(np.flatnonzero(rows), s),
            tuple(channels),
            severity="error" if beyond.any() and not s.stream else _weight(float(rows.mean()), s.limits),
        )


def blank_rows(s: Examination) -> Iterator[Issue]:
    """Find rows in which every channel reads 0; cells that nothing touches do so without a fault."""
    rows = ~s.frames.values.any(axis=1)
    if sum(not ch.is_discrete for ch in s.layout.channels) > 1 and rows.any():
        n, row = int(rows.sum()), s.row(int(np.argmax(rows)))
        yield Issue(
            Message("{n:row} in which every channel reads 0 (first row {row})", n=n, row=row),
            _ranges(np.flatnonzero(rows), s),
            severity=_weight(float(rows.mean()), s.limits),
        )


def spikes(s: Examination) -> Iterator[Issue]:
    """Find single rows in which a channel jumps far away and back, which are probably failed readings."""
    values = s.frames.values
    if len(values) < _SPIKE_ROWS:
        return
    steps = np.diff(values, axis=0)
    there, back = steps[:-1], steps[1:]
    size = np.where(np.sign(there) == -np.sign(back), np.minimum(np.abs(there), np.abs(back)), 0)
    usual = np.percentile(np.abs(steps), 95, axis=0)
    usual = np.maximum(usual, _OF_SPREAD * np.subtract(*np.percentile(values, (98, 2), axis=0)))
    far = (size > s.limits.spike * np.maximum(usual, 1)) & (size > 3 * np.abs(values[2:] - values[:-2]))
    far &= ~np.array([ch.is_discrete for ch in s.layout.channels])
    # Another check reports values outside the valid range.
    far &= (values[1:-1] >= s.layout.valid_min_int) & (values[1:-1] <= s.layout.valid_max_int)
    rows = np.flatnonzero(far.any(axis=1)) + 1
    # Beside a channel at rest, whose steps are 0 or 1, a tap is as large.
    failed = far & (size > _FAILED * usual) & (usual >= _MOVES)
    if len(rows):
        n, row = len(rows), s.row(rows[0])
        yield Issue(
            Message(
                "{n:row} in which a value jumps far away and back (first row {row}): a reading that failed?",
                n=n,
                row=row,
            ),
            _ranges(rows, s),
            severity="error" if failed.any() else _weight(len(rows) / len(values), s.limits),
        )


def malformed(s: Examination) -> Iterator[Issue]:
    if s.malformed:
        yield Issue(Message("{n:malformed line} left out", n=s.malformed))


def cut_line(s: Examination) -> Iterator[Issue]:
    if s.cut:
        yield Issue(Message("the last line is cut off: left out"))


def format_duration(ms: float) -> str:
    """Format a duration of ``ms`` milliseconds in a suitable unit."""
    for limit_ms, unit_ms, unit in ((10_000, 1, "ms"), (600_000, 1000, "s"), (36_000_000, 60_000, "min")):
        if ms < limit_ms:
            return f"{ms / unit_ms:.0f} {unit}"
    return f"{ms / 3_600_000:.0f} h"


def clock_still(s: Examination) -> Iterator[Issue]:
    n, of = rows_at_one_time(s.frames.device_ms), len(s.frames)
    if n:
        template = (
            "the clock stands still: all {n} rows have one time (were digits lost in a spreadsheet, or as float32? "
            "export the times again, or give row_rate_hz in a pattern)"
        )
        if n < of:
            template = (
                "the clock stands still: {n} rows in turn have one time (were digits lost in a spreadsheet, or as "
                "float32? export the times again, or give row_rate_hz in a pattern)"
            )
        yield Issue(Message(template, n=n))


def clock_reset(s: Examination) -> Iterator[Issue]:
    back, _ = s.back
    of_stream: Severity | None = None
    if s.stream:
        # The first rows of a stream may be old ones from the buffer of the serial port.
        of_stream = "info" if len(back) and back.max() < _LEFT_OVER else "warning"
    if len(back):
        n, row, by = len(back), s.row(back[0]), format_duration(-int(s.steps[back[0]]))
        yield Issue(
            Message("the device clock runs backwards {n}× (first after row {row}, by {by})", n=n, row=row, by=by),
            _ranges(back, s, 2),
            severity=of_stream,
        )
    if len(s.jumps):
        n, row, most = len(s.jumps), s.row(s.jumps[0]), format_duration(int(s.steps[s.jumps].max()))
        yield Issue(
            Message(
                "the device clock leaps ahead {n}× (first after row {row}, at most {most}) while hardly any time "
                "passes on the computer",
                n=n,
                row=row,
                most=most,
            ),
            _ranges(s.jumps, s, 2),
            severity="info" if s.jumps.max() < _LEFT_OVER else of_stream,
        )


def clock_value(s: Examination) -> Iterator[Issue]:
    """Find single rows with an impossible time, as where the recorder could not read the clock and wrote 0."""
    if len(s.stray):
        n, row = len(s.stray), s.row(int(s.stray[0]))
        yield Issue(
            Message("{n:row} with an impossible clock value between possible ones (first row {row})", n=n, row=row),
            _ranges(s.stray, s),
            severity=_weight(n / len(s.frames), s.limits),
        )


def out_of_order(s: Examination) -> Iterator[Issue]:
    """Find rows that came after later ones, as packets of a radio do that overtake each other."""
    _, late = s.back
    if len(late):
        n, row, by = len(late), s.row(int(late[0]) + 1), format_duration(-int(s.steps[late].min()))
        yield Issue(
            Message("{n:row} out of order by the device clock (first row {row}, by at most {by})", n=n, row=row, by=by),
            _ranges(late, s, 2),
        )


def gaps(s: Examination) -> Iterator[Issue]:
    if len(s.gaps):
        longest = int(s.ordered_steps[s.gaps].max())
        at = int(s.gaps[int(np.argmax(s.ordered_steps[s.gaps]))])
        n, limit, row = len(s.gaps), round(s.gap_ms), s.row(at)
        yield Issue(
            Message(
                "{n:gap} over {limit} ms, the longest {longest} ms (after row {row})",
                n=n,
                limit=limit,
                longest=longest,
                row=row,
            ),
            _ranges(s.gaps, s, 2),
            severity="error" if not s.stream and longest > s.limits.long_gap_ms else None,
        )


def lost_frames(s: Examination) -> Iterator[Issue]:
    """Count the lost frames by the device clock; if the time stamps are uneven, only those in gaps."""
    if s.period_ms <= 0:
        return
    # Other checks report pauses and restarts.
    good = (s.ordered_steps > 0) & (s.ordered_steps <= _STANDSTILL_MS)
    good[s.jumps] = False
    usual = float(np.mean(s.ordered_steps[good & (s.ordered_steps < 1.5 * s.period_ms)])) if good.any() else s.period_ms
    missing = np.where(good, np.rint(s.ordered_steps / usual) - 1, 0)
    long = s.gaps if s.uneven else np.flatnonzero((s.ordered_steps > 1.6 * s.period_ms) & (missing >= 1))
    lost = int(missing[long].sum())
    share = lost / (lost + len(s.frames))
    if lost >= _FEW_LOST and share > s.limits.lost and not s.in_bursts:
        # Frames that a single delay kept back, and that came at once after it, are not lost.
        counter = LossCounter()
        counted = sum(map(counter.push, s.times[in_order(s.times)].tolist()))
        if 2 * counted < lost:
            lost, share = counted, counted / (counted + len(s.frames))
    if lost >= _FEW_LOST and share > s.limits.lost:
        of = lost + len(s.frames)
        yield Issue(
            Message(
                "about {n} of {of} frames are lost ({percent:.1f} %) by the device clock",
                n=lost,
                of=of,
                percent=100 * share,
            ),
            _ranges(long, s, 2),
        )


def jitter(s: Examination) -> Iterator[Issue]:
    if len(s.steps) < 20 or s.period_ms <= 0:
        return
    low, high = s.spread_ms
    if s.jitters:
        template = "the time between frames varies from {low:.0f} to {high:.0f} ms (median {median:.0f} ms)"
        if s.in_bursts:
            template = (
                "the time between frames varies from {low:.0f} to {high:.0f} ms (median {median:.0f} ms): frames are "
                "stamped several at once"
            )
        yield Issue(Message(template, low=low, high=high, median=s.period_ms))


def rate(s: Examination) -> Iterator[Issue]:
    """Compare the measured frame rate, without gaps, with that of the layout."""
    even = s.steps[(s.steps >= 0) & (s.steps <= s.gap_ms)]
    nominal = s.layout.rate_hz
    # With uneven time stamps, more rows are needed to measure the rate.
    if len(even) < max(10, _RATE_OVER_S * nominal if s.uneven else 0) or even.sum() <= 0:
        return
    measured = 1000.0 * len(even) / float(even.sum())
    if abs(measured - nominal) > s.limits.rate * nominal:
        yield Issue(
            Message(
                "measured {measured:.1f} Hz, but the rate of the layout is {nominal:g} Hz",
                measured=measured,
                nominal=nominal,
            )
        )


def resumed(s: Examination) -> Iterator[Issue]:
    """Find pauses, by the computer's clock, after which frames were appended to the same stream."""
    host = s.frames.host_ms
    if host is None or s.frames.device_ms is host:
        return
    # A stamp that the next one does not follow was garbled.
    host = bridged_ms(host, stray_rows(host, s.limits.pause_s * 1000))
    quiet = np.diff(host) - np.where(s.steps <= s.limits.pause_s * 1000, np.maximum(s.steps, 0), 0)
    at = np.flatnonzero(quiet > s.limits.pause_s * 1000)
    if not len(at):
        return
    longest = float(quiet[at].max())
    # The time zone of the recorder, and so midnight, is unknown: guess from the length of the pause.
    days = longest > _NIGHT_MS
    n, most, row = len(at), format_duration(longest), s.row(at[0])
    template = "goes on after a pause {n}× (the longest {most} by the computer's clock, first after row {row})"
    if days:
        template = (
            "goes on after a pause {n}× (the longest {most} by the computer's clock, first after row {row}, most "
            "likely on another day)"
        )
    yield Issue(
        Message(template, n=n, most=most, row=row),
        _ranges(at, s, 2),
    )
