"""Removing a person from a data set: raw and session files, marks, the people's table, caches, evaluations.

This is the only operation that rewrites append-only files. The intention is written first (``forgetting.json``), so
that an interrupted run can be finished by the same call. Only a line in ``forgotten.jsonl`` remains, with the day and
the number of files but not the person: codes are so few that even a hash would reveal one. Programs that run on the
data set meanwhile can no longer write results (`dataset.generation`).
"""

from __future__ import annotations

import contextlib
import glob
import json
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import FileLock

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.files import PART, is_unfinished, unfinished, write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.toml import read_toml
from plushsense.dataset.files import (
    CACHE,
    EVALUATIONS,
    INDEX,
    DatasetFile,
    list_files,
    match_code,
    missing_files,
    person_folders,
)
from plushsense.dataset.generation import FORGOTTEN, LOCK, UNDER_WAY
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS
from plushsense.dataset.people import read_people, write_people
from plushsense.dataset.privacy.redaction import NamePatterns
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, DatasetHead

_EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class RemovalRecord:
    """Record of a removal: the day and the number of raw files, not who."""

    day: str
    files: int


@dataclass(frozen=True)
class RemovalPlan:
    """Everything in a data set that belongs to a person, by paths in its folder.

    ``files`` are theirs alone, ``marks`` counts the lines about them, ``listed`` is whether the people's table has
    them. ``caches`` and ``evaluations`` used their data; ``mentions`` are files that stay and name them; ``published``
    is the data set's DOI. ``leftovers`` are unfinished files of killed programs in the data set or beside it (``../``).
    With ``absent`` the data set does not contain the person (any more), and only derived files are removed.
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
    absent: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}


def read_removals(folder: Path) -> list[RemovalRecord]:
    """Return the removals of people from a data set, without names."""
    out = []
    try:
        lines = (folder / FORGOTTEN).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"'{folder / FORGOTTEN}' cannot be read ({cause}): bring it back from a copy.") from None
    for line in lines:
        try:
            table = json.loads(line)
            out.append(RemovalRecord(str(table["day"]), int(table["files"])))
        except (ValueError, KeyError, TypeError):
            continue
    return out


def plan_removal(dataset: str | Path, subject: str) -> RemovalPlan:
    """Return what `forget` would remove; nothing is changed.

    Raises:
        DatasetError: when the data set does not know the person, and nobody was ever taken out of it.
    """
    folder = Path(dataset)
    DatasetHead.read(folder)
    if not subject.strip():
        raise DatasetError("No person was named: give the code of one, as  plushsense info  shows it.")
    people = person_folders(folder)
    table = read_people(folder)
    if subject in (NOBODY, UNKNOWN_SUBJECT):
        raise DatasetError(
            f"'{subject}' is no person: it holds what nobody, or nobody known, recorded; to leave such recordings out, "
            "exclude them by a mark."
        )
    found = list_files(folder)
    mine = [c.path.as_posix() for c in found if c.person == subject]
    marks = sum(_is_about(line, subject) for line in _mark_lines(folder))
    begun = _under_way(folder)
    if begun is not None and begun["subject"] != subject:
        raise DatasetError(
            f"Another person is being taken out of '{folder}' and that was stopped: finish it first, with  "
            f"plushsense forget {folder} {begun['subject']} --yes"
        )
    # A torn line or another spelling is no proof of a person: what is removed for good must be named exactly.
    marked = any(_is_about(line, subject) and _whole(line) for line in _mark_lines(folder))
    absent = not mine and not marked and subject not in table and begun is None
    if absent:
        known = sorted({*people, *table} - {NOBODY, UNKNOWN_SUBJECT})
        # The names of removed people are not kept, so an unknown code may be one of them, but not another spelling.
        if not _tombstones(folder) or match_code(subject, known):
            raise DatasetError(
                f"'{folder}' knows no person '{subject}': it knows {', '.join(known) or 'nobody'}."
                f"{nearest(subject, known)}"
            )
    lost = [f for f in missing_files(folder) if PurePosixPath(f).parts[1] != subject]
    if begun is None and lost and not absent:
        raise DatasetError(
            f"'{folder}' lacks {len(lost)} raw file{'s' if len(lost) > 1 else ''} of other people ('{lost[0]}'): bring "
            "them back first, or nobody would notice any more."
        )
    caches = (CACHE,) if (folder / CACHE).exists() else ()
    leftovers = _leftovers(folder, found)
    gone, below = set(mine), tuple(f"{left}/" for left in leftovers)
    evaluations = tuple(e for e in _evaluations(folder) if _uses_person(folder / e, subject))
    names = NamePatterns({subject: ""})
    mentions = []
    for content in found:
        path = content.path.as_posix()
        if content.kind in ("raw", "index", "cache", "evaluation", "link", "working", "people"):
            continue
        if path in gone or f"{path}/".startswith(below):
            continue
        if names.find_in(path) or names.find_in(_text_of(folder / path, skip=subject if path == MARKS else "")):
            mentions.append(path)
    raw = sum(c.kind == "raw" and c.person == subject for c in found)
    return RemovalPlan(
        subject,
        tuple(mine),
        max(raw, int(begun["files"]) if begun else 0),
        marks,
        bool(_row_of(subject, table)),
        caches,
        evaluations,
        tuple(m for m in mentions if m not in (UNDER_WAY, FORGOTTEN)),
        _published(folder),
        leftovers,
        absent,
    )


def forget(dataset: str | Path, subject: str) -> RemovalPlan:
    """Remove a person from a data set; this cannot be undone. An interrupted run is finished by the same call.

    Other people's files and marks stay as they are, byte for byte. Backups, published copies and trained models are
    out of its reach. For a person who was removed before, files that may be derived from them are removed again.

    Returns:
        What was taken away.

    Raises:
        DatasetError: when the data set does not know the person, or a file cannot be removed.
    """
    folder = Path(dataset)
    plan_removal(folder, subject)  # refused before a lock is made
    try:
        with FileLock(folder / LOCK):
            # Again under the lock: other programs may have written until now, and cannot from here on.
            plan = plan_removal(folder, subject)
            intent = None if plan.absent else _begin(folder, plan)
            _remove_derived(folder, plan)
            _remove_own(folder, plan)
            if intent is not None:
                _finish(folder, intent)
    except OSError as cause:
        raise DatasetError(
            f"'{cause.filename or folder}' cannot be removed ({cause.strerror or cause}): close what uses it, then "
            "give the same command again; it finishes what was begun."
        ) from None
    # The removal is complete even if the data set has other problems; opening it later reports them.
    with contextlib.suppress(DatasetError):
        open_dataset(folder)
    return plan


def _begin(folder: Path, plan: RemovalPlan) -> dict[str, Any]:
    """Write down what will be removed, unless an interrupted run already did, and return it."""
    intent = _under_way(folder) or {
        "subject": plan.subject,
        "files": plan.raw,
        "day": datetime.now(timezone.utc).date().isoformat(),
        "before": len(_tombstones(folder)),
    }
    write_file(folder / UNDER_WAY, json.dumps(intent) + "\n")
    return intent


def _remove_derived(folder: Path, plan: RemovalPlan) -> None:
    # Temporary files of killed programs may hold the person's data.
    for part in folder.glob(f"*{PART}"):
        part.unlink()
    # Remove the index before the files it lists. For an absent person it stays if it is the only record of other
    # people's missing files.
    owners = {PurePosixPath(f).parts[1] for f in missing_files(folder)}
    if not plan.absent or owners == {plan.subject}:
        for name in reversed(INDEX):
            (folder / name).unlink(missing_ok=True)
    for path in (*plan.caches, *plan.evaluations, *plan.leftovers):
        _remove(folder / path)


def _remove_own(folder: Path, plan: RemovalPlan) -> None:
    for path in plan.files:
        (folder / path).unlink(missing_ok=True)
    _remove_empty(folder, plan.files)
    _rewrite_marks(folder, plan.subject)
    people = read_people(folder)
    if people.pop(_row_of(plan.subject, people), None) is not None:
        write_people(folder, people.values())


def _leftovers(folder: Path, found: Iterable[DatasetFile]) -> tuple[str, ...]:
    """Return what killed programs left in the data set, or beside it while creating it."""
    out = {f"../{entry.name}" for entry in folder.resolve().parent.glob(f"{glob.escape(unfinished(folder))}*")}
    for content in found:
        parts = content.path.parts
        inside = [i for i, part in enumerate(parts) if is_unfinished(part)]
        if inside:
            out.add("/".join(parts[: inside[0] + 1]))
        elif parts[0] == EVALUATIONS and content.path.suffix == ".part":
            out.add(content.path.as_posix())
    return tuple(sorted(out))


def _published(folder: Path) -> str:
    about = read_toml(folder / HEAD, "data set", DatasetError).get("about")
    return str(about.get("doi", "")) if isinstance(about, dict) else ""


def _row_of(subject: str, table: Iterable[str]) -> str:
    """Return the code under which the people's table has a person; "" if it has not."""
    codes = list(table)
    return subject if subject in codes else match_code(subject, codes)


def _mark_lines(folder: Path) -> list[bytes]:
    try:
        return (folder / MARKS).read_bytes().splitlines(keepends=True)
    except FileNotFoundError:
        return []


def _is_about(line: bytes, subject: str) -> bool:
    """Return whether a mark is about a person's recording; a torn line is if it names the person."""
    try:
        table = json.loads(line.decode("utf-8"))
    except ValueError:
        text = line.decode("utf-8", "replace")
        return f'"{subject}/' in text or bool(NamePatterns({subject: ""}).find_in(text))
    identity = table.get("recording") if isinstance(table, dict) else None
    return isinstance(identity, str) and (identity == subject or identity.startswith(f"{subject}/"))


def _whole(line: bytes) -> bool:
    try:
        json.loads(line.decode("utf-8"))
    except ValueError:
        return False
    return True


def _rewrite_marks(folder: Path, subject: str) -> None:
    lines = _mark_lines(folder)
    kept = [line for line in lines if not _is_about(line, subject)]
    if len(kept) == len(lines):
        return
    write_file(folder / MARKS, b"".join(kept))


def _text_of(path: Path, skip: str = "") -> str:
    """Return the text of a file of the data set (not of big or foreign ones) without the marks about ``skip``."""
    if path.suffix.lower() not in (".toml", ".json", ".jsonl", ".csv", ".md", ".txt", ".html"):
        return ""
    try:
        lines = path.read_bytes().splitlines(keepends=True)
    except OSError:
        return ""
    return b"".join(line for line in lines if not (skip and _is_about(line, skip))).decode("utf-8", "replace")


def _evaluations(folder: Path) -> list[str]:
    """Return each evaluation kept in the data set: the folder with its scores, or a single file."""
    place = folder / EVALUATIONS
    return sorted(f"{EVALUATIONS}/{entry.name}" for entry in place.iterdir()) if place.is_dir() else []


def _uses_person(place: Path, subject: str) -> bool:
    """Return whether an evaluation used a person's data; assume so if it does not state its people."""
    try:
        table = json.loads((place / _EVALUATION).read_text(encoding="utf-8"))
        people = {str(row["subject"]) for row in table["subjects"]}
    except (OSError, ValueError, KeyError, TypeError):
        return True
    return not people or subject in people


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, onerror=_unless_gone)
    else:
        path.unlink(missing_ok=True)


def _unless_gone(_: object, path: str, cause: Any) -> None:
    """Ignore files that another program has just removed."""
    if not isinstance(cause[1], FileNotFoundError):
        raise cause[1]


def _remove_empty(folder: Path, files: Iterable[str]) -> None:
    """Remove folders without files; also those of a run that was interrupted after the last file."""
    places = {parent for f in files for parent in PurePosixPath(f).parents if len(parent.parts) > 1}
    for place in sorted(places, key=lambda p: len(p.parts), reverse=True):
        if (folder / place).is_dir() and not any((folder / place).iterdir()):
            (folder / place).rmdir()


def _under_way(folder: Path) -> dict[str, Any] | None:
    try:
        table = json.loads((folder / UNDER_WAY).read_text(encoding="utf-8"))
        intent = {"subject": str(table["subject"]), "files": int(table["files"]), "day": str(table["day"])}
        return intent | {"before": int(table["before"])}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as cause:
        raise DatasetError(
            f"'{folder / UNDER_WAY}' is damaged ({cause}): remove it and give the command again."
        ) from None


def _finish(folder: Path, intent: dict[str, Any]) -> None:
    """Append the permanent line and then remove the note that a removal is under way."""
    line = json.dumps({"day": intent["day"], "files": intent["files"]}) + "\n"
    # A run that was stopped just here has its line already.
    before = _tombstones(folder)[: intent["before"]]
    write_file(folder / FORGOTTEN, "".join([*before, line]))
    (folder / UNDER_WAY).unlink()


def _tombstones(folder: Path) -> list[str]:
    path = folder / FORGOTTEN
    return path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
