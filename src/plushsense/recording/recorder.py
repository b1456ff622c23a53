"""Recorder of a session: a state machine that commands and the toy's frames drive.

Commands do not wait for their effects. One thread reads the toy's frames, those of the background writer write them; at
real time the reader never waits for the disk. All durations of a session are measured by the toy's own clock, so that a
virtual toy at twenty times the speed counts down in a twentieth of the time, and a toy that is unplugged during the
countdown does not start an empty recording. A real toy's clock that stands or is much too slow counts as half as fast
as the computer's, so that every recording ends.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames
from plushsense.core.sentences import Message
from plushsense.devices.base import Counters, Device, Frame, now_ms
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.recording.session import OpenSession
from plushsense.recording.status import PlanProgress, RecorderState, RecorderStatus, StepResult, key_of
from plushsense.recording.takes import AWAY_S, Ended, FrameReceiver, RecordingTake, StreamGap, measured_rate_hz
from plushsense.recording.writer import (
    FORMAT_VERSION,
    BackgroundWriter,
    SessionEvent,
    SessionHead,
    StreamFile,
    lacks_descriptor,
    save_take,
    to_frames,
)

_NO_DESCRIPTOR = Message(
    "Too many files are open on this computer: saving waits until some are closed. Nothing is lost."
)
_RECORDING = Message("Recording: space stops it, r discards it.")
_CANCELLED = Message("The countdown was cancelled.")

Listener = Callable[[str, RecorderStatus], None]


@dataclass(frozen=True)
class AutoRecording:
    """Automatic recording: begin a countdown ``rest_s`` after the recorder is ready, and record for ``take_s``."""

    take_s: float = 5.0
    rest_s: float = 1.0


class Recorder:
    """Recorder of one session. Use it as a context manager; its commands may be called from any thread.

    Args:
        session: the open folder of the session, which the recorder closes.
        device: the toy, which the caller closes.
        speed: the speed of the toy as a multiple of real time. At 1, rows have the computer's time; at any other speed
            they have the start time plus the toy's time since then.
        auto: settings to start and stop recordings automatically; None to do it by commands.
        software: name and version of the program, for the log and the sidecars.

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
        self._message = self._mismatch = Message()
        self.over = Message()
        self._failed = Message()
        self._closing = False
        self._received: list[Frame] = []
        self._writer: BackgroundWriter | None = None
        self._reader = self._new_reader()

    @classmethod
    def open(cls, folder: Path, device: Device, head: SessionHead | None = None, **options: Any) -> Recorder:
        """Open the session in ``folder`` as `OpenSession` does, and return its recorder."""
        return cls(OpenSession(folder, head), device, **options)

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

    @property
    def toy_s(self) -> float:
        """Seconds since the first frame by the toy's clock, see `FrameReceiver`."""
        with self._changed:
            return self._receiver.toy_ms / 1000.0

    def steps(self) -> tuple[StepResult, ...]:
        """Return the state of every planned recording, in order."""
        with self._changed:
            plan = self._plan
            return tuple(
                StepResult(s, plan.takes.get(k, ""), k in plan.skipped, len(plan.discarded.get(k, ())))
                for s in plan.steps
                for k in (key_of(s),)
            )

    @property
    def begins_ms(self) -> int | None:
        """Toy's clock in ms at the end of the running countdown; None if there is none, or before the first frame."""
        with self._changed:
            last = self._receiver.last
            if self._state != "countdown" or last is None:
                return None
            return last.device_ms + round(1000.0 * (self.protocol.countdown_s - self._passed_s()))

    @property
    def gaps(self) -> list[StreamGap]:
        """Gaps since this recorder started, as in the sidecars, but with ``after_row`` in rows of the stream."""
        with self._changed:
            return list(self._receiver.gaps)

    def wait(self, *states: RecorderState, timeout_s: float | None = None) -> bool:
        """Wait until the state is one of ``states`` or "stopped"; return False after ``timeout_s``."""
        with self._changed:
            return self._changed.wait_for(lambda: self._state in (*states, "stopped"), timeout_s)

    def start(self) -> None:
        """Start reading frames; raise DatasetError if the stream's file cannot be opened.

        No recording begins before the first `space`, unless it is automatic.
        """
        try:
            stream = StreamFile(self.session.folder / STREAM_NAME, self.session.layout)
        except OSError as cause:
            self.session.close()
            raise write_error(self.session, len(self._plan.takes), cause) from None
        self._writer = BackgroundWriter(
            stream,
            self.session.log,
            synchronous=self._speed != 1.0,
            on_fail=self._fail,
            on_wait=partial(self.show_message, _NO_DESCRIPTOR),
        )
        with self._changed:
            self._log(
                "open",
                software=self._software,
                device=self.device.url,
                speed=self._speed,
                resumed=self.session.progress.resumed,
                row=self._receiver.rows,
            )
            repairs = self.session.progress.repairs
            self._advance(Message("{repairs}", repairs="; ".join(repairs)) if repairs else Message(), from_start=True)
        self._reader.start()

    def space(self) -> None:
        """Start the countdown, cancel it, or stop the recording if it has lasted the protocol's ``shortest_s``."""
        with self._notifying():
            if self._state == "idle":
                if self._receiver.quality().signal == "unreadable":
                    layout, fields = self.session.layout.name, len(self.session.layout.wire)
                    unread = self.device.mismatch or Message(
                        "The toy sends lines, but none is a frame of {layout} ({n} numbers): is the layout right, "
                        "and the cable sound?",
                        layout=layout,
                        n=fields,
                    )
                    self._show_message(unread)
                elif self._receiver.silent:
                    self._show_message(Message("Nothing comes from the toy: is it switched on and near?"))
                else:
                    self._begin()
            elif self._state == "countdown":
                self._cancel(_CANCELLED)
            elif self._state == "recording" and self._take is not None:
                if max(self._passed_s(), self._wall_s()) < self.protocol.shortest_s:
                    self._show_message(Message("Too early to stop: still recording."))
                else:
                    self._stop("space")
            elif self._state == "paused":
                self._show_message(Message("Paused: resume first (p)."))

    def redo(self, why: str = "") -> None:
        """Record again: stop the running recording, or else discard the last one, whose file is kept."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel(_CANCELLED)
            elif self._state == "recording":
                self._abandon("redo", Message("Stopped: record it again."))
            elif self._state in ("idle", "paused", "finished"):
                key = self._plan.last
                if key is None:
                    self._show_message(Message("There is no recording to repeat: go back to it (b)."))
                    return
                file = self._plan.discard(key)
                more = {"why": why} if why else {}
                self._log("redo", file=file, gesture=key[0], repetition=key[1], **more)
                self._ready(
                    Message(
                        "'{gesture}', {n}, is to be recorded again; skip (s) keeps the earlier recording.",
                        gesture=key[0],
                        n=key[1],
                    )
                )

    def skip(self) -> None:
        """Skip this step; if it was to be recorded again, use the earlier recording."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel()
            if self._state == "recording":
                self._show_message(_RECORDING)
            elif self._state in ("idle", "paused"):
                key = key_of(self._plan.step)
                message = Message()
                if file := self._plan.keep(key):
                    self._log("keep", file=file, gesture=key[0], repetition=key[1])
                    message = Message("The earlier recording is kept.")
                elif key not in self._plan.takes:
                    self._plan.skipped.add(key)
                    self._log_step("skip")
                    message = Message("Skipped '{gesture}', {n}; go back to it with b.", gesture=key[0], n=key[1])
                self._advance(message)

    def go(self, number: int) -> None:
        """Go to the step ``number`` (from 0); its recording, if any, is replaced only when a new one is finished."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel()
            if self._state == "recording":
                self._show_message(_RECORDING)
            elif self._state in ("idle", "paused", "finished"):
                self._plan.at = min(max(0, number), len(self._plan.steps) - 1)
                self._log_step("go")
                there = key_of(self._plan.step) in self._plan.takes
                self._ready(Message("This step is recorded: space records it again, s goes on.") if there else None)

    def back(self) -> None:
        """Go one step back."""
        with self._changed:
            number = self._plan.at - (self._state != "finished")
        self.go(number)

    def pause(self) -> None:
        """Pause: no recording starts until `resume`, but the stream is still written.

        A running recording is abandoned: its rows are in the stream only, and its step is to be recorded again.
        """
        with self._notifying():
            if self._state == "countdown":
                self._cancel()
            if self._state not in ("idle", "recording"):
                return
            self._paused = True
            if self._state == "recording":
                self._abandon("pause", Message("The pause stopped this recording: record it again."))
            else:
                self._enter("paused")
            self._log("pause")

    def resume(self) -> None:
        """End a pause."""
        with self._notifying():
            if self._state == "paused":
                self._paused = False
                self._log("resume")
                self._ready()

    def exchange(self, device: Device) -> Device:
        """Go on with another toy of the same layout, in the same files; return the former toy, to be closed.

        A recording that waits for a toy that is away is abandoned, and its step is to be recorded again.

        Raises:
            ConfigError: while a recording runs, is counted down to or saved, or the session has ended.
        """
        with self._notifying():
            running = self._state in ("countdown", "saving") or (self._state == "recording" and not self._receiver.away)
            if running or self._closing or device.layout.wire != self.session.layout.wire:
                raise ConfigError("The toy can be exchanged only between two recordings, for one of the same layout.")
            former, self.device = self.device, device
            self._receiver.exchange(device)
            self._log("exchange", device=device.url, former=former.url, row=self._receiver.rows)
            message_to_all = Message("The session goes on with another toy.")
            over, self.over = self.over, Message()
            if self._state == "recording":
                self._abandon("exchange", message_to_all)
            elif self._state == "stopped":
                self._advance(message_to_all, from_start=True)
            else:
                self._show_message(message_to_all)
            if over:
                # The reader of a toy whose data have ended is finished.
                self._reader = self._new_reader()
                self._reader.start()
            return former

    def mark(self) -> None:
        """Log the present moment by both clocks, to find it again in a video."""
        with self._notifying():
            last, at_ms = self._receiver.last, now_ms()
            device_ms = None
            if last is not None and not self._receiver.silent:
                # At real time, the toy's clock has gone on since its last frame.
                device_ms = last.device_ms + (at_ms - last.host_ms if self._speed == 1.0 else 0)
            self._log_step("mark", host_ms=at_ms, device_ms=device_ms, row=self._receiver.rows)
            self._show_message(Message("Marked for the video."))

    def note(self, text: str) -> None:
        """Log a remark with the time, the current step and the last recording."""
        text = " ".join(text.split())
        with self._notifying():
            if text and (self._closing or self._state == "stopped"):
                self._show_message(Message("The session has ended: this note is not saved."))
            elif text:
                self._log_step("note", text=text, file=self._plan.last_file)
                self._show_message(Message("Note saved."))

    def show_message(self, message: Message) -> None:
        """Show a message on every display."""
        with self._notifying():
            self._show_message(message)

    def close(self) -> None:
        """Close the session: abandon a running recording and write all other data. Closing twice is harmless."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel()
            elif self._state == "recording" and not self._failed:
                self._abandon("quit")
            last, self._closing = not self._closing, True
        if self._reader.is_alive():
            self._reader.join()
        if last:
            with self._notifying():
                self._log("close", rows=self._receiver.rows)
        if self._writer is not None:
            self._writer.close()
        self.session.close()
        with self._notifying():
            if self._state != "stopped":
                self._enter("stopped", self._message)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _new_reader(self) -> threading.Thread:
        return threading.Thread(target=self._read, name="plushsense-reader", daemon=True)

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

    def _show_message(self, message: Message) -> None:
        self._message = message
        self._changes.append("message")
        self._changed.notify_all()

    def _enter(self, state: RecorderState, message: Message | None = None) -> None:
        if self._failed:
            # The stream may have failed while a recording was still being saved.
            state, message = "stopped", self._failed
        self._state = state
        self._since_ms, self._since_s = self._receiver.toy_ms, time.monotonic()
        self._message = message or Message()
        self._changes.append(state)
        self._changed.notify_all()

    def _wall_s(self) -> float:
        return time.monotonic() - self._take.from_s if self._take is not None else 0.0

    def _passed_s(self) -> float:
        """Return the seconds since the state was entered, by the toy's clock, see `FrameReceiver.passed_s`."""
        return self._receiver.passed_s(self._since_ms, self._since_s)

    def _advance(self, message: Message | None = None, from_start: bool = False) -> None:
        """Go to the next step to record; finish the session if none is left."""
        if self._plan.advance(from_start):
            self._ready(message)
        else:
            self._log("finished", recordings=len(self._plan.takes), skipped=len(self._plan.skipped))
            self._paused = False
            self._enter("stopped" if self.over else "finished", message)

    def _ready(self, message: Message | None = None) -> None:
        if self.over:
            self._enter("stopped", self.over)
        else:
            self._enter("paused" if self._paused else "idle", message)

    def _begin(self) -> None:
        now = self._receiver.last.device_ms if self._receiver.last else None
        self._log_step("countdown", countdown_s=self.protocol.countdown_s, device_ms=now)
        self._enter("countdown")

    def _cancel(self, message: Message | None = None) -> None:
        self._log_step("cancel")
        self._enter("idle", message)

    def _abandon(self, why: str, message: Message | None = None) -> None:
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
            take.gaps.append(StreamGap.of(len(take.frames), take.frames[-1], None, silent_ms, "nothing came any more"))
        self._take = None
        counters = Counters(**self.device.counters.to_dict())
        self._enter("saving")
        self._flush()
        if self._writer is not None:
            self._writer.submit(lambda: self._save(take, ended, counters))

    def _read(self) -> None:
        """Process frames as they arrive, in the reader's thread, independently of the display."""
        over = Message("The toy's data have ended.")
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
            over = cause.message
        except Exception as cause:  # noqa: BLE001, RUF100
            over = Message(
                "Reading the toy failed ({name}: {why}): all frames until then are kept.",
                name=type(cause).__name__,
                why=cause,
            )
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
        mismatch = self.device.mismatch if unreadable else Message()
        if mismatch and mismatch != self._mismatch:
            self._show_message(mismatch)
        self._mismatch = mismatch

    def _flush(self) -> None:
        """Pass the received frames to the background writer; call this before anything to be written after them."""
        if self._writer is not None and self._received:
            self._writer.add_frames(self._received, self._receiver.toy_ms)
        self._received = []

    def _gap(self, gap: StreamGap) -> None:
        """Log a gap of the stream, add it to a running recording, and show a message if it is long."""
        (self._log_step if self._take is not None else self._log)("gap", **gap.to_json())
        if self._take is not None:
            self._take.gaps.append(replace(gap, after_row=len(self._take.frames)))
        if gap.missing_ms >= 1000.0 * AWAY_S:
            away_s = round(gap.missing_ms / 1000.0, 1)
            if self._state == "countdown":
                self._cancel(Message("The toy was disconnected for {s:.1f} s: press space again.", s=away_s))
            elif self._state == "recording":
                template = "The toy was disconnected for {s:.1f} s: this recording has a gap; r records it again."
                self._show_message(Message(template, s=away_s))
            else:
                self._show_message(Message("The toy was disconnected for {s:.1f} s.", s=away_s))

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
            self._failed = write_error(self.session, len(self._plan.takes), cause).message
            self._closing = True
            self._take = None
            self._enter("stopped", self._failed)


def store_take(
    session: OpenSession,
    take: RecordingTake,
    counters: Counters,
    ended: Ended,
    saved_ms: int,
    earlier: str,
    **more: Any,
) -> tuple[str, Message]:
    """Write a recording, its sidecar and its log entry; ``earlier`` is the file that it replaces, or "".

    Returns:
        The name of the file, and a message for the user, which may be empty.

    Raises:
        OSError: if the files cannot be written; no partial file is left.
    """
    layout, step = session.layout, take.step
    frames = to_frames(take.frames, layout.n_channels)
    metadata = _sidecar(take, frames, layout, session.head, counters, ended, saved_ms=saved_ms, **more)
    path = save_take(session.folder, frames, layout, step.gesture, saved_ms, metadata)
    key = {"gesture": step.gesture, "repetition": step.repetition}
    result = {"rows": len(frames), "lost": take.lost, "gaps": len(take.gaps), "ended": ended}
    events = [SessionEvent("take", saved_ms, {"file": path.name} | key | result)]
    if earlier:
        events.append(SessionEvent("redo", saved_ms, {"file": earlier} | key))
    session.log.write(events)
    message = Message()
    if ended == "longest":
        longest_s = session.protocol.longest_s
        message = Message("Nobody stopped the recording: it ended after {s:g} s; r records it again.", s=longest_s)
    elif take.gaps:
        longest = max(gap.missing_ms for gap in take.gaps) / 1000.0
        if longest >= 0.05:
            message = Message("This recording has a gap of {s:.1f} s; it is kept, r records it again.", s=longest)
        else:
            message = Message("This recording has a jump in the toy's clock; it is kept, r records it again.")
    return path.name, message


def _sidecar(
    take: RecordingTake,
    frames: Frames,
    layout: Layout,
    head: SessionHead,
    counters: Counters,
    ended: Ended,
    **more: Any,
) -> dict[str, Any]:
    """Return the metadata of a recording for its sidecar: subject, gesture, clocks, device, transmission faults."""
    assert frames.host_ms is not None
    outside = (frames.values < layout.valid_min_int) | (frames.values > layout.valid_max_int)
    step = take.step
    return {
        "format": FORMAT_VERSION,
        "subject": head.subject,
        "session": head.session,
        "gesture": step.gesture,
        "repetition": step.repetition,
        "prompt": step.prompt,
        "protocol": head.protocol["name"],
        "words": head.protocol["words"],
        "rows": len(frames),
        "stream_row": take.row,
        "device_ms": [int(frames.device_ms[0]), int(frames.device_ms[-1])],
        "host_ms": [int(frames.host_ms[0]), int(frames.host_ms[-1])],
        "rate_hz": round(measured_rate_hz(frames.device_ms), 2),
        "lost": take.lost,
        "malformed": counters.malformed - take.before.malformed,
        "garbage": int(outside.any(axis=1).sum()),
        "reconnects": counters.reconnects - take.before.reconnects,
        "gaps": [gap.to_json() for gap in take.gaps],
        "ended": ended,
        "auto_stopped": ended == "longest",
        "layout": layout.name,
        "wire": list(layout.wire),
        "device": head.device,
        "simulated": head.simulated,
    } | more


_FILES_OPEN = (
    "'{folder}' cannot be written any more ({why}): the session has stopped, with {n:recording} saved; close other "
    "programs, and continue the same session."
)
_DISK_FULL = (
    "'{folder}' cannot be written any more ({why}): the session has stopped, with {n:recording} saved; free disk "
    "space, and continue the same session."
)


def write_error(session: OpenSession, recordings: int, cause: Exception) -> DatasetError:
    """Return the error for a session that stopped because its folder cannot be written any more."""
    why = getattr(cause, "strerror", None) or cause
    template = _FILES_OPEN if lacks_descriptor(cause) else _DISK_FULL
    return DatasetError(template, folder=str(session.folder), why=str(why), n=recordings)


def open_toy(url: str, layout: Layout | str | None = None) -> Device:
    """Open a toy by its URL with `open_device`; if it is disconnected later, wait for it and record the gap."""
    return open_device(url, layout, reconnect=True)


def prompt_virtual(recorder: Recorder) -> None:
    """Let the simulated person of a virtual toy perform each requested gesture when it is recorded.

    This has no effect on other toys. Call it before the recorder starts, and after `Recorder.exchange`.
    """
    device = recorder.device
    inner = getattr(device, "inner", device)
    if not isinstance(inner, VirtualDevice):
        return
    inner.follow()

    def on_change(change: str, status: RecorderStatus) -> None:
        if change == "countdown" and status.state == "countdown" and recorder.device is device:
            inner.perform(status.step.gesture, recorder.begins_ms)

    recorder.subscribe(on_change)


def send_markers(recorder: Recorder, push: Callable[[str], None]) -> None:
    """Call ``push`` with a marker when a recording begins (its gesture) or ends ("end"), and for each `Recorder.mark`.

    These are the markers by which an XDF file is imported. Call it before the recorder starts.
    """

    def on_change(change: str, status: RecorderStatus) -> None:
        if change in ("start", "saving", "abandon", "mark"):
            push(status.step.gesture if change == "start" else "mark" if change == "mark" else "end")

    recorder.subscribe(on_change)
