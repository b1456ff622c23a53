"""``plushsense record OUT --device URL --subject S01``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, say
from plushsense.core.errors import ConfigError

if TYPE_CHECKING:
    from plushsense.cli.terminal import KeySource, Screen
    from plushsense.recording.recorder import Recorder
    from plushsense.recording.session_files import SessionHead
    from plushsense.recording.setup import SessionRequest

_DRAW_S = 0.1
_WAIT_S = 0.02

ABOUT = """\
The screen says what the person is to do. Press SPACE, three seconds are counted down, the recording begins; press
SPACE again when the gesture is over. Whatever happens (a pulled cable, a crash, a full disk), what was recorded stays:
give the same command again, and the session goes on where it stood.

keys: SPACE start and stop   r make the last one again   s skip   b back   p pause   n note   q quit
Where keys come from a script instead of a keyboard, a point waits a second of the toy's time, and SPACE waits for the
countdown:   printf ' ... ' | plushsense record ...   makes one recording of three seconds.
"""


def add(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = f"{parser.description}\n\n{ABOUT}"
    parser.add_argument("out", metavar="OUT", help="folder for all recordings; gets OUT/SUBJECT/SESSION/")
    parser.add_argument(
        "--device",
        required=True,
        metavar="URL",
        help="the toy: serial:///dev/ttyUSB0, serial://COM3, tcp://host:port; virtual:// to try it without one",
    )
    parser.add_argument(
        "--subject", metavar="CODE", help="the person's code, such as S01; never a name (none: the toy alone)"
    )
    parser.add_argument(
        "--session", metavar="NAME", help="name of the session (default: the unfinished one, or a number)"
    )
    parser.add_argument("--new", action="store_true", help="begin a new session even if the last one is unfinished")
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="what is recorded: plush-17 (default: the paper's 17 gestures, 3 times), quick (to try it), rest (the toy "
        "alone), or a TOML file of your own",
    )
    parser.add_argument(
        "--words", metavar="NAME", help="which wording of the prompts, such as child (default: default)"
    )
    parser.add_argument(
        "--age-group", default="", metavar="WORD", help="such as child, teen, adult (default: not said)"
    )
    parser.add_argument("--gender", default="", metavar="WORD", help="as the person says (default: not said)")
    parser.add_argument(
        "--consent", default="", metavar="REF", help="number of the signed consent form (without it: never published)"
    )
    parser.add_argument(
        "--layout", metavar="NAME", help="the toy's firmware: plush-15 (default), plush-14, or a TOML file"
    )
    parser.add_argument("--speed", type=float, metavar="X", help="times real time at which a virtual toy runs (1)")
    parser.add_argument(
        "--auto",
        type=float,
        nargs="?",
        const=5.0,
        metavar="S",
        help="press the space bar by itself and record S seconds (5) each time: for trying it, and for the toy at rest",
    )
    parser.add_argument(
        "--simulated", action="store_true", help="the toy is `plushsense toy`: mark the recordings as a simulation"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.cli.terminal import Screen, keys, orderly_end
    from plushsense.core.version import __version__
    from plushsense.recording.recorder import Recorder
    from plushsense.recording.session import OpenSession
    from plushsense.recording.setup import (
        open_toy,
        prompt_virtual,
        session_folder,
        session_head,
        session_layout,
        with_speed,
    )
    from plushsense.recording.states import AutoRecording

    software = f"plushsense {__version__}"
    wanted = _request(args)
    folder, known = session_folder(Path(args.out), wanted, args.session, args.new)
    with open_toy(with_speed(args.device, wanted.speed), session_layout(wanted, folder, known)) as device:
        head = session_head(wanted, folder, known is None, device.layout, software)
        notices = _notices(wanted, head, known is None)
        for notice in notices:
            say(f"warning: {notice}")
        session = OpenSession(folder, head)
        for sentence in session.progress.repairs:
            say(f"mended: {sentence}")
        auto = AutoRecording(args.auto) if args.auto is not None else None
        recorder = Recorder(session, device, speed=wanted.speed, auto=auto, software=software)
        prompt_virtual(recorder)
        title = f"{head.subject}, session {folder.name}: {session.protocol.title}"
        screen = Screen(recorder, title, notices)
        try:
            with orderly_end(), recorder, keys() as typed:
                _drive(recorder, typed, screen, auto is not None)
        finally:
            screen.close()
    return _report(args, recorder)


def _report(args: argparse.Namespace, recorder: Recorder) -> int:
    """Say what came of it; 2 where the toy or the disk ended it."""
    status, standing = recorder.status(), recorder.session.progress
    finished = status.done + status.skipped >= status.steps
    result: dict[str, Any] = {
        "folder": status.folder,
        "subject": recorder.session.head.subject,
        "session": recorder.session.head.session,
        "recordings": status.done,
        "skipped": status.skipped,
        "redone": status.redone,
        "rows": status.rows,
        "lost": status.lost,
        "malformed": status.malformed,
        "garbage": status.garbage,
        "reconnects": status.reconnects,
        "gaps": recorder.gaps,
        "finished": finished,
        "resumed": standing.resumed,
    }
    stopped = status.failed or recorder.over
    text = f"{status.folder}: {status.done} of {status.steps} recorded"
    text += f", {status.skipped} skipped" if status.skipped else ""
    text += "." if finished else "; the same command goes on from here."
    emit(args, result | ({"stopped": stopped} if stopped else {}), text)
    if stopped and not finished:
        say(f"plushsense: {stopped}")
        return 2
    return 0


def _request(args: argparse.Namespace) -> SessionRequest:
    from plushsense.recording.setup import SessionRequest, check_speed, speed_of

    if args.auto is not None and not 0.5 <= args.auto <= 3600.0:
        raise ConfigError(f"--auto is {args.auto:g}; 0.5 to 3600 seconds are accepted.")
    return SessionRequest(
        device=args.device,
        subject=args.subject or "",
        protocol=args.protocol or "",
        words=args.words or "",
        layout=args.layout or "",
        age_group=args.age_group,
        gender=args.gender,
        consent=args.consent,
        speed=check_speed(speed_of(args.device) if args.speed is None else float(args.speed)),
        simulated=args.simulated,
    )


def _notices(wanted: SessionRequest, head: SessionHead, fresh: bool) -> list[str]:
    """Return the notices to print before a session."""
    from plushsense.recording.setup import is_pseudo_terminal, lacks_consent

    said = []
    if is_pseudo_terminal(wanted, head):
        said.append("This port is a pseudo terminal: if it is `plushsense toy`, quit and add --simulated.")
    if fresh and lacks_consent(head):
        said.append("No consent reference (--consent): recorded as missing, and publishing will refuse it.")
    return said


def _drive(recorder: Recorder, typed: KeySource, screen: Screen, auto: bool) -> None:  # noqa: C901
    """Turn keys into commands and update the screen until the session ends."""
    from plushsense.cli.terminal import END, Held

    note: str | None = None
    leaving = False
    held = Held()
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
        repeated = key is not None and held.again(key, time.monotonic())
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
            if status.state == "recording" and not leaving:
                leaving = True
                recorder.show_message(
                    "Recording: q again quits, and this one is to be made again; SPACE stops it first."
                )
                continue
            return
        elif typed.script and key == ".":
            _toy_second(recorder)
        elif key.lower() in commands:
            if typed.script:
                _settled(recorder, key)
            commands[key.lower()]()
            if typed.script:
                recorder.wait("idle", "recording", "paused", "finished")
        leaving = False


def _settled(recorder: Recorder, key: str) -> None:
    """Wait until a script's key can take effect, since a script cannot see the screen."""
    recorder.wait("idle", "recording", "paused", "finished")
    while key == " " and (s := recorder.status()).state == "recording":
        if s.elapsed_s >= recorder.protocol.shortest_s:
            return
        time.sleep(_WAIT_S)
    while key == " " and (s := recorder.status()).state == "idle" and s.signal in ("none", "unreadable"):
        time.sleep(_WAIT_S)


def _toy_second(recorder: Recorder) -> None:
    until = recorder.toy_s + 1.0
    while recorder.toy_s < until and recorder.status().state != "stopped":
        time.sleep(_WAIT_S)
