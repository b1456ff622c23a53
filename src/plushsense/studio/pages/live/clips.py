"""Clips kept from the live page: sessions that are written at once and labelled later.

A clip lies in ``recordings/<subject>/live-<n>/`` with its stream, as the recorder leaves a session; a label cuts rows
of the stream into a recording beside it. The stream itself never changes.
"""

from __future__ import annotations

import contextlib
import json
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.gestures import plain_label
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames, parse_name, read_stream, recording_filename
from plushsense.core.version import __version__
from plushsense.dataset.importing.build import ImportSummary
from plushsense.dataset.importing.importers import import_recordings
from plushsense.devices.base import Counters, Frame, LossCounter, now_ms
from plushsense.models.bundle import Bundle
from plushsense.recording.plan import Protocol, Step
from plushsense.recording.session import OpenSession, check_subject
from plushsense.recording.session_files import SIDECAR, SessionEvent, SessionHead, read_events
from plushsense.recording.setup import speed_of, with_speed
from plushsense.recording.states import store_take
from plushsense.recording.takes import FrameReceiver, RecordingTake, gap_entry
from plushsense.recording.writer import BackgroundWriter, StreamFile
from plushsense.studio.app.toys import TappedDevice
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.studio.pages.live.reader import LiveReader

PROTOCOL = "live"
"""What the sessions of clips name as their protocol: nobody was asked for anything."""


@dataclass(frozen=True)
class Label:
    """A recording cut from a clip: rows ``first`` to before ``last`` of its stream."""

    file: str
    gesture: str
    first: int
    last: int


@dataclass(frozen=True)
class Clip:
    """A clip as stored on disk.

    Attributes:
        seconds: length by the toy's clock, or from the rate if a crash ended it.
        added: names of the data sets that hold all its recordings.
    """

    folder: Path
    head: SessionHead
    rows: int
    seconds: float
    labels: tuple[Label, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """A name for pages: subject/session."""
        return f"{self.folder.parent.name}/{self.folder.name}"

    @property
    def layout(self) -> Layout:
        """The layout of the clip's rows."""
        return Layout.from_dict(self.head.layout, f"layout of '{self.folder}'")


def read_clip(folder: Path) -> Clip | None:
    """Return the clip in a session's folder; None if it holds another session, or none.

    Raises:
        DatasetError: for a head that cannot be read.
    """
    head = SessionHead.read(folder)
    if head is None or head.protocol.get("name") != PROTOCOL:
        return None
    labels: dict[str, Label] = {}
    added: list[str] = []
    seconds: float | None = None
    for event in read_events(folder):
        more = event.details
        if event.what == "close" and isinstance(more.get("seconds"), int | float):
            seconds = float(more["seconds"])
        if event.what == "take":
            file, first = str(more.get("file")), _first_row(folder / str(more.get("file")))
            held = more.get("rows")
            last = first + (held if isinstance(held, int) else 0)
            labels[file] = Label(file, str(more.get("gesture")), first, last)
            added = []
        elif event.what == "added" and more.get("dataset") not in added:
            added.append(str(more.get("dataset")))
    stream = folder / STREAM_NAME
    rows = stream.read_bytes().count(b"\n") if stream.is_file() else 0
    if seconds is None:
        seconds = rows / Layout.from_dict(head.layout, f"layout of '{folder}'").rate_hz
    return Clip(folder, head, rows, seconds, tuple(labels.values()), tuple(added))


def _first_row(recording: Path) -> int:
    """Return the row of the session's stream at which a recording begins, as its sidecar says."""
    try:
        return int(json.loads(recording.with_suffix(SIDECAR).read_text(encoding="utf-8"))["stream_row"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


LONGEST_S = 600.0
"""A clip that nobody ends does so by itself, by the toy's clock."""
_SOFTWARE = f"plushsense {__version__}"


@dataclass
class _Running:
    """The clip that is being recorded."""

    session: OpenSession
    intake: FrameReceiver
    device: TappedDevice
    keeper: BackgroundWriter | None = None
    failed: str = ""
    over: bool = False
    lock: Any = field(default_factory=threading.Lock)


class Clips:
    """Service that records clips. `changed` is notified when a clip is added or changed."""

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace = workspace
        self._lock = threading.RLock()
        self._running: _Running | None = None
        self.failed = ""

    # Keeping --------------------------------------------------------------------------------------------------

    @property
    def recording(self) -> str:
        """Key of the clip that is being recorded, or ""."""
        running = self._running
        return "" if running is None else _key(running.session.folder)

    @property
    def recorded_s(self) -> float:
        """Length of the clip that is being recorded, by the toy's clock."""
        running = self._running
        return running.intake.toy_ms / 1000.0 if running is not None else 0.0

    def keep(self, reader: LiveReader, seconds: float, subject: str) -> str:
        """Write the last ``seconds`` as a clip; return its key.

        Raises:
            ConfigError: when nothing was heard. DatasetError: for a code that is none, or a disk that refuses.
        """
        device, bundle = reader.device, reader.bundle
        frames = device.buffer.frames(seconds) if device is not None else []
        if device is None or bundle is None or not frames:
            raise ConfigError("Nothing was heard yet that could be kept: start a toy first.")
        with self._lock:
            running = self._open(reader, device, bundle, subject)
        try:
            stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            with contextlib.closing(stream):
                stream.write([running.intake.receive(frame).frame for frame in frames])
                running.session.log.write([_closing(running.intake)])
        except OSError as cause:
            raise _refused(running.session.folder, cause) from None
        finally:
            running.session.close()
        self.changed.notify()
        return _key(running.session.folder)

    def begin(self, reader: LiveReader, subject: str) -> str:
        """Start to record a clip; return its key.

        Samples are on the disk half a second after they arrive.

        Raises:
            ConfigError: when nothing is read, or a clip is being recorded already. DatasetError: as for `keep`.
        """
        with self._lock:
            device, bundle = reader.device, reader.bundle
            if self._running is not None:
                raise ConfigError(f"The clip '{self.recording}' is being recorded already: end it first.")
            if device is None or bundle is None or not reader.now.running:
                raise ConfigError("No toy is being read: start one first.")
            self.failed = ""
            running = self._open(reader, device, bundle, subject)
            try:
                stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            except OSError as cause:
                running.session.close()
                raise _refused(running.session.folder, cause) from None
            running.keeper = BackgroundWriter(
                stream, running.session.log, synchronous=False, on_fail=lambda cause: self._fail(running, cause)
            )
            self._running = running
            device.taps.append(self._tap)
        self.changed.notify()
        return _key(running.session.folder)

    def end(self, only: _Running | None = None) -> str:
        """End the clip that is being recorded, or only if it is ``only``; return its key, or ""."""
        with self._lock:
            running = self._running
            if running is None or only not in (None, running):
                return ""
            self._running = None
            with contextlib.suppress(ValueError):
                running.device.taps.remove(self._tap)
            running.over = True
            assert running.keeper is not None
            with running.lock:
                running.keeper.submit(_closing(running.intake))
            running.keeper.close()
            running.session.close()
            self.failed = running.failed
        self.changed.notify()
        return _key(running.session.folder)

    def close(self) -> None:
        """End the clip when the studio ends."""
        self.end()

    def _tap(self, frames: list[Frame]) -> None:
        """Record new frames; called in the reader's thread."""
        running = self._running
        if running is None or running.keeper is None:
            return
        with running.lock:
            if running.over:
                return
            came = [running.intake.receive(frame) for frame in frames]
            running.keeper.add_frames([c.frame for c in came], running.intake.toy_ms)
            for gap in (c.gap for c in came):
                if gap is not None:
                    running.keeper.submit(_event("gap", **gap))
            running.over = running.intake.toy_ms >= 1000.0 * LONGEST_S
        if running.over:
            threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _fail(self, running: _Running, cause: Exception) -> None:
        running.failed = str(_refused(running.session.folder, cause))
        running.over = True
        threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _open(self, reader: LiveReader, device: TappedDevice, bundle: Bundle, subject: str) -> _Running:
        """Create the session of a new clip; the caller holds the lock."""
        person = self._workspace.inside(self._workspace.recordings / check_subject(subject.strip()))
        taken = {p.name for p in person.iterdir()} if person.is_dir() else set()
        number = 1
        while f"live-{number}" in taken:
            number += 1
        choice = reader.choice
        head = SessionHead(
            subject=person.name,
            session=f"live-{number}",
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
            # At once finished: a recorder that takes up the person's last session must not take this one.
            session.log.write(
                [_event("open", software=_SOFTWARE, device=device.url, speed=speed, row=0), _event("finished")]
            )
        except OSError as cause:
            session.close()
            raise _refused(session.folder, cause) from None
        return _Running(session, FrameReceiver(device, device.layout, speed, 0, 0), device)

    # What there is --------------------------------------------------------------------------------------------

    def all(self) -> list[Clip]:
        """Return every clip on disk, the newest first. Reads files: not for the event loop."""
        found = []
        for folder in self._workspace.sessions():
            if folder.name.startswith("live-"):
                # A damaged one must not hide the others; `plushsense import` names it.
                with contextlib.suppress(BadInput, OSError):
                    clip = read_clip(folder)
                    if clip is not None:
                        found.append(clip)
        return sorted(found, key=lambda clip: -clip.head.started_ms)

    def get(self, key: str) -> Clip:
        """Return the clip with this key.

        Raises:
            ConfigError: where there is none.
        """
        folder = self._workspace.inside(self._workspace.recordings / key)
        clip = read_clip(folder)
        if clip is None:
            raise ConfigError(f"There is no clip '{key}': it may have been moved.")
        return clip

    def rows(self, clip: Clip) -> Frames:
        """Return the rows of a clip's stream."""
        return read_stream(clip.folder / STREAM_NAME, clip.layout).frames

    # Labelling ------------------------------------------------------------------------------------------------

    def label(self, key: str, gesture: str, first: int, last: int) -> Label:
        """Make rows ``first`` up to but not ``last`` of a clip a recording of ``gesture``, beside its stream.

        Raises:
            ConfigError: for rows or a label that cannot be. DatasetError: when the disk refuses.
        """
        clip = self.get(key)
        if key == self.recording:
            raise ConfigError(f"The clip '{key}' is still being recorded: end it first.")
        gesture = " ".join(gesture.split())
        named = parse_name(recording_filename(gesture, 0, 0))
        if not gesture or named is None or plain_label(named.label) != plain_label(gesture):
            raise ConfigError(
                f"'{gesture}' cannot be a gesture's label: give a word or two without  \\ / : * ? \" < > | ( )  ."
            )
        frames = self.rows(clip)
        if not 0 <= first < last <= len(frames) or last - first < 2:
            raise ConfigError(
                f"Rows {first} to {last} are no part of the clip '{key}', which has {len(frames)}: choose an end "
                "after the start."
            )
        part = frames.slice(first, last)
        host = part.host_ms if part.host_ms is not None else part.device_ms
        as_frames = [
            Frame(int(h), int(d), tuple(int(x) for x in v))
            for h, d, v in zip(host, part.device_ms, part.values, strict=True)
        ]
        times = 1 + sum(plain_label(label.gesture) == plain_label(gesture) for label in clip.labels)
        take = RecordingTake(Step(0, gesture, times, gesture), first, 0.0, Counters(), as_frames)
        _count_losses(take, clip.layout)
        with contextlib.closing(OpenSession(clip.folder)) as session:
            try:
                file, _ = store_take(
                    session, take, Counters(), "cut", now_ms(), "", device=clip.head.device, software=_SOFTWARE
                )
            except OSError as cause:
                raise _refused(clip.folder, cause) from None
        self.changed.notify()
        return Label(file, gesture, first, last)

    def add(self, key: str, dataset: Path) -> ImportSummary:
        """Import the recordings of a clip into a data set, as ``plushsense import --add`` does.

        Raises:
            ConfigError: without a label. DatasetError: as for `import_recordings`.
        """
        clip = self.get(key)
        if not clip.labels:
            raise ConfigError(f"The clip '{key}' has no label yet: choose a part of it and say what it is.")
        done = import_recordings(clip.folder, self._workspace.inside(dataset), add_to=True)
        with contextlib.closing(OpenSession(clip.folder)) as session, contextlib.suppress(OSError):
            session.log.write([_event("added", dataset=dataset.name, recordings=done.added["recordings"])])
        self.changed.notify()
        return done


def _closing(intake: FrameReceiver) -> SessionEvent:
    return _event("close", rows=intake.rows, lost=intake.lost, seconds=round(intake.toy_ms / 1000.0, 2))


def _key(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _event(what: str, **more: Any) -> SessionEvent:
    return SessionEvent(what, now_ms(), more)


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
    """Count lost frames and gaps from the rows' device clock."""
    loss = LossCounter()
    last: Frame | None = None
    for at, frame in enumerate(take.frames):
        take.lost += loss.push(frame.device_ms)
        if last is not None:
            step_ms = frame.device_ms - last.device_ms
            if step_ms < 0 or step_ms > layout.gap_ms:
                reason = "the toy's clock began anew" if step_ms < 0 else "nothing came"
                take.gaps.append(gap_entry(at, last, frame, max(step_ms, frame.host_ms - last.host_ms, 0), reason))
        last = frame


def _refused(folder: Path, cause: Exception) -> DatasetError:
    why = getattr(cause, "strerror", None) or cause
    return DatasetError(f"'{folder}' cannot be written ({why}): what was written until then is kept; make room.")
