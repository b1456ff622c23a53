"""How the toy's signal is right now, by its own clock: rate, jitter, and one word for the person."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from plushsense.core.signal import Layout
from plushsense.devices.base import Counters

SPAN_MS = 2_000
LOSS_SPAN_MS = 10_000
SILENT_S = 1.0
FAIR, POOR = 0.005, 0.05
RATE_OFF = 0.2
_READINGS = 4096

SIGNAL = {
    "good": "hardly anything is lost",
    "fair": "over 0.5 % of the lines of the last 10 s were lost, spoilt or out of range",
    "poor": "over 5 % were, or the rate is over 20 % off, or the toy's clock stands still",
    "none": "nothing came for a second, or the toy is away",
    "unreadable": "lines come, but none of them is a frame of the layout",
}


@dataclass(frozen=True)
class Quality:
    """What a meter says: frames a second, standard deviation of the time between frames, a word of `SIGNAL`, and the
    share of the last seconds' lines that were lost, spoilt or out of range."""

    rate_hz: float = 0.0
    jitter_ms: float = 0.0
    signal: str = "none"
    bad_share: float = 0.0


class Meter:
    """Counts along with the frames; `quality` may be asked at any time."""

    def __init__(self, layout: Layout, silent_s: float = SILENT_S) -> None:
        self._rate_hz = layout.rate_hz
        self._silent_s = silent_s
        # By count, too: a clock that stands still never leaves the span.
        self._clock: deque[int] = deque(maxlen=max(64, round(2 * layout.rate_hz * SPAN_MS / 1000)))
        self._losses: deque[tuple[int, int, int]] = deque(maxlen=_READINGS)
        self._heard_s = float("-inf")

    def push(self, device_ms: int) -> None:
        """One frame; a clock that goes back, or over a pause, begins anew."""
        clock = self._clock
        if clock and not 0 <= device_ms - clock[-1] <= SPAN_MS:
            clock.clear()
            self._losses.clear()
        clock.append(device_ms)
        while device_ms - clock[0] > SPAN_MS:
            clock.popleft()

    def heard(self, counters: Counters, at_s: float) -> None:
        """The frames of one reading are all in; ``at_s`` by a monotonic clock."""
        self._heard_s = at_s
        if self._clock:
            now = self._clock[-1]
            self._losses.append((now, counters.frames, counters.lost + counters.malformed + counters.garbage))
            while now - self._losses[0][0] > LOSS_SPAN_MS:
                self._losses.popleft()

    def quality(self, at_s: float, away: bool = False) -> Quality:
        """How the signal is at this moment of the monotonic clock."""
        if away or at_s - self._heard_s > self._silent_s or len(self._clock) < 3:
            return Quality()
        steps = np.diff(np.array(self._clock))
        passed = float(steps.sum())
        rate = 1000.0 * len(steps) / passed if passed > 0 else 0.0
        frames, bad = (b - a for a, b in zip(self._losses[0][1:], self._losses[-1][1:], strict=True))
        share = bad / max(1, frames + bad)
        stands = passed <= 0 and len(steps) > self._rate_hz
        off = stands or (passed > SPAN_MS / 2 and abs(rate - self._rate_hz) > RATE_OFF * self._rate_hz)
        word = "poor" if share > POOR or off else "fair" if share > FAIR else "good"
        return Quality(round(rate, 1), round(float(steps.std()), 2), word, share)
