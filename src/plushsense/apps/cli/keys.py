"""Single keys without Enter: from a terminal on any system, or as characters from a script's output; and the end."""

from __future__ import annotations

import codecs
import contextlib
import os
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

END = "\x04"
"""What `Keys.get` gives when nothing will come any more."""


HELD_S = {" ": 0.7, "r": 0.1, "s": 0.1, "b": 0.1}
"""A key that comes again so soon is held down. Keyboards begin to repeat after about half a second, then every 0.03 s;
the space bar, which is leant on, has no use twice within that time, and the others may be pressed in a row."""


class Keys(Protocol):
    """Where keys come from; ``script``: they are not typed by a person who looks at a screen."""

    script: bool

    def get(self, timeout_s: float) -> str | None:
        """The next key, None when none came in time, `END` when none will come any more."""
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
def keys() -> Iterator[Keys]:
    """Keys as they are pressed; the terminal is put back as it was."""
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
        """Whether ``key``, come at ``at_s`` of a monotonic clock, is only the last one, still held."""
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
