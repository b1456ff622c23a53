"""A toy's frames as they come: stamped, timed on the toy's own clock, and the holes between them."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from plushsense.core.signal import Layout
from plushsense.devices.base import Device, Frame, LossMeter, now_ms
from plushsense.recording.meter import Meter, Quality
from plushsense.recording.take import gap_entry

AWAY_S = 1.0
"""A toy that is silent for so long is away; its user is told."""


class Came(NamedTuple):
    """One frame as it goes to the files, the frames that are missing before it, and the hole where there is one."""

    frame: Frame
    missing: int
    gap: dict[str, Any] | None


class Intake:
    """Follows a toy. Not for two threads at once: the recorder's lock guards it.

    Attributes:
        rows: of the session's stream.
        toy_ms: how long the toy has been heard, by its own clock: gaps count, a clock that begins anew goes on.
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
        return self._meter.quality(time.monotonic(), self.away)

    def now_ms(self) -> int:
        """The time that goes with the rows' stamps."""
        return now_ms() if self._real else self._base_ms + round(self.toy_ms)

    def take_in(self, came: Frame) -> Came:
        """One frame."""
        last = self.last
        step_ms = came.device_ms - last.device_ms if last else 0
        on_host = came.host_ms - last.host_ms if last and self._real else 0
        self.toy_ms += step_ms if step_ms >= 0 else max(on_host, round(1000.0 / self._layout.rate_hz))
        host = came.host_ms if self._real else self._base_ms + round(self.toy_ms)
        frame = Frame(host, came.device_ms, came.values)
        missing = self._loss.push(came.device_ms)
        self.lost += missing
        returned = self._device.counters.reconnects > self._reconnects
        self._reconnects = self._device.counters.reconnects
        gap = None
        if last is not None and (step_ms < 0 or step_ms > self._layout.gap_ms or returned):
            gap = gap_entry(self.rows, last, frame, max(step_ms, on_host, 0), self._reason(step_ms, returned))
            self.gaps.append(gap)
        self._meter.push(came.device_ms)
        self.last = frame
        self.rows += 1
        return Came(frame, missing, gap)

    def heard(self) -> None:
        """All frames of one reading are in."""
        self._heard_s = time.monotonic()
        self._meter.heard(self._device.counters, self._heard_s)

    def _reason(self, step_ms: int, returned: bool) -> str:
        if returned:
            known = [gap.reason for gap in getattr(self._device, "gaps", ())]
            return known[-1] if known and known[-1] else "the toy was away and came back"
        return "the toy's clock began anew" if step_ms < 0 else "nothing came"
