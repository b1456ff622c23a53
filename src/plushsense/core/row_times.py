"""Find the rows of a recording whose device time is out of order, as rule 1 of `plushsense.windows.clock` says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def kept_rows(device_ms: NDArray[np.int64], gap_ms: float) -> NDArray[np.int64]:
    """Return the rows that rule 1 of `plushsense.windows.clock` keeps, in order.

    A row is left out if its clock is earlier than in the row before, or more than ``gap_ms`` later, unless that row is
    left out, too. Between two kept rows such a step is a gap or a reset of the clock.
    """
    step = np.diff(device_ms)
    odd = np.flatnonzero((step < 0) | (step > gap_ms)) + 1
    if not len(odd):
        return np.arange(len(device_ms), dtype=np.int64)
    # Of odd rows in turn, every other one is left out, from the first.
    turn = np.arange(len(odd))
    first = np.maximum.accumulate(np.where(np.diff(odd, prepend=-1) > 1, turn, 0))
    return np.delete(np.arange(len(device_ms), dtype=np.int64), odd[(turn - first) % 2 == 0])


def stray_rows(device_ms: NDArray[np.int64], gap_ms: float) -> NDArray[np.int64]:
    """Return the rows that `kept_rows` leaves out between two rows that follow each other: only their time is wrong."""
    left_out = np.setdiff1d(np.arange(len(device_ms) - 1), kept_rows(device_ms, gap_ms))
    ahead = device_ms[left_out + 1] - device_ms[left_out - 1]
    return left_out[(ahead >= 0) & (ahead <= gap_ms)]


def bridged_ms(device_ms: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the times with those of ``rows`` half-way between the times before and after them."""
    times = device_ms.copy()
    times[rows] = (times[rows - 1] + times[rows + 1]) // 2
    return times
