"""What the files of a data set folder are, and whose: for whatever copies, rewrites or empties a data set."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from plushsense.dataset.freshness import RECORDINGS_INDEX, STAMP, STREAMS_INDEX
from plushsense.dataset.marks import MARKS
from plushsense.dataset.people import PEOPLE
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS

CACHE = "cache"
EVALUATIONS = "evaluations"
INDEX = (RECORDINGS_INDEX, STREAMS_INDEX, STAMP)

# What the files with a fixed name are. A file of a person's that is neither raw nor JSON is "other".
_KNOWN = {HEAD: "head", MARKS: "marks", PEOPLE: "people", **dict.fromkeys(INDEX, "index")}


@dataclass(frozen=True)
class Content:
    """One file: ``path`` in the data set's folder, ``kind`` and, where it lies in a person's folder, ``person``.

    Kinds: head, marks, people, index, raw (recordings and streams), words (JSON beside these: what a session wrote
    down), cache, evaluation, working (locks, unfinished parts), other; and link, for anything that is no plain file.
    """

    path: PurePosixPath
    kind: str
    person: str = ""


def _kind(path: PurePosixPath) -> str:
    top = path.parts[0]
    if path.name.endswith((".part", ".lock")):
        return "working"
    if len(path.parts) == 1:
        return _KNOWN.get(path.name, "other")
    if top in (CACHE, EVALUATIONS):
        return "cache" if top == CACHE else "evaluation"
    suffix = path.suffix.lower()
    if top in (RECORDINGS, STREAMS) and suffix == ".csv":
        return "raw"
    return "words" if len(path.parts) > 2 and suffix in (".json", ".jsonl") else "other"


def contents(folder: Path) -> list[Content]:
    """Every file below ``folder``, in the order of the paths; links to folders are named, not followed.

    Whatever lies in ``<any folder>/<person>/`` is that person's, where ``recordings/`` or ``streams/`` know the person.

    Raises:
        OSError: when a folder cannot be listed.
    """

    def refuse(cause: OSError) -> None:
        raise cause

    found: list[tuple[PurePosixPath, bool]] = []
    for place, folders, names in os.walk(folder, onerror=refuse, followlinks=False):
        here = Path(place)
        links = [f for f in folders if (here / f).is_symlink()]
        for name in names + links:
            path = PurePosixPath((here / name).relative_to(folder).as_posix())
            found.append((path, name not in links and (here / name).is_file()))
    known = set(folders_of_people(folder))
    out = []
    for path, plain in sorted(found):
        own = len(path.parts) > 2 and path.parts[0] not in (CACHE, EVALUATIONS) and path.parts[1] in known
        out.append(Content(path, _kind(path) if plain else "link", path.parts[1] if own else ""))
    return out


def folders_of_people(folder: Path) -> list[str]:
    """The folders below ``recordings/`` and ``streams/``: people by code, and nobody's."""
    there = [place for kind in (RECORDINGS, STREAMS) if (place := folder / kind).is_dir()]
    return sorted({entry.name for place in there for entry in place.iterdir() if entry.is_dir()})


def squashed(word: str) -> str:
    """A code without case, blanks and punctuation: ``P_01`` and ``p 01`` are one."""
    return "".join(c for c in word.casefold() if c.isalnum())


def same_code(word: str, codes: Iterable[str]) -> str:
    """The one of ``codes`` that is ``word`` in another spelling; "" where there is none."""
    wanted = squashed(word)
    return next((code for code in codes if squashed(code) == wanted), "")
