"""Files of a session's folder, which survive a crash, and their writer in the background.

session.json                     person, protocol and toy: `SessionHead`, replaced atomically
session.jsonl                    one `SessionEvent` per line, append-only
fulldatastream.csv               all frames of the toy, in the format of the authors' recorder
<label>_<epoch ms>_<rows>.csv    one recording each; beside it a sidecar of the same name that ends in .json

The folder of a person contains one folder for each session: ``OUT/<subject>/<session>/``. One thread writes the stream,
another one everything else.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.layouts import DELAY_MS, Layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.core.toml import load_table, loads_json
from plushsense.devices.base import Frame

SESSION_HEAD = "session.json"
SESSION_LOG = "session.jsonl"
SIDECAR = ".json"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class SessionHead:
    """Description of a session. ``subject`` is a code, never a name; ``protocol`` and ``layout`` are complete.

    ``consent`` is a reference to the signed form, not the form. ``simulated`` is whether the toy was a virtual one.
    """

    subject: str
    session: str
    started_ms: int
    layout: dict[str, Any]
    protocol: dict[str, Any]
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    device: str = ""
    software: str = ""
    simulated: bool = False

    def write(self, folder: Path) -> None:
        """Write the head to ``folder``, completely or not at all."""
        text = json.dumps({"format": FORMAT_VERSION} | asdict(self), ensure_ascii=False, indent=1) + "\n"
        write_file(folder / SESSION_HEAD, text)

    @classmethod
    def read(cls, folder: Path) -> SessionHead | None:
        """Read the head of the session in ``folder``; None if there is none, DatasetError if it is damaged."""
        path = folder / SESSION_HEAD
        try:
            table = loads_json(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, RecursionError) as cause:
            raise DatasetError(
                "'{path}' cannot be read ({cause}): restore it from a copy.", path=path, cause=cause, name=folder.name
            ) from None
        if not isinstance(table, dict) or table.pop("format", None) != FORMAT_VERSION:
            raise DatasetError(
                "'{path}' is no session head of format {format_version}: update PlushSense, or restore the file.",
                path=path,
                format_version=FORMAT_VERSION,
                name=folder.name,
            )
        return load_table(table, cls, f"'{path}'", DatasetError)


@dataclass(frozen=True)
class SessionEvent:
    """Event of a session: its ``kind``, the computer's time ``at_ms``, and details.

    Kinds, with their details: ``open`` and ``close`` (a program opened or closed the session), ``countdown``
    (``gesture``, ``repetition``, ``countdown_s``), ``start`` (of a recording, with its first row), ``take`` (finished
    recording: ``file``, ``gesture``, ``repetition``), ``abandon`` (recording stopped on purpose, ``why``: redo, pause,
    exchange or quit; its rows are in the stream only), ``unfinished`` (stopped by a crash), ``redo`` (``file`` is
    discarded), ``keep`` (``file`` is used again), ``skip``, ``go`` (to another step), ``note``, ``pause``, ``resume``,
    ``exchange`` (another toy from ``row`` on: ``device``, ``former``), ``mark`` (a moment to find in a video:
    ``host_ms``, ``device_ms``), ``gap``, ``mended`` (repaired after a crash), ``failed``, ``finished`` (``early``:
    although steps are missing), ``reopened``, ``renamed`` (the person's code was changed; with the former ``subject``
    and ``session``). Readers ignore other kinds.
    """

    kind: str
    at_ms: int
    details: dict[str, Any] = field(default_factory=dict)

    def to_line(self) -> str:
        """Return the event as a line of the log."""
        return json.dumps({"what": self.kind, "at_ms": self.at_ms} | self.details, ensure_ascii=False) + "\n"


def read_events(folder: Path) -> Iterator[SessionEvent]:
    """Yield the events of the log in ``folder``, in order; skip lines that are incomplete because of a crash."""
    try:
        lines = (folder / SESSION_LOG).read_bytes().split(b"\n")
    except FileNotFoundError:
        return
    except OSError as cause:
        raise DatasetError(
            "'{path}' cannot be read: {why}.", path=folder / SESSION_LOG, why=cause.strerror or cause, name=folder.name
        ) from None
    for line in filter(None, lines):
        try:
            table = loads_json(line.decode("utf-8"))
            yield SessionEvent(str(table.pop("what")), int(table.pop("at_ms")), table)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            continue


def discarded_recordings(folder: Path) -> dict[str, str]:
    """Return the reason for each discarded recording of a session, by file name."""
    discarded: dict[str, str] = {}
    for event in read_events(folder):
        file = str(event.details.get("file") or "")
        if event.kind == "redo" and file:
            discarded[file] = str(event.details.get("why") or "recorded again")
        elif event.kind == "keep":
            discarded.pop(file, None)
    return discarded


def to_frames(frames: Sequence[Frame], channels: int) -> Frames:
    """Convert a sequence of T frames to arrays, with ``values`` (T, channels)."""
    values = np.array([f.values for f in frames], dtype=np.int64).reshape(len(frames), channels)
    return Frames(
        values,
        np.array([f.device_ms for f in frames], dtype=np.int64),
        np.array([f.host_ms for f in frames], dtype=np.int64),
    )


def lacks_descriptor(cause: Exception) -> bool:
    """Return whether the error is a lack of file descriptors, which is temporary, unlike a full disk."""
    return isinstance(cause, OSError) and cause.errno in (errno.EMFILE, errno.ENFILE)


class AppendedFile:
    """A file to which whole lines are appended."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("ab", buffering=0)
        self._size = self._file.seek(0, os.SEEK_END)

    def append(self, data: bytes) -> None:
        """Append lines and flush them to disk; on OSError the file is left as it was before."""
        try:
            left = memoryview(data)
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError:
            # Remove a partial line; truncating works even on a full disk.
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), self._size)
            raise
        self._size += len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class StreamFile(AppendedFile):
    """``fulldatastream.csv``: all frames of the toy in the columns of the authors' recorder, without a header."""

    def __init__(self, path: Path, layout: Layout) -> None:
        super().__init__(path)
        self.layout = layout
        # The delay of a row is the time since the row before, so keep the last frame.
        self._overlap = DELAY_MS in layout.csv.columns
        self._last: Frame | None = None

    def write(self, frames: Sequence[Frame]) -> None:
        """Append frames."""
        if not frames:
            return
        before = [self._last] if self._overlap and self._last is not None else []
        text = format_rows(to_frames([*before, *frames], self.layout.n_channels), self.layout)
        self.append((text.split("\n", 1)[1] if before else text).encode())
        self._last = frames[-1]


class LogFile(AppendedFile):
    """``session.jsonl``: one event a line."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / SESSION_LOG)

    def write(self, events: Iterable[SessionEvent]) -> None:
        """Append events."""
        if data := "".join(e.to_line() for e in events).encode():
            self.append(data)


def save_take(
    folder: Path, frames: Frames, layout: Layout, gesture: str, saved_ms: int, sidecar: dict[str, Any]
) -> Path:
    """Write one recording and its sidecar, each atomically and never over an existing recording.

    The sidecar is written first, so that a crash leaves no recording without its sidecar; a sidecar without a recording
    is removed when the session is opened again.

    Returns:
        Path of the CSV, named by gesture, time of saving and rows as in the authors' recorder.
    """
    path = folder / recording_filename(gesture, saved_ms, len(frames))
    while path.exists():
        saved_ms += 1
        path = folder / recording_filename(gesture, saved_ms, len(frames))
    sidecar_path = path.with_suffix(SIDECAR)
    try:
        write_file(sidecar_path, json.dumps({"file": path.name} | sidecar, ensure_ascii=False, indent=1) + "\n")
        write_recording(path, frames, layout)
    except BaseException:
        if not path.exists():
            with contextlib.suppress(OSError):
                sidecar_path.unlink(missing_ok=True)
        raise
    return path


FLUSH_S = 0.5
"""Longest delay before rows are written, by the clock of the computer or of the toy, whichever is first."""

CLOSING_S = 10.0
"""How long a closing writer keeps trying while no file descriptor is free."""

_POLL_S = 0.05
_RETRY_S = 0.2

Job = Callable[[], None]


class BackgroundWriter:
    """Queues rows, events and jobs without blocking, and writes them to disk in two threads.

    Args:
        stream, log: open files; the writer closes the stream.
        synchronous: let `wait_written` block until rows that are due are on disk; for a simulated toy that runs faster
            than real time, of which a crash could otherwise lose more than the last second.
        on_fail: called once, in a thread of the writer, when something cannot be written; nothing more is written.
        on_wait: called in a thread of the writer when a write or a job is repeated because no file
            descriptor was free.
    """

    def __init__(
        self,
        stream: StreamFile,
        log: LogFile,
        *,
        synchronous: bool,
        on_fail: Callable[[Exception], None],
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        self._stream = stream
        self._log = log
        self._synchronous = synchronous
        self._on_fail = on_fail
        self._on_wait = on_wait
        self._changed = threading.Condition()
        self._rows: list[Frame] = []
        self._since_s = self._since_ms = self._toy_ms = 0.0
        self._added = self._written = 0
        self._jobs: list[tuple[int, SessionEvent | Job]] = []
        self._closing = self._failed = False
        self._closing_s = 0.0
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"plushsense-{name}", daemon=True)
            for name, work in (("stream", self._write_stream), ("log", self._write_events))
        ]
        for thread in self._threads:
            thread.start()

    def add_frames(self, frames: Sequence[Frame], toy_ms: float) -> None:
        """Queue rows for the stream; ``toy_ms`` is the toy's running time at the last of them."""
        with self._changed:
            if not self._rows:
                self._since_s, self._since_ms = time.monotonic(), self._toy_ms
            self._rows.extend(frames)
            self._added += len(frames)
            self._toy_ms = toy_ms
            if self._due():
                self._changed.notify_all()

    def submit(self, job: SessionEvent | Job) -> None:
        """Queue an event for the log, or a job that runs after the rows added so far are written; the order is kept.

        A job that fails for lack of a file descriptor is repeated, so it must undo what it did before it fails.
        """
        with self._changed:
            self._jobs.append((0 if isinstance(job, SessionEvent) else self._added, job))
            self._changed.notify_all()

    def wait_written(self) -> None:
        """Wait until all rows are on disk if ``synchronous`` and they are due; else return at once."""
        if self._synchronous:
            with self._changed:
                # Rows that are not due may wait for more, because each flush costs more than formatting many rows.
                until = self._added if self._due() else 0
                while self._written < until and not (self._failed or self._closing):
                    self._changed.wait(_POLL_S)

    def close(self) -> None:
        """Write everything and stop; jobs that are queued in the meantime are still run."""
        with self._changed:
            if not self._closing:
                self._closing, self._closing_s = True, time.monotonic()
            self._changed.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._stream.close()

    def _guarded(self, work: Job) -> None:
        try:
            work()
        except Exception as cause:  # noqa: BLE001, RUF100
            with self._changed:
                first, self._failed = not self._failed, True
                self._changed.notify_all()
            if first:
                self._on_fail(cause)

    def _persist(self, work: Job) -> None:
        """Repeat ``work`` while no file descriptor is free; a closing writer gives up after `CLOSING_S`."""
        waiting = False
        while True:
            try:
                work()
                return
            except OSError as cause:
                if not lacks_descriptor(cause):
                    raise
                with self._changed:
                    late = self._closing and time.monotonic() - self._closing_s > CLOSING_S
                    if self._failed or late:
                        raise
            if not waiting:
                waiting = True
                self._on_wait()
            time.sleep(_RETRY_S)

    def _due(self) -> bool:
        if not self._rows:
            return False
        job_waits = any(after > self._written for after, _ in self._jobs)
        is_late = time.monotonic() - self._since_s >= FLUSH_S or self._toy_ms - self._since_ms >= 1000.0 * FLUSH_S
        return is_late or job_waits or self._closing

    def _write_stream(self) -> None:
        while True:
            with self._changed:
                while not (self._due() or self._closing or self._failed):
                    self._changed.wait(_POLL_S)
                if self._failed or not self._rows:
                    return
                rows, self._rows = self._rows, []
            self._persist(functools.partial(self._stream.write, rows))
            with self._changed:
                self._written += len(rows)
                self._changed.notify_all()

    def _write_events(self) -> None:
        while True:
            events: list[SessionEvent] = []
            job: Job | None = None
            with self._changed:
                while not (self._closing or self._failed or (self._jobs and self._jobs[0][0] <= self._written)):
                    self._changed.wait(_POLL_S)
                if self._failed or (self._closing and not self._jobs):
                    return
                if self._jobs[0][0] > self._written:
                    self._changed.wait(_POLL_S)
                    continue
                while self._jobs and isinstance(event := self._jobs[0][1], SessionEvent):
                    events.append(event)
                    self._jobs.pop(0)
                if not events:
                    first = self._jobs.pop(0)[1]
                    assert not isinstance(first, SessionEvent)
                    job = first
            self._persist(functools.partial(self._log.write, events))
            if job is not None:
                self._persist(job)
