"""Marks: decisions of people about recordings and streams, appended to ``marks.jsonl``. Raw files are never changed."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.toml import load_table, loads_json

MARKS = "marks.jsonl"
RECORDER = "recorder"
"""Who set the marks that were made while recording."""
BY_HAND, SUGGESTED = "hand", "suggested"
LOCK = MARKS + ".lock"
"""Lock file of a data set, see `locked`."""
# Much longer than it takes to delete a large cache on a slow disk.
_LOCK_S = 600.0
_NO_LOCKS = (errno.EROFS, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
_MARKS_S = 30.0
ACTIONS = ("trim", "untrim", "exclude", "include", "accept", "unaccept", "label", "unlabel", "relabel")
HANDLING, REST, PRACTICE = "handling", "rest", "practice:"
"""Labels of a stretch; the name of a gesture follows `PRACTICE`."""


@dataclass(frozen=True)
class Mark:
    """Decision about a recording or a stream.

    The action ``trim`` keeps the rows from ``start`` to before ``stop`` (-1: the end), ``exclude`` removes the
    recording from use, ``accept`` states that the findings of ``check`` are known and no fault; ``untrim``,
    ``include`` and ``unaccept`` undo them. ``label`` states what happens in the rows from ``start`` to before
    ``stop`` of a stream, and replaces earlier labels of these rows; ``unlabel`` removes labels. ``relabel`` states
    that another ``gesture`` was made than the recording is named after; with the gesture "" it is the recorded one
    again. ``recording`` is the id of a recording, stream or person, or "" for the whole data set. The attribute
    ``label`` is `HANDLING` (the toy is picked up, turned or put down), `REST` (nobody touches it), or `PRACTICE` and
    a gesture.
    ``how`` is the origin of a trim: "hand" (set by a person) or "suggested" (a suggestion that was accepted); "" in
    older marks counts as "hand".
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
    label: str = ""
    gesture: str = ""


_TYPES = {key: int if key in ("start", "stop") else str for key in Mark.__dataclass_fields__}
_REQUIRED = {"recording", "action", "who"}


@dataclass(frozen=True)
class LabelledStretch:
    """The rows from ``start`` to before ``stop`` of a stream, with the label of a `Mark`."""

    stream: str
    start: int
    stop: int
    label: str

    @property
    def gesture(self) -> str:
        """Gesture that is practised; "" if the stretch is no practice."""
        return self.label.removeprefix(PRACTICE) if self.label.startswith(PRACTICE) else ""

    def outside(self, start: int, stop: int) -> list[LabelledStretch]:
        """Return what remains without the rows from ``start`` to before ``stop`` (-1: the end)."""
        if self.stop <= start or 0 <= stop <= self.start:
            return [self]
        ends = [(self.start, min(self.stop, start)), (max(self.start, stop) if stop >= 0 else self.stop, self.stop)]
        return [replace(self, start=a, stop=b) for a, b in ends if a < b]


@dataclass(frozen=True)
class MarkState:
    """State of a recording or a stream after all its marks.

    ``accepted`` holds the checks whose findings are accepted; ``how`` is that of the current trim. ``stretches`` of a
    stream are ordered and do not overlap. ``gesture`` is "" if it is the recorded one. ``excluded_by``, ``trim_by`` and
    ``gesture_by`` name who decided last on these, also to undo them; "" if nobody did.
    """

    excluded: bool = False
    start: int = 0
    stop: int = -1
    accepted: frozenset[str] = frozenset()
    how: str = ""
    stretches: tuple[LabelledStretch, ...] = ()
    gesture: str = ""
    excluded_by: str = field(default="", compare=False)
    trim_by: str = field(default="", compare=False)
    gesture_by: str = field(default="", compare=False)

    @property
    def trimmed(self) -> bool:
        """Whether the recording is trimmed, even by a trim that keeps all rows."""
        return bool(self.how) or (self.start, self.stop) != (0, -1)


def _refuse_contradictions(mark: Mark, where: str) -> None:
    """Raise DatasetError for a mark whose values contradict each other, or are out of range."""
    if mark.action not in ACTIONS:
        raise DatasetError(
            "{where}: unknown mark '{action}': accepted are {actions}.{hint}",
            where=where,
            action=mark.action,
            actions=", ".join(ACTIONS),
            hint=nearest(mark.action, ACTIONS),
        )
    is_label = mark.label in (HANDLING, REST) or (mark.label.startswith(PRACTICE) and mark.label != PRACTICE)
    checks = mark.action in ("accept", "unaccept")
    for wrong, problem in (
        (mark.start < 0, "start is {m.start}; it must be a whole number from 0 on."),
        (mark.stop < -1, "stop is {m.stop}; it must be a whole number from -1 on."),
        (0 <= mark.stop <= mark.start, "rows {m.start} to {m.stop} keep nothing; stop must be above start, or -1."),
        (bool(mark.check) != checks, "{a} with check '{m.check}'; accept and unaccept name a check."),
        (
            mark.how not in ("", BY_HAND, SUGGESTED) or (mark.how and mark.action != "trim"),
            f"{{a}} made by '{{m.how}}'; a trim may be by {BY_HAND} or {SUGGESTED}.",
        ),
        (
            is_label != (mark.action == "label") or (mark.label and not is_label),
            f"{{a}} with label '{{m.label}}'; only the action label has one: {HANDLING}, {REST}, or {PRACTICE} and a "
            "gesture.",
        ),
        (mark.gesture and mark.action != "relabel", "{a} with gesture '{m.gesture}'; only relabel has one."),
        (mark.action == "label" and mark.stop < 0, "{a} without stop; it needs the row after its last one."),
    ):
        if wrong:
            problem = problem.format(m=mark, a=f"a mark '{mark.action}'")
            raise DatasetError(f"{where}: {problem}")


def match_ids(pattern: str, known: Iterable[str], kind: str) -> list[str]:
    """Return the ids of ``known`` that ``pattern`` matches: an id, or a glob such as ``P19/*``.

    Raises:
        DatasetError: if there is none; the message calls an id ``what`` and suggests the nearest one.
    """
    ids = sorted(set(known))
    matched = [pattern] if pattern in ids else [i for i in ids if fnmatchcase(i, pattern)]
    if not matched:
        hint = nearest(pattern, ids)
        example = f" For example '{ids[0]}', or a pattern such as 'P01/*'." if ids and not hint else ""
        raise DatasetError(
            "There is no {kind} '{name}'.{hint}{example}", kind=kind, name=pattern, hint=hint, example=example
        )
    return matched


def mark_line(mark: Mark) -> str:
    """Return a mark as a line of ``marks.jsonl``, without an empty label or gesture, as in older versions."""
    table = {key: value for key, value in asdict(mark).items() if key not in ("label", "gesture") or value}
    return json.dumps(table, ensure_ascii=False) + "\n"


@contextmanager
def locked(folder: Path, timeout_s: float = _LOCK_S) -> Iterator[None]:
    """Hold the lock of a data set while its files are written or removed; do not nest.

    On a read-only disk, or one without locks, nothing is locked.

    Raises:
        DatasetError: if another program holds the lock for longer than ``timeout_s``.
        OSError: if the lock's file cannot be made for another reason.
    """
    lock = FileLock(folder / LOCK, timeout=timeout_s)
    try:
        lock.acquire()
    except Timeout:
        raise DatasetError(
            "Another program has held '{path}' for {timeout_s:.0f} s: wait for it or end it.",
            path=folder / LOCK,
            timeout_s=timeout_s,
            folder=folder.name,
        ) from None
    except NotImplementedError:
        pass
    except OSError as cause:
        if not isinstance(cause, PermissionError) and cause.errno not in _NO_LOCKS:
            raise
    try:
        yield
    finally:
        lock.release()


@contextmanager
def adding_locked(folder: Path) -> Iterator[None]:
    """Hold the lock of an import into a data set, which keeps copies of raw files in it; on a read-only disk nothing.

    Raises:
        Timeout: if an import, or a removal, holds the lock.
    """
    lock = FileLock(folder / "adding.lock", timeout=0)
    with suppress(PermissionError, NotImplementedError):
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def append_marks(folder: Path, marks: Iterable[Mark], check: Callable[[], None] | None = None) -> None:
    """Append marks under a file lock, so that several programs can write marks at the same time.

    Args:
        check: called while the lock is held, before anything is written; an exception prevents it. For marks about an
            open data set, that is `dataset.store.Generation.check` (`Dataset.append_marks`).

    Raises:
        DatasetError: for a mark with contradictory values, or a folder that cannot be written.
    """
    marks = tuple(marks)
    if not marks:
        return
    try:
        with locked(folder, _MARKS_S):
            if check is not None:
                check()
            write_marks(folder, marks)
    except OSError as cause:
        raise DatasetError(
            "'{path}' cannot be written: {why}.", path=folder / MARKS, why=cause.strerror or cause
        ) from None


def write_marks(folder: Path, marks: Iterable[Mark]) -> None:
    """Append marks while the caller holds the lock of the data set, see `append_marks`.

    Raises:
        DatasetError: for a mark with contradictory values.
    """
    lines = []
    for mark in marks:
        _refuse_contradictions(mark, f"The mark of '{mark.recording}'")
        when = mark.when or datetime.now(timezone.utc).isoformat(timespec="seconds")
        lines.append(mark_line(replace(mark, when=when)))
    if not lines:
        return
    with (folder / MARKS).open("a+b") as file:
        # An incomplete last line must not merge with the next mark.
        if file.seek(0, os.SEEK_END) > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                lines.insert(0, "\n")
        file.write("".join(lines).encode("utf-8"))


def read_marks(folder: Path) -> dict[str, MarkState]:
    """Return the state of each marked recording.

    A line that is not JSON (cut off by a crash) is skipped; raise DatasetError for JSON that is not a valid mark.
    """
    path = folder / MARKS
    states: dict[str, MarkState] = {}
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return states
    except OSError as cause:
        raise _unreadable(path, cause) from None
    for number, line in enumerate(lines, 1):
        try:
            table: Any = loads_json(line.decode("utf-8"))
        except (ValueError, RecursionError):
            continue
        where = f"'{path}' line {number}"
        # Checking each value strictly takes most of the time, and is only needed to say what is wrong.
        plain = isinstance(table, dict) and _REQUIRED <= table.keys() <= _TYPES.keys()
        plain = plain and all(type(value) is _TYPES[key] for key, value in table.items())
        mark = (
            Mark(**table)
            if plain
            else load_table(table, Mark, where, DatasetError, "The marks cannot be read. {problem}")
        )
        _refuse_contradictions(mark, where)
        states[mark.recording] = apply_mark(states.get(mark.recording, MarkState()), mark)
    return states


def _unreadable(path: Path, cause: OSError) -> DatasetError:
    why = cause.strerror or str(cause)
    return DatasetError("'{path}' cannot be read: {why}.", path=path, why=why)


class MarksFollower:
    """Reader of the marks of a data set that reads the file again only if it changed. Not thread-safe."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: tuple[int, int, int] | None = None
        self._states: dict[str, MarkState] = {}

    @property
    def changed(self) -> bool:
        """Whether the file changed since `states` was last called."""
        return self._now() != self._seen

    def states(self) -> dict[str, MarkState]:
        """Return the state of each marked recording, like `read_marks`; a new dictionary if the file changed."""
        now = self._now()
        if now != self._seen:
            self._states = read_marks(self._folder)
            self._seen = now
        return self._states

    def _now(self) -> tuple[int, int, int] | None:
        path = self._folder / MARKS
        try:
            now = path.stat()
        except FileNotFoundError:
            return None
        except OSError as cause:
            raise _unreadable(path, cause) from None
        return now.st_ino, now.st_size, now.st_mtime_ns


def apply_mark(now: MarkState, mark: Mark) -> MarkState:
    """Return the state of a recording after ``mark``, from its state ``now``."""
    match mark.action:
        case "trim":
            return replace(now, start=mark.start, stop=mark.stop, how=mark.how, trim_by=mark.who)
        case "untrim":
            return replace(now, start=0, stop=-1, how="", trim_by=mark.who)
        case "exclude":
            return replace(now, excluded=True, excluded_by=mark.who)
        case "include":
            return replace(now, excluded=False, excluded_by=mark.who)
        case "relabel":
            return replace(now, gesture=mark.gesture, gesture_by=mark.who)
        case "accept":
            return replace(now, accepted=now.accepted | {mark.check})
        case "label" | "unlabel":
            pieces = [piece for s in now.stretches for piece in s.outside(mark.start, mark.stop)]
            if mark.action == "label":
                pieces.append(LabelledStretch(mark.recording, mark.start, mark.stop, mark.label))
            return replace(now, stretches=tuple(sorted(pieces, key=lambda s: s.start)))
        case _:
            return replace(now, accepted=now.accepted - {mark.check})


def inverse_marks(mark: Mark, before: MarkState, who: str, why: str = "") -> list[Mark]:
    """Return the marks that undo ``mark`` on a recording or stream whose state was ``before``."""
    match mark.action:
        case "trim" | "untrim" if before.trimmed:
            return [Mark(mark.recording, "trim", who, why, start=before.start, stop=before.stop, how=before.how)]
        case "trim" | "untrim":
            return [Mark(mark.recording, "untrim", who, why)]
        case "exclude" | "include":
            return [Mark(mark.recording, "exclude" if before.excluded else "include", who, why)]
        case "relabel":
            return [Mark(mark.recording, "relabel", who, why, gesture=before.gesture)]
        case "label" | "unlabel":
            replaced = [s for s in before.stretches if s.outside(mark.start, mark.stop) != [s]]
            return [
                Mark(mark.recording, "unlabel", who, why, start=mark.start, stop=mark.stop),
                *(Mark(s.stream, "label", who, why, start=s.start, stop=s.stop, label=s.label) for s in replaced),
            ]
        case _:
            action = "accept" if mark.check in before.accepted else "unaccept"
            return [Mark(mark.recording, action, who, why, check=mark.check)]
