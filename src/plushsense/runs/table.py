"""What a run of many jobs shows while it works: a table on a terminal, a line every ten seconds elsewhere.

`Standing` is what is known, told the time from outside; `lines` makes text of it; `Table` draws that text.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TextIO

from plushsense.runs.jobs import Job
from plushsense.runs.journal import Result

_DRAW_S, _CLOCK_S, _LINE_S = 0.2, 1.0, 10.0


class Row(NamedTuple):
    """What a job is called, and what it costs, in any unit that is the same for all."""

    name: str
    cost: float


class At(NamedTuple):
    """Where a job is: so many steps (epochs) of all, and its last loss."""

    step: int
    steps: int
    loss: float | None = None


class Best(NamedTuple):
    """A score, and what reached it; more is better."""

    score: float
    name: str


@dataclass
class _Running:
    since: float
    at: At | None = None

    @property
    def part(self) -> float:
        return 0.0 if self.at is None else min(1.0, self.at.step / max(1, self.at.steps))


@dataclass
class Standing:
    """Where a run stands. It has no clock: every change says when, in seconds of any monotonic clock."""

    rows: Mapping[str, Row]
    began: float
    done: set[str] = field(default_factory=set)
    resumed: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    best: Best | None = None
    _running: dict[str, _Running] = field(default_factory=dict)
    _side_by_side: int = 0

    def start(self, job: str, now: float) -> None:
        """The job begins, or begins again."""
        self._running[job] = _Running(now)
        self._side_by_side = max(self._side_by_side, len(self._running))

    def report(self, job: str, at: At, now: float) -> None:
        """The job is there now."""
        if job in self.done or job in self.failed:
            return
        if job not in self._running:
            self.start(job, now)
        self._running[job].at = at

    def finish(self, job: str, best: Best | None = None, resumed: bool = False) -> None:
        """The job is done, with its score if it has one; ``resumed``: it was, before this run."""
        self._running.pop(job, None)
        self.done.add(job)
        if resumed:
            self.resumed.add(job)
        if best is not None and (self.best is None or best.score > self.best.score):
            self.best = best

    def fail(self, job: str, why: str) -> None:
        """The job was given up."""
        self._running.pop(job, None)
        self.failed[job] = why

    @property
    def running(self) -> list[tuple[Row, At | None, float]]:
        """What runs now, the longest first: (row, where it is, since when)."""
        return [(self.rows[job], r.at, r.since) for job, r in sorted(self._running.items(), key=lambda j: j[1].since)]

    @property
    def share(self) -> float:
        """How much of the cost of all is behind us, 0 to 1."""
        total = sum(row.cost for row in self.rows.values())
        return 1.0 if total <= 0 else 1.0 - self._ahead() / total

    def left_s(self, now: float) -> float | None:
        """The time until all is done; None while there is nothing to judge by.

        From the cost per second of what this run itself did; what was there before says nothing of its speed. Not less
        than the longest job needs that is still to be done, at the speed of one.
        """
        ahead = self._ahead()
        if ahead <= 0:
            return 0.0
        # A failed job took time too, nobody knows how much of its cost: it is left out on both sides.
        fresh = sum(self.rows[job].cost for job in self.done - self.resumed)
        fresh += sum(self.rows[job].cost * r.part for job, r in self._running.items())
        passed = now - self.began
        if fresh <= 0 or passed <= 0:
            return None
        speed = fresh / passed
        longest = max(
            self.rows[job].cost * (1.0 - self._running[job].part if job in self._running else 1.0)
            for job in self._open()
        )
        return max(ahead, longest * self._side_by_side) / speed

    def _open(self) -> list[str]:
        return [job for job in self.rows if job not in self.done and job not in self.failed]

    def _ahead(self) -> float:
        return sum(
            self.rows[job].cost * (1.0 - self._running[job].part if job in self._running else 1.0)
            for job in self._open()
        )


def lines(s: Standing, title: str, now: float, width: int, height: int = 1000, score: str = "score") -> list[str]:
    """The table as at most ``height`` lines, none longer than ``width``; what runs gives way first."""
    head = [_cut(line, width) for line in _head(s, title, now, width, score)]
    room = max(0, height - len(head))
    running = s.running
    shown = running if len(running) <= room else running[: max(0, room - 1)]
    wide = max((len(row.name) for row, _, _ in shown), default=0)
    body = [_cut(f"  {row.name:<{wide}}  {_where(at, now - since)}", width) for row, at, since in shown]
    if len(shown) < len(running) and room:
        body.append(_cut(f"  and {len(running) - len(shown)} more", width))
    return (head + body)[:height]


def line(s: Standing, title: str, now: float, score: str = "score") -> str:
    """The same in one line, for a log."""
    parts = [f"{title}: {_counts(s)}", f"{s.share:.0%}", *_times(s, now)]
    if s.best is not None:
        parts.append(f"best {score} {s.best.score:.3f} {s.best.name}")
    return ", ".join(parts)


def _head(s: Standing, title: str, now: float, width: int, score: str) -> list[str]:
    bar = max(10, min(40, width - 40))
    full = int(bar * s.share)
    out = [
        f"{title}: {_counts(s)}",
        f"{'█' * full}{'░' * (bar - full)} {s.share:4.0%}  {', '.join(_times(s, now))}",
    ]
    if s.best is not None:
        out.append(f"best {score} {s.best.score:.3f}  {s.best.name}")
    if s.failed:
        job, why = next(reversed(s.failed.items()))
        out.append(f"{len(s.failed)} failed, last {s.rows[job].name}: {' '.join(why.split())}")
    return out


def _counts(s: Standing) -> str:
    text = f"{len(s.done)} of {len(s.rows)} done"
    text += f" ({len(s.resumed)} from before)" if s.resumed else ""
    return text + (f", {len(s.failed)} failed" if s.failed else "")


def _times(s: Standing, now: float) -> list[str]:
    left = s.left_s(now)
    said = [duration(now - s.began)]
    if left is None:
        said.append("time left not known yet")
    elif left > 0:
        said.append(f"about {duration(left)} left")
    return said


def _where(at: At | None, passed: float) -> str:
    if at is None:
        return f"begun {duration(passed)} ago"
    loss = "" if at.loss is None else f"  loss {at.loss:.3f}"
    return f"epoch {at.step:>{len(str(at.steps))}} of {at.steps}{loss}"


def _cut(text: str, width: int) -> str:
    # Also what would move the cursor: a name may be anybody's.
    text = "".join(c if c.isprintable() else " " for c in text)
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"[:width]


def duration(seconds: float) -> str:
    """A time for people: 45 s, 3 min 20 s, 2 h 05 min, 4 d 3 h."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes:02d} min"
    return f"{hours // 24} d {hours % 24} h"


class Table:
    """Shows a run on standard error while it lasts; its ``on_…`` are what `run_jobs` asks for.

    A context manager. A terminal that is closed on the way ends the showing, not the run.
    """

    def __init__(
        self,
        title: str,
        rows: Mapping[str, Row],
        *,
        read: Callable[[Any], At | None],
        score: Callable[[Job, Result], Best | None] | None = None,
        score_name: str = "score",
        stream: TextIO | None = None,
    ) -> None:
        """``rows``: of every job's id; ``read``: where a job is, from its report; ``score``: of a result."""
        self._title, self._score_name = title, score_name
        self._read, self._score = read, score
        self._out = sys.stderr if stream is None else stream
        self._terminal = self._out.isatty()
        self._gone = False
        self.standing = Standing(rows, time.monotonic())
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._changed = False
        self._said: list[str] = []
        # What stands on the screen: so many lines, drawn when it had this size.
        self._drawn, self._size = 0, (0, 0)
        self._drawer = threading.Thread(target=self._keep_drawing, name="plushsense-table", daemon=True)

    def __enter__(self) -> Table:
        self.standing.began = time.monotonic()
        if self._terminal and sys.platform == "win32":
            os.system("")  # wakes the console's escape sequences
        self._drawer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._drawer.join(5)
        # A terminal that somebody holds (Ctrl-S) must not hold the run.
        if not self._drawer.is_alive():
            self._draw(last=True)

    def on_start(self, job: Job) -> None:
        """The job begins."""
        with self._lock:
            self.standing.start(job.id, time.monotonic())
            self._changed = True

    def on_report(self, job: Job, message: Any) -> None:
        """The job said something."""
        at = self._read(message)
        if at is not None:
            with self._lock:
                self.standing.report(job.id, at, time.monotonic())
                self._changed = True

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """The job is done."""
        best = None if self._score is None else self._score(job, result)
        with self._lock:
            self.standing.finish(job.id, best, resumed)
            self._changed = True

    def on_failed(self, job: Job, error: Exception) -> None:
        """The job was given up: said at once and for good, and shown in the table."""
        why = str(error) or type(error).__name__
        with self._lock:
            self.standing.fail(job.id, why)
            self._said.append(f"{self.standing.rows[job.id].name} failed: {why}")
            self._changed = True

    def say(self, text: str) -> None:
        """A sentence that stays above the table."""
        with self._lock:
            self._said.append(text)
            self._changed = True

    def _keep_drawing(self) -> None:
        drawn = lined = time.monotonic()
        while not self._stop.wait(_DRAW_S):
            now = time.monotonic()
            if self._terminal:
                if self._changed or now - drawn >= _CLOCK_S:
                    drawn = now
                    self._draw()
            elif now - lined >= _LINE_S or self._said:
                if now - lined >= _LINE_S:
                    lined = now
                    self._draw()
                else:
                    self._write("".join(f"{said}\n" for said in self._take_said()))

    def _take_said(self) -> Sequence[str]:
        with self._lock:
            said, self._said = self._said, []
        return said

    def _draw(self, last: bool = False) -> None:
        said = self._take_said()
        now = time.monotonic()
        if not self._terminal:
            with self._lock:
                told = line(self.standing, self._title, now, self._score_name)
            self._write("".join(f"{text}\n" for text in [*said, told]))
            return
        size = self._measure()
        if size != self._size and not last and self._drawn:
            # While somebody pulls at the window its lines move: begin below, once it keeps still.
            self._size, self._drawn = size, -1
            with self._lock:
                self._said[:0] = said
            return
        self._size = size
        with self._lock:
            self._changed = False
            shown = lines(self.standing, self._title, now, size[0] - 1, max(1, size[1] - 1), self._score_name)
        up = f"\x1b[{self._drawn}A" if self._drawn > 0 else "\n" if self._drawn < 0 else ""
        self._write(f"{up}\r\x1b[J" + "".join(f"{text}\n" for text in [*said, *shown]))
        self._drawn = len(shown)

    def _measure(self) -> tuple[int, int]:
        try:
            size = os.get_terminal_size(self._out.fileno())
        except (OSError, ValueError):
            return 80, 24
        # Some terminals do not know theirs.
        return max(20, size.columns or 80), max(2, size.lines or 24)

    def _write(self, text: str) -> None:
        if self._gone or not text:
            return
        try:
            self._out.write(text)
            self._out.flush()
        except (OSError, ValueError):
            self._gone = True
