"""Build the part of the live page that marks an event as wrong and improves the network for the person."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from nicegui import ui

from plushsense.core.errors import BadInput, PlushSenseError
from plushsense.recording.session import check_subject
from plushsense.studio.app.shell import Page, button, named, on_change, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.live.clips import Clips
from plushsense.studio.pages.live.feedback import Feedback, Improved
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.state import EventSpan


def show(page: Page, reader: LiveReader, people: PersonFields) -> None:
    """Build the part, which is beside the current event."""
    box = ui.element("div").props("role=group").classes("w-full column no-wrap ps-small-gap q-mt-sm")
    with named(box, page.words("live.wrong_about")):
        _FeedbackPanel(page, reader, people)


class PersonFields:
    """The fields of a page for the code of the person who touches the toy; all of them hold the same text."""

    def __init__(self, page: Page, reader: LiveReader) -> None:
        self._page, self._reader = page, reader
        self._fields: list[ui.input] = []
        self.code = reader.subject

    def add(self, name: str, on_change: Callable[[], None] = lambda: None) -> ui.input:
        """Add a field; ``on_change`` is called when the text of any field has changed."""
        words = self._page.words
        field = tag(ui.input(words("live.person"), value=self.code, placeholder="S01").props("maxlength=16"), name)
        self._fields.append(field)

        def changed() -> None:
            self.code = str(field.value or "").strip()
            field.error = None
            for other in self._fields:
                other.set_value(field.value)
            self._reader.subject = ""
            # A code that is still being typed may be invalid.
            with contextlib.suppress(BadInput):
                self._reader.subject = check_subject(self.code)
            on_change()

        field.on_value_change(changed)
        return field

    def checked(self, field: ui.input) -> str:
        """Return the code; if it is missing or invalid, say so beside ``field`` and return ""."""
        text = ""
        try:
            text = check_subject(self.code)
        except BadInput as refusal:
            field.error = self._page.words.error(refusal) if self.code else self._page.words("live.person_first")
            field.run_method("focus")
        return text


class _FeedbackPanel:
    """Fields and buttons that mark the last event, remove the last mark, and improve the network."""

    def __init__(self, page: Page, reader: LiveReader, people: PersonFields) -> None:
        self._reader, self._words, self._people = reader, page.words, people
        self._feedback = page.workspace.part(Feedback)
        self._event: EventSpan | None = None
        self._labels: tuple[str, ...] = ()
        self._busy = False
        words = page.words
        with ui.row().classes("w-full justify-between ps-small-gap"):
            self._which = tag(ui.label(""), "wrong-event")
            self._count = tag(ui.label("").classes("ps-dim"), "marks")
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._wrong = button("wrong", words("live.wrong"), self._mark, "unelevated", icon="thumb_down")
            nothing = {"": words("live.wrong_nothing")}
            self._right = ui.select(nothing, value="", label=words("live.wrong_really"))
            tag(self._right, "wrong-really").style("flex: 1 1 15rem; min-width: 0")
            self._person = people.add("wrong-person", self._update_marks).style("flex: 1 1 9rem")
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._improve = button("improve", words("live.improve"), self._fit, icon="auto_fix_high")
            self._undo = button("marks-undo", words("live.marks_undo"), self._remove, "flat", icon="undo")
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._recordings = ui.select({}, label=words("live.adapt_from")).style("flex: 1 1 10rem; min-width: 0")
            tag(self._recordings, "adapt-from")
            self._adapt = button("adapt", words("live.adapt"), self._adapt_to_recordings, icon="auto_fix_high")
        # Messages are displayed here, because the top of the page may be out of view.
        self._page = replace(page, _messages=ui.column().classes("w-full ps-messages"))
        on_change(reader.changed, self._update_event)
        on_change(self._feedback.changed, self._update)
        on_change(page.workspace.part(Clips).changed, self._update_marks)
        self._update()

    def _code(self) -> str:
        return self._people.checked(self._person)

    async def _mark(self) -> None:
        # The event that the page shows: another one may begin while the button is pressed.
        event, right, words = self._event, str(self._right.value or ""), self._words
        if event is None or not (subject := self._code()):
            return
        with self._page.show_errors():
            n = await asyncio.to_thread(self._feedback.mark, event.number, subject, right)
            self._right.set_value("")
            values = {"gesture": words.gesture(event.gesture or ""), "s": self._begin(event)}
            key = "live.marked_right" if right else "live.marked"
            self._page.say(words(key, **values, right=words.gesture(right), subject=subject, n=n), "good")

    async def _remove(self) -> None:
        if subject := self._code():
            with self._page.show_errors():
                n = await asyncio.to_thread(self._feedback.undo, subject)
                self._page.say(self._words("live.marks_undone", subject=subject, n=n), "good")

    async def _fit(self) -> None:
        await self._change_network(self._feedback.improve)

    async def _adapt_to_recordings(self) -> None:
        recordings = Path(str(self._recordings.value or ""))
        await self._change_network(lambda subject: self._feedback.adapt(subject, recordings))

    async def _change_network(self, work: Callable[[str], Improved]) -> None:
        """Call ``work`` with the code of the person, and say what changed, with a button to undo it."""
        if self._busy or not (subject := self._code()):
            return
        self._busy = True
        self._page.say(self._words("live.improving"))
        self._update_marks()
        try:
            with self._page.show_errors():
                done = await asyncio.to_thread(work, subject)
                if done.name:
                    names = {"name": done.name, "before": done.before.stem, "subject": subject}
                    message = " ".join([self._words("live.improved", **names), *_outcomes(self._words, done)])
                    self._page.say(message, "good", lambda: self._take_back(done))
                else:
                    message = " ".join([self._words("live.improve_refused"), *_outcomes(self._words, done)])
                    self._page.say(message, "warning")
        finally:
            self._busy = False
            self._update_marks()

    async def _take_back(self, done: Improved) -> None:
        with self._page.show_errors():
            await asyncio.to_thread(self._feedback.take_back, done)
            self._page.say(self._words("live.taken_back", name=done.before.stem), "good")

    def _begin(self, event: EventSpan) -> str:
        # 8.95 is written as 9.0, as in the list of events.
        return self._words.number(round(event.begin_s, 2) + 1e-6, 1)

    def _update(self) -> None:
        self._update_event()
        self._update_marks()

    def _update_event(self) -> None:
        """Display the event that can be marked, and the gestures of the bundle in use."""
        words, bundle = self._words, self._reader.bundle
        self._event = event = self._feedback.last_event()
        self._wrong.set_enabled(event is not None)
        if event is None:
            self._which.set_text(words("live.wrong_none"))
        else:
            gesture = words.gesture(event.gesture or "")
            self._which.set_text(words("live.wrong_event", gesture=gesture, s=self._begin(event)))
        labels = bundle.gestures.labels if bundle is not None else ()
        if labels != self._labels:
            self._labels = labels
            options = {"": words("live.wrong_nothing")} | {label: words.gesture(label) for label in labels}
            self._right.set_options(options, value=self._right.value if self._right.value in options else "")

    def _update_marks(self) -> None:
        subject, n = self._people.code, 0
        if subject:
            # A code that is still being typed may be invalid.
            with contextlib.suppress(BadInput, OSError):
                n = self._feedback.count(subject)
        self._count.set_text(self._words("live.marks", subject=subject, n=n) if n else "")
        for control in (self._undo, self._improve):
            control.set_enabled(n > 0 and not self._busy)
        sources: list[Path] = []
        if subject:
            with contextlib.suppress(PlushSenseError, OSError):
                sources = self._feedback.sources(subject)
        everything = self._words("live.adapt_all", subject=subject)
        options = {str(p): p.name if p.name != subject else everything for p in sources}
        if options != self._recordings.options:
            self._recordings.set_options(options, value=next(iter(options), None))
        self._adapt.set_enabled(bool(options) and not self._busy)


def _outcomes(words: Words, done: Improved) -> Iterator[str]:
    """Yield a sentence on what the recordings changed, and one on what the marks did."""
    if (own := done.recordings) is not None:
        scores = {"n": own.before.recordings, "before": own.before.right, "after": own.after.right}
        yield words(f"live.own_{own.refusal or 'gain'}", **scores)
    if (marks := done.marks) is not None:
        before, after = (words.number(100.0 * share) for share in (marks.before, marks.after))
        yield words(f"live.marks_{marks.refusal or 'gain'}", n=marks.corrections, before=before, after=after)
