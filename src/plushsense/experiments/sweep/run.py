"""A sweep: every trial of a grid trained and scored once, kept, and gone on with after whatever stopped it.

Windows are held once for each span that the networks need (one set for padding mirror and causal), in this process
and in each worker; a training adds its fold as float32. Results stay in memory until the end: 4 bytes for each tested
window × class × scored epoch, 182 kB for each of the paper's 156 trainings.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from plushsense.core.errors import ForgottenError, need
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.jobs.journal import JOURNAL, Result, job_id
from plushsense.jobs.pool import Job
from plushsense.jobs.progress import BestScore, JobInfo, JobsReporter, JobStep
from plushsense.reports.table import Table
from plushsense.trials.columns import listed_columns
from plushsense.trials.estimate import plan_seconds
from plushsense.trials.grid import GridSpec, changed, load_grid
from plushsense.trials.plan import GridProblems, Plan, Task, plan, processes, train_all
from plushsense.trials.tables import RUNS, TRIALS, Tables, check_place, summary_head
from plushsense.workflow.preparation import Warn, silent
from plushsense.workflow.reporting import journal_of


class Watcher(Protocol):
    """Observer of trainings while they run; a context manager around them."""

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: object) -> None: ...

    def on_start(self, job: Job) -> None:
        """Note that a training begins."""

    def on_report(self, job: Job, message: Any) -> None:
        """Note that a training is at (epoch, epochs, loss)."""

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """Note that a training is done, now or before."""

    def on_failed(self, job: Job, error: Exception) -> None:
        """Note that a training was given up."""


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


def report_jobs(planned: Plan, tables: Tables) -> JobsReporter:
    """Return a reporter of the trainings: what is done, what runs, the best so far, the time left."""

    def best(job: Job, result: Result) -> BestScore | None:
        row = tables.best
        if row is None:
            return None
        marks = " (leaky)" * row["leaky"] + " (simulation)" * row["simulated"]
        return BestScore(row["accuracy"], f"{row['arch']} {row['filters']}{marks}")

    rows = {job.id: JobInfo(_named(job.task), planned.macs(job)) for job in planned.jobs}
    return JobsReporter(
        f"sweep {planned.grid.name}",
        rows,
        read=lambda message: JobStep(*message),
        score=best,
        score_name="accuracy",
        unit="trainings",
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
        """Do nothing: no resource is held."""

    def on_start(self, job: Job) -> None:
        """Do nothing: the first epoch is reported."""

    def on_failed(self, job: Job, error: Exception) -> None:
        """Stop counting the training's share."""
        self._running.pop(job.id, None)

    def on_done(self, job: Job, result: Result, resumed: bool) -> None:
        """Report a training that is done, now or before."""
        self._done += 1
        self._resumed += resumed
        self._running.pop(job.id, None)
        self._finished += self._macs[job.id]
        self._tell(job, 0, 0)

    def on_report(self, job: Job, message: tuple[int, int, float]) -> None:
        """Report a training at (epoch, epochs, loss)."""
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


# So many trainings given up, and none done: the rest would go the same way.
_HOPELESS = 3


@dataclass(frozen=True)
class Sweep:
    """The outcome of `sweep`: the folder, and its summary (``sweep.json``)."""

    out: Path
    summary: dict[str, Any]

    @cached_property
    def trials(self) -> Any:
        """The table of trials, a polars frame; one row a network, number of epochs and batch."""
        return need("polars", "train").read_parquet(self.out / TRIALS)

    @cached_property
    def runs(self) -> Any:
        """The table of runs, a polars frame; one row a trial, seed and fold."""
        return need("polars", "train").read_parquet(self.out / RUNS)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {**self.summary, "out": str(self.out)}

    def _described(self) -> str:
        s = self.summary
        marks = ", leaky" * s["leaky"] + ", SIMULATION" * s["simulated"]
        return f"{s['done']} of {s['trials']} trials of the grid '{s['name']}', {s['split']}{marks}"

    def __repr__(self) -> str:
        best = self.summary["best"]
        first = f"; best {best[0]['arch']} {best[0]['filters']}: accuracy {best[0]['accuracy']:.3f}" if best else ""
        return f"Sweep({self._described()}{first}; {self.out})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(self._described())}</p>{best_table(self.summary).html()}"


def best_table(summary: Mapping[str, Any]) -> Table:
    """Return the best trials of a summary, as the command line and notebooks list them."""
    columns, rows = tuple(listed_columns(terminal=True)), tuple(summary["best"])
    return Table("best", "The best trials", columns, rows, leaky=summary["leaky"], simulated=summary["simulated"])


def sweep(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    split: str | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int = 0,
    cluster: str | None = None,
    progress: Callable[[SweepProgress], None] | None = None,
    table: Callable[[Plan, Tables], Watcher] | None = None,
    warn: Warn = silent,
    **changes: Any,
) -> Sweep:
    """Train and score every trial of a grid.

    Finished trainings are kept in the data set's ``cache`` folder, and the tables in ``out`` are renewed as they come;
    a sweep that was stopped or killed goes on from there.

    Args:
        grid: "paper", the path of a TOML file, or a `GridSpec`.
        split: instead of the grid's: "windows:holdout" (the paper's, leaky), "by-subject:5", "leave-one-subject-out".
        out: default ``evaluations/sweep-<name>`` in the data set; with the split and a hash where the grid was changed.
        workers: trainings at a time; 0: as many as the processors hold.
        cluster: address of a Ray cluster that trains instead of this machine's processes.
        progress: called with where it stands.
        table: `report_jobs`, to report the trainings on standard error.
        changes: keys of a grid, as ``epochs=(20,)``, ``architectures=…``, ``seeds=…``, ``threads=2``.

    Raises:
        ConfigError: with all problems of the grid at once, before anything is trained.
    """
    dataset = as_dataset(dataset)
    spec, told = resolve(grid, {**changes, "split": split})
    planned = plan(dataset, spec, told, warn)
    place = Path(out) if out is not None else default_place(dataset, grid, spec)
    check_place(place, planned.id, replace=overwrite)
    tables = Tables(planned, place, summary_head(dataset, planned))
    tables = Tables(planned, place, summary_head(dataset, planned), writing=dataset.generation.writing)
    teller = Teller(planned, tables, progress)

    watchers = [teller] if table is None else [teller, table(planned, tables)]
    try:
        _work_off(planned, dataset, tables, processes(workers, spec.threads), cluster, watchers)
    except BaseException:
        # What is finished stands in the tables; stopped before anything new, those of before stay.
        if len(tables.outcomes) > len(tables.resumed):
            tables.write()
        raise
    return Sweep(place, tables.write())


def _work_off(
    planned: Plan,
    dataset: Dataset,
    tables: Tables,
    workers: int,
    cluster: str | None,
    watchers: Sequence[Watcher],
) -> None:
    def started(job: Job) -> None:
        for watcher in watchers:
            watcher.on_start(job)

    def reported(job: Job, message: Any) -> None:
        for watcher in watchers:
            watcher.on_report(job, message)

    def done(job: Job, result: Result, resumed: bool) -> None:
        tables.add(job.id, result, resumed)
        for watcher in watchers:
            watcher.on_done(job, result, resumed)

    def failed(job: Job, error: Exception) -> None:
        if isinstance(error, ForgottenError):
            raise error
        tables.lose(job.id, str(error) or type(error).__name__)
        for watcher in watchers:
            watcher.on_failed(job, error)
        # What keeps the first ones from being trained keeps them all.
        if len(tables.lost) >= _HOPELESS and len(tables.outcomes) == len(tables.resumed):
            raise error

    with ExitStack() as stack:
        for watcher in watchers:
            stack.enter_context(watcher)
        train_all(
            dataset,
            planned,
            planned.jobs,
            workers=workers,
            cluster=cluster,
            on_start=started,
            on_report=reported,
            on_done=done,
            on_failed=failed,
        )


def resolve(grid: GridSpec | str | os.PathLike[str], changes: dict[str, Any]) -> tuple[GridSpec, list[str]]:
    """Return a grid with changes applied, and a sentence for each that could not be read."""
    if not isinstance(grid, GridSpec):
        return load_grid(os.fspath(grid), changes)
    return changed(grid, changes)


def default_place(dataset: Dataset, grid: GridSpec | str | os.PathLike[str], spec: GridSpec) -> Path:
    """Return the output folder of a sweep; that of a changed grid has its split and a hash in the name."""
    plain, _ = resolve(grid, {})
    name = f"sweep-{spec.name}"
    if plain != spec:
        split = re.sub(r"[^A-Za-z0-9-]+", "-", spec.split)
        name += f"-{split}-{job_id(spec.to_dict())[:8]}"
    return dataset.path / "evaluations" / name


def preview(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    measure: bool = False,
    warn: Warn = silent,
    **changes: Any,
) -> dict[str, Any]:
    """Return what `sweep` would train, without training: counts, cost in multiply-accumulates, and all problems.

    ``measure``: also ``seconds``, about how long what is not done yet takes here (see `estimating.plan_seconds`).
    """
    dataset = as_dataset(dataset)
    spec, told = resolve(grid, changes)
    try:
        planned = plan(dataset, spec, told, warn)
    except GridProblems as cause:
        return {"name": spec.name, "trials": 0, "problems": list(cause.found), "grid": spec.to_dict()}
    journal = journal_of(dataset, JOURNAL)
    macs = {job.id: planned.macs(job) for job in planned.jobs}
    total = sum(macs.values())
    shares: dict[str, float] = {}
    for job in planned.jobs:
        shares[job.task.arch.symbol] = shares.get(job.task.arch.symbol, 0.0) + macs[job.id] / total
    from plushsense.training.engine import step_bytes

    held = [step_bytes(job.task.arch, job.task.spec) for job in planned.jobs]
    more: dict[str, Any] = {}
    if measure:
        left = sum(macs[job.id] for job in planned.jobs if not journal.has(job.id))
        more["seconds"] = plan_seconds(planned, left, processes(0, spec.threads))
    return {
        "name": spec.name,
        "id": planned.id,
        "split": planned.split.text,
        "leaky": planned.split.leaky,
        "simulated": dataset.head.simulated,
        "trials": len(planned.trials),
        "trainings": len(planned.jobs),
        "folds": len(next(iter(planned.folds.values()))),
        "seeds": len(spec.seeds),
        "held": sum(journal.has(job.id) for job in planned.jobs),
        "macs": total,
        "macs_one_by_one": sum(planned.macs(job, nested=False) for job in planned.jobs),
        "windows_mb": sum(windows.x.nbytes for windows in planned.sets.values()) / 1e6,
        "training_mb": max((n for n in held if n is not None), default=0) / 1e6 if None not in held else None,
        "cost": dict(sorted(shares.items(), key=lambda item: -item[1])),
        "problems": [],
        "grid": spec.to_dict(),
        **more,
    }
