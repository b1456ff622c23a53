"""Taking a person out of a data set, for good: raw and session files, marks, the people's table, caches, evaluations.

Here append-only is broken on purpose. What is about to go is written down first (``forgetting.json``), so that a run
that was stopped can be finished by the same call; at the end only a line in ``forgotten.jsonl`` stays, which says when
and how many files, not who: codes are so few that even a hash of one would tell.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import FileLock

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.gestures import NOBODY
from plushsense.core.tomlfile import read_toml
from plushsense.dataset.contents import CACHE, EVALUATIONS, INDEX, contents, folders_of_people, same_code
from plushsense.dataset.freshness import missing_files
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS
from plushsense.dataset.people import read_people, write_people
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, DatasetHead, write_atomically
from plushsense.dataset.wording import Names

FORGOTTEN = "forgotten.jsonl"
UNDER_WAY = "forgetting.json"
_EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class Tombstone:
    """That somebody was forgotten: the day, and how many raw files they had."""

    day: str
    files: int


@dataclass(frozen=True)
class Leaving:
    """What belongs to a person in a data set, by paths in its folder.

    ``files`` theirs alone; ``marks`` the lines about them; ``listed`` whether the people's table names them;
    ``caches`` and ``evaluations`` were made with them; ``mentions`` stay, and name them in their text; ``published``
    is the DOI under which the data set says that it can be had.
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

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}


def forgotten(folder: Path) -> list[Tombstone]:
    """Who was taken out of a data set, without names: for a warning before anything is added to it again."""
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
            out.append(Tombstone(str(table["day"]), int(table["files"])))
        except (ValueError, KeyError, TypeError):
            continue
    return out


def leaving(dataset: str | Path, subject: str) -> Leaving:
    """What `forget` would take away; nothing is changed.

    Raises:
        DatasetError: when the data set does not know the person.
    """
    folder = Path(dataset)
    DatasetHead.read(folder)
    if not subject.strip():
        raise DatasetError("No person was named: give the code of one, as  plushsense info  shows it.")
    people = folders_of_people(folder)
    table = read_people(folder)
    if subject in (NOBODY, UNKNOWN_SUBJECT):
        raise DatasetError(
            f"'{subject}' is no person: it holds what nobody, or nobody known, recorded; to leave such recordings out, "
            "exclude them by a mark."
        )
    found = contents(folder)
    mine = [c.path.as_posix() for c in found if c.person == subject]
    marks = sum(_is_about(line, subject) for line in _mark_lines(folder))
    begun = _under_way(folder)
    if begun is not None and begun["subject"] != subject:
        raise DatasetError(
            f"Another person is being taken out of '{folder}' and that was stopped: finish it first, with  "
            f"plushsense forget {folder} {begun['subject']} --yes"
        )
    # A torn line proves nobody, nor does another spelling: what goes for good is named exactly.
    marked = any(_is_about(line, subject) and _whole(line) for line in _mark_lines(folder))
    if not mine and not marked and subject not in table and begun is None:
        known = sorted({*people, *table} - {NOBODY, UNKNOWN_SUBJECT})
        raise DatasetError(
            f"'{folder}' knows no person '{subject}': it knows {', '.join(known) or 'nobody'}.{nearest(subject, known)}"
        )
    lost = [f for f in missing_files(folder) if PurePosixPath(f).parts[1] != subject]
    if begun is None and lost:
        raise DatasetError(
            f"'{folder}' lacks {len(lost)} raw file{'s' if len(lost) > 1 else ''} of other people ('{lost[0]}'): bring "
            "them back first, or nobody would notice any more."
        )
    caches = (CACHE,) if (folder / CACHE).exists() else ()
    gone = {*mine}
    evaluations = tuple(e for e in _evaluations(folder) if _holds(folder / e, subject))
    names = Names({subject: ""})
    mentions = []
    for content in found:
        path = content.path.as_posix()
        if path in gone or content.kind in ("raw", "index", "cache", "evaluation", "link", "working", "people"):
            continue
        if names.found(path) or names.found(_text_of(folder / path, skip=subject if path == MARKS else "")):
            mentions.append(path)
    raw = sum(c.kind == "raw" and c.person == subject for c in found)
    return Leaving(
        subject,
        tuple(mine),
        max(raw, int(begun["files"]) if begun else 0),
        marks,
        bool(_row_of(subject, table)),
        caches,
        evaluations,
        tuple(m for m in mentions if m not in (UNDER_WAY, FORGOTTEN)),
        _published(folder),
    )


def forget(dataset: str | Path, subject: str) -> Leaving:
    """Take a person out of a data set; this cannot be undone. Stopped half-way, the same call finishes it.

    Other people's files and marks stay as they are, byte for byte. Backups, published copies and trained models are
    out of its reach.

    Returns:
        What was taken away.

    Raises:
        DatasetError: when the data set does not know the person, or a file cannot be removed.
    """
    folder = Path(dataset)
    plan = leaving(folder, subject)
    try:
        with FileLock(folder / (MARKS + ".lock")):
            intent = _under_way(folder) or {
                "subject": subject,
                "files": plan.raw,
                "day": datetime.now(timezone.utc).date().isoformat(),
                "before": len(_tombstones(folder)),
            }
            write_atomically(folder / UNDER_WAY, json.dumps(intent) + "\n")
            # What a killed program never renamed: tables, marks or this note, with the person in it.
            for part in folder.glob("*.part"):
                part.unlink()
            # From here on no index claims files that are about to go.
            for name in reversed(INDEX):
                (folder / name).unlink(missing_ok=True)
            for cache in (*plan.caches, *plan.evaluations):
                _remove(folder / cache)
            for path in plan.files:
                (folder / path).unlink(missing_ok=True)
            _remove_empty(folder, plan.files)
            _rewrite_marks(folder, subject)
            people = read_people(folder)
            if people.pop(_row_of(subject, people), None) is not None:
                write_people(folder, people.values())
            _bury(folder, intent)
    except OSError as cause:
        raise DatasetError(
            f"'{cause.filename or folder}' cannot be removed ({cause.strerror or cause}): close what uses it, then "
            "give the same command again; it finishes what was begun."
        ) from None
    # The person is gone whatever else is wrong with the data set: who opens it next is told.
    with contextlib.suppress(DatasetError):
        open_dataset(folder)
    return plan


def _published(folder: Path) -> str:
    about = read_toml(folder / HEAD, "data set", DatasetError).get("about")
    return str(about.get("doi", "")) if isinstance(about, dict) else ""


def _row_of(subject: str, table: Iterable[str]) -> str:
    """The code under which the people's table has a person; "" where it has not."""
    codes = list(table)
    return subject if subject in codes else same_code(subject, codes)


def _mark_lines(folder: Path) -> list[bytes]:
    try:
        return (folder / MARKS).read_bytes().splitlines(keepends=True)
    except FileNotFoundError:
        return []


def _is_about(line: bytes, subject: str) -> bool:
    """Whether a line of the marks is about a person's recording; a torn line is, where it names the person."""
    try:
        table = json.loads(line.decode("utf-8"))
    except ValueError:
        text = line.decode("utf-8", "replace")
        return f'"{subject}/' in text or bool(Names({subject: ""}).found(text))
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
    path = folder / MARKS
    part = path.with_name(f"{MARKS}.{os.getpid()}.part")
    try:
        part.write_bytes(b"".join(kept))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _text_of(path: Path, skip: str = "") -> str:
    """What stands in a file of the data set's own (not in big or foreign ones); marks about ``skip`` apart."""
    if path.suffix.lower() not in (".toml", ".json", ".jsonl", ".csv", ".md", ".txt", ".html"):
        return ""
    try:
        lines = path.read_bytes().splitlines(keepends=True)
    except OSError:
        return ""
    return b"".join(line for line in lines if not (skip and _is_about(line, skip))).decode("utf-8", "replace")


def _evaluations(folder: Path) -> list[str]:
    """Each evaluation that is kept in the data set: the folder that holds its scores, or a file that lies beside."""
    place = folder / EVALUATIONS
    return sorted(f"{EVALUATIONS}/{entry.name}" for entry in place.iterdir()) if place.is_dir() else []


def _holds(place: Path, subject: str) -> bool:
    """Whether an evaluation was made with a person; where it does not say with whom, it was."""
    try:
        table = json.loads((place / _EVALUATION).read_text(encoding="utf-8"))
        told = {str(row["subject"]) for row in table["subjects"]}
    except (OSError, ValueError, KeyError, TypeError):
        return True
    return not told or subject in told


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _remove_empty(folder: Path, files: Iterable[str]) -> None:
    """Remove the folders that the files leave empty; also those of a run that was stopped after the last file."""
    places = {parent for f in files for parent in PurePosixPath(f).parents if len(parent.parts) > 1}
    for place in sorted(places, key=lambda p: len(p.parts), reverse=True):
        if (folder / place).is_dir() and not any((folder / place).iterdir()):
            (folder / place).rmdir()


def _under_way(folder: Path) -> dict[str, Any] | None:
    try:
        table = json.loads((folder / UNDER_WAY).read_text(encoding="utf-8"))
        told = {"subject": str(table["subject"]), "files": int(table["files"]), "day": str(table["day"])}
        return told | {"before": int(table["before"])}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as cause:
        raise DatasetError(
            f"'{folder / UNDER_WAY}' is damaged ({cause}): remove it and give the command again."
        ) from None


def _bury(folder: Path, intent: dict[str, Any]) -> None:
    """Add the line that stays, and take away the note that this was under way: last of all."""
    line = json.dumps({"day": intent["day"], "files": intent["files"]}) + "\n"
    # A run that was stopped just here has its line already.
    before = _tombstones(folder)[: intent["before"]]
    write_atomically(folder / FORGOTTEN, "".join([*before, line]))
    (folder / UNDER_WAY).unlink()


def _tombstones(folder: Path) -> list[str]:
    path = folder / FORGOTTEN
    return path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
