"""Build the section of the home page in which a toy is found, chosen and tried out."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import run, ui

from plushsense.core.errors import PlushSenseError
from plushsense.devices.opening import check_address, parse_url
from plushsense.studio.app.shell import STOP_USE, Kind, Page, button, message_row, on_change, on_page, tag
from plushsense.studio.app.toys import (
    PERSONS,
    ToyInUseError,
    Toys,
    ToyTrial,
    ToyUse,
    described,
    found_title,
    with_layout,
)
from plushsense.studio.app.words import Texts
from plushsense.studio.pages.home.sections import SMALL, simulation_badge, titled_card
from plushsense.studio.widgets.elements import errors_beside

_TESTS: Texts = {
    "good": "The toy works: {frames} frames in {seconds} s, and the layout {layout} fits.",
    "slow": (
        "The layout {layout} fits, but {frames} frames came in {seconds} s instead of {rate} a second. Check the "
        "connection."
    ),
    "malformed": (
        "Many lines are not of the sensors {layout}: {malformed} (frames: {frames}). Check the connection, or "
        "whether the toy has other sensors."
    ),
}


class ToySection:
    """Section for choosing a toy; it searches for toys unless a search was made before."""

    def __init__(self, page: Page, toys: Toys) -> None:
        self._page, self._words, self._toys = page, page.words, toys
        words = self._words
        with titled_card(page, "Toy", "toy"):
            self._chosen = ui.column().classes("w-full ps-small-gap").props('aria-live="polite"')
            with ui.row().classes("items-end ps-small-gap w-full"):
                options = {n: words("Person {n}", n=n) for n in range(1, PERSONS + 1)}
                who = ui.select(options, value=7, label=words("Person who uses the virtual toy")).classes("ps-wide")
                tag(who, "person")
                text = words("Use the virtual toy")
                button("virtual", text, lambda: self._choose(f"virtual://?person={who.value}"), "unelevated")
            self._others = ui.column().classes("w-full ps-small-gap")
            with ui.row().classes("items-start ps-small-gap w-full"):
                field = ui.input(words("Address of another toy"), placeholder="tcp://192.168.1.20:3333")
                self._address = tag(field.classes("ps-wide"), "address")
                field.on("keydown.enter", self._use)
                button("use", words("Use this toy"), self._use)
        self._update()
        on_change(toys.changed, self._update)
        if not toys.searched:
            # Nobody has asked for it: nothing may be sent.
            toys.search(network=False)

    def _use(self) -> None:
        """Choose the toy at the address that was typed; an error is shown beside the field."""
        with errors_beside(self._page, self._address):
            url = str(self._address.value or "").strip()
            check_address(parse_url(url))
            self._toys.choose(url)
            self._try_out()

    def _choose(self, url: str) -> None:
        with self._page.show_errors():
            self._toys.choose(url)
            self._try_out()

    def _try_out(self) -> None:
        self._page.say("")
        self._toys.try_out()

    async def _free(self, use: ToyUse) -> None:
        """End what another page does with the toy, and try it."""
        with self._page.show_errors():
            await run.io_bound(use.stop)
            self._try_out()

    def _update(self) -> None:
        self._show_chosen()
        self._show_others()

    def _show_chosen(self) -> None:
        words, toy, trial = self._words, self._page.workspace.toy, self._toys.trial
        self._chosen.clear()
        with self._chosen:
            if not toy:
                ui.label(words("No toy is chosen yet.")).classes("ps-dim")
                return
            with ui.row().classes("items-center ps-small-gap"):
                tag(ui.label(words("Chosen: {toy}", toy=words.toy(toy))).classes("ps-break text-bold"), "chosen")
                if self._toys.simulated:
                    simulation_badge(self._page)
            if trial is not None:
                kind, text = self._describe(trial)
                with tag(message_row(kind), "trial"):
                    if trial.running:
                        ui.spinner(size="1.2em", color="inherit").props("aria-hidden=true")
                    ui.label(text).classes("ps-break")
            with ui.row().classes("ps-small-gap"):
                if trial is not None and trial.layout:
                    fitting, url = trial.layout, with_layout(trial.url, trial.layout)
                    text = words("Use the sensors of {layout}", layout=fitting)
                    button("use-layout", text, on_page(lambda: self._choose(url)), "unelevated")
                if trial is not None and isinstance(trial.error, ToyInUseError):
                    button("stop-use", words(STOP_USE), on_page(partial(self._free, trial.error.use)), "unelevated")
                test = button("test", words("Test the toy"), on_page(self._try_out))
                test.set_enabled(trial is None or not trial.running)

    def _describe(self, trial: ToyTrial) -> tuple[Kind, str]:
        """Return the kind of message and the sentence about a trial."""
        words, result = self._words, trial.result
        if trial.running:
            return "info", words("Reading the toy for a second …")
        if trial.layout:
            return "warning", words("The toy works, but its sensors are those of {layout}.", layout=trial.layout)
        if trial.error is not None:
            error = trial.error
            if isinstance(error, PlushSenseError):
                return "warning" if isinstance(error, ToyInUseError) else "error", words.error(error)
            return "error", words.failure(" ".join(str(error).split()) or type(error).__name__)
        assert result is not None
        values: dict[str, Any] = {"seconds": words.number(result.seconds, 1), "rate": words.number(result.rate_hz)}
        key = "good" if result.fits and result.on_time else "slow" if result.fits else "malformed"
        values |= {"frames": str(result.frames), "layout": result.layout, "malformed": str(result.malformed)}
        return ("good" if key == "good" else "warning"), words(_TESTS[key], **values)

    def _show_others(self) -> None:
        words, toys = self._words, self._toys
        self._others.clear()
        since = words("given when the studio was started")
        given = [(url, words.toy(url), since) for url in self._page.workspace.devices]
        found = [d for d in toys.listing.devices if d.kind != "virtual"]
        listed = [(d.url, found_title(words, d), described(words, d)) for d in found]
        with self._others:
            for url, name, about in [*given, *listed]:
                with ui.row().classes("ps-row items-center justify-between w-full no-wrap"):
                    with ui.column().classes("ps-no-gap"):
                        ui.label(name).classes("ps-break")
                        ui.label(about).classes("ps-dim ps-break")
                    button("", words("Choose"), on_page(lambda url=url: self._choose(url)), SMALL, about=name)
            if toys.searching:
                with ui.row().classes("items-center ps-small-gap").props('role="status"'):
                    ui.spinner(size="1.2em").props("aria-hidden=true")
                    ui.label(words("Looking for toys …"))
                return
            if toys.searched and not listed:
                ui.label(words("No other toy was found.")).classes("ps-dim")
            for note in toys.listing.notes:
                ui.label(words.sentence(note)).classes("ps-dim ps-note ps-break")
            button("look", words("Look again" if toys.searched else "Look for toys"), toys.search, SMALL)
            about = words(
                "Only serial ports are searched when this page opens. The button also searches by Bluetooth, and asks "
                "the network for LSL streams."
            )
            ui.label(about).classes("ps-dim ps-note")
