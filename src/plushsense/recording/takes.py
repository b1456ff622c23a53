"""Receive a toy's frames: time stamps, signal quality, losses and gaps."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from plushsense.core.layouts import Layout
from plushsense.devices.base import Counters, Device, Frame, LossCounter, now_ms
from plushsense.recording.plan import Step

SPAN_MS = 2_000
LOSS_SPAN_MS = 10_000
SILENT_S = 1.0
FAIR, POOR = 0.005, 0.05
RATE_OFF = 0.2
_READINGS = 4096

SIGNAL = {
    "good": "almost nothing is lost",
    "fair": "over 0.5 % of the lines of the last 10 s were lost, malformed or out of range",
    "poor": "over 5 % were, or the rate is over 20 % off, or the toy's clock stands still",
    "none": "no frame arrived for a second, or the toy is disconnected",
    "unreadable": "lines arrive, but none of them is a frame of the layout",
}


@dataclass(frozen=True)
class SignalQuality:
    """Signal quality of the last seconds.

    ``rate_hz`` is the frame rate, ``jitter_ms`` the standard deviation of the time between frames, ``signal`` a key of
    `SIGNAL`, ``bad_share`` the share of lines that were lost, malformed or out of range, 0 to 1.
    """

    rate_hz: float = 0.0
    jitter_ms: float = 0.0
    signal: str = "none"
    bad_share: float = 0.0


class SignalMonitor:
    """Monitor that measures rate, jitter and losses of a stream of frames."""

    def __init__(self, layout: Layout, silent_s: float = SILENT_S) -> None:
        self._rate_hz = layout.rate_hz
        self._silent_s = silent_s
        # Limit the count too, since with a clock that stands still no frame ever leaves the time span.
        self._clock: deque[int] = deque(maxlen=max(64, round(2 * layout.rate_hz * SPAN_MS / 1000)))
        self._losses: deque[tuple[int, int, int]] = deque(maxlen=_READINGS)
        self._last_read_s = float("-inf")

    def push(self, device_ms: int) -> None:
        """Add the time stamp of a frame; start again if the clock went back, or after a pause."""
        clock = self._clock
        if clock and not 0 <= device_ms - clock[-1] <= SPAN_MS:
            clock.clear()
            self._losses.clear()
        clock.append(device_ms)
        while device_ms - clock[0] > SPAN_MS:
            clock.popleft()

    def update_losses(self, counters: Counters, at_s: float) -> None:
        """Store the counters after a reading; ``at_s`` is its time by a monotonic clock."""
        self._last_read_s = at_s
        if self._clock:
            now = self._clock[-1]
            self._losses.append((now, counters.frames, counters.lost + counters.malformed + counters.garbage))
            while now - self._losses[0][0] > LOSS_SPAN_MS:
                self._losses.popleft()

    def quality(self, at_s: float, away: bool = False) -> SignalQuality:
        """Return the signal quality at the time ``at_s`` of the monotonic clock; none if the toy is ``away``."""
        if away or at_s - self._last_read_s > self._silent_s or len(self._clock) < 3:
            return SignalQuality()
        steps = np.diff(np.array(self._clock))
        passed = float(steps.sum())
        rate = 1000.0 * len(steps) / passed if passed > 0 else 0.0
        frames, bad = (b - a for a, b in zip(self._losses[0][1:], self._losses[-1][1:], strict=True))
        share = bad / max(1, frames + bad)
        stands = passed <= 0 and len(steps) > self._rate_hz
        off = stands or (passed > SPAN_MS / 2 and abs(rate - self._rate_hz) > RATE_OFF * self._rate_hz)
        word = "poor" if share > POOR or off else "fair" if share > FAIR else "good"
        return SignalQuality(round(rate, 1), round(float(steps.std()), 2), word, share)


Ended = Literal["space", "auto", "longest", "toy", "cut"]
"""Why a recording ended: the space bar, automatic recording (--auto), the protocol's ``longest_s``, or the end of the
toy's data; "cut" if it was cut from a longer stream afterwards."""


@dataclass
class RecordingTake:
    """Recording in progress.

    It begins at ``row`` of the session's stream, at the time ``from_s`` of the computer's monotonic clock; ``before``
    are the counters at that time. ``lost`` frames are missing between its rows.
    """

    step: Step
    row: int
    from_s: float
    before: Counters
    frames: list[Frame] = field(default_factory=list)
    lost: int = 0
    gaps: list[StreamGap] = field(default_factory=list)


@dataclass(frozen=True)
class StreamGap:
    """A gap: number of rows before it, both clocks before and after it (None: it has not ended), length, reason."""

    after_row: int
    device_ms: tuple[int, int | None]
    host_ms: tuple[int, int | None]
    missing_ms: int
    reason: str

    @classmethod
    def of(cls, rows: int, last: Frame, now: Frame | None, missing_ms: float, reason: str) -> StreamGap:
        """Return the gap between two frames; ``now`` is None if nothing came any more."""
        clocks = (last.device_ms, now.device_ms if now else None), (last.host_ms, now.host_ms if now else None)
        return cls(rows, *clocks, round(missing_ms), reason)

    def to_json(self) -> dict[str, object]:
        """Return the gap as sidecars and the log hold it."""
        return asdict(self)


def measured_rate_hz(device_ms: Any) -> float:
    """Return the frames per second by the toy's clock, without gaps and resets; 0 if unknown."""
    steps = np.diff(device_ms)
    even = steps[(steps >= 0) & (steps <= 1000)]
    return 1000.0 * len(even) / float(even.sum()) if even.sum() > 0 else 0.0


def duration_s(rows: int, rate_hz: float) -> float:
    """Return how many seconds ``rows`` rows last at the rate of `measured_rate_hz`; 0 if the rate is unknown.

    Each row counts for one mean period, also the last one. Lost frames count as time, as they lower the rate, but gaps
    of more than a second and resets do not.
    """
    return rows / rate_hz if rate_hz > 0 else 0.0


AWAY_S = 1.0
"""Seconds without a frame after which the toy counts as disconnected."""

JUMP_MS = 1000
"""If the toy's clock advances by this much more than the elapsed time, it was misread or set: ignore the step."""


SLOWEST = 2.0
"""Longest that a second of the toy's clock may take, in seconds; a clock that stands counts as that slow."""


class ReceivedFrame(NamedTuple):
    """Frame with the times to write, the change of the number of missing frames, and the gap before it, if any."""

    frame: Frame
    missing: int
    gap: StreamGap | None


class FrameReceiver:
    """Receiver that time-stamps a toy's frames and tracks its clock, losses and gaps.

    Not thread-safe: the recorder's lock guards it. ``toy_ms`` is the time since the first frame by the toy's clock,
    including gaps; it continues if the clock restarts, and an impossible time stamp does not end a countdown or a
    recording. ``rows`` counts the rows of the session's stream, ``lost`` the missing frames; ``after_row`` of ``gaps``
    is a row of the stream.
    """

    def __init__(self, device: Device, layout: Layout, speed: float, rows: int, host_ms: int) -> None:
        """Continue a stream of ``rows`` rows that ends at ``host_ms``; ``speed`` is that of the `Recorder`."""
        self.rows = rows
        self.toy_ms = 0.0
        self.last: Frame | None = None
        self.lost = 0
        self.gaps: list[StreamGap] = []
        self._device = device
        self._layout = layout
        self._real = speed == 1.0
        self._base_ms = now_ms() if self._real else max(now_ms(), host_ms + 1000)
        self._last_read_s = float("-inf")
        self._reconnects = device.counters.reconnects
        self._last_malformed_s = float("-inf")
        self._malformed = device.counters.malformed
        self._loss = LossCounter()
        self._monitor = SignalMonitor(layout, AWAY_S)
        self._exchanged = False

    def exchange(self, device: Device) -> None:
        """Go on with another toy of the same layout; `lost` begins again with it."""
        self._device = device
        self._reconnects, self._malformed = device.counters.reconnects, device.counters.malformed
        self._loss, self._monitor = LossCounter(), SignalMonitor(self._layout, AWAY_S)
        self._last_read_s = self._last_malformed_s = float("-inf")
        self.lost = 0
        self._exchanged = True

    @property
    def away(self) -> bool:
        """Whether the connection was lost and is being restored."""
        return getattr(self._device, "state", "connected") == "waiting"

    @property
    def silent_ms(self) -> float:
        """Milliseconds since the last frame, by the computer's clock."""
        return 1000.0 * (time.monotonic() - self._last_read_s)

    @property
    def silent(self) -> bool:
        """Whether no frames arrive at present."""
        return self.away or self.silent_ms > 1000.0 * AWAY_S

    def quality(self) -> SignalQuality:
        """Return the current signal quality."""
        now_s = time.monotonic()
        quality = self._monitor.quality(now_s, self.away)
        if quality.signal == "none" and not self.away and now_s - self._last_malformed_s <= AWAY_S:
            return SignalQuality(signal="unreadable")
        return quality

    def passed_s(self, since_ms: float, since_s: float) -> float:
        """Return the seconds since a moment by the toy's clock; it counts as at most `SLOWEST` times too slow.

        Args:
            since_ms: ``toy_ms`` at the moment.
            since_s: `time.monotonic` at the moment.
        """
        passed_s = (self.toy_ms - since_ms) / 1000.0
        if self._real and not self.silent:
            passed_s = max(passed_s, (time.monotonic() - since_s) / SLOWEST)
        return passed_s

    def now_ms(self) -> int:
        """Return the current time on the clock of the rows' time stamps."""
        return now_ms() if self._real else self._base_ms + round(self.toy_ms)

    def receive(self, came: Frame) -> ReceivedFrame:
        """Time-stamp a frame, count missing frames and detect a gap before it."""
        last = self.last
        step_ms = came.device_ms - last.device_ms if last else 0
        on_host = came.host_ms - last.host_ms if last and self._real else 0
        possible_ms = self._possible_ms(on_host)
        another = self._exchanged and last is not None
        self._exchanged = False
        odd = another or not 0 <= step_ms <= possible_ms + JUMP_MS
        passed_ms = 0 if another else min(step_ms, possible_ms)
        self.toy_ms += max(passed_ms, on_host, 1000.0 / self._layout.rate_hz) if odd else step_ms
        host = came.host_ms if self._real else self._base_ms + round(self.toy_ms)
        frame = Frame(host, came.device_ms, came.values)
        counted = self._loss.push(came.device_ms)
        missing = 0 if odd else counted
        self.lost = max(0, self.lost + missing)
        returned = self._device.counters.reconnects > self._reconnects
        self._reconnects = self._device.counters.reconnects
        gap = None
        if last is not None and (odd or step_ms > self._layout.gap_ms or returned):
            missing_ms = max(on_host, 0 if odd else step_ms)
            reason = "another toy" if another else self._reason(step_ms, odd, returned)
            gap = StreamGap.of(self.rows, last, frame, missing_ms, reason)
            self.gaps.append(gap)
        self._monitor.push(came.device_ms)
        self.last = frame
        self.rows += 1
        return ReceivedFrame(frame, missing, gap)

    def check_malformed(self) -> None:
        """Store the time of new malformed lines, which show that the toy at least sends something."""
        if self._device.counters.malformed != self._malformed:
            self._malformed = self._device.counters.malformed
            self._last_malformed_s = time.monotonic()

    def end_reading(self) -> None:
        """Update time and counters; call this after all frames of a reading."""
        self._last_read_s = time.monotonic()
        self._monitor.update_losses(self._device.counters, self._last_read_s)

    def _possible_ms(self, on_host: int) -> float:
        """Return the most that the toy's clock can have advanced since the last reading, by the computer's clocks."""
        if not self._real or math.isinf(self._last_read_s):
            return math.inf
        return max(on_host, self.silent_ms)

    def _reason(self, step_ms: int, odd: bool, returned: bool) -> str:
        if returned:
            known = [gap.reason for gap in getattr(self._device, "gaps", ())]
            return known[-1] if known and known[-1] else "the toy was away and came back"
        if odd:
            return "the toy's clock restarted" if step_ms < 0 else "the toy's clock jumped"
        return "nothing came"
