"""Find columns that are no readings of a sensor: a second clock, or a number that counts the rows.

A network reads from such a column when a recording was made, and not what happened in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.sentences import Message

CLOCK, COUNTER = "a second clock", "a number of the row"
# Shorter recordings prove nothing.
_LEAST_ROWS = 20
# A number of the row counts by one from so many rows to the next; the others are lost rows, or it begins again.
_COUNTS = 0.9
# A clock rises, or falls, without a break for nearly all rows, on a straight line over the first clock, and as fast in
# every recording.
_COVERED = 0.9
_STRAIGHT = 0.999
_SAME_RATE = 1.1

Floats = NDArray[np.float64]


def no_reading(columns: Sequence[tuple[Floats, Floats]]) -> str:
    """Return whether a column is ``CLOCK`` or ``COUNTER``; "" if it may be a reading.

    Args:
        columns: values and times of each recording, both (T,), NaN where they are no numbers.
    """
    usable = [np.isfinite(values) & np.isfinite(times) for values, times in columns]
    parts = [(v[ok], t[ok]) for (v, t), ok in zip(columns, usable, strict=True) if ok.sum() >= _LEAST_ROWS]
    if not parts:
        return ""
    if all(_counts(values) for values, _ in parts):
        return COUNTER
    rates = [rate for values, times in parts for rate in _rates(values, times)]
    return CLOCK if rates and max(rates) <= _SAME_RATE * min(rates) else ""


def _counts(values: Floats) -> bool:
    """Return whether whole numbers count by one, also if they begin again, as at 256."""
    if np.any(np.abs(values - np.round(values)) > 1e-6):
        return False
    steps = np.round(np.diff(values))
    return max(float(np.mean(steps == 1)), float(np.mean(steps == -1))) > _COUNTS


def _rates(values: Floats, times: Floats) -> list[float]:
    """Return how fast each run of values rises or falls evenly with the times; 0 if they do not in nearly all rows."""
    down = np.mean(np.diff(values) < 0) > 0.5
    values = -values if down else values
    breaks = np.flatnonzero((np.diff(values) < 0) | (np.diff(times) < 0)) + 1
    runs = [run for run in np.split(np.arange(len(values)), breaks) if len(run) >= _LEAST_ROWS]
    if sum(map(len, runs)) < _COVERED * len(values):
        return [0.0, 1.0]
    rates = []
    for run in runs:
        x, y = times[run] - times[run].mean(), values[run] - values[run].mean()
        spread = float(np.sqrt((x @ x) * (y @ y)))
        if not spread or x @ y < _STRAIGHT * spread:
            return [0.0, 1.0]
        rates.append(float(x @ y / (x @ x)))
    return rates


def counters_note(layout: Layout, recordings: Sequence[Frames]) -> list[Message]:
    """Return a warning about the channels that are clocks or numbers of rows in every recording, if there are any."""
    kinds = {
        c.name: no_reading(
            [(r.values[:, k].astype(np.float64) * c.step, r.device_ms.astype(np.float64)) for r in recordings]
        )
        for k, c in enumerate(layout.channels)
    }
    found = {name: kind for name, kind in kinds.items() if kind}
    if not found:
        return []
    listed = ", ".join(f"'{name}' is {kind}" for name, kind in found.items())
    channels = ", ".join(f"'{name}'" for name in found)
    return [
        Message(
            "{listed}: a network would read from it when a recording was made, which says nothing live; take "
            "{channels} out of the channels and import again",
            listed=listed,
            channels=channels,
        )
    ]
