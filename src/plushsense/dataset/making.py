"""From what a search found to a data set: copying, reading, people, marks, and the account of every file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.folders import whole_folder
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.recfile import parse_name
from plushsense.dataset.copying import ORPHAN, Copier, refuse_merged, safe
from plushsense.dataset.index import Progress, Rebuilt, build, with_marks, write
from plushsense.dataset.marks import Mark, append_marks, read_marks
from plushsense.dataset.people import PersonInfo, write_people
from plushsense.dataset.sources import COMPANIONS, LEFT_OUT, Found, Search
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, UNKNOWN_SUBJECT, Dataset, DatasetHead

RECORDER = "recorder"
SIMULATED = "these recordings are of the virtual toy: scores on them say nothing about a real one"
NO_PEOPLE = (
    "the folders are gestures, so the people are not known: splits by subject are not possible; "
    "import again with --subjects map.csv (columns file,subject) if a mapping exists"
)


@dataclass
class ImportSummary:
    """What an import did; ``rejected``, ``left_out`` and ``warnings`` name each file.

    ``recordings``, ``subjects``, ``gestures`` and ``streams`` count the data set as it is now; ``added`` the recordings
    and streams that are new, ``already_there`` the files that an import with ``add`` did not copy again. ``companions``
    (sidecars, session heads and logs) lie beside what they belong to.
    """

    dataset: Dataset
    recordings: int
    subjects: int
    gestures: list[str]
    streams: int
    rejected: list[dict[str, str]]
    warnings: list[str]
    seconds: float
    notes: list[str] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    companions: int = 0
    excluded: int = 0
    added: dict[str, int] = field(default_factory=dict)
    already_there: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "recordings": self.recordings,
            "subjects": self.subjects,
            "gestures": self.gestures,
            "streams": self.streams,
            "rejected": self.rejected,
            "left_out": self.left_out,
            "companions": self.companions,
            "excluded": self.excluded,
            "added": self.added,
            "already_there": self.already_there,
            "warnings": self.notes + self.warnings,
            "seconds": round(self.seconds, 2),
            "hash": self.dataset.hash,
        }


class Account:
    """Where each file of a search went; they are copied into the copier's work folder."""

    def __init__(self, search: Search, copier: Copier):
        self.search = search
        self.copier = copier
        self.rejected: list[dict[str, str]] = []
        self.left_out: list[dict[str, str]] = []
        self._origin: dict[str, Found] = {}
        refuse_merged(
            [f for f in search.found if f.kind in (RECORDINGS, STREAMS)], people_there(copier.contents.values())
        )
        # A companion goes where its file went.
        for found in sorted(search.found, key=lambda f: f.kind == COMPANIONS):
            if found.kind == LEFT_OUT:
                self.left_out.append({"file": found.origin, "reason": found.reason})
            elif not found.kind:
                self.reject(found, found.reason)
            elif reason := copier.copy(found):
                self.reject(found, reason)
            elif found.source in copier.copied:
                self._origin[copier.copied[found.source]] = found

    def reject(self, found: Found, reason: str) -> None:
        self.rejected.append({"file": found.origin, "reason": reason})

    def drop(self, unreadable: Mapping[str, str]) -> None:
        """Take what could not be read out of the work folder again, with its companions."""
        for file, reason in unreadable.items():
            self.reject(self._origin[file], reason)
            self._remove(file)
            for source in self.copier.companions.pop(file, ()):
                companion = self.copier.copied.get(source)
                if companion is not None:
                    self.reject(self._origin[companion], ORPHAN.format(Path(file).name))
                    self._remove(companion)

    def _remove(self, file: str) -> None:
        (self.copier.work / file).unlink()
        del self.copier.copied[self._origin.pop(file).source]

    @property
    def kept(self) -> dict[str, Found]:
        """What was copied, by its path below the data set."""
        return dict(self._origin)

    def count(self, kind: str) -> int:
        """How many files of a kind were copied."""
        return sum(f.kind == kind for f in self._origin.values())

    def check(self) -> None:
        """Nothing is forgotten."""
        accounted = len(self._origin) + len(self.copier.already) + len(self.rejected) + len(self.left_out)
        assert accounted == len(self.search.found), "every source file is imported, left out or rejected"

    def aside(self) -> dict[str, str]:
        """Why the recorder does not want a recording used, "" where it does, by id; also of those there before."""
        places = self.copier.copied | self.copier.already
        mine = (f for f in self.search.found if f.kind == RECORDINGS and f.source in places)
        return {identity(places[f.source]): f.aside for f in mine}


def identity(file: str) -> str:
    """The id of a recording by its path below the data set."""
    return file.removeprefix(f"{RECORDINGS}/").rpartition(".")[0]


def people_there(files: Iterable[str]) -> set[str]:
    """Folders of people, by the paths of raw files below the data set."""
    return {parts[1] for path in files if len(parts := path.split("/")) > 2 and parts[0] in (RECORDINGS, STREAMS)}


def extended(given: GestureSet | None, dataset: Dataset) -> GestureSet:
    """The given set with every label that it lacks, or the set that the recordings imply."""
    if given is None:
        return GestureSet.infer(r.gesture for r in dataset.recordings)
    unknown = sorted(r.gesture for r in dataset.recordings if given.find(r.gesture) is None)
    if not unknown:
        return given
    return GestureSet(given.name, given.gestures + GestureSet.infer(unknown).gestures, given.inferred)


def merged_people(
    there: Mapping[str, PersonInfo], sessions: Iterable[PersonInfo], file: Mapping[str, PersonInfo], subjects: set[str]
) -> tuple[list[PersonInfo], list[str]]:
    """The people's table: what is there, its gaps filled by the sessions, and over both what the user's file says."""
    people, notes = dict(there), []
    for said in sessions:
        code = safe(said.subject)
        was = people.get(code)
        if code == NOBODY:
            continue
        if was is None:
            people[code] = replace(said, subject=code)
            continue
        for key in ("age_group", "gender", "consent"):
            now, then = getattr(said, key), getattr(was, key)
            if now and then and now != then:
                notes.append(f"the {key.replace('_', ' ')} of '{code}' is kept as '{then}'; a session says '{now}'")
            elif now and not then:
                was = replace(was, **{key: now})
        people[code] = was
    strangers = []
    for code, said in file.items():
        if safe(code) not in subjects:
            strangers.append(code)
            continue
        was = people.get(safe(code), PersonInfo(safe(code)))
        own = {key: getattr(said, key) or getattr(was, key) for key in ("age_group", "gender", "consent")}
        people[safe(code)] = PersonInfo(safe(code), **own, more=was.more | said.more)
    if strangers:
        notes.append(
            f"people of the people's file who are not in the data set were left out ({len(strangers)}): "
            + ", ".join(f"'{s}'" for s in strangers[:5])
            + (", …" if len(strangers) > 5 else "")
        )
    return list(people.values()), notes


def make(
    source: Path,
    dest: Path,
    search: Search,
    head: DatasetHead,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
) -> ImportSummary:
    """Make the data set ``dest`` of what a search found, whole or not at all.

    Raises:
        DatasetError: when nothing can be read, or ``dest`` holds something already.
    """
    with whole_folder(dest, DatasetError, last=HEAD) as work:
        account = Account(search, Copier(work))
        if search.gestures is None:
            names = (parse_name(Path(file).name) for file in account.kept)
            head = replace(head, gestures=GestureSet.infer(n.label for n in names if n is not None))
        built = read_all(account, head, progress)
        if not built.dataset.recordings:
            reasons = [*built.unreadable.values(), *(r["reason"] for r in account.rejected), *search.notes[-1:]]
            if not reasons:
                raise DatasetError(f"'{source}' holds no finished recording yet, only a stream: record some first.")
            raise DatasetError(
                f"'{source}' holds no recording that layout '{head.layout.name}' can read. The first: {reasons[0]}"
            )
        head = replace(head, gestures=extended(search.gestures, built.dataset))
        if {r.gesture for r in built.dataset.recordings} - set(head.gestures.labels):
            # Spellings were merged: the recordings are named once more by the whole set.
            built = build(work, head)
        listed, notes = merged_people({}, search.people, people, {r.subject for r in built.dataset.recordings})
        if listed:
            write_people(work, listed)
        if marks := [Mark(i, "exclude", RECORDER, why) for i, why in account.aside().items() if why]:
            append_marks(work, marks)
        (work / HEAD).write_text(head.to_toml(), encoding="utf-8")
        infos = with_marks(built.dataset.recordings, read_marks(work))
        write(Dataset(work, head, infos, built.dataset.streams))
        account.check()
    dataset = Dataset(dest, head, infos, built.dataset.streams)
    return summary_of(dataset, account, search.notes + notes, set(account.kept))


def read_all(account: Account, head: DatasetHead, progress: Progress | None) -> Rebuilt:
    """Read what was copied; what cannot be read is taken out again."""
    built = build(account.copier.work, head, progress)
    account.drop(built.unreadable)
    return built


def summary_of(dataset: Dataset, account: Account, notes: list[str], new: set[str]) -> ImportSummary:
    """The summary of an import that brought the files ``new``."""
    said = [SIMULATED] if dataset.head.simulated else []
    said += notes
    if any(r.subject == UNKNOWN_SUBJECT for r in dataset.recordings):
        said.append(NO_PEOPLE)
    flagged = [(s.id, s.flags) for s in dataset.streams if s.file in new]
    flagged += [(r.id, r.flags) for r in dataset.recordings if r.file in new]
    mine = [r for r in dataset.recordings if r.file in new]
    return ImportSummary(
        dataset,
        len(dataset.recordings),
        len(dataset.subjects),
        sorted({r.gesture for r in dataset.recordings}),
        len(dataset.streams),
        account.rejected,
        [f"{identity}: {flag}" for identity, flags in flagged for flag in flags],
        0.0,
        said,
        left_out=account.left_out,
        companions=account.count(COMPANIONS),
        excluded=sum(r.excluded for r in mine),
        added={"recordings": len(mine), "streams": account.count(STREAMS)},
        already_there=len(account.copier.already),
    )
