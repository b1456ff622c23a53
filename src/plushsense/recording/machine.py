"""What happens in a session while it is recorded: states, takes and the frames that move them on.

The recorder's inner half; `plushsense.recording.engine` has the commands. Nobody waits for another: one thread takes
the toy's frames in, the keeper's write. All times of a session run on the toy's own clock, so that a virtual toy at
twenty times the speed counts down in a twentieth of the time, and a toy that is unplugged during the countdown does
not start a recording of nothing.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from plushsense.core.errors import PlushSenseError
from plushsense.devices.base import Counters, Device, Frame, now_ms
from plushsense.recording.course import Course, key_of
from plushsense.recording.intake import AWAY_S, Intake
from plushsense.recording.keeper import Keeper
from plushsense.recording.saving import keep_take, refusal
from plushsense.recording.session import OpenSession
from plushsense.recording.sessionfile import Event
from plushsense.recording.status import State, Status
from plushsense.recording.take import Ended, Take, gap_entry

Listener = Callable[[str, Status], None]


@dataclass(frozen=True)
class Auto:
    """The recorder presses its own space bar: ``rest_s`` after it is ready, and ``take_s`` after a recording began."""

    take_s: float = 5.0
    rest_s: float = 1.0


class Machine:
    """A session's state and how it changes; a `Recorder` is driven through its commands. Arguments: see there."""

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
        self._speed = speed
        self._auto = auto
        self._software = software
        self._changed = threading.Condition(threading.RLock())
        self._listeners: list[Listener] = []
        self._news: list[str] = []
        standing = session.standing
        self._course = Course(self.protocol.steps(), standing)
        self._intake = Intake(device, session.layout, speed, standing.rows, standing.host_ms)
        self._take: Take | None = None
        self._since_ms = 0.0
        self._state: State = "idle"
        self._paused = False
        self._message = ""
        self._over = ""
        self._failed = ""
        self._closing = False
        self._came: list[Frame] = []
        self._keeper: Keeper | None = None
        self._reader = threading.Thread(target=self._read, name="plushsense-reader", daemon=True)

    # For whoever shows it -------------------------------------------------------------------------------------

    def listen(self, listener: Listener) -> None:
        """Call ``listener(what, status)`` at every change, from whichever thread made it; it must not block."""
        self._listeners.append(listener)

    def unlisten(self, listener: Listener) -> None:
        """Call it no more: a page that was closed or loaded again."""
        with contextlib.suppress(ValueError):
            self._listeners.remove(listener)

    def status(self) -> Status:
        """Everything there is to show, at this moment."""
        with self._changed:
            course = self._course
            counters = self.device.counters
            quality = self._intake.quality()
            passed = self._passed_s()
            counting, running = self._state == "countdown", self._state == "recording"
            return Status(
                state=self._state,
                step=course.step,
                steps=len(course.steps),
                repetitions=self.protocol.repetitions,
                following=course.following(),
                done=len(course.takes),
                skipped=len(course.skipped),
                redone=course.redone,
                already=course.takes.get(key_of(course.step), ""),
                countdown_s=max(0.0, self.protocol.countdown_s - passed) if counting else 0.0,
                elapsed_s=max(passed, self._wall_s()) if running else 0.0,
                left_s=max(0.0, self.protocol.longest_s - passed) if running else 0.0,
                rate_hz=quality.rate_hz,
                jitter_ms=quality.jitter_ms,
                signal=quality.signal,
                away=self._intake.away,
                lost=self._intake.lost,
                malformed=counters.malformed,
                garbage=counters.garbage,
                reconnects=counters.reconnects,
                gaps=len(self._intake.gaps),
                rows=self._intake.rows,
                file=course.last_file,
                message=self._message,
                failed=self._failed,
                folder=str(self.session.folder),
                heard=counters.frames,
                bad_share=quality.bad_share,
            )

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
            for listener in tuple(self._listeners):
                # A screen that fails must not end a recording.
                with contextlib.suppress(Exception):
                    listener(what, self.status())

    def _log(self, what: str, **more: Any) -> None:
        if self._keeper is not None:
            self._keeper.do(Event(what, self._intake.now_ms(), more))
        self._news.append(what)

    def _log_step(self, what: str, **more: Any) -> None:
        step = self._course.step
        self._log(what, gesture=step.gesture, repetition=step.repetition, **more)

    def _say(self, text: str) -> None:
        self._message = text
        self._news.append("message")
        self._changed.notify_all()

    def _enter(self, state: State, message: str) -> None:
        if self._failed:
            # Also for a recording that was still being saved when the stream could not be written any more.
            state, message = "stopped", self._failed
        self._state = state
        self._since_ms = self._intake.toy_ms
        self._message = message
        self._news.append(state)
        self._changed.notify_all()

    def _wall_s(self) -> float:
        return time.monotonic() - self._take.from_s if self._take is not None else 0.0

    def _passed_s(self) -> float:
        """Since the state was entered, by the toy's clock."""
        return (self._intake.toy_ms - self._since_ms) / 1000.0

    def _advance(self, message: str = "", from_start: bool = False) -> None:
        """On to the next recording that is to be made, or to the end."""
        if self._course.advance(from_start):
            self._ready(message)
        else:
            self._log("finished", recordings=len(self._course.takes), skipped=len(self._course.skipped))
            self._paused = False
            self._enter("stopped" if self._over else "finished", message)

    def _ready(self, message: str) -> None:
        if self._over:
            self._enter("stopped", self._over)
        else:
            self._enter("paused" if self._paused else "idle", message)

    def _begin(self) -> None:
        now = self._intake.last.device_ms if self._intake.last else None
        self._log_step("countdown", countdown_s=self.protocol.countdown_s, device_ms=now)
        self._enter("countdown", "")

    def _cancel(self, message: str) -> None:
        self._log_step("cancel")
        self._enter("idle", message)

    def _first_row(self, frame: Frame, row: int) -> None:
        counters = Counters(**self.device.counters.to_dict())
        self._take = Take(self._course.step, row, time.monotonic(), counters)
        self._log_step("start", row=row, host_ms=frame.host_ms, device_ms=frame.device_ms)
        self._enter("recording", "")

    def _abandon(self, why: str, message: str) -> None:
        take = self._take
        assert take is not None
        self._take = None
        self._log_step("abandon", why=why, rows=len(take.frames))
        self._ready(message)

    def _stop(self, ended: Ended) -> None:
        take = self._take
        assert take is not None
        # A recording that a frame has ended is not silent: that frame's hole, if any, is known.
        waiting = self._intake.away or (self._speed == 1.0 and self._intake.silent)
        if waiting and ended in ("space", "toy"):
            silent_ms = self._intake.silent_ms
            take.gaps.append(gap_entry(len(take.frames), take.frames[-1], None, silent_ms, "nothing came any more"))
        self._take = None
        counters = Counters(**self.device.counters.to_dict())
        self._enter("saving", "")
        self._hand_on()
        if self._keeper is not None:
            self._keeper.do(lambda: self._save(take, ended, counters))

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
                    self._intake.listened()
                    if frames:
                        self._hand_on()
                        self._intake.heard()
                if self._keeper is not None:
                    self._keeper.wait_written()
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

    def _one(self, frame: Frame) -> None:
        """One frame, and what it brings about."""
        row = self._intake.rows
        frame, missing, gap = self._intake.take_in(frame)
        if gap is not None:
            self._gap(gap)
        if self._state == "countdown" and self._passed_s() >= self.protocol.countdown_s:
            self._first_row(frame, row)
        elif self._take is not None:
            self._take.lost += missing
        self._came.append(frame)
        if self._take is not None:
            self._take.frames.append(frame)
        if self._state == "recording":
            if self._auto is not None and self._passed_s() >= self._auto.take_s:
                self._stop("auto")
            elif self._passed_s() >= self.protocol.longest_s:
                self._stop("longest")
        elif self._state == "idle" and self._auto is not None and self._passed_s() >= self._auto.rest_s:
            self._begin()

    def _hand_on(self) -> None:
        """Give the keeper what has come, before anything that must stand behind it."""
        if self._keeper is not None and self._came:
            self._keeper.add(self._came, self._intake.toy_ms)
        self._came = []

    def _gap(self, gap: dict[str, Any]) -> None:
        """A hole in the stream: kept with the session and the recording, and told."""
        (self._log_step if self._take is not None else self._log)("gap", **gap)
        if self._take is not None:
            self._take.gaps.append(gap | {"after_row": len(self._take.frames)})
        if gap["missing_ms"] >= 1000.0 * AWAY_S:
            said = f"The toy was away for {gap['missing_ms'] / 1000.0:.1f} s"
            if self._state == "countdown":
                self._cancel(f"{said}: press space again.")
            elif self._state == "recording":
                self._say(f"{said}: this recording has a hole; r makes it again.")
            else:
                self._say(f"{said}.")

    # Writing --------------------------------------------------------------------------------------------------

    def _save(self, take: Take, ended: Ended, counters: Counters) -> None:
        """One recording to the disk (in the keeper's thread), then on to the next."""
        key = key_of(take.step)
        with self._changed:
            saved_ms = self._intake.now_ms()
            earlier = self._course.takes.get(key, "")
        more = {"device": self.device.url, "speed": self._speed, "software": self._software}
        file, said = keep_take(self.session, take, counters, ended, saved_ms, earlier, **more)
        with self._telling():
            self._course.made(key, file)
            self._news.append("take")
            self._advance(said)

    def _fail(self, cause: Exception) -> None:
        with contextlib.suppress(OSError):
            self.session.log.write([Event("failed", now_ms(), {"why": str(cause)})])
        with self._telling():
            self._failed = str(refusal(self.session, len(self._course.takes), cause))
            self._closing = True
            self._take = None
            self._enter("stopped", self._failed)
