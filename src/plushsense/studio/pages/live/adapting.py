"""Adapt the network in use on the live page to recordings of one person, and take the former network back."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from nicegui import ui

from plushsense.core.errors import BadInput, ConfigError, DatasetError, PlushSenseError
from plushsense.core.recorder_csv import parse_name
from plushsense.experiments.adaptation import adapt
from plushsense.live.adaptation import Personal, PersonalSpec
from plushsense.models.bundle import Bundle
from plushsense.recording.session import check_subject
from plushsense.studio.app.shell import Page, button, named, on_change, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BUNDLES, ChangeSignal, Workspace, plain_name
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.validation import Validation

_OUTCOMES: Texts = {
    "gain": "Of {n} own recordings, each left out once, it reads {after} right instead of {before}.",
    "no_gain": (
        "The recordings would not clearly help: of {n}, each left out once, {after} instead of {before} would be "
        "read right."
    ),
    "inseparable": (
        "The recordings cannot be told apart (of {n}, {after} are read right): perhaps their gestures or the sensors "
        "are wrong."
    ),
}


_SUFFIX = ".plush"


@dataclass(frozen=True)
class Improved:
    """Result of `Adapting.adapt`.

    Attributes:
        name: name of the new bundle, "" if none was written.
        before: the bundle in use before.
        personal: what the recordings of the person changed.
    """

    name: str
    before: Path
    personal: Personal


class Adapting:
    """Service that adapts the bundle in use to a person; it notifies `changed` when another bundle is in use."""

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace = workspace
        self._reader = workspace.part(LiveReader)
        self._lock = threading.Lock()

    def sources(self, subject: str) -> list[Path]:
        """Return the folders with recordings of a person: that of all sessions, if there are several, and each."""
        person = self._workspace.inside(self._workspace.recordings / check_subject(subject))
        sessions = [p for p in sorted(person.glob("*")) if any(parse_name(file.name) for file in p.glob("*.csv"))]
        return [person, *sessions] if len(sessions) > 1 else sessions

    def adapt(self, subject: str, recordings: Path) -> Improved:
        """Adapt the bundle in use to a person, and use the result, which is written as a new bundle.

        Args:
            recordings: one of `sources`.

        Raises:
            ConfigError: if no bundle is in use. DatasetError: for an invalid ``subject``.
            BadInput: as `plushsense.experiments.adaptation.adapt`.
        """
        with self._lock:
            subject, choice = check_subject(subject.strip()), self._reader.choice
            if choice.bundle is None:
                raise ConfigError("No network is chosen. Choose one, or train one first.", field="network")
            bundle = Bundle.load(self._workspace.inside(choice.bundle))
            done = adapt(bundle, self._workspace.inside(recordings), subject=subject)
            if not done.accepted:
                return Improved("", choice.bundle, done.personal)
            base = plain_name(choice.bundle.stem.partition(f"-for-{subject}")[0], "network")[:40]
            name = self._workspace.free_name(BUNDLES, f"{base}-for-{subject}", _SUFFIX)
            out = done.bundle.save(self._workspace.new(BUNDLES, name + _SUFFIX))
            self._reader.choose(out, choice.engine, choice.reactions)
        self.changed.notify()
        return Improved(out.stem, choice.bundle, done.personal)

    def take_back(self, result: Improved) -> None:
        """Use the bundle before an improvement again; the improved one is kept."""
        choice = self._reader.choice
        self._reader.choose(result.before, choice.engine, choice.reactions)


def show(page: Page, people: PersonFields) -> None:
    """Build the part, which is beside the current event."""
    box = ui.element("div").props("role=group").classes("w-full column no-wrap ps-small-gap q-mt-sm")
    with named(box, page.words("Adapt the network to a person")):
        _AdaptingPanel(page, people)


class PersonFields:
    """The fields of a page for the code of the person who touches the toy; all of them hold the same text."""

    def __init__(self, page: Page, reader: LiveReader) -> None:
        self._page, self._reader = page, reader
        self._fields: list[ui.input] = []
        self.code = reader.subject

    def add(self, name: str, about: str, on_change: Callable[[], None] = lambda: None) -> ui.input:
        """Add a field; ``on_change`` is called when the text of any field has changed.

        Args:
            about: what the code is used for; screen readers read it after the label.
        """
        field = ui.input(self._page.words("Code of the person"), value=self.code, placeholder="S01")
        tag(named(field, f"{self._page.words('Code of the person')}: {about}").props("maxlength=16"), name)
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
        try:
            text = check_subject(self.code)
            if known := self._page.workspace.codes().same(text):
                raise DatasetError(
                    "“{code}” is written almost like {known}. Enter {known} if it is the same person, else another "
                    "code.",
                    code=text,
                    known=known,
                )
        except BadInput as refusal:
            missing = self._page.words(
                "First enter the code of the person who touches the toy, for example S01 and never a name."
            )
            field.error = self._page.words.error(refusal) if self.code else missing
            field.run_method("focus")
            return ""
        return text


class _AdaptingPanel:
    """Fields and buttons that adapt the network in use to recordings of a person, and take the former one back."""

    def __init__(self, page: Page, people: PersonFields) -> None:
        self._words, self._people = page.words, people
        self._adapting = page.workspace.part(Adapting)
        self._busy = False
        words = page.words
        title = words("Adapt the network to a person")
        ui.label(title).classes("text-bold")
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._person = people.add("adapt-person", title, self._update).style("flex: 1 1 9rem")
            self._recordings = tag(ui.select({}, label=words("Recordings of the person")), "adapt-from")
            self._recordings.style("flex: 1 1 15rem; min-width: 0")
            self._adapt = button("adapt", words("Adapt to these recordings"), self._run, icon="auto_fix_high")
        # Messages are displayed here, because the top of the page may be out of view.
        self._page = replace(page, _messages=ui.column().classes("w-full ps-messages"))
        on_change(self._adapting.changed, self._update)
        on_change(page.workspace.part(Validation).changed, self._update)
        self._update()

    async def _run(self) -> None:
        """Adapt the network, and say what changed, with a button to undo it."""
        if self._busy or not (subject := self._people.checked(self._person)):
            return
        words, recordings = self._words, Path(str(self._recordings.value or ""))
        self._busy = True
        self._page.say(words("The network is being improved…"))
        self._update()
        try:
            with self._page.show_errors():
                done = await asyncio.to_thread(self._adapting.adapt, subject, recordings)
                own = done.personal
                scores = {"n": own.before.recordings, "before": own.before.right, "after": own.after.right}
                outcome = words(_OUTCOMES[own.refusal or "gain"], **scores)
                if own.without:
                    few = {"n": PersonalSpec().least, "gestures": ", ".join(map(words.gesture, own.without))}
                    outcome += f" {words('Fewer than {n} recordings, so unchanged: {gestures}.', **few)}"
                if done.name:
                    names = {"name": done.name, "before": done.before.stem, "subject": subject}
                    message = words(
                        "Now in use for {subject}: {name}. The former network, {before}, is unchanged.", **names
                    )
                    self._page.say(f"{message} {outcome}", "good", lambda: self._take_back(done))
                else:
                    self._page.say(f"{words('The network stays as it is.')} {outcome}", "warning")
        finally:
            self._busy = False
            self._update()

    async def _take_back(self, done: Improved) -> None:
        with self._page.show_errors():
            await asyncio.to_thread(self._adapting.take_back, done)
            self._page.say(self._words("The network {name} is in use again.", name=done.before.stem), "good")

    def _update(self) -> None:
        subject = self._people.code
        sources: list[Path] = []
        if subject:
            # A code that is still being typed may be invalid.
            with contextlib.suppress(PlushSenseError, OSError):
                sources = self._adapting.sources(subject)
        everything = self._words("all recordings of {subject}", subject=subject)
        options = {str(p): p.name if p.name != subject else everything for p in sources}
        if options != self._recordings.options:
            self._recordings.set_options(options, value=next(iter(options), None))
        self._adapt.set_enabled(bool(options) and not self._busy)
