"""Record the signals of a validation on the live page: a session that is written at once and labelled at the end.

It is a session folder ``recordings/<subject>/live-<n>/`` with a stream file like that of the recorder. Labelling a part
copies these rows of the stream into a separate recording file; the stream itself is not changed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError
from plushsense.core.gestures import plain_label
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames, parse_name, read_stream, recording_filename
from plushsense.core.version import __version__
from plushsense.devices.base import Counters, Frame, LossCounter, now_ms
from plushsense.devices.opening import speed_of, with_speed
from plushsense.models.bundle import Bundle
from plushsense.recording.plan import Protocol, Step
from plushsense.recording.recorder import store_take
from plushsense.recording.session import OpenSession, check_subject, new_event, new_session
from plushsense.recording.takes import FrameReceiver, RecordingTake, StreamGap
from plushsense.recording.writer import BackgroundWriter, SessionEvent, SessionHead, StreamFile
from plushsense.studio.app.toys import TappedDevice
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live.reader import LiveReader

_SOFTWARE = f"plushsense {__version__}"


@dataclass
class _Running:
    """The session that is being recorded; ``longest_s`` is its maximum length by the clock of the toy."""

    session: OpenSession
    receiver: FrameReceiver
    device: TappedDevice
    longest_s: float
    writer: BackgroundWriter | None = None
    begun_s: float = field(default_factory=time.monotonic)
    failed: PlushSenseError | None = None
    ended: bool = False
    lock: Any = field(default_factory=threading.Lock)

    @property
    def key(self) -> str:
        return f"{self.session.folder.parent.name}/{self.session.folder.name}"

    @property
    def passed_s(self) -> float:
        """Length by the clock of the toy, see `FrameReceiver.passed_s`."""
        return self.receiver.passed_s(0.0, self.begun_s)


class SignalRecording:
    """Service that records the signals of the toy that the live page reads; ``failed`` is why the last one ended."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._lock = threading.RLock()
        self._running: _Running | None = None
        self.failed: PlushSenseError | None = None

    @property
    def key(self) -> str:
        """Person and session (``S01/live-1``) of the recording that is going on, or ""."""
        running = self._running
        return "" if running is None else running.key

    @property
    def recorded_s(self) -> float:
        """Length of the recording that is going on, by the clock of the toy."""
        running = self._running
        return running.passed_s if running is not None else 0.0

    def begin(self, reader: LiveReader, subject: str, longest_s: float) -> str:
        """Start a recording and return its key; samples are on disk about half a second after they arrive.

        Recording ends after ``longest_s`` by the clock of the toy. One that is still going on is ended first.

        Raises:
            ConfigError: if no toy is being read. DatasetError: for an invalid ``subject``, or if writing fails.
        """
        with self._lock:
            self.end()
            device, bundle = reader.device, reader.bundle
            if device is None or bundle is None or not reader.now.running:
                raise ConfigError("No toy is being read. Start one first.")
            self.failed = None
            running = self._open(reader, device, bundle, subject, longest_s)
            try:
                stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            except OSError as cause:
                running.session.close()
                raise _write_error(running.session.folder, cause) from None
            running.writer = BackgroundWriter(
                stream, running.session.log, synchronous=False, on_fail=lambda cause: self._fail(running, cause)
            )
            self._running = running
            device.taps.append(self._tap)
        return running.key

    def end(self, only: _Running | None = None) -> None:
        """End the recording that is going on, if any; if ``only`` is given, only if it is that one."""
        with self._lock:
            running = self._running
            if running is None or only not in (None, running):
                return
            with contextlib.suppress(ValueError):
                running.device.taps.remove(self._tap)
            running.ended = True
            assert running.writer is not None
            with running.lock:
                running.writer.submit(_close_event(running.receiver))
            try:
                running.writer.close()
                running.session.close()
            finally:
                # Not before: a validation labels the recording as soon as it has ended.
                self._running = None
            self.failed = running.failed

    def close(self) -> None:
        """End the recording because the studio ends."""
        self.end()

    def _tap(self, frames: list[Frame]) -> None:
        """Record new frames; called in the thread of the reader."""
        running = self._running
        if running is None or running.writer is None:
            return
        with running.lock:
            if running.ended:
                return
            received = [running.receiver.receive(frame) for frame in frames]
            running.receiver.end_reading()
            running.writer.add_frames([r.frame for r in received], running.receiver.toy_ms)
            for gap in (r.gap for r in received):
                if gap is not None:
                    running.writer.submit(new_event("gap", **gap.to_json()))
            running.ended = running.passed_s >= running.longest_s
        if running.ended:
            threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _fail(self, running: _Running, cause: Exception) -> None:
        running.failed = _write_error(running.session.folder, cause)
        running.ended = True
        threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _open(
        self, reader: LiveReader, device: TappedDevice, bundle: Bundle, subject: str, longest_s: float
    ) -> _Running:
        """Create the session of a new recording; the caller must hold the lock."""
        person = self._workspace.inside(self._workspace.recordings / check_subject(subject.strip()))
        choice = reader.choice
        head = SessionHead(
            subject=person.name,
            session=new_session(person, "live-"),
            started_ms=now_ms(),
            layout=device.layout.to_dict(),
            protocol=_protocol(bundle).to_dict(),
            device=device.url,
            software=_SOFTWARE,
            simulated=choice.simulated,
        )
        session = OpenSession(person / head.session, head)
        speed = speed_of(with_speed(choice.toy, self._workspace.speed))
        try:
            # Mark it as finished, so that the recorder does not resume it as the last session of the person.
            session.log.write(
                [new_event("open", software=_SOFTWARE, device=device.url, speed=speed, row=0), new_event("finished")]
            )
        except OSError as cause:
            session.close()
            raise _write_error(session.folder, cause) from None
        return _Running(session, FrameReceiver(device, device.layout, speed, 0, 0), device, longest_s)

    # Labelling ------------------------------------------------------------------------------------------------

    def read(self, key: str) -> tuple[Frames, Layout]:
        """Return the rows of a recording that has ended, and their layout."""
        with contextlib.closing(OpenSession(self._workspace.recordings / key)) as session:
            return read_stream(session.folder / STREAM_NAME, session.layout).frames, session.layout

    def label(self, key: str, parts: Sequence[tuple[str, int, int]]) -> None:
        """Save parts of a recording that has ended as recordings of gestures.

        Args:
            parts: gesture, first row and last row (exclusive) of each part.

        Raises:
            ConfigError: if a gesture cannot be part of a file name. DatasetError: if writing fails.
        """
        made: list[str] = []
        with contextlib.closing(OpenSession(self._workspace.recordings / key)) as session:
            frames = read_stream(session.folder / STREAM_NAME, session.layout).frames
            for gesture, first, last in parts:
                made.append(plain_label(gesture))
                take = _take(frames.slice(first, last), session.layout, gesture, made.count(made[-1]), first)
                try:
                    store_take(
                        session, take, Counters(), "cut", now_ms(), "", device=session.head.device, software=_SOFTWARE
                    )
                except OSError as cause:
                    raise _write_error(session.folder, cause) from None


def _take(part: Frames, layout: Layout, gesture: str, repetition: int, first: int) -> RecordingTake:
    """Return a recording of ``gesture`` from rows of a stream, of which ``first`` is the first."""
    parsed = parse_name(recording_filename(gesture, 0, 0))
    if parsed is None or plain_label(parsed.label) != plain_label(gesture):
        raise ConfigError("“{label}” cannot be the name of a gesture. Give a word or two.", label=gesture)
    host = part.host_ms if part.host_ms is not None else part.device_ms
    as_frames = [
        Frame(int(h), int(d), tuple(int(x) for x in v))
        for h, d, v in zip(host, part.device_ms, part.values, strict=True)
    ]
    take = RecordingTake(Step(0, gesture, repetition, gesture), first, 0.0, Counters(), as_frames)
    _count_losses(take, layout)
    return take


def _close_event(receiver: FrameReceiver) -> SessionEvent:
    return new_event("close", rows=receiver.rows, lost=receiver.lost, seconds=round(receiver.toy_ms / 1000.0, 2))


def _protocol(bundle: Bundle) -> Protocol:
    labels = bundle.gestures.labels
    prompts = {label: label for label in labels}
    return Protocol("live", "Live validation", bundle.gestures.name, labels, prompts, 1)


def _count_losses(take: RecordingTake, layout: Layout) -> None:
    """Count the lost frames of ``take`` and list its gaps, both derived from the device clock."""
    loss = LossCounter()
    last: Frame | None = None
    for at, frame in enumerate(take.frames):
        take.lost += loss.push(frame.device_ms)
        if last is not None:
            step_ms = frame.device_ms - last.device_ms
            if step_ms < 0 or step_ms > layout.gap_ms:
                reason = "the toy's clock restarted" if step_ms < 0 else "nothing came"
                take.gaps.append(StreamGap.of(at, last, frame, max(step_ms, frame.host_ms - last.host_ms, 0), reason))
        last = frame


def _write_error(folder: Path, cause: Exception) -> DatasetError:
    why = getattr(cause, "strerror", None) or cause
    return DatasetError(
        "{folder} cannot be written ({why}). Free some space; what was written before is kept.",
        folder=folder.name,
        why=why,
    )
