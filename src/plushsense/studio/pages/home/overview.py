"""Summarise the workspace for the home page and suggest the next step."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.core.errors import PlushSenseError
from plushsense.core.gestures import NOBODY
from plushsense.core.recorder_csv import parse_name
from plushsense.core.sentences import Message
from plushsense.dataset.marks import MARKS, RECORDER
from plushsense.dataset.privacy.removed import may_be_suggested
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, DatasetHead, RecordingInfo, read_index
from plushsense.recording.session import is_finished
from plushsense.recording.writer import SessionHead
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.workspace import BACKUPS, EXPORTS, Workspace, file_stamps

if TYPE_CHECKING:
    from plushsense.studio.app.stored_results import ResultRow

INDEX = "recordings.csv"
# Number of recordings in one session of the paper; fewer than this from a single person are too few to train on.
_ENOUGH = 51


@dataclass(frozen=True)
class DatasetEntry:
    """Summary of a data set. ``refused`` is the error message if it cannot be read; later fields are then empty.

    ``files`` are the file names of the recordings; a name contains the time of recording and so identifies it.
    """

    path: Path
    name: str
    refused: str = ""
    simulated: bool = False
    layout: str = ""
    people: int = 0
    recordings: int = 0
    excluded: int = 0
    bytes: int = 0
    reviewed: bool = False
    files: frozenset[str] = frozenset()


@dataclass(frozen=True)
class SessionEntry:
    """Summary of a recorded session.

    ``datasets`` are the names of the data sets that contain all its recordings; ``active`` is whether it is being
    recorded now; ``removed`` whether the person was removed from the workspace, so that it is not suggested.
    """

    path: Path
    subject: str
    session: str
    start_s: float = 0.0
    recordings: int = 0
    finished: bool = False
    simulated: bool = False
    layout: str = ""
    refused: str = ""
    datasets: tuple[str, ...] = ()
    active: bool = False
    removed: bool = False

    @property
    def waiting(self) -> bool:
        """True if the session has ended, has recordings of a person to suggest, and no data set contains them all."""
        return bool(self.recordings) and not (self.datasets or self.refused or self.active or self.removed)


@dataclass(frozen=True)
class BundleEntry:
    """Summary of a bundle (a model file) and its score; ``refused`` is the error message if it cannot be read."""

    path: Path
    name: str
    dataset: str = ""
    gestures: int = 0
    simulated: bool = False
    refused: str = ""
    score: ResultRow | None = None


@dataclass(frozen=True)
class WorkspaceSummary:
    """Contents of the workspace."""

    datasets: tuple[DatasetEntry, ...] = ()
    sessions: tuple[SessionEntry, ...] = ()
    bundles: tuple[BundleEntry, ...] = ()
    exports: int = 0
    discarded: tuple[Path, ...] = ()
    backups: tuple[Path, ...] = ()

    def batches(self) -> list[tuple[SessionEntry, ...]]:
        """Group sessions that can form one data set: same layout, all real or all simulated; real groups come first."""
        groups: dict[tuple[bool, str], list[SessionEntry]] = {}
        for s in self.sessions:
            if s.recordings and not s.refused:
                groups.setdefault((s.simulated, s.layout), []).append(s)
        return [tuple(groups[key]) for key in sorted(groups)]


@dataclass(frozen=True)
class NextStep:
    """The suggested next step.

    Attributes:
        key: key of the texts of the step and of its button, without prefix and suffix.
        page: page that the button opens; "" if there is no button or it starts an action.
        values: values to fill into the text; ``model`` is the network that the page opens.
    """

    key: str
    page: str = ""
    values: dict[str, Any] = field(default_factory=dict)


def next_step(summary: WorkspaceSummary, *, toy: str = "", virtual: bool = False, making: bool = False) -> NextStep:
    """Return the suggested next step.

    Args:
        toy: the chosen toy, "" for none.
        virtual: whether ``toy`` is virtual.
        making: whether a job is creating a data set.
    """
    if making:
        return NextStep("making")
    if active := [s for s in summary.sessions if s.active]:
        return NextStep("recording", "record", {"subject": active[0].subject, "session": active[0].session})
    waiting = [s for s in summary.sessions if s.waiting]
    bundles = [b for b in summary.bundles if not b.refused]
    readable = [d for d in summary.datasets if not d.refused and d.recordings]
    if waiting:
        return NextStep("collect", "", {"n": len(waiting), "recordings": sum(s.recordings for s in waiting)})
    if not readable and not bundles:
        unfinished = [s for s in summary.sessions if not (s.finished or s.refused or s.removed)]
        if unfinished:
            return NextStep("go_on", "record", {"subject": unfinished[-1].subject, "session": unfinished[-1].session})
        return NextStep("record", "record") if toy and not virtual else NextStep("try")
    unreviewed = [d for d in readable if not d.reviewed and not d.simulated]
    if not bundles:
        if unreviewed:
            return NextStep("review", "review", {"name": unreviewed[0].name})
        best = max(readable, key=lambda d: (d.people, d.recordings))
        if best.people == 1 and best.recordings < _ENOUGH:
            return NextStep("more", "record", {"name": best.name})
        return NextStep("train", "train", {"name": best.name})
    if unreviewed and all(b.simulated for b in bundles):
        # All bundles come from simulated data: continue with the real data.
        return NextStep("review", "review", {"name": unreviewed[0].name})
    usable = next((b for b in bundles if b.score is not None and b.score.usable), None)
    if usable is None:
        untested = next((b for b in bundles if b.score is not None and b.score.untested), None)
        if untested is None:
            return NextStep("improve", "record", {"name": bundles[0].name})
        return NextStep("test", "live", {"name": untested.name, "model": untested.path})
    return NextStep("live", "live", {"name": usable.name, "model": usable.path})


class Overview:
    """Reader of the workspace's contents. It caches results by file; do not call it in the event loop."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._cache: dict[Path, tuple[Any, Any]] = {}
        self._lock = threading.Lock()

    def look(self) -> WorkspaceSummary:
        """Return the current contents of the workspace."""
        with self._lock:
            datasets = tuple(self._cached(p, _dataset, HEAD, INDEX, MARKS) for p in self._workspace.datasets())
            active = {use.name for use in self._workspace.part(Toys).in_use}
            read = (_session(path, datasets) for path in self._workspace.sessions())
            home = self._workspace.folder
            sessions = tuple(
                replace(s, active=f"{s.subject}/{s.session}" in active, removed=not may_be_suggested(home, s.subject))
                for s in read
            )
            scores = self._scores()
            read_bundles = [self._cached(p, _bundle, "") for p in self._workspace.bundles()]
            bundles = tuple(replace(b, score=scores.get(b.path)) for b in read_bundles)
        exports = sum(1 for p in (self._workspace.folder / EXPORTS).glob("*") if p.is_dir() and p.name[0] != ".")
        backups = tuple(sorted((self._workspace.folder / BACKUPS).glob("*.zip")))
        return WorkspaceSummary(datasets, sessions, bundles, exports, tuple(self._workspace.discarded()), backups)

    def _scores(self) -> dict[Path, ResultRow]:
        """Return the stored score of each network."""
        if not self._workspace.bundles():
            return {}
        from plushsense.studio.app.stored_results import StoredResults

        return self._workspace.part(StoredResults).networks()

    def _cached(self, path: Path, read: Callable[[Path], Any], *files: str) -> Any:
        """Return ``read(path)``, cached until one of the files in ``path`` changes."""
        stamps = file_stamps(*(path / name for name in files))
        if self._cache.get(path, (None,))[0] != stamps:
            self._cache[path] = (stamps, read(path))
        return self._cache[path][1]


def _refusal(path: Path, cause: Exception) -> Message:
    if isinstance(cause, PlushSenseError) and cause.message.values:
        return cause.message
    return Message("This cannot be read: a file in it is damaged or missing ({path}).", path=str(path))


def _dataset(path: Path) -> DatasetEntry:
    try:
        head = DatasetHead.read(path)
        # A missing index is rebuilt when the data set is opened.
        rows = read_index(path / INDEX, RecordingInfo) if (path / INDEX).exists() else []
    except (PlushSenseError, OSError, ValueError, csv.Error) as cause:
        return DatasetEntry(path, path.name, _refusal(path, cause))
    return DatasetEntry(
        path,
        head.name,
        "",
        head.simulated,
        head.layout.name,
        people=len({r.subject for r in rows} - {NOBODY, UNKNOWN_SUBJECT}),
        recordings=len(rows),
        excluded=sum(r.excluded for r in rows),
        bytes=_size(path),
        reviewed=_reviewed(path),
        files=frozenset(r.file.rpartition("/")[2] for r in rows),
    )


def _size(path: Path) -> int:
    total = 0
    for place, _, names in os.walk(path):
        for name in names:
            with contextlib.suppress(OSError):
                total += Path(place, name).lstat().st_size
    return total


def _reviewed(path: Path) -> bool:
    """Return whether a person has set any mark; marks set by the recorder do not count as a review."""
    with contextlib.suppress(OSError):
        for line in (path / MARKS).read_bytes().splitlines():
            with contextlib.suppress(ValueError, AttributeError, RecursionError):
                if json.loads(line).get("who") != RECORDER:
                    return True
    return False


def _session(path: Path, datasets: Iterable[DatasetEntry]) -> SessionEntry:
    try:
        head = SessionHead.read(path)
        if head is None:
            return SessionEntry(path, path.parent.name, path.name)
        files = {f.name for f in path.iterdir() if parse_name(f.name) is not None}
        names = tuple(d.name for d in datasets if files and d.simulated == head.simulated and files <= d.files)
        return SessionEntry(
            path,
            head.subject,
            head.session,
            head.started_ms / 1000.0,
            len(files),
            is_finished(path),
            head.simulated,
            str(head.layout.get("name", "")),
            datasets=names,
        )
    except (PlushSenseError, OSError) as cause:
        return SessionEntry(path, path.parent.name, path.name, refused=_refusal(path, cause))


def _bundle(path: Path) -> BundleEntry:
    from plushsense.models.bundle import Bundle

    try:
        bundle = Bundle.load(path)
    except (PlushSenseError, OSError) as cause:
        return BundleEntry(path, path.stem, refused=_refusal(path, cause))
    origin = bundle.provenance
    return BundleEntry(path, path.stem, str(origin.get("dataset") or ""), len(bundle.gestures), bundle.simulated)
