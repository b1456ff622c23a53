"""The recorder, which a terminal or a web page drives by commands and displays by its status.

Commands return at once; their effects are in `plushsense.recording.states`.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

from plushsense.core.recorder_csv import STREAM_NAME
from plushsense.devices.base import Device
from plushsense.recording.session import OpenSession
from plushsense.recording.session_files import SessionHead
from plushsense.recording.states import RecorderState, RecordingMachine, StepResult, key_of, write_error
from plushsense.recording.writer import BackgroundWriter, StreamFile


class Recorder(RecordingMachine):
    """Record one session. Use it as a context manager; commands may come from any thread.

    Args:
        session: its open folder; the recorder closes it.
        device: the toy; the caller closes it.
        speed: times real time at which the toy runs. At 1, rows carry the computer's time; at any other speed they
            carry the toy's time since the start.
        auto: start and stop recordings automatically.
        software: name and version of the program, for the log and the sidecars.
    """

    @classmethod
    def open(cls, folder: Path, device: Device, head: SessionHead | None = None, **options: Any) -> Recorder:
        """Return a recorder for the session in ``folder``: a new one of ``head``, or the existing one.

        Raises:
            DatasetError: when another program has it, ``head`` is of another session, or the disk refuses.
        """
        return cls(OpenSession(folder, head), device, **options)

    # Status --------------------------------------------------------------------------------------------------

    @property
    def toy_s(self) -> float:
        """Seconds during which the toy has sent frames, by its own clock."""
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
    def over(self) -> str:
        """Why the toy sends no more data; "" while it may."""
        return self._over

    @property
    def begins_ms(self) -> int | None:
        """The toy's clock at the end of the countdown; None without a countdown, or before the first frame."""
        with self._changed:
            last = self._receiver.last
            if self._state != "countdown" or last is None:
                return None
            return last.device_ms + round(1000.0 * (self.protocol.countdown_s - self._passed_s()))

    @property
    def gaps(self) -> list[dict[str, Any]]:
        """Gaps of the stream since this recorder began, as in the sidecars; ``after_row`` counts the stream's rows."""
        with self._changed:
            return list(self._receiver.gaps)

    def wait(self, *states: RecorderState, timeout_s: float | None = None) -> bool:
        """Wait until the state is one of ``states`` or "stopped"; return False after ``timeout_s``."""
        with self._changed:
            return self._changed.wait_for(lambda: self._state in (*states, "stopped"), timeout_s)

    # Commands -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to read frames. Nothing is recorded before the first `space`.

        Raises:
            DatasetError: when the stream cannot be opened.
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
            on_wait=self._wait_for_descriptor,
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
            self._advance("; ".join(self.session.progress.repairs), from_start=True)
        self._reader.start()

    def space(self) -> None:
        """Start the countdown, cancel it, or stop the recording, though not within the protocol's shortest_s."""
        with self._notifying():
            if self._state == "idle":
                if self._receiver.quality().signal == "unreadable":
                    self._show_message(
                        f"The toy sends lines, but none is a frame of {self.session.layout.name} "
                        f"({len(self.session.layout.wire)} numbers): is the layout right, and the cable sound?"
                    )
                elif self._receiver.silent:
                    self._show_message("Nothing comes from the toy: is it switched on and near?")
                else:
                    self._begin()
            elif self._state == "countdown":
                self._cancel("The countdown was cancelled.")
            elif self._state == "recording" and self._take is not None:
                if max(self._passed_s(), self._wall_s()) < self.protocol.shortest_s:
                    self._show_message("Too early to stop: still recording.")
                else:
                    self._stop("space")
            elif self._state == "paused":
                self._show_message("Paused: resume first (p).")

    def redo(self, why: str = "") -> None:
        """Repeat the last recording, or the current one; the existing file is kept as discarded."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel("The countdown was cancelled.")
            elif self._state == "recording":
                self._abandon("redo", "Stopped: record it again.")
            elif self._state in ("idle", "paused", "finished"):
                key = self._plan.last
                if key is None:
                    self._show_message("There is no recording to repeat: go back to it (b).")
                    return
                file = self._plan.discard(key)
                more = {"why": why} if why else {}
                self._log("redo", file=file, gesture=key[0], repetition=key[1], **more)
                self._ready(f"'{key[0]}', {key[1]}, is to be recorded again; skip (s) keeps the earlier recording.")

    def skip(self) -> None:
        """Skip this step; a recording that was to be repeated is kept."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._show_message("Recording: space stops it, r discards it.")
            elif self._state in ("idle", "paused"):
                key = key_of(self._plan.step)
                message = ""
                if file := self._plan.keep(key):
                    self._log("keep", file=file, gesture=key[0], repetition=key[1])
                    message = "The earlier recording is kept."
                elif key not in self._plan.takes:
                    self._plan.skipped.add(key)
                    self._log_step("skip")
                    message = f"Skipped '{key[0]}', {key[1]}; go back to it with b."
                self._advance(message)

    def go(self, number: int) -> None:
        """Go to a step by its number from 0; an existing recording is replaced only when the new one is finished."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel("")
            if self._state == "recording":
                self._show_message("Recording: space stops it, r discards it.")
            elif self._state in ("idle", "paused", "finished"):
                self._plan.at = min(max(0, number), len(self._plan.steps) - 1)
                self._log_step("go")
                there = key_of(self._plan.step) in self._plan.takes
                self._ready("This step is recorded: space records it again, s goes on." if there else "")

    def back(self) -> None:
        """Go one step back."""
        with self._changed:
            number = self._plan.at - (self._state != "finished")
        self.go(number)

    def pause(self) -> None:
        """Pause: nothing starts until `resume`; the stream is kept all the while.

        A recording that is running is abandoned: its rows are in the stream only, and `resume` asks for it again.
        """
        with self._notifying():
            if self._state == "countdown":
                self._cancel("")
            if self._state not in ("idle", "recording"):
                return
            self._paused = True
            if self._state == "recording":
                self._abandon("pause", "The pause stopped this recording: record it again.")
            else:
                self._enter("paused", "")
            self._log("pause")

    def resume(self) -> None:
        """End a pause."""
        with self._notifying():
            if self._state == "paused":
                self._paused = False
                self._log("resume")
                self._ready("")

    def note(self, text: str) -> None:
        """Log a remark with the time, the current step and the last recording."""
        text = " ".join(text.split())
        with self._notifying():
            if text and (self._closing or self._state == "stopped"):
                self._show_message("The session has ended: this note is not saved.")
            elif text:
                self._log_step("note", text=text, file=self._plan.last_file)
                self._show_message("Note saved.")

    def show_message(self, text: str) -> None:
        """Show a sentence on every display."""
        with self._notifying():
            self._show_message(text)

    def close(self) -> None:
        """Close the session: abandon a running recording and write everything else. Closing twice is harmless."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel("")
            elif self._state == "recording" and not self._failed:
                self._abandon("quit", "")
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
