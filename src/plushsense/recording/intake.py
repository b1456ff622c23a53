"""A toy's frames as they come: stamped, timed on the toy's own clock, and the holes between them."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

from plushsense.core.signal import Layout
from plushsense.devices.base import Device, Frame, LossMeter, now_ms
from plushsense.recording.meter import Meter, Quality
from plushsense.recording.take import gap_entry

AWAY_S = 1.0
"""A toy that is silent for so long is away; its user is told."""

JUMP_MS = 1000
"""A toy's clock that goes on by so much more than time has passed was misread on the way, or set: it does not count."""


class Came(NamedTuple):
    """One frame as it goes to the files, the frames that are missing before it, and the hole where there is one."""

    frame: Frame
    missing: int
    gap: dict[str, Any] | None


class Intake:
    """Follows a toy. Not for two threads at once: the recorder's lock guards it.

    Attributes:
        rows: of the session's stream.
        toy_ms: how long the toy has been heard, by its own clock: gaps count, a clock that begins anew goes on, and
            a stamp that cannot be true does not end a countdown or a recording.
        last: the newest frame.
        lost: frames that the toy's clock says are missing; gaps: the holes, ``after_row`` in rows of the stream.
    """

    def __init__(self, device: Device, layout: Layout, speed: float, rows: int, host_ms: int) -> None:
        """``rows`` and ``host_ms``: of the stream so far. ``speed``: see `plushsense.recording.engine.Recorder`."""
        self.rows = rows
        self.toy_ms = 0.0
        self.last: Frame | None = None
        self.lost = 0
        self.gaps: list[dict[str, Any]] = []
        self._device = device
        self._layout = layout
        self._real = speed == 1.0
        self._base_ms = now_ms() if self._real else max(now_ms(), host_ms + 1000)
        self._heard_s = float("-inf")
        self._reconnects = device.counters.reconnects
        self._noise_s = float("-inf")
        self._malformed = device.counters.malformed
        self._loss = LossMeter()
        self._meter = Meter(layout, AWAY_S)

    @property
    def away(self) -> bool:
        """Whether the toy was lost and is being waited for."""
        return getattr(self._device, "state", "connected") == "waiting"

    @property
    def silent_ms(self) -> float:
        """Since the last frame, by the computer's clock."""
        return 1000.0 * (time.monotonic() - self._heard_s)

    @property
    def silent(self) -> bool:
        """Whether nothing comes now."""
        return self.away or self.silent_ms > 1000.0 * AWAY_S

    def quality(self) -> Quality:
        """How the signal is right now."""
        now_s = time.monotonic()
        quality = self._meter.quality(now_s, self.away)
        if quality.signal == "none" and not self.away and now_s - self._noise_s <= AWAY_S:
            return Quality(signal="unreadable")
        return quality

    def now_ms(self) -> int:
        """The time that goes with the rows' stamps."""
        return now_ms() if self._real else self._base_ms + round(self.toy_ms)

    def take_in(self, came: Frame) -> Came:
        """One frame."""
        last = self.last
        step_ms = came.device_ms - last.device_ms if last else 0
        on_host = came.host_ms - last.host_ms if last and self._real else 0
        possible_ms = self._possible_ms(on_host)
        odd = not 0 <= step_ms <= possible_ms + JUMP_MS
        self.toy_ms += max(min(step_ms, possible_ms), on_host, 1000.0 / self._layout.rate_hz) if odd else step_ms
        host = came.host_ms if self._real else self._base_ms + round(self.toy_ms)
        frame = Frame(host, came.device_ms, came.values)
        counted = self._loss.push(came.device_ms)
        missing = 0 if odd else counted
        self.lost += missing
        returned = self._device.counters.reconnects > self._reconnects
        self._reconnects = self._device.counters.reconnects
        gap = None
        if last is not None and (odd or step_ms > self._layout.gap_ms or returned):
            missing_ms = max(on_host, 0 if odd else step_ms)
            gap = gap_entry(self.rows, last, frame, missing_ms, self._reason(step_ms, odd, returned))
            self.gaps.append(gap)
        self._meter.push(came.device_ms)
        self.last = frame
        self.rows += 1
        return Came(frame, missing, gap)

    def listened(self) -> None:
        """The toy was read, whether frames came or not: lines that are no frames are a signal, too."""
        if self._device.counters.malformed != self._malformed:
            self._malformed = self._device.counters.malformed
            self._noise_s = time.monotonic()

    def heard(self) -> None:
        """All frames of one reading are in."""
        self._heard_s = time.monotonic()
        self._meter.heard(self._device.counters, self._heard_s)

    def _possible_ms(self, on_host: int) -> float:
        """At real time the toy's clock can only have gone on since the last reading, by either of the computer's."""
        if not self._real or math.isinf(self._heard_s):
            return math.inf
        return max(on_host, self.silent_ms)

    def _reason(self, step_ms: int, odd: bool, returned: bool) -> str:
        if returned:
            known = [gap.reason for gap in getattr(self._device, "gaps", ())]
            return known[-1] if known and known[-1] else "the toy was away and came back"
        if odd:
            return "the toy's clock began anew" if step_ms < 0 else "the toy's clock jumped"
        return "nothing came"
