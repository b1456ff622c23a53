"""Remove a person from a data set: raw and session files, marks, the people's table, caches, evaluations.

Removing a person, and taking a session out again, are the only operations that rewrite append-only files. The intent of
a removal is written first (``forgetting.json``), so that the same call finishes an interrupted run. In the data set
only a line in ``forgotten.jsonl`` remains, with the day and the number of files but not the person; the home that it
lies in remembers the code (`dataset.privacy.removed`). Programs that use the data set at the same time can no longer
write results (`dataset.store.Generation`).
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import Timeout

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.files import (
    PART,
    abandoned_folders,
    abandoned_temporary_folders,
    is_in_use,
    is_unfinished,
    unfinished,
    write_file,
)
from plushsense.core.gestures import NOBODY
from plushsense.core.toml import load_table, read_toml
from plushsense.dataset.files import (
    CACHE,
    EVALUATIONS,
    INDEX,
    DatasetFile,
    IndexStamp,
    accept_marks,
    list_files,
    match_code,
    person_folders,
    walk_files,
)
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS, adding_locked, locked
from plushsense.dataset.privacy.removed import home_of, remember_removed
from plushsense.dataset.privacy.searching import NamePatterns, is_searchable, texts_in, words_of_rows
from plushsense.dataset.store import (
    FORGOTTEN,
    HEAD,
    RECORDINGS,
    STREAMS,
    UNDER_WAY,
    UNKNOWN_SUBJECT,
    DatasetHead,
    read_people,
    write_people,
)

_EVALUATION = "evaluation.json"
_LONG_CODE = 4
# A line of its own, perhaps with a key as in YAML, a cell, a quoted text, a tag's text, or a part of a path.
_SHORT = r"^(?:\s*[\w-]+:)?\s*{0}\s*$|(?<![^\n,;\t\"'/\\>]){0}(?![^\n,;\t\"'/\\<])"


@dataclass(frozen=True)
class RemovalRecord:
    """Record of a removal: the day and the number of raw files, not the person."""

    day: str
    files: int


@dataclass(frozen=True)
class _Intent:
    """Removal that has begun; ``before`` is the number of earlier removal records."""

    subject: str
    files: int
    day: str
    before: int


@dataclass(frozen=True)
class RemovalPlan:
    """Everything in a data set that belongs to a person, as paths in its folder.

    ``files`` are the person's files, of which ``raw`` are raw; ``marks`` counts the marks about the person, ``listed``
    is whether the people's table contains them. ``caches`` and ``evaluations`` may derive from their data; ``mentions``
    are files that stay and contain the code, or cannot be read; ``published`` is the DOI of the data set.
    ``leftovers`` are unfinished files of killed programs in the data set, beside it (``../``), or in the system's
    folder for temporary files; ``running`` are those beside it that programs use now, and remove when they end. If
    ``absent``, the data set does not contain the person (any more), and only derived files are removed.
    """

    subject: str
    files: tuple[str, ...]
    raw: int
    marks: int
    listed: bool
    caches: tuple[str, ...]
    evaluations: tuple[str, ...]
    mentions: tuple[str, ...]
    published: str = ""
    leftovers: tuple[str, ...] = ()
    running: tuple[str, ...] = ()
    absent: bool = False


def read_removals(folder: Path) -> list[RemovalRecord]:
    """Return the records of earlier removals from a data set; they do not identify people."""
    try:
        lines = _record_lines(folder)
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"'{folder / FORGOTTEN}' cannot be read ({cause}): restore it from a copy.") from None
    records = []
    for line in lines:
        try:
            table = json.loads(line)
            records.append(RemovalRecord(str(table["day"]), int(table["files"])))
        except (ValueError, KeyError, TypeError):
            continue
    return records


def people_of_dataset(folder: Path) -> list[str]:
    """Return the codes of all people of whom a data set has files or a line in the people's table."""
    return sorted({*person_folders(folder), *read_people(folder)} - {NOBODY, UNKNOWN_SUBJECT})


def plan_removal(dataset: str | Path, subject: str) -> RemovalPlan:
    """Return what `forget` would remove, without changing anything.

    Raises:
        DatasetError: if ``subject`` is unknown, another removal was interrupted, or files of other people are missing.
    """
    folder = Path(dataset)
    DatasetHead.read(folder)
    _refuse_nobody(subject)
    table = read_people(folder)
    files = list_files(folder)
    own = [f for f in files if f.person == subject]
    about = [line for line in _mark_lines(folder) if _is_about(line, subject)]
    intent = _read_intent(folder)
    if intent is not None and intent.subject != subject:
        raise DatasetError(
            "The removal of another person from '{folder}' was interrupted: finish it first, with  plushsense forget "
            "{folder} {person} --yes",
            folder=folder,
            person=intent.subject,
        )
    # An incomplete line or another spelling is not enough: the code must be exact, since the removal is permanent.
    marked = any(_parsed(line) is not None for line in about)
    absent = not own and not marked and subject not in table and intent is None
    evaluations = sorted((folder / EVALUATIONS).iterdir()) if (folder / EVALUATIONS).is_dir() else []
    # Files may have been deleted by hand, and results kept.
    if absent and not any(subject in _people_of(e) for e in evaluations):
        _refuse_unknown(folder, subject)
    if intent is None and not absent:
        _refuse_missing(folder, subject)
    leftovers, running = _leftovers(folder, files)
    # Assume that a folder that does not state its people used the person.
    used = tuple(f"{EVALUATIONS}/{e.name}" for e in evaluations if subject in (_people_of(e) or (subject,)))
    about_head = read_toml(folder / HEAD, "data set", DatasetError).get("about")
    raw = sum(f.kind == "raw" for f in own)
    return RemovalPlan(
        subject,
        tuple(f.path.as_posix() for f in own),
        max(raw, intent.files if intent else 0),
        len(about),
        bool(_row_of(subject, table)),
        (CACHE,) if (folder / CACHE).exists() else (),
        used,
        tuple(_mentions(folder, files, subject, (CACHE, *used, *leftovers))),
        str(about_head.get("doi", "")) if isinstance(about_head, dict) else "",
        leftovers,
        running,
        absent,
    )


def _refuse_nobody(subject: str) -> None:
    if not subject.strip():
        raise DatasetError("No person was named: give the code of one, as  plushsense info  shows it.")
    if subject in (NOBODY, UNKNOWN_SUBJECT):
        raise DatasetError(
            "'{subject}' is no person, but the folder of recordings without one: exclude such recordings by a mark.",
            subject=subject,
        )


def _refuse_unknown(folder: Path, subject: str) -> None:
    """Raise DatasetError for a code that nothing contains, unless it may be that of a person removed before."""
    known = people_of_dataset(folder)
    # Codes of removed people are not stored, so an unknown code may be one of them, but not another spelling.
    if not _record_lines(folder) or match_code(subject, known):
        raise DatasetError(
            "'{folder}' knows no person '{subject}': it knows {known}.{hint}",
            folder=folder,
            subject=subject,
            known=", ".join(known) or "nobody",
            hint=nearest(subject, known),
        )


def _refuse_missing(folder: Path, subject: str) -> None:
    """Raise DatasetError if raw files of other people are missing."""
    lost = [f for f in _missing_files(folder) if PurePosixPath(f).parts[1] != subject]
    if lost:
        raise DatasetError(
            "'{folder}' lacks {n} raw file{more} of other people ('{file}'): restore them first, since the removal "
            "deletes the list that they are missing from.",
            folder=folder,
            n=len(lost),
            more="s" if len(lost) > 1 else "",
            file=lost[0],
        )


def _missing_files(folder: Path) -> list[str]:
    """Return the raw files that the index lists and that no longer exist."""
    stamp = IndexStamp.read(folder)
    return [] if stamp is None else stamp.missing(folder)


def _mentions(folder: Path, files: Iterable[DatasetFile], subject: str, removed: tuple[str, ...]) -> Iterator[str]:
    """Yield the files that stay, and contain the code of a person or cannot be read; ``removed`` are places."""
    for file in files:
        path = file.path.as_posix()
        goes = file.person == subject or f"{path}/".startswith(tuple(f"{place}/" for place in removed))
        goes = goes or (len(file.path.parts) == 1 and file.path.suffix == PART)
        if goes or file.kind == "index" or path in (UNDER_WAY, FORGOTTEN):
            continue
        try:
            found = _named(path, subject) or any(_holds(text, subject) for text in _texts_of(folder, file, subject))
        except (OSError, ValueError):
            found = True
        if found:
            yield path


def _texts_of(folder: Path, file: DatasetFile, subject: str) -> Iterator[str]:
    """Yield the texts of a file that remain when ``subject`` is removed."""
    path = folder / file.path
    if file.kind == "marks":
        yield _other_marks(folder, subject)
    elif file.kind == "people":
        people = read_people(folder)
        people.pop(_row_of(subject, people), None)
        yield "\n".join(cell for p in people.values() for cell in (p.age_group, p.gender, p.consent, *p.more.values()))
    elif file.kind == "raw":
        yield words_of_rows(path.read_bytes())
    elif file.kind == "link":
        yield path.readlink().as_posix() if path.is_symlink() else ""
    else:
        yield from texts_in(path)


def _named(path: str, subject: str) -> bool:
    """Return whether a path contains the code of a person."""
    return _holds(path, subject) or subject in re.split(r"[\W_]+", path)


def _holds(text: str, subject: str) -> bool:
    """Return whether a text contains the code of a person.

    It is searched for as a whole word in any spelling, and as it is in the middle of other text if it is not too short
    for that. Codes such as ``7`` also are numbers, so they must be a line, a cell, a quoted text or a folder.
    """
    if is_searchable(subject):
        found = bool(NamePatterns([subject]).find_in(text)) or subject in text.splitlines()
        return found or (len(subject) >= _LONG_CODE and subject in text)
    return re.search(_SHORT.format(re.escape(subject)), text, re.MULTILINE) is not None


def find_mentions(places: Iterable[Path], subject: str, apart_from: Path) -> Iterator[Path]:
    """Yield what contains the code of a person, or cannot be read, in folders other than the data set ``apart_from``.

    Folders that are named after the person are not searched further.
    """
    for place in places:
        for at, folders, names in os.walk(place):
            here = Path(at)
            yield from (here / name for name in folders if name == subject)
            folders[:] = [name for name in folders if name != subject and (here / name).resolve() != apart_from]
            yield from (here / name for name in names if mentions(here / name, subject))


def mentions(path: Path, subject: str) -> bool:
    """Return whether a file contains the code of a person in its name or its text, or cannot be read."""
    raw = path.suffix.lower() == ".csv" and {RECORDINGS, STREAMS} & set(path.parts)
    try:
        texts = iter([words_of_rows(path.read_bytes())]) if raw else texts_in(path)
        return _named(path.name, subject) or any(_holds(text, subject) for text in texts)
    except (OSError, ValueError):
        return True


def forget(dataset: str | Path, subject: str) -> RemovalPlan:
    """Remove a person from a data set; this cannot be undone. The same call finishes an interrupted run.

    Other people's raw files and marks stay the same byte for byte. Backups, published copies and trained models are
    not changed. For a person who was removed before, files that may be derived from their data are removed again.

    Returns:
        What was removed.

    Raises:
        DatasetError: as in `plan_removal`, or if a file cannot be removed.
    """
    folder = Path(dataset)
    plan_removal(folder, subject)  # Refuse before the lock is taken.
    try:
        with adding_locked(folder), locked(folder):
            # Plan again under the lock, since other programs may have written until now.
            plan = plan_removal(folder, subject)
            if not plan.absent and (home := home_of(folder)) is not None:
                remember_removed(home, subject)
            intent = None if plan.absent else _begin(folder, plan)
            _remove_derived(folder, plan)
            _remove_own(folder, plan)
            if intent is not None:
                _finish(folder, intent)
    except Timeout:
        raise DatasetError(
            "An import is adding to '{folder}' now, and nothing was removed: wait until it ends, or end it, then "
            "give the command again.",
            folder=folder,
        ) from None
    except OSError as cause:
        raise DatasetError(
            "'{why}' cannot be changed ({cause}): close the programs that use it, check that you may write there, "
            "then give the same command again to finish.",
            why=cause.filename or folder,
            cause=cause.strerror or cause,
            file=cause.filename or folder.name,
        ) from None
    # The removal is complete even if the data set has other problems; opening it later reports them.
    with contextlib.suppress(DatasetError):
        open_dataset(folder)
    return plan


def take_out(dataset: str | Path, session: Path) -> None:
    """Take a recorded session out of a data set again: its copies, the marks on them, and the line of its person.

    The folder of the session, ``<person>/<session>``, stays as it is, and can be imported again.

    Raises:
        DatasetError: if the data set does not hold the session, or other files under its name, or files are in use.
    """
    folder, name = Path(dataset), f"{session.parent.name}/{session.name}"
    places = [folder / kind / name for kind in (RECORDINGS, STREAMS)]
    try:
        with adding_locked(folder), locked(folder):
            copies = [path for place in places for path in walk_files(place) if path.suffix == ".csv"]
            if not copies or not all(_begins(session / path.name, path) for path in copies):
                raise DatasetError(
                    "“{dataset}” does not hold the session {name} as it was recorded, so nothing was taken out.",
                    dataset=folder.name,
                    name=name,
                )
            # The index first, which would say that files are lost.
            for path in (*(folder / name for name in reversed(INDEX)), *places, folder / CACHE):
                _remove(path)
            for place in places:
                with contextlib.suppress(OSError):  # not empty: the person has other sessions there
                    place.parent.rmdir()
            _rewrite_marks(folder, name)
            people = read_people(folder)
            if session.parent.name not in person_folders(folder):
                people.pop(_row_of(session.parent.name, people), None)
                write_people(folder, people.values())
    except Timeout:
        raise DatasetError("Another import is adding to '{dest}' now: wait until it ends.", dest=folder) from None
    with contextlib.suppress(DatasetError):
        open_dataset(folder)


def _begins(session_file: Path, copy: Path) -> bool:
    """Return whether a file of a session begins as its copy, to which the recorder may have added since."""
    return session_file.is_file() and session_file.read_bytes().startswith(copy.read_bytes())


def _begin(folder: Path, plan: RemovalPlan) -> _Intent:
    """Write the intent of the removal, or continue that of an interrupted run, and return it."""
    today = datetime.now(timezone.utc).date().isoformat()
    intent = _read_intent(folder) or _Intent(plan.subject, plan.raw, today, len(_record_lines(folder)))
    write_file(folder / UNDER_WAY, json.dumps(asdict(intent)) + "\n")
    return intent


def _remove_derived(folder: Path, plan: RemovalPlan) -> None:
    # Temporary files of killed programs may contain the person's data.
    for part in folder.glob(f"*{PART}"):
        part.unlink()
    # Remove the index before the files it lists. For an absent person it stays if it is the only record of other
    # people's missing files.
    owners = {PurePosixPath(f).parts[1] for f in _missing_files(folder)}
    if not plan.absent or owners == {plan.subject}:
        for name in reversed(INDEX):
            (folder / name).unlink(missing_ok=True)
    for path in (*plan.caches, *plan.evaluations, *plan.leftovers):
        _remove(folder / path)


def _remove_own(folder: Path, plan: RemovalPlan) -> None:
    for path in plan.files:
        (folder / path).unlink(missing_ok=True)
    _remove_empty(folder, plan)
    _rewrite_marks(folder, plan.subject)
    people = read_people(folder)
    if people.pop(_row_of(plan.subject, people), None) is not None:
        write_people(folder, people.values())


def _rewrite_marks(folder: Path, subject: str) -> None:
    lines = _mark_lines(folder)
    others = [line for line in lines if not _is_about(line, subject)]
    if len(others) < len(lines):
        write_file(folder / MARKS, b"".join(others))
        accept_marks(folder)


def _leftovers(folder: Path, files: Iterable[DatasetFile]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return unfinished files and folders in the data set, beside it, and in the folder for temporary files.

    The first are those that killed programs left, the second those folders that a process still uses.
    """
    place = folder.resolve().parent
    running = [f"../{entry.name}" for entry in place.iterdir() if is_unfinished(entry.name) and is_in_use(entry)]
    beside = [f for f in place.glob(f"{glob.escape(unfinished(folder))}*") if not is_in_use(f)]
    out = {f"../{entry.name}" for entry in (*abandoned_folders(place), *beside)}
    out |= {entry.as_posix() for entry in abandoned_temporary_folders() if entry.parent != place}
    for file in files:
        parts = file.path.parts
        inside = ["/".join(parts[: i + 1]) for i, part in enumerate(parts) if is_unfinished(part)]
        if inside and not is_in_use(folder / inside[0]):
            out.add(inside[0])
        elif parts[0] == EVALUATIONS and file.path.suffix == ".part":
            out.add(file.path.as_posix())
    return tuple(sorted(out)), tuple(sorted(running))


def _row_of(subject: str, table: Iterable[str]) -> str:
    """Return the spelling of a person's code in the people's table; "" if it is missing."""
    codes = list(table)
    return subject if subject in codes else match_code(subject, codes)


def _mark_lines(folder: Path) -> list[bytes]:
    try:
        return (folder / MARKS).read_bytes().splitlines(keepends=True)
    except FileNotFoundError:
        return []


def _is_about(line: bytes, subject: str) -> bool:
    """Return whether a mark is about a person or their recording; an incomplete line is if it contains the code."""
    table = _parsed(line)
    if table is None:
        text = line.decode("utf-8", "replace")
        return f'"{subject}/' in text or bool(NamePatterns([subject]).find_in(text))
    identity = table.get("recording") if isinstance(table, dict) else None
    return isinstance(identity, str) and (identity == subject or identity.startswith(f"{subject}/"))


def _parsed(line: bytes) -> Any:
    """Return the JSON value of a line; None if the line is incomplete."""
    try:
        return json.loads(line.decode("utf-8"))
    except ValueError:
        return None


def _other_marks(folder: Path, subject: str) -> str:
    """Return the marks that are not about ``subject``."""
    return b"".join(line for line in _mark_lines(folder) if not _is_about(line, subject)).decode("utf-8", "replace")


def _people_of(place: Path) -> set[str]:
    """Return the people whose data an evaluation used; none if it does not state them."""
    try:
        table = json.loads((place / _EVALUATION).read_text(encoding="utf-8"))
        return {str(row["subject"]) for row in table["subjects"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, onerror=_ignore_missing)
    else:
        path.unlink(missing_ok=True)


def _ignore_missing(_: object, path: str, cause: Any) -> None:
    """Ignore files that another program has just removed."""
    if not isinstance(cause[1], FileNotFoundError):
        raise cause[1]


def _remove_empty(folder: Path, plan: RemovalPlan) -> None:
    """Remove the folders of the removed files that are empty now, and those that an interrupted run left empty."""
    places = {folder / parent for f in plan.files for parent in PurePosixPath(f).parents if len(parent.parts) > 1}
    for own in (folder / RECORDINGS / plan.subject, folder / STREAMS / plan.subject):
        places |= {own, *own.rglob("*")}
    for place in sorted(places, key=lambda p: len(p.parts), reverse=True):
        if place.is_dir() and not place.is_symlink() and not any(place.iterdir()):
            place.rmdir()


def _read_intent(folder: Path) -> _Intent | None:
    try:
        table = json.loads((folder / UNDER_WAY).read_text(encoding="utf-8"))
        return load_table(table, _Intent, "the file", DatasetError)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, DatasetError) as cause:
        raise DatasetError(
            f"'{folder / UNDER_WAY}' is damaged ({cause}): remove it and give the command again."
        ) from None


def _finish(folder: Path, intent: _Intent) -> None:
    """Append the permanent record of the removal, then delete its intent."""
    line = json.dumps({"day": intent.day, "files": intent.files}) + "\n"
    # An interrupted run may have written its record already: replace it.
    write_file(folder / FORGOTTEN, "".join([*_record_lines(folder)[: intent.before], line]))
    (folder / UNDER_WAY).unlink()


def _record_lines(folder: Path) -> list[str]:
    path = folder / FORGOTTEN
    return path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
