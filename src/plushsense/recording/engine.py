"""The recorder: an engine that a terminal or a web page drives with a few commands and looks at through a status.

Three threads share the work, so that none waits for another: one takes the toy's frames in, one writes them to the
disk, and whoever calls a command is answered at once. All times of a session run on the toy's own clock, so that a
virtual toy at twenty times the speed counts down in a twentieth of the time, and a toy that is unplugged during the
countdown does not start a recording of nothing.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from plushsense.core.errors import DatasetError, PlushSenseError
from plushsense.core.recfile import STREAM_NAME
from plushsense.devices.base import Counters, Device, Frame, LossMeter, now_ms
from plushsense.recording.meter import Meter
from plushsense.recording.protocol import Step
from plushsense.recording.session import Key, OpenSession
from plushsense.recording.sessionfile import Event, SessionHead
from plushsense.recording.status import State, Status
from plushsense.recording.take import Take, gap_entry, sidecar
from plushsense.recording.writer import StreamFile, save_take, to_frames

FLUSH_S = 0.5
"""The stream on disk is at most so old, by the computer's clock and by the toy's, whichever comes first."""

_AWAY_S = 1.0

Listener = Callable[[str, Status], None]
Ended = Literal["space", "auto", "longest", "toy"]


@dataclass(frozen=True)
class Auto:
    """The recorder presses its own space bar: ``rest_s`` after it is ready, and ``take_s`` after a recording began."""

    take_s: float = 5.0
    rest_s: float = 1.0


@dataclass(frozen=True)
class _Save:
    take: Take
    ended: Ended
    counters: Counters


class Recorder:
    """One session being recorded. Use it as a context manager; commands may come from any thread.

    Args:
        session: its folder, opened; the recorder closes it.
        device: the toy; the caller closes it.
        speed: times real time at which the toy runs. At 1, rows carry the computer's clock; at any other the
            computer's clock means nothing, and rows are stamped with the toy's time since the start.
        auto: press the space bar, too.
        software: to stand in the log and the sidecars.
    """

    def __init__(
        self,
        session: OpenSession,
        device: Device,
        *,
        speed: float = 1.0,
        auto: Auto | None = None,
        software: str = "",
    ) -> None:
        self.session = session
        self.device = device
        self.protocol = session.protocol
        self.steps = self.protocol.steps()
        self._speed = speed
        self._auto = auto
        self._software = software
        self._changed = threading.Condition(threading.RLock())
        self._listeners: list[Listener] = []
        self._news: list[str] = []
        standing = session.standing
        self._takes: dict[Key, str] = dict(standing.takes)
        self._skipped: set[Key] = set(standing.skipped)
        self._aside: dict[Key, list[str]] = {k: list(v) for k, v in standing.aside.items()}
        self._last_key: Key | None = next(reversed(self._takes), None)
        self._rows = standing.rows
        self._base_ms = max(now_ms(), standing.host_ms + 1000 if speed != 1.0 else 0)
        self._toy_ms = 0.0
        self._last: Frame | None = None
        self._heard_s = float("-inf")
        self._reconnects = device.counters.reconnects
        self._loss = LossMeter()
        self._lost = 0
        self._gaps: list[dict[str, Any]] = []
        self._meter = Meter(session.layout)
        self._pending: list[Frame] = []
        self._pending_s = self._pending_ms = 0.0
        self._jobs: list[Event | _Save] = []
        self._take: Take | None = None
        self._since_ms = 0.0
        self._state: State = "idle"
        self._paused = False
        self._at = 0
        self._message = ""
        self._over = ""
        self._failed = ""
        self._closing = False
        self._stream: StreamFile | None = None
        self._reader = threading.Thread(target=self._read, name="plushsense-reader", daemon=True)
        self._writer = threading.Thread(target=self._write, name="plushsense-writer", daemon=True)

    @classmethod
    def open(cls, folder: Path, device: Device, head: SessionHead | None = None, **options: Any) -> Recorder:
        """A recorder for the session in ``folder``: a new one of ``head``, or the one that is there.

        Raises:
            DatasetError: when another program has it, ``head`` is of another session, or the disk refuses.
        """
        return cls(OpenSession(folder, head), device, **options)

    # For whoever shows it -------------------------------------------------------------------------------------

    def listen(self, listener: Listener) -> None:
        """Call ``listener(what, status)`` at every change, from whichever thread made it; it must not block."""
        self._listeners.append(listener)

    def status(self) -> Status:
        """Everything there is to show, at this moment."""
        with self._changed:
            step = self.steps[self._at]
            key = (step.gesture, step.repetition)
            counters = self.device.counters
            away = getattr(self.device, "state", "connected") == "waiting"
            quality = self._meter.quality(time.monotonic(), away)
            passed = (self._toy_ms - self._since_ms) / 1000.0
            counting, running = self._state == "countdown", self._state == "recording"
            left = max(0.0, self.protocol.countdown_s - passed) if counting else 0.0
            elapsed = max(passed, self._wall_s()) if running else 0.0
            return Status(
                state=self._state,
                step=step,
                steps=len(self.steps),
                repetitions=self.protocol.repetitions,
                following=self._following(),
                done=len(self._takes),
                skipped=len(self._skipped),
                redone=sum(map(len, self._aside.values())),
                already=self._takes.get(key, ""),
                countdown_s=left,
                elapsed_s=elapsed,
                left_s=max(0.0, self.protocol.longest_s - passed) if running else 0.0,
                rate_hz=quality.rate_hz,
                jitter_ms=quality.jitter_ms,
                signal=quality.signal,
                away=away,
                lost=self._lost,
                malformed=counters.malformed,
                garbage=counters.garbage,
                reconnects=counters.reconnects,
                gaps=len(self._gaps),
                rows=self._rows,
                file=self._takes.get(self._last_key, "") if self._last_key else "",
                message=self._message,
                failed=self._failed,
                folder=str(self.session.folder),
            )

    @property
    def toy_s(self) -> float:
        """How long the toy has been heard, by its own clock, in seconds."""
        with self._changed:
            return self._toy_ms / 1000.0

    @property
    def over(self) -> str:
        """Why nothing comes from the toy any more; "" while it may."""
        return self._over

    @property
    def begins_ms(self) -> int | None:
        """When the toy's clock will be at the end of the countdown; None while there is none, or no clock yet."""
        with self._changed:
            if self._state != "countdown" or self._last is None:
                return None
            left = 1000.0 * self.protocol.countdown_s - (self._toy_ms - self._since_ms)
            return self._last.device_ms + round(left)

    @property
    def gaps(self) -> list[dict[str, Any]]:
        """Holes in the stream since this recorder began, as in the sidecars; ``after_row`` counts the stream's rows."""
        with self._changed:
            return list(self._gaps)

    def wait(self, *states: State, timeout_s: float | None = None) -> bool:
        """Wait until the state is one of these, "stopped" included; False when the time ran out."""
        with self._changed:
            return self._changed.wait_for(lambda: self._state in (*states, "stopped"), timeout_s)

    # Commands -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to take frames in. Nothing is recorded before the first `space`.

        Raises:
            DatasetError: when the stream cannot be opened.
        """
        try:
            self._stream = StreamFile(self.session.folder / STREAM_NAME, self.session.layout)
        except OSError as cause:
            self.session.close()
            raise self._refusal(cause) from None
        with self._changed:
            self._log(
                "open",
                software=self._software,
                device=self.device.url,
                speed=self._speed,
                resumed=self.session.standing.resumed,
                row=self._rows,
            )
            self._advance("; ".join(self.session.standing.mended), from_start=True)
        self._reader.start()
        self._writer.start()

    def space(self) -> None:
        """Start the countdown; stop the recording, not within the protocol's shortest_s; cancel a countdown."""
        with self._telling():
            if self._state == "idle":
                if self._silent():
                    self._say("Nothing comes from the toy: is it switched on and near?")
                else:
                    self._begin()
            elif self._state == "countdown":
                self._cancel("The countdown was cancelled.")
            elif self._state == "recording" and self._take is not None:
                passed = max(self._toy_ms - self._since_ms, 1000.0 * self._wall_s())
                if passed < 1000.0 * self.protocol.shortest_s:
                    self._say("That was too quick for a stop: still recording.")
                else:
                    self._stop("space")
            elif self._state == "paused":
                self._say("Paused: go on first (p).")

    def redo(self, why: str = "") -> None:
        """Make the last recording again, or the one that is running; the file that is there stays, set aside."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("The countdown was cancelled.")
            elif self._state == "recording":
                self._abandon("redo", "Broken off: it is to be made again.")
            elif self._state in ("idle", "paused", "finished"):
                key = self._last_key
                file = self._takes.pop(key, "") if key else ""
                if key is None or not file:
                    self._say("There is no recording to make again: go back to it (b).")
                    return
                self._set_aside(key, file, why)
                self._last_key = None
                self._at = next(s.number for s in self.steps if (s.gesture, s.repetition) == key)
                self._ready(f"'{key[0]}', {key[1]}, is to be made again; skip (s) keeps it after all.")

    def skip(self) -> None:
        """Pass over this recording; one that was to be made again is kept after all."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._say("Recording: space stops it, r breaks it off.")
            elif self._state in ("idle", "paused"):
                step = self.steps[self._at]
                key = (step.gesture, step.repetition)
                said = ""
                if key not in self._takes:
                    if self._aside.get(key):
                        file = self._aside[key].pop()
                        self._takes[key] = self._restored(key, file)
                        said = "The earlier recording is kept."
                    else:
                        self._skipped.add(key)
                        self._log("skip", gesture=step.gesture, repetition=step.repetition)
                        said = f"Skipped '{step.gesture}', {step.repetition}; go back to it with b."
                self._advance(said)

    def go(self, number: int) -> None:
        """Go to a recording by its number from 0; one that is there is only replaced when the new one is finished."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._say("Recording: space stops it, r breaks it off.")
            elif self._state in ("idle", "paused", "finished"):
                self._at = min(max(0, number), len(self.steps) - 1)
                step = self.steps[self._at]
                self._log("go", gesture=step.gesture, repetition=step.repetition)
                there = (step.gesture, step.repetition) in self._takes
                self._ready("This one is recorded: space makes it again, s goes on." if there else "")

    def back(self) -> None:
        """Go one recording back."""
        with self._telling():
            self.go(self._at - 1 if self._state != "finished" else len(self.steps) - 1)

    def pause(self) -> None:
        """Pause: nothing starts until `resume`; the stream is kept all the while."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._say("Recording: space stops it first.")
            elif self._state == "idle":
                self._paused = True
                self._log("pause")
                self._enter("paused", "Paused.")

    def resume(self) -> None:
        """End a pause."""
        with self._telling():
            if self._state == "paused":
                self._paused = False
                self._log("resume")
                self._ready("")

    def note(self, text: str) -> None:
        """Keep a remark with the time, the recording that is asked for and the last one made."""
        text = " ".join(text.split())
        with self._telling():
            if text:
                step = self.steps[self._at]
                last = self._takes.get(self._last_key, "") if self._last_key else ""
                self._log("note", text=text, gesture=step.gesture, repetition=step.repetition, file=last)
                self._say("Noted.")

    def say(self, text: str) -> None:
        """Put a sentence on every screen."""
        with self._telling():
            self._say(text)

    def close(self) -> None:
        """End the session's work for now: all is written, a running recording is broken off. Twice is harmless."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            elif self._state == "recording" and not self._failed:
                self._abandon("quit", "")
            if not self._closing:
                self._log("close", rows=self._rows)
            self._closing = True
            self._changed.notify_all()
        for thread in (self._reader, self._writer):
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join()
        if self._stream is not None:
            self._stream.close()
        self.session.close()
        with self._telling():
            if self._state != "stopped":
                self._enter("stopped", self._message)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # What happens (always with the lock) ----------------------------------------------------------------------

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Hold the lock; tell the listeners afterwards, without it, so that they may give commands."""
        with self._changed:
            yield
        self._tell()

    def _tell(self) -> None:
        with self._changed:
            news, self._news = self._news, []
        for what in news:
            for listener in self._listeners:
                # A screen that fails must not end a recording.
                with contextlib.suppress(Exception):
                    listener(what, self.status())

    def _log(self, what: str, **more: Any) -> None:
        self._jobs.append(Event(what, self._now_ms(), more))
        self._news.append(what)
        self._changed.notify_all()

    def _say(self, text: str) -> None:
        self._message = text
        self._news.append("message")
        self._changed.notify_all()

    def _enter(self, state: State, message: str) -> None:
        self._state = state
        self._since_ms = self._toy_ms
        self._message = message
        self._news.append(state)
        self._changed.notify_all()

    def _now_ms(self) -> int:
        return now_ms() if self._speed == 1.0 else self._base_ms + round(self._toy_ms)

    def _wall_s(self) -> float:
        return time.monotonic() - self._take.from_s if self._take is not None else 0.0

    def _silent(self) -> bool:
        return time.monotonic() - self._heard_s > _AWAY_S or getattr(self.device, "state", "") == "waiting"

    def _open_steps(self, after: int) -> list[Step]:
        """Steps without a recording, from ``after`` on and then from the beginning."""
        order = [*self.steps[after:], *self.steps[:after]]
        return [s for s in order if (k := (s.gesture, s.repetition)) not in self._takes and k not in self._skipped]

    def _following(self) -> Step | None:
        return next(iter(s for s in self._open_steps(self._at + 1) if s.number != self._at), None)

    def _advance(self, message: str = "", from_start: bool = False) -> None:
        """On to the next recording that is to be made, or to the end."""
        left = self._open_steps(0 if from_start else self._at + 1)
        if left:
            self._at = left[0].number
            self._ready(message)
        else:
            self._at = len(self.steps) - 1
            self._log("finished", recordings=len(self._takes), skipped=len(self._skipped))
            self._paused = False
            self._enter("stopped" if self._over else "finished", message)

    def _ready(self, message: str) -> None:
        if self._over:
            self._enter("stopped", self._over)
        else:
            self._enter("paused" if self._paused else "idle", message)

    def _begin(self) -> None:
        step = self.steps[self._at]
        self._log(
            "countdown",
            gesture=step.gesture,
            repetition=step.repetition,
            countdown_s=self.protocol.countdown_s,
            device_ms=self._last.device_ms if self._last else None,
        )
        self._enter("countdown", "")

    def _cancel(self, message: str) -> None:
        step = self.steps[self._at]
        self._log("cancel", gesture=step.gesture, repetition=step.repetition)
        self._enter("idle", message)

    def _first_row(self, frame: Frame) -> None:
        step = self.steps[self._at]
        counters = Counters(**self.device.counters.to_dict())
        self._take = Take(step, self._rows, self._toy_ms, time.monotonic(), counters)
        self._log(
            "start",
            gesture=step.gesture,
            repetition=step.repetition,
            row=self._rows,
            host_ms=frame.host_ms,
            device_ms=frame.device_ms,
        )
        self._enter("recording", "")

    def _abandon(self, why: str, message: str) -> None:
        take = self._take
        assert take is not None
        self._take = None
        step = take.step
        self._log("abandon", gesture=step.gesture, repetition=step.repetition, why=why, rows=len(take.frames))
        self._ready(message)

    def _stop(self, ended: Ended) -> None:
        take = self._take
        assert take is not None
        silent_ms = 1000.0 * (time.monotonic() - self._heard_s)
        away = getattr(self.device, "state", "") == "waiting"
        if away or (self._speed == 1.0 and silent_ms > 1000.0 * _AWAY_S):
            take.gaps.append(gap_entry(len(take.frames), take.frames[-1], None, silent_ms, "nothing came any more"))
        self._take = None
        self._jobs.append(_Save(take, ended, Counters(**self.device.counters.to_dict())))
        self._enter("saving", "")

    def _set_aside(self, key: Key, file: str, why: str) -> None:
        self._aside.setdefault(key, []).append(file)
        more = {"why": why} if why else {}
        self._log("redo", file=file, gesture=key[0], repetition=key[1], **more)

    def _restored(self, key: Key, file: str) -> str:
        self._log("keep", file=file, gesture=key[0], repetition=key[1])
        self._last_key = key
        return file

    # Taking in ------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        """The reader's thread: frames as they come, whatever the screen and the disk are doing."""
        over = "The toy's data have ended."
        try:
            while not self._closing:
                frames = self.device.read()
                if frames is None:
                    break
                with self._telling():
                    for frame in frames:
                        self._one(frame)
                    if frames:
                        self._heard_s = time.monotonic()
                        self._meter.heard(self.device.counters, self._heard_s)
                        self._changed.notify_all()
                    # A toy that runs faster than the clock must not run away from the disk.
                    while self._speed != 1.0 and self._pending and not self._closing:
                        self._changed.wait(0.05)
        except PlushSenseError as cause:
            over = str(cause)
        except Exception as cause:  # noqa: BLE001 (a thread that dies unseen would lose the rest of the session)
            over = f"Reading the toy failed ({type(cause).__name__}: {cause}): what came until then is kept."
        with self._telling():
            if self._closing:
                return
            self._over = over
            if self._state == "recording":
                self._stop("toy")
            elif self._state not in ("saving", "stopped"):
                self._enter("stopped", over)

    def _one(self, came: Frame) -> None:
        """One frame: stamped, kept, and what it brings about."""
        layout, last = self.session.layout, self._last
        step_ms = came.device_ms - last.device_ms if last else 0
        on_host = came.host_ms - last.host_ms if last and self._speed == 1.0 else 0
        passed = step_ms if step_ms >= 0 else max(on_host, round(1000.0 / layout.rate_hz))
        self._toy_ms += passed
        host = came.host_ms if self._speed == 1.0 else self._base_ms + round(self._toy_ms)
        frame = Frame(host, came.device_ms, came.values)
        missing = self._loss.push(came.device_ms)
        self._lost += missing
        if last is not None and (step_ms < 0 or step_ms > layout.gap_ms or self._returned()):
            self._gap(last, frame, max(step_ms, on_host))
        self._meter.push(came.device_ms)
        if self._state == "countdown" and self._toy_ms - self._since_ms >= 1000.0 * self.protocol.countdown_s:
            self._first_row(frame)
        elif self._take is not None:
            self._take.lost += missing
        self._last = frame
        if not self._pending:
            self._pending_s, self._pending_ms = time.monotonic(), self._toy_ms
        self._pending.append(frame)
        self._rows += 1
        if self._take is not None:
            self._take.frames.append(frame)
        waited = (self._toy_ms - self._since_ms) / 1000.0
        if self._state == "recording":
            if self._auto is not None and waited >= self._auto.take_s:
                self._stop("auto")
            elif waited >= self.protocol.longest_s:
                self._stop("longest")
        elif self._state == "idle" and self._auto is not None and waited >= self._auto.rest_s:
            self._begin()

    def _returned(self) -> bool:
        """Whether the toy was away since the frame before."""
        before, self._reconnects = self._reconnects, self.device.counters.reconnects
        return self._reconnects > before

    def _gap(self, last: Frame, frame: Frame, missing_ms: float) -> None:
        began_anew = "the toy's clock began anew" if frame.device_ms < last.device_ms else "nothing came"
        away = [g for g in getattr(self.device, "gaps", ()) if g.reason]
        reason = away[-1].reason if away and away[-1].host_ms_end is not None and missing_ms > 500 else began_anew
        entry = gap_entry(self._rows, last, frame, missing_ms, reason)
        self._gaps.append(entry)
        step = self.steps[self._at]
        during = {"gesture": step.gesture, "repetition": step.repetition} if self._take is not None else {}
        self._log("gap", **entry, **during)
        if self._take is not None:
            self._take.gaps.append(gap_entry(len(self._take.frames), last, frame, missing_ms, reason))
        if missing_ms >= 1000.0 * _AWAY_S:
            said = f"The toy was away for {missing_ms / 1000.0:.1f} s"
            if self._state == "countdown":
                self._cancel(f"{said}: press space again.")
            elif self._state == "recording":
                self._say(f"{said}: this recording has a hole; r makes it again.")
            else:
                self._say(f"{said}.")

    # Writing --------------------------------------------------------------------------------------------------

    def _write(self) -> None:
        """The writer's thread: the stream first, then what was finished, then what happened."""
        while True:
            with self._changed:
                while not (self._jobs or self._closing or self._due()):
                    self._changed.wait(0.1)
                frames, self._pending = self._pending, []
                jobs, self._jobs = self._jobs, []
                last = self._closing and not self._reader.is_alive()
                self._changed.notify_all()
                if self._closing and not last:
                    self._changed.wait(0.01)
            try:
                assert self._stream is not None
                self._stream.write(frames)
                events: list[Event] = []
                for job in jobs:
                    if isinstance(job, _Save):
                        self.session.log.write(events)
                        events = []
                        self._save(job)
                    else:
                        events.append(job)
                self.session.log.write(events)
            except Exception as cause:  # noqa: BLE001 (whatever stops the writing must stop the session, loudly)
                self._fail(cause)
                return
            if last and not self._jobs:
                return

    def _due(self) -> bool:
        if not self._pending:
            return False
        old = time.monotonic() - self._pending_s >= FLUSH_S or self._toy_ms - self._pending_ms >= 1000.0 * FLUSH_S
        return old or self._speed != 1.0

    def _save(self, job: _Save) -> None:
        """One recording to the disk, then on to the next."""
        take, layout, head = job.take, self.session.layout, self.session.head
        step = take.step
        key = (step.gesture, step.repetition)
        frames = to_frames(take.frames, layout.n_channels)
        with self._changed:
            saved_ms = self._now_ms()
        more = {
            "saved_ms": saved_ms,
            "device": self.device.url,
            "speed": self._speed,
            "software": self._software,
        }
        beside = sidecar(take, frames, layout, head, job.counters, job.ended, **more)
        path = save_take(self.session.folder, frames, layout, step.gesture, saved_ms, beside)
        says = {"rows": len(frames), "lost": take.lost, "gaps": len(take.gaps), "ended": job.ended}
        events = [Event("take", saved_ms, {"file": path.name, "gesture": key[0], "repetition": key[1]} | says)]
        earlier = self._takes.get(key)
        if earlier:
            events.append(Event("redo", saved_ms, {"file": earlier, "gesture": key[0], "repetition": key[1]}))
        self.session.log.write(events)
        said = ""
        if job.ended == "longest":
            said = f"Nobody stopped it: it ended by itself after {self.protocol.longest_s:g} s; r makes it again."
        elif take.gaps:
            longest = max(g["missing_ms"] for g in take.gaps) / 1000.0
            said = f"This recording has a hole of {longest:.1f} s; it is kept, r makes it again."
        with self._telling():
            if earlier:
                self._aside.setdefault(key, []).append(earlier)
            self._takes.pop(key, None)
            self._takes[key] = path.name
            self._skipped.discard(key)
            self._last_key = key
            self._news.append("take")
            self._advance(said)

    def _refusal(self, cause: Exception) -> DatasetError:
        why = getattr(cause, "strerror", None) or cause
        return DatasetError(
            f"'{self.session.folder}' cannot be written any more ({why}): the session has stopped. "
            f"What was recorded until then is kept ({len(self._takes)} recordings); "
            "make room, and give the same command to go on."
        )

    def _fail(self, cause: Exception) -> None:
        with contextlib.suppress(OSError):
            self.session.log.write([Event("failed", now_ms(), {"why": str(cause)})])
        with self._telling():
            self._failed = str(self._refusal(cause))
            self._closing = True
            self._take = None
            self._enter("stopped", self._failed)
