"""Live page: shows the signals of a toy, the answers of a bundle, and events as they happen."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import context, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from plushsense.core.errors import PlushSenseError
from plushsense.live.reactions import reaction_names
from plushsense.recording.setup import is_virtual
from plushsense.runtime.decisions import DecideSpec
from plushsense.studio.app.guard import is_loopback
from plushsense.studio.app.shell import (
    AFFECT_COLOURS,
    AFFECT_SIGNS,
    LINES,
    Page,
    on_change,
    query_path,
    query_value,
    tag,
)
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import VIRTUAL, Workspace
from plushsense.studio.pages.live import clips_page
from plushsense.studio.pages.live.clips import Clips
from plushsense.studio.pages.live.reader import EventSpan, LatestAnswer, LiveChoice, LiveReader, LiveState

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
    """Messages for one page: what it was sent already, and whether it keeps up. For use in one thread only.

    Attributes:
        hidden: the page is in the background: it gets nothing, and all anew when it is seen again.
        away: the connection is lost; likewise.
    """

    def __init__(self, reader: LiveReader) -> None:
        self._reader = reader
        self.hidden = self.away = False
        self._generation = -1
        self._place = 0
        self._change = 0
        self._sent = self._seen = 0
        self._last = 0.0
        self._rare: tuple[Any, ...] = ()
        self._round_ms: float | None = None
        self._watched: tuple[int, float] | None = None

    def wait_s(self) -> float:
        """Return the time until the next message may be sent."""
        return max(0.0, self._last + PACE_S - time.perf_counter())

    @property
    def holds(self) -> bool:
        """True if the page should be sent nothing now."""
        return self.hidden or self.away or self._sent - self._seen > _AHEAD

    def seen(self, number: int) -> None:
        """Note that the page has drawn message ``number``."""
        if self._watched is not None and number >= self._watched[0]:
            self._round_ms = 1000.0 * (time.perf_counter() - self._watched[1])
            self._watched = None
        self._seen = max(self._seen, number)

    def again(self) -> None:
        """Send everything anew after the page was hidden or disconnected."""
        self._generation = -1
        self._seen = self._sent

    def scene(self) -> Message:
        """Return the whole state, for a page that opens, comes back, or sees another toy or bundle."""
        reader = self._reader
        now, device, bundle = reader.now, reader.device, reader.bundle
        self._generation = now.generation
        self._change = 0
        scene: Message = {
            "window": WINDOW_S,
            "strip": STRIP_S,
            "channels": [],
            "classes": [],
            "gate_rules": 0,
            "simulated": reader.choice.simulated,
        }
        if device is not None and bundle is not None:
            channels = device.layout.channels
            scene["channels"] = [
                {"name": c.name, "unit": c.unit, "step": c.step, "offset": c.offset, "scale": c.scale} for c in channels
            ]
            scene["classes"] = [{"label": g.label, "affect": g.affect} for g in bundle.gestures.gestures]
            scene["gate_rules"] = len(DecideSpec.from_dict(bundle.decision).gate.rules)
            rate = device.layout.rate_hz
            self._place = max(0, device.buffer.count - int(WINDOW_S * rate))
        else:
            self._place = 0
        self._rare = ()
        return scene | {"first": self._message(now)}

    def message(self) -> tuple[str, Message] | None:
        """Return the method to call in the page and its argument; None if nothing should be sent."""
        if self.holds:
            return None
        now = self._reader.now
        self._last = time.perf_counter()
        if now.generation != self._generation:
            return "scene", self.scene()
        return "update", self._message(now)

    def _message(self, now: LiveState) -> Message:
        device = self._reader.device
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
            piece = device.buffer.since(self._place, int(WINDOW_S * device.layout.rate_hz))
            self._place = piece.end
            message["x"] = [round(s, 3) for s in piece.seconds.tolist()]
            message["y"] = piece.values.astype(int).T.tolist()
        if now.probabilities is not None:
            # Whole thousandths: what a bar can show.
            message["p"] = [round(1000.0 * p) for p in now.probabilities]
        if now.network is not None:
            message["net"] = _answer(now.network)
        if now.latency_s is not None:
            message["lat"] = round(1000.0 * now.latency_s, 2)
        if self._round_ms is not None:
            message["round"] = round(self._round_ms, 1)
        if now.changes > self._change:
            message["spans"] = [_span(s) for s in self._reader.spans(self._change)]
            self._change = now.changes
        # Sent only when it changed, which is rare.
        rare = (now.running, now.message, now.state, now.gate, now.event, now.reaction)
        if rare != self._rare:
            self._rare = rare
            message["now"] = {
                "running": now.running,
                "said": now.message,
                "state": now.state,
                "gate": _answer(now.gate),
                "event": None if now.event is None else _span(now.event),
                "eyes": now.reaction.eyes if now.reaction else "off",
                "sound": now.reaction.sound if now.reaction else "",
            }
        return message


def _answer(answer: LatestAnswer | None) -> Message | None:
    if answer is None:
        return None
    return {
        "t": round(answer.t_s, 2),
        "affect": answer.affect,
        "gesture": answer.gesture,
        "sure": None if answer.confidence is None else round(100.0 * answer.confidence),
        "answer": answer.answer,
    }


def _span(span: EventSpan) -> Message:
    return {
        "id": span.number,
        "from": round(span.begin_s, 2),
        "to": None if span.end_s is None else round(span.end_s, 2),
        "affect": span.affect,
        "gesture": span.gesture,
        "source": span.source,
    }


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
        # Latencies can only be measured on the same clock.
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
        """Add the gestures' names in the page's language to the scene."""
        for one in scene["classes"]:
            one["name"] = self._words.gesture(one["label"])
        return scene

    def _seen(self, event: GenericEventArguments) -> None:
        figures = dict(event.args)
        self._feed.seen(int(figures["n"]))
        if self._on_seen is not None:
            self._on_seen(figures)

    def _visible(self, event: GenericEventArguments) -> None:
        visible = bool(event.args["on"])
        if visible and self._feed.hidden:
            self._feed.hidden = False
            self._feed.again()
            self.push()
        self._feed.hidden = not visible


_GRID = "display: grid; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); gap: 12px"


def show(page: Page) -> None:
    """Build the page."""
    reader = page.workspace.part(LiveReader)
    words = page.words
    with ui.element("section").classes("ps-card w-full column no-wrap ps-tight"):
        _controls(page, reader)
    simulated = tag(ui.label(words("shell.simulation")).classes("ps-said ps-said-warning w-full"), "simulation")

    def mark() -> None:
        device = reader.device
        simulated.set_visibility(device is not None and reader.choice.simulated)

    on_change(reader.changed, mark)
    mark()
    feed = Feed(reader)
    view = LiveView(words, feed)
    _follow(view, feed, reader)
    clips_page.show(page, reader)
    clips = page.workspace.part(Clips)
    context.client.on_delete(reader.add_viewer(lambda: bool(clips.recording)))


def _follow(view: LiveView, feed: Feed, reader: LiveReader) -> None:
    """Push to the view after every change, no faster than its pace; nothing while it cannot take it."""
    client = context.client
    loop = asyncio.get_running_loop()
    waits: list[asyncio.TimerHandle] = []

    def push() -> None:
        waits.clear()
        if not client.has_socket_connection:
            feed.away = True
            return
        with client:
            view.push()

    def update() -> None:
        if waits:
            return
        wait_s = feed.wait_s()
        if wait_s > 0.0:
            waits.append(loop.call_later(wait_s, push))
        else:
            push()

    def back() -> None:
        if feed.away:
            feed.away = False
            feed.again()
        push()

    on_change(reader.changed, update)
    client.on_connect(back)

    def gone() -> None:
        for handle in waits:
            handle.cancel()

    client.on_delete(gone)


def _controls(page: Page, reader: LiveReader) -> None:  # noqa: C901
    words, workspace = page.words, page.workspace
    toys = workspace.part(Toys)
    choice = reader.choice
    bundles = {str(path): path.stem for path in workspace.bundles()}
    chosen = str(choice.bundle) if choice.bundle else None
    if chosen is None or (query_value("model") and not reader.now.running):
        chosen = query_path(workspace, "model", bundles) or None
    first = choice.toy if reader.now.running else workspace.toy or VIRTUAL
    with ui.element("div").classes("w-full").style(_GRID):
        toy = ui.select(
            _named(toys, workspace, first),
            value=first,
            label=words("live.toy"),
            with_input=True,
            new_value_mode="add-unique",
        )
        hint = words("live.toy_hint")
        tag(toy.props(f'outlined dense hint="{hint}"'), "toy")
        bundle = ui.select(bundles, value=chosen, label=words("live.bundle"))
        tag(bundle.props("outlined dense"), "bundle")
        engines = {"float": words("live.engine_float"), "int8": words("live.engine_int8")}
        engine = ui.select(engines, value=choice.engine, label=words("live.engine"))
        tag(engine.props("outlined dense"), "engine")
        answers = {"": words("live.reactions_none")} | {
            name: words(f"live.reactions_{name}") if words.has(f"live.reactions_{name}") else name
            for name in reaction_names()
        }
        reactions = ui.select(answers, value=choice.reactions, label=words("live.reactions"))
        tag(reactions.props("outlined dense"), "reactions")
    with ui.row().classes("w-full items-center ps-tight"):
        start = tag(ui.button(words("live.start"), icon="play_arrow").props("unelevated no-caps"), "start")
        stop = tag(ui.button(words("live.stop"), icon="stop").props("outline no-caps"), "stop")
        look = tag(ui.button(words("live.look"), icon="search", on_click=toys.search).props("flat no-caps"), "look")
        virtual = tag(ui.checkbox(words("live.simulated"), value=choice.simulated), "simulated")
        busy = tag(ui.spinner(size="1.6em").props("aria-hidden=true"), "busy")
    busy.set_visibility(False)

    async def working(what: Any, *args: Any) -> bool:
        """Run a command beside the loop; whether it was taken."""
        busy.set_visibility(True)
        page.say("")
        taken = False
        with page.show_errors():
            await asyncio.to_thread(what, *args)
            taken = True
        busy.set_visibility(False)
        return taken

    async def begin() -> None:
        with page.show_errors():
            url = toys.choose(str(toy.value or ""))
            path = Path(bundle.value) if bundle.value else None
            await working(reader.start, LiveChoice(url, path, engine.value, reactions.value, bool(virtual.value)))

    async def other() -> None:
        # Also called when the page follows another tab's choice, with nothing to do.
        now = reader.choice
        selection = (Path(bundle.value) if bundle.value else None, engine.value, reactions.value)
        if selection != (now.bundle, now.engine, now.reactions) and not await working(reader.choose, *selection):
            follow()

    def follow() -> None:
        """Show what is chosen, whoever chose it."""
        now = reader.choice
        if now.bundle is not None:
            if str(now.bundle) not in bundles:
                bundles[str(now.bundle)] = now.bundle.stem
                bundle.set_options(bundles)
            bundle.set_value(str(now.bundle))
        engine.set_value(now.engine)
        reactions.set_value(now.reactions)
        if reader.now.running:
            toy.set_options(_named(toys, workspace, now.toy), value=now.toy)
            virtual.set_value(now.simulated)

    def changed(before: list[Any]) -> None:
        running = reader.now.running
        start.set_visibility(not running)
        stop.set_visibility(running)
        for control in (toy, look, virtual):
            control.set_enabled(not running)
        if message := reader.now.problem or reader.now.message:
            page.say(message, "warning")
        elif before and before[0]:
            page.say("")

    state: list[Any] = []

    def update() -> None:
        # Called at every decision, mostly without a change.
        seen = [reader.now.problem or reader.now.message, reader.now.running, reader.choice]
        if seen != state:
            changed(state)
            state[:] = seen
            follow()

    def listed() -> None:
        busy.set_visibility(toys.searching)
        if not reader.now.running:
            toy.set_options(_named(toys, workspace, str(toy.value or "")), value=toy.value)

    def simulated() -> None:
        if not reader.now.running:
            with contextlib.suppress(PlushSenseError):
                virtual.set_value(is_virtual(str(toy.value or "")))

    start.on_click(begin)
    stop.on_click(lambda: working(reader.stop))
    toy.on_value_change(simulated)
    for control in (bundle, engine, reactions):
        control.on_value_change(other)
    on_change(reader.changed, update)
    on_change(toys.changed, listed)
    simulated()
    update()


def _named(toys: Toys, workspace: Workspace, url: str) -> dict[str, str]:
    """Return the toys to choose from: those named at start, ``url``, the virtual one, and those that were found."""
    named = {one: one for one in (url, workspace.toy, *workspace.devices, VIRTUAL) if one}
    return named | {d.url: f"{d.name or d.url}: {d.description}" for d in toys.listing.devices}
