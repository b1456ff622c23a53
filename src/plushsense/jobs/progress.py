"""Progress of long work on standard error: a live display on a terminal, a plain line every ten seconds elsewhere.

`ProgressReporter` counts items; `JobsReporter` follows many jobs of different cost. At most one reporter is active.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TextIO

from plushsense.core.errors import printable

if TYPE_CHECKING:
    from rich.console import ConsoleDimensions, RenderableType

    from plushsense.jobs.journal import Job, Result

_REFRESH_S, _LINE_S = 0.2, 10.0

_active: Reporter | None = None


class JobInfo(NamedTuple):
    """The name of a job and its cost, in any unit that all jobs share."""

    name: str
    cost: float


class JobStep(NamedTuple):
    """The step (epoch) that a job has reached, its last loss, and the step ``first`` that it continued from."""

    step: int
    steps: int
    loss: float | None = None
    first: int = 0


class BestScore(NamedTuple):
    """A score (higher is better), with the name and, if there is one, the table row of the job that reached it."""

    score: float
    name: str
    row: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class JobProgress:
    """Progress of many jobs: ``done`` of ``total``, of which an earlier run finished ``resumed``.

    ``share`` is the finished share of the cost, that of running jobs included. ``name`` is the job that caused this
    report: it has reached ``epoch`` of ``epochs`` and sent ``message``, or it is done (epoch 0).
    """

    done: int
    total: int
    resumed: int
    share: float
    name: str
    epoch: int = 0
    epochs: int = 0
    message: Any = None
    best: BestScore | None = None


@dataclass(frozen=True)
class ProgressStatus:
    """The state that a reporter displays; ``left_s`` is None while it cannot be estimated."""

    title: str
    done: int
    total: int
    unit: str = ""
    resumed: int = 0
    failed: int = 0
    share: float = 0.0
    elapsed_s: float = 0.0
    left_s: float | None = None
    notes: Sequence[str] = ()
    running: Sequence[tuple[str, str]] = ()

    @property
    def counts(self) -> str:
        """The counts as text: ``sweep: 2 of 4 trainings (1 from before), 1 failed``."""
        text = f"{self.title}: {self.done} of {self.total}{' ' * bool(self.unit)}{self.unit}"
        text += f" ({self.resumed} from before)" if self.resumed else ""
        return text + (f", {self.failed} failed" if self.failed else "")

    @property
    def times(self) -> str:
        """The elapsed time, and an estimate of the remaining time, as text."""
        left = f", about {duration(self.left_s)} left" if self.left_s and self.done < self.total else ""
        return f"{duration(self.elapsed_s)}{left}"

    @property
    def line(self) -> str:
        """The status without the running jobs as one line for a log."""
        return printable(", ".join([self.counts, f"{self.share:.0%}", self.times, *self.notes]))

    def render(self, height: int = 1000) -> RenderableType:
        """Return the live display, at most ``height`` lines; running jobs are left out first."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        def cropped(text: str, style: str = "") -> Text:
            return Text(printable(text), style, no_wrap=True, overflow="ellipsis")

        bar = Table.grid(padding=(0, 1), pad_edge=False)
        bar.add_row(ProgressBar(total=1.0, completed=self.share, width=16), f"{self.share:4.0%}", cropped(self.times))
        head: list[RenderableType] = [cropped(self.counts, "bold"), bar, *(cropped(note) for note in self.notes)]
        rows = max(0, height - len(head))
        visible = self.running if len(self.running) <= rows else self.running[: max(0, rows - 1)]
        width = max((len(name) for name, _ in visible), default=0)
        body: list[RenderableType] = [cropped(f"  {name:<{width}}  {where}", "dim") for name, where in visible]
        if len(visible) < len(self.running) and rows:
            body.append(cropped(f"  and {len(self.running) - len(visible)} more", "dim"))
        return Group(*[*head, *body][:height])


class Reporter(ABC):
    """Base of both reporters: draws the display in a thread of its own.

    Closing the terminal ends the display but not the work.
    """

    def __init__(self, *, keep: bool, stream: TextIO | None) -> None:
        self._keep, self._stream = keep, stream
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._messages: list[str] = []
        self._began = time.monotonic()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Start the display, unless it is running, and end that of any other reporter."""
        global _active
        if self._thread is not None:
            return
        close_active()
        _active = self
        self._began = time.monotonic()
        self._stop.clear()
        out = sys.stderr if self._stream is None else self._stream
        self._thread = threading.Thread(target=self._run, args=(out,), name="plushsense-progress", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the display and write its last state."""
        global _active
        thread, self._thread = self._thread, None
        if _active is self:
            _active = None
        if thread is not None:
            self._stop.set()
            # A terminal on hold (Ctrl-S) must not stop the work.
            thread.join(5)

    def write(self, text: str) -> None:
        """Write a line that stays above the display."""
        with self._lock:
            self._messages.append(printable(text))

    @abstractmethod
    def status(self, now: float) -> ProgressStatus:
        """Return what to display at ``now``, in seconds of `time.monotonic`."""

    def _run(self, out: TextIO) -> None:
        # A closed terminal or a full disk must not stop the work.
        with contextlib.suppress(OSError, ValueError):
            if out.isatty() and os.environ.get("TERM") not in ("dumb", "unknown"):
                self._draw_live(out)
            else:
                self._write_lines(out)

    def _write_lines(self, out: TextIO) -> None:
        written = self._began
        stopped = False
        while not stopped:
            stopped = self._stop.wait(_REFRESH_S)
            now = time.monotonic()
            lines = self._take_messages()
            if now - written >= _LINE_S or (stopped and (self._keep or written > self._began)):
                written = now
                lines.append(self.status(now).line)
            if lines:
                out.write("".join(f"{line}\n" for line in lines))
                out.flush()

    def _draw_live(self, out: TextIO) -> None:
        from rich.console import Console
        from rich.live import Live

        console = Console(file=out, force_terminal=True, force_jupyter=False, highlight=False)
        live = Live(
            get_renderable=lambda: self.status(time.monotonic()).render(console.height - 1),
            console=console,
            auto_refresh=False,
            transient=not self._keep,
            redirect_stdout=False,  # results go there
            redirect_stderr=out is sys.stderr,  # messages appear above the display
        )
        stopped = False
        with live:
            while not stopped:
                stopped = self._stop.wait(_REFRESH_S)
                console.size = _measure(out)
                for message in self._take_messages():
                    console.print(message, markup=False, soft_wrap=True)
                live.refresh()

    def _take_messages(self) -> list[str]:
        with self._lock:
            messages, self._messages = self._messages, []
        return messages


class ProgressReporter(Reporter):
    """Shows how many items are done; call it with ``(done, total)``.

    The display starts with the first call and ends when all items are done, or with `close`.
    """

    def __init__(self, title: str, unit: str = "", *, keep: bool = False, stream: TextIO | None = None) -> None:
        """Prepare the display.

        Args:
            title: the activity, such as "reading".
            unit: plural noun of the items, such as "folds".
            keep: leave the last state on the terminal, and log it even if the work was short.
            stream: where to write; by default standard error.
        """
        super().__init__(keep=keep, stream=stream)
        self._status = ProgressStatus(title, 0, 0, unit)

    def __call__(
        self, done: int, total: int, *, detail: str = "", resumed: int = 0, share: float | None = None
    ) -> None:
        """Report that ``done`` of ``total`` items are done.

        Args:
            detail: further text to display, such as the last loss.
            resumed: how many of ``done`` an earlier run finished; they do not count for the speed of this one.
            share: share of the work that is done, where it is not done / total; the time left is then not estimated.
        """
        self.start()
        elapsed = time.monotonic() - self._began
        fresh = done - resumed
        with self._lock:
            self._status = replace(
                self._status,
                done=done,
                total=total,
                resumed=resumed,
                share=share if share is not None else done / total if total else 1.0,
                elapsed_s=elapsed,
                left_s=elapsed / fresh * (total - done) if fresh > 0 and share is None else None,
                notes=(detail,) if detail else (),
            )
        if done >= total:
            self.close()

    def status(self, now: float) -> ProgressStatus:
        with self._lock:
            last = self._status
        elapsed = now - self._began
        left = None if last.left_s is None else max(1.0, last.left_s - (elapsed - last.elapsed_s))
        return replace(last, elapsed_s=elapsed, left_s=left)


@dataclass
class JobsState:
    """State of many jobs. It has no clock: times are passed in, in seconds of any monotonic clock."""

    jobs: Mapping[str, JobInfo]
    began: float
    done: set[str] = field(default_factory=set)
    resumed: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    best: BestScore | None = None
    _running: dict[str, tuple[float, JobStep | None]] = field(default_factory=dict)
    _most_parallel: int = 0

    def start(self, job: str, now: float) -> None:
        """Mark a job as started at ``now``."""
        self._running[job] = now, None
        self._most_parallel = max(self._most_parallel, len(self._running))

    def step(self, job: str, step: JobStep, now: float) -> None:
        """Record the step that a job has reached."""
        if job in self.done or job in self.failed:
            return
        if job not in self._running:
            self.start(job, now)
        self._running[job] = self._running[job][0], step

    def finish(self, job: str, best: BestScore | None = None, resumed: bool = False) -> None:
        """Mark a job as done, by this run or (``resumed``) by an earlier one."""
        self._running.pop(job, None)
        self.done.add(job)
        if resumed:
            self.resumed.add(job)
        if best is not None and (self.best is None or best.score >= self.best.score):
            self.best = best

    def fail(self, job: str, why: str) -> None:
        """Mark a job as failed."""
        self._running.pop(job, None)
        self.failed[job] = why

    @property
    def share(self) -> float:
        """Share of the total cost that is done, 0 to 1."""
        total = sum(job.cost for job in self.jobs.values())
        return 1.0 if total <= 0 else 1.0 - sum(self._open().values()) / total

    def left_s(self, now: float) -> float | None:
        """Estimate the time until all jobs are done; None while the speed is unknown.

        The speed is the finished cost per second of this run; the result is at least the time of the longest open job.
        """
        open_costs = self._open()
        open_cost = sum(open_costs.values())
        if open_cost <= 0:
            return 0.0
        # How far failed jobs came is unknown, so they count neither as finished nor as open.
        finished_cost = sum(self.jobs[job].cost for job in self.done - self.resumed)
        finished_cost += sum(self.jobs[job].cost - open_costs[job] for job in self._running)
        if finished_cost <= 0 or now <= self.began:
            return None
        return max(open_cost, max(open_costs.values()) * self._most_parallel) / finished_cost * (now - self.began)

    def status(self, title: str, unit: str, score_name: str, now: float) -> ProgressStatus:
        """Return what to display at ``now``; the jobs that have run longest come first."""
        notes = [] if self.best is None else [f"best {score_name} {self.best.score:.3f} {self.best.name}"]
        if self.failed:
            job, why = next(reversed(self.failed.items()))
            notes.append(f"last failed: {self.jobs[job].name}: {' '.join(why.split())}")
        by_age = sorted(self._running.items(), key=lambda item: item[1][0])
        return ProgressStatus(
            title,
            len(self.done),
            len(self.jobs),
            unit,
            len(self.resumed),
            len(self.failed),
            self.share,
            now - self.began,
            self.left_s(now),
            notes,
            [(self.jobs[job].name, _position(step, now - since)) for job, (since, step) in by_age],
        )

    def _open(self) -> dict[str, float]:
        """Return the remaining cost of every job that is neither done nor failed."""
        steps = {job: step for job, (_, step) in self._running.items() if step is not None}
        parts = {job: min(1.0, (s.step - s.first) / max(1, s.steps - s.first)) for job, s in steps.items()}
        return {
            job: info.cost * (1.0 - parts.get(job, 0.0))
            for job, info in self.jobs.items()
            if job not in self.done and job not in self.failed
        }


def read_epoch(_: Job, message: Sequence[Any]) -> JobStep:
    """Return the step in a message that begins with (epoch, epochs)."""
    return JobStep(message[0], message[1])


class JobsReporter(Reporter):
    """Follows many jobs; its ``on_…`` methods are the callbacks of `run_jobs`.

    It calls ``progress`` when a job reports or is done, and displays the jobs while it is used as a context manager.
    """

    def __init__(
        self,
        jobs: Mapping[str, JobInfo],
        *,
        title: str = "",
        unit: str = "jobs",
        read: Callable[[Job, Any], JobStep] = read_epoch,
        score: Callable[[Job, Result], BestScore | None] | None = None,
        score_name: str = "score",
        progress: Callable[[JobProgress], None] | None = None,
        stream: TextIO | None = None,
    ) -> None:
        """Prepare the display.

        Args:
            jobs: name and cost of every job, by its id.
            read: returns the step in a message of a job.
            score: returns the score of a result.
            progress: called when a job reports or is done.
        """
        super().__init__(keep=True, stream=stream)
        self._title, self._unit = title, unit
        self._read, self._score, self._score_name, self._progress = read, score, score_name, progress
        self.state = JobsState(jobs, time.monotonic())

    def start(self) -> None:
        self.state.began = time.monotonic()
        super().start()

    def on_start(self, job: Job) -> None:
        """Mark a job as running."""
        with self._lock:
            self.state.start(job.id, time.monotonic())

    def on_report(self, job: Job, message: Any) -> None:
        """Record the step in a message of a job."""
        step = self._read(job, message)
        with self._lock:
            self.state.step(job.id, step, time.monotonic())
        self._notify(job, step, message)

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """Mark a job as done and keep its score if it is the best."""
        best = None if self._score is None else self._score(job, result)
        with self._lock:
            self.state.finish(job.id, best, resumed)
        self._notify(job)

    def on_failed(self, job: Job, error: Exception) -> None:
        """Mark a job as failed and write the reason above the display."""
        why = str(error) or type(error).__name__
        with self._lock:
            self.state.fail(job.id, why)
        self.write(f"{self.state.jobs[job.id].name} failed: {why}")

    def _notify(self, job: Job, step: JobStep | None = None, message: Any = None) -> None:
        if self._progress is None:
            return
        s, (epoch, epochs) = self.state, (0, 0) if step is None else step[:2]
        done, total, resumed, name = len(s.done), len(s.jobs), len(s.resumed), s.jobs[job.id].name
        self._progress(JobProgress(done, total, resumed, s.share, name, epoch, epochs, message, s.best))

    def status(self, now: float) -> ProgressStatus:
        with self._lock:
            return self.state.status(self._title, self._unit, self._score_name, now)


def close_active() -> None:
    """End the display of the active reporter, if there is one."""
    if _active is not None:
        _active.close()


def duration(seconds: float) -> str:
    """Format a duration: ``45 s``, ``3 min 20 s``, ``2 h 05 min``, ``4 d 3 h``."""
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


def _position(step: JobStep | None, elapsed_s: float) -> str:
    if step is None:
        return f"started {duration(elapsed_s)} ago"
    loss = "" if step.loss is None else f"  loss {step.loss:.3f}"
    return f"epoch {step.step:>{len(str(step.steps))}} of {step.steps}{loss}"


def _measure(stream: TextIO) -> ConsoleDimensions:
    """Return the terminal's size; 80 × 24 if it is unknown."""
    from rich.console import ConsoleDimensions

    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return ConsoleDimensions(80, 24)
    return ConsoleDimensions(max(20, size.columns or 80), max(2, size.lines or 24))
