"""Log the events of a session: rows for a CSV file, and a table for printing."""

from __future__ import annotations

import time
from collections.abc import Sequence

from markupsafe import Markup
from nicegui import ui

from plushsense.reports.table import Table
from plushsense.studio.app.shell import AFFECT_SIGNS, Page, add_style, button, html, moment, on_change, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.app.workspace import plain_name
from plushsense.studio.pages.live.feed import VIEW_TEXTS
from plushsense.studio.pages.live.live_state import EventSpan
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.widgets.elements import table_html

_PRINT = """
.lv-print { display: none; }
@media print {
  .q-header, .ps-main:has(.lv-print:not(:empty)) > *:not(.lv-print) { display: none !important; }
  .lv-print { display: block !important; color: #000; background: #fff; }
  body, body.body--dark { background: #fff !important; color: #000 !important; }
  .lv-print tr { break-inside: avoid; } .lv-print * { border-color: #999 !important; color: #000 !important; }
}
"""


SIMULATIONS: Texts = {
    "toy": "Simulation: these data say nothing about a real toy.",
    "network": (
        "Simulation: this network was trained on virtual people. What it says about a real toy proves nothing."
    ),
}
"""Sentences on what is virtual, by `plushsense.studio.pages.live.live_state.SimulationKind`."""


def log_table(events: Sequence[EventSpan]) -> Table:
    """Return a table with one row for each event, for a file."""
    rows = [
        {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(event.at)),
            "toy_s": round(event.begin_s, 2),
            "lasted_s": None if event.end_s is None else round(event.end_s - event.begin_s, 2),
            "gesture": event.gesture or "",
            "affect": event.affect,
            "confidence": None if event.confidence is None else round(event.confidence, 3),
            "source": event.source,
            "eyes": event.eyes,
            "sound": event.sound,
            "really": "" if event.really is None else event.really or "nothing",
            "person": event.subject,
            "network": event.network,
            "simulated": "yes" if event.simulated else "no",
        }
        for event in events
    ]
    return Table.from_rows("log", "", rows)


def printed(words: Words, events: Sequence[EventSpan]) -> Markup:
    """Return the log as a page for printing, in the language of ``words``."""
    virtual = any(event.really is not None for event in events)
    head = words.each("Time", "Person", "Gesture", "Affect", "Confidence", "Duration", "Reaction of the toy")
    head += [words("Really made")] if virtual else []
    rows = []
    for event in events:
        reaction = [words(VIEW_TEXTS[f"eyes_{event.eyes}"])] if event.eyes else []
        reaction += [words(VIEW_TEXTS.get(f"sound_{event.sound}", event.sound))] if event.sound else []
        row = [
            time.strftime("%H:%M:%S", time.localtime(event.at)),
            event.subject,
            words.gesture(event.gesture) if event.gesture else words("A touch"),
            f"{AFFECT_SIGNS[event.affect]} {words.affect(event.affect)}",
            "" if event.confidence is None else f"{words.number(100.0 * event.confidence)} %",
            "" if event.end_s is None else f"{words.number(event.end_s - event.begin_s, 1)} s",
            ", ".join(reaction),
        ]
        if virtual:
            row.append("" if event.really is None else words.gesture(event.really or words("nothing")))
        rows.append(row)
    about = words("No event yet.")
    if events:
        when, networks = moment(events[0].session), ", ".join(dict.fromkeys(event.network for event in events))
        about = words("Session begun {when}. Network: {network}.", when=when, network=networks)
    kinds = dict.fromkeys(event.simulated for event in events if event.simulated)
    mark = " ".join(words(SIMULATIONS[kind]) for kind in kinds)
    return Markup("<h2>{}</h2><p>{}</p><p><b>{}</b></p>{}").format(
        words("Log of the session"), about, mark, table_html(head, rows, numbers=(4, 5)) if rows else ""
    )


class LogButtons:
    """Buttons that save and print the log of a session, and the choice of the session if there are several."""

    def __init__(self, page: Page, reader: LiveReader) -> None:
        self._page, self._reader = page, reader
        words = page.words
        add_style(_PRINT)
        with ui.row().classes("w-full items-center ps-small-gap q-mt-sm"):
            self._count = tag(ui.label("").classes("ps-dim"), "log-count")
            self._session = tag(ui.select({}, label=words("Session begun")).classes("w-64"), "log-session")
            self._save = button("log-save", words("Save as a table (CSV)"), self._download, icon="download")
            self._print = button("log-print", words("Print"), self._open_print, icon="print")
        self._session.on_value_change(self._update)
        self._numbers = (-1, -1)
        on_change(reader.changed, self._update_after_event)
        self._update_after_event()

    def add_sheet(self) -> None:
        """Add the element that is printed; call this where the other sections of the page are added."""
        self._sheet = html().classes("lv-print w-full")

    def _events(self) -> list[EventSpan]:
        return [event for event in self._reader.events() if event.session == self._session.value]

    def _update_after_event(self) -> None:
        # Called after every decision, mostly without a new event.
        now = self._reader.now
        if self._numbers == (numbers := (now.generation, now.changes)):
            return
        self._numbers = numbers
        sessions = list(dict.fromkeys(event.session for event in self._reader.events()))
        if sessions != list(self._session.options):
            # A new session is chosen, unless an earlier one was chosen by hand.
            newest = self._session.value in (None, *list(self._session.options)[-1:])
            value = sessions[-1] if newest and sessions else self._session.value
            self._session.set_options({start: moment(start) for start in sessions}, value=value)
            self._session.set_visibility(len(sessions) > 1)
        self._update()

    def _update(self) -> None:
        n = len(self._events())
        self._count.set_text(self._page.words("{n:event} in the log", n=n))
        for control in (self._save, self._print):
            control.set_enabled(n > 0)

    def _download(self) -> None:
        events = self._events()
        people = sorted({event.subject for event in events if event.subject})
        name = "-".join(["live", time.strftime("%Y-%m-%d-%H%M", time.localtime(events[0].session)), *people])
        ui.download.content(log_table(events).csv(), f"{plain_name(name, 'live')}.csv", "text/csv")

    def _open_print(self) -> None:
        self._sheet.set_content(printed(self._page.words, self._events()))
        # The browser prints what it has drawn, so wait until the table is there.
        ui.run_javascript("requestAnimationFrame(() => requestAnimationFrame(() => print()))")
