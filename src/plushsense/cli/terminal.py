"""Read keys and draw the screen of a recording session in a terminal."""

from __future__ import annotations

import codecs
import contextlib
import math
import os
import queue
import signal
import sys
import textwrap
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Protocol

from plushsense.recording.recorder import Recorder
from plushsense.recording.status import RecorderStatus

END = "\x04"
"""What `Keys.get` gives when nothing will come any more."""


HELD_S = {" ": 0.7, "r": 0.1, "s": 0.1, "b": 0.1}
"""A key that comes again so soon is held down. Keyboards begin to repeat after about half a second, then every 0.03 s;
the space bar, which is leant on, has no use twice within that time, and the others may be pressed in a row."""


class KeySource(Protocol):
    """Source of keys; ``script``: they are not typed by a person who sees a screen."""

    script: bool

    def get(self, timeout_s: float) -> str | None:
        """Return the next key, None when none came in time, `END` when none can come any more."""
        ...


class _Script:
    """Characters of standard input where that is no terminal."""

    script = True

    def __init__(self) -> None:
        self._came: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._work, name="plushsense-keys", daemon=True).start()

    def _work(self) -> None:
        # Not through sys.stdin: a thread that waits in it would stop the program from ending.
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        with contextlib.suppress(OSError, ValueError):
            fd = sys.stdin.fileno()
            while data := os.read(fd, 1024):
                for text in decoder.decode(data):
                    self._came.put(text)
        self._came.put(END)

    def get(self, timeout_s: float) -> str | None:
        try:
            return self._came.get(timeout=timeout_s)
        except queue.Empty:
            return None


class _Posix:
    """A terminal of Linux or macOS."""

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
            # Arrow and function keys come as a sequence that begins with Escape: they are no letters. Ctrl-D is a key
            # like q: it may be a slip.
            if not (data.startswith(b"\x1b") and len(data) > 1):
                self._waiting.extend(self._decoder.decode(data).replace(END, "q"))
        return self._waiting.popleft() if self._waiting else None


class _Windows:
    """A console of Windows."""

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
    """Yield keys as they are pressed; the terminal is restored afterwards."""
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
            with contextlib.suppress(termios.error):  # it may be gone
                termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Held:
    """Tells a key that is held down, and so comes again and again, from one that is pressed anew."""

    def __init__(self) -> None:
        self._key: str | None = None
        self._at_s = float("-inf")

    def again(self, key: str, at_s: float) -> bool:
        """Return whether ``key``, pressed at ``at_s`` seconds, only repeats the last one while it is held."""
        held = key == self._key and at_s - self._at_s < HELD_S.get(key.lower(), 0.0)
        self._key, self._at_s = key, at_s
        return held


@contextmanager
def orderly_end() -> Iterator[None]:
    """Have ``kill``, and a terminal that is closed, end the work as Ctrl-C does: in order, and only once."""
    asked = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)]
    # Who started it with nohup wants it to go on.
    asked = [number for number in asked if signal.getsignal(number) is signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():
        asked = []

    def end(number: int, frame: object) -> None:
        for other in asked:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in asked:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in asked:
            signal.signal(number, signal.SIG_DFL)


_BOLD, _DIM, _RED, _GREEN, _BLUE, _OFF = "\x1b[1m", "\x1b[2m", "\x1b[31;1m", "\x1b[32;1m", "\x1b[34;1m", "\x1b[0m"
_REMIND_S = 20.0
_WIDEST = 90

KEYS = {
    "idle": "SPACE start   s skip   r last one again   b back   p pause   n note   q quit",
    "countdown": "SPACE cancel",
    "recording": "SPACE stop   r break off and make it again   p break off and pause   n note   q quit",
    "saving": "",
    "paused": "p go on   n note   q quit",
    "finished": "q close   r last one again   b back   n note",
    "stopped": "",
}


def _state(s: RecorderStatus) -> tuple[str, str]:
    """Return the line that says the state and the key to press, and its colour."""
    if s.state == "idle":
        if s.signal == "none":
            return "WAITING FOR THE TOY: switch it on, bring it near", _RED
        if s.signal == "unreadable":
            return "THE TOY CANNOT BE READ: is --layout right, and the cable sound?", _RED
        return "READY.  Press SPACE, then wait for the countdown", _BLUE
    if s.state == "countdown":
        return f"GET READY … {math.ceil(s.countdown_s)}", _BLUE
    if s.state == "recording":
        if s.away:
            return f"RECORDING  {s.elapsed_s:4.1f} s   THE TOY IS AWAY: check cable and battery", _RED
        if s.left_s < _REMIND_S and s.elapsed_s > _REMIND_S:
            return f"STILL RECORDING  {s.elapsed_s:4.1f} s   SPACE stops; it ends by itself in {s.left_s:.0f} s", _RED
        return f"RECORDING  {s.elapsed_s:4.1f} s   Press SPACE when the gesture is over", _GREEN
    if s.state == "saving":
        return "SAVING …", _BLUE
    if s.state == "paused":
        return "PAUSED.  Press p to go on", _BLUE
    return ("ALL RECORDED.  Press q to close" if s.state == "finished" else "STOPPED"), _GREEN


def _toy(s: RecorderStatus) -> list[tuple[str, str]]:
    """Return two lines on the signal, each with its colour."""
    words = {
        "good": ("good", ""),
        "fair": ("fair: some readings are lost or spoilt; bring the toy nearer", ""),
        "poor": ("POOR: many readings are lost or spoilt; bring the toy nearer, check its battery", _RED),
        "none": ("NONE: the toy is silent", _RED),
        "unreadable": ("UNREADABLE: lines come, but none is a frame", _RED),
    }
    heard = f"   {s.rate_hz:.0f} readings a second" if s.rate_hz else ""
    text, colour = words[s.signal]
    return [
        (f"Signal {text}{heard}", colour),
        (
            f"jitter {s.jitter_ms:.1f} ms   lost {s.lost}   unreadable {s.malformed}   out of range {s.garbage}   "
            f"gaps {s.gaps}   reconnected {s.reconnects}",
            _DIM,
        ),
    ]


def lines(
    s: RecorderStatus, title: str, notices: Sequence[str], typing: str | None, width: int, height: int = 1000
) -> list[str]:
    """Return the screen as at most ``height`` lines, no wider than ``width``.

    Where there is no room, what a session can be led without goes first: blank lines, rules, counters; what is to be
    made, its state and the keys stay longest.
    """
    out: list[tuple[int, str]] = []

    def put(rank: int, text: str, colour: str = "", indent: str = "") -> None:
        for line in textwrap.wrap(text, max(1, width - len(indent))) or [""]:
            out.append((rank, f"{indent}{colour}{line}{_OFF if colour else ''}"))

    rule = "─" * width
    put(4, title, _BOLD)
    for notice in notices:
        put(3, notice, _RED)
    put(2, f"{s.done} of {s.steps} recorded" + (f", {s.skipped} skipped" if s.skipped else ""))
    put(6, _bar(s, width))
    put(8, "")
    if s.state not in ("finished", "stopped"):
        again = "   (recorded; this makes it again)" if s.existing else ""
        name = f"{_BOLD}{s.step.gesture[: max(1, width - 2)]}{_OFF}"
        out.append((0, f"  {name}   {s.step.repetition} of {s.repetitions}{again}"))
        put(8, "")
        put(1, s.step.prompt, _BOLD, "  ")
        put(8, "")
    put(0, *_state(s), "  ")
    put(8, "")
    put(1, s.message, "", "  " if s.message else "")
    put(7, rule)
    if s.next_step is not None and s.state != "finished":
        put(5, f"Next  {s.next_step.gesture}, {s.next_step.repetition} of {s.repetitions}")
    for rank, (text, colour) in zip((3, 6), _toy(s), strict=True):
        put(rank, text, colour)
    if s.file:
        put(7, f"Last  {s.file}", _DIM)
    put(7, rule)
    put(1, f"Note: {typing}▏   (Enter keeps it, Esc forgets it)" if typing is not None else KEYS[s.state])
    while len(out) > max(1, height):
        worst = max(rank for rank, _ in out)
        del out[max(n for n, (rank, _) in enumerate(out) if rank == worst)]
    return [text for _, text in out]


def _bar(s: RecorderStatus, width: int) -> str:
    full = round(width * s.done / max(1, s.steps))
    return "█" * full + "░" * (width - full)


class Screen:
    """Shows a recorder on standard error: redrawn in place on a terminal, else a line for every change."""

    def __init__(self, recorder: Recorder, title: str, notices: Sequence[str] = ()) -> None:
        """Prepare a screen; ``notices`` stay visible all the time."""
        self._title = title
        self._notices = notices
        self._terminal = sys.stderr.isatty()
        self._said = self._message = ""
        # Told by the recorder's threads, written by the caller's: a log that nobody reads must hold up no frame.
        self._messages: SimpleQueue[str] = SimpleQueue()
        if self._terminal:
            if sys.platform == "win32":
                os.system("")  # wakes the console's escape sequences
            # A screen of its own, no cursor, no wrapped lines.
            sys.stderr.write("\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J")
        else:
            recorder.subscribe(self._line)

    def draw(self, status: RecorderStatus, typing: str | None = None) -> None:
        """Show this moment."""
        self._write_messages()
        if self._terminal:
            # Standard output may be a file: it is the screen's size that counts. Some terminals do not know theirs.
            size = os.get_terminal_size(sys.stderr.fileno())
            width, height = (size.columns or 80) - 1, (size.lines or 24) - 1
            shown = lines(status, self._title, self._notices, typing, max(1, min(_WIDEST, width)), height)
            sys.stderr.write("\x1b[H" + "".join(f"{line}\x1b[K\n" for line in shown) + "\x1b[J")
            sys.stderr.flush()

    def _line(self, what: str, s: RecorderStatus) -> None:
        """Return one change as a line for a log or a screen reader."""
        where = f"{s.step.gesture}, {s.step.repetition} of {s.repetitions}"
        said = {
            "idle": f"{s.done} of {s.steps}. {where}: {s.step.prompt}",
            "countdown": f"countdown: {where}" if s.state == "countdown" else "",
            "recording": f"recording: {where}",
            "take": f"saved {s.file}",
            "finished": f"all done: {s.done} of {s.steps} recorded, {s.skipped} skipped"
            if s.state == "finished"
            else "",
        }.get(what, "")
        if s.message and s.message != self._message:
            self._messages.put(s.message + "\n")
        if said and said != self._said:
            self._messages.put(said + "\n")
            self._said = said
        self._message = s.message

    def _write_messages(self) -> None:
        if not self._messages.empty():
            while not self._messages.empty():
                sys.stderr.write(self._messages.get())
            sys.stderr.flush()

    def close(self) -> None:
        """Write what is left, and give the terminal back as it was; nothing to do for one that is gone."""
        with contextlib.suppress(OSError):
            self._write_messages()
        if self._terminal:
            with contextlib.suppress(OSError):
                sys.stderr.write("\x1b[?7h\x1b[?25h\x1b[?1049l")
                sys.stderr.flush()
