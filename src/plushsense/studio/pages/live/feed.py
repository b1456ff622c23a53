"""Send the state of the live reader to the pages, and define the browser component that displays it."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from typing import Any

from nicegui import context
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from plushsense.core.errors import PlushSenseError
from plushsense.core.sentences import Message
from plushsense.runtime.decisions import DecideSpec
from plushsense.studio.app.guard import is_loopback
from plushsense.studio.app.shell import AFFECT_COLOURS, AFFECT_SIGNS, LINES, on_change
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.live.live_state import UNREAD, EventSpan, LiveState, Situation
from plushsense.studio.pages.live.reader import LiveReader

VIEW_TEXTS: Texts = {
    "signals": "Signals",
    "signals_label": "The {n} signals of the toy over the last {s} seconds, one lane each",
    "unit_count": "counts",
    "now": "Now",
    "timeline": "Events",
    "timeline_label": "The events of the last minute; the list below describes them in words",
    "events": "The last events, the newest first",
    "events_none": "No event yet.",
    "lasting": "still going on",
    "eyes_label": "Eyes of the toy",
    "latency": "Delay:",
    "latency_decision": "from the toy to the decision {ms}\u00a0ms",
    "latency_page": "to this page {ms}\u00a0ms (95\u00a0% are faster)",
    "latency_page_most": "to this page at most {ms}\u00a0ms (95\u00a0% are faster)",
    "chances": "What the network computes: the raw probability of each gesture",
    "chances_about": (
        "The toy does not react to these numbers, but to the events above, which are decided from them over some time."
    ),
    "by_gate": "noticed by the gate (threshold rules)",
    "by_network": "recognised by the network",
    "some_gesture": "A touch",
    "gate_none": "This network has no gate.",
    "gate_mark": "▸ begun by the gate, before the network was sure",
    "reacts_to": "reaction to: {what}",
    "really": "Really:",
    "really_nothing": "the virtual person does nothing",
    "really_next": "the virtual person is about to begin: {gesture}",
    "did_row": "Grey: what the virtual person really did.",
    "eyes_green": "Eyes green",
    "eyes_red": "Eyes red",
    "eyes_off": "Eyes off",
    "state_warming": "Warming up",
    "state_sensor_fault": "Sensor fault",
    "state_stopped": "Not started",
    "state_connecting": "Connecting …",
    "state_gone": "The toy is gone",
    "state_unreadable": "The toy cannot be read",
    "state_silent": "No signal from the toy",
    "state_nothing": "Nothing is happening",
    "state_unsure": "Not sure",
    "state_unknown": "Some touch that it does not know",
    "about_stopped": "Choose the toy and the network, and press Start.",
    "about_connecting": "Waiting for the first data of the toy.",
    "about_gone": "It was unplugged or switched off, or is out of reach. The studio connects again by itself.",
    "about_unreadable": (
        "It sends lines, but none is of the layout {layout} ({n} numbers) of this network. Choose a network for this "
        "toy, and check the cable."
    ),
    "about_silent": "It is connected but sends nothing. Check that it is switched on and charged.",
    "about_sensor_fault": "The sensor values cannot be trusted, so nothing is recognised. Check the toy and its cable.",
    "about_warming": "The network must read a few seconds before its first answer.",
    "about_nothing": "The network sees no gesture.",
    "about_unsure": "No gesture is clear enough for an event.",
    "about_unknown": "None of its gestures fits, so there is no event.",
    "quiet_off": "no reactions are chosen",
    "quiet_none": "the chosen reactions have none for this touch",
    "quiet_dark": "stays dark and silent, as chosen for this touch",
    "quiet_over": "the reaction to this touch is over",
    "quiet_named": "reacts as soon as the gesture is sure",
    "quiet_ended": "reacts when the touch ends",
    "quiet_pause": "pause after the last reaction",
    "sound_purr": "purring",
    "sound_shriek": "shrieking",
}
"""Texts that the script of the page shows; it finds them by these keys."""

WINDOW_S = 8.0
"""Length of the displayed signals, in seconds."""
STRIP_S = 60.0
"""Length of the time line of events, in seconds."""
PACE_S = 0.04
"""Minimum time between two messages to a page; less than the 50 ms between two decisions in real time."""
RATES_HZ = (1, 2, 5, 10, 20)
"""Rates to choose from: how often a page displays the decision, and how often it draws the signals."""
PLOT_HZ = 10
"""How often a page draws the signals unless another rate is chosen; their lines are most of what a browser draws."""
_CLOCK_S = 0.001
"""Tolerance of timers, in seconds."""
_MAX_BEHIND = 60
"""Number of unconfirmed messages after which sending pauses; a page confirms messages about once a second."""

FeedMessage = dict[str, Any]


class Feed:
    """Source of the messages for one page; it tracks what was sent and whether the page keeps up. Not thread-safe.

    Attributes:
        hidden: whether the page is in the background. It is then sent nothing, and afterwards the whole state.
        away: whether the connection is lost, which has the same effect.
        plot_s, decision_s: minimum time between two messages with signals, and with the decision of the network. A lost
            signal is sent at once.

    Args:
        explain: returns the sentence of an error in the language of the page.
    """

    def __init__(self, reader: LiveReader, explain: Callable[[PlushSenseError | Message], str] = str) -> None:
        self._reader, self._explain = reader, explain
        self.plot_s, self.decision_s = 1.0 / PLOT_HZ, PACE_S
        self.hidden = self.away = False
        self._generation = -1
        self._place = 0
        self._change = 0
        self._sent = self._seen = 0
        self._performed = 0
        self._plotted_at = self._decided_at = -math.inf
        self._rare: tuple[Any, ...] = ()
        self._round_ms: float | None = None
        self._watched: tuple[int, float] | None = None

    def wait_s(self) -> float:
        """Return the number of seconds until the next message may be sent."""
        due = min(self._plotted_at + self.plot_s, self._decided_at + self.decision_s)
        return max(0.0, due - time.perf_counter())

    @property
    def holds(self) -> bool:
        """True if no message should be sent now, because the page is hidden, disconnected or too far behind."""
        return self.hidden or self.away or self._sent - self._seen > _MAX_BEHIND

    def seen(self, number: int) -> None:
        """Record that the page has drawn message ``number``."""
        if self.holds:
            self._plotted_at = self._decided_at = -math.inf
        if self._watched is not None and number >= self._watched[0]:
            self._round_ms = 1000.0 * (time.perf_counter() - self._watched[1])
            self._watched = None
        # A page cannot have drawn what was not sent.
        self._seen = max(self._seen, min(number, self._sent))

    def again(self) -> None:
        """Make the next message contain the whole state, after the page was hidden or disconnected."""
        self._generation = -1
        self._seen = self._sent

    def scene(self) -> FeedMessage:
        """Return the whole state, for a page that opens or becomes visible, or after a change of toy or bundle."""
        reader = self._reader
        now, device, bundle = reader.now, reader.device, reader.bundle
        self._generation = now.generation
        self._change = self._performed = 0
        scene: FeedMessage = {"window": WINDOW_S, "strip": STRIP_S}
        scene |= {"channels": [], "classes": [], "gate_rules": 0, "layout": "", "numbers": 0, "person": False}
        self._place = 0
        if device is not None and bundle is not None:
            channels = device.layout.channels
            scene["channels"] = [
                {"name": c.name, "unit": c.unit, "step": c.step, "offset": c.offset, "scale": c.scale} for c in channels
            ]
            scene["classes"] = [{"label": g.label, "affect": g.affect} for g in bundle.gestures.gestures]
            scene |= {"layout": device.layout.name, "numbers": len(device.layout.wire)}
            scene["person"] = reader.person is not None
            scene["gate_rules"] = len(DecideSpec.from_dict(bundle.decision).gate.rules)
            self._place = max(0, device.buffer.count - int(WINDOW_S * device.layout.rate_hz))
        self._rare = ()
        return scene | {"first": self._message(now, True, True)}

    def message(self) -> tuple[str, FeedMessage] | None:
        """Return the method to call in the browser and its argument, or None if nothing should be sent."""
        if self.holds:
            return None
        now, host = self._reader.now, time.perf_counter() + _CLOCK_S
        decision = host >= self._decided_at + self.decision_s or now.situation.kind in UNREAD
        # Signals that are nearly due go with a decision, and need no message of their own.
        plot = host >= self._plotted_at + self.plot_s - (PACE_S / 2.0 if decision else 0.0)
        if now.generation != self._generation:
            plot = decision = True
        if plot:
            self._plotted_at = host
        if decision:
            self._decided_at = host
        if now.generation != self._generation:
            return "scene", self.scene()
        return ("update", self._message(now, plot, decision)) if plot or decision else None

    def _message(self, now: LiveState, plot: bool, decision: bool) -> FeedMessage:
        """Return the signals, the decision, or both, as far as the page does not have them."""
        device = self._reader.device
        self._sent += 1
        if self._watched is None:
            self._watched = (self._sent, time.perf_counter())
        message: FeedMessage = {
            "n": self._sent,
            "t": round(now.t_s, 3),
            "at": round(1000.0 * now.arrived, 2),
            "out": round(1000.0 * time.time(), 2),
        }
        if plot and device is not None:
            piece = device.buffer.since(self._place, int(WINDOW_S * device.layout.rate_hz))
            self._place = piece.end
            message["x"] = [round(s, 3) for s in piece.seconds.tolist()]
            message["y"] = piece.values.astype(int).T.tolist()
        if now.latency_s is not None:
            message["lat"] = round(1000.0 * now.latency_s, 2)
        if self._round_ms is not None:
            message["round"] = round(self._round_ms, 1)
        return message | self._decision(now) if decision else message

    def _decision(self, now: LiveState) -> FeedMessage:
        # Integer thousandths are precise enough for the length of a bar.
        shares = now.probabilities
        message: FeedMessage = {"p": None if shares is None else [round(1000.0 * p) for p in shares]}
        if now.changes > self._change:
            message["spans"] = [_span(s) for s in self._reader.spans(self._change)]
            self._change = now.changes
        if now.performed > self._performed:
            made = enumerate(self._reader.performed(self._performed), self._performed + 1)
            message["did"] = [
                {"id": number, "from": round(p.start_s, 2), "to": round(p.end_s, 2), "label": p.label}
                for number, p in made
            ]
            self._performed = now.performed
        # These values change rarely, so they are sent only after a change.
        situation = _situation(now.situation)
        unread = now.mismatch if now.situation.kind == "unreadable" else Message()
        warnings = [self._explain(each) for each in now.warnings if each != now.mismatch]
        rare = (situation, now.ended, now.next_gesture, unread, warnings)
        if rare != self._rare:
            self._rare = rare
            message["now"] = {
                **situation,
                "why": self._explain(now.ended or unread) if now.ended or unread else "",
                "warnings": warnings,
                "next": now.next_gesture,
            }
        return message


def _situation(situation: Situation) -> FeedMessage:
    sure = None if situation.confidence is None else round(100.0 * situation.confidence)
    return {**vars(situation), "confidence": sure}


def _span(span: EventSpan) -> FeedMessage:
    return {
        "id": span.number,
        "from": round(span.begin_s, 2),
        "to": None if span.end_s is None else round(span.end_s, 2),
        "affect": span.affect,
        "gesture": span.gesture,
        "source": span.source,
        "sure": None if span.confidence is None else round(100.0 * span.confidence),
        "eyes": span.eyes,
        "sound": span.sound,
    }


class LiveView(Element, component="live_view.js"):
    """Browser component that displays the messages of ``feed``, with texts from ``words``.

    Elements that are added to it are displayed beside the current event.
    """

    def __init__(self, words: Words, feed: Feed) -> None:
        super().__init__()
        self._feed = feed
        self._props.update(
            words={key: words(text) for key, text in VIEW_TEXTS.items()},
            gestures=words.names("gesture"),
            names=words.names("channel"),
            affects={key: words.affect(key) for key in AFFECT_COLOURS},
            signs=dict(AFFECT_SIGNS),
            colours=dict(AFFECT_COLOURS),
            lines=list(LINES),
            locale=words.language,
            # Latency can be measured only if browser and studio use the same clock.
            sameClock=is_loopback(context.client.ip),
            start=feed.scene(),
        )
        self.classes("w-full")
        self.on("seen", self._seen)
        self.on("visible", self._visible)

    def push(self) -> None:
        """Send the next message to the browser, if there is one."""
        if (due := self._feed.message()) is not None:
            self.run_method(*due)

    def _seen(self, event: GenericEventArguments) -> None:
        held_back = self._feed.holds
        self._feed.seen(int(event.args["n"]))
        if held_back:
            # If the toy has stopped sending, no change would trigger the withheld message, so send it now.
            self.push()

    def _visible(self, event: GenericEventArguments) -> None:
        visible = bool(event.args["on"])
        if visible and self._feed.hidden:
            self._feed.hidden = False
            self._feed.again()
            self.push()
        self._feed.hidden = not visible


def follow(view: LiveView, feed: Feed, reader: LiveReader) -> None:
    """Push a message to the view after each change, at most every `PACE_S`, and not while it is disconnected."""
    client = context.client
    loop = asyncio.get_running_loop()
    timer: asyncio.TimerHandle | None = None

    def push() -> None:
        nonlocal timer
        timer = None
        if not client.has_socket_connection:
            feed.away = True
            return
        with client:
            view.push()

    def update() -> None:
        nonlocal timer
        if timer is not None:
            return
        if (wait_s := feed.wait_s()) > 0.0:
            timer = loop.call_later(wait_s, push)
        else:
            push()

    def connected() -> None:
        if feed.away:
            feed.away = False
            feed.again()
        push()

    def deleted() -> None:
        if timer is not None:
            timer.cancel()

    on_change(reader.changed, update)
    client.on_connect(connected)
    client.on_delete(deleted)
