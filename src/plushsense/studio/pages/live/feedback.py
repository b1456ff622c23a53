"""Keep the reported events that a person marks as wrong on the live page, and fit the network to these corrections.

The corrections of a person are in ``feedback/<subject>.jsonl`` in the studio's folder (see `plushsense.live.feedback`).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import ConfigError
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
    """Result of `Feedback.improve`: ``name`` of the new bundle ("" if none was written), and of the one ``before``."""

    name: str
    before: str
    reason: str


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
                raise ConfigError("This event is marked already: wait for the next one.")
            if device is None or bundle is None or event is None or event.gesture is None or event.named_s is None:
                raise ConfigError("This event is not kept any more: mark an event soon after it.")
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
                raise ConfigError("No network is in use: start a toy first.")
            before = choice.bundle
            done = correct(Bundle.load(self._workspace.inside(before)), read_corrections(path))
            if not done.accepted:
                return Improved("", before.stem, done.reason)
            out = self._save(done, before.stem, path.stem)
        self._reader.choose(out, choice.engine, choice.reactions)
        self.changed.notify()
        return Improved(out.stem, before.stem, done.reason)

    def _save(self, done: Corrected, stem: str, subject: str) -> Path:
        """Write a corrected bundle under a new name in the studio's folder, and return its path."""
        base = stem.partition(f"-for-{subject}")[0]
        name = f"{plain_name(base, 'network')[:40]}-for-{subject}"
        return done.bundle.save(
            self._workspace.new(BUNDLES, self._workspace.free_name(BUNDLES, name, _SUFFIX) + _SUFFIX)
        )

    def _path(self, subject: str) -> Path:
        return self._workspace.inside(Path(FOLDER) / f"{check_subject(subject.strip())}.jsonl")
