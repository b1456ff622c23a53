"""Train and score every trial of a grid (a sweep), and continue after an interruption.

Memory: this process and each worker hold one set of windows for each span that the networks need (a single set with
padding mirror or causal), and each training a copy of its fold as float32. Results stay in memory until the end: 4
bytes for each tested window × class × scored epoch, 182 kB for each of the paper's 156 trainings.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from plushsense.core.errors import ForgottenError, need, python_warning
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.jobs.journal import JOURNAL, Result, job_id
from plushsense.jobs.pool import Job
from plushsense.jobs.progress import BestScore, JobInfo, JobProgress, JobsReporter, JobStep
from plushsense.reports.table import Table
from plushsense.trials.estimate import plan_seconds
from plushsense.trials.grid import GridSpec, load_grid
from plushsense.trials.plan import GridProblems, Plan, Task, plan, processes, train_all
from plushsense.trials.tables import (
    PAPER_CHOICE,
    RUNS,
    SUMMARY,
    TRIALS,
    Tables,
    listed_columns,
    networks_to_keep,
    summary_head,
)
from plushsense.workflow.preparation import Warn
from plushsense.workflow.reporting import check_results, journal_of


def _reporter(planned: Plan, tables: Tables, progress: Callable[[JobProgress], None] | None) -> JobsReporter:
    """Return a progress reporter that weights trainings by their cost in multiply-accumulates."""

    def best(job: Job, result: Result) -> BestScore | None:
        row = tables.best
        if row is None:
            return None
        marks = " (leaky)" * row["leaky"] + " (simulation)" * row["simulated"]
        return BestScore(row["accuracy"], f"{row['arch']} {row['filters']}{marks}", row)

    def name(task: Task) -> str:
        return f"{task.arch.title} batch {task.spec.batch} seed {task.spec.seed} fold {task.fold + 1}"

    return JobsReporter(
        {job.id: JobInfo(name(job.task), planned.macs(job)) for job in planned.jobs},
        title=f"sweep {planned.grid.name}",
        unit="trainings",
        read=lambda job, message: JobStep(*message),
        score=best,
        score_name="accuracy",
        progress=progress,
    )


# Number of failed trainings after which a sweep stops if none has succeeded.
_HOPELESS = 3


@dataclass(frozen=True)
class Sweep:
    """The result of `sweep`: the output folder, and the summary that is stored there as ``sweep.json``."""

    out: Path
    summary: dict[str, Any]

    @cached_property
    def trials(self) -> Any:
        """The table of trials, a polars frame with a row for each network, number of epochs and batch."""
        return need("polars", "train").read_parquet(self.out / TRIALS)

    @cached_property
    def runs(self) -> Any:
        """The table of runs, a polars frame with a row for each trial, seed and fold."""
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
    """Return the table of the best trials in a summary, which the command line and notebooks show."""
    columns, rows = tuple(listed_columns(terminal=True)), tuple(summary["best"])
    return Table("best", "The best trials", columns, rows, leaky=summary["leaky"], simulated=summary["simulated"])


def sweep(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int = 0,
    cluster: str | None = None,
    keep_predictions: str = PAPER_CHOICE,
    progress: Callable[[JobProgress], None] | None = None,
    display: bool = False,
    warn: Warn = python_warning,
    **changes: Any,
) -> Sweep:
    """Train and score every trial of a grid.

    Finished trainings are kept in the data set's ``cache`` folder, so that a stopped or killed sweep can be continued.
    The tables in ``out`` are updated during the run.

    Args:
        grid: "paper", the path of a TOML file, or a `GridSpec`.
        out: output folder; see `default_place` for the default.
        workers: number of trainings at a time; 0: as many as the processor cores allow.
        cluster: address of a Ray cluster that trains instead of this machine's processes.
        keep_predictions: the networks whose predictions and confusions are kept; see `networks_to_keep`.
        progress: called when a training reports an epoch or is done.
        display: show the trainings, the best score so far and the time left on standard error.
        changes: new values of a grid's keys, such as ``split="by-subject:5"`` (the paper's "windows:holdout" is leaky),
            ``epochs=(20,)``, ``architectures=…``, ``seeds=…``, ``threads=2``.

    Raises:
        ConfigError: with all problems of the grid at once, before anything is trained.
    """
    dataset = as_dataset(dataset)
    spec, wrong = load_grid(grid, changes)
    planned = plan(dataset, spec, wrong, warn)
    place = Path(out) if out is not None else default_place(dataset, grid, spec)
    keep = networks_to_keep(planned, keep_predictions)
    check_results(place, "A sweep", SUMMARY, planned.id, replace=overwrite)
    tables = Tables(planned, place, summary_head(dataset, planned), dataset.generation.writing, keep)
    reporter = _reporter(planned, tables, progress)

    def done(job: Job, result: Result, resumed: bool) -> None:
        tables.add(job.id, result, resumed)
        reporter.on_done(job, result, resumed)

    def failed(job: Job, error: Exception) -> None:
        if isinstance(error, ForgottenError):
            raise error
        tables.lose(job.id, str(error) or type(error).__name__)
        reporter.on_failed(job, error)
        # If all of the first trainings fail, the others will probably fail for the same reason.
        if len(tables.lost) >= _HOPELESS and len(tables.outcomes) == len(tables.resumed):
            raise error

    try:
        with reporter if display else nullcontext():
            results = train_all(
                dataset,
                planned,
                planned.jobs,
                workers=processes(workers, spec.threads),
                cluster=cluster,
                on_start=reporter.on_start,
                on_report=reporter.on_report,
                on_done=done,
                on_failed=failed,
            )
    except BaseException:
        # Write the tables of finished trainings, unless none of them is new.
        if len(tables.outcomes) > len(tables.resumed):
            tables.write()
        raise
    return Sweep(place, tables.write(results))


def default_place(dataset: Dataset, grid: GridSpec | str | os.PathLike[str], spec: GridSpec) -> Path:
    """Return ``evaluations/sweep-<name>`` in the data set; with the split and a hash appended for a changed grid."""
    plain, _ = load_grid(grid)
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
    keep_predictions: str = PAPER_CHOICE,
    warn: Warn = python_warning,
    **changes: Any,
) -> dict[str, Any]:
    """Return counts of what `sweep` would train, the cost in multiply-accumulates, and all problems, without training.

    With ``measure``, the result has ``seconds``, an estimate of the time of the missing trainings on this machine.
    """
    dataset = as_dataset(dataset)
    spec, wrong = load_grid(grid, changes)
    try:
        planned = plan(dataset, spec, wrong, warn)
    except GridProblems as cause:
        return {"name": spec.name, "trials": 0, "problems": list(cause.problems), "grid": spec.to_dict()}
    networks_to_keep(planned, keep_predictions)
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
        "windows_mb": sum(windows.integers.nbytes for windows in planned.sets.values()) / 1e6,
        "training_mb": max((n for n in held if n is not None), default=0) / 1e6 if None not in held else None,
        "cost": dict(sorted(shares.items(), key=lambda item: -item[1])),
        "problems": [],
        "grid": spec.to_dict(),
        **more,
    }
