"""Search the networks of a grid by successive halving, for at most a given share of the cost of the whole grid.

A search and a sweep give their trainings the same ids in the same journal, so that neither repeats a training of the
other. In a later rung, a training continues from its state at the end of the previous rung. If the journal has no such
state (a sweep saves none), the training starts from the beginning, with the same result.
"""

from __future__ import annotations

import json
import os
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import stdev
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput, ConfigError, python_warning
from plushsense.core.files import write_file
from plushsense.core.sentences import Message
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.experiments.search.halving import (
    QUARTER,
    Costs,
    FinishedRung,
    Halved,
    Rung,
    Scores,
    SearchSpec,
    halving,
    limits_text,
    load_search,
    none_left,
    problems,
)
from plushsense.jobs.journal import Result, job_id
from plushsense.jobs.pool import Job
from plushsense.jobs.progress import BestScore, JobInfo, JobProgress, JobsReporter, JobStep
from plushsense.models.arch import Arch, slashed
from plushsense.scoring.metrics import pareto_front
from plushsense.trials.estimate import plan_seconds
from plushsense.trials.grid import GridSpec
from plushsense.trials.plan import (
    GridProblems,
    Plan,
    PlannedRun,
    PlannedTrial,
    TrainingOutcome,
    outcome,
    plans_by_epochs,
    processes,
    train_all,
)
from plushsense.trials.tables import SUMMARY as SWEEP
from plushsense.trials.tables import Tables, summary_head
from plushsense.workflow.preparation import Warn, silent
from plushsense.workflow.reporting import check_results

SUMMARY, SETTINGS = "search.json", "train.toml"


@dataclass(frozen=True)
class SearchProgress(JobProgress):
    """Progress within a rung (numbered from 1) of ``networks`` networks; ``share`` is relative to the allowed cost."""

    rung: int = 0
    rungs: int = 0
    networks: int = 0


@dataclass(frozen=True)
class Search:
    """The result of `search`: the output folder, and the summary that is stored there as ``search.json``."""

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


@dataclass(frozen=True)
class SearchPlan:
    """A search that is ready to run: a plan of the same networks for each rung, costs, and the networks left out."""

    grid: GridSpec
    spec: SearchSpec
    plans: tuple[Plan, ...]
    costs: Costs
    left_out: tuple[Arch, ...]

    @property
    def id(self) -> str:
        """Identifier, equal for equal data and settings."""
        return job_id({"plans": [plan.id for plan in self.plans], "search": self.spec.to_dict()})

    def macs(self, rung: int, job: str) -> float:
        """Return the multiply-accumulates of a training from the first epoch to the end of a rung."""
        return self.plans[rung].macs(self._jobs[rung][job])

    @cached_property
    def _jobs(self) -> list[dict[str, Job]]:
        return [{job.id: job for job in plan.jobs} for plan in self.plans]

    def left_out_rows(self) -> list[dict[str, str]]:
        """Return a row for each network beyond the limits, with the limits that it exceeds."""
        return [
            {"arch": arch.symbol, "filters": slashed(arch.filters), "why": limits_text(self.spec.over(arch))}
            for arch in self.left_out
        ]


def prepare(
    dataset: Dataset,
    grid: GridSpec | str | os.PathLike[str] = "paper",
    changes: Mapping[str, Any] | None = None,
    warn: Warn = silent,
) -> SearchPlan:
    """Read, check and plan a search; arguments as for `search`.

    Raises:
        ConfigError: with all problems at once; or when no network is within the limits, or the share does not suffice.
    """
    settled, spec, unreadable = load_search(grid, changes)
    wrong = problems(spec)
    # Report wrong rungs only once, and not again as wrong epochs of the grid.
    checked = replace(settled, epochs=(1,)) if wrong else settled
    archs: list[Arch] = []

    def fits(arch: Arch) -> bool:
        archs.append(arch)
        return not spec.over(arch)

    plans = plans_by_epochs(dataset, checked, [*unreadable, *wrong, *_stops_early(settled)], warn, fits)
    archs = archs[: len(archs) // len(plans)]
    last = plans[-1]
    if not last.trials:
        raise ConfigError(none_left(spec, archs))
    folds = len(next(iter(last.folds.values())))
    if wrong := problems(spec, folds):
        raise GridProblems(wrong)
    macs = {job.id: last.macs(job) for job in last.jobs}
    # Cost of one epoch of each network on each fold, which is the same for all seeds.
    epoch = np.array([[macs[run.job] / spec.rungs[-1] for run in t.runs[:folds]] for t in last.trials])
    costs = Costs(epoch, spec, len(settled.seeds))
    costs.check()
    if spec.share is None and costs.share > QUARTER:
        warn(
            Message(
                "{n} networks are too few to find the best for a quarter of their cost: up to {share:.0%} may be spent",
                n=len(last.trials),
                share=costs.share,
                percent=round(100 * costs.share),
            )
        )
    over = dict.fromkeys(arch for arch in archs if spec.over(arch))
    if over:
        filters: dict[str, list[str]] = {}
        for arch in over:
            filters.setdefault(arch.symbol, []).append(slashed(arch.filters))
        named = "; ".join(f"{symbol} with {', '.join(several)}" for symbol, several in filters.items())
        warn(
            Message(
                "{n} of {of} networks are beyond the limits and left out: {names}",
                n=len(over),
                of=len(dict.fromkeys(archs)),
                names=named,
            )
        )
    return SearchPlan(settled, spec, tuple(plans), costs, tuple(over))


def _stops_early(grid: GridSpec) -> list[str]:
    try:
        patience = grid.training.patience
    except (BadInput, KeyError):
        # `plans_by_epochs` reports this error.
        return []
    if patience is None:
        return []
    return [
        f"Trainings that stop early (patience {patience}, preset {grid.preset}) cannot be continued in the next rung: "
        "use the preset people or search, without patience."
    ]


def search(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int = 0,
    cluster: str | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
    warn: Warn = python_warning,
    **changes: Any,
) -> Search:
    """Find the network with the best macro-F1 within limits, for at most a share of the cost of the whole grid.

    Finished trainings are kept in the data set's ``cache`` folder, so that a stopped or killed search can be continued.

    Args:
        grid: the networks and batches to try: "paper", the path of a TOML file (with a table [search]), or a
            `GridSpec`. Keys that a name or file does not set have the values of `halving.DEFAULTS`.
        out: output folder; default ``evaluations/search-<name>-<hash>`` in the data set.
        workers: number of trainings at a time; 0: as many as the processor cores allow.
        cluster: address of a Ray cluster that trains instead of this machine's processes.
        progress: called when a training reports an epoch or is done.
        changes: new values for keys of `SearchSpec`, such as ``max_parameters=10_000``, ``rungs=(4, 15, 60)``, and of a
            grid, such as ``split="by-subject:5"``, ``architectures=…``, ``seeds=(0, 1)``.

    Raises:
        ConfigError: with all problems at once, before anything is trained.
        TrainingError: when every training failed.
    """
    began = time.monotonic()
    dataset = as_dataset(dataset)
    ready = prepare(dataset, grid, changes, warn)
    place = Path(out) if out is not None else dataset.path / "evaluations" / f"search-{ready.grid.name}-{ready.id[:8]}"
    check_results(place, "A search", SWEEP, ready.id, replace=overwrite)
    trainer = _Trainer(ready, dataset, place, processes(workers, ready.grid.threads), cluster, progress)
    summary = _summary(ready, halving(ready.costs, trainer), trainer, dataset.path)
    summary |= {"seconds": round(time.monotonic() - began, 1), "trainings_resumed": trainer.resumed}
    with dataset.generation.writing():
        write_file(place / SUMMARY, json.dumps(summary, ensure_ascii=False, indent=1, allow_nan=False))
        if settings := _settings(summary["grid"]):
            write_file(place / SETTINGS, settings)
    return Search(place, summary)


def preview_search(
    dataset: Dataset | str | os.PathLike[str],
    grid: GridSpec | str | os.PathLike[str] = "paper",
    *,
    measure: bool = False,
    warn: Warn = python_warning,
    **changes: Any,
) -> dict[str, Any]:
    """Return the networks, rungs and costs of a `search` without training anything.

    With ``measure``, the result has ``seconds``, an estimate of the longest time that the search takes on this machine.
    """
    dataset = as_dataset(dataset)
    ready = prepare(dataset, grid, changes, warn)
    costs, last = ready.costs, ready.plans[-1]
    workers = processes(0, ready.grid.threads)
    return {
        **({"seconds": plan_seconds(last, costs.bound, workers)} if measure else {}),
        "name": ready.grid.name,
        "id": ready.id,
        "split": last.split.text,
        "leaky": last.split.leaky,
        "simulated": dataset.head.simulated,
        "candidates": len(last.trials),
        "left_out": ready.left_out_rows(),
        "rungs": list(ready.spec.rungs),
        "folds": list(costs.folds),
        "seeds": len(ready.grid.seeds),
        "grid_macs": costs.whole,
        "bound_macs": costs.bound,
        "bound_share": costs.share,
        "first_share": float(costs.step(0).sum()) / costs.whole,
        "least_share": costs.least,
        "grid": ready.grid.to_dict(),
        "search": ready.spec.to_dict(),
    }


class _SearchTables(Tables):
    """The tables of a search. A network that was not trained to the end has the status "partial"."""

    def _row(self, planned: PlannedTrial) -> dict[str, Any]:
        row = super()._row(planned)
        part = row["status"] == "done" and planned.trial.epochs < self.plan.grid.epochs[-1]
        return row | {"status": "partial"} if part else row


class _Trainer:
    """Function object that trains a rung and then writes the tables of all networks trained so far."""

    def __init__(
        self,
        ready: SearchPlan,
        dataset: Dataset,
        out: Path,
        workers: int,
        cluster: str | None,
        progress: Callable[[SearchProgress], None] | None,
    ) -> None:
        self._ready, self._dataset, self.out, self._progress = ready, dataset, out, progress
        self._workers, self._cluster = workers, cluster
        self.head = {**summary_head(dataset, ready.plans[-1]), "id": ready.id, "kind": "search"}
        self.head["search"] = ready.spec.to_dict()
        self.resumed = 0
        self._spent = 0.0
        self._best: BestScore | None = None
        self._results: dict[str, Result] = {}
        self._outcomes: dict[str, TrainingOutcome] = {}
        self._reached: dict[int, PlannedTrial] = {}

    def __call__(self, rung: Rung) -> Scores:
        """Train the networks of a rung and return their macro-F1 (networks, seeds × folds)."""
        plan = self._ready.plans[rung.number]
        runs = {n: [run for run in plan.trials[n].runs if run.fold_index < rung.folds] for n in rung.entered}
        run_of = {run.job: run for several in runs.values() for run in several}
        before = self._jobs_before(rung, runs)
        jobs, infos = [], dict[str, JobInfo]()
        for job in plan.jobs:
            if job.id in run_of:
                earlier = before.get(job.id)
                cost = plan.macs(job) - (0 if earlier is None else self._ready.macs(rung.number - 1, earlier))
                infos[job.id] = JobInfo(f"{job.task.arch.title} batch {job.task.spec.batch}", cost)
                jobs.append(self._continued(job, earlier, last=rung.number + 1 == len(self._ready.plans)))
        reporter = JobsReporter(infos, read=_read_epoch, progress=self._report(rung) if self._progress else None)
        reporter.state.best = self._best
        self._results = train_all(
            self._dataset,
            self._ready.plans[-1],
            jobs,
            workers=self._workers,
            cluster=self._cluster,
            on_done=reporter.on_done,
            on_report=reporter.on_report,
        )
        self.resumed += len(reporter.state.resumed)
        self._spent += rung.cost
        outcomes = {job: outcome(plan, run_of[job], result) for job, result in self._results.items()}
        scores = np.array([[_score(outcomes[run.job], rung.epochs) for run in runs[n]] for n in rung.entered])
        self._outcomes |= outcomes
        self._reached |= {n: replace(plan.trials[n], runs=tuple(several)) for n, several in runs.items()}
        self._tables().write()
        means = scores.mean(axis=1)
        if np.isfinite(means).any():
            first = int(np.nanargmax(means))
            self._best = BestScore(float(means[first]), plan.trials[rung.entered[first]].trial.arch.title)
        return scores

    def rows(self) -> dict[int, dict[str, Any]]:
        """Return the row of each network in the table of trials."""
        return dict(zip(sorted(self._reached), self._tables().trial_rows(), strict=True))

    @property
    def seconds(self) -> float:
        """Total training time, in seconds, of the networks up to the epoch that each has reached."""
        jobs = {run.job for planned in self._reached.values() for run in planned.runs}
        return sum(self._outcomes[job].seconds for job in jobs)

    def _tables(self) -> Tables:
        trials = tuple(self._reached[network] for network in sorted(self._reached))
        used = {run.job for planned in trials for run in planned.runs}
        jobs = tuple(job for plan in self._ready.plans for job in plan.jobs if job.id in used)
        reached = replace(self._ready.plans[-1], trials=trials, jobs=jobs)
        tables = _SearchTables(reached, self.out, self.head, writing=self._dataset.generation.writing)
        tables.outcomes = {job: self._outcomes[job] for job in sorted(used)}
        return tables

    def _jobs_before(self, rung: Rung, runs: Mapping[int, Sequence[PlannedRun]]) -> dict[str, str]:
        """Return by job id the training of the previous rung that each training continues."""
        if not rung.number:
            return {}
        earlier = self._ready.plans[rung.number - 1].trials
        ids = {(n, run.seed, run.fold_index): run.job for n in runs for run in earlier[n].runs}
        pairs = [(run.job, ids[n, run.seed, run.fold_index]) for n, several in runs.items() for run in several]
        return {job: old for job, old in pairs if old in self._results}

    def _continued(self, job: Job, earlier: str | None, last: bool) -> Job:
        """Return the job with a task that starts from the final state of the ``earlier`` job, if that was kept."""
        task = replace(job.task, stateful=not last)
        result = {} if earlier is None else self._results[earlier]
        if "random" in result:
            # Imported here, because PyTorch is needed for training only.
            from plushsense.training.engine import FitState

            task = replace(task, start=FitState.from_arrays(result), spent_s=float(result["seconds"]))
        return Job(job.id, task)

    def _report(self, rung: Rung) -> Callable[[JobProgress], None]:
        """Return a callback that converts the progress of a rung's trainings to that of the whole search."""
        progress, bound, spent, plans = self._progress, self._ready.costs.bound, self._spent, self._ready.plans
        assert progress is not None

        def report(at: JobProgress) -> None:
            values = {**vars(at), "share": (spent + at.share * rung.cost) / bound}
            progress(SearchProgress(**values, rung=rung.number + 1, rungs=len(plans), networks=len(rung.entered)))

        return report


def _read_epoch(job: Job, message: tuple[int, int, float]) -> JobStep:
    start = job.task.start
    return JobStep(*message, first=0 if start is None else start.epoch)


def _score(trained: TrainingOutcome, epochs: int) -> float:
    scored = trained.scored.get(epochs)
    value = None if scored is None else scored.figures["macro_f1"]
    return float("nan") if value is None else value


def _summary(ready: SearchPlan, done: Halved, trainer: _Trainer, dataset: Path) -> dict[str, Any]:
    """Return the content of ``search.json``."""
    rows = trainer.rows()
    last = done.rungs[-1]
    finalists = [_finalist(ready, last, network, rows[network]) for network in last.kept]
    axes = ("parameters", "macs_per_step", "state_bytes_int8")
    front = pareto_front([(row["macro_f1"], *(row[axis] for axis in axes)) for row in finalists])
    for row, on, network in zip(finalists, front, last.kept, strict=True):
        row |= {"pareto": on, "equals_best": network == done.best or network in done.equals}
    winner = finalists[0]
    return {
        **trainer.head,
        "candidates": len(ready.plans[-1].trials),
        "left_out": ready.left_out_rows(),
        "rungs": [_rung(ready, compared) for compared in done.rungs],
        "winner": winner,
        "smallest_equal": min((row for row in finalists if row["equals_best"]), key=lambda row: row["parameters"]),
        "finalists": finalists,
        "cost": {
            "macs": done.spent,
            "bound_macs": done.bound,
            "grid_macs": done.whole,
            "share": done.spent / done.whole,
            "bound_share": ready.costs.share,
            "training_seconds": round(trainer.seconds, 1),
        },
        "ranked_by": "macro_f1",
        "chosen_among": len(ready.plans[-1].trials),
        "command": shlex.join(_command(ready.grid, winner, dataset, trainer.out)),
    }


def _finalist(ready: SearchPlan, last: FinishedRung, network: int, row: Mapping[str, Any]) -> dict[str, Any]:
    scores = last.scores[last.rung.entered.index(network)].reshape(len(ready.grid.seeds), -1)
    by_fold, by_seed = (list(map(float, scores.mean(axis=axis))) for axis in (0, 1))
    return {
        **row,
        "by_fold": by_fold,
        "by_seed": by_seed,
        "sd_folds": stdev(by_fold) if len(by_fold) > 1 else None,
        "sd_seeds": stdev(by_seed) if len(by_seed) > 1 else None,
    }


_WENT = {
    "score": "below the cut",
    "cost": "no budget left for it",
    "failed": "its training failed",
}


def _rung(ready: SearchPlan, compared: FinishedRung) -> dict[str, Any]:
    rung = compared.rung
    trials = ready.plans[rung.number].trials
    final = rung.number + 1 == len(ready.plans)
    # Networks without a mean come last.
    ranked = [*compared.kept, *sorted(compared.left, key=lambda n: -np.nan_to_num(compared.means[n], nan=-np.inf))]
    networks = []
    for network in ranked:
        trial = trials[network].trial
        went = _WENT[compared.left[network]] if network in compared.left else "to the end" if final else "on"
        mean = compared.means[network]
        networks.append(
            {
                "trial": trials[network].id,
                "arch": trial.arch.symbol,
                "filters": slashed(trial.arch.filters),
                "batch_asked": str(trial.batch),
                "macro_f1": None if np.isnan(mean) else mean,
                "went": went,
            }
        )
    return {
        "epochs": rung.epochs,
        "folds": rung.folds,
        "entered": len(rung.entered),
        "kept": len(compared.kept),
        "macs": rung.cost,
        "share": rung.cost / ready.costs.whole,
        "standard_error": compared.error,
        "networks": networks,
    }


def _settings(grid: Mapping[str, Any]) -> str:
    """Return a configuration file of the changed settings that ``train`` has no option for; "" if there are none."""
    usual = GridSpec()
    keys = {
        "training": ("learning_rate", "halve_every", "augment", "turn_deg", "threads"),
        "windows": ("window_s", "step_s"),
    }
    text = ""
    for table, names in keys.items():
        lines = [f"{name} = {json.dumps(grid[name])}\n" for name in names if grid.get(name) != getattr(usual, name)]
        text += f"[{table}]\n{''.join(lines)}\n" if lines else ""
    return text


def _command(grid: GridSpec, winner: Mapping[str, Any], dataset: Path, out: Path) -> list[str]:
    """Return the command line that trains the winner on all people."""
    words = ["plushsense", "train", str(dataset), "--arch", winner["arch"]]
    words += ["--filters", winner["filters"].replace("/", ","), "--preset", grid.preset]
    words += ["--padding", grid.padding, "--context", grid.context, "--classes", grid.classes]
    words += ["--epochs", str(winner["epochs"]), "--batch", str(winner["batch"])]
    words += [] if grid.norm == "batch" else ["--norm", grid.norm]
    words += ["--config", str(out / SETTINGS)] if _settings(grid.to_dict()) else []
    return words
