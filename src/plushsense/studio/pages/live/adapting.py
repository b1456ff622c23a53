"""Adapt the network in use on the live page to recordings of one person, and take the former network back."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.recorder_csv import parse_name
from plushsense.experiments.adaptation import adapt
from plushsense.live.adaptation import Personal
from plushsense.models.bundle import Bundle
from plushsense.recording.session import check_subject
from plushsense.studio.app.workspace import BUNDLES, ChangeSignal, Workspace, plain_name
from plushsense.studio.pages.live.reader import LiveReader

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
            out = self._save(done.bundle, choice.bundle.stem, subject)
            self._reader.choose(out, choice.engine, choice.reactions)
        self.changed.notify()
        return Improved(out.stem, choice.bundle, done.personal)

    def take_back(self, result: Improved) -> None:
        """Use the bundle before an improvement again; the improved one is kept."""
        choice = self._reader.choice
        self._reader.choose(result.before, choice.engine, choice.reactions)

    def _save(self, bundle: Bundle, stem: str, subject: str) -> Path:
        base = stem.partition(f"-for-{subject}")[0]
        name = f"{plain_name(base, 'network')[:40]}-for-{subject}"
        return bundle.save(self._workspace.new(BUNDLES, self._workspace.free_name(BUNDLES, name, _SUFFIX) + _SUFFIX))
