"""The recorder: an engine that a terminal or a web page drives with a few commands and looks at through a status.

Whoever calls a command is answered at once; what it brings about is in `plushsense.recording.machine`.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

from plushsense.core.recfile import STREAM_NAME
from plushsense.devices.base import Device
from plushsense.recording.course import key_of
from plushsense.recording.keeper import Keeper
from plushsense.recording.machine import Auto, Listener, Machine
from plushsense.recording.saving import refusal
from plushsense.recording.session import OpenSession
from plushsense.recording.sessionfile import SessionHead
from plushsense.recording.status import State, StepStanding
from plushsense.recording.writer import StreamFile

__all__ = ["Auto", "Listener", "Recorder"]


class Recorder(Machine):
    """One session being recorded. Use it as a context manager; commands may come from any thread.

    Args:
        session: its folder, opened; the recorder closes it.
        device: the toy; the caller closes it.
        speed: times real time at which the toy runs. At 1, rows carry the computer's clock; at any other the
            computer's clock means nothing, and rows are stamped with the toy's time since the start.
        auto: press the space bar, too.
        software: to stand in the log and the sidecars.
    """

    @classmethod
    def open(cls, folder: Path, device: Device, head: SessionHead | None = None, **options: Any) -> Recorder:
        """A recorder for the session in ``folder``: a new one of ``head``, or the one that is there.

        Raises:
            DatasetError: when another program has it, ``head`` is of another session, or the disk refuses.
        """
        return cls(OpenSession(folder, head), device, **options)

    # For whoever shows it -------------------------------------------------------------------------------------

    @property
    def toy_s(self) -> float:
        """How long the toy has been heard, by its own clock, in seconds."""
        with self._changed:
            return self._intake.toy_ms / 1000.0

    def steps(self) -> tuple[StepStanding, ...]:
        """All recordings of the plan, in order, and what came of each."""
        with self._changed:
            course = self._course
            return tuple(
                StepStanding(s, course.takes.get(k, ""), k in course.skipped, len(course.aside.get(k, ())))
                for s in course.steps
                for k in (key_of(s),)
            )

    @property
    def over(self) -> str:
        """Why nothing comes from the toy any more; "" while it may."""
        return self._over

    @property
    def begins_ms(self) -> int | None:
        """When the toy's clock will be at the end of the countdown; None while there is none, or no clock yet."""
        with self._changed:
            last = self._intake.last
            if self._state != "countdown" or last is None:
                return None
            return last.device_ms + round(1000.0 * (self.protocol.countdown_s - self._passed_s()))

    @property
    def gaps(self) -> list[dict[str, Any]]:
        """Holes in the stream since this recorder began, as in the sidecars; ``after_row`` counts the stream's rows."""
        with self._changed:
            return list(self._intake.gaps)

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
            stream = StreamFile(self.session.folder / STREAM_NAME, self.session.layout)
        except OSError as cause:
            self.session.close()
            raise refusal(self.session, len(self._course.takes), cause) from None
        self._keeper = Keeper(stream, self.session.log, hurried=self._speed != 1.0, on_fail=self._fail)
        with self._changed:
            self._log(
                "open",
                software=self._software,
                device=self.device.url,
                speed=self._speed,
                resumed=self.session.standing.resumed,
                row=self._intake.rows,
            )
            self._advance("; ".join(self.session.standing.mended), from_start=True)
        self._reader.start()

    def space(self) -> None:
        """Start the countdown; stop the recording, not within the protocol's shortest_s; cancel a countdown."""
        with self._telling():
            if self._state == "idle":
                if self._intake.quality().signal == "unreadable":
                    self._say(
                        f"The toy sends lines, but none is a frame of {self.session.layout.name} "
                        f"({len(self.session.layout.wire)} numbers): is the layout right, and the cable sound?"
                    )
                elif self._intake.silent:
                    self._say("Nothing comes from the toy: is it switched on and near?")
                else:
                    self._begin()
            elif self._state == "countdown":
                self._cancel("The countdown was cancelled.")
            elif self._state == "recording" and self._take is not None:
                if max(self._passed_s(), self._wall_s()) < self.protocol.shortest_s:
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
                key = self._course.last
                if key is None:
                    self._say("There is no recording to make again: go back to it (b).")
                    return
                file = self._course.set_aside(key)
                more = {"why": why} if why else {}
                self._log("redo", file=file, gesture=key[0], repetition=key[1], **more)
                self._ready(f"'{key[0]}', {key[1]}, is to be made again; skip (s) keeps it after all.")

    def skip(self) -> None:
        """Pass over this recording; one that was to be made again is kept after all."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._say("Recording: space stops it, r breaks it off.")
            elif self._state in ("idle", "paused"):
                key = key_of(self._course.step)
                said = ""
                if file := self._course.keep(key):
                    self._log("keep", file=file, gesture=key[0], repetition=key[1])
                    said = "The earlier recording is kept."
                elif key not in self._course.takes:
                    self._course.skipped.add(key)
                    self._log_step("skip")
                    said = f"Skipped '{key[0]}', {key[1]}; go back to it with b."
                self._advance(said)

    def go(self, number: int) -> None:
        """Go to a recording by its number from 0; one that is there is only replaced when the new one is finished."""
        with self._telling():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._say("Recording: space stops it, r breaks it off.")
            elif self._state in ("idle", "paused", "finished"):
                self._course.at = min(max(0, number), len(self._course.steps) - 1)
                self._log_step("go")
                there = key_of(self._course.step) in self._course.takes
                self._ready("This one is recorded: space makes it again, s goes on." if there else "")

    def back(self) -> None:
        """Go one recording back."""
        with self._changed:
            number = self._course.at - (self._state != "finished")
        self.go(number)

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
                self._enter("paused", "")

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
            if text and (self._closing or self._state == "stopped"):
                self._say("The session has ended: this remark is not kept.")
            elif text:
                self._log_step("note", text=text, file=self._course.last_file)
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
            last, self._closing = not self._closing, True
        if self._reader.is_alive():
            self._reader.join()
        if last:
            with self._telling():
                self._log("close", rows=self._intake.rows)
        if self._keeper is not None:
            self._keeper.close()
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
