"""Find the rows of a recording whose device time is out of order, as rule 1 of `plushsense.windows.clock` says."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray


def kept_rows(device_ms: NDArray[np.int64], gap_ms: float) -> NDArray[np.int64]:
    """Return the rows that rule 1 of `plushsense.windows.clock` keeps, in order.

    Between two kept rows, a step back or of more than ``gap_ms`` is a reset of the clock or a gap.
    """
    rows = np.arange(len(device_ms), dtype=np.int64)
    step = np.diff(device_ms)
    odd = np.flatnonzero((step < 0) | (step > gap_ms))
    if not len(odd):
        return rows
    times, starts = device_ms.tolist(), (odd + 1).tolist()
    row, seen, out_of_order, left_out = starts[0], times[starts[0] - 1], False, list[int]()
    while row < len(times):
        time = times[row]
        late = -gap_ms <= time - seen < 0
        if not late:
            out_of_order = not out_of_order and not 0 <= time - seen <= gap_ms
        if late or out_of_order:
            left_out.append(row)
            row += 1
        else:
            # All rows are kept up to the next step that is out of order.
            after = bisect_right(starts, row)
            row = starts[after] if after < len(starts) else len(times)
            seen = times[row - 1]
    return np.delete(rows, left_out)


def stray_rows(device_ms: NDArray[np.int64], gap_ms: float) -> NDArray[np.int64]:
    """Return the rows that `kept_rows` leaves out between two kept rows that follow each other: their time is wrong."""
    kept = kept_rows(device_ms, gap_ms)
    left_out = np.setdiff1d(np.arange(kept[-1] if len(kept) else 0), kept)
    after = np.searchsorted(kept, left_out)
    ahead = device_ms[kept[after]] - device_ms[kept[after - 1]]
    return left_out[(ahead >= 0) & (ahead <= gap_ms)]


def bridged_ms(device_ms: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the times with those of ``rows`` evenly between the times of the other rows before and after them."""
    times = device_ms.copy()
    others = np.setdiff1d(np.arange(len(times)), rows)
    after = np.searchsorted(others, rows)
    before, after = others[after - 1], others[after]
    times[rows] = times[before] + (times[after] - times[before]) * (rows - before) // (after - before)
    return times
