"""Record clips on the live page: sessions that are written to disk at once and labelled later.

A clip is a session folder ``recordings/<subject>/live-<n>/`` with a stream file like that of the recorder. Labelling a
part of the clip copies these rows of the stream into a separate recording file; the stream itself is not changed.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, ConfigError, DatasetError, PlushSenseError
from plushsense.core.gestures import plain_label
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames, parse_name, read_stream, recording_filename
from plushsense.core.version import __version__
from plushsense.dataset.importing.build import ImportSummary
from plushsense.dataset.importing.importers import import_recordings
from plushsense.devices.base import Counters, Frame, LossCounter, now_ms
from plushsense.devices.opening import speed_of, with_speed
from plushsense.models.bundle import Bundle
from plushsense.recording.plan import Protocol, Step
from plushsense.recording.recorder import store_take
from plushsense.recording.session import OpenSession, check_subject, new_event, new_session
from plushsense.recording.session_files import SIDECAR, SessionEvent, SessionHead, read_events
from plushsense.recording.takes import FrameReceiver, RecordingTake, gap_entry
from plushsense.recording.writer import BackgroundWriter, StreamFile
from plushsense.studio.app.toys import TappedDevice
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.studio.pages.live.reader import LiveReader

PROTOCOL = "live"
"""Name of the protocol in the sessions of clips. It marks clips, in which nobody was prompted to perform a gesture."""


@dataclass(frozen=True)
class Label:
    """A labelled part of a clip, saved as a recording: stream rows ``first`` (inclusive) to ``last`` (exclusive)."""

    file: str
    gesture: str
    first: int
    last: int


@dataclass(frozen=True)
class Clip:
    """A clip on disk.

    Attributes:
        rows: number of rows of the stream.
        seconds: length by the clock of the toy, or estimated from the frame rate if a crash ended the clip.
        added: names of the data sets to which all its recordings were added.
    """

    folder: Path
    head: SessionHead
    rows: int
    seconds: float
    labels: tuple[Label, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Identifier of the clip, in the form ``subject/session``."""
        return _key(self.folder)

    @property
    def layout(self) -> Layout:
        """The sensor layout of the rows."""
        return _layout(self.head, self.folder)


def read_clip(folder: Path) -> Clip | None:
    """Read the clip in a folder; return None if the folder has no session, or one that is not a clip.

    Raises:
        DatasetError: if the head of the session cannot be read.
    """
    head = SessionHead.read(folder)
    if head is None or head.protocol.get("name") != PROTOCOL:
        return None
    labels: dict[str, Label] = {}
    added: list[str] = []
    seconds: float | None = None
    for event in read_events(folder):
        details = event.details
        if event.kind == "close" and isinstance(details.get("seconds"), int | float):
            seconds = float(details["seconds"])
        if event.kind == "take":
            file, count = str(details.get("file")), details.get("rows")
            first = _first_row(folder / file)
            last = first + (count if isinstance(count, int) else 0)
            labels[file] = Label(file, str(details.get("gesture")), first, last)
            added = []
        elif event.kind == "added" and details.get("dataset") not in added:
            added.append(str(details.get("dataset")))
    stream = folder / STREAM_NAME
    rows = stream.read_bytes().count(b"\n") if stream.is_file() else 0
    if seconds is None:
        seconds = rows / _layout(head, folder).rate_hz
    return Clip(folder, head, rows, seconds, tuple(labels.values()), tuple(added))


def _first_row(recording: Path) -> int:
    """Return the row of the stream at which a recording begins, from its sidecar file, or 0 if unknown."""
    try:
        return int(json.loads(recording.with_suffix(SIDECAR).read_text(encoding="utf-8"))["stream_row"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


LONGEST_S = 600.0
"""Maximum length of a clip by the clock of the toy; recording then ends automatically."""
_SOFTWARE = f"plushsense {__version__}"


@dataclass
class _Running:
    """The clip that is being recorded."""

    session: OpenSession
    receiver: FrameReceiver
    device: TappedDevice
    writer: BackgroundWriter | None = None
    longest_s: float = LONGEST_S
    begun_s: float = field(default_factory=time.monotonic)
    failed: PlushSenseError | None = None
    ended: bool = False
    lock: Any = field(default_factory=threading.Lock)

    @property
    def key(self) -> str:
        return _key(self.session.folder)

    @property
    def passed_s(self) -> float:
        """Length by the clock of the toy, see `FrameReceiver.passed_s`."""
        return self.receiver.passed_s(0.0, self.begun_s)


class Clips:
    """Service that records and labels clips; it notifies `changed` when a clip is added or changed."""

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace = workspace
        self._lock = threading.RLock()
        self._running: _Running | None = None
        self.failed: PlushSenseError | None = None

    # Recording ------------------------------------------------------------------------------------------------

    @property
    def recording(self) -> str:
        """Key of the clip that is being recorded, or ""."""
        running = self._running
        return "" if running is None else running.key

    @property
    def recorded_s(self) -> float:
        """Length of the clip that is being recorded, by the clock of the toy."""
        running = self._running
        return running.passed_s if running is not None else 0.0

    def keep(self, reader: LiveReader, seconds: float, subject: str) -> str:
        """Write the last ``seconds`` of the signals as a clip, and return its key.

        Raises:
            ConfigError: if nothing was received. DatasetError: for an invalid ``subject``, or if writing fails.
        """
        device, bundle = reader.device, reader.bundle
        frames = device.buffer.frames(seconds) if device is not None else []
        if device is None or bundle is None or not frames:
            raise ConfigError("No data were received yet: start a toy first.", reason="nothing_received")
        with self._lock:
            running = self._open(reader, device, bundle, subject)
        try:
            stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            with contextlib.closing(stream):
                stream.write([running.receiver.receive(frame).frame for frame in frames])
                running.session.log.write([_close_event(running.receiver)])
        except OSError as cause:
            raise _write_error(running.session.folder, cause) from None
        finally:
            running.session.close()
        self.changed.notify()
        return running.key

    def begin(self, reader: LiveReader, subject: str, longest_s: float | None = None) -> str:
        """Start to record a clip and return its key; samples are on disk about half a second after they arrive.

        Recording ends after ``longest_s`` (by default `LONGEST_S`) by the clock of the toy.

        Raises:
            ConfigError: if no toy is being read, or a clip is already being recorded. DatasetError: as for `keep`.
        """
        with self._lock:
            device, bundle = reader.device, reader.bundle
            if self._running is not None:
                message = f"The clip '{self.recording}' is being recorded already: end it first."
                raise ConfigError(message, reason="clip_running", clip=self.recording)
            if device is None or bundle is None or not reader.now.running:
                raise ConfigError("No toy is being read: start one first.", reason="no_toy_read")
            self.failed = None
            running = self._open(reader, device, bundle, subject)
            running.longest_s = LONGEST_S if longest_s is None else longest_s
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
        self.changed.notify()
        return running.key

    def end(self, only: _Running | None = None) -> str:
        """End the current clip (if ``only`` is given, only if it is that clip); return its key, or "" if none ended."""
        with self._lock:
            running = self._running
            if running is None or only not in (None, running):
                return ""
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
                # Not before: a validation labels the clip as soon as it is no longer being recorded.
                self._running = None
            self.failed = running.failed
        self.changed.notify()
        return running.key

    def close(self) -> None:
        """End the current clip because the studio ends."""
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
                    running.writer.submit(new_event("gap", **gap))
            running.ended = running.passed_s >= running.longest_s
        if running.ended:
            threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _fail(self, running: _Running, cause: Exception) -> None:
        running.failed = _write_error(running.session.folder, cause)
        running.ended = True
        threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _open(self, reader: LiveReader, device: TappedDevice, bundle: Bundle, subject: str) -> _Running:
        """Create the session of a new clip; the caller must hold the lock."""
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
        return _Running(session, FrameReceiver(device, device.layout, speed, 0, 0), device)

    # Listing --------------------------------------------------------------------------------------------------

    def all(self) -> list[Clip]:
        """Return all clips on disk, newest first; this reads files, so do not call it in the event loop."""
        clips = []
        for folder in self._workspace.sessions():
            if folder.name.startswith("live-"):
                # A damaged clip must not hide the others; `plushsense import` reports it.
                with contextlib.suppress(BadInput, OSError):
                    if (clip := read_clip(folder)) is not None:
                        clips.append(clip)
        return sorted(clips, key=lambda clip: -clip.head.started_ms)

    def get(self, key: str) -> Clip:
        """Return the clip with this key; raise ConfigError for an unknown key."""
        clip = read_clip(self._workspace.inside(self._workspace.recordings / key))
        if clip is None:
            message = f"There is no clip '{key}': it may have been moved."
            raise ConfigError(message, reason="clip_gone", clip=key)
        return clip

    def rows(self, clip: Clip) -> Frames:
        """Return the rows of a clip's stream."""
        return read_stream(clip.folder / STREAM_NAME, clip.layout).frames

    # Labelling ------------------------------------------------------------------------------------------------

    def label(self, key: str, gesture: str, first: int, last: int) -> Label:
        """Save the rows ``first`` (inclusive) to ``last`` (exclusive) of a clip as a recording of ``gesture``.

        Raises:
            ConfigError: for an invalid label or range of rows. DatasetError: if writing fails.
        """
        return self.label_parts(key, [(gesture, first, last)])[0]

    def label_parts(self, key: str, parts: Sequence[tuple[str, int, int]]) -> list[Label]:
        """Save several parts of a clip (gesture, first row, last row exclusive) as recordings, see `label`."""
        clip = self.get(key)
        if key == self.recording:
            message = f"The clip '{key}' is still being recorded: end it first."
            raise ConfigError(message, reason="clip_running", clip=key)
        frames = self.rows(clip)
        labels = list(clip.labels)
        with contextlib.closing(OpenSession(clip.folder)) as session:
            for gesture, first, last in parts:
                take = _take(clip, frames, gesture, first, last, labels)
                try:
                    file, _ = store_take(
                        session, take, Counters(), "cut", now_ms(), "", device=clip.head.device, software=_SOFTWARE
                    )
                except OSError as cause:
                    raise _write_error(clip.folder, cause) from None
                labels.append(Label(file, take.step.gesture, first, last))
        self.changed.notify()
        return labels[len(clip.labels) :]

    def add(self, key: str, dataset: Path) -> ImportSummary:
        """Import the recordings of a clip into a data set, as ``plushsense import --add`` does.

        Raises:
            ConfigError: if the clip has no label. DatasetError: as for `import_recordings`.
        """
        clip = self.get(key)
        if not clip.labels:
            message = f"The clip '{key}' has no label yet: choose a part of it and its gesture."
            raise ConfigError(message, reason="clip_unlabelled")
        summary = import_recordings(clip.folder, self._workspace.inside(dataset), add_to=True)
        with contextlib.closing(OpenSession(clip.folder)) as session, contextlib.suppress(OSError):
            session.log.write([new_event("added", dataset=dataset.name, recordings=summary.added["recordings"])])
        self.changed.notify()
        return summary


def _take(clip: Clip, frames: Frames, gesture: str, first: int, last: int, labels: Sequence[Label]) -> RecordingTake:
    """Cut a recording from the rows of a clip; ``labels`` are those that it has already."""
    gesture = " ".join(gesture.split())
    parsed = parse_name(recording_filename(gesture, 0, 0))
    if not gesture or parsed is None or plain_label(parsed.label) != plain_label(gesture):
        raise ConfigError(
            f"'{gesture}' cannot be the label of a gesture: give a word or two without  \\ / : * ? \" < > | ( )  .",
            reason="label_bad",
            label=gesture,
        )
    if not 0 <= first < last <= len(frames) or last - first < 2:
        raise ConfigError(
            f"Rows {first} to {last} are not a part of the clip '{clip.key}', which has {len(frames)} rows: choose an "
            "end after the start.",
            reason="clip_part_bad",
        )
    part = frames.slice(first, last)
    host = part.host_ms if part.host_ms is not None else part.device_ms
    as_frames = [
        Frame(int(h), int(d), tuple(int(x) for x in v))
        for h, d, v in zip(host, part.device_ms, part.values, strict=True)
    ]
    times = 1 + sum(plain_label(label.gesture) == plain_label(gesture) for label in labels)
    take = RecordingTake(Step(0, gesture, times, gesture), first, 0.0, Counters(), as_frames)
    _count_losses(take, clip.layout)
    return take


def _key(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _layout(head: SessionHead, folder: Path) -> Layout:
    return Layout.from_dict(head.layout, f"layout of '{folder}'")


def _close_event(receiver: FrameReceiver) -> SessionEvent:
    return new_event("close", rows=receiver.rows, lost=receiver.lost, seconds=round(receiver.toy_ms / 1000.0, 2))


def _protocol(bundle: Bundle) -> Protocol:
    labels = bundle.gestures.labels
    return Protocol(
        name=PROTOCOL,
        title="Kept from the live page",
        gesture_set=bundle.gestures.name,
        gestures=labels,
        prompts={label: label for label in labels},
        repetitions=1,
    )


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
                take.gaps.append(gap_entry(at, last, frame, max(step_ms, frame.host_ms - last.host_ms, 0), reason))
        last = frame


def _write_error(folder: Path, cause: Exception) -> DatasetError:
    why = getattr(cause, "strerror", None) or cause
    message = f"'{folder}' cannot be written ({why}): free some space; what was written before is kept."
    return DatasetError(message, reason="clip_unwritable", folder=folder.name, why=why)
