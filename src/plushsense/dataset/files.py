"""List the files of a data set by kind and person, and record (in a stamp) from which files its index was built."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from plushsense.core.errors import DatasetError
from plushsense.core.files import PART, foreign_link, write_file
from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import HEAD, PEOPLE, RECORDINGS, STREAMS, DatasetHead, Generation

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


def list_package_files(root: Path) -> list[Path]:
    """Return every file below ``root``, sorted by the text of its path, which is the same on all systems."""
    return sorted(walk_files(root), key=lambda p: p.relative_to(root).as_posix())


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; "" when there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class IndexStamp:
    """Fingerprint of the files that an index was built from, kept in ``index.json``.

    ``files`` maps each raw file to its size and time in ns; ``marks`` are the length and hash of ``marks.jsonl``,
    ``head`` is the hash of ``dataset.toml``, and ``index`` those of the index files, by name.
    """

    files: dict[str, tuple[int, int]]
    marks: tuple[int, str]
    head: str
    index: dict[str, str]

    @classmethod
    def of(cls, folder: Path) -> IndexStamp:
        """Return the stamp of the present files."""
        raw = [(path.relative_to(folder).as_posix(), path.stat()) for _, path in raw_files(folder)]
        files = {name: (now.st_size, now.st_mtime_ns) for name, now in raw}
        return cls(files, _marks_stamp(_marks(folder)), sha256_of(folder / HEAD), _index_hashes(folder))

    @classmethod
    def read(cls, folder: Path) -> IndexStamp | None:
        """Return the stamp on disk; None if there is none, or it is damaged or of an earlier version."""
        try:
            table = json.loads((folder / STAMP).read_text(encoding="utf-8"))
            if table["format"] != STAMP_VERSION or list(map(type, table["marks"])) != [int, str]:
                return None
            files = {str(name): (int(size), int(time)) for name, size, time in table["files"]}
            length, sha256 = table["marks"]
            index = {str(name): str(value) for name, value in table["index"].items()}
            return cls(files, (length, sha256), str(table["head"]), index)
        except (FileNotFoundError, ValueError, RecursionError, KeyError, TypeError, AttributeError):
            return None

    def write(self, folder: Path) -> None:
        """Write the stamp into a data set."""
        files = [[name, *state] for name, state in self.files.items()]
        table = {"format": STAMP_VERSION, "files": files, "marks": self.marks, "head": self.head, "index": self.index}
        write_file(folder / STAMP, json.dumps(table) + "\n")

    def with_index(self, folder: Path) -> IndexStamp:
        """Return the stamp with the hashes of the present index files; call this after writing these."""
        return replace(self, index=_index_hashes(folder))

    def missing(self, folder: Path) -> list[str]:
        """Return the raw files that no longer exist."""
        return [name for name in self.files if not (folder / name).is_file()]

    def marks_rewritten(self, folder: Path) -> bool:
        """Return whether marks are missing or differ that were there: marks are only appended."""
        return _marks_stamp(_marks(folder)[: self.marks[0]]) != self.marks

    def is_intact(self, folder: Path) -> bool:
        """Return whether the index files are those of the stamp, even if raw files changed since."""
        return self.index == _index_hashes(folder)


def _marks(folder: Path) -> bytes:
    try:
        return (folder / MARKS).read_bytes()
    except FileNotFoundError:
        return b""


def _marks_stamp(marks: bytes) -> tuple[int, str]:
    return len(marks), hashlib.sha256(marks).hexdigest()


def _index_hashes(folder: Path) -> dict[str, str]:
    return {name: sha256_of(folder / name) for name in (RECORDINGS_INDEX, STREAMS_INDEX)}


def accept_marks(folder: Path) -> None:
    """Let the stamp on disk, if there is one, have the present marks, after marks were removed on purpose."""
    if (stamp := IndexStamp.read(folder)) is not None:
        replace(stamp, marks=_marks_stamp(_marks(folder))).write(folder)


CACHE = "cache"
EVALUATIONS = "evaluations"
DATASETS = "datasets"
"""Folder of a home, that of a studio, with its data sets."""
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


def change_head(folder: Path, change: Callable[[DatasetHead], DatasetHead]) -> DatasetHead:
    """Replace ``dataset.toml`` atomically by ``change`` of its present contents, and return the new head.

    The index stays valid unless the layout or the gesture set changes.

    Raises:
        DatasetError: if the folder is no data set, or the file cannot be written. It is unchanged then.
    """
    try:
        with Generation.of(folder).writing():
            before, fresh = DatasetHead.read(folder), IndexStamp.read(folder) == IndexStamp.of(folder)
            head = change(before)
            if head != before:
                write_file(folder / HEAD, head.to_toml())
                if fresh and (head.layout, head.gestures) == (before.layout, before.gestures):
                    IndexStamp.of(folder).write(folder)
    except OSError as cause:
        why = cause.strerror or str(cause)
        raise DatasetError(
            "'{path}' cannot be written: {why}.", path=folder / HEAD, why=why, folder=folder.name
        ) from None
    return head
