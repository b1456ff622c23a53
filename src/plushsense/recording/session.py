"""Taking up a session's folder: a new one is made, an interrupted one is mended and goes on where it stood."""

from __future__ import annotations

import contextlib
import json
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import NOBODY
from plushsense.core.recfile import STREAM_NAME, parse_name
from plushsense.core.signal import HOST_MS, Layout
from plushsense.devices.base import now_ms
from plushsense.recording.protocol import Protocol
from plushsense.recording.sessionfile import SESSION_HEAD, SESSION_LOG, SIDECAR, Event, SessionHead, read_events
from plushsense.recording.writer import NEW, PART, LogFile

LOCK = "session.lock"
TORN = ".torn"
_KEPT_BYTES = 4096
_RESERVED = re.compile(r"(?i)con|prn|aux|nul|(com|lpt)\d")
"""What no folder can be called on Windows."""

Key = tuple[str, int]
"""A recording to be made: its gesture and its repetition."""


@dataclass
class Standing:
    """Where a session stands: the recording of each step, what was skipped, and what had to be mended.

    ``rows`` and ``host_ms``: rows of the stream so far, and the last one's time. ``mended``: sentences for the person.
    """

    takes: dict[Key, str] = field(default_factory=dict)
    skipped: set[Key] = field(default_factory=set)
    aside: dict[Key, list[str]] = field(default_factory=dict)
    rows: int = 0
    host_ms: int = 0
    resumed: bool = False
    mended: list[str] = field(default_factory=list)


def check_subject(code: str) -> str:
    """A person's code; refused when it looks like a name.

    Raises:
        DatasetError: for two words, a word without a digit, or more than 16 characters.
    """
    plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,15}", code, re.ASCII)
    bare = len(code) > 2 and not re.search(r"\d", code) and code != NOBODY
    if plain is None or bare or _RESERVED.fullmatch(code):
        raise DatasetError(
            f"'{code}' is no code for a person: give a short one with a number in it, such as S01, never a name "
            "(at most 16 letters and digits; who S01 is stays on paper, away from the recordings)."
        )
    return code


def check_session(name: str) -> str:
    """A session's name as a folder name; DatasetError for one that cannot be."""
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", name, re.ASCII) is None or _RESERVED.fullmatch(name):
        raise DatasetError(
            f"'{name}' is no name for a session: give at most 32 letters and digits, such as 1 or autumn."
        )
    return name


def session_names(person: Path) -> list[str]:
    """The sessions in a person's folder, in the order in which they were begun.

    Numbers say it where all are numbers: a computer without a battery for its clock may think that it is yesterday.
    """
    found = []
    for folder in sorted(person.iterdir()) if person.is_dir() else ():
        head = SessionHead.read(folder) if (folder / SESSION_HEAD).is_file() else None
        if head is not None:
            found.append((head.started_ms, folder.name))
    if all(name.isdigit() for _, name in found):
        return sorted((name for _, name in found), key=int)
    return [name for _, name in sorted(found)]


def is_finished(folder: Path) -> bool:
    """Whether the session in ``folder`` came to its end."""
    finished = False
    for event in read_events(folder):
        finished = event.what == "finished" or (finished and event.what not in ("redo", "go"))
    return finished


def next_session(person: Path) -> str:
    """The session to take up: the last one when it is unfinished, else a new number."""
    names = session_names(person)
    if names and not is_finished(person / names[-1]):
        return names[-1]
    return new_session(person)


def new_session(person: Path) -> str:
    """A number for a new session, after all that are there."""
    taken = {p.name for p in person.iterdir()} if person.is_dir() else set()
    number = 1
    while str(number) in taken:
        number += 1
    return str(number)


class OpenSession:
    """A session's folder, held by this process alone until it is closed.

    Attributes:
        folder, head, layout, protocol: the session's.
        standing: where it stood when it was taken up.
        log: to append events to.
    """

    def __init__(self, folder: Path, head: SessionHead | None = None) -> None:
        """Make the session of ``head`` in ``folder``, or take up the one that is there.

        Raises:
            DatasetError: when another program has it, ``head`` is of another session, or the disk refuses.
        """
        self.folder = folder
        try:
            if head is not None:
                folder.mkdir(parents=True, exist_ok=True)
            elif not (folder / SESSION_HEAD).is_file():
                raise DatasetError(f"'{folder}' holds no session: there is no {SESSION_HEAD} in it.")
            self._lock = FileLock(str(folder / LOCK), timeout=0, thread_local=False)
            self._lock.acquire()
        except Timeout:
            raise DatasetError(
                f"Another program is recording the session '{folder}': go on there, or close it first."
            ) from None
        except (OSError, NotImplementedError) as cause:
            raise DatasetError(_refused(folder, cause)) from None
        try:
            self.head = self._head(head)
            self.layout = Layout.from_dict(self.head.layout, f"layout in '{folder / SESSION_HEAD}'")
            self.protocol = Protocol.from_dict(self.head.protocol, f"protocol in '{folder / SESSION_HEAD}'")
            _end_torn_line(folder / SESSION_LOG)
            self.log = LogFile(folder)
            try:
                self.standing = _mend(folder, self.layout, self.log)
            except BaseException:
                self.log.close()
                raise
        except OSError as cause:
            self._release()
            raise DatasetError(_refused(folder, cause)) from None
        except BaseException:
            self._release()
            raise

    def _head(self, given: SessionHead | None) -> SessionHead:
        known = SessionHead.read(self.folder)
        if known is None:
            assert given is not None
            others = [p.name for p in self.folder.iterdir() if p.name != LOCK and not p.name.endswith(PART)]
            if others:
                raise DatasetError(
                    f"'{self.folder}' holds '{others[0]}' but no session: nothing is mixed, take another --session."
                )
            given.write(self.folder)
            return given
        if given is None:
            return known
        return self._joined(known, given)

    def _joined(self, known: SessionHead, given: SessionHead) -> SessionHead:
        """The head as it stands, with what only now is said; refused where both say something else."""
        added: dict[str, Any] = {}
        for key, option in (
            ("subject", "--subject"),
            ("layout", "--layout"),
            ("protocol", "--protocol"),
            ("age_group", "--age-group"),
            ("gender", "--gender"),
            ("consent", "--consent"),
        ):
            old, new = getattr(known, key), getattr(given, key)
            old_said, new_said = json.loads(json.dumps([old, new]))
            if old_said == new_said or not new:
                continue
            if old:
                shown = [v["name"] if isinstance(v, dict) and "name" in v else v for v in (old, new)]
                differs = f"{shown[0]!r}, not {shown[1]!r}" if shown[0] != shown[1] else "another one of that name"
                raise DatasetError(
                    f"The session '{self.folder}' was begun with the {key.replace('_', ' ')} {differs}: "
                    f"leave {option} as it was, or begin a new session (--new)."
                )
            added[key] = new
        if given.simulated and not known.simulated:
            raise DatasetError(
                f"The session '{self.folder}' was begun with a real toy: begin a new one (--new) for a virtual toy."
            )
        if added:
            known = replace(known, **added)
            known.write(self.folder)
        return known

    def close(self) -> None:
        """Let go of the folder. Closing twice is harmless."""
        self.log.close()
        self._release()

    def _release(self) -> None:
        if self._lock.is_locked:
            # Unlinked while it is held: who opened it meanwhile sees that and tries again. Windows unlinks it itself.
            if os.name == "posix":
                with contextlib.suppress(OSError):
                    (self.folder / LOCK).unlink()
            self._lock.release()


def _refused(folder: Path, cause: Exception) -> str:
    return f"'{folder}' cannot be used ({getattr(cause, 'strerror', None) or cause}): check the path and the disk."


def _end_torn_line(path: Path) -> None:
    """A log line that a crash tore is ended, so that the next one stands alone; readers pass over it."""
    if path.is_file() and path.stat().st_size:
        with path.open("rb+") as file:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")


def _mend(folder: Path, layout: Layout, log: LogFile) -> Standing:
    """Where the session stands, by its log and its files; what a crash left is put right, each time with an event."""
    standing = Standing(resumed=(folder / STREAM_NAME).exists() or any(True for _ in read_events(folder)))
    started, made = replay_log(folder, standing)
    _mend_stream(folder / STREAM_NAME, layout, standing, log)
    for path in sorted(folder.iterdir()):
        if path.name.endswith((PART, NEW)):
            log.write([_event("mended", file=path.name, bytes=path.stat().st_size, how="unfinished file removed")])
            path.unlink()
    _mend_takes(folder, standing, log, made)
    for path in sorted(folder.glob(f"*{SIDECAR}")):
        csv = path.with_suffix(".csv")
        # One whose recording was finished once is kept: the recording may be somewhere else, or come back.
        if path.name != SESSION_HEAD and csv.name not in made and not csv.exists():
            log.write([_event("mended", file=path.name, how="sidecar without a recording removed")])
            path.unlink()
    if started is not None and started not in standing.takes:
        log.write([_event("unfinished", gesture=started[0], repetition=started[1])])
        standing.mended.append(f"'{started[0]}', {started[1]}, was broken off: it is to be made again")
    return standing


def _event(what: str, **more: Any) -> Event:
    return Event(what, now_ms(), more)


def _key(more: dict[str, Any]) -> Key | None:
    gesture, repetition = more.get("gesture"), more.get("repetition")
    return (gesture, repetition) if isinstance(gesture, str) and isinstance(repetition, int) else None


def replay_log(folder: Path, standing: Standing) -> tuple[Key | None, dict[str, Key]]:
    """Bring ``standing`` to what the log says.

    Returns:
        The recording that was begun and never ended, and every file that ever was finished with what it is of.
    """
    of: dict[str, Key] = {}
    open_key: Key | None = None
    for event in read_events(folder):
        key, file = _key(event.more), str(event.more.get("file") or "")
        if event.what == "start":
            open_key = key
        elif event.what in ("take", "abandon", "unfinished"):
            open_key = None
        if event.what == "take" and key is not None and file:
            of[file] = key
            standing.takes[key] = file
            standing.skipped.discard(key)
        elif event.what == "redo" and file in of:
            standing.aside.setdefault(of[file], []).append(file)
            if standing.takes.get(of[file]) == file:
                del standing.takes[of[file]]
        elif event.what == "keep" and file in of:
            if file in (aside := standing.aside.get(of[file], [])):
                aside.remove(file)
            standing.takes[of[file]] = file
        elif event.what == "skip" and key is not None:
            standing.skipped.add(key)
    return open_key, of


def _mend_stream(path: Path, layout: Layout, standing: Standing, log: LogFile) -> None:
    """Count the stream's rows; a torn last line is kept in the log and cut off, so that the next row stands alone."""
    if not path.exists():
        return
    with path.open("rb+") as file:
        last = b""
        whole = size = 0
        while block := file.read(1 << 20):
            standing.rows += block.count(b"\n")
            end = block.rfind(b"\n")
            if end >= 0:
                tail = last + block[:end]
                standing.host_ms = _host_ms(tail[tail.rfind(b"\n") + 1 :], layout) or standing.host_ms
                last = block[end + 1 :]
                whole = size + end + 1
            else:
                last += block
            size += len(block)
        if size > whole:
            kept = last[:_KEPT_BYTES].decode("ascii", "backslashreplace")
            log.write([_event("mended", file=path.name, how="torn last line cut off", bytes=size - whole, text=kept)])
            file.truncate(whole)
            os.fsync(file.fileno())
            standing.mended.append(f"the last line of {path.name} was torn and is cut off ({size - whole} bytes)")


def _host_ms(line: bytes, layout: Layout) -> int:
    cells = line.split(layout.csv.separator.strip().encode() or None)
    if HOST_MS in layout.csv.columns and len(cells) == len(layout.csv.columns):
        with contextlib.suppress(ValueError):
            return int(cells[layout.csv.columns.index(HOST_MS)])
    return 0


def _mend_takes(folder: Path, standing: Standing, log: LogFile, made: dict[str, Key]) -> None:
    """Look at every recording: one that the log does not know is taken in, one that is not whole is set aside."""
    known = {file: key for key, file in standing.takes.items()}
    known |= {file: key for key, files in standing.aside.items() for file in files}
    for path in sorted(folder.glob("*.csv"), key=lambda p: (n.epoch_ms if (n := parse_name(p.name)) else 0, p.name)):
        name = parse_name(path.name)
        if name is None:
            continue
        key = known.get(path.name)
        data = path.read_bytes()
        if not data.endswith(b"\n") or data.count(b"\n") != name.rows + 1:
            os.replace(path, path.with_name(path.name + TORN))
            log.write([_event("mended", file=path.name, how=f"not whole: renamed to end in {TORN}")])
            standing.mended.append(f"'{path.name}' is not whole: it is to be made again")
            if key is not None and standing.takes.get(key) == path.name:
                del standing.takes[key]
            continue
        if key is not None:
            continue
        if path.name in made:
            # It was gone, was made again, and is back: the newer one counts.
            key = made[path.name]
            log.write([_event("redo", file=path.name, gesture=key[0], repetition=key[1], why="made again")])
            standing.aside.setdefault(key, []).insert(0, path.name)
            continue
        try:
            sidecar = json.loads(path.with_suffix(SIDECAR).read_text(encoding="utf-8"))
            key = _key(sidecar)
        except (OSError, ValueError, AttributeError):
            key = None
        if key is None:
            continue
        events = [_event("take", file=path.name, gesture=key[0], repetition=key[1], rows=name.rows, found=True)]
        if key in standing.takes:
            events.append(_event("redo", file=standing.takes[key], gesture=key[0], repetition=key[1]))
            standing.aside.setdefault(key, []).append(standing.takes[key])
        log.write(events)
        standing.takes[key] = path.name
        standing.skipped.discard(key)
    for key, file in list(standing.takes.items()):
        if not (folder / file).exists():
            log.write([_event("mended", file=file, how="the recording is gone", gesture=key[0], repetition=key[1])])
            standing.mended.append(f"'{file}' is gone: it is to be made again")
            del standing.takes[key]
