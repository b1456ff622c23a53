"""What one open live page is sent: small messages at its own pace, and everything anew when it has missed some."""

from __future__ import annotations

import time
from typing import Any

from plushsense.apps.studio.felt import Now, Span, Voice
from plushsense.apps.studio.listening import Listening
from plushsense.live.decide import DecideSpec

WINDOW_S = 8.0
"""Seconds of signals on a page."""
STRIP_S = 60.0
"""Seconds of events on its time line."""
PACE_S = 0.04
"""Between two messages at least; a bundle that decides every 50 ms at real time is never held back."""
_AHEAD = 60
"""Messages that a page may be behind before it is sent nothing more; it says once a second how far it is."""
LISTED = 20
"""Events in the list for reading."""

Message = dict[str, Any]


class Feed:
    """The view of one page on a `Listening`: what it was sent already, and whether it keeps up. One thread only.

    Attributes:
        hidden: the page is in the background: it gets nothing, and all anew when it is seen again.
        away: the connection is lost; likewise.
    """

    def __init__(self, listening: Listening) -> None:
        self._listening = listening
        self.hidden = self.away = False
        self._generation = -1
        self._place = 0
        self._change = 0
        self._sent = self._seen = 0
        self._last = 0.0
        self._said: tuple[Any, ...] = ()
        self._round_ms: float | None = None
        self._watched: tuple[int, float] | None = None

    def wait_s(self) -> float:
        """How long until the next message may go."""
        return max(0.0, self._last + PACE_S - time.perf_counter())

    @property
    def holds(self) -> bool:
        """Whether the page should be sent nothing now."""
        return self.hidden or self.away or self._sent - self._seen > _AHEAD

    def seen(self, number: int) -> None:
        """The page says which message it has drawn."""
        if self._watched is not None and number >= self._watched[0]:
            self._round_ms = 1000.0 * (time.perf_counter() - self._watched[1])
            self._watched = None
        self._seen = max(self._seen, number)

    def again(self) -> None:
        """Send everything anew: the page was away."""
        self._generation = -1
        self._seen = self._sent

    def scene(self) -> Message:
        """Everything there is, for a page that opens, comes back, or sees another toy or bundle."""
        listening = self._listening
        now, device, bundle = listening.now, listening.device, listening.bundle
        self._generation = now.generation
        self._change = 0
        scene: Message = {
            "window": WINDOW_S,
            "strip": STRIP_S,
            "channels": [],
            "classes": [],
            "gate_rules": 0,
            "simulated": listening.choice.simulated,
        }
        if device is not None and bundle is not None:
            channels = device.layout.channels
            scene["channels"] = [
                {"name": c.name, "unit": c.unit, "step": c.step, "offset": c.offset, "scale": c.scale} for c in channels
            ]
            scene["classes"] = [{"label": g.label, "affect": g.affect} for g in bundle.gestures.gestures]
            scene["gate_rules"] = len(DecideSpec.from_dict(bundle.decision).gate.rules)
            rate = device.layout.rate_hz
            self._place = max(0, device.ring.count - int(WINDOW_S * rate))
        else:
            self._place = 0
        self._said = ()
        return scene | {"first": self._message(now)}

    def message(self) -> tuple[str, Message] | None:
        """What to call in the page, and with what; None when it should be sent nothing."""
        if self.holds:
            return None
        now = self._listening.now
        self._last = time.perf_counter()
        if now.generation != self._generation:
            return "scene", self.scene()
        return "update", self._message(now)

    def _message(self, now: Now) -> Message:
        device = self._listening.device
        self._sent += 1
        if self._watched is None:
            self._watched = (self._sent, time.perf_counter())
        message: Message = {
            "n": self._sent,
            "t": round(now.t_s, 3),
            "at": round(1000.0 * now.arrived, 2),
            "out": round(1000.0 * time.time(), 2),
        }
        if device is not None:
            piece = device.ring.since(self._place, int(WINDOW_S * device.layout.rate_hz))
            self._place = piece.upto
            message["x"] = [round(s, 3) for s in piece.seconds.tolist()]
            message["y"] = piece.values.astype(int).T.tolist()
        if now.probabilities is not None:
            # Whole thousandths: what a bar can show.
            message["p"] = [round(1000.0 * p) for p in now.probabilities]
        if now.network is not None:
            message["net"] = _voice(now.network)
        if now.latency_s is not None:
            message["lat"] = round(1000.0 * now.latency_s, 2)
        if self._round_ms is not None:
            message["round"] = round(self._round_ms, 1)
        if now.changes > self._change:
            message["spans"] = [_span(s) for s in self._listening.spans(self._change)]
            self._change = now.changes
        # What rarely changes is only said when it did.
        said = (now.running, now.said, now.state, now.gate, now.event, now.reaction)
        if said != self._said:
            self._said = said
            message["now"] = {
                "running": now.running,
                "said": now.said,
                "state": now.state,
                "gate": _voice(now.gate),
                "event": None if now.event is None else _span(now.event),
                "eyes": now.reaction.eyes if now.reaction else "off",
                "sound": now.reaction.sound if now.reaction else "",
            }
        return message


def _voice(voice: Voice | None) -> Message | None:
    if voice is None:
        return None
    return {
        "t": round(voice.t_s, 2),
        "affect": voice.affect,
        "gesture": voice.gesture,
        "sure": None if voice.confidence is None else round(100.0 * voice.confidence),
        "answer": voice.answer,
    }


def _span(span: Span) -> Message:
    return {
        "id": span.number,
        "from": round(span.begin_s, 2),
        "to": None if span.end_s is None else round(span.end_s, 2),
        "affect": span.affect,
        "gesture": span.gesture,
        "source": span.source,
    }
