"""Read keys and draw the screen of a recording session in a terminal."""

from __future__ import annotations

import codecs
import contextlib
import math
import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from queue import SimpleQueue
from typing import TYPE_CHECKING, Protocol

from plushsense.core.errors import printable
from plushsense.recording.recorder import Recorder
from plushsense.recording.status import RecorderStatus

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

END = "\x04"
"""The key that a source returns when it has ended."""

REPEAT_S = {" ": 0.7, "r": 0.1, "s": 0.1, "b": 0.1}
"""Time in seconds within which a repeated key counts as held down. Keyboards repeat a key after about 0.5 s, then every
0.03 s. Nobody needs the space bar twice within 0.7 s, but the other keys may be pressed in quick succession."""


class KeySource(Protocol):
    """Source of keys; ``script`` is true if they come from a file or pipe instead of a keyboard."""

    script: bool

    def get(self, timeout_s: float) -> str | None:
        """Return the next key, or None after ``timeout_s``, or `END` if the source has ended."""
        ...


class _Script:
    """Keys from standard input if it is not a terminal."""

    script = True

    def __init__(self) -> None:
        self._keys: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._work, name="plushsense-keys", daemon=True).start()

    def _work(self) -> None:
        # Read the file descriptor: a thread waiting in sys.stdin would prevent the program from ending.
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        with contextlib.suppress(OSError, ValueError):
            fd = sys.stdin.fileno()
            while data := os.read(fd, 1024):
                for text in decoder.decode(data):
                    self._keys.put(text)
        self._keys.put(END)

    def get(self, timeout_s: float) -> str | None:
        try:
            return self._keys.get(timeout=timeout_s)
        except queue.Empty:
            return None


class _Posix:
    """Keys from a terminal on Linux or macOS."""

    script = False

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._waiting: deque[str] = deque()

    def get(self, timeout_s: float) -> str | None:
        import select

        fd = sys.stdin.fileno()
        if not self._waiting and select.select([fd], [], [], timeout_s)[0]:
            try:
                data = os.read(fd, 1024)
            except OSError:  # the terminal was closed
                data = b""
            if not data:
                return END
            # Ignore the sequences of arrow and function keys, which begin with Escape. Treat Ctrl-D, which may be a
            # slip, like q, which asks for confirmation before a recording is discarded.
            if not (data.startswith(b"\x1b") and len(data) > 1):
                self._waiting.extend(self._decoder.decode(data).replace(END, "q"))
        return self._waiting.popleft() if self._waiting else None


class _Windows:
    """Keys from a console on Windows."""

    script = False

    def get(self, timeout_s: float) -> str | None:
        if sys.platform != "win32":
            return None
        import msvcrt

        until = time.monotonic() + timeout_s
        while not msvcrt.kbhit():
            if time.monotonic() >= until:
                return None
            time.sleep(0.02)
        key = msvcrt.getwch()
        if key in "\x00\xe0":
            msvcrt.getwch()
            return ""
        if key == "\x03":
            raise KeyboardInterrupt
        return "q" if key == END else key


@contextmanager
def keys() -> Iterator[KeySource]:
    """Yield a source of single key presses from standard input; restore the terminal afterwards."""
    if not sys.stdin.isatty():
        yield _Script()
    elif sys.platform == "win32":
        yield _Windows()
    else:
        import termios
        import tty

        fd = sys.stdin.fileno()
        before = termios.tcgetattr(fd)
        try:
            tty.setcbreak(fd)
            yield _Posix()
        finally:
            with contextlib.suppress(termios.error):  # the terminal may be closed
                termios.tcsetattr(fd, termios.TCSADRAIN, before)


class KeyRepeatFilter:
    """Detector of the automatic repetition of a key that is held down."""

    def __init__(self) -> None:
        self._key: str | None = None
        self._at_s = float("-inf")

    def repeats(self, key: str, at_s: float) -> bool:
        """Return whether ``key``, received at ``at_s`` seconds, is a repetition by a key that is held down."""
        repeated = key == self._key and at_s - self._at_s < REPEAT_S.get(key.lower(), 0.0)
        self._key, self._at_s = key, at_s
        return repeated


_REMIND_S = 20.0
_WIDEST = 90

KEYS = {
    "idle": "SPACE start   s skip   r redo the last   b back   p pause   n note   q quit",
    "countdown": "SPACE cancel",
    "recording": "SPACE stop   r cancel and repeat   p cancel and pause   n note   q quit",
    "saving": "",
    "paused": "p resume   n note   q quit",
    "finished": "q close   r redo the last   b back   n note",
    "stopped": "",
}
_SIGNAL = {
    "good": ("good", ""),
    "fair": ("fair: some readings are lost or damaged; bring the toy nearer", ""),
    "poor": ("POOR: many readings are lost or damaged; bring the toy nearer, check its battery", "bold red"),
    "none": ("NONE: the toy sends nothing", "bold red"),
    "unreadable": ("UNREADABLE: the toy sends lines, but none is a frame", "bold red"),
}
_STATES = {
    "saving": ("SAVING …", "bold blue"),
    "paused": ("PAUSED.  Press p to resume", "bold blue"),
    "finished": ("ALL RECORDED.  Press q to close", "bold green"),
    "stopped": ("STOPPED", "bold green"),
}


def _state(s: RecorderStatus) -> tuple[str, str]:
    """Return the line that describes the state and the key to press, and its style."""
    if s.state == "idle":
        if s.signal == "none":
            return "WAITING FOR THE TOY: switch it on, bring it near", "bold red"
        if s.signal == "unreadable":
            return "THE TOY CANNOT BE READ: is --layout right, and the cable sound?", "bold red"
        return "READY.  Press SPACE, then wait for the countdown", "bold blue"
    if s.state == "countdown":
        return f"GET READY … {math.ceil(s.countdown_s)}", "bold blue"
    if s.state == "recording":
        if s.away:
            return f"RECORDING  {s.elapsed_s:4.1f} s   TOY DISCONNECTED: check cable and battery", "bold red"
        if s.left_s < _REMIND_S and s.elapsed_s > _REMIND_S:
            left = f"SPACE stops; stops by itself in {s.left_s:.0f} s"
            return f"STILL RECORDING  {s.elapsed_s:4.1f} s   {left}", "bold red"
        return f"RECORDING  {s.elapsed_s:4.1f} s   Press SPACE when the gesture is over", "bold green"
    return _STATES[s.state]


def view(s: RecorderStatus, title: str, notices: Sequence[str], typing: str | None) -> RenderableType:
    """Return the screen. What is to be done stands at the top, because a low terminal cuts off the lines below."""
    from rich.console import Group
    from rich.padding import Padding
    from rich.progress_bar import ProgressBar
    from rich.text import Text

    rows: list[RenderableType] = []

    def put(text: str, style: str = "", indent: int = 0) -> None:
        rows.append(Padding(Text(printable(text, lines=True), style), (0, 0, 0, indent)))

    if s.state not in ("finished", "stopped"):
        again = "   (recorded before; this one replaces it)" if s.existing else ""
        put(f"{s.step.gesture}   {s.step.repetition} of {s.repetitions}{again}", "bold", 2)
        put(s.step.prompt, "bold", 2)
    put(*_state(s), 2)
    put(s.message, "", 2)
    put(f"Note: {typing}▏   (Enter saves it, Esc discards it)" if typing is not None else KEYS[s.state])
    put(f"{s.done} of {s.steps} recorded" + (f", {s.skipped} skipped" if s.skipped else ""))
    rows.append(ProgressBar(total=max(1, s.steps), completed=s.done))
    put("")
    put(title, "bold")
    for notice in notices:
        put(notice, "bold red")
    if s.next_step is not None and s.state != "finished":
        put(f"Next  {s.next_step.gesture}, {s.next_step.repetition} of {s.repetitions}")
    text, style = _SIGNAL[s.signal]
    put(f"Signal {text}" + (f"   {s.rate_hz:.0f} readings a second" if s.rate_hz else ""), style)
    counts = f"lost {s.lost}   unreadable {s.malformed}   out of range {s.garbage}   gaps {s.gaps}"
    put(f"jitter {s.jitter_ms:.1f} ms   {counts}   reconnected {s.reconnects}", "dim")
    if s.file:
        put(f"Last  {s.file}", "dim")
    return Group(*rows)


class Screen:
    """Display of a recorder on standard error: redrawn in place on a terminal, otherwise one line per change."""

    def __init__(self, recorder: Recorder, title: str, notices: Sequence[str] = ()) -> None:
        """Prepare the screen; on a terminal, ``notices`` are displayed below ``title``."""
        self._title, self._notices = title, notices
        self._line = self._message = ""
        # The recorder's threads only queue messages, so that a blocked log cannot delay frames; the caller writes them.
        self._messages: SimpleQueue[str] = SimpleQueue()
        self._live: Live | None = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            console = Console(stderr=True, highlight=False)
            self._live = Live(
                console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
            )
            self._live.start()
        else:
            recorder.subscribe(self._on_change)

    def draw(self, status: RecorderStatus, typing: str | None = None) -> None:
        """Draw the status; ``typing`` is the note that is being typed, if any."""
        self._write_messages()
        if self._live is not None:
            from rich.constrain import Constrain

            screen = view(status, self._title, self._notices, typing)
            self._live.update(Constrain(screen, _WIDEST), refresh=True)

    def _on_change(self, change: str, s: RecorderStatus) -> None:
        """Queue a line that describes a change, for a log or a screen reader."""
        where = f"{s.step.gesture}, {s.step.repetition} of {s.repetitions}"
        line = {
            "idle": f"{s.done} of {s.steps}. {where}: {s.step.prompt}",
            "countdown": f"countdown: {where}" if s.state == "countdown" else "",
            "recording": f"recording: {where}",
            "take": f"saved {s.file}",
            "finished": f"all done: {s.done} of {s.steps} recorded, {s.skipped} skipped"
            if s.state == "finished"
            else "",
        }.get(change, "")
        if s.message and s.message != self._message:
            self._messages.put(s.message + "\n")
        if line and line != self._line:
            self._messages.put(line + "\n")
            self._line = line
        self._message = s.message

    def _write_messages(self) -> None:
        if not self._messages.empty():
            while not self._messages.empty():
                sys.stderr.write(printable(self._messages.get(), lines=True))
            sys.stderr.flush()

    def close(self) -> None:
        """Write the remaining messages and restore the terminal, unless it is closed."""
        with contextlib.suppress(OSError):
            self._write_messages()
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.stop()
