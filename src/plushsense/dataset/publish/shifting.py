"""Times that say nothing about the day: every person's recordings begin at a random instant of the year 2000.

One shift a person, for all clocks and names: what lies between two moments of one person stays as it was, so that a
recording is still found in its stream. The instant is drawn independently of the true one, so that the shift tells
neither day nor hour. The device clock counts from when the toy was switched on and is kept, unless it is a wall clock.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import Frames

YEAR_2000_MS = 946_684_800_000
_SPREAD_MS = 366 * 86_400_000
# Every shifted time lies before: sessions of one person may be years apart, not more.
LATEST_MS = 1_262_304_000_000
_FAR_MS = 9 * 366 * 86_400_000
# A clock of 32 bits in ms wraps after 49 days; what is beyond is a date.
WALL_CLOCK_MS = 2**32


@dataclass(frozen=True)
class Shift:
    """The shift of one person: ``anchor_ms`` is a true time that becomes ``target_ms``; ``device`` moves with it."""

    anchor_ms: int
    target_ms: int
    device: bool

    def plausible(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether each time can be one of this person's: what is years away is damage, and would tell the shift."""
        return (times >= self.anchor_ms - _SPREAD_MS) & (times < self.anchor_ms + _FAR_MS)

    def times(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Shifted times; an impossible one takes the place of the last possible one before it."""
        good = self.plausible(times)
        if not good.all():
            if not good.any():
                return np.full(len(times), self.target_ms, dtype=np.int64)
            last = np.maximum.accumulate(np.where(good, np.arange(len(times)), -1))
            times = times[np.where(last < 0, int(np.argmax(good)), last)]
        return times - self.anchor_ms + self.target_ms

    def time(self, time: int) -> int | None:
        """One shifted time; None when it is no time of this person's."""
        return time - self.anchor_ms + self.target_ms if self.plausible(np.array([time]))[0] else None

    def frames(self, frames: Frames, keep_host: bool) -> Frames:
        """The rows with shifted clocks; the values are the same array."""
        host = self.times(frames.host_ms) if keep_host and frames.host_ms is not None else None
        device = self.times(frames.device_ms) if self.device else frames.device_ms
        return replace(frames, host_ms=host, device_ms=device)


def shift_of(subject: str, firsts: list[int], device: bool, key: bytes) -> Shift:
    """The shift of one person.

    Args:
        firsts: the first wall-clock time of each of the person's files.
        device: whether the device clock is a wall clock too.
        key: the secret that the instant is drawn from: the same key gives the same shift.
    """
    drawn = int.from_bytes(hmac.digest(key, subject.encode("utf-8"), "sha256")[:8], "big") % _SPREAD_MS
    # The middle one decides which times are possible, so that one damaged file cannot.
    middle = sorted(firsts)[len(firsts) // 2] if firsts else 0
    near = [t for t in firsts if abs(t - middle) <= _FAR_MS // 2]
    return Shift(min(near, default=0), YEAR_2000_MS + drawn, device)
