"""Add the files of a source to an existing data set; existing files, marks and class numbers stay as they are."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from filelock import Timeout

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.gestures import GestureSet
from plushsense.core.sentences import Message, join_names
from plushsense.dataset.files import CACHE, sha256_of, walk_files
from plushsense.dataset.importing.build import (
    RECORDER,
    Copier,
    ImportedFiles,
    ImportSummary,
    extend_gestures,
    key_of,
    merge_people,
    read_copied,
    summarize_import,
    unknown_labels,
)
from plushsense.dataset.importing.sources import SourceScan
from plushsense.dataset.index import open_dataset, rebuild_index
from plushsense.dataset.marks import MARKS, Mark, adding_locked, read_marks, write_marks
from plushsense.dataset.privacy.forget import read_removals
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    STREAMS,
    Dataset,
    Generation,
    PersonInfo,
    Progress,
    read_people,
    write_people,
)


@contextmanager
def _locked_work_folder(dest: Path) -> Iterator[Path]:
    """Create a work folder on the disk of the data set for one import at a time; remove those of killed imports."""
    cache = dest / CACHE
    try:
        with adding_locked(dest):
            cache.mkdir(exist_ok=True)
            for left in cache.glob("adding-*"):
                shutil.rmtree(left, ignore_errors=True)
            work = Path(tempfile.mkdtemp(prefix="adding-", dir=cache))
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except Timeout:
        raise DatasetError("Another import is adding to '{dest}' now: wait until it ends.", dest=dest) from None


def _copier(dataset: Dataset, work: Path) -> Copier:
    """Create a copier into ``work`` that does not copy files of the data set again."""
    taken: dict[str, str] = {}
    contents: dict[tuple[str, str], str] = {}
    for kind, infos in ((RECORDINGS, dataset.recordings), (STREAMS, dataset.streams)):
        for info in infos:
            # Recordings that are parts of a stream have no file of their own.
            if info.file.startswith(f"{kind}/"):
                taken[key_of(info.file, companion=False)] = info.sha256
                contents[(kind, info.sha256)] = info.file
    for path in (*walk_files(dataset.path / RECORDINGS), *walk_files(dataset.path / STREAMS)):
        if path.suffix.lower() != ".csv":
            taken[key_of(path.relative_to(dataset.path).as_posix(), companion=True)] = sha256_of(path)
    return Copier(work, taken, contents, dataset.path)


def _new_marks(folder: Path, set_aside: Mapping[str, str]) -> list[Mark]:
    """Return marks for recordings that the recorder has discarded or kept since; marks of people take precedence.

    Args:
        set_aside: by recording id, the reason why the recorder discarded it, "" if it did not.
    """
    last: dict[str, tuple[str, str]] = {}
    for line in (folder / MARKS).read_bytes().split(b"\n") if (folder / MARKS).is_file() else ():
        try:
            mark = json.loads(line)
            if mark["action"] in ("exclude", "include"):
                last[str(mark["recording"])] = (mark["action"], mark["who"])
        except (ValueError, TypeError, KeyError, RecursionError):
            continue
    marks = []
    for recording, why in set_aside.items():
        action, who = last.get(recording, ("include", RECORDER))
        new_action = "exclude" if why else "include"
        if who == RECORDER and action != new_action:
            marks.append(Mark(recording, new_action, RECORDER, why or "kept after all"))
    return marks


def add_to_dataset(
    dest: Path,
    search: SourceScan,
    gestures: GestureSet | None,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
    generation: Generation,
) -> ImportSummary:
    """Add the files of a search to the data set ``dest``; ``gestures`` may describe gestures that it lacks.

    ``generation`` is that of ``dest`` before the source was read.

    Raises:
        ForgottenError: if a person, who may be among the new files, was removed since.
        DatasetError: if the data set cannot be opened, nothing can be added, or another import is running.
    """
    with _locked_work_folder(dest) as work:
        dataset = open_dataset(dest)
        copier = _copier(dataset, work)
        account = ImportedFiles(search, copier)
        own = dataset.head.gestures
        if new_gestures := tuple(g for g in (gestures.gestures if gestures else ()) if own.find(g.label) is None):
            own = GestureSet(own.name, own.gestures + new_gestures)
        head = replace(dataset.head, gestures=own)
        built = read_copied(account, head, progress)
        simulated = search.simulated or built.virtual > 0
        if dataset.head.simulated != simulated and (simulated or account.kept):
            kinds = ("real", "virtual") if simulated else ("virtual", "real")
            raise DatasetError(
                "'{dest}' holds recordings of a {kind} toy, the source those of a {other} one: keep them apart.",
                dest=dest,
                kind=kinds[0],
                other=kinds[1],
            )
        if account.rejected and not account.kept and not copier.already:
            file, reason = account.rejected[0].values()
            raise DatasetError(
                "Nothing of the source fits '{dest}', whose layout is '{layout}': rejected are all files ({n}). The "
                "first: '{file}': {reason}.",
                dest=dest,
                layout=head.layout.name,
                n=len(account.rejected),
                file=file,
                reason=reason.rstrip("."),
                first=reason,
            )
        head = replace(head, gestures=extend_gestures(head.gestures, built.dataset))
        subjects = {r.subject for r in (*dataset.recordings, *built.dataset.recordings)}
        there = read_people(dest)
        listed, notes = merge_people(there, search.people, people, subjects)
        account.check()
        new = set(account.kept)
        # Without the lock, marks and the people's table could restore a person who is removed meanwhile.
        with generation.writing():
            if head.gestures != dataset.head.gestures:
                write_file(dest / HEAD, head.to_toml())
            marks = _new_marks(dest, account.set_aside_reasons())
            both = (*dataset.recordings, *built.dataset.recordings)
            trims, labels, remarks = account.marks(both, head.gestures, read_marks(dest))
            write_marks(dest, marks := marks + trims + labels)
            if {p.subject: p for p in listed} != there:
                write_people(dest, listed)
            # Move companions first, so that a recording in the data set always has its sidecar.
            for file in sorted(new, key=lambda f: (f.lower().endswith(".csv"), f)):
                target = dest / file
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists() and file not in copier.grown:
                    raise DatasetError(f"'{target}' appeared during the import and is not overwritten: import again.")
                os.replace(work / file, target)
        rebuilt = rebuild_index(dest, head).dataset if new or marks else open_dataset(dest)
    come = sorted(set(rebuilt.subjects) - set(dataset.subjects))
    notes += remarks + _returning_people_warning(dest, come)
    if note := unknown_labels(own, (r.gesture for r in built.dataset.recordings)):
        notes.append(note)
    return summarize_import(rebuilt, account, search.notes + notes, new, len(trims))


def _returning_people_warning(dest: Path, come: list[str]) -> list[str]:
    """Return a warning if ``come`` were added to a data set from which people were removed: they may be the same."""
    gone = read_removals(dest)
    if not come or not gone:
        return []
    days = ", ".join(dict.fromkeys(g.day for g in gone))
    listed = join_names(come, most=5)
    return [
        Message(
            "people were removed from this data set ({n}; {days}), and {listed} were added now: remove a person "
            "again with  plushsense forget {dest} CODE",
            n=len(gone),
            days=days,
            listed=listed,
            dest=dest,
            people=", ".join(come),
        )
    ]
