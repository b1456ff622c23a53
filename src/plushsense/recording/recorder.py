"""Recorder with the commands for the terminal and the studio, and preparation of a session from a request.

Commands do not wait for their effects, which `plushsense.recording.states` implements.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import STREAM_NAME
from plushsense.core.sentences import Sentence
from plushsense.devices.base import Device, now_ms
from plushsense.devices.opening import open_device, parse_url
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.recording.plan import load_protocol
from plushsense.recording.session import OpenSession, check_session, check_subject, new_session, next_session
from plushsense.recording.session_files import SessionHead
from plushsense.recording.states import RecorderState, RecorderStatus, RecordingMachine, StepResult, key_of, write_error
from plushsense.recording.writer import BackgroundWriter, StreamFile

_NO_DESCRIPTOR = Sentence(
    "Too many files are open on this computer: saving waits until some are closed. Nothing is lost.", "saving_waits"
)
_RECORDING = Sentence("Recording: space stops it, r discards it.", "recording_first")
_CANCELLED = Sentence("The countdown was cancelled.", "cancelled")


class Recorder(RecordingMachine):
    """Recorder of one session. Use it as a context manager; its commands may be called from any thread.

    Args:
        session: the open folder of the session, which the recorder closes.
        device: the toy, which the caller closes.
        speed: the speed of the toy as a multiple of real time. At 1, rows have the computer's time; at any other speed
            they have the start time plus the toy's time since then.
        auto: settings to start and stop recordings automatically; None to do it by commands.
        software: name and version of the program, for the log and the sidecars.
    """

    @classmethod
    def open(cls, folder: Path, device: Device, head: SessionHead | None = None, **options: Any) -> Recorder:
        """Open the session in ``folder`` as `OpenSession` does, and return its recorder."""
        return cls(OpenSession(folder, head), device, **options)

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
    def gaps(self) -> list[dict[str, Any]]:
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
            self._advance(Sentence("; ".join(repairs), "repaired", n=len(repairs)), from_start=True)
        self._reader.start()

    def space(self) -> None:
        """Start the countdown, cancel it, or stop the recording if it has lasted the protocol's ``shortest_s``."""
        with self._notifying():
            if self._state == "idle":
                if self._receiver.quality().signal == "unreadable":
                    layout, fields = self.session.layout.name, len(self.session.layout.wire)
                    sentence = (
                        f"The toy sends lines, but none is a frame of {layout} ({fields} numbers): "
                        "is the layout right, and the cable sound?"
                    )
                    unread = self.device.mismatch or Sentence(sentence, "unreadable", layout=layout, n=fields)
                    self._show_message(unread)
                elif self._receiver.silent:
                    sentence = "Nothing comes from the toy: is it switched on and near?"
                    self._show_message(Sentence(sentence, "silent"))
                else:
                    self._begin()
            elif self._state == "countdown":
                self._cancel(_CANCELLED)
            elif self._state == "recording" and self._take is not None:
                if max(self._passed_s(), self._wall_s()) < self.protocol.shortest_s:
                    self._show_message(Sentence("Too early to stop: still recording.", "too_early"))
                else:
                    self._stop("space")
            elif self._state == "paused":
                self._show_message(Sentence("Paused: resume first (p).", "paused"))

    def redo(self, why: str = "") -> None:
        """Record again: stop the running recording, or else discard the last one, whose file is kept."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel(_CANCELLED)
            elif self._state == "recording":
                self._abandon("redo", Sentence("Stopped: record it again.", "broken_off"))
            elif self._state in ("idle", "paused", "finished"):
                key = self._plan.last
                if key is None:
                    sentence = "There is no recording to repeat: go back to it (b)."
                    self._show_message(Sentence(sentence, "nothing_to_repeat"))
                    return
                file = self._plan.discard(key)
                more = {"why": why} if why else {}
                self._log("redo", file=file, gesture=key[0], repetition=key[1], **more)
                sentence = f"'{key[0]}', {key[1]}, is to be recorded again; skip (s) keeps the earlier recording."
                self._ready(Sentence(sentence, "again", gesture=key[0], n=key[1]))

    def skip(self) -> None:
        """Skip this step; if it was to be recorded again, use the earlier recording."""
        with self._notifying():
            if self._state == "countdown":
                self._cancel()
            if self._state == "recording":
                self._show_message(_RECORDING)
            elif self._state in ("idle", "paused"):
                key = key_of(self._plan.step)
                message = Sentence()
                if file := self._plan.keep(key):
                    self._log("keep", file=file, gesture=key[0], repetition=key[1])
                    message = Sentence("The earlier recording is kept.", "kept")
                elif key not in self._plan.takes:
                    self._plan.skipped.add(key)
                    self._log_step("skip")
                    sentence = f"Skipped '{key[0]}', {key[1]}; go back to it with b."
                    message = Sentence(sentence, "skipped", gesture=key[0], n=key[1])
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
                sentence = "This step is recorded: space records it again, s goes on."
                self._ready(Sentence(sentence, "recorded_already") if there else None)

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
                sentence = "The pause stopped this recording: record it again."
                self._abandon("pause", Sentence(sentence, "broken_off_by_pause"))
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
                message = "The toy can be exchanged only between two recordings, for one of the same layout."
                raise ConfigError(message, reason="no_exchange")
            former, self.device = self.device, device
            self._receiver.exchange(device)
            self._log("exchange", device=device.url, former=former.url, row=self._receiver.rows)
            message_to_all = Sentence("The session goes on with another toy.", "exchanged")
            over, self.over = self.over, Sentence()
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
            self._show_message(Sentence("Marked for the video.", "marked"))

    def note(self, text: str) -> None:
        """Log a remark with the time, the current step and the last recording."""
        text = " ".join(text.split())
        with self._notifying():
            if text and (self._closing or self._state == "stopped"):
                sentence = "The session has ended: this note is not saved."
                self._show_message(Sentence(sentence, "note_too_late"))
            elif text:
                self._log_step("note", text=text, file=self._plan.last_file)
                self._show_message(Sentence("Note saved.", "note_saved"))

    def show_message(self, message: Sentence) -> None:
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


_SIMULATED = "virtual"


def open_toy(url: str, layout: Layout | str | None = None) -> Device:
    """Open a toy by its URL with `open_device`; if it is disconnected later, wait for it and record the gap."""
    return open_device(url, layout, reconnect=True)


def is_virtual(url: str) -> bool:
    """Return whether a URL opens a virtual toy in this process."""
    return parse_url(url).scheme == _SIMULATED


def with_speed(url: str, speed: float) -> str:
    """Return ``url`` with ``speed`` if it is of a virtual or replayed toy and has no speed, else unchanged."""
    address = parse_url(url)
    if address.scheme not in (_SIMULATED, "replay") or "speed" in address.query:
        return url
    return f"{url}{'&' if '?' in url else '?'}speed={speed:g}"


def speed_of(url: str) -> float:
    """Return the speed in the URL of a virtual or replayed toy; 1 for any other."""
    address = parse_url(url)
    return address.number("speed", 1.0) if address.scheme in (_SIMULATED, "replay") else 1.0


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


PROTOCOL = "plush-17"
"""The default protocol of a new session."""
FASTEST = 1000.0


@dataclass(frozen=True)
class SessionRequest:
    """Request of the terminal or the studio for a recording session.

    ``device`` is the toy's URL, ``subject`` a code ("" for a protocol that is recorded without a person). Without
    ``protocol``, ``words`` or ``layout``, a continued session keeps its own, and a new one has `PROTOCOL`, its default
    wording, and the layout of the URL or plush-15. The toy runs at ``speed`` times real time. ``simulated`` marks a
    virtual toy that cannot be recognised by its URL.
    """

    device: str
    subject: str = ""
    protocol: str = ""
    words: str = ""
    layout: str = ""
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    speed: float = 1.0
    simulated: bool = False


def check_speed(speed: float) -> float:
    """Return ``speed`` if it is valid, else raise ConfigError."""
    if not 0.0 <= speed <= FASTEST:
        message = f"--speed is {speed:g}; 0 (as fast as it can) to {FASTEST:g} is accepted."
        raise ConfigError(message, reason="speed_bad", speed=speed, most=FASTEST)
    return speed


def session_folder(
    out: Path, request: SessionRequest, session: str | None = None, new: bool = False
) -> tuple[Path, SessionHead | None]:
    """Return the folder of the requested session in ``out``, and its head if it exists.

    Args:
        session: its name; None for the person's last session if that is unfinished, else for a new number.
        new: whether to begin a new session in any case.

    Raises:
        ConfigError: if there is no subject, or a new session was requested and one of this name exists.
        DatasetError: for an invalid code or name.
    """
    subject = request.subject
    if not subject and request.protocol and load_protocol(request.protocol).needs_nobody:
        subject = NOBODY
    if not subject:
        message = "The session has no person: give --subject with the person's code, such as S01."
        raise ConfigError(message, reason="no_person")
    person = out / check_subject(subject)
    if session is not None:
        name = check_session(session)
    else:
        name = new_session(person) if new else next_session(person)
    known = SessionHead.read(person / name)
    if known is not None and new:
        message = f"The session '{person / name}' exists: leave --new off, or give another --session."
        raise ConfigError(message, reason="session_exists", name=f"{person.name}/{name}")
    return person / name, known


def session_layout(request: SessionRequest, folder: Path, known: SessionHead | None) -> Layout | str | None:
    """Return the layout to open the toy with; None for that of the URL."""
    if not request.layout and known is not None:
        return Layout.from_dict(known.layout, f"layout in '{folder}'")
    return request.layout or None


def session_head(request: SessionRequest, folder: Path, fresh: bool, layout: Layout, software: str) -> SessionHead:
    """Return the head of the requested session; for a continued session, settings not requested are empty.

    Args:
        fresh: whether the session is new.
        layout: the layout of the open toy.
        software: name and version of the recording program.
    """
    named = request.protocol or (PROTOCOL if fresh else "")
    if not named and request.words:
        raise ConfigError("--words goes with --protocol: a continued session keeps the wording it began with.")
    protocol = load_protocol(named, request.words or None) if named else None
    if protocol is not None and protocol.order == "random" and fresh and not protocol.seed:
        protocol = replace(protocol, seed=1 + secrets.randbelow(2**31 - 1))
    return SessionHead(
        subject=folder.parent.name,
        session=folder.name,
        started_ms=now_ms(),
        layout=layout.to_dict(),
        protocol=protocol.to_dict() if protocol is not None else {},
        age_group=request.age_group,
        gender=request.gender,
        consent=request.consent,
        device=request.device,
        software=software,
        simulated=request.simulated or is_virtual(request.device) or request.speed != 1.0,
    )


def is_pseudo_terminal(request: SessionRequest, head: SessionHead) -> bool:
    """Return whether the port is a pseudo terminal, possibly of a virtual toy that is not marked ``simulated``."""
    return "/dev/pts/" in request.device and not head.simulated


def lacks_consent(head: SessionHead) -> bool:
    """Return whether a real session with a person has no reference to a signed consent form."""
    return not (head.consent or head.subject == NOBODY or head.simulated)
