"""A sweep: every trial of a grid trained and scored once, kept, and gone on with after whatever stopped it.

Windows are held once for each span that the networks need (one set for padding mirror and causal), in this process
and in each worker; a training adds its fold as float32. Results stay in memory until the end: 4 bytes for each tested
window × class × scored epoch, 182 kB for each of the paper's 156 trainings.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from plushsense import __version__
from plushsense.apps.estimating import plan_seconds
from plushsense.apps.places import machine
from plushsense.apps.preparation import Warn, opened, silent
from plushsense.apps.sweep_job import JOURNAL, train_all
from plushsense.apps.sweep_plan import GridProblems, Plan, plan, processes
from plushsense.apps.sweep_shown import SweepProgress, Teller, Watcher
from plushsense.apps.sweep_tables import RUNS, TRIALS, Tables, check_place
from plushsense.core.extras import need
from plushsense.dataset.store import Dataset
from plushsense.runs.journal import Journal, Result, job_id
from plushsense.runs.pool import Job
from plushsense.training.grid import GridSpec
from plushsense.training.gridfile import changed, load_grid

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
        """Plain values, ready for JSON."""
        return {**self.summary, "out": str(self.out)}

    def _said(self) -> str:
        s = self.summary
        marks = ", leaky" * s["leaky"] + ", SIMULATION" * s["simulated"]
        return f"{s['done']} of {s['trials']} trials of the grid '{s['name']}', {s['split']}{marks}"

    def __repr__(self) -> str:
        best = self.summary["best"]
        first = f"; best {best[0]['arch']} {best[0]['filters']}: accuracy {best[0]['accuracy']:.3f}" if best else ""
        return f"Sweep({self._said()}{first}; {self.out})"

    def _repr_html_(self) -> str:
        mark = " (leaky)" if self.summary["leaky"] else ""
        head = ("arch", "filters", "epochs", "batch_asked", "parameters", "macs_per_step")
        scores = ("accuracy", "macro_f1", "acr")
        title = [*head, *(name + mark for name in scores)]
        rows = [[*(row[k] for k in head), *(f"{row[k]:.3f}" for k in scores)] for row in self.summary["best"]]
        cells = "".join("<tr>" + "".join(f"<td>{value}</td>" for value in row) + "</tr>" for row in rows)
        return (
            f"<table><caption>{self._said()}</caption>"
            f"<tr>{''.join(f'<th>{name}</th>' for name in title)}</tr>{cells}</table>"
        )


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
        table: `sweep_shown.live_table`, to see the trainings on standard error.
        changes: keys of a grid, as ``epochs=(20,)``, ``architectures=…``, ``seeds=…``, ``threads=2``.

    Raises:
        ConfigError: with all problems of the grid at once, before anything is trained.
    """
    dataset = opened(dataset)
    spec, told = resolve(grid, {**changes, "split": split})
    planned = plan(dataset, spec, told, warn)
    place = Path(out) if out is not None else default_place(dataset, grid, spec)
    check_place(place, planned.id, replace=overwrite)
    tables = Tables(planned, place, head(dataset, planned))
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
    """A grid with changes over it, and what could not be read of them."""
    if not isinstance(grid, GridSpec):
        return load_grid(os.fspath(grid), changes)
    return changed(grid, changes)


def default_place(dataset: Dataset, grid: GridSpec | str | os.PathLike[str], spec: GridSpec) -> Path:
    """The folder of a sweep: a person tells them apart by the words, a changed grid has a hash of its own."""
    plain, _ = resolve(grid, {})
    name = f"sweep-{spec.name}"
    if plain != spec:
        split = re.sub(r"[^A-Za-z0-9-]+", "-", spec.split)
        name += f"-{split}-{job_id(spec.to_dict())[:8]}"
    return dataset.path / "evaluations" / name


def head(dataset: Dataset, planned: Plan) -> dict[str, Any]:
    """What a summary says of data, grid and machine."""
    grid = planned.grid
    return {
        "name": grid.name,
        "id": planned.id,
        "dataset": dataset.head.name,
        "dataset_hash": dataset.hash,
        "simulated": dataset.head.simulated,
        "split": planned.split.text,
        "leaky": planned.split.leaky,
        "context": grid.context,
        "preset": grid.preset,
        "grid": grid.to_dict(),
        "labels": list(planned.gestures.labels),
        "affects": list(planned.gestures.affects),
        "windows": max(len(windows) for windows in planned.sets.values()),
        "machine": machine(
            f"{os.cpu_count()} processors",
            f"{grid.threads} thread{'s' * (grid.threads > 1)} a training",
            f"PyTorch {need('torch', 'train').__version__}",
        ),
        "code_version": __version__,
    }


def preview(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    measure: bool = False,
    warn: Warn = silent,
    **changes: Any,
) -> dict[str, Any]:
    """What `sweep` would train, without training: counts, cost in multiply-accumulates, and all problems.

    ``measure``: also ``seconds``, about how long what is not done yet takes here (see `estimating.plan_seconds`).
    """
    dataset = opened(dataset)
    spec, told = resolve(grid, changes)
    try:
        planned = plan(dataset, spec, told, warn)
    except GridProblems as cause:
        return {"name": spec.name, "trials": 0, "problems": list(cause.found), "grid": spec.to_dict()}
    journal = Journal(dataset.path.joinpath(*JOURNAL))
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
