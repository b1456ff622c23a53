"""Marks: what people decided about recordings. Append-only; a raw file never changes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.tomlfile import refuse_unknown

MARKS = "marks.jsonl"
BY_HAND, SUGGESTED = "hand", "suggested"
NEEDED = ("recording", "action", "who")
_LOCK_S = 30.0
ACTIONS = ("trim", "untrim", "exclude", "include", "accept", "unaccept")


@dataclass(frozen=True)
class Mark:
    """One decision: ``trim`` keeps rows ``start`` to ``stop``; ``untrim``, ``include`` and ``unaccept`` undo.

    ``accept`` says that what the check ``check`` found is known and no fault. ``recording`` is the id of a recording or
    a stream, or "" for the data set as a whole. ``how`` a trim came about: "hand" set by a person, "suggested" accepted
    as suggested; "" in marks from before that was kept, which count as set by hand.
    """

    recording: str
    action: str
    who: str
    why: str = ""
    start: int = 0
    stop: int = -1
    when: str = ""
    check: str = ""
    how: str = ""


@dataclass(frozen=True)
class Standing:
    """Where the marks leave one recording; ``accepted`` are the checks whose findings somebody accepted, ``how`` is the
    standing trim's.
    """

    excluded: bool = False
    start: int = 0
    stop: int = -1
    accepted: frozenset[str] = frozenset()
    how: str = ""

    @property
    def trimmed(self) -> bool:
        """Whether a trim stands, be it one that keeps the whole recording."""
        return bool(self.how) or (self.start, self.stop) != (0, -1)


def _checked(mark: Mark, where: str) -> Mark:
    """The mark, when its values are of the right type and range."""
    for key in ("recording", "action", "who", "why", "when", "check", "how"):
        if not isinstance(getattr(mark, key), str):
            raise DatasetError(f"{where}: {key} is {getattr(mark, key)!r}; it must be a text.")
    if mark.action not in ACTIONS:
        raise DatasetError(
            f"{where}: unknown mark '{mark.action}': accepted are {', '.join(ACTIONS)}.{nearest(mark.action, ACTIONS)}"
        )
    for key, low in (("start", 0), ("stop", -1)):
        value = getattr(mark, key)
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise DatasetError(f"{where}: {key} is {value!r}; it must be a whole number from {low} on.")
    if bool(mark.check) != (mark.action in ("accept", "unaccept")):
        raise DatasetError(
            f"{where}: a mark '{mark.action}' with check '{mark.check}'; accept and unaccept name a check."
        )
    if mark.how not in ("", BY_HAND, SUGGESTED) or (mark.how and mark.action != "trim"):
        raise DatasetError(
            f"{where}: a mark '{mark.action}' made by '{mark.how}'; a trim may be by {BY_HAND} or {SUGGESTED}."
        )
    if 0 <= mark.stop <= mark.start:
        raise DatasetError(f"{where}: rows {mark.start} to {mark.stop} keep nothing; stop must be above start, or -1.")
    return mark


def matching(pattern: str, known: Iterable[str], what: str) -> list[str]:
    """The ids that a pattern names: the id itself, or a glob such as ``P19/*``.

    Raises:
        DatasetError: when it names none, with the nearest one.
    """
    ids = sorted(set(known))
    if pattern in ids:
        return [pattern]
    found = [i for i in ids if fnmatchcase(i, pattern)]
    if not found:
        hint = nearest(pattern, ids)
        example = f" For example '{ids[0]}', or a pattern such as 'P01/*'." if ids and not hint else ""
        raise DatasetError(f"There is no {what} '{pattern}'.{hint}{example}")
    return found


def append_marks(folder: Path, marks: Iterable[Mark]) -> None:
    """Add marks at the end, under a file lock, so that two programs can mark at once.

    Raises:
        DatasetError: for a mark that cannot be, or a folder that cannot be written.
    """
    lines = []
    for mark in marks:
        table = asdict(_checked(mark, f"The mark of '{mark.recording}'"))
        table["when"] = mark.when or datetime.now(timezone.utc).isoformat(timespec="seconds")
        lines.append(json.dumps(table, ensure_ascii=False) + "\n")
    path = folder / MARKS
    try:
        with FileLock(folder / (MARKS + ".lock"), timeout=_LOCK_S), path.open("a+b") as file:
            # What a crash left without an end must not swallow the next mark.
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    lines.insert(0, "\n")
            file.write("".join(lines).encode("utf-8"))
    except OSError as cause:
        raise DatasetError(f"'{path}' cannot be written: {cause.strerror or cause}.") from None


def read_marks(folder: Path) -> dict[str, Standing]:
    """Where the marks leave each marked recording.

    A line that is no JSON was torn by a crash while writing and is passed over; one that is JSON but no mark is an
    error.

    Raises:
        DatasetError: naming the line.
    """
    return FollowedMarks(folder).standing()


class FollowedMarks:
    """The marks of a data set, read again only as far as other programs added to them. Not for two threads at once."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / MARKS
        self._standing: dict[str, Standing] = {}
        self._seen: tuple[int, int, int] | None = None
        self._lines = self._bytes = 0

    @property
    def changed(self) -> bool:
        """Whether the file is another than when `standing` was last asked for."""
        return self._now() != self._seen

    def standing(self) -> dict[str, Standing]:
        """As `read_marks`; each call gives a new dictionary where something changed, the same one otherwise.

        Raises:
            DatasetError: naming the line.
        """
        now = self._now()
        if now == self._seen:
            return self._given
        if now is None:
            # Taken back as a whole, which nothing here does: as if no mark had been.
            self._standing, self._lines, self._bytes = {}, 0, 0
            self._seen, self._given = now, {}
            return self._given
        try:
            with self._path.open("rb") as file:
                if self._seen is None or now[0] != self._seen[0] or now[1] < self._bytes or not self._goes_on(file):
                    self._standing, self._lines, self._bytes = {}, 0, 0
                file.seek(self._bytes)
                *whole, rest = file.read().split(b"\n")
        except OSError as cause:
            raise DatasetError(f"'{self._path}' cannot be read: {cause.strerror or cause}.") from None
        standing = dict(self._standing)
        for line in whole:
            self._take(line, self._lines + 1, standing)
            self._lines += 1
            self._bytes += len(line) + 1
        self._standing = dict(standing)
        # What has no end yet may be a mark, or the beginning of one.
        self._take(rest, self._lines + 1, standing)
        self._tail = whole[-1] if whole else self._tail
        self._seen, self._given = now, standing
        return standing

    _given: dict[str, Standing] = {}  # noqa: RUF012 (replaced, never changed)
    _tail = b""

    def _now(self) -> tuple[int, int, int] | None:
        try:
            now = self._path.stat()
        except FileNotFoundError:
            return None
        except OSError as cause:
            raise DatasetError(f"'{self._path}' cannot be read: {cause.strerror or cause}.") from None
        return now.st_ino, now.st_size, now.st_mtime_ns

    def _goes_on(self, file: BinaryIO) -> bool:
        """Whether the last line that was read still stands where it stood."""
        file.seek(max(0, self._bytes - len(self._tail) - 1))
        return self._bytes == 0 or file.read(len(self._tail) + 1) == self._tail + b"\n"

    def _take(self, line: bytes, number: int, standing: dict[str, Standing]) -> None:
        where = f"'{self._path}' line {number}"
        try:
            table: Any = json.loads(line.decode("utf-8"))
        except (ValueError, RecursionError):
            return
        if not isinstance(table, dict):
            raise DatasetError(f"{where} is no mark: each line is one JSON object.")
        refuse_unknown(table, Mark.__dataclass_fields__, where, DatasetError)
        if lacking := [key for key in NEEDED if key not in table]:
            raise DatasetError(f"{where} lacks {', '.join(lacking)}: a mark says at least {', '.join(NEEDED)}.")
        mark = _checked(Mark(**table), where)
        standing[mark.recording] = after(standing.get(mark.recording, Standing()), mark)


def after(now: Standing, mark: Mark) -> Standing:
    """Where one more mark leaves a recording."""
    match mark.action:
        case "trim":
            return replace(now, start=mark.start, stop=mark.stop, how=mark.how)
        case "untrim":
            return replace(now, start=0, stop=-1, how="")
        case "exclude":
            return replace(now, excluded=True)
        case "include":
            return replace(now, excluded=False)
        case "accept":
            return replace(now, accepted=now.accepted | {mark.check})
        case _:
            return replace(now, accepted=now.accepted - {mark.check})


def taking_back(mark: Mark, before: Standing, who: str, why: str = "") -> Mark:
    """The mark that undoes ``mark`` where it was made on a recording that stood as ``before``."""
    match mark.action:
        case "trim" | "untrim" if before.trimmed:
            return Mark(mark.recording, "trim", who, why, start=before.start, stop=before.stop, how=before.how)
        case "trim" | "untrim":
            return Mark(mark.recording, "untrim", who, why)
        case "exclude" | "include":
            return Mark(mark.recording, "exclude" if before.excluded else "include", who, why)
        case _:
            action = "accept" if mark.check in before.accepted else "unaccept"
            return Mark(mark.recording, action, who, why, check=mark.check)
