"""Mark simulated recordings in the times of their rows, where moving, renaming and cutting of files leaves it.

A frame of a simulation arrives 0 to 6 ms late, and by how much is no chance: its time on the computer, modulo 7, is a
checksum of its values. Of a real recording, one row in seven fits. The mark is lost if times are shifted or values
changed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recorder_csv import Frames

_MODULUS = 7
_GARBAGE = -2000
# So many rows, whose values differ from those before, tell a simulation if this share of them fits: by chance, fewer
# than one recording in 10^18 has it.
_LEAST_ROWS = 50
_SHARE = 0.75


def _checksums(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number from 0 to 6 for each row of values (T, C).

    Values under -2000 count as 0, which the authors' recorder writes in their place.
    """
    weights = np.cumprod(np.full(values.shape[1], 0x9E3779B97F4A7C15, dtype=np.uint64))
    mixed = np.where(values < _GARBAGE, 0, values).astype(np.uint64) @ weights
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return ((mixed >> np.uint64(40)) % np.uint64(_MODULUS)).astype(np.int64)


def mark_times(host_ms: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the times (T,), each later by as little as the checksum of its ``values`` (T, C) asks, and in order."""
    sums = _checksums(values)
    marked = host_ms + (sums - host_ms) % _MODULUS
    if not np.all(np.diff(marked) >= 0):
        # Frames that came together wait for each other.
        last = 0
        for row, (at, checksum) in enumerate(zip(host_ms.tolist(), sums.tolist(), strict=True)):
            last = max(last, at)
            last += (checksum - last) % _MODULUS
            marked[row] = last
    return marked


def is_marked(frames: Frames) -> bool:
    """Return whether the times of a recording, or of a part of it, have the mark of `mark_times`."""
    if frames.host_ms is None or len(frames) <= _LEAST_ROWS:
        return False
    fits = _checksums(frames.values) == frames.host_ms % _MODULUS
    changes = (frames.values[1:] != frames.values[:-1]).any(axis=1)
    return bool(changes.sum() >= _LEAST_ROWS and fits[1:][changes].mean() >= _SHARE)
