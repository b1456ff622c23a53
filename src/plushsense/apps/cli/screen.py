"""What the person at the terminal sees of a recording session."""

from __future__ import annotations

import math
import os
import sys
import textwrap
from collections.abc import Sequence

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


def _toy(s: Status) -> str:
    words = {
        "good": "good",
        "fair": "fair: some readings are lost; bring the toy nearer",
        "poor": f"{_RED}POOR: many readings are lost; bring the toy nearer, check its battery{_OFF}",
        "none": f"{_RED}NONE: the toy is silent{_OFF}",
    }
    heard = f"   {s.rate_hz:.0f} readings a second" if s.rate_hz else ""
    return (
        f"Signal {words[s.signal]}{heard}\n"
        f"{_DIM}jitter {s.jitter_ms:.1f} ms   lost {s.lost}   unreadable {s.malformed}   out of range {s.garbage}   "
        f"gaps {s.gaps}   reconnected {s.reconnects}{_OFF}"
    )


def lines(s: Status, title: str, notices: Sequence[str], typing: str | None, width: int) -> list[str]:
    """The screen as lines, no wider than ``width``."""
    rule = "─" * width
    done = f"{s.done} of {s.steps} recorded" + (f", {s.skipped} skipped" if s.skipped else "")
    state, colour = _state(s)
    out = [f"{_BOLD}{title}{_OFF}"]
    out += [f"{_RED}{text}{_OFF}" for notice in notices for text in textwrap.wrap(notice, width)]
    out += [f"{done}", _bar(s, width), ""]
    if s.state not in ("finished", "stopped"):
        again = "   (recorded; this makes it again)" if s.already else ""
        out.append(f"  {_BOLD}{s.step.gesture}{_OFF}   {s.step.repetition} of {s.repetitions}{again}")
        out.append("")
        out += [f"  {_BOLD}{text}{_OFF}" for text in textwrap.wrap(s.step.prompt, width - 2)]
        out.append("")
    out += [f"  {colour}{state}{_OFF}", ""]
    out += [f"  {text}" for text in textwrap.wrap(s.message, width - 2)] or [""]
    out.append(rule)
    if s.following is not None and s.state != "finished":
        out.append(f"Next  {s.following.gesture}, {s.following.repetition} of {s.repetitions}")
    out += _toy(s).split("\n")
    if s.file:
        out.append(f"{_DIM}Last  {s.file}{_OFF}")
    out.append(rule)
    out.append(f"Note: {typing}▏   (Enter keeps it, Esc forgets it)" if typing is not None else KEYS[s.state])
    return out


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
        if self._terminal:
            if sys.platform == "win32":
                os.system("")  # wakes the console's escape sequences
            # A screen of its own, no cursor, no wrapped lines.
            sys.stderr.write("\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J")
        else:
            recorder.listen(self._line)

    def draw(self, status: Status, typing: str | None = None) -> None:
        """Show this moment."""
        if self._terminal:
            # Standard output may be a file: it is the screen's size that counts.
            size = os.get_terminal_size(sys.stderr.fileno())
            shown = lines(status, self._title, self._notices, typing, min(_WIDEST, size.columns - 1))[: size.lines - 1]
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
            sys.stderr.write(s.message + "\n")
        if said and said != self._said:
            sys.stderr.write(said + "\n")
            self._said = said
        self._message = s.message
        sys.stderr.flush()

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._terminal:
            sys.stderr.write("\x1b[?7h\x1b[?25h\x1b[?1049l")
            sys.stderr.flush()
