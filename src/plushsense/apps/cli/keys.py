"""Single keys without Enter: from a terminal on any system, or as characters from a script's output."""

from __future__ import annotations

import codecs
import contextlib
import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

END = "\x04"
"""What `Keys.get` gives when nothing will come any more."""


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
            data = os.read(fd, 1024)
            if not data:
                return END
            # Arrow and function keys come as a sequence that begins with Escape: they are no letters.
            if not (data.startswith(b"\x1b") and len(data) > 1):
                self._waiting.extend(self._decoder.decode(data))
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
        return key


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
            termios.tcsetattr(fd, termios.TCSADRAIN, before)
