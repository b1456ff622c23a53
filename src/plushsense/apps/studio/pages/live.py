"""Live: a toy read by a bundle, and everything that both say, as it happens."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from nicegui import context, ui

from plushsense.apps.studio.feeding import Feed
from plushsense.apps.studio.house import VIRTUAL, House
from plushsense.apps.studio.listening import Choice, Listening
from plushsense.apps.studio.live_view import LiveView
from plushsense.apps.studio.pages import live_clips
from plushsense.apps.studio.shell import Page, on_ring, tag
from plushsense.core.signal import layout_names
from plushsense.devices.listing import list_devices
from plushsense.devices.opening import parse_url
from plushsense.live.react import reaction_names


def show(page: Page) -> None:
    """Build the page."""
    listening = page.house.part(Listening)
    words = page.words
    with ui.element("section").classes("ps-card w-full column no-wrap q-gutter-y-sm"):
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
    choice = listening.choice
    toys = _toys(house, choice)
    bundles = {str(path): path.stem for path in house.bundles()}
    chosen = str(choice.bundle) if choice.bundle else next(iter(bundles), None)
    with ui.row().classes("w-full items-end q-gutter-sm"):
        toy = ui.select(
            toys,
            value=choice.toy or house.toy or VIRTUAL,
            label=words("live.toy"),
            with_input=True,
            new_value_mode="add-unique",
        ).classes("col-12 col-md-4")
        tag(toy, "toy")
        look = ui.button(words("live.look"), icon="search").props("flat")
        tag(look, "look")
        bundle = ui.select(bundles, value=chosen, label=words("live.bundle")).classes("col-12 col-md-3")
        tag(bundle, "bundle")
        engines = {"float": words("live.engine_float"), "int8": words("live.engine_int8")}
        engine = ui.select(engines, value=choice.engine, label=words("live.engine")).classes("col-12 col-sm-3")
        tag(engine, "engine")
        reactions = {"": words("live.reactions_none")} | {
            name: words(f"live.reactions_{name}") if words.has(f"live.reactions_{name}") else name
            for name in reaction_names()
        }
        answers = ui.select(reactions, value=choice.reactions, label=words("live.reactions"))
        tag(answers, "reactions").classes("col-12 col-sm-3")
    with ui.row().classes("w-full items-center q-gutter-sm"):
        start = tag(ui.button(words("live.start"), icon="play_arrow"), "start")
        stop = tag(ui.button(words("live.stop"), icon="stop").props("outline"), "stop")
        virtual = tag(ui.checkbox(words("live.simulated"), value=choice.simulated), "simulated")
        busy = tag(ui.spinner(size="1.6em"), "busy")
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
            url = _allowed(house, str(toy.value or ""))
            wanted = Choice(
                url, Path(bundle.value) if bundle.value else None, engine.value, answers.value, bool(virtual.value)
            )
            await working(listening.start, wanted)

    async def other() -> None:
        # Also called when a page follows what another tab chose: then there is nothing to do.
        now = listening.choice
        wanted = (Path(bundle.value) if bundle.value else None, engine.value, answers.value)
        if wanted == (now.bundle, now.engine, now.reactions):
            return
        if not await working(listening.choose, *wanted):
            follow()

    def follow() -> None:
        now = listening.choice
        if now.bundle is not None and str(now.bundle) in bundle.options:
            bundle.set_value(str(now.bundle))
        engine.set_value(now.engine)
        answers.set_value(now.reactions)

    def changed() -> None:
        running = listening.now.running
        start.set_visibility(not running)
        stop.set_visibility(running)
        toy.set_enabled(not running)
        look.set_enabled(not running)
        virtual.set_enabled(not running)
        if said := listening.now.trouble or listening.now.said:
            page.say(said, "warning")
        elif state and state[0]:
            page.say("")

    state: list[Any] = []

    def rung() -> None:
        now = listening.now
        seen = [now.trouble or now.said, now.running, listening.choice]
        if seen != state:
            changed()
            state[:] = seen
            follow()

    async def search() -> None:
        busy.set_visibility(True)
        found = await asyncio.to_thread(list_devices)
        busy.set_visibility(False)
        toy.set_options(toys | {d.url: f"{d.name or d.url}: {d.description}" for d in found.devices}, value=toy.value)
        if found.notes:
            page.say(" ".join(found.notes))

    start.on_click(begin)
    stop.on_click(lambda: working(listening.stop))
    look.on_click(search)
    for control in (bundle, engine, answers):
        control.on_value_change(other)
    on_ring(listening.bell, rung)
    rung()


def _toys(house: House, choice: Choice) -> dict[str, str]:
    """The toys that were named, each once, and the virtual one."""
    named = dict.fromkeys(t for t in (choice.toy, house.toy, *house.devices, VIRTUAL) if t)
    return {url: url for url in named}


def _allowed(house: House, url: str) -> str:
    """A toy's address as typed in a browser: a file that it names must lie in the studio's folders.

    Raises:
        ConfigError: for an address that is none, or a file elsewhere.
    """
    address = parse_url(url)
    if url in (*house.devices, house.toy):
        return url
    if address.scheme == "replay":
        house.inside(address.place)
    layout = address.query.get("layout", "")
    if layout and layout not in layout_names():
        house.inside(layout)
    return url
