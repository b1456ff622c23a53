"""Open a session's folder: create the requested one, or repair and continue an interrupted one."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import secrets
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError
from plushsense.core.files import PART
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import HOST_MS, Layout
from plushsense.core.recorder_csv import STREAM_NAME, parse_name
from plushsense.core.sentences import Message
from plushsense.core.toml import loads_json
from plushsense.devices.base import now_ms
from plushsense.devices.opening import is_virtual
from plushsense.recording.plan import Protocol, load_protocol
from plushsense.recording.writer import (
    SESSION_HEAD,
    SESSION_LOG,
    SIDECAR,
    LogFile,
    SessionEvent,
    SessionHead,
    read_events,
)

LOCK = "session.lock"
TORN = ".torn"
_KEPT_BYTES = 4096
_RESERVED = re.compile(r"(?i)con|prn|aux|nul|(com|lpt)\d")
"""Names that Windows reserves."""

Key = tuple[str, int]
"""Key of a planned recording: its gesture and its repetition."""
# Errors for an opened session of which a value of the head differs, by its key.
_DIFFERS = {
    "subject": (
        "The session '{folder}' was begun with the subject {differs}: leave --subject as it was, or begin a new "
        "session (--new)."
    ),
    "layout": (
        "The session '{folder}' was begun with the layout {differs}: leave --layout as it was, or begin a new "
        "session (--new)."
    ),
    "protocol": (
        "The session '{folder}' was begun with the protocol {differs}: leave --protocol as it was, or begin a new "
        "session (--new)."
    ),
    "age_group": (
        "The session '{folder}' was begun with the age group {differs}: leave --age-group as it was, or begin a new "
        "session (--new)."
    ),
    "gender": (
        "The session '{folder}' was begun with the gender {differs}: leave --gender as it was, or begin a new "
        "session (--new)."
    ),
    "consent": (
        "The session '{folder}' was begun with the consent {differs}: leave --consent as it was, or begin a new "
        "session (--new)."
    ),
}


@dataclass
class SessionProgress:
    """State of a session: the recording in use of each step, discarded files, skipped steps, repairs after a crash.

    ``rows`` is the number of rows of the stream, ``host_ms`` the time of the last one; ``repairs`` are messages for
    the user.
    """

    takes: dict[Key, str] = field(default_factory=dict)
    skipped: set[Key] = field(default_factory=set)
    discarded: dict[Key, list[str]] = field(default_factory=dict)
    rows: int = 0
    host_ms: int = 0
    resumed: bool = False
    repairs: list[Message] = field(default_factory=list)


def check_subject(code: str) -> str:
    """Return a person's code if it is valid and does not look like a name.

    Raises:
        DatasetError: for a word without a digit, characters other than ``A-Za-z0-9_-``, or more than 16 of them.
    """
    valid = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,15}", code, re.ASCII)
    is_word = len(code) > 2 and not re.search(r"\d", code) and code != NOBODY
    if valid is None or is_word or _RESERVED.fullmatch(code):
        raise DatasetError(
            "'{code}' is no code for a person: give a short one with a number in it, such as S01, never a name (at "
            "most 16 letters and digits; keep the name that belongs to S01 on paper, away from the recordings).",
            code=code,
            field="person",
        )
    return code


def check_session(name: str) -> str:
    """Return the name of a session if it is valid as a folder name, else raise DatasetError."""
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", name, re.ASCII) is None or _RESERVED.fullmatch(name):
        raise DatasetError(
            "'{name}' is no name for a session: give at most 32 letters and digits, such as 1 or autumn.", name=name
        )
    return name


def session_names(person: Path) -> list[str]:
    """Return the sessions in a person's folder, in the order of their start.

    If all names are numbers, sort by number, since the clock of a computer without a clock battery may be wrong.
    """
    folders = sorted(person.iterdir()) if person.is_dir() else []
    heads = [(head.started_ms, f.name) for f in folders if f.is_dir() and (head := SessionHead.read(f)) is not None]
    if all(name.isdigit() for _, name in heads):
        return sorted((name for _, name in heads), key=int)
    return [name for _, name in sorted(heads)]


def is_finished(folder: Path) -> bool:
    """Return whether the session in ``folder`` was completed or marked as finished, and not reopened since."""
    finished = False
    for event in read_events(folder):
        finished = event.kind == "finished" or (finished and event.kind not in ("redo", "go", "reopened"))
    return finished


def next_session(person: Path) -> str:
    """Return the name of the session to continue: the last one if it is unfinished, else a new number."""
    names = session_names(person)
    if names and not is_finished(person / names[-1]):
        return names[-1]
    return new_session(person)


def new_session(person: Path, prefix: str = "") -> str:
    """Return an unused name for a new session: ``prefix`` and a number.

    A folder in which a session was about to begin when the program was killed or the disk was full is used again.
    """
    taken = {p.name for p in person.iterdir() if not _is_left_empty(p)} if person.is_dir() else set()
    return next(name for number in itertools.count(1) if (name := f"{prefix}{number}") not in taken)


def _is_left_empty(folder: Path) -> bool:
    """Return whether nothing was written into the folder of a session, and no program uses it."""
    if not folder.is_dir() or any(map(_is_content, folder.iterdir())):
        return False
    try:
        with FileLock(folder / LOCK, timeout=0):
            return True
    except (Timeout, OSError, NotImplementedError):
        return False


def _is_content(path: Path) -> bool:
    return path.name != LOCK and path.suffix != PART


class OpenSession:
    """Folder of a session, locked by this process until `close`; ``progress`` is its state when it was opened."""

    def __init__(self, folder: Path, head: SessionHead | None = None) -> None:
        """Create the session of ``head`` in ``folder``, or open the existing one.

        Raises:
            DatasetError: if another program uses it, ``head`` contradicts the existing one, or the disk fails.
        """
        self.folder = folder
        try:
            with contextlib.ExitStack() as undo:
                if head is not None:
                    folder.mkdir(parents=True, exist_ok=True)
                elif not (folder / SESSION_HEAD).is_file():
                    raise DatasetError(
                        "'{path}' holds no session: there is no {session_head} in it.",
                        path=folder,
                        session_head=SESSION_HEAD,
                    )
                self._lock = FileLock(str(folder / LOCK), timeout=0, thread_local=False)
                self._lock.acquire()
                undo.callback(self._release)
                self.head = self._head(head)
                self.layout = Layout.from_dict(self.head.layout, f"layout in '{folder / SESSION_HEAD}'")
                self.protocol = Protocol.from_dict(self.head.protocol, f"protocol in '{folder / SESSION_HEAD}'")
                _end_torn_line(folder / SESSION_LOG)
                self.log = LogFile(folder)
                undo.callback(self.log.close)
                self.progress = _repair(folder, self.layout, self.log)
                undo.pop_all()
        except Timeout:
            raise DatasetError(
                "Another program is recording the session '{folder}': continue there, or close it first.",
                folder=folder,
                name=f"{folder.parent.name}/{folder.name}",
                field="person",
            ) from None
        except (OSError, NotImplementedError) as cause:
            why = getattr(cause, "strerror", None) or cause
            raise DatasetError(
                "'{folder}' cannot be used ({why}): check the path and the disk.", folder=folder, why=why
            ) from None

    def _head(self, given: SessionHead | None) -> SessionHead:
        known = SessionHead.read(self.folder)
        if known is None:
            assert given is not None
            others = [p.name for p in self.folder.iterdir() if _is_content(p)]
            if others:
                raise DatasetError(
                    "'{folder}' holds '{file}' but no session: give another --session or an empty folder.",
                    folder=self.folder,
                    file=others[0],
                )
            given.write(self.folder)
            return given
        return known if given is None else self._joined(known, given)

    def _joined(self, known: SessionHead, given: SessionHead) -> SessionHead:
        """Return the stored head with values that only ``given`` has; raise DatasetError if they contradict."""
        added: dict[str, Any] = {}
        for key in _DIFFERS:
            old, new = getattr(known, key), getattr(given, key)
            old_json, new_json = json.loads(json.dumps([old, new]))
            if key == "protocol":
                # The seed of a random order is drawn once, when a session begins.
                for table in (old_json, new_json):
                    table.pop("seed", None)
            if old_json == new_json or not new:
                continue
            if old:
                names = [v["name"] if isinstance(v, dict) and "name" in v else v for v in (old, new)]
                differs = f"{names[0]!r}, not {names[1]!r}" if names[0] != names[1] else "another one of that name"
                raise DatasetError(
                    _DIFFERS[key],
                    folder=self.folder,
                    differs=differs,
                    name=f"{self.folder.parent.name}/{self.folder.name}",
                )
            added[key] = new
        if given.simulated and not known.simulated:
            raise DatasetError(
                "The session '{folder}' was begun with a real toy: begin a new one (--new) for a virtual toy.",
                folder=self.folder,
                name=f"{self.folder.parent.name}/{self.folder.name}",
                field="toy",
            )
        if added:
            known = replace(known, **added)
            known.write(self.folder)
        return known

    def close(self) -> None:
        """Release the folder. Closing twice is harmless."""
        self.log.close()
        self._release()

    def _release(self) -> None:
        if self._lock.is_locked:
            # Delete it while locked: a process that opened it meanwhile notices and tries again. Windows deletes it.
            if os.name == "posix":
                with contextlib.suppress(OSError):
                    (self.folder / LOCK).unlink()
            self._lock.release()


def mark_finished(folder: Path, finished: bool = True) -> None:
    """Mark a session as finished although its plan is not complete, or take that back with ``finished`` False.

    Raises:
        DatasetError: if another program uses the session, or it cannot be written.
    """
    with contextlib.closing(OpenSession(folder)) as session:
        session.log.write([new_event("finished", early=True) if finished else new_event("reopened")])


def change_subject(folder: Path, code: str, recordings: Path | None = None) -> Path:
    """Give the session in ``folder`` to the person ``code``, and return its new folder, in ``recordings`` if given.

    It keeps its name, or gets a number if the person has a session of that name.

    Raises:
        DatasetError: for an invalid code, or if another program uses the session.
    """
    person = (recordings or folder.parent.parent) / check_subject(code)
    if person == folder.parent:
        return folder
    OpenSession(folder).close()  # refuses if another program uses it
    place = person / (folder.name if not (person / folder.name).exists() else new_session(person))
    person.mkdir(parents=True, exist_ok=True)
    folder.rename(place)
    with contextlib.closing(OpenSession(place)) as session:
        session.log.write([new_event("renamed", subject=session.head.subject, session=session.head.session)])
        replace(session.head, subject=code, session=place.name).write(place)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
    return place


def _end_torn_line(path: Path) -> None:
    """Add a line end after a line that a crash cut off, so that the next one is separate; readers skip it."""
    if path.is_file() and path.stat().st_size:
        with path.open("rb+") as file:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")


def _repair(folder: Path, layout: Layout, log: LogFile) -> SessionProgress:
    """Return the progress of a session from its log and files; repair damage by a crash, and log each repair."""
    progress = SessionProgress(resumed=(folder / STREAM_NAME).exists() or any(True for _ in read_events(folder)))
    started, made = replay_log(folder, progress)
    _repair_stream(folder / STREAM_NAME, layout, progress, log)
    for path in sorted(folder.iterdir()):
        # ".new" was written by earlier versions.
        if path.name.endswith((PART, ".new")):
            log.write([new_event("mended", file=path.name, bytes=path.stat().st_size, how="unfinished file removed")])
            path.unlink()
    _repair_takes(folder, progress, log, made)
    for path in sorted(folder.glob(f"*{SIDECAR}")):
        csv = path.with_suffix(".csv")
        # Keep the sidecar of a recording that was finished once, since its file may be restored.
        if path.name != SESSION_HEAD and csv.name not in made and not csv.exists():
            log.write([new_event("mended", file=path.name, how="sidecar without a recording removed")])
            path.unlink()
    if started is not None and started not in progress.takes:
        log.write([new_event("unfinished", gesture=started[0], repetition=started[1])])
        progress.repairs.append(
            Message("'{gesture}', {n}, was interrupted: record it again", gesture=started[0], n=started[1])
        )
    return progress


def new_event(kind: str, **details: Any) -> SessionEvent:
    """Return an event with the current time."""
    return SessionEvent(kind, now_ms(), details)


def _key(more: dict[str, Any]) -> Key | None:
    gesture, repetition = more.get("gesture"), more.get("repetition")
    return (gesture, repetition) if isinstance(gesture, str) and isinstance(repetition, int) else None


def replay_log(folder: Path, progress: SessionProgress) -> tuple[Key | None, dict[str, Key]]:
    """Update ``progress`` from the events of the log.

    Returns:
        The key of a recording that began but did not end (or None), and the key of each file ever finished.
    """
    of: dict[str, Key] = {}
    open_key: Key | None = None
    for event in read_events(folder):
        key, file = _key(event.details), str(event.details.get("file") or "")
        if event.kind == "start":
            open_key = key
        elif event.kind in ("take", "abandon", "unfinished"):
            open_key = None
        if event.kind == "take" and key is not None and file:
            of[file] = key
            progress.takes[key] = file
            progress.skipped.discard(key)
        elif event.kind == "redo" and file in of:
            progress.discarded.setdefault(of[file], []).append(file)
            if progress.takes.get(of[file]) == file:
                del progress.takes[of[file]]
        elif event.kind == "keep" and file in of:
            if file in (discarded := progress.discarded.get(of[file], [])):
                discarded.remove(file)
            progress.takes[of[file]] = file
        elif event.kind == "skip" and key is not None:
            progress.skipped.add(key)
    return open_key, of


def _repair_stream(path: Path, layout: Layout, progress: SessionProgress, log: LogFile) -> None:
    """Count the rows of the stream; move an incomplete last line to the log, so that the next row is separate."""
    if not path.exists():
        return
    with path.open("rb+") as file:
        last = b""
        whole = size = 0
        while block := file.read(1 << 20):
            progress.rows += block.count(b"\n")
            end = block.rfind(b"\n")
            if end >= 0:
                tail = last + block[:end]
                progress.host_ms = _host_ms(tail[tail.rfind(b"\n") + 1 :], layout) or progress.host_ms
                last = block[end + 1 :]
                whole = size + end + 1
            else:
                last += block
            size += len(block)
        if size > whole:
            torn = last[:_KEPT_BYTES].decode("ascii", "backslashreplace")
            log.write(
                [new_event("mended", file=path.name, how="torn last line cut off", bytes=size - whole, text=torn)]
            )
            file.truncate(whole)
            os.fsync(file.fileno())
            progress.repairs.append(
                Message(
                    "the incomplete last line of {file} was removed ({size} bytes)", file=path.name, size=size - whole
                )
            )


def _host_ms(line: bytes, layout: Layout) -> int:
    cells = line.split(layout.csv.separator.strip().encode() or None)
    if HOST_MS in layout.csv.columns and len(cells) == len(layout.csv.columns):
        with contextlib.suppress(ValueError):
            return int(cells[layout.csv.columns.index(HOST_MS)])
    return 0


def _repair_takes(folder: Path, progress: SessionProgress, log: LogFile, made: dict[str, Key]) -> None:
    """Check every recording: add those that the log lacks, rename incomplete ones, and drop missing ones."""
    known = {file: key for key, file in progress.takes.items()}
    known |= {file: key for key, files in progress.discarded.items() for file in files}
    for path in sorted(folder.glob("*.csv"), key=lambda p: (n.epoch_ms if (n := parse_name(p.name)) else 0, p.name)):
        name = parse_name(path.name)
        if name is None:
            continue
        key = known.get(path.name)
        data = path.read_bytes()
        if not data.endswith(b"\n") or data.count(b"\n") != name.rows + 1:
            os.replace(path, path.with_name(path.name + TORN))
            log.write([new_event("mended", file=path.name, how=f"not whole: renamed to end in {TORN}")])
            progress.repairs.append(Message("'{file}' is incomplete: record it again", file=path.name))
            if key is not None and progress.takes.get(key) == path.name:
                del progress.takes[key]
            continue
        if key is not None:
            continue
        if path.name in made:
            # The file was missing, so the step was recorded again, and the file is back: use the newer one.
            key = made[path.name]
            log.write([new_event("redo", file=path.name, gesture=key[0], repetition=key[1], why="made again")])
            progress.discarded.setdefault(key, []).insert(0, path.name)
            continue
        try:
            sidecar = loads_json(path.with_suffix(SIDECAR).read_text(encoding="utf-8"))
            key = _key(sidecar)
        except (OSError, ValueError, AttributeError):
            key = None
        if key is None:
            continue
        events = [new_event("take", file=path.name, gesture=key[0], repetition=key[1], rows=name.rows, found=True)]
        if key in progress.takes:
            events.append(new_event("redo", file=progress.takes[key], gesture=key[0], repetition=key[1]))
            progress.discarded.setdefault(key, []).append(progress.takes[key])
        log.write(events)
        progress.takes[key] = path.name
        progress.skipped.discard(key)
    for key, file in list(progress.takes.items()):
        if not (folder / file).exists():
            log.write([new_event("mended", file=file, how="the recording is gone", gesture=key[0], repetition=key[1])])
            progress.repairs.append(Message("'{file}' is missing: record it again", file=file))
            del progress.takes[key]


@dataclass(frozen=True)
class SessionSummary:
    """Summary of a session on disk.

    ``head`` and ``protocol`` are None if they cannot be read, for the reason ``error``; ``done``, ``skipped`` and
    ``steps`` are numbers of steps.
    """

    folder: Path
    head: SessionHead | None = None
    protocol: Protocol | None = None
    done: int = 0
    skipped: int = 0
    steps: int = 0
    finished: bool = False
    error: str = ""

    @property
    def name(self) -> str:
        """Subject and session, as in ``S01/1``."""
        return f"{self.folder.parent.name}/{self.folder.name}"


def list_sessions(out: Path) -> list[SessionSummary]:
    """Return the summaries of all sessions in ``out``, the newest first, including unreadable ones."""
    sessions = [summarize_session(path.parent) for path in sorted(out.glob(f"*/*/{SESSION_HEAD}"))]
    return sorted(sessions, key=lambda s: -(s.head.started_ms if s.head is not None else 0))


def summarize_session(folder: Path) -> SessionSummary:
    """Return the summary of the session in ``folder``."""
    try:
        head = SessionHead.read(folder)
        if head is None:
            return SessionSummary(folder, error=f"'{folder}' holds no session.")
        protocol = Protocol.from_dict(head.protocol, f"protocol in '{folder / SESSION_HEAD}'")
        progress = SessionProgress()
        replay_log(folder, progress)
        finished = is_finished(folder)
    except PlushSenseError as refusal:
        return SessionSummary(folder, error=str(refusal))
    steps = len(protocol.steps())
    return SessionSummary(folder, head, protocol, len(progress.takes), len(progress.skipped), steps, finished)


PROTOCOL = "plush-17"
"""The default protocol of a new session."""
FASTEST = 1000.0


@dataclass(frozen=True)
class SessionRequest:
    """Request of the terminal or the studio for a recording session.

    ``device`` is the toy's URL, ``subject`` a code ("" for a protocol that is recorded without a person). Without
    ``protocol``, ``words`` or ``layout``, a continued session keeps its own, and a new one has `PROTOCOL`, its default
    wording, and the layout of the URL or plush-15. The toy runs at ``speed`` times real time. ``simulated`` marks a
    virtual toy that cannot be recognised by its URL.
    """

    device: str
    subject: str = ""
    protocol: str = ""
    words: str = ""
    layout: str = ""
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    speed: float = 1.0
    simulated: bool = False


def check_speed(speed: float) -> float:
    """Return ``speed`` if it is valid, else raise ConfigError."""
    if not 0.0 <= speed <= FASTEST:
        raise ConfigError(
            "--speed is {speed:g}; 0 (as fast as it can) to {most:g} is accepted.", speed=speed, most=FASTEST
        )
    return speed


def session_folder(
    out: Path, request: SessionRequest, session: str | None = None, new: bool = False
) -> tuple[Path, SessionHead | None]:
    """Return the folder of the requested session in ``out``, and its head if it exists.

    Args:
        session: its name; None for the person's last session if that is unfinished, else for a new number.
        new: whether to begin a new session in any case.

    Raises:
        ConfigError: if there is no subject, or a new session was requested and one of this name exists.
        DatasetError: for an invalid code or name.
    """
    subject = request.subject
    if not subject and request.protocol and load_protocol(request.protocol).needs_nobody:
        subject = NOBODY
    if not subject:
        raise ConfigError(
            "The session has no person: give --subject with the person's code, such as S01.", field="person"
        )
    person = out / check_subject(subject)
    if session is not None:
        name = check_session(session)
    else:
        name = new_session(person) if new else next_session(person)
    known = SessionHead.read(person / name)
    if known is not None and new:
        raise ConfigError(
            "The session '{person}' exists: leave --new off, or give another --session.",
            person=person / name,
            name=f"{person.name}/{name}",
        )
    return person / name, known


def session_layout(request: SessionRequest, folder: Path, known: SessionHead | None) -> Layout | str | None:
    """Return the layout to open the toy with; None for that of the URL."""
    if not request.layout and known is not None:
        return Layout.from_dict(known.layout, f"layout in '{folder}'")
    return request.layout or None


def session_head(request: SessionRequest, folder: Path, fresh: bool, layout: Layout, software: str) -> SessionHead:
    """Return the head of the requested session; for a continued session, settings not requested are empty.

    Args:
        fresh: whether the session is new.
        layout: the layout of the open toy.
        software: name and version of the recording program.
    """
    named = request.protocol or (PROTOCOL if fresh else "")
    if not named and request.words:
        raise ConfigError("--words goes with --protocol: a continued session keeps the wording it began with.")
    protocol = load_protocol(named, request.words or None) if named else None
    if protocol is not None and protocol.order == "random" and fresh and not protocol.seed:
        protocol = replace(protocol, seed=1 + secrets.randbelow(2**31 - 1))
    return SessionHead(
        subject=folder.parent.name,
        session=folder.name,
        started_ms=now_ms(),
        layout=layout.to_dict(),
        protocol=protocol.to_dict() if protocol is not None else {},
        age_group=request.age_group,
        gender=request.gender,
        consent=request.consent,
        device=request.device,
        software=software,
        simulated=request.simulated or is_virtual(request.device) or request.speed != 1.0,
    )


def is_pseudo_terminal(request: SessionRequest, head: SessionHead) -> bool:
    """Return whether the port is a pseudo terminal, possibly of a virtual toy that is not marked ``simulated``."""
    return "/dev/pts/" in request.device and not head.simulated


def lacks_consent(head: SessionHead) -> bool:
    """Return whether a real session with a person has no reference to a signed consent form."""
    return not (head.consent or head.subject == NOBODY or head.simulated)
