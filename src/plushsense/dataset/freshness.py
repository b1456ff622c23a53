"""Whether the index still says what the raw files and the marks say: by names, sizes and times, not by reading all."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, write_atomically

RECORDINGS_INDEX = "recordings.csv"
STREAMS_INDEX = "streams.csv"
STAMP = "index.json"
STAMP_VERSION = 2


def raw_files(folder: Path) -> list[tuple[str, Path]]:
    """Every raw file of a data set with its kind, streams or recordings; the suffix in any case."""
    files = []
    for kind in (STREAMS, RECORDINGS):
        found = [
            Path(place) / name
            for place, _, names in os.walk(folder / kind)
            for name in names
            if name.lower().endswith(".csv")
        ]
        files += [(kind, path) for path in sorted(found)]
    return files


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal; "" where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def taken(folder: Path) -> dict[str, Any]:
    """What an index is made from: the raw files (name, size, time in ns), the marks and the head (hashes)."""
    files = []
    for _, path in raw_files(folder):
        now = path.stat()
        files.append([path.relative_to(folder).as_posix(), now.st_size, now.st_mtime_ns])
    return {
        "format": STAMP_VERSION,
        "files": files,
        "marks": sha256_of(folder / MARKS),
        "head": sha256_of(folder / HEAD),
    }


def _index(folder: Path) -> dict[str, str]:
    return {name: sha256_of(folder / name) for name in (RECORDINGS_INDEX, STREAMS_INDEX)}


def write_stamp(folder: Path, stamp: dict[str, Any]) -> None:
    """Say what the index in ``folder`` was made from; called after the index files were written."""
    write_atomically(folder / STAMP, json.dumps(stamp | {"index": _index(folder)}) + "\n")


def is_fresh(folder: Path) -> bool:
    """Whether the index in ``folder`` is whole and made from what is there now."""
    try:
        said = json.loads((folder / STAMP).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError, RecursionError):
        return False
    return bool(said == taken(folder) | {"index": _index(folder)})


def same_files(folder: Path, now: dict[str, Any]) -> bool:
    """Whether the index is whole and, but for the marks, was made from what is there ``now`` (`taken`)."""
    try:
        said = json.loads((folder / STAMP).read_text(encoding="utf-8"))
        return bool(said | {"marks": now["marks"]} == now | {"index": _index(folder)})
    except (FileNotFoundError, ValueError, RecursionError, TypeError):
        return False


def missing_files(folder: Path) -> list[str]:
    """Raw files that the last index was made from and that are not there now; none where there is no stamp."""
    try:
        listed = json.loads((folder / STAMP).read_text(encoding="utf-8"))["files"]
        return [str(entry[0]) for entry in listed if not (folder / str(entry[0])).is_file()]
    except (FileNotFoundError, ValueError, RecursionError, KeyError, TypeError, IndexError):
        return []
