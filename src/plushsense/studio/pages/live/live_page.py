"""Build the live page, which shows the signals of a toy, the predictions of a bundle and events as they happen."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import context, run, ui

from plushsense.core.errors import BundleError, ConfigError, PlushSenseError
from plushsense.core.layouts import layout_names
from plushsense.dataset.store import DatasetHead
from plushsense.devices.opening import is_virtual
from plushsense.live.reactions import reaction_names
from plushsense.studio.app.shell import Page, button, named, on_change, query, query_path, tag
from plushsense.studio.app.stored_results import ResultRow, StoredResults, recommended
from plushsense.studio.app.toys import ToyInUseError, Toys, described
from plushsense.studio.app.words import Texts, in_context
from plushsense.studio.app.workspace import VIRTUAL
from plushsense.studio.pages.live import adapting, trial, validation_page
from plushsense.studio.pages.live.event_log import SIMULATIONS, LogButtons
from plushsense.studio.pages.live.feed import PACE_S, PLOT_HZ, RATES_HZ, Feed, LiveView, follow
from plushsense.studio.pages.live.live_state import LiveChoice
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.signal_recording import SignalRecording
from plushsense.studio.widgets.elements import notice, style, summary
from plushsense.studio.widgets.verdict import show_choice

_REACTIONS: Texts = {
    "standard": "green, or red if rough",
    "gentle": "green, or dark if rough",
}

_GRID = "display: grid; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); gap: 12px; margin-top: 8px"


_MAX_RECORDINGS = 12


async def show(page: Page) -> None:
    """Build the page."""
    networks = await run.io_bound(page.workspace.part(StoredResults).networks) or {}
    reader = page.workspace.part(LiveReader)
    words = page.words
    style()
    if "trial" in query():
        trial.show(page, partial(_person_panel, free=False))
        return
    feed = Feed(reader, words.error)
    with ui.element("section").classes("ps-card w-full column no-wrap ps-small-gap"):
        _Controls(page, reader, feed, networks)
    mark = tag(notice(""), "simulation")

    def update_mark() -> None:
        mark.set_visibility(bool(kind := reader.simulated))
        if kind:
            mark.set_content(words(SIMULATIONS[kind]))

    on_change(reader.changed, update_mark)
    update_mark()
    view, people = LiveView(words, feed), adapting.PersonFields(page, reader)
    with view:
        _person_panel(page, reader)
        adapting.show(page, people)
    with view.add_slot("log"):
        log = LogButtons(page, reader)
    follow(view, feed, reader)
    validation_page.show(page, reader, people)
    log.add_sheet()
    recording = page.workspace.part(SignalRecording)
    context.client.on_delete(reader.add_viewer(lambda: bool(recording.key)))


def _person_panel(page: Page, reader: LiveReader, free: bool = True) -> None:
    """Add the buttons that direct the person of a virtual toy; they are hidden for any other toy.

    ``free``: also one that lets the person make any gesture, unasked.
    """
    words = page.words
    box = named(ui.element("div").props("role=group").classes("w-full"), words("Let the virtual person do this:"))
    with tag(box, "virtual-person"):
        ui.label(words("Let the virtual person do this:")).classes("text-bold")
        buttons = ui.row().classes("w-full ps-small-gap q-mt-xs")

    def direct(label: str | None) -> None:
        with page.show_errors():
            reader.direct(label)

    labels: tuple[str, ...] | None = None

    def update() -> None:
        # Called after every decision, mostly without a change.
        nonlocal labels
        bundle = reader.bundle if reader.person is not None else None
        now = () if bundle is None else tuple(g.label for g in bundle.gestures.gestures if not g.idle)
        if now == labels:
            return
        labels = now
        box.set_visibility(bool(now))
        buttons.clear()
        with buttons:
            for label in now:
                make, look = partial(direct, label), 'outline padding="3px 8px"'
                button(f"do-{label}", words.gesture(label), make, look).classes("ps-note")
            button("do-nothing", words("Stop"), lambda: direct(""), "outline dense", icon="stop").classes("ps-note")
            if free:
                button("do-own", words("By themselves"), lambda: direct(None), "flat dense").classes("ps-note")

    on_change(reader.changed, update)
    update()


def _recordings(page: Page) -> dict[str, str]:
    """Return the addresses and names of recordings to play: of sensors that no toy has, a stream or one a gesture."""
    from plushsense.dataset.index import open_dataset

    found: dict[str, str] = {}
    for path in page.workspace.datasets():
        with contextlib.suppress(PlushSenseError, OSError):
            if DatasetHead.read(path).layout.name in layout_names():
                continue
            dataset = open_dataset(path)
            parts = {r.gesture: (r.file, r.subject, page.words.gesture(r.gesture)) for r in reversed(dataset.used)}
            streams = [(s.file, s.subject, page.words("stream")) for s in dataset.streams]
            for file, person, what in (streams or list(parts.values()))[:_MAX_RECORDINGS]:
                values = {"person": person, "what": what, "dataset": dataset.head.name}
                title = page.words("Recording of {person}: {what} ({dataset})", **values)
                found[f"replay://{quote(str(path / file))}"] = title
    return found


class _Controls:
    """Fields for toy, network and settings, which are folded while a toy is read, and the buttons above them."""

    def __init__(self, page: Page, reader: LiveReader, feed: Feed, networks: Mapping[Path, ResultRow]) -> None:
        self._page, self._reader, self._feed, self._networks = page, reader, feed, networks
        self._workspace, self._toys = page.workspace, page.workspace.part(Toys)
        words, choice = page.words, reader.choice
        self._state: tuple[Any, ...] = ()
        self._recordings = _recordings(page)
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._start = button("start", words("Start"), self._begin, "unelevated", icon="play_arrow")
            self._stop = button("stop", words("Stop"), lambda: self._run(reader.stop), "unelevated", icon="stop")
            self._fields = tag(ui.element("details").style("flex: 1 1 17rem; min-width: 0"), "settings")
            self._busy = tag(ui.spinner(size="1.6em").props("aria-hidden=true"), "busy")
        self._busy.set_visibility(False)
        with self._fields:
            self._title = summary("").classes("ps-break")
            with ui.element("div").classes("w-full").style(_GRID):
                self._add_toy(words("Toy"))
                self._bundles = {str(path): path.stem for path in self._workspace.bundles()}
                chosen = str(choice.bundle) if choice.bundle else None
                if chosen is None or (query().get("model") and not reader.now.running):
                    first = recommended(networks, to_try=True)
                    chosen = query_path(self._workspace, "model", self._bundles, first) or None
                with ui.column().classes("ps-no-gap"):
                    box = ui.select(self._bundles, value=chosen, label=words("Network"))
                    self._bundle = tag(box.classes("w-full"), "bundle")
                    self._score = ui.column().classes("ps-no-gap ps-note")
                names = {"": words(in_context("reactions", "none"))}
                names |= {name: words(_REACTIONS.get(name, name)) for name in reaction_names()}
                self._reactions = ui.select(names, value=choice.reactions, label=words("Reactions of the toy"))
                tag(self._reactions, "reactions")
                engines = {"float": words("as trained (float)"), "int8": words("as on the chip (int8)")}
                self._engine = tag(ui.select(engines, value=choice.engine, label=words("Arithmetic")), "engine")
                self._add_rate("decision", words("Show the decision"), RATES_HZ[-1])
                self._add_rate("plot", words("Draw the signals"), PLOT_HZ)
            self._rates = ui.label("").classes("ps-dim ps-note")
            with ui.row().classes("w-full items-center ps-small-gap"):
                self._look = button("look", words("Look for toys"), self._toys.search, "flat", icon="search")
                virtual = ui.checkbox(words("This is a virtual toy: a simulation"), value=choice.simulated)
                self._simulated = tag(virtual, "simulated")
        self._toy.on_value_change(self._update_simulated)
        self._bundle.on_value_change(self._show_score)
        self._show_score()
        for control in (self._bundle, self._engine, self._reactions):
            control.on_value_change(self._change)
        on_change(reader.changed, self._update)
        on_change(self._toys.changed, self._update_toys)
        self._update_simulated()
        self._update()

    def _show_score(self) -> None:
        self._score.clear()
        with self._score:
            show_choice(self._page.words, self._networks, self._bundle.value)

    def _add_toy(self, label: str) -> None:
        reader, workspace = self._reader, self._workspace
        first = reader.choice.toy if reader.now.running else workspace.toy or VIRTUAL
        self._toy = ui.select(
            self._toy_options(first), value=first, label=label, with_input=True, new_value_mode="add-unique"
        )
        tag(self._toy.props(f'hint="{self._page.words("Choose, or type an address and press Enter")}"'), "toy")

    def _add_rate(self, name: str, label: str, usual: int) -> None:
        """Add the choice of a rate at which this page displays something; ``usual`` is chosen at first."""
        words, most = self._page.words, RATES_HZ[-1]
        rates = {n: words("{n} times a second", n=n) if n > 1 else words("once a second") for n in RATES_HZ[::-1]}

        def choose(rate: int) -> None:
            setattr(self._feed, f"{name}_s", PACE_S if rate == most else 1.0 / rate)

        field = ui.select(rates, value=usual, label=label)
        tag(field, f"rate-{name}").on_value_change(lambda e: choose(e.value))

    async def _run(self, command: Callable[..., None], *args: Any) -> bool:
        """Run ``command`` in a thread, show its errors beside the field, and return whether it succeeded."""
        self._busy.set_visibility(True)
        self._page.say("")
        self._bundle.error = self._toy.error = None
        done = False
        with self._page.show_errors(lambda: self._run(command, *args)):
            try:
                await asyncio.to_thread(command, *args)
                done = True
            except ToyInUseError:
                raise
            except PlushSenseError as refusal:
                of_network = isinstance(refusal, BundleError) or refusal.message.values.get("field") == "network"
                field = self._bundle if of_network else self._toy
                if self._reader.now.running:
                    # First, because a change of its value clears the error of a field.
                    self._follow()
                field.error = self._page.words.error(refusal)
                self._fields.props("open")
                field.run_method("focus")
        self._busy.set_visibility(False)
        return done

    async def _begin(self) -> None:
        url, simulated = str(self._toy.value or ""), bool(self._simulated.value)
        path = Path(self._bundle.value) if self._bundle.value else None

        def start() -> None:
            if not url.strip():
                raise ConfigError("No toy is chosen. Choose one first.", field="toy")
            chosen = LiveChoice(self._toys.choose(url), path, self._engine.value, self._reactions.value, simulated)
            self._reader.start(chosen)

        await self._run(start)

    async def _change(self) -> None:
        # Also called when this page displays the choice made in another tab; then there is nothing to do.
        now = self._reader.choice
        path = Path(self._bundle.value) if self._bundle.value else None
        chosen = (path, self._engine.value, self._reactions.value)
        if chosen != (now.bundle, now.engine, now.reactions):
            await self._run(self._reader.choose, *chosen)

    def _follow(self) -> None:
        """Display the current choice, which may have been made in another tab."""
        now = self._reader.choice
        if now.bundle is not None:
            if str(now.bundle) not in self._bundles:
                self._bundles[str(now.bundle)] = now.bundle.stem
                self._bundle.set_options(self._bundles)
            self._bundle.set_value(str(now.bundle))
        self._engine.set_value(now.engine)
        self._reactions.set_value(now.reactions)
        if self._reader.now.running:
            self._toy.set_options(self._toy_options(now.toy), value=now.toy)
            self._simulated.set_value(now.simulated)

    def _update(self) -> None:
        # Called after every decision, mostly without a change.
        reader, words = self._reader, self._page.words
        running = reader.now.running
        if (state := (running, reader.choice, reader.bundle)) == self._state:
            return
        if not self._state or self._state[0] != running:
            self._fields.props(remove="open") if running else self._fields.props("open")
        self._state = state
        self._start.set_visibility(not running)
        self._stop.set_visibility(running)
        for control in (self._toy, self._look, self._simulated):
            control.set_enabled(not running)
        choice = reader.choice
        now = (
            f": {self._recordings.get(choice.toy) or words.toy(choice.toy)} · {choice.bundle.stem}"
            if running and choice.bundle is not None
            else ""
        )
        self._title.set_content(words("Toy, network and settings") + now)
        step_s = reader.bundle.arch.step * reader.bundle.layout.period_us / 1e6 if reader.bundle is not None else 0.05
        rates = words(
            "These two change only this page. The network itself answers {n} times a second, and neither events nor "
            "reactions wait for the page.",
            n=round(1.0 / step_s),
        )
        self._rates.set_text(rates)
        self._follow()

    def _update_toys(self) -> None:
        self._busy.set_visibility(self._toys.searching)
        if not self._reader.now.running:
            value = self._toy.value
            self._toy.set_options(self._toy_options(str(value or "")), value=value)

    def _update_simulated(self) -> None:
        self._toy.error = None
        if not self._reader.now.running:
            with contextlib.suppress(PlushSenseError):
                self._simulated.set_value(is_virtual(str(self._toy.value or "")))

    def _toy_options(self, url: str) -> dict[str, str]:
        """Return the toys to choose from: ``url``, those given at start, the virtual one and those found."""
        words, workspace = self._page.words, self._workspace
        known = {one: words.toy(one) for one in (url, workspace.toy, *workspace.devices, VIRTUAL) if one}
        found = [d for d in self._toys.listing.devices if d.kind != "virtual"]
        known |= {d.url: f"{d.name or d.url}: {described(words, d)}" for d in found}
        return known | self._recordings
