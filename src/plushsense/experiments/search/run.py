"""A search: the networks of a grid by successive halving, within a stated share of what the whole grid would cost.

Its trainings are a sweep's, with the same ids in the same journal: one that a sweep has done is not done again, and
the other way round. A training that goes on to the next rung starts from its state of the last; where the journal
holds none (it is of a sweep), from the beginning, with the same outcome.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from plushsense.core.errors import BadInput, ConfigError
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.experiments.search.halving import (
    QUARTER,
    Costs,
    Rung,
    Scores,
    SearchSpec,
    asked_of,
    halving,
    load_search,
    none_left,
    problems,
)
from plushsense.experiments.search.score import Prepared, SearchTables, left_out, summed_up, write_summary
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import Job
from plushsense.models.arch import Arch, slashed
from plushsense.training.engine import FitState
from plushsense.trials.estimate import plan_seconds
from plushsense.trials.grid import GridSpec, changed
from plushsense.trials.plan import (
    GridProblems,
    PlannedRun,
    Task,
    TrainingOutcome,
    outcome,
    plans_by_epochs,
    processes,
    train_all,
)
from plushsense.trials.tables import check_place, summary_head
from plushsense.workflow.preparation import Warn, silent


class SearchProgress(NamedTuple):
    """Where a search stands: trainings ``done`` in this rung (from 1); ``share`` of the cost it may have.

    ``epoch`` of ``epochs`` in ``what``, 0: that training is done; ``networks`` in the rung; ``best`` the best network
    of the rung before and its macro-F1.
    """

    rung: int
    rungs: int
    networks: int
    done: int
    trainings: int
    resumed: int
    share: float
    what: str
    epoch: int
    epochs: int
    best: tuple[str, float] | None


@dataclass(frozen=True)
class Search:
    """The outcome of `search`: the folder, and its summary (``search.json``)."""

    out: Path
    summary: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {**self.summary, "out": str(self.out)}

    def __repr__(self) -> str:
        s, best = self.summary, self.summary["winner"]
        marks = ", leaky" * s["leaky"] + ", SIMULATION" * s["simulated"]
        return (
            f"Search({best['arch']} {best['filters']} of {s['candidates']}: macro-F1 {best['macro_f1']:.3f}, "
            f"{s['split']}{marks}, for {s['cost']['share']:.0%} of the grid's cost; {self.out})"
        )


def prepare(
    dataset: Dataset,
    grid: GridSpec | str | os.PathLike[str] = "paper",
    changes: Mapping[str, Any] | None = None,
    asked: Mapping[str, Any] | None = None,
    warn: Warn = silent,
) -> Prepared:
    """Read, check and plan a search: ``changes`` to the grid, ``asked`` of the search; else as `search`.

    Raises:
        ConfigError: with all problems at once; or when no network is within the limits, or the share does not suffice.
    """
    if isinstance(grid, GridSpec):
        spec, told = asked_of(SearchSpec(), asked)
        settled, more = changed(replace(grid, epochs=spec.rungs), changes or {})
        told += more
    else:
        settled, spec, told = load_search(os.fspath(grid), changes, asked)
    wrong = problems(spec)
    # What is wrong with the rungs is said of them, not of the epochs that they become.
    checked = replace(settled, epochs=(1,)) if wrong else settled
    archs: list[Arch] = []

    def fits(arch: Arch) -> bool:
        archs.append(arch)
        return not spec.over(arch)

    plans = plans_by_epochs(dataset, checked, [*told, *wrong, *_stops_early(settled)], warn, fits)
    archs = archs[: len(archs) // len(plans)]
    if not plans[-1].trials:
        raise ConfigError(none_left(spec, archs))
    last = plans[-1]
    folds = len(next(iter(last.folds.values())))
    if wrong := problems(spec, folds):
        raise GridProblems(wrong)
    macs = {job.id: last.macs(job) for job in last.jobs}
    # One epoch of each network on each fold; all seeds cost alike.
    epoch = np.array([[macs[run.job] / spec.rungs[-1] for run in t.runs[:folds]] for t in last.trials])
    costs = Costs(epoch, spec, len(settled.seeds))
    costs.check()
    if spec.share is None and costs.share > QUARTER:
        warn(
            f"{len(last.trials)} networks are too few to find the best for a quarter of their cost: up to "
            f"{costs.share:.0%} may be spent"
        )
    over = dict.fromkeys(arch for arch in archs if spec.over(arch))
    if over:
        filters: dict[str, list[str]] = {}
        for arch in over:
            filters.setdefault(arch.symbol, []).append(slashed(arch.filters))
        named = "; ".join(f"{symbol} with {', '.join(several)}" for symbol, several in filters.items())
        warn(f"{len(over)} of {len(dict.fromkeys(archs))} networks are beyond the limits and left out: {named}")
    return Prepared(settled, spec, tuple(plans), costs, tuple(over))


def _stops_early(grid: GridSpec) -> list[str]:
    try:
        patience = grid.training.patience
    except (BadInput, KeyError):
        # Said among the problems of the grid.
        return []
    if patience is None:
        return []
    return [
        f"Trainings that stop early (patience {patience}, preset {grid.preset}) cannot go on from where they stood: "
        "take the preset people or search, without patience."
    ]


def search(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    rungs: Sequence[int] | None = None,
    folds: Sequence[int] | None = None,
    share: float | None = None,
    eta: float | None = None,
    max_parameters: int | None = None,
    max_state_bytes: int | None = None,
    max_macs_per_step: int | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int = 0,
    cluster: str | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
    warn: Warn = silent,
    **changes: Any,
) -> Search:
    """Find the network with the best macro-F1 within limits, for at most a share of the cost of the whole grid.

    Finished trainings are kept in the data set's ``cache`` folder; a search that was stopped or killed goes on there.

    Args:
        grid: whose networks and batches are tried: "paper", the path of a TOML file (its [search] too), a `GridSpec`.
            But for a `GridSpec`, what it leaves open is as in `training.searchfile.DEFAULTS`.
        rungs, folds, share, eta, max_parameters, max_state_bytes, max_macs_per_step: see `SearchSpec`.
        out: default ``evaluations/search-<name>-<hash>`` in the data set.
        workers: trainings at a time; 0: as many as the processors hold.
        cluster: address of a Ray cluster that trains instead of this machine's processes.
        changes: keys of a grid, as ``split="by-subject:5"``, ``architectures=…``, ``seeds=(0, 1)``.

    Raises:
        ConfigError: with all problems at once, before anything is trained; TrainingError: when every training failed.
    """
    began = time.monotonic()
    dataset = as_dataset(dataset)
    asked = {
        "rungs": rungs, "folds": folds, "share": share, "eta": eta, "max_parameters": max_parameters,
        "max_state_bytes": max_state_bytes, "max_macs_per_step": max_macs_per_step,
    }  # fmt: skip
    ready = prepare(dataset, grid, changes, asked, warn)
    place = Path(out) if out is not None else dataset.path / "evaluations" / f"search-{ready.grid.name}-{ready.id[:8]}"
    check_place(place, ready.id, replace=overwrite)
    says = {**summary_head(dataset, ready.plans[-1]), "id": ready.id, "kind": "search", "search": ready.spec.to_dict()}
    trainer = _Trainer(ready, dataset, place, says, processes(workers, ready.grid.threads), cluster, progress)
    found = halving(ready.costs, trainer)
    tables = trainer.tables
    summary = summed_up(ready, found, tables, dataset, place)
    summary |= {"seconds": round(time.monotonic() - began, 1), "trainings_resumed": trainer.resumed}
    with dataset.generation.writing():
        write_summary(place, summary)
    return Search(place, summary)


def preview_search(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    asked: Mapping[str, Any] | None = None,
    changes: Mapping[str, Any] | None = None,
    measure: bool = False,
    warn: Warn = silent,
) -> dict[str, Any]:
    """Return what `search` would try and spend, without training.

    ``measure``: also ``seconds``, about how long it takes here at most (see `estimating.plan_seconds`).
    """
    dataset = as_dataset(dataset)
    ready = prepare(dataset, grid, changes, asked, warn)
    costs, last = ready.costs, ready.plans[-1]
    workers = processes(0, ready.grid.threads)
    return {
        **({"seconds": plan_seconds(last, costs.bound, workers)} if measure else {}),
        "name": ready.grid.name,
        "id": ready.id,
        "split": ready.plans[-1].split.text,
        "leaky": ready.plans[-1].split.leaky,
        "simulated": dataset.head.simulated,
        "candidates": len(ready.plans[-1].trials),
        "left_out": left_out(ready),
        "rungs": list(ready.spec.rungs),
        "folds": list(costs.folds),
        "seeds": len(ready.grid.seeds),
        "grid_macs": costs.whole,
        "bound_macs": costs.bound,
        "bound_share": ready.costs.share,
        "first_share": float(costs.step(0).sum()) / costs.whole,
        "least_share": costs.least,
        "grid": ready.grid.to_dict(),
        "search": ready.spec.to_dict(),
    }


class _Trainer:
    """Trains the rungs, and keeps the tables."""

    def __init__(
        self,
        ready: Prepared,
        dataset: Dataset,
        out: Path,
        says: dict[str, Any],
        workers: int,
        cluster: str | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> None:
        self._ready, self._progress = ready, progress
        self._train = partial(train_all, dataset, ready.plans[-1], workers=workers, cluster=cluster)
        self.resumed = 0
        self.tables = SearchTables(ready, out, says, dataset.generation.writing)
        self._results: dict[str, Result] = {}
        self._spent = 0.0
        self._best: tuple[str, float] | None = None

    def __call__(self, rung: Rung) -> Scores:
        plan = self._ready.plans[rung.number]
        runs = {
            network: [run for run in plan.trials[network].runs if run.fold_index < rung.folds]
            for network in rung.entered
        }
        wanted = {run.job: run for several in runs.values() for run in several}
        before = self._jobs_before(rung, runs)
        jobs, costs = [], dict[str, float]()
        for job in plan.jobs:
            if job.id in wanted:
                earlier = before.get(job.id)
                costs[job.id] = plan.macs(job) - (0 if earlier is None else self._ready.macs(rung.number - 1, earlier))
                jobs.append(Job(job.id, self._going_on(job.task, earlier, rung)))
        teller = _Teller(self._ready, rung, costs, self._spent, self._best, self._progress)

        self._results = self._train(jobs=jobs, on_done=teller.done, on_report=teller.epoch)
        self.resumed += teller.resumed
        self._spent += rung.cost
        outcomes = {job: outcome(plan, wanted[job], result) for job, result in self._results.items()}
        scores = np.array([[_score(outcomes[run.job], rung.epochs) for run in runs[n]] for n in rung.entered])
        self.tables.take(rung, runs, outcomes)
        means = scores.mean(axis=1)
        if np.isfinite(means).any():
            first = int(np.nanargmax(means))
            arch = plan.trials[rung.entered[first]].trial.arch
            self._best = arch.title, float(means[first])
        return scores

    def _jobs_before(self, rung: Rung, runs: Mapping[int, Sequence[PlannedRun]]) -> dict[str, str]:
        """Return the training of the rung before that each of these continues."""
        if not rung.number:
            return {}
        earlier = self._ready.plans[rung.number - 1].trials
        ids = {(n, run.seed, run.fold_index): run.job for n in runs for run in earlier[n].runs}
        pairs = [(run.job, ids[n, run.seed, run.fold_index]) for n, several in runs.items() for run in several]
        return {job: old for job, old in pairs if old in self._results}

    def _going_on(self, task: Task, earlier: str | None, rung: Rung) -> Task:
        last = rung.number + 1 == len(self._ready.plans)
        task = replace(task, stateful=not last)
        held = None if earlier is None else self._results[earlier]
        if held is None or "random" not in held:
            return task
        return replace(task, start=FitState.from_arrays(held), spent_s=float(held["seconds"]))


def _score(found: TrainingOutcome, epochs: int) -> float:
    scored = found.scored.get(epochs)
    value = None if scored is None else scored.figures["macro_f1"]
    return float("nan") if value is None else value


class _Teller:
    """Turns what jobs of a rung say into `SearchProgress`; the share counts multiply-accumulates."""

    def __init__(
        self,
        ready: Prepared,
        rung: Rung,
        costs: Mapping[str, float],
        spent: float,
        best: tuple[str, float] | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> None:
        self._ready, self._rung, self._costs = ready, rung, costs
        self._spent, self._best, self._progress = spent, best, progress
        self._done = self.resumed = 0
        self._running: dict[str, float] = {}

    def done(self, job: Job, result: Result, resumed: bool) -> None:
        self._done += 1
        self.resumed += resumed
        self._running.pop(job.id, None)
        self._spent += self._costs[job.id]
        self._tell(job, 0, 0)

    def epoch(self, job: Job, message: tuple[int, int, float]) -> None:
        from_epoch = 0 if job.task.start is None else job.task.start.epoch
        part = (message[0] - from_epoch) / max(1, message[1] - from_epoch)
        self._running[job.id] = part * self._costs[job.id]
        self._tell(job, *message[:2])

    def _tell(self, job: Job, epoch: int, epochs: int) -> None:
        if self._progress is None:
            return
        task: Task = job.task
        what = f"{task.arch.title} batch {task.spec.batch}"
        share = (self._spent + sum(self._running.values())) / self._ready.costs.bound
        rung = self._rung
        at = (rung.number + 1, len(self._ready.plans), len(rung.entered), self._done, len(self._costs), self.resumed)
        self._progress(SearchProgress(*at, share, what, epoch, epochs, self._best))
