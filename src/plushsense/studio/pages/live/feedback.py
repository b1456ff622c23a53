"""Keep the reported events that a person marks as wrong on the live page, and fit the network to these corrections.

The corrections of a person are in ``feedback/<subject>.jsonl`` in the studio's folder (see `plushsense.live.feedback`).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.recorder_csv import parse_name
from plushsense.experiments.adaptation import adapt
from plushsense.live.adaptation import Personal
from plushsense.live.feedback import (
    FOLDER,
    Corrected,
    append_corrections,
    correct,
    cut_correction,
    read_corrections,
    remove_last_correction,
)
from plushsense.models.bundle import Bundle
from plushsense.recording.session import check_subject
from plushsense.studio.app.workspace import BUNDLES, ChangeSignal, Workspace, plain_name
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.state import EventSpan

EVENT_S = 22.0
"""Longest part of an event that is kept, its last seconds; a correction has at most 30 s of rows."""
WAIT_S = 25.0
"""Time after the end of an event in which it can be marked; its rows are then still in the buffer of the toy."""
_SUFFIX = ".plush"


@dataclass(frozen=True)
class Improved:
    """Result of `Feedback.improve` and `Feedback.adapt`.

    Attributes:
        name: name of the new bundle, "" if none was written.
        before: the bundle in use before.
        recordings: what the recordings of the person changed, if there were any.
        marks: what the marks of the person changed, if there were any.
    """

    name: str
    before: Path
    recordings: Personal | None = None
    marks: Corrected | None = None


class Feedback:
    """Service that keeps corrections and fits bundles to them; it notifies `changed` after each change."""

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace = workspace
        self._reader = workspace.part(LiveReader)
        self._lock = threading.Lock()
        # Events that were marked, by number: the person whose file has the mark, and the right gesture, if known.
        self._marked: dict[int, tuple[str, str]] = {}

    def last_event(self) -> EventSpan | None:
        """Return the last event that names a gesture of the bundle in use, unless it is marked or long ago."""
        bundle, now_s = self._reader.bundle, self._reader.now.t_s
        if bundle is None:
            return None
        for span in reversed(self._reader.spans()):
            if span.named_s is not None and span.gesture in bundle.gestures.labels:
                late = span.end_s is not None and now_s - span.end_s > WAIT_S
                return None if late or span.number in self._marked else span
        return None

    def marks(self) -> dict[int, tuple[str, str]]:
        """Return the events that were marked since the studio was started: number to person and right gesture."""
        with self._lock:
            return dict(self._marked)

    def count(self, subject: str) -> int:
        """Return the number of marks of a person; raise DatasetError for an invalid code."""
        path = self._path(subject)
        return sum(bool(line.strip()) for line in path.read_bytes().splitlines()) if path.is_file() else 0

    def mark(self, number: int, subject: str, right: str = "") -> int:
        """Keep an event as wrong, and return the number of marks of the person.

        Args:
            number: that of `last_event`.
            right: label of the gesture that was really made; "" for none, or if it is not known.

        Raises:
            ConfigError: if the event is marked already, or too long ago.
            DatasetError: for an invalid ``subject``.
            BadInput: for an invalid ``right``, if the rows are not kept any more, or if the file cannot be written.
        """
        device, bundle = self._reader.device, self._reader.bundle
        with self._lock:
            path = self._path(subject)
            event = next((span for span in self._reader.spans() if span.number == number), None)
            if number in self._marked:
                raise ConfigError("This event is marked already: wait for the next one.", reason="marked_already")
            if device is None or bundle is None or event is None or event.gesture is None or event.named_s is None:
                message = "This event is not kept any more: mark an event soon after it."
                raise ConfigError(message, reason="event_not_kept")
            first_s, frames = device.buffer.rows()
            ended_s = event.closed_s or event.end_s or self._reader.now.t_s
            times_s = max(event.named_s, ended_s - EVENT_S) - first_s, ended_s - first_s
            correction = cut_correction(bundle, frames, event.gesture, *times_s, subject=path.stem, right=right)
            path.parent.mkdir(parents=True, exist_ok=True)
            append_corrections(path, [correction])
            self._marked[number] = (path.stem, right)
            count = self.count(subject)
        self.changed.notify()
        return count

    def undo(self, subject: str) -> int:
        """Remove the last mark of a person, and return the number of those that are left.

        Raises:
            DatasetError: for an invalid ``subject``. BadInput: if the file cannot be written.
        """
        with self._lock:
            path = self._path(subject)
            if remove_last_correction(path):
                # The event can be marked again if it was marked since the studio was started.
                self._marked.pop(next((n for n in reversed(self._marked) if self._marked[n][0] == path.stem), 0), None)
            count = self.count(subject)
        self.changed.notify()
        return count

    def improve(self, subject: str) -> Improved:
        """Fit the bundle in use to the marks of a person, and use the result, which is written as a new bundle.

        Raises:
            ConfigError: if no bundle is in use. BadInput: as `correct` and `read_corrections`.
        """
        with self._lock:
            path, choice = self._path(subject), self._reader.choice
            if choice.bundle is None:
                raise _no_network()
            before = choice.bundle
            done = correct(Bundle.load(self._workspace.inside(before)), read_corrections(path))
            result = Improved("", before, marks=done)
            return self._use(result, done.bundle, path.stem) if done.accepted else result

    def sources(self, subject: str) -> list[Path]:
        """Return the folders with recordings of a person: that of all sessions, if there are several, and each."""
        person = self._workspace.inside(self._workspace.recordings / check_subject(subject))
        sessions = [p for p in sorted(person.glob("*")) if any(parse_name(file.name) for file in p.glob("*.csv"))]
        return [person, *sessions] if len(sessions) > 1 else sessions

    def adapt(self, subject: str, recordings: Path) -> Improved:
        """Adapt the bundle in use to a person, and use the result, which is written as a new bundle.

        Args:
            recordings: one of `sources`. The marks of the person are used, too.

        Raises:
            ConfigError: if no bundle is in use. BadInput: as `plushsense.experiments.adaptation.adapt`.
        """
        with self._lock:
            path, choice = self._path(subject), self._reader.choice
            if choice.bundle is None:
                raise _no_network()
            before = choice.bundle
            bundle = Bundle.load(self._workspace.inside(before))
            marks = path if self.count(subject) else None
            place = self._workspace.inside(recordings)
            done = adapt(bundle, place, subject=path.stem, feedback=marks)
            result = Improved("", before, done.personal, done.corrected)
            return self._use(result, done.bundle, path.stem) if done.accepted else result

    def _use(self, result: Improved, bundle: Bundle, subject: str) -> Improved:
        """Write a bundle under a new name in the studio's folder, and use it."""
        out, choice = self._save(bundle, result.before.stem, subject), self._reader.choice
        self._reader.choose(out, choice.engine, choice.reactions)
        self.changed.notify()
        return replace(result, name=out.stem)

    def take_back(self, result: Improved) -> None:
        """Use the bundle before an improvement again; the improved one is kept."""
        choice = self._reader.choice
        self._reader.choose(result.before, choice.engine, choice.reactions)

    def _save(self, bundle: Bundle, stem: str, subject: str) -> Path:
        base = stem.partition(f"-for-{subject}")[0]
        name = f"{plain_name(base, 'network')[:40]}-for-{subject}"
        return bundle.save(self._workspace.new(BUNDLES, self._workspace.free_name(BUNDLES, name, _SUFFIX) + _SUFFIX))

    def _path(self, subject: str) -> Path:
        return self._workspace.inside(Path(FOLDER) / f"{check_subject(subject.strip())}.jsonl")


def _no_network() -> ConfigError:
    return ConfigError("No network is in use: start a toy first.", reason="no_network")
