"""What the person at the terminal sees of a recording session."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import textwrap
from collections.abc import Sequence
from queue import SimpleQueue

from plushsense.recording.engine import Recorder
from plushsense.recording.status import Status

_BOLD, _DIM, _RED, _GREEN, _BLUE, _OFF = "\x1b[1m", "\x1b[2m", "\x1b[31;1m", "\x1b[32;1m", "\x1b[34;1m", "\x1b[0m"
_REMIND_S = 20.0
_WIDEST = 90

KEYS = {
    "idle": "SPACE start   s skip   r last one again   b back   p pause   n note   q quit",
    "countdown": "SPACE cancel",
    "recording": "SPACE stop   r break off and make it again   n note   q quit",
    "saving": "",
    "paused": "p go on   n note   q quit",
    "finished": "q close   r last one again   b back   n note",
    "stopped": "",
}


def _state(s: Status) -> tuple[str, str]:
    """The one line that says what happens and what to press, and its colour."""
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


def _toy(s: Status) -> list[tuple[str, str]]:
    """Two lines on the signal, each with its colour."""
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
    s: Status, title: str, notices: Sequence[str], typing: str | None, width: int, height: int = 1000
) -> list[str]:
    """The screen as at most ``height`` lines, no wider than ``width``.

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
        again = "   (recorded; this makes it again)" if s.already else ""
        name = f"{_BOLD}{s.step.gesture[: max(1, width - 2)]}{_OFF}"
        out.append((0, f"  {name}   {s.step.repetition} of {s.repetitions}{again}"))
        put(8, "")
        put(1, s.step.prompt, _BOLD, "  ")
        put(8, "")
    put(0, *_state(s), "  ")
    put(8, "")
    put(1, s.message, "", "  " if s.message else "")
    put(7, rule)
    if s.following is not None and s.state != "finished":
        put(5, f"Next  {s.following.gesture}, {s.following.repetition} of {s.repetitions}")
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


def _bar(s: Status, width: int) -> str:
    full = round(width * s.done / max(1, s.steps))
    return "█" * full + "░" * (width - full)


class Screen:
    """Shows a recorder on standard error: redrawn in place on a terminal, else a line for every change."""

    def __init__(self, recorder: Recorder, title: str, notices: Sequence[str] = ()) -> None:
        """``notices``: what the person must know all the while."""
        self._title = title
        self._notices = notices
        self._terminal = sys.stderr.isatty()
        self._said = self._message = ""
        # Told by the recorder's threads, written by the caller's: a log that nobody reads must hold up no frame.
        self._told: SimpleQueue[str] = SimpleQueue()
        if self._terminal:
            if sys.platform == "win32":
                os.system("")  # wakes the console's escape sequences
            # A screen of its own, no cursor, no wrapped lines.
            sys.stderr.write("\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J")
        else:
            recorder.listen(self._line)

    def draw(self, status: Status, typing: str | None = None) -> None:
        """Show this moment."""
        self._write_told()
        if self._terminal:
            # Standard output may be a file: it is the screen's size that counts. Some terminals do not know theirs.
            size = os.get_terminal_size(sys.stderr.fileno())
            width, height = (size.columns or 80) - 1, (size.lines or 24) - 1
            shown = lines(status, self._title, self._notices, typing, max(1, min(_WIDEST, width)), height)
            sys.stderr.write("\x1b[H" + "".join(f"{line}\x1b[K\n" for line in shown) + "\x1b[J")
            sys.stderr.flush()

    def _line(self, what: str, s: Status) -> None:
        """One change as a line, for a log or a screen reader."""
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
            self._told.put(s.message + "\n")
        if said and said != self._said:
            self._told.put(said + "\n")
            self._said = said
        self._message = s.message

    def _write_told(self) -> None:
        if not self._told.empty():
            while not self._told.empty():
                sys.stderr.write(self._told.get())
            sys.stderr.flush()

    def close(self) -> None:
        """Write what is left, and give the terminal back as it was; nothing to do for one that is gone."""
        with contextlib.suppress(OSError):
            self._write_told()
        if self._terminal:
            with contextlib.suppress(OSError):
                sys.stderr.write("\x1b[?7h\x1b[?25h\x1b[?1049l")
                sys.stderr.flush()
