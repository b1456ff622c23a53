"""A sweep: every trial of a grid trained and scored once, kept, and gone on with after whatever stopped it.

Windows are held once for each span that the networks need (one set for padding mirror and causal), in this process
and in each worker; a training adds its fold as float32. Results stay in memory until the end: 4 bytes for each tested
window × class × scored epoch, 182 kB for each of the paper's 156 trainings.
"""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from plushsense import __version__
from plushsense.apps.preparation import Warn, opened, silent
from plushsense.apps.sweep_job import TrainAndScore
from plushsense.apps.sweep_plan import GridProblems, Plan, Task, plan, processes
from plushsense.apps.sweep_tables import TRIALS, Tables, check_place
from plushsense.core.extras import need
from plushsense.dataset.store import Dataset
from plushsense.runs.journal import Journal, Result, job_id
from plushsense.runs.pool import Job, run_jobs
from plushsense.runs.table import At, Best, Row, Table
from plushsense.training.grid import GridSpec
from plushsense.training.gridfile import changed, load_grid

JOURNAL, UNFINISHED = ("cache", "sweeps"), ("cache", "unfinished")

# So many trainings given up, and none done: the rest would go the same way.
_HOPELESS = 3


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


@dataclass(frozen=True)
class Sweep:
    """The outcome of `sweep`: the folder, and its summary (``sweep.json``)."""

    out: Path
    summary: dict[str, Any]

    @cached_property
    def trials(self) -> Any:
        """The table of trials, a polars frame; one row a network, number of epochs and batch."""
        return need("polars", "train").read_parquet(self.out / TRIALS)

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
        table: `live_table`, to see the trainings on standard error.
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
    teller = _Teller(planned, tables, progress)

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
    """The one place where trainings are handed out."""
    results, unfinished = Journal(dataset.path.joinpath(*JOURNAL)), Journal(dataset.path.joinpath(*UNFINISHED))

    def started(job: Job) -> None:
        for watcher in watchers:
            watcher.on_start(job)

    def reported(job: Job, message: Any) -> None:
        for watcher in watchers:
            watcher.on_report(job, message)

    def done(job: Job, result: Result, resumed: bool) -> None:
        unfinished.discard(job.id)
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
        run_jobs(
            planned.jobs,
            # Nodes of a cluster do not share a disk: there a training is done whole.
            TrainAndScore(unfinished if cluster is None else None),
            shared=(planned.sets, planned.folds),
            workers=workers,
            threads=planned.grid.threads,
            journal=results,
            cluster=cluster,
            gpus=1.0 if cluster is not None and planned.grid.device == "cuda" else 0.0,
            on_start=started,
            on_report=reported,
            on_done=done,
            on_failed=failed,
        )


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
    filters = "/".join(map(str, task.arch.filters))
    return f"{task.arch.symbol} {filters} batch {task.spec.batch} seed {task.spec.seed} fold {task.fold + 1}"


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
        "machine": machine(grid.threads),
        "code_version": __version__,
    }


def machine(threads: int) -> str:
    """Processor, threads and PyTorch in plain words."""
    named = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        named = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    torch = need("torch", "train")
    return (
        f"{named}, {os.cpu_count()} processors, {threads} thread{'s' * (threads > 1)} a training, "
        f"PyTorch {torch.__version__}, {platform.system()}"
    )


class _Teller:
    """Turns what jobs say into `SweepProgress`; the share counts multiply-accumulates, of running trainings too."""

    def __init__(self, planned: Plan, tables: Tables, progress: Callable[[SweepProgress], None] | None) -> None:
        self._macs = {job.id: planned.macs(job) for job in planned.jobs}
        self._all = sum(self._macs.values()) or 1
        self._finished = self._done = self._resumed = 0
        self._running: dict[str, float] = {}
        self._tables, self._progress = tables, progress

    def __enter__(self) -> _Teller:
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
        what = f"{task.arch.symbol} {'/'.join(map(str, task.arch.filters))} batch {task.spec.batch}"
        share = (self._finished + sum(self._running.values())) / self._all
        at = (self._done, len(self._macs), self._resumed, share, what, epoch, epochs, self._tables.best)
        self._progress(SweepProgress(*at))


def preview(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    warn: Warn = silent,
    **changes: Any,
) -> dict[str, Any]:
    """What `sweep` would train, without training: counts, cost in multiply-accumulates, and all problems."""
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
        "activations_mb": max(_activation_bytes(job.task) for job in planned.jobs) / 1e6,
        "cost": dict(sorted(shares.items(), key=lambda item: -item[1])),
        "problems": [],
        "grid": spec.to_dict(),
    }


def _activation_bytes(task: Task) -> int:
    """What all layers give for one batch, as float32, once."""
    arch = task.arch
    return 4 * task.spec.batch * sum(f * n for f, n in zip(arch.filters, arch.positions, strict=True))
