"""The live view in the page: signals, bars, eyes, time line, all drawn by one component from small messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import context
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from plushsense.apps.studio.feeding import Feed, Message
from plushsense.apps.studio.guard import is_loopback
from plushsense.apps.studio.shell import AFFECT_COLOURS, AFFECT_SIGNS, LINES
from plushsense.apps.studio.words import Words

WORDS = (
    "signals",
    "signals_label",
    "network",
    "gate",
    "gate_none",
    "gate_quiet",
    "gate_ago",
    "gate_mark",
    "now",
    "nothing",
    "chances",
    "timeline",
    "timeline_label",
    "events",
    "events_none",
    "by_gate",
    "by_network",
    "lasting",
    "eyes_label",
    "eyes_green",
    "eyes_red",
    "eyes_off",
    "state_warming",
    "state_tracking",
    "state_no_signal",
    "state_sensor_fault",
    "state_stopped",
    "answer_sure",
    "answer_affect",
    "answer_unsure",
    "answer_unknown",
    "answer_idle",
    "answer_none",
    "latency",
    "latency_decision",
    "latency_page",
    "latency_page_most",
    "some_gesture",
    "unit_count",
)
"""Keys of the table ``live`` that the component says."""


class LiveView(Element, component="live_view.js"):
    """Draws what a `Feed` sends.

    Args:
        words: of the page.
        feed: what it is to draw.
        on_seen: called once a second with the page's own figures (for tests and the curious).
    """

    def __init__(self, words: Words, feed: Feed, on_seen: Callable[[dict[str, Any]], None] | None = None) -> None:
        super().__init__()
        self._feed = feed
        self._on_seen = on_seen
        self._props["words"] = {key: words(f"live.{key}") for key in WORDS}
        self._props["affects"] = {key: words.affect(key) for key in AFFECT_COLOURS}
        self._props["signs"] = dict(AFFECT_SIGNS)
        self._props["colours"] = dict(AFFECT_COLOURS)
        self._props["lines"] = list(LINES)
        self._props["locale"] = words.language
        # Another machine's clock says nothing about ours.
        self._props["sameClock"] = is_loopback(context.client.ip)
        self._words = words
        self._props["start"] = self._named(feed.scene())
        self.classes("w-full")
        self.on("seen", self._seen)
        self.on("visible", self._visible)

    def push(self) -> None:
        """Send what is new."""
        due = self._feed.message()
        if due is None:
            return
        what, message = due
        self.run_method(what, self._named(message) if what == "scene" else message)

    def _named(self, scene: Message) -> Message:
        """The scene with the gestures' names in the page's language."""
        for one in scene["classes"]:
            one["name"] = self._words.gesture(one["label"])
        return scene

    def _seen(self, event: GenericEventArguments) -> None:
        told = dict(event.args)
        self._feed.seen(int(told["n"]))
        if self._on_seen is not None:
            self._on_seen(told)

    def _visible(self, event: GenericEventArguments) -> None:
        visible = bool(event.args["on"])
        if visible and self._feed.hidden:
            self._feed.hidden = False
            self._feed.again()
            self.push()
        self._feed.hidden = not visible
