"""Live: a toy read by a bundle, and everything that both say, as it happens."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

from nicegui import context, ui

from plushsense.apps.studio.clips import Clips
from plushsense.apps.studio.feeding import Feed
from plushsense.apps.studio.felt import Choice
from plushsense.apps.studio.house import VIRTUAL, House
from plushsense.apps.studio.listening import Listening
from plushsense.apps.studio.live_view import LiveView
from plushsense.apps.studio.pages import live_clips
from plushsense.apps.studio.shell import Page, asked, asked_path, on_ring, tag
from plushsense.apps.studio.toys import Toys
from plushsense.core.errors import PlushSenseError
from plushsense.live.react import reaction_names
from plushsense.recording.toy import is_virtual

_GRID = "display: grid; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); gap: 12px"


def show(page: Page) -> None:
    """Build the page."""
    listening = page.house.part(Listening)
    words = page.words
    with ui.element("section").classes("ps-card w-full column no-wrap ps-tight"):
        _controls(page, listening)
    simulated = tag(ui.label(words("shell.simulation")).classes("ps-said ps-said-warning w-full"), "simulation")

    def mark() -> None:
        device = listening.device
        simulated.set_visibility(device is not None and listening.choice.simulated)

    on_ring(listening.bell, mark)
    mark()
    feed = Feed(listening)
    view = LiveView(words, feed)
    _follow(view, feed, listening)
    live_clips.show(page, listening)
    clips = page.house.part(Clips)
    context.client.on_delete(listening.look(lambda: bool(clips.recording)))


def _follow(view: LiveView, feed: Feed, listening: Listening) -> None:
    """Push to the view after every ring, no faster than its pace; nothing while it cannot take it."""
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

    def rung() -> None:
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

    on_ring(listening.bell, rung)
    client.on_connect(back)

    def gone() -> None:
        for handle in waits:
            handle.cancel()

    client.on_delete(gone)


def _controls(page: Page, listening: Listening) -> None:
    words, house = page.words, page.house
    toys = house.part(Toys)
    choice = listening.choice
    bundles = {str(path): path.stem for path in house.bundles()}
    chosen = str(choice.bundle) if choice.bundle else None
    if chosen is None or (asked("model") and not listening.now.running):
        chosen = asked_path(house, "model", bundles) or None
    first = choice.toy if listening.now.running else house.toy or VIRTUAL
    with ui.element("div").classes("w-full").style(_GRID):
        toy = ui.select(
            _named(toys, house, first),
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
        look = tag(ui.button(words("live.look"), icon="search", on_click=toys.look).props("flat no-caps"), "look")
        virtual = tag(ui.checkbox(words("live.simulated"), value=choice.simulated), "simulated")
        busy = tag(ui.spinner(size="1.6em").props("aria-hidden=true"), "busy")
    busy.set_visibility(False)

    async def working(what: Any, *args: Any) -> bool:
        """Run a command beside the loop; whether it was taken."""
        busy.set_visibility(True)
        page.say("")
        taken = False
        with page.refusing():
            await asyncio.to_thread(what, *args)
            taken = True
        busy.set_visibility(False)
        return taken

    async def begin() -> None:
        with page.refusing():
            url = toys.choose(str(toy.value or ""))
            path = Path(bundle.value) if bundle.value else None
            await working(listening.start, Choice(url, path, engine.value, reactions.value, bool(virtual.value)))

    async def other() -> None:
        # Also called when a page follows what another tab chose: then there is nothing to do.
        now = listening.choice
        wanted = (Path(bundle.value) if bundle.value else None, engine.value, reactions.value)
        if wanted != (now.bundle, now.engine, now.reactions) and not await working(listening.choose, *wanted):
            follow()

    def follow() -> None:
        """Show what is chosen, whoever chose it."""
        now = listening.choice
        if now.bundle is not None:
            if str(now.bundle) not in bundles:
                bundles[str(now.bundle)] = now.bundle.stem
                bundle.set_options(bundles)
            bundle.set_value(str(now.bundle))
        engine.set_value(now.engine)
        reactions.set_value(now.reactions)
        if listening.now.running:
            toy.set_options(_named(toys, house, now.toy), value=now.toy)
            virtual.set_value(now.simulated)

    def changed(before: list[Any]) -> None:
        running = listening.now.running
        start.set_visibility(not running)
        stop.set_visibility(running)
        for control in (toy, look, virtual):
            control.set_enabled(not running)
        if said := listening.now.trouble or listening.now.said:
            page.say(said, "warning")
        elif before and before[0]:
            page.say("")

    state: list[Any] = []

    def rung() -> None:
        # At every decision, too: mostly there is nothing new here.
        seen = [listening.now.trouble or listening.now.said, listening.now.running, listening.choice]
        if seen != state:
            changed(state)
            state[:] = seen
            follow()

    def listed() -> None:
        busy.set_visibility(toys.looking)
        if not listening.now.running:
            toy.set_options(_named(toys, house, str(toy.value or "")), value=toy.value)

    def simulated() -> None:
        if not listening.now.running:
            with contextlib.suppress(PlushSenseError):
                virtual.set_value(is_virtual(str(toy.value or "")))

    start.on_click(begin)
    stop.on_click(lambda: working(listening.stop))
    toy.on_value_change(simulated)
    for control in (bundle, engine, reactions):
        control.on_value_change(other)
    on_ring(listening.bell, rung)
    on_ring(toys.bell, listed)
    simulated()
    rung()


def _named(toys: Toys, house: House, url: str) -> dict[str, str]:
    """The toys that were named, the one at ``url``, the virtual one, and those that were found."""
    named = {one: one for one in (url, house.toy, *house.devices, VIRTUAL) if one}
    return named | {d.url: f"{d.name or d.url}: {d.description}" for d in toys.listing.devices}
