"""What was kept from the live page: each clip a session of its own, written at once, labelled whenever there is time.

A clip lies in ``recordings/<subject>/live-<n>/`` with its stream, as the recorder leaves a session; a label cuts rows
of the stream into a recording beside it. The stream itself never changes.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense import __version__
from plushsense.apps.studio.clip import PROTOCOL, Clip, Label, read_clip
from plushsense.apps.studio.house import Bell, House
from plushsense.apps.studio.listening import Listening
from plushsense.apps.studio.signals import TappedDevice
from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.gestures import plain_label
from plushsense.core.recfile import STREAM_NAME, Frames, parse_name, read_stream, recording_filename
from plushsense.core.signal import Layout
from plushsense.dataset.importers import import_recordings
from plushsense.dataset.making import ImportSummary
from plushsense.devices.base import Counters, Frame, LossMeter, now_ms
from plushsense.models.bundle import Bundle
from plushsense.recording.intake import Intake
from plushsense.recording.keeper import Keeper
from plushsense.recording.protocol import Protocol, Step
from plushsense.recording.saving import keep_take
from plushsense.recording.session import OpenSession, check_subject
from plushsense.recording.sessionfile import Event, SessionHead
from plushsense.recording.take import Take, gap_entry
from plushsense.recording.toy import speed_of, with_speed
from plushsense.recording.writer import StreamFile

LONGEST_S = 600.0
"""A clip that nobody ends does so by itself, by the toy's clock."""
_SOFTWARE = f"plushsense {__version__}"


@dataclass
class _Running:
    """The clip that is being recorded."""

    session: OpenSession
    intake: Intake
    device: TappedDevice
    keeper: Keeper | None = None
    failed: str = ""
    over: bool = False
    lock: Any = field(default_factory=threading.Lock)


class Clips:
    """The part that keeps clips. `bell` rings when there is another one, and when one changed."""

    def __init__(self, house: House) -> None:
        self.bell = Bell()
        self._house = house
        self._lock = threading.RLock()
        self._running: _Running | None = None
        self.failed = ""

    # Keeping --------------------------------------------------------------------------------------------------

    @property
    def recording(self) -> str:
        """The clip that is being recorded, as in `Clip.key`; "" while none is."""
        running = self._running
        return "" if running is None else _key(running.session.folder)

    @property
    def recorded_s(self) -> float:
        """How long it is, by the toy's clock."""
        running = self._running
        return running.intake.toy_ms / 1000.0 if running is not None else 0.0

    def keep(self, listening: Listening, seconds: float, subject: str) -> str:
        """Write the last so many seconds as a clip; its key.

        Raises:
            ConfigError: when nothing was heard. DatasetError: for a code that is none, or a disk that refuses.
        """
        device, bundle = listening.device, listening.bundle
        frames = device.ring.frames(seconds) if device is not None else []
        if device is None or bundle is None or not frames:
            raise ConfigError("Nothing was heard yet that could be kept: start a toy first.")
        with self._lock:
            running = self._open(listening, device, bundle, subject)
        try:
            stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            with contextlib.closing(stream):
                stream.write([running.intake.take_in(frame).frame for frame in frames])
                running.session.log.write([_closing(running.intake)])
        except OSError as cause:
            raise _refused(running.session.folder, cause) from None
        finally:
            running.session.close()
        self.bell.ring()
        return _key(running.session.folder)

    def begin(self, listening: Listening, subject: str) -> str:
        """Record from now on; its key. What comes is on the disk half a second later.

        Raises:
            ConfigError: when nothing is read, or a clip is being recorded already. DatasetError: as for `keep`.
        """
        with self._lock:
            device, bundle = listening.device, listening.bundle
            if self._running is not None:
                raise ConfigError(f"The clip '{self.recording}' is being recorded already: end it first.")
            if device is None or bundle is None or not listening.now.running:
                raise ConfigError("No toy is being read: start one first.")
            self.failed = ""
            running = self._open(listening, device, bundle, subject)
            try:
                stream = StreamFile(running.session.folder / STREAM_NAME, running.session.layout)
            except OSError as cause:
                running.session.close()
                raise _refused(running.session.folder, cause) from None
            running.keeper = Keeper(
                stream, running.session.log, hurried=False, on_fail=lambda cause: self._fail(running, cause)
            )
            self._running = running
            device.taps.append(self._tap)
        self.bell.ring()
        return _key(running.session.folder)

    def end(self, only: _Running | None = None) -> str:
        """End the clip that is being recorded, or ``only`` this one; its key, or "" where none was."""
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
                running.keeper.do(_closing(running.intake))
            running.keeper.close()
            running.session.close()
            self.failed = running.failed
        self.bell.ring()
        return _key(running.session.folder)

    def close(self) -> None:
        """End with the studio."""
        self.end()

    def _tap(self, frames: list[Frame]) -> None:
        """Frames as they come, in the reader's thread."""
        running = self._running
        if running is None or running.keeper is None:
            return
        with running.lock:
            if running.over:
                return
            came = [running.intake.take_in(frame) for frame in frames]
            running.keeper.add([c.frame for c in came], running.intake.toy_ms)
            for gap in (c.gap for c in came):
                if gap is not None:
                    running.keeper.do(_event("gap", **gap))
            running.over = running.intake.toy_ms >= 1000.0 * LONGEST_S
        if running.over:
            threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _fail(self, running: _Running, cause: Exception) -> None:
        running.failed = str(_refused(running.session.folder, cause))
        running.over = True
        threading.Thread(target=self.end, args=(running,), daemon=True).start()

    def _open(self, listening: Listening, device: TappedDevice, bundle: Bundle, subject: str) -> _Running:
        """A new session; with the lock."""
        person = self._house.inside(self._house.recordings / check_subject(subject.strip()))
        taken = {p.name for p in person.iterdir()} if person.is_dir() else set()
        number = 1
        while f"live-{number}" in taken:
            number += 1
        choice = listening.choice
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
        speed = speed_of(with_speed(choice.toy, self._house.speed))
        try:
            # At once finished: a recorder that takes up the person's last session must not take this one.
            session.log.write(
                [_event("open", software=_SOFTWARE, device=device.url, speed=speed, row=0), _event("finished")]
            )
        except OSError as cause:
            session.close()
            raise _refused(session.folder, cause) from None
        return _Running(session, Intake(device, device.layout, speed, 0, 0), device)

    # What there is --------------------------------------------------------------------------------------------

    def all(self) -> list[Clip]:
        """Every clip on disk, the newest first. Reads files: not on the loop of the pages."""
        found = []
        for folder in self._house.sessions():
            if folder.name.startswith("live-"):
                # A damaged one must not hide the others; `plushsense import` names it.
                with contextlib.suppress(BadInput, OSError):
                    clip = read_clip(folder)
                    if clip is not None:
                        found.append(clip)
        return sorted(found, key=lambda clip: -clip.head.started_ms)

    def get(self, key: str) -> Clip:
        """The clip of a key.

        Raises:
            ConfigError: where there is none.
        """
        folder = self._house.inside(self._house.recordings / key)
        clip = read_clip(folder)
        if clip is None:
            raise ConfigError(f"There is no clip '{key}': it may have been moved.")
        return clip

    def rows(self, clip: Clip) -> Frames:
        """What the toy sent in a clip."""
        return read_stream(clip.folder / STREAM_NAME, clip.layout).frames

    # Labelling ------------------------------------------------------------------------------------------------

    def label(self, key: str, gesture: str, first: int, last: int) -> Label:
        """Make rows ``first`` to before ``last`` of a clip a recording of ``gesture``, beside its stream.

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
        take = Take(Step(0, gesture, times, gesture), first, 0.0, Counters(), as_frames)
        _count_losses(take, clip.layout)
        with contextlib.closing(OpenSession(clip.folder)) as session:
            try:
                file, _ = keep_take(
                    session, take, Counters(), "cut", now_ms(), "", device=clip.head.device, software=_SOFTWARE
                )
            except OSError as cause:
                raise _refused(clip.folder, cause) from None
        self.bell.ring()
        return Label(file, gesture, first, last)

    def add(self, key: str, dataset: Path) -> ImportSummary:
        """Add the recordings of a clip to a data set, as ``plushsense import --add`` does.

        Raises:
            ConfigError: without a label. DatasetError: as for `import_recordings`.
        """
        clip = self.get(key)
        if not clip.labels:
            raise ConfigError(f"The clip '{key}' has no label yet: choose a part of it and say what it is.")
        done = import_recordings(clip.folder, self._house.inside(dataset), add_to=True)
        with contextlib.closing(OpenSession(clip.folder)) as session, contextlib.suppress(OSError):
            session.log.write([_event("added", dataset=dataset.name, recordings=done.added["recordings"])])
        self.bell.ring()
        return done


def _closing(intake: Intake) -> Event:
    return _event("close", rows=intake.rows, lost=intake.lost, seconds=round(intake.toy_ms / 1000.0, 2))


def _key(folder: Path) -> str:
    return f"{folder.parent.name}/{folder.name}"


def _event(what: str, **more: Any) -> Event:
    return Event(what, now_ms(), more)


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


def _count_losses(take: Take, layout: Layout) -> None:
    """What the rows' own clock says is missing between them."""
    loss = LossMeter()
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
