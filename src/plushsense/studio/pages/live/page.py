"""Build the live page, which shows the signals of a toy, the predictions of a bundle and events as they happen."""

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
from plushsense.recording.recorder import is_virtual
from plushsense.runtime.decisions import DecideSpec
from plushsense.studio.app.guard import is_loopback
from plushsense.studio.app.shell import (
    AFFECT_COLOURS,
    AFFECT_SIGNS,
    LINES,
    Page,
    button,
    on_change,
    query,
    query_path,
    tag,
)
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import VIRTUAL, Workspace
from plushsense.studio.pages.live import clips_page, feedback_page
from plushsense.studio.pages.live.clips import Clips
from plushsense.studio.pages.live.reader import EventSpan, LatestAnswer, LiveChoice, LiveReader, LiveState

WINDOW_S = 8.0
"""Length of the displayed signals, in seconds."""
STRIP_S = 60.0
"""Length of the time line of events, in seconds."""
PACE_S = 0.04
"""Minimum time between two messages to a page; less than the 50 ms between two decisions in real time."""
_MAX_BEHIND = 60
"""Number of unconfirmed messages after which sending pauses; a page confirms messages about once a second."""

Message = dict[str, Any]


class Feed:
    """Source of the messages for one page; it tracks what was sent and whether the page keeps up. Not thread-safe.

    Attributes:
        hidden: whether the page is in the background. It is then sent nothing, and afterwards the whole state.
        away: whether the connection is lost, which has the same effect.
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
        """Return the number of seconds until the next message may be sent."""
        return max(0.0, self._last + PACE_S - time.perf_counter())

    @property
    def holds(self) -> bool:
        """True if no message should be sent now, because the page is hidden, disconnected or too far behind."""
        return self.hidden or self.away or self._sent - self._seen > _MAX_BEHIND

    def seen(self, number: int) -> None:
        """Record that the page has drawn message ``number``."""
        if self._watched is not None and number >= self._watched[0]:
            self._round_ms = 1000.0 * (time.perf_counter() - self._watched[1])
            self._watched = None
        self._seen = max(self._seen, number)

    def again(self) -> None:
        """Make the next message contain the whole state, after the page was hidden or disconnected."""
        self._generation = -1
        self._seen = self._sent

    def scene(self) -> Message:
        """Return the whole state, for a page that opens or becomes visible, or after a change of toy or bundle."""
        reader = self._reader
        now, device, bundle = reader.now, reader.device, reader.bundle
        self._generation = now.generation
        self._change = 0
        scene: Message = {"window": WINDOW_S, "strip": STRIP_S, "simulated": reader.choice.simulated}
        scene |= {"channels": [], "classes": [], "gate_rules": 0}
        self._place = 0
        if device is not None and bundle is not None:
            channels = device.layout.channels
            scene["channels"] = [
                {"name": c.name, "unit": c.unit, "step": c.step, "offset": c.offset, "scale": c.scale} for c in channels
            ]
            scene["classes"] = [{"label": g.label, "affect": g.affect} for g in bundle.gestures.gestures]
            scene["gate_rules"] = len(DecideSpec.from_dict(bundle.decision).gate.rules)
            self._place = max(0, device.buffer.count - int(WINDOW_S * device.layout.rate_hz))
        self._rare = ()
        return scene | {"first": self._message(now)}

    def message(self) -> tuple[str, Message] | None:
        """Return the method to call in the browser and its argument, or None if nothing should be sent."""
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
            # Integer thousandths are precise enough for the length of a bar.
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
        # These values change rarely, so they are sent only after a change.
        rare = (now.running, now.message, now.state, now.gate, now.event, now.reaction)
        if rare != self._rare:
            self._rare = rare
            message["now"] = {
                "running": now.running,
                "message": now.message,
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


class LiveView(Element, component="live_view.js"):
    """Browser component that displays the messages of ``feed``, with texts from ``words``.

    Elements that are added to it are displayed below the current event.
    """

    def __init__(self, words: Words, feed: Feed) -> None:
        super().__init__()
        self._feed, self._words = feed, words
        self._props.update(
            words=words.table("live"),
            affects={key: words.affect(key) for key in AFFECT_COLOURS},
            signs=dict(AFFECT_SIGNS),
            colours=dict(AFFECT_COLOURS),
            lines=list(LINES),
            locale=words.language,
            # Latency can be measured only if browser and studio use the same clock.
            sameClock=is_loopback(context.client.ip),
            start=self._named(feed.scene()),
        )
        self.classes("w-full")
        self.on("seen", self._seen)
        self.on("visible", self._visible)

    def push(self) -> None:
        """Send the next message to the browser, if there is one."""
        if (due := self._feed.message()) is not None:
            method, message = due
            self.run_method(method, self._named(message) if method == "scene" else message)

    def _named(self, scene: Message) -> Message:
        """Add to ``scene`` the names of the gestures in the language of the page."""
        for gesture in scene["classes"]:
            gesture["name"] = self._words.gesture(gesture["label"])
        return scene

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


_GRID = "display: grid; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); gap: 12px"


def show(page: Page) -> None:
    """Build the page."""
    reader = page.workspace.part(LiveReader)
    words = page.words
    with ui.element("section").classes("ps-card w-full column no-wrap ps-small-gap"):
        _controls(page, reader)
    simulated = tag(ui.label(words("shell.simulation")).classes("ps-message ps-message-warning w-full"), "simulation")

    def update_mark() -> None:
        simulated.set_visibility(reader.device is not None and reader.choice.simulated)

    on_change(reader.changed, update_mark)
    update_mark()
    feed = Feed(reader)
    view = LiveView(words, feed)
    with view:
        feedback_page.show(page, reader)
    _follow(view, feed, reader)
    clips_page.show(page, reader)
    clips = page.workspace.part(Clips)
    context.client.on_delete(reader.add_viewer(lambda: bool(clips.recording)))


def _follow(view: LiveView, feed: Feed, reader: LiveReader) -> None:
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


def _controls(page: Page, reader: LiveReader) -> None:  # noqa: C901
    words, workspace = page.words, page.workspace
    toys = workspace.part(Toys)
    choice = reader.choice
    bundles = {str(path): path.stem for path in workspace.bundles()}
    chosen = str(choice.bundle) if choice.bundle else None
    if chosen is None or (query().get("model") and not reader.now.running):
        chosen = query_path(workspace, "model", bundles) or None
    first = choice.toy if reader.now.running else workspace.toy or VIRTUAL
    with ui.element("div").classes("w-full").style(_GRID):
        toy = ui.select(
            _toy_options(toys, workspace, first),
            value=first,
            label=words("live.toy"),
            with_input=True,
            new_value_mode="add-unique",
        )
        tag(toy.props(f'hint="{words("live.toy_hint")}"'), "toy")
        bundle = tag(ui.select(bundles, value=chosen, label=words("live.bundle")), "bundle")
        engines = {"float": words("live.engine_float"), "int8": words("live.engine_int8")}
        engine = tag(ui.select(engines, value=choice.engine, label=words("live.engine")), "engine")
        names = {"": words("live.reactions_none")}
        names |= {name: words.get(f"live.reactions_{name}", name) for name in reaction_names()}
        reactions = tag(ui.select(names, value=choice.reactions, label=words("live.reactions")), "reactions")
    with ui.row().classes("w-full items-center ps-small-gap"):
        start = button("start", words("live.start"), None, "unelevated", icon="play_arrow")
        stop = button("stop", words("live.stop"), icon="stop")
        look = button("look", words("live.look"), toys.search, "flat", icon="search")
        virtual = tag(ui.checkbox(words("live.simulated"), value=choice.simulated), "simulated")
        busy = tag(ui.spinner(size="1.6em").props("aria-hidden=true"), "busy")
    busy.set_visibility(False)

    async def run(command: Callable[..., None], *args: Any) -> bool:
        """Run ``command`` in a thread, show its errors on the page, and return whether it succeeded."""
        busy.set_visibility(True)
        page.say("")
        done = False
        with page.show_errors():
            await asyncio.to_thread(command, *args)
            done = True
        busy.set_visibility(False)
        return done

    async def begin() -> None:
        with page.show_errors():
            url = toys.choose(str(toy.value or ""))
            path = Path(bundle.value) if bundle.value else None
            await run(reader.start, LiveChoice(url, path, engine.value, reactions.value, bool(virtual.value)))

    async def change() -> None:
        # Also called when this page displays the choice made in another tab; then there is nothing to do.
        now = reader.choice
        selection = (Path(bundle.value) if bundle.value else None, engine.value, reactions.value)
        if selection != (now.bundle, now.engine, now.reactions) and not await run(reader.choose, *selection):
            follow()

    def follow() -> None:
        """Display the current choice, which may have been made in another tab."""
        now = reader.choice
        if now.bundle is not None:
            if str(now.bundle) not in bundles:
                bundles[str(now.bundle)] = now.bundle.stem
                bundle.set_options(bundles)
            bundle.set_value(str(now.bundle))
        engine.set_value(now.engine)
        reactions.set_value(now.reactions)
        if reader.now.running:
            toy.set_options(_toy_options(toys, workspace, now.toy), value=now.toy)
            virtual.set_value(now.simulated)

    state: tuple[Any, ...] = ("",)

    def update() -> None:
        # Called after every decision, mostly without a change.
        nonlocal state
        message, running = reader.now.problem or reader.now.message, reader.now.running
        if (message, running, reader.choice) == state:
            return
        start.set_visibility(not running)
        stop.set_visibility(running)
        for control in (toy, look, virtual):
            control.set_enabled(not running)
        if message or state[0]:
            page.say(message, "warning")
        state = (message, running, reader.choice)
        follow()

    def update_toys() -> None:
        busy.set_visibility(toys.searching)
        if not reader.now.running:
            toy.set_options(_toy_options(toys, workspace, str(toy.value or "")), value=toy.value)

    def update_simulated() -> None:
        if not reader.now.running:
            with contextlib.suppress(PlushSenseError):
                virtual.set_value(is_virtual(str(toy.value or "")))

    start.on_click(begin)
    stop.on_click(lambda: run(reader.stop))
    toy.on_value_change(update_simulated)
    for control in (bundle, engine, reactions):
        control.on_value_change(change)
    on_change(reader.changed, update)
    on_change(toys.changed, update_toys)
    update_simulated()
    update()


def _toy_options(toys: Toys, workspace: Workspace, url: str) -> dict[str, str]:
    """Return the toys to choose from (URL to text): ``url``, those given at start, the virtual one and those found."""
    known = {one: one for one in (url, workspace.toy, *workspace.devices, VIRTUAL) if one}
    return known | {d.url: f"{d.name or d.url}: {d.description}" for d in toys.listing.devices}
