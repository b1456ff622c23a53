"""Who is told while a sweep's trainings are worked off: a live table on standard error, a callback of a program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from plushsense.apps.sweep_plan import Plan, Task
from plushsense.apps.sweep_tables import Tables
from plushsense.runs.journal import Result
from plushsense.runs.pool import Job
from plushsense.runs.table import At, Best, Row, Table


class Watcher(Protocol):
    """Who is told of trainings while they are worked off; a context manager around it."""

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: object) -> None: ...

    def on_start(self, job: Job) -> None:
        """It begins."""

    def on_report(self, job: Job, message: Any) -> None:
        """It is at (epoch, epochs, loss)."""

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """It is done, or was before."""

    def on_failed(self, job: Job, error: Exception) -> None:
        """It was given up."""


class SweepProgress(NamedTuple):
    """Where a sweep stands: ``share`` of its work; ``epoch`` of ``epochs`` in ``what``, 0: that training is done.

    ``best`` is the row of the best trial that is complete.
    """

    done: int
    trainings: int
    resumed: int
    share: float
    what: str
    epoch: int
    epochs: int
    best: dict[str, Any] | None


def live_table(planned: Plan, tables: Tables) -> Table:
    """A table of the trainings on standard error: what is done, what runs, the best so far, the time left."""

    def best(job: Job, result: Result) -> Best | None:
        row = tables.best
        if row is None:
            return None
        marks = " (leaky)" * row["leaky"] + " (simulation)" * row["simulated"]
        return Best(row["accuracy"], f"{row['arch']} {row['filters']}{marks}")

    rows = {job.id: Row(_named(job.task), planned.macs(job)) for job in planned.jobs}
    return Table(
        f"sweep {planned.grid.name}",
        rows,
        read=lambda message: At(*message),
        score=best,
        score_name="accuracy",
    )


def _named(task: Task) -> str:
    return f"{task.arch.title} batch {task.spec.batch} seed {task.spec.seed} fold {task.fold + 1}"


class Teller:
    """Turns what jobs say into `SweepProgress`; the share counts multiply-accumulates, of running trainings too."""

    def __init__(self, planned: Plan, tables: Tables, progress: Callable[[SweepProgress], None] | None) -> None:
        self._macs = {job.id: planned.macs(job) for job in planned.jobs}
        self._all = sum(self._macs.values()) or 1
        self._finished = self._done = self._resumed = 0
        self._running: dict[str, float] = {}
        self._tables, self._progress = tables, progress

    def __enter__(self) -> Teller:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is held."""

    def on_start(self, job: Job) -> None:
        """Told with its first epoch."""

    def on_failed(self, job: Job, error: Exception) -> None:
        """Its share is not counted any more."""
        self._running.pop(job.id, None)

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """It is done, or was before."""
        self._done += 1
        self._resumed += resumed
        self._running.pop(job.id, None)
        self._finished += self._macs[job.id]
        self._tell(job, 0, 0)

    def on_report(self, job: Job, message: tuple[int, int, float]) -> None:
        """It is at (epoch, epochs, loss)."""
        self._running[job.id] = message[0] / message[1] * self._macs[job.id]
        self._tell(job, *message[:2])

    def _tell(self, job: Job, epoch: int, epochs: int) -> None:
        if self._progress is None:
            return
        task: Task = job.task
        what = f"{task.arch.title} batch {task.spec.batch}"
        share = (self._finished + sum(self._running.values())) / self._all
        at = (self._done, len(self._macs), self._resumed, share, what, epoch, epochs, self._tables.best)
        self._progress(SweepProgress(*at))
