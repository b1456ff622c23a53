"""Adding recordings to a data set that exists: only what is new by content, and nothing there is lost.

A session that was resumed since has a longer stream and log, which begin with what is there: these take its place.

The order of writing leaves a valid data set wherever it stops: the gesture set and the marks first (both mean nothing
without their recordings), then each file by an atomic rename, the index last; done again, it goes on.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from filelock import FileLock, Timeout

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.dataset.copying import Copier, key_of
from plushsense.dataset.forget import forgotten
from plushsense.dataset.freshness import sha256_of
from plushsense.dataset.index import Progress, open_dataset, rebuild
from plushsense.dataset.making import RECORDER, Account, ImportSummary, extended, merged_people, read_all, summary_of
from plushsense.dataset.marks import MARKS, Mark, append_marks
from plushsense.dataset.people import PersonInfo, read_people, write_people
from plushsense.dataset.sources import Search
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, Dataset, write_atomically

CACHE = "cache"


@contextmanager
def _workplace(dest: Path) -> Iterator[Path]:
    """A folder on the data set's own disk, held by one import at a time; what a killed one left is removed."""
    cache = dest / CACHE
    cache.mkdir(exist_ok=True)
    try:
        with FileLock(cache / "adding.lock", timeout=0):
            for left in cache.glob("adding-*"):
                shutil.rmtree(left, ignore_errors=True)
            work = Path(tempfile.mkdtemp(prefix="adding-", dir=cache))
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except Timeout:
        raise DatasetError(f"Another import is adding to '{dest}' just now: wait for it to end.") from None


def _copier(dataset: Dataset, work: Path) -> Copier:
    """A copier into ``work`` that knows what the data set has."""
    taken: dict[str, str] = {}
    contents: dict[tuple[str, str], str] = {}
    for kind, infos in ((RECORDINGS, dataset.recordings), (STREAMS, dataset.streams)):
        for info in infos:
            # Recordings that are rows of a stream are no files of their own.
            if info.file.startswith(f"{kind}/"):
                taken[key_of(info.file, companion=False)] = info.sha256
                contents[(kind, info.sha256)] = info.file
    for kind in (RECORDINGS, STREAMS):
        for place, _, names in os.walk(dataset.path / kind):
            for name in names:
                path = Path(place) / name
                file = path.relative_to(dataset.path).as_posix()
                if not name.lower().endswith(".csv"):
                    taken[key_of(file, companion=True)] = sha256_of(path)
    return Copier(work, taken, contents, dataset.path)


def _decided(folder: Path) -> dict[str, tuple[str, str]]:
    """The last word on using each recording that is marked: exclude or include, and whose it is."""
    decided: dict[str, tuple[str, str]] = {}
    try:
        lines = (folder / MARKS).read_bytes().split(b"\n")
    except FileNotFoundError:
        return decided
    for line in lines:
        try:
            mark = json.loads(line)
            if mark["action"] in ("exclude", "include"):
                decided[str(mark["recording"])] = (mark["action"], mark["who"])
        except (ValueError, TypeError, KeyError, RecursionError):
            continue
    return decided


def _new_marks(aside: Mapping[str, str], decided: Mapping[str, tuple[str, str]]) -> list[Mark]:
    """What the recorder says now and did not say before; what a person decided since stands."""
    marks = []
    for recording, why in aside.items():
        action, who = decided.get(recording, ("include", RECORDER))
        wanted = "exclude" if why else "include"
        if who == RECORDER and action != wanted:
            marks.append(Mark(recording, wanted, RECORDER, why or "kept after all"))
    return marks


def refuse_mixture(dataset: Dataset, search: Search) -> None:
    """Refuse to put recordings of the virtual toy among real ones, or the other way round."""
    if dataset.head.simulated != search.simulated:
        mine, theirs = ("real", "virtual") if search.simulated else ("virtual", "real")
        raise DatasetError(
            f"'{dataset.path}' holds recordings of a {mine} toy and the source those of a {theirs} one: "
            "keep them apart."
        )


def add(
    dest: Path,
    search: Search,
    gestures: GestureSet | None,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
) -> ImportSummary:
    """Add what a search found to the data set ``dest``; ``gestures`` may say more of gestures that are new to it.

    Raises:
        DatasetError: when the data set cannot be opened or written, or another import is at work.
    """
    with _workplace(dest) as work:
        dataset = open_dataset(dest)
        refuse_mixture(dataset, search)
        copier = _copier(dataset, work)
        account = Account(search, copier)
        head = replace(dataset.head, gestures=_with_described(dataset.head.gestures, gestures))
        built = read_all(account, head, progress)
        if account.rejected and not account.kept and not copier.already:
            file, reason = account.rejected[0].values()
            raise DatasetError(
                f"Nothing of the source fits '{dest}', whose layout is '{head.layout.name}': all "
                f"{len(account.rejected)} files are rejected. The first: '{file}': {reason.rstrip('.')}."
            )
        head = replace(head, gestures=extended(head.gestures, built.dataset))
        subjects = {r.subject for r in (*dataset.recordings, *built.dataset.recordings)}
        there = read_people(dest)
        listed, notes = merged_people(there, search.people, people, subjects)
        account.check()
        new = set(account.kept)
        if head.gestures != dataset.head.gestures:
            write_atomically(dest / HEAD, head.to_toml())
        marks = _new_marks(account.aside(), _decided(dest))
        if marks:
            append_marks(dest, marks)
        if {p.subject: p for p in listed} != there:
            write_people(dest, listed)
        # Companions first: a recording that is there has its sidecar.
        for file in sorted(new, key=lambda f: (f.lower().endswith(".csv"), f)):
            target = dest / file
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists() and file not in copier.grown:
                raise DatasetError(f"'{target}' appeared while adding: nothing is overwritten, so run it once more.")
            os.replace(work / file, target)
        rebuilt = rebuild(dest, head).dataset if new or marks else open_dataset(dest)
    come = sorted(set(rebuilt.subjects) - set(dataset.subjects))
    return summary_of(rebuilt, account, search.notes + notes + _came_back(dest, come), new)


def _came_back(dest: Path, come: list[str]) -> list[str]:
    """A warning where people come into a data set that others were taken out of: nobody knows any more who that was."""
    gone = forgotten(dest)
    if not come or not gone:
        return []
    days = ", ".join(dict.fromkeys(g.day for g in gone))
    return [
        f"people were forgotten here ({len(gone)}; {days}), and {', '.join(come[:5])} just came in"
        f"{f' with {len(come) - 5} more' if len(come) > 5 else ''}: whoever should not be here, take out again with  "
        f"plushsense forget {dest} CODE"
    ]


def _with_described(mine: GestureSet, more: GestureSet | None) -> GestureSet:
    """The data set's gestures in their order, and after them those that ``more`` describes and they lack."""
    new = tuple(g for g in (more.gestures if more is not None else ()) if mine.find(g.label) is None)
    return GestureSet(mine.name, mine.gestures + new, mine.inferred and not new) if new else mine
