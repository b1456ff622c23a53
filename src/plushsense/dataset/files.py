"""List the files of a data set by kind and person, and record (in a stamp) from which files its index was built."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.files import PART, foreign_link, write_file
from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import HEAD, PEOPLE, RECORDINGS, STREAMS

RECORDINGS_INDEX = "recordings.csv"
STREAMS_INDEX = "streams.csv"
STAMP = "index.json"
STAMP_VERSION = 4


def raw_files(folder: Path) -> list[tuple[str, Path]]:
    """Return every raw file (``.csv`` in any case) of a data set with its kind, streams or recordings.

    Raises:
        DatasetError: for a link to a folder or out of the data set, and for a pipe or device.
    """
    found, inside = [], folder.resolve()
    for kind in (STREAMS, RECORDINGS):
        for place, folders, names in os.walk(folder / kind):
            here = Path(place)
            if link := next((path for path in (here, *map(here.joinpath, folders)) if path.is_symlink()), None):
                raise foreign_link(folder, link, DatasetError)
            for path in (here / name for name in names if name.lower().endswith(".csv")):
                if not is_own_file(path, inside):
                    raise foreign_link(folder, path, DatasetError)
                found.append((kind, path))
    return sorted(found, key=lambda one: (one[0] != STREAMS, one[1]))


def is_own_file(path: Path, folder: Path) -> bool:
    """Return whether a path is a regular file, or a link to one that lies in the resolved ``folder``."""
    return path.is_file() and (not path.is_symlink() or path.resolve().is_relative_to(folder))


def walk_files(folder: Path) -> list[Path]:
    """Return every file below a folder, sorted by path; folders that cannot be listed are left out."""
    return sorted(Path(place) / name for place, _, names in os.walk(folder) for name in names)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; "" when there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def current_stamp(folder: Path) -> dict[str, Any]:
    """Return the stamp of the present files: raw files (name, size, time in ns), hashes of the marks and the head."""
    files = [(path.relative_to(folder).as_posix(), path.stat()) for _, path in raw_files(folder)]
    return {
        "format": STAMP_VERSION,
        "files": [[name, now.st_size, now.st_mtime_ns] for name, now in files],
        "marks": _marks_stamp(_marks(folder)),
        "head": sha256_of(folder / HEAD),
    }


def _marks(folder: Path) -> bytes:
    try:
        return (folder / MARKS).read_bytes()
    except FileNotFoundError:
        return b""


def _marks_stamp(marks: bytes) -> list[Any]:
    return [len(marks), hashlib.sha256(marks).hexdigest()]


def _index_hashes(folder: Path) -> dict[str, str]:
    return {name: sha256_of(folder / name) for name in (RECORDINGS_INDEX, STREAMS_INDEX)}


def write_stamp(folder: Path, stamp: dict[str, Any]) -> None:
    """Write ``stamp`` with the hashes of the index files; call this after writing the index files."""
    write_file(folder / STAMP, json.dumps(stamp | {"index": _index_hashes(folder)}) + "\n")


def _read_stamp(folder: Path) -> dict[str, Any]:
    """Return the stamp on disk; empty if there is none, or it is damaged."""
    try:
        stamp = json.loads((folder / STAMP).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError, RecursionError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def is_index_fresh(folder: Path) -> bool:
    """Return whether the index in ``folder`` is complete and was built from the present files."""
    return _read_stamp(folder) == current_stamp(folder) | {"index": _index_hashes(folder)}


def indexed_files(folder: Path) -> dict[str, int]:
    """Return the size in bytes of each file of the stamp on disk, by name; call it only if the stamp is right."""
    return {name: size for name, size, _ in _read_stamp(folder)["files"]}


def is_same_raw_data(folder: Path, now: dict[str, Any]) -> bool:
    """Return whether the index is complete and, except for the marks, was built from the files of the stamp ``now``."""
    return _read_stamp(folder) | {"marks": now["marks"]} == now | {"index": _index_hashes(folder)}


def missing_files(folder: Path) -> list[str]:
    """Return the raw files of the stamp on disk that no longer exist; none if there is no stamp."""
    try:
        return [str(entry[0]) for entry in _read_stamp(folder)["files"] if not (folder / str(entry[0])).is_file()]
    except (KeyError, TypeError, IndexError):
        return []


def rewritten_marks(folder: Path) -> bool:
    """Return whether marks are missing or differ that were there when the stamp was written: marks are only appended.

    False if there is no stamp, or it is damaged or of an earlier version.
    """
    stamp = _read_stamp(folder)
    before = stamp.get("marks")
    if stamp.get("format") != STAMP_VERSION or not isinstance(before, list) or list(map(type, before)) != [int, str]:
        return False
    return _marks_stamp(_marks(folder)[: before[0]]) != before


def accept_marks(folder: Path) -> None:
    """Let the stamp on disk, if there is one, have the present marks, after marks were removed on purpose."""
    if stamp := _read_stamp(folder):
        write_file(folder / STAMP, json.dumps(stamp | {"marks": _marks_stamp(_marks(folder))}) + "\n")


def is_index_intact(folder: Path) -> bool:
    """Return whether the index files are those that were written with the stamp, even if raw files changed since."""
    return _read_stamp(folder).get("index") == _index_hashes(folder)


CACHE = "cache"
EVALUATIONS = "evaluations"
INDEX = (RECORDINGS_INDEX, STREAMS_INDEX, STAMP)

# Files with a fixed name, by kind.
_KNOWN = {HEAD: "head", MARKS: "marks", PEOPLE: "people", **dict.fromkeys(INDEX, "index")}


@dataclass(frozen=True)
class DatasetFile:
    """File of a data set: its path in the folder, its kind and, in a person's folder, the person.

    Kinds are head, marks, people, index, raw (recordings and streams), words (JSON files in deeper folders), cache,
    evaluation, working (locks, unfinished files), other, and link for anything that is not a regular file.
    """

    path: PurePosixPath
    kind: str
    person: str = ""


def _kind(path: PurePosixPath) -> str:
    top = path.parts[0]
    if path.name.endswith((PART, ".lock")):
        return "working"
    if len(path.parts) == 1:
        return _KNOWN.get(path.name, "other")
    if top in (CACHE, EVALUATIONS):
        return "cache" if top == CACHE else "evaluation"
    suffix = path.suffix.lower()
    if top in (RECORDINGS, STREAMS) and suffix == ".csv":
        return "raw"
    return "words" if len(path.parts) > 2 and suffix in (".json", ".jsonl") else "other"


def list_files(folder: Path) -> list[DatasetFile]:
    """List every file below ``folder``, sorted by path; links to folders, or out of it, are listed but not followed.

    Files in ``<any folder>/<person>/``, except in ``cache/`` and ``evaluations/``, belong to the person if
    ``recordings/`` or ``streams/`` has a folder of that name.

    Raises:
        OSError: if a folder cannot be listed.
    """

    def refuse(cause: OSError) -> None:
        raise cause

    paths: list[tuple[PurePosixPath, bool]] = []
    inside = folder.resolve()
    for place, folders, names in os.walk(folder, onerror=refuse, followlinks=False):
        here = Path(place)
        links = [f for f in folders if (here / f).is_symlink()]
        for name in names + links:
            path = PurePosixPath((here / name).relative_to(folder).as_posix())
            paths.append((path, name not in links and is_own_file(here / name, inside)))
    known = set(person_folders(folder))
    out = []
    for path, plain in sorted(paths):
        own = len(path.parts) > 2 and path.parts[0] not in (CACHE, EVALUATIONS) and path.parts[1] in known
        out.append(DatasetFile(path, _kind(path) if plain else "link", path.parts[1] if own else ""))
    return out


def person_folders(folder: Path) -> list[str]:
    """Return the folders in ``recordings/`` and ``streams/``: the codes of people, and nobody for the toy at rest."""
    there = [place for kind in (RECORDINGS, STREAMS) if (place := folder / kind).is_dir()]
    return sorted({entry.name for place in there for entry in place.iterdir() if entry.is_dir()})


def normalize_code(word: str) -> str:
    """Return a code in lower case without blanks and punctuation, so that ``P_01`` and ``p 01`` are equal."""
    return "".join(c for c in word.casefold() if c.isalnum())


def match_code(word: str, codes: Iterable[str]) -> str:
    """Return the first of ``codes`` that equals ``word`` after `normalize_code`; "" if there is none."""
    key = normalize_code(word)
    return next((code for code in codes if normalize_code(code) == key), "")
