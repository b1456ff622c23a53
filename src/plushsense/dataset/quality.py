"""Checks of one recording or stream at the door. Each is one function and one line in its table.

A check returns a sentence, or nothing. Nothing is refused here: the finding becomes a flag of the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout

LONG_GAP_MS = 50
GAP_FACTOR = 2.5
LONG_PAUSE_MS = 60_000
RATE_TOLERANCE = 0.2
NEVER_STOPPED_FACTOR = 10.0


@dataclass(frozen=True)
class Examined:
    """What a check looks at. ``rows_named`` is the count in the file's name, None where it says none;
    ``usual_rows`` the median over the recordings of the gesture.
    """

    frames: Frames
    layout: Layout
    rows_named: int | None
    usual_rows: float | None


def median_period_ms(frames: Frames) -> float:
    """Median time between frames by the device clock, in ms; 0 for fewer than two."""
    steps = np.diff(frames.device_ms)
    forward = steps[steps > 0]
    return float(np.median(forward)) if len(forward) else 0.0


def measured_rate_hz(frames: Frames) -> float:
    """Frames a second by the device clock, over the stretches without gaps or resets; 0 for fewer than two frames."""
    steps = np.diff(frames.device_ms)
    even = steps[(steps >= 0) & (steps <= 1000)]
    passed = float(even.sum())
    return 1000.0 * len(even) / passed if passed > 0 else 0.0


def _rows_against_name(s: Examined) -> str | None:
    if s.rows_named is None or s.rows_named == len(s.frames):
        return None
    return f"holds {len(s.frames)} rows, its name says {s.rows_named}"


def _never_stopped(s: Examined) -> str | None:
    if s.usual_rows is None or len(s.frames) <= NEVER_STOPPED_FACTOR * s.usual_rows:
        return None
    return f"holds {len(s.frames)} rows where this gesture usually has {s.usual_rows:.0f}: never stopped?"


def _clock_reset(s: Examined) -> str | None:
    back = np.flatnonzero(np.diff(s.frames.device_ms) < 0)
    if not len(back):
        return None
    return f"the device clock runs backwards {len(back)}× (first after row {int(back[0]) + 1})"


def _gaps(s: Examined) -> str | None:
    limit = max(LONG_GAP_MS, GAP_FACTOR * median_period_ms(s.frames))
    steps = np.diff(s.frames.device_ms)
    long = steps[steps > limit]
    if not len(long):
        return None
    return f"{len(long)} gap{'s' if len(long) > 1 else ''} over {limit:.0f} ms, the longest {int(long.max())} ms"


def _pauses(s: Examined) -> str | None:
    if s.frames.host_ms is None:
        return None
    quiet = np.diff(s.frames.host_ms) - np.maximum(np.diff(s.frames.device_ms), 0)
    pauses = quiet[quiet > LONG_PAUSE_MS]
    if not len(pauses):
        return None
    return f"goes on after a pause {len(pauses)}× (the longest {pauses.max() / 1000:.0f} s by the computer's clock)"


def _rate(s: Examined) -> str | None:
    rate = measured_rate_hz(s.frames)
    if rate == 0.0 or abs(rate - s.layout.rate_hz) <= RATE_TOLERANCE * s.layout.rate_hz:
        return None
    return f"measured {rate:.1f} Hz where the layout says {s.layout.rate_hz:g} Hz"


def _invalid(s: Examined) -> str | None:
    values = s.frames.values
    bad = np.logical_or(values < s.layout.valid_min_int, values > s.layout.valid_max_int)
    if not bad.any():
        return None
    names = [n for n, any_bad in zip(s.layout.names, bad.T, strict=True) if any_bad.any()]
    return f"{int(bad.sum())} values outside the valid range ({', '.join(names)})"


Check = Callable[[Examined], str | None]

CHECKS: dict[str, Check] = {
    "rows": _rows_against_name,
    "duration": _never_stopped,
    "clock": _clock_reset,
    "gaps": _gaps,
    "pause": _pauses,
    "rate": _rate,
    "range": _invalid,
}


def findings(examined: Examined) -> list[str]:
    """Every check's sentence about one recording or stream."""
    return [said for check in CHECKS.values() if (said := check(examined)) is not None]
