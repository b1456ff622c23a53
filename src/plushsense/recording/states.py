"""State machine of a recording session, driven by commands and by the toy's frames.

`plushsense.recording.recorder` adds the commands. One thread reads the toy's frames, those of the background writer
write them; at real time the reader never waits for the disk. All durations of a session are measured by the toy's own
clock, so that a virtual toy at twenty times the speed counts down in a twentieth of the time, and a toy that is
unplugged during the countdown does not start an empty recording. A real toy's clock that stands or is much too slow
counts as half as fast as the computer's, so that every recording ends.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from plushsense.core.errors import DatasetError, PlushSenseError
from plushsense.core.sentences import Sentence, plural
from plushsense.devices.base import Counters, Device, Frame, now_ms
from plushsense.recording.plan import Step
from plushsense.recording.session import Key, OpenSession, SessionProgress
from plushsense.recording.session_files import SessionEvent
from plushsense.recording.takes import AWAY_S, Ended, FrameReceiver, RecordingTake, gap_entry, sidecar
from plushsense.recording.writer import BackgroundWriter, lacks_descriptor, save_take, to_frames

RecorderState = Literal["idle", "countdown", "recording", "saving", "paused", "finished", "stopped"]


@dataclass(frozen=True)
class StepResult:
    """State of one planned recording.

    ``file`` is the recording in use ("" if there is none), ``discarded`` the number of discarded files.
    """

    step: Step
    file: str
    skipped: bool
    discarded: int


@dataclass(frozen=True)
class RecorderStatus:
    """Snapshot of a session.

    ``state`` is "finished" if all steps are recorded or skipped, "stopped" if no more data can be received or written
    (the reason is ``failed`` for errors of the disk, else ``message``). ``done``, ``skipped`` and ``steps`` are numbers
    of steps, ``redone`` is the number of discarded files, ``existing`` the file of the current step if it is recorded,
    ``file`` the last recording in use. ``countdown_s`` and ``left_s`` are the remaining times of countdown and
    recording, ``elapsed_s`` is the duration of the recording so far. ``rate_hz``, ``jitter_ms``, ``signal`` and
    ``bad_share`` are those of `SignalQuality`; ``away`` is whether the toy is disconnected. ``rows`` counts the
    session's stream; the other counts begin with this program.
    """

    state: RecorderState
    step: Step
    steps: int
    repetitions: int
    next_step: Step | None
    done: int
    skipped: int
    redone: int
    existing: str
    countdown_s: float
    elapsed_s: float
    left_s: float
    rate_hz: float
    jitter_ms: float
    signal: str
    away: bool
    lost: int
    malformed: int
    garbage: int
    reconnects: int
    gaps: int
    rows: int
    file: str
    message: Sentence
    failed: str
    folder: str
    frames: int = 0
    bad_share: float = 0.0

    @property
    def bad_share_total(self) -> float:
        """Share of all lines since the start of this program that were lost, malformed or out of range, 0 to 1."""
        bad = self.lost + self.malformed + self.garbage
        return bad / max(1, self.frames + bad)

    @property
    def seen(self) -> str:
        """Identifier of the displayed state, by which a command for an outdated display can be recognised."""
        return f"{self.state}.{self.step.number}.{self.done}.{self.skipped}.{self.redone}"


def store_take(
    session: OpenSession,
    take: RecordingTake,
    counters: Counters,
    ended: Ended,
    saved_ms: int,
    earlier: str,
    **more: Any,
) -> tuple[str, Sentence]:
    """Write a recording, its sidecar and its log entry; ``earlier`` is the file that it replaces, or "".

    Returns:
        The name of the file, and a message for the user, which may be empty.

    Raises:
        OSError: if the files cannot be written; no partial file is left.
    """
    layout, step = session.layout, take.step
    frames = to_frames(take.frames, layout.n_channels)
    metadata = sidecar(take, frames, layout, session.head, counters, ended, saved_ms=saved_ms, **more)
    path = save_take(session.folder, frames, layout, step.gesture, saved_ms, metadata)
    key = {"gesture": step.gesture, "repetition": step.repetition}
    result = {"rows": len(frames), "lost": take.lost, "gaps": len(take.gaps), "ended": ended}
    events = [SessionEvent("take", saved_ms, {"file": path.name} | key | result)]
    if earlier:
        events.append(SessionEvent("redo", saved_ms, {"file": earlier} | key))
    session.log.write(events)
    message = Sentence()
    if ended == "longest":
        longest_s = session.protocol.longest_s
        sentence = f"Nobody stopped the recording: it ended after {longest_s:g} s; r records it again."
        message = Sentence(sentence, "ended_by_itself", s=longest_s)
    elif take.gaps:
        longest = max(gap["missing_ms"] for gap in take.gaps) / 1000.0
        fault = f"has a gap of {longest:.1f} s" if longest >= 0.05 else "has a jump in the toy's clock"
        reason = "kept_with_gap" if longest >= 0.05 else "kept_with_jump"
        message = Sentence(f"This recording {fault}; it is kept, r records it again.", reason, s=round(longest, 1))
    return path.name, message


def write_error(session: OpenSession, recordings: int, cause: Exception) -> DatasetError:
    """Return the error for a session that stopped because its folder cannot be written any more."""
    why = getattr(cause, "strerror", None) or cause
    remedy = "close other programs" if lacks_descriptor(cause) else "free disk space"
    return DatasetError(
        f"'{session.folder}' cannot be written any more ({why}): the session has stopped, with "
        f"{plural(recordings, 'recording')} saved; {remedy}, and continue the same session.",
        reason="files_open" if lacks_descriptor(cause) else "disk_full",
        folder=session.folder,
        why=why,
        n=recordings,
    )


def key_of(step: Step) -> Key:
    """Return the key of a planned recording: its gesture and repetition."""
    return step.gesture, step.repetition


class PlanProgress:
    """Steps of a session in their order, and the recordings of each.

    ``takes`` maps a step to its file in use, the newest last; ``discarded`` maps it to its other files. ``at`` is the
    number of the current step.
    """

    def __init__(self, steps: tuple[Step, ...], progress: SessionProgress) -> None:
        self.steps = steps
        self.takes = dict(progress.takes)
        self.skipped = set(progress.skipped)
        self.discarded = {key: list(files) for key, files in progress.discarded.items()}
        self.at = 0
        self._last: Key | None = next(reversed(self.takes), None)

    @property
    def step(self) -> Step:
        """The current step."""
        return self.steps[self.at]

    @property
    def last(self) -> Key | None:
        """Step of the last recording; None if there is none, or it is to be recorded again."""
        return self._last if self._last in self.takes else None

    @property
    def last_file(self) -> str:
        """File of the last recording; "" if there is none, or it is to be recorded again."""
        return self.takes[self.last] if self.last is not None else ""

    @property
    def redone(self) -> int:
        """Number of discarded files."""
        return sum(map(len, self.discarded.values()))

    def _left(self, order: tuple[Step, ...]) -> Step | None:
        return next((s for s in order if key_of(s) not in self.takes and key_of(s) not in self.skipped), None)

    def next_step(self) -> Step | None:
        """Return the next step to record after the current one; None if no other is left."""
        return self._left(self.steps[self.at + 1 :] + self.steps[: self.at])

    def advance(self, from_start: bool = False) -> bool:
        """Go to the next step to record, wrapping around at the end; return False if none is left."""
        at = 0 if from_start else self.at + 1
        left = self._left(self.steps[at:] + self.steps[:at])
        self.at = left.number if left is not None else len(self.steps) - 1
        return left is not None

    def discard(self, key: Key) -> str:
        """Discard the recording of a step and go to that step, to record it again; return the file."""
        file = self.takes.pop(key)
        self.discarded.setdefault(key, []).append(file)
        self.at = next(s.number for s in self.steps if key_of(s) == key)
        return file

    def keep(self, key: Key) -> str:
        """Use the newest discarded file of a step again; return it, or "" if there is none or another file is used."""
        if key in self.takes or not self.discarded.get(key):
            return ""
        file = self.takes[key] = self.discarded[key].pop()
        self._last = key
        return file

    def record(self, key: Key, file: str) -> None:
        """Store the file of a finished recording; discard an earlier one of the same step."""
        earlier = self.takes.pop(key, "")
        if earlier:
            self.discarded.setdefault(key, []).append(earlier)
        self.takes[key] = file
        self.skipped.discard(key)
        self._last = key


Listener = Callable[[str, RecorderStatus], None]


@dataclass(frozen=True)
class AutoRecording:
    """Automatic recording: begin a countdown ``rest_s`` after the recorder is ready, and record for ``take_s``."""

    take_s: float = 5.0
    rest_s: float = 1.0


class RecordingMachine:
    """State machine of a session; `Recorder` adds the commands and documents the arguments.

    ``over`` is the reason why the toy sends no more data; "" while it may send some.
    """

    def __init__(
        self,
        session: OpenSession,
        device: Device,
        *,
        speed: float = 1.0,
        auto: AutoRecording | None = None,
        software: str = "",
    ) -> None:
        self.session = session
        self.device = device
        self.protocol = session.protocol
        self._speed = speed
        self._auto = auto
        self._software = software
        self._changed = threading.Condition(threading.RLock())
        self._listeners: list[Listener] = []
        self._changes: list[str] = []
        progress = session.progress
        self._plan = PlanProgress(self.protocol.steps(), progress)
        self._receiver = FrameReceiver(device, session.layout, speed, progress.rows, progress.host_ms)
        self._take: RecordingTake | None = None
        self._since_ms = 0.0
        self._since_s = time.monotonic()
        self._state: RecorderState = "idle"
        self._paused = False
        self._message = self._mismatch = Sentence()
        self.over = Sentence()
        self._failed = Sentence()
        self._closing = False
        self._received: list[Frame] = []
        self._writer: BackgroundWriter | None = None
        self._reader = self._new_reader()

    def _new_reader(self) -> threading.Thread:
        return threading.Thread(target=self._read, name="plushsense-reader", daemon=True)

    def subscribe(self, listener: Listener) -> None:
        """Call ``listener(change, status)`` at every change, in the thread that caused it; it must not block."""
        self._listeners.append(listener)

    def status(self) -> RecorderStatus:
        """Return a snapshot of the session."""
        with self._changed:
            plan, receiver = self._plan, self._receiver
            counters = self.device.counters
            passed = self._passed_s()
            counting, running = self._state == "countdown", self._state == "recording"
            return RecorderStatus(
                state=self._state,
                step=plan.step,
                steps=len(plan.steps),
                repetitions=self.protocol.repetitions,
                next_step=plan.next_step(),
                done=len(plan.takes),
                skipped=len(plan.skipped),
                redone=plan.redone,
                existing=plan.takes.get(key_of(plan.step), ""),
                countdown_s=max(0.0, self.protocol.countdown_s - passed) if counting else 0.0,
                elapsed_s=max(passed, self._wall_s()) if running else 0.0,
                left_s=max(0.0, self.protocol.longest_s - passed) if running else 0.0,
                **vars(receiver.quality()),
                away=receiver.away,
                lost=receiver.lost,
                malformed=counters.malformed,
                garbage=counters.garbage,
                reconnects=counters.reconnects,
                gaps=len(receiver.gaps),
                rows=receiver.rows,
                file=plan.last_file,
                message=self._message,
                failed=self._failed,
                folder=str(self.session.folder),
                frames=counters.frames,
            )

    @contextlib.contextmanager
    def _notifying(self) -> Iterator[None]:
        """Hold the lock, and notify the listeners after releasing it, so that they may give commands."""
        with self._changed:
            yield
        with self._changed:
            changes, self._changes = self._changes, []
        for change in changes:
            for listener in tuple(self._listeners):
                # An error in a listener must not end a recording.
                with contextlib.suppress(Exception):
                    listener(change, self.status())

    def _log(self, kind: str, **more: Any) -> None:
        if self._writer is not None:
            self._writer.submit(SessionEvent(kind, self._receiver.now_ms(), more))
        self._changes.append(kind)

    def _log_step(self, kind: str, **more: Any) -> None:
        step = self._plan.step
        self._log(kind, gesture=step.gesture, repetition=step.repetition, **more)

    def _show_message(self, message: Sentence) -> None:
        self._message = message
        self._changes.append("message")
        self._changed.notify_all()

    def _enter(self, state: RecorderState, message: Sentence | None = None) -> None:
        if self._failed:
            # The stream may have failed while a recording was still being saved.
            state, message = "stopped", self._failed
        self._state = state
        self._since_ms, self._since_s = self._receiver.toy_ms, time.monotonic()
        self._message = message or Sentence()
        self._changes.append(state)
        self._changed.notify_all()

    def _wall_s(self) -> float:
        return time.monotonic() - self._take.from_s if self._take is not None else 0.0

    def _passed_s(self) -> float:
        """Return the seconds since the state was entered, by the toy's clock, see `FrameReceiver.passed_s`."""
        return self._receiver.passed_s(self._since_ms, self._since_s)

    def _advance(self, message: Sentence | None = None, from_start: bool = False) -> None:
        """Go to the next step to record; finish the session if none is left."""
        if self._plan.advance(from_start):
            self._ready(message)
        else:
            self._log("finished", recordings=len(self._plan.takes), skipped=len(self._plan.skipped))
            self._paused = False
            self._enter("stopped" if self.over else "finished", message)

    def _ready(self, message: Sentence | None = None) -> None:
        if self.over:
            self._enter("stopped", self.over)
        else:
            self._enter("paused" if self._paused else "idle", message)

    def _begin(self) -> None:
        now = self._receiver.last.device_ms if self._receiver.last else None
        self._log_step("countdown", countdown_s=self.protocol.countdown_s, device_ms=now)
        self._enter("countdown")

    def _cancel(self, message: Sentence | None = None) -> None:
        self._log_step("cancel")
        self._enter("idle", message)

    def _abandon(self, why: str, message: Sentence | None = None) -> None:
        take = self._take
        assert take is not None
        self._take = None
        self._log_step("abandon", why=why, rows=len(take.frames))
        self._ready(message)

    def _stop(self, ended: Ended) -> None:
        take = self._take
        assert take is not None
        # If a frame ended the recording, the gap before it has been added already.
        waiting = self._receiver.away or (self._speed == 1.0 and self._receiver.silent)
        if waiting and ended in ("space", "toy"):
            silent_ms = self._receiver.silent_ms
            take.gaps.append(gap_entry(len(take.frames), take.frames[-1], None, silent_ms, "nothing came any more"))
        self._take = None
        counters = Counters(**self.device.counters.to_dict())
        self._enter("saving")
        self._flush()
        if self._writer is not None:
            self._writer.submit(lambda: self._save(take, ended, counters))

    def _read(self) -> None:
        """Process frames as they arrive, in the reader's thread, independently of the display."""
        over = Sentence("The toy's data have ended.", "data_ended")
        device = self.device
        try:
            while not self._closing:
                device = self.device
                frames = device.read()
                if device is not self.device:
                    continue
                if frames is None:
                    break
                with self._notifying():
                    if device is not self.device:
                        continue
                    for frame in frames:
                        self._receive(frame)
                    self._receiver.check_malformed()
                    if not frames:
                        self._show_unreadable()
                    if frames:
                        self._flush()
                        self._receiver.end_reading()
                if self._writer is not None:
                    self._writer.wait_written()
        except PlushSenseError as cause:
            over = Sentence.of(cause)
        except Exception as cause:  # noqa: BLE001, RUF100
            sentence = f"Reading the toy failed ({type(cause).__name__}: {cause}): all frames until then are kept."
            over = Sentence(sentence, "reading_broke_off", why=cause)
        with self._notifying():
            if self._closing:
                return
            if device is not self.device:
                # The toy was exchanged when its data ended.
                self._reader = self._new_reader()
                self._reader.start()
                return
            self.over = over
            if self._state == "recording":
                self._stop("toy")
            elif self._state not in ("saving", "stopped"):
                self._enter("stopped", over)

    def _receive(self, frame: Frame) -> None:
        """Process one frame: detect gaps, begin and end recordings, and keep the frame for the writer."""
        row = self._receiver.rows
        frame, missing, gap = self._receiver.receive(frame)
        if gap is not None:
            self._gap(gap)
        if self._state == "countdown" and self._passed_s() >= self.protocol.countdown_s:
            counters = Counters(**self.device.counters.to_dict())
            self._take = RecordingTake(self._plan.step, row, time.monotonic(), counters)
            self._log_step("start", row=row, host_ms=frame.host_ms, device_ms=frame.device_ms)
            self._enter("recording")
        elif self._take is not None:
            # Negative where frames that were counted before the recording came late.
            self._take.lost = max(0, self._take.lost + missing)
        self._received.append(frame)
        if self._take is not None:
            self._take.frames.append(frame)
        if self._state == "recording":
            if self._auto is not None and self._passed_s() >= self._auto.take_s:
                self._stop("auto")
            elif self._passed_s() >= self.protocol.longest_s:
                self._stop("longest")
        elif self._state == "idle" and self._auto is not None and self._passed_s() >= self._auto.rest_s:
            self._begin()

    def _show_unreadable(self) -> None:
        """Show why no line of the toy can be read, once for each reason."""
        unreadable = self._receiver.silent and self._receiver.quality().signal == "unreadable"
        mismatch = self.device.mismatch if unreadable else Sentence()
        if mismatch and mismatch != self._mismatch:
            self._show_message(mismatch)
        self._mismatch = mismatch

    def _flush(self) -> None:
        """Pass the received frames to the background writer; call this before anything to be written after them."""
        if self._writer is not None and self._received:
            self._writer.add_frames(self._received, self._receiver.toy_ms)
        self._received = []

    def _gap(self, gap: dict[str, Any]) -> None:
        """Log a gap of the stream, add it to a running recording, and show a message if it is long."""
        (self._log_step if self._take is not None else self._log)("gap", **gap)
        if self._take is not None:
            self._take.gaps.append(gap | {"after_row": len(self._take.frames)})
        if gap["missing_ms"] >= 1000.0 * AWAY_S:
            away_s = round(gap["missing_ms"] / 1000.0, 1)
            sentence = f"The toy was disconnected for {away_s:.1f} s"
            if self._state == "countdown":
                self._cancel(Sentence(f"{sentence}: press space again.", "away_in_countdown", s=away_s))
            elif self._state == "recording":
                sentence += ": this recording has a gap; r records it again."
                self._show_message(Sentence(sentence, "away_in_recording", s=away_s))
            else:
                self._show_message(Sentence(f"{sentence}.", "away", s=away_s))

    def _save(self, take: RecordingTake, ended: Ended, counters: Counters) -> None:
        """Save a recording and go to the next step; runs in a thread of the background writer."""
        key = key_of(take.step)
        with self._changed:
            saved_ms = self._receiver.now_ms()
            earlier = self._plan.takes.get(key, "")
        more = {"device": self.device.url, "speed": self._speed, "software": self._software}
        file, message = store_take(self.session, take, counters, ended, saved_ms, earlier, **more)
        with self._notifying():
            self._plan.record(key, file)
            self._changes.append("take")
            self._advance(message)

    def _fail(self, cause: Exception) -> None:
        with contextlib.suppress(OSError):
            self.session.log.write([SessionEvent("failed", now_ms(), {"why": str(cause)})])
        with self._notifying():
            self._failed = Sentence.of(write_error(self.session, len(self._plan.takes), cause))
            self._closing = True
            self._take = None
            self._enter("stopped", self._failed)
