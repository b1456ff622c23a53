"""Checks of one file's rows: how many, how whole, how valid."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from plushsense.dataset.quality.examined import NEVER_STOPPED_FACTOR, Examined
from plushsense.dataset.quality.finding import Limits, Said, Severity

_SHOWN = 50
_FEW = 0.01
_TELLING_ROWS = 20
_OF_SPREAD = 0.02


def _weight(share: float, limits: Limits) -> Severity | None:
    """A few odd values are the sensor's way, and the clock rule holds the last valid one; many make data useless."""
    return "error" if share > limits.garbage else "info" if share < _FEW else None


def rows_against_name(s: Examined) -> Iterator[Said]:
    held = len(s.frames) if s.rows_in_file is None else s.rows_in_file
    if s.rows_named is not None and s.rows_named != held:
        yield Said(f"holds {held} rows, its name says {s.rows_named}")


def never_stopped(s: Examined) -> Iterator[Said]:
    if s.usual_rows is not None and len(s.frames) > NEVER_STOPPED_FACTOR * s.usual_rows:
        yield Said(
            f"holds {len(s.frames)} rows where this gesture usually has {s.usual_rows:.0f}: never stopped?",
            ((s.first_row, s.first_row + len(s.frames)),),
        )


def garbage(s: Examined) -> Iterator[Said]:
    """Values outside the valid range, and rows in which every channel reads 0: the authors' recorder wrote these."""
    values = s.frames.values
    outside: NDArray[np.bool_] = np.logical_or(values < s.layout.valid_min_int, values > s.layout.valid_max_int)
    rows = outside.any(axis=1)
    if rows.any():
        channels = np.flatnonzero(outside.any(axis=0)).tolist()
        names = [s.layout.names[c] for c in channels]
        yield Said(
            f"{int(outside.sum())} value{'s' if outside.sum() > 1 else ''} outside the valid range "
            f"({', '.join(names)}; first in row {s.row(int(np.argmax(rows)))})",
            tuple((int(r) + s.first_row, int(r) + s.first_row + 1) for r in np.flatnonzero(rows)[:_SHOWN]),
            tuple(channels),
            severity=_weight(float(rows.mean()), s.limits),
        )


def blank_rows(s: Examined) -> Iterator[Said]:
    rows = ~s.frames.values.any(axis=1)
    if s.layout.n_channels > 1 and rows.any():
        yield Said(
            f"{int(rows.sum())} row{'s' if rows.sum() > 1 else ''} in which every channel reads 0 "
            f"(first row {s.row(int(np.argmax(rows)))})",
            tuple((int(r) + s.first_row, int(r) + s.first_row + 1) for r in np.flatnonzero(rows)[:_SHOWN]),
            severity=_weight(float(rows.mean()), s.limits),
        )


def spikes(s: Examined) -> Iterator[Said]:
    """Single rows in which a channel jumps far away and back: a reading that failed, not a touch."""
    values = s.frames.values
    if len(values) < _TELLING_ROWS:
        return
    steps = np.diff(values, axis=0)
    there, back = steps[:-1], steps[1:]
    size = np.where(np.sign(there) == -np.sign(back), np.minimum(np.abs(there), np.abs(back)), 0)
    usual = np.percentile(np.abs(steps), 95, axis=0)
    usual = np.maximum(usual, _OF_SPREAD * np.subtract(*np.percentile(values, (98, 2), axis=0)))
    far = (size > s.limits.spike * np.maximum(usual, 1)) & (size > 3 * np.abs(values[2:] - values[:-2]))
    # What is outside the valid range has a check of its own.
    far &= (values[1:-1] >= s.layout.valid_min_int) & (values[1:-1] <= s.layout.valid_max_int)
    rows = np.flatnonzero(far.any(axis=1)) + 1
    if len(rows):
        yield Said(
            f"{len(rows)} row{'s' if len(rows) > 1 else ''} in which a value jumps far away and back "
            f"(first row {s.row(rows[0])}): a reading that failed?",
            tuple((int(r) + s.first_row, int(r) + s.first_row + 1) for r in rows[:_SHOWN]),
            severity=_weight(len(rows) / len(values), s.limits),
        )


def malformed(s: Examined) -> Iterator[Said]:
    if s.malformed:
        yield Said(f"{s.malformed} malformed line{'s' if s.malformed > 1 else ''} left out")


def cut_line(s: Examined) -> Iterator[Said]:
    if s.cut:
        yield Said("the last line is cut off: left out")
