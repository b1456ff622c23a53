"""Choices before and during a session: the toy, and one's own protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from nicegui import run, ui

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.core.gestures import AFFECTS, load_gestures, plain_label
from plushsense.devices.opening import list_devices
from plushsense.recording.plan import ORDERS
from plushsense.studio.app.shell import Page, button, named, tag
from plushsense.studio.app.toys import found_title
from plushsense.studio.app.words import Texts
from plushsense.studio.pages.record.controller import RecordController
from plushsense.studio.widgets.elements import errors_beside, on_enter, summary

_ORDERS: Texts = {
    "gesture": "As listed, all repetitions of a gesture in a row",
    "round": "As listed, every gesture once, then again",
    "random": "Mixed, another order in each session",
}

PROTOCOLS: Texts = {
    "plush-17": "The session of the paper: 17 gestures, 3 times each",
    "quick": "Short trial: 4 gestures, once each",
    "rest": "The toy at rest, nobody touches it",
}
"""Titles of the protocols that PlushSense has."""

_SCAN_S = 3.0


class ToyChoice:
    """A list of toys, a button that searches for more, and a field for any other address.

    Args:
        urls: the toys to choose from; the first one is chosen.
        prefix: beginning of the names by which tests find the elements.
    """

    def __init__(self, page: Page, urls: Sequence[str], prefix: str = "") -> None:
        self._page, self._urls, words = page, urls, page.words
        label = words("Toy")
        self._list = ui.select({u: words.toy(u) for u in urls}, value=urls[0], label=label)
        named(tag(self._list, f"{prefix}toy"), label).style("width: 27rem; max-width: 100%")
        self._look = button(f"{prefix}look", words("Look for toys"), self._search)
        self._other = ui.input(label=words("Address of another toy")).props(
            f'outlined hint="{words("For example serial:///dev/ttyUSB0")}"'
        )
        tag(self._other, f"{prefix}other_toy").classes("w-64")
        self._list.on_value_change(lambda: self.show_error(""))
        self._other.on_value_change(lambda: self.show_error(""))

    @property
    def url(self) -> str:
        """The address that was typed, or else the chosen toy."""
        return str(self._other.value or "").strip() or str(self._list.value)

    def show_error(self, sentence: str) -> None:
        """Show an error beside the field from which the toy was taken; "" removes it."""
        typed = bool(str(self._other.value or "").strip())
        for field, is_source in ((self._other, typed), (self._list, not typed)):
            field.error = sentence if sentence and is_source else None

    async def _search(self) -> None:
        words = self._page.words
        self._look.disable()
        self._page.say(
            words("Looking for toys at ports, by Bluetooth and on the network (LSL), {s} s …", s=f"{_SCAN_S:g}")
        )
        try:
            listing = await run.io_bound(list_devices, _SCAN_S)
        finally:
            self._look.enable()
        if listing is None:
            return
        options = {u: words.toy(u) for u in dict.fromkeys(self._urls)}
        options |= {d.url: found_title(words, d) for d in listing.devices if d.url not in options}
        self._list.set_options(options, value=self._list.value)
        notes = [words.sentence(note) for note in listing.notes]
        self._page.say(" ".join([words("Toys to choose from: {n}.", n=len(options)), *notes]))


_GESTURES = "plush-18"
_MOST = 20


class ProtocolForm:
    """A folded form; ``saved`` is called with the path of a new protocol."""

    def __init__(self, page: Page, controller: RecordController, saved: Callable[[Path], None]) -> None:
        self._page, self._controller, self._saved = page, controller, saved
        words = page.words
        with tag(ui.element("details").classes("w-full"), "own-protocol") as self._box:
            summary(words("Make your own list of gestures"))
            with ui.column().classes("w-full q-pt-sm"):
                ui.label(words("Gestures to record")).classes("text-bold")
                self._group = ui.row().classes("w-full ps-no-gap").props("role=group")
                named(self._group, words("Gestures to record"))
                self._gestures: dict[str, ui.checkbox] = {}
                self._affects = controller.own_gestures()
                for label in (*load_gestures(_GESTURES).labels, *self._affects):
                    self._list(label, False)
                button("own-all", words("Select all"), self._select_all, "flat dense")
                with ui.row().classes("w-full items-start"):
                    self._other = tag(ui.input(words("Another gesture, such as kiss")), "own-gesture").classes("w-64")
                    on_enter(self._other, self._add)
                    meant = words("How it is meant")
                    self._affect = ui.select({a: words.affect(a) for a in AFFECTS}, value="positive", label=meant)
                    named(tag(self._affect.classes("w-64"), "own-affect"), meant)
                    button("own-add", words("Add this gesture"), self._add)
                self._lacking = ui.label().classes("ps-bad").props("role=alert")
                with ui.row().classes("w-full items-start"):
                    self._repetitions = ui.number(
                        words("How often each"), value=3, min=1, max=_MOST, step=1, format="%d"
                    )
                    tag(self._repetitions, "own-repetitions").classes("w-64")
                    orders = {order: words(_ORDERS[order]) for order in ORDERS}
                    label = words("Order")
                    self._order = tag(ui.select(orders, value="gesture", label=label), "own-order").classes("w-96")
                    named(self._order, label)
                with ui.row().classes("w-full items-start"):
                    self._name = tag(ui.input(words("Name of the list")), "own-name").classes("w-64")
                    button("own-save", words("Save and choose it"), self._save)

    def _list(self, label: str, chosen: bool) -> None:
        with self._group:
            box = ui.checkbox(self._page.words.gesture(label), value=chosen).style("width: 16rem")
        self._gestures[label] = tag(box, f"own-{label}")

    def _select_all(self) -> None:
        """Choose all gestures, or none if all are chosen."""
        on = not all(box.value for box in self._gestures.values())
        for box in self._gestures.values():
            box.value = on

    def _add(self) -> None:
        """Add the gesture that was typed, chosen; an error is shown beside its field."""
        with errors_beside(self._page, self._other):
            label = self._page.workspace.check_name(str(self._other.value or ""))
            if plain_label(label) in map(plain_label, self._gestures):
                raise ConfigError("“{gesture}” is in the list already.", gesture=label)
            self._affects[label] = str(self._affect.value)
            self._list(label, True)
            self._other.value = ""

    def _save(self) -> None:
        words = self._page.words
        self._name.error, self._repetitions.error, self._lacking.text = None, None, ""
        chosen = [label for label, box in self._gestures.items() if box.value]
        own = {label: affect for label, affect in self._affects.items() if label in chosen}
        name, repetitions = str(self._name.value or ""), int(self._repetitions.value or 0)
        try:
            path = self._controller.save_protocol(name, chosen, repetitions, self._order.value, own)
        except PlushSenseError as error:
            sentence = words.error(error)
            field = error.message.values.get("field")
            if field == "name":
                self._name.error = sentence
            elif field == "repetitions":
                self._repetitions.error = sentence
            else:
                self._lacking.text = sentence
            return
        for box in self._gestures.values():
            box.value = False
        self._name.value = ""
        ui.run_javascript(f"getHtmlElement({self._box.id}).open = false")
        self._saved(path)
