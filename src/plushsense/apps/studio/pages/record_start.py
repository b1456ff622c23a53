"""Record, before a session: the ones that are open or unfinished, and a new one."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any
from urllib.parse import quote

from nicegui import run, ui

from plushsense.apps.studio.desk import Desk, Sitting
from plushsense.apps.studio.shell import Page, named, tag
from plushsense.apps.studio.words import Words
from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.devices.listing import list_devices
from plushsense.recording.beginning import PROTOCOL, Wanted
from plushsense.recording.protocol import DEFAULT, wordings
from plushsense.recording.shelf import Shelved
from plushsense.recording.toy import is_virtual

_LISTED = 8
_SCAN_S = 3.0
"""The button that is meant first, readable in both lights."""


def address(name: str, key: str = "session") -> str:
    """The page of a session."""
    return f"/record?{key}={quote(name)}"


def protocol_title(words: Words, name: str, title: str) -> str:
    """A protocol's title in the page's language, where it is a built-in one."""
    key = f"record.protocol_{name}"
    return words(key) if words.has(key) else title


def toy_name(words: Words, url: str) -> str:
    """A toy in a list: its address, and a word where it is a virtual one."""
    return f"{words('record.virtual_toy')} · {url}" if is_virtual(url) else url


def unfolding(text: str) -> None:
    """What is seen of a folded part of the page."""
    style = "display: list-item; list-style-position: inside; cursor: pointer; font-weight: 600"
    ui.html(escape(text), sanitize=False, tag="summary").style(style)


async def show_start(page: Page, desk: Desk, asked: str, ended: str) -> None:
    """Sessions to go on with, then the form.

    Args:
        asked: a session that the address names and that is not open; ``ended``: one that was just closed.
    """
    sessions = await run.io_bound(desk.sessions) or []
    mine = {_name(s): s for s in sessions}
    if ended in mine:
        _say_ended(page, mine[ended])
    elif asked in mine and not mine[asked].finished:
        page.say(page.words("record.not_open", name=asked), "warning")
    elif asked:
        page.say(page.words("record.no_session", name=asked), "warning")
    _open_ones(page, desk)
    _unfinished(page, desk, sessions)
    _Form(page, desk)
    done = sum(s.finished for s in sessions)
    if done:
        with ui.row().classes("items-baseline"):
            ui.label(page.words("record.finished_ones", n=done)).classes("ps-dim")
            ui.link(page.words("record.import_them"), "/").classes("ps-link")


def _say_ended(page: Page, session: Shelved) -> None:
    counts = {"name": _name(session), "done": session.done, "steps": session.steps}
    page.say(page.words("record.ended_whole" if session.finished else "record.ended_part", **counts), "good")


def _name(session: Shelved) -> str:
    return f"{session.folder.parent.name}/{session.folder.name}"


def _open_ones(page: Page, desk: Desk) -> None:
    for sitting in desk.sittings():
        with tag(ui.row().classes("ps-card w-full items-center"), "open-session"):
            ui.label(page.words("record.open_now", name=sitting.name)).classes("flex-grow text-bold")
            there = page.words("record.show")
            button = ui.button(there, on_click=lambda s=sitting: ui.navigate.to(address(s.name)))
            named(button.props("no-caps unelevated"), f"{there}: {sitting.name}")


def _unfinished(page: Page, desk: Desk, sessions: list[Shelved]) -> None:
    words = page.words
    left = [s for s in sessions if not s.finished and desk.get(_name(s)) is None]
    if not left:
        return
    with ui.column().classes("ps-card w-full"):
        ui.html(f"<h2>{words('record.unfinished')}</h2>", sanitize=False)
        for session in left[:_LISTED]:
            _one_unfinished(page, desk, session)
        if len(left) > _LISTED:
            with ui.element("details").classes("w-full"):
                unfolding(words("record.older", n=len(left) - _LISTED))
                for session in left[_LISTED:]:
                    _one_unfinished(page, desk, session)


def _one_unfinished(page: Page, desk: Desk, session: Shelved) -> None:
    words, name = page.words, _name(session)
    with tag(ui.row().classes("w-full items-center"), f"unfinished-{name}"):
        if session.head is None or session.protocol is None:
            ui.label(f"{name}: {session.said}").classes("flex-grow")
            return
        told = words("record.so_far", name=name, done=session.done, steps=session.steps)
        with ui.column().classes("flex-grow").style("gap: 0"):
            ui.label(told).classes("text-bold")
            title = protocol_title(words, session.protocol.name, session.protocol.title)
            title += f" · {words('record.simulated')}" if session.head.simulated else ""
            ui.label(title).classes("ps-dim")
        toys = list(dict.fromkeys([session.head.device, *desk.toys()]))
        titles = {u: toy_name(words, u) for u in toys}
        toy = ui.select(titles, value=toys[0], label=words("record.toy")).style("width: 24rem; max-width: 100%")
        named(toy.props("outlined dense"), f"{words('record.toy')}: {name}")
        button = ui.button(words("record.go_on")).props("no-caps unelevated")
        named(button, f"{words('record.go_on')}: {name}")
        button.on_click(lambda: _sit_down(page, button, lambda: desk.resume(name, str(toy.value))))


async def _sit_down(page: Page, button: ui.button, work: Callable[[], Sitting]) -> None:
    """Open the toy, which may take a while, and go to the session; what is refused is said."""
    button.disable()
    page.say(page.words("record.opening"))
    try:
        with page.refusing():
            sitting = await run.io_bound(work)
            if sitting is not None:
                ui.navigate.to(address(sitting.name))
    finally:
        button.enable()


class _Form:
    """A new session."""

    def __init__(self, page: Page, desk: Desk) -> None:
        self._page, self._desk, words = page, desk, page.words
        protocols = desk.protocols()
        with tag(ui.column().classes("ps-card w-full"), "new-session"):
            ui.html(f"<h2>{words('record.new')}</h2>", sanitize=False)
            with ui.row().classes("w-full items-start"):
                self._subject = self._input("code", "code_hint")
                self._consent = self._input("consent", "consent_hint")
                self._age = self._input("age_group", "age_hint")
                self._gender = self._input("gender", "gender_hint")
            with ui.row().classes("w-full items-start"):
                named = {key: self._named("protocol", key, name) for key, name in protocols.items()}
                self._protocol = self._select(named, "protocol", PROTOCOL)
                self._protocol.on_value_change(self._choose_words)
                self._words = self._select({DEFAULT: DEFAULT}, "wording", DEFAULT)
            with ui.row().classes("w-full items-start"):
                toys = desk.toys()
                self._toy = self._select({u: toy_name(words, u) for u in toys}, "toy", toys[0])
                self._look = ui.button(words("record.look"), on_click=self._look_for_toys).props("no-caps outline")
                self._other = self._input("other_toy", "other_toy_hint")
            with ui.element("details").classes("w-full"):
                unfolding(words("record.more"))
                with ui.column():
                    layouts = {"": words("record.layout_usual")} | desk.layouts()
                    self._layout = self._select(layouts, "layout", "")
                    self._simulated = ui.checkbox(words("record.is_virtual"))
                    self._anew = ui.checkbox(words("record.anew"))
            self._begin = ui.button(words("record.begin"), on_click=self._sit)
            tag(self._begin, "begin").props("no-caps unelevated size=lg")
        self._choose_words()

    def _named(self, what: str, key: str, name: str) -> str:
        text = f"record.{what}_{key}"
        return self._page.words(text) if self._page.words.has(text) else name

    def _input(self, key: str, hint: str) -> ui.input:
        words = self._page.words
        field = ui.input(label=words(f"record.{key}")).props(f'outlined hint="{words(f"record.{hint}")}"')
        return tag(field, key).classes("w-64")

    def _select(self, options: dict[str, str], key: str, value: str) -> ui.select:
        label = self._page.words(f"record.{key}")
        value = value if value in options else next(iter(options))
        field = ui.select(options, value=value, label=label).props("outlined")
        named(field, label)
        return tag(field, key).style("width: 27rem; max-width: 100%")

    def _choose_words(self) -> None:
        """The wordings of this protocol; first the one in the page's language."""
        try:
            known = wordings(str(self._protocol.value))
        except PlushSenseError as refusal:
            self._page.say(str(refusal), "error")
            known = (DEFAULT,)
        language = self._page.words.language
        value = language if language in known else DEFAULT
        self._words.set_options({w: self._named("wording", w, w) for w in known}, value=value)

    async def _look_for_toys(self) -> None:
        words = self._page.words
        self._look.disable()
        self._page.say(words("record.looking", s=f"{_SCAN_S:g}"))
        try:
            found = await run.io_bound(list_devices, _SCAN_S)
        finally:
            self._look.enable()
        if found is None:
            return
        known = dict.fromkeys(self._desk.toys())
        options = {u: toy_name(words, u) for u in known} | {
            d.url: f"{d.name} · {d.url}" for d in found.devices if d.url not in known
        }
        self._toy.set_options(options, value=self._toy.value)
        self._page.say(" ".join([words("record.found", n=len(options)), *found.notes]))

    def _wanted(self) -> Wanted:
        toy = str(self._other.value or "").strip() or str(self._toy.value)
        simulated = bool(self._simulated.value)
        return Wanted(
            device=toy,
            subject=str(self._subject.value or "").strip(),
            protocol=str(self._protocol.value),
            words=str(self._words.value),
            layout=str(self._layout.value or ""),
            age_group=_short(self._age.value),
            gender=_short(self._gender.value),
            consent=_short(self._consent.value),
            speed=self._desk.speed_for(toy, simulated),
            simulated=simulated,
        )

    async def _sit(self) -> Any:
        with self._page.refusing():
            wanted = self._wanted()
            anew = bool(self._anew.value)
            await _sit_down(self._page, self._begin, lambda: self._desk.begin(wanted, anew))


def _short(value: Any) -> str:
    text = " ".join(str(value or "").split())
    if len(text) > 100:
        raise ConfigError(f"'{text[:20]}…' is too long: at most 100 characters.")
    return text
