"""Writing beside the recorder: one thread for the stream, one for all else, so that neither waits for the other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from plushsense.devices.base import Frame
from plushsense.recording.sessionfile import Event
from plushsense.recording.writer import LogFile, StreamFile

FLUSH_S = 0.5
"""The stream on disk is at most so old, by the computer's clock and by the toy's, whichever comes first."""

_LOOK_S = 0.05

Job = Callable[[], None]


class Keeper:
    """Takes rows, events and jobs in without a wait, and brings them to the disk.

    Args:
        stream, log: open; the keeper closes the stream.
        hurried: the toy runs faster than real time: every row is written at once, and `wait_written` holds the
            reader back, so that "the last second" means the toy's second.
        on_fail: called once, from a thread of the keeper, when something cannot be written; nothing is written then.
    """

    def __init__(
        self, stream: StreamFile, log: LogFile, *, hurried: bool, on_fail: Callable[[Exception], None]
    ) -> None:
        self._stream = stream
        self._log = log
        self._hurried = hurried
        self._on_fail = on_fail
        self._changed = threading.Condition()
        self._rows: list[Frame] = []
        self._since_s = self._since_ms = self._toy_ms = 0.0
        self._added = self._written = 0
        self._jobs: list[tuple[int, Event | Job]] = []
        self._closing = self._failed = False
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"plushsense-{name}", daemon=True)
            for name, work in (("stream", self._write_stream), ("log", self._work_off))
        ]
        for thread in self._threads:
            thread.start()

    def add(self, frames: Sequence[Frame], toy_ms: float) -> None:
        """Rows for the stream; ``toy_ms`` is the toy's running time at the last of them."""
        with self._changed:
            if not self._rows:
                self._since_s, self._since_ms = time.monotonic(), self._toy_ms
            self._rows.extend(frames)
            self._added += len(frames)
            self._toy_ms = toy_ms
            self._changed.notify_all()

    def do(self, job: Event | Job) -> None:
        """An event for the log, or a job, in the order in which they come; a job waits for the rows added so far."""
        with self._changed:
            self._jobs.append((0 if isinstance(job, Event) else self._added, job))
            self._changed.notify_all()

    def wait_written(self) -> None:
        """Hold a hurried reader until its rows are on disk; at real time return at once."""
        if self._hurried:
            with self._changed:
                while self._written < self._added and not (self._failed or self._closing):
                    self._changed.wait(_LOOK_S)

    def close(self) -> None:
        """Bring everything to the disk and end; jobs that come meanwhile are done, too."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._stream.close()

    def _guarded(self, work: Job) -> None:
        try:
            work()
        except Exception as cause:  # noqa: BLE001 (whatever stops the writing must stop the session, loudly)
            with self._changed:
                first, self._failed = not self._failed, True
                self._changed.notify_all()
            if first:
                self._on_fail(cause)

    def _due(self) -> bool:
        if not self._rows:
            return False
        waited = any(after > self._written for after, _ in self._jobs)
        old = time.monotonic() - self._since_s >= FLUSH_S or self._toy_ms - self._since_ms >= 1000.0 * FLUSH_S
        return old or waited or self._hurried or self._closing

    def _write_stream(self) -> None:
        while True:
            with self._changed:
                while not (self._due() or self._closing or self._failed):
                    self._changed.wait(_LOOK_S)
                if self._failed or not self._rows:
                    return
                rows, self._rows = self._rows, []
            self._stream.write(rows)
            with self._changed:
                self._written += len(rows)
                self._changed.notify_all()

    def _work_off(self) -> None:
        while True:
            events: list[Event] = []
            job: Job | None = None
            with self._changed:
                while not (self._closing or self._failed or (self._jobs and self._jobs[0][0] <= self._written)):
                    self._changed.wait(_LOOK_S)
                if self._failed or (self._closing and not self._jobs):
                    return
                if self._jobs[0][0] > self._written:
                    self._changed.wait(_LOOK_S)
                    continue
                while self._jobs and isinstance(event := self._jobs[0][1], Event):
                    events.append(event)
                    self._jobs.pop(0)
                if not events:
                    first = self._jobs.pop(0)[1]
                    assert not isinstance(first, Event)
                    job = first
            self._log.write(events)
            if job is not None:
                job()
