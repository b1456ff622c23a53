"""Implement ``plushsense record OUT --device URL --subject S01``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, say
from plushsense.cli.signals import interrupt_on_signals
from plushsense.core.errors import ConfigError

if TYPE_CHECKING:
    from plushsense.cli.terminal import KeySource, Screen
    from plushsense.recording.recorder import Recorder
    from plushsense.recording.session import SessionRequest
    from plushsense.recording.writer import SessionHead

_DRAW_S = 0.1
_WAIT_S = 0.02


def run(args: argparse.Namespace) -> int:
    from plushsense.cli.terminal import Screen, keys
    from plushsense.core.version import __version__
    from plushsense.devices.opening import with_speed
    from plushsense.recording.recorder import AutoRecording, Recorder, open_toy, prompt_virtual
    from plushsense.recording.session import OpenSession, session_folder, session_head, session_layout

    software = f"plushsense {__version__}"
    request = _request(args)
    folder, known = session_folder(Path(args.out), request, args.session, args.new)
    layout = session_layout(request, folder, known)
    with interrupt_on_signals(), open_toy(with_speed(args.device, request.speed), layout) as device:
        head = session_head(request, folder, known is None, device.layout, software)
        notices = [*_notices(request, head, known is None), *(f"{args.device}: {note}" for note in device.notes)]
        for notice in notices:
            say(f"warning: {notice}")
        session = OpenSession(folder, head)
        for sentence in session.progress.repairs:
            say(f"repaired: {sentence}")
        auto = AutoRecording(args.auto) if args.auto is not None else None
        recorder = Recorder(session, device, speed=request.speed, auto=auto, software=software)
        prompt_virtual(recorder)
        title = f"{head.subject}, session {folder.name}: {session.protocol.title}"
        screen = Screen(recorder, title, notices)
        try:
            with recorder, keys() as typed:
                _drive(recorder, typed, screen, auto is not None)
        finally:
            screen.close()
    return _report(args, recorder)


def _report(args: argparse.Namespace, recorder: Recorder) -> int:
    """Print the result; return 2 if the session ended early because of the toy or the disk, else 0."""
    status = recorder.status()
    finished = status.done + status.skipped >= status.steps
    counts = ("skipped", "redone", "rows", "lost", "malformed", "garbage", "reconnects")
    result: dict[str, Any] = {
        "folder": status.folder,
        "subject": recorder.session.head.subject,
        "session": recorder.session.head.session,
        "recordings": status.done,
        **{name: getattr(status, name) for name in counts},
        "gaps": [gap.to_json() for gap in recorder.gaps],
        "finished": finished,
        "resumed": recorder.session.progress.resumed,
    }
    stopped = status.failed or recorder.over
    text = f"{status.folder}: {status.done} of {status.steps} recorded"
    text += f", {status.skipped} skipped" if status.skipped else ""
    text += "." if finished else "; give the same command again to resume."
    emit(args, result | ({"stopped": stopped} if stopped else {}), text)
    if stopped and not finished:
        say(f"plushsense: {stopped}")
        return 2
    return 0


def _request(args: argparse.Namespace) -> SessionRequest:
    from plushsense.devices.opening import speed_of
    from plushsense.recording.session import SessionRequest, check_speed

    if args.auto is not None and not 0.5 <= args.auto <= 3600.0:
        raise ConfigError(f"--auto is {args.auto:g}; 0.5 to 3600 seconds are accepted.")
    given = options(args, "age_group", "gender", "consent", "simulated")
    given |= {name: getattr(args, name) or "" for name in ("subject", "protocol", "words", "layout")}
    return SessionRequest(
        device=args.device,
        **given,
        speed=check_speed(speed_of(args.device) if args.speed is None else float(args.speed)),
    )


def _notices(request: SessionRequest, head: SessionHead, fresh: bool) -> list[str]:
    """Return the warnings to print before a session."""
    from plushsense.recording.session import is_pseudo_terminal, lacks_consent

    notices = []
    if is_pseudo_terminal(request, head):
        notices.append("This port is a pseudo terminal: if it is `plushsense toy`, quit and add --simulated.")
    if fresh and lacks_consent(head):
        notices.append("No consent reference (--consent): recorded as missing, and publishing will refuse it.")
    return notices


def _drive(recorder: Recorder, typed: KeySource, screen: Screen, auto: bool) -> None:  # noqa: C901
    """Run the commands of pressed keys and update the screen until the session ends."""
    from plushsense.cli.terminal import END, KeyRepeatFilter
    from plushsense.core.sentences import Message

    note: str | None = None
    confirming = False
    repeats = KeyRepeatFilter()
    commands: dict[str, Callable[[], None]] = {
        " ": recorder.space,
        "r": recorder.redo,
        "s": recorder.skip,
        "b": recorder.back,
        "p": lambda: recorder.resume() if recorder.status().state == "paused" else recorder.pause(),
    }
    while True:
        status = recorder.status()
        screen.draw(status, note)
        if status.state == "stopped" or (status.state == "finished" and auto):
            return
        key = typed.get(_WAIT_S if auto or typed.script else _DRAW_S)
        if key == END:
            if not auto:
                return
            recorder.wait("finished", timeout_s=_DRAW_S)
            continue
        repeated = key is not None and repeats.repeats(key, time.monotonic())
        if not key or (repeated and note is None and not typed.script):
            continue
        if note is not None:
            if key in "\r\n":
                recorder.note(note)
                note = None
            elif key == "\x1b":
                note = None
            else:
                note = note[:-1] if key in "\x7f\b" else note + key
        elif key in "nN":
            note = ""
        elif key in "qQ":
            if status.state == "recording" and not confirming:
                confirming = True
                text = "Recording: press q again to quit and discard it, or SPACE to stop it first."
                recorder.show_message(Message(text))
                continue
            return
        elif typed.script and key == ".":
            _wait_toy_second(recorder)
        elif key.lower() in commands:
            if typed.script:
                _wait_ready(recorder, key)
            commands[key.lower()]()
            if typed.script:
                recorder.wait("idle", "recording", "paused", "finished")
        confirming = False


def _wait_ready(recorder: Recorder, key: str) -> None:
    """Wait until a key from a script can take effect, because a script cannot see the screen."""
    recorder.wait("idle", "recording", "paused", "finished")
    while key == " " and (s := recorder.status()).state == "recording":
        if s.elapsed_s >= recorder.protocol.shortest_s:
            return
        time.sleep(_WAIT_S)
    while key == " " and (s := recorder.status()).state == "idle" and s.signal in ("none", "unreadable"):
        time.sleep(_WAIT_S)


def _wait_toy_second(recorder: Recorder) -> None:
    until = recorder.toy_s + 1.0
    while recorder.toy_s < until and recorder.status().state != "stopped":
        time.sleep(_WAIT_S)
