"""Checks of the clock: rate, jitter, gaps, resets, loss, pauses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from plushsense.dataset.quality.examined import Examined
from plushsense.dataset.quality.finding import Said, Severity

_SHOWN = 50
_NIGHT_MS = 6 * 3_600_000
_LEFT_OVER = 3
_STANDSTILL_MS = 5000
_RATE_OVER_S = 3
_FEW_LOST = 3


def _around(rows: NDArray[np.int64], s: Examined) -> tuple[tuple[int, int], ...]:
    """The first places, as stretches of two rows of the file."""
    return tuple((int(r) + s.first_row, int(r) + s.first_row + 2) for r in rows[:_SHOWN])


def duration_said(ms: float) -> str:
    """A time in the unit that reads best."""
    return (
        f"{ms:.0f} ms"
        if ms < 10_000
        else f"{ms / 1000:.0f} s"
        if ms < 600_000
        else f"{ms / 60_000:.0f} min"
        if ms < 36_000_000
        else f"{ms / 3_600_000:.0f} h"
    )


def clock_reset(s: Examined) -> Iterator[Said]:
    back = np.flatnonzero(s.steps < 0)
    whole: Severity | None = None
    if s.stream:
        # A stream's first rows may be left over from before, in the buffer of the serial port.
        whole = "info" if len(back) and back.max() < _LEFT_OVER else "warning"
    if len(back):
        yield Said(
            f"the device clock runs backwards {len(back)}× (first after row {s.row(back[0])}, "
            f"by {duration_said(-int(s.steps[back[0]]))})",
            _around(back, s),
            severity=whole,
        )
    if len(s.jumps):
        most = int(s.steps[s.jumps].max())
        yield Said(
            f"the device clock leaps ahead {len(s.jumps)}× (first after row {s.row(s.jumps[0])}, at most "
            f"{duration_said(most)}) while hardly any time passes on the computer",
            _around(s.jumps, s),
            severity="info" if s.jumps.max() < _LEFT_OVER else whole,
        )


def gaps(s: Examined) -> Iterator[Said]:
    if len(s.gaps):
        longest = int(s.steps[s.gaps].max())
        at = int(s.gaps[int(np.argmax(s.steps[s.gaps]))])
        yield Said(
            f"{len(s.gaps)} gap{'s' if len(s.gaps) > 1 else ''} over {s.gap_ms:.0f} ms, the longest {longest} ms "
            f"(after row {s.row(at)})",
            _around(s.gaps, s),
            severity="error" if not s.stream and longest > s.limits.long_gap_ms else None,
        )


def lost_frames(s: Examined) -> Iterator[Said]:
    """Whole periods that passed without a frame. An uneven clock hides single losses: there, only gaps count."""
    if s.period_ms <= 0:
        return
    # A stream that stood still for seconds was paused, or restarted: that has checks of its own.
    good = (s.steps > 0) & (s.steps <= _STANDSTILL_MS)
    good[s.jumps] = False
    usual = float(np.mean(s.steps[good & (s.steps < 1.5 * s.period_ms)])) if good.any() else s.period_ms
    missing = np.where(good, np.rint(s.steps / usual) - 1, 0)
    long = s.gaps if s.uneven else np.flatnonzero((s.steps > 1.6 * s.period_ms) & (missing >= 1))
    lost = int(missing[long].sum())
    share = lost / (lost + len(s.frames))
    if lost >= _FEW_LOST and share > s.limits.lost:
        yield Said(
            f"about {lost} of {lost + len(s.frames)} frames are lost ({100 * share:.1f} %) by the device clock",
            _around(long, s),
        )


def jitter(s: Examined) -> Iterator[Said]:
    if len(s.steps) < 20 or s.period_ms <= 0:
        return
    low, high = s.spread_ms
    if s.jitters:
        yield Said(
            f"the time between frames varies from {low:.0f} to {high:.0f} ms (median {s.period_ms:.0f} ms)"
            + (": frames are stamped several at once" if s.in_bursts else "")
        )


def rate(s: Examined) -> Iterator[Said]:
    """Over the stretches without gaps: what is lost has a check of its own."""
    even = s.steps[(s.steps >= 0) & (s.steps <= s.gap_ms)]
    nominal = s.layout.rate_hz
    if len(even) < 10 or even.sum() <= 0:
        return
    measured = 1000.0 * len(even) / float(even.sum())
    if s.uneven and len(even) < _RATE_OVER_S * nominal:
        return  # Little time with uneven stamps tells no rate.
    if abs(measured - nominal) > s.limits.rate * nominal:
        yield Said(f"measured {measured:.1f} Hz where the layout says {nominal:g} Hz")


def resumed(s: Examined) -> Iterator[Said]:
    """A stream that was appended to later, by the computer's clock."""
    host = s.frames.host_ms
    if host is None or s.frames.device_ms is host:
        return
    quiet = np.diff(host) - np.where(s.steps <= s.limits.pause_s * 1000, np.maximum(s.steps, 0), 0)
    at = np.flatnonzero(quiet > s.limits.pause_s * 1000)
    if not len(at):
        return
    longest = float(quiet[at].max())
    # Where the recorder stood is not known, so the date at midnight there is not either.
    days = longest > _NIGHT_MS
    yield Said(
        f"goes on after a pause {len(at)}× (the longest {duration_said(longest)} by the computer's clock, "
        f"first after row {s.row(at[0])}{', most likely on another day' if days else ''})",
        _around(at, s),
    )
