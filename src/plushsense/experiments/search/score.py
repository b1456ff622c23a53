"""The results of a search: the tables of a sweep, one row for each network at its last rung, and search.json."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import stdev
from typing import Any

from plushsense.core.files import write_file
from plushsense.dataset.store import Dataset
from plushsense.experiments.search.halving import Costs, FinishedRung, Halved, Rung, SearchSpec, limits_text
from plushsense.jobs.journal import job_id
from plushsense.jobs.pool import Job
from plushsense.models.arch import Arch, slashed
from plushsense.scoring.metrics import pareto_front
from plushsense.trials.grid import GridSpec
from plushsense.trials.plan import Plan, PlannedRun, PlannedTrial, TrainingOutcome
from plushsense.trials.tables import Tables

SUMMARY, SETTINGS = "search.json", "train.toml"

_WENT = {
    "score": "below the cut",
    "cost": "no budget left for it",
    "failed": "its training failed",
}


@dataclass(frozen=True)
class Prepared:
    """A search before it runs: a plan for each rung with the same networks, their costs, and who is left out."""

    grid: GridSpec
    spec: SearchSpec
    plans: tuple[Plan, ...]
    costs: Costs
    left_out: tuple[Arch, ...]

    @property
    def id(self) -> str:
        """The same for the same data and settings."""
        return job_id({"plans": [plan.id for plan in self.plans], "search": self.spec.to_dict()})

    def macs(self, rung: int, job: str) -> float:
        """Multiply-accumulates of a training up to a rung, from the first epoch."""
        return self.plans[rung].macs(self._jobs[rung][job])

    @cached_property
    def _jobs(self) -> list[dict[str, Job]]:
        return [{job.id: job for job in plan.jobs} for plan in self.plans]


class SearchTables:
    """The tables of a sweep over what a search has trained; written after each rung."""

    def __init__(
        self,
        ready: Prepared,
        out: Path,
        head: Mapping[str, Any],
        writing: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self.ready, self.out, self.head, self._writing = ready, out, dict(head), writing
        self.outcomes: dict[str, TrainingOutcome] = {}
        self._reached: dict[int, PlannedTrial] = {}

    def take(
        self, rung: Rung, runs: Mapping[int, Sequence[PlannedRun]], outcomes: Mapping[str, TrainingOutcome]
    ) -> None:
        """Take in a rung, and write."""
        self.outcomes |= outcomes
        for network, done in runs.items():
            self._reached[network] = replace(self.ready.plans[rung.number].trials[network], runs=tuple(done))
        self._tables().write()

    def rows(self) -> dict[int, dict[str, Any]]:
        """Return the row of each network."""
        return dict(zip(sorted(self._reached), self._tables().trial_rows(), strict=True))

    @property
    def seconds(self) -> float:
        """Of training, all that is behind what the networks have reached."""
        jobs = {run.job for planned in self._reached.values() for run in planned.runs}
        return sum(self.outcomes[job].seconds for job in jobs)

    def _tables(self) -> _Partly:
        trials = tuple(self._reached[network] for network in sorted(self._reached))
        used = {run.job for planned in trials for run in planned.runs}
        jobs = tuple(job for plan in self.ready.plans for job in plan.jobs if job.id in used)
        reached = replace(self.ready.plans[-1], trials=trials, jobs=jobs)
        tables = _Partly(reached, self.out, self.head, writing=self._writing)
        tables.outcomes = {job: self.outcomes[job] for job in sorted(used)}
        return tables


class _Partly(Tables):
    """A network that was not trained to the end is done in part, however good it looked."""

    def _row(self, planned: PlannedTrial) -> dict[str, Any]:
        row = super()._row(planned)
        part = row["status"] == "done" and planned.trial.epochs < self.plan.grid.epochs[-1]
        return row | {"status": "partial"} if part else row


def summed_up(ready: Prepared, found: Halved, tables: SearchTables, dataset: Dataset, out: Path) -> dict[str, Any]:
    """Return the content of ``search.json``."""
    rows = tables.rows()
    last = found.rungs[-1]
    finalists = [_finalist(ready, last, network, rows[network]) for network in last.kept]
    axes = ("parameters", "macs_per_step", "state_bytes_int8")
    front = pareto_front([(row["macro_f1"], *(row[axis] for axis in axes)) for row in finalists])
    for row, on, network in zip(finalists, front, last.kept, strict=True):
        row |= {"pareto": on, "equals_best": network == found.best or network in found.equals}
    winner = finalists[0]
    equals = [row for row in finalists if row["equals_best"]]
    return {
        **tables.head,
        "candidates": len(ready.plans[-1].trials),
        "left_out": left_out(ready),
        "rungs": [_rung(ready, compared) for compared in found.rungs],
        "winner": winner,
        "smallest_equal": min(equals, key=lambda row: row["parameters"]),
        "finalists": finalists,
        "cost": {
            "macs": found.spent,
            "bound_macs": found.bound,
            "grid_macs": found.whole,
            "share": found.spent / found.whole,
            "bound_share": ready.costs.share,
            "training_seconds": round(tables.seconds, 1),
        },
        "ranked_by": "macro_f1",
        "chosen_among": len(ready.plans[-1].trials),
        "command": shlex.join(_command(ready.grid, winner, dataset.path, out)),
    }


def left_out(ready: Prepared) -> list[dict[str, str]]:
    """Return the networks beyond the limits, and by how much."""
    return [
        {"arch": arch.symbol, "filters": slashed(arch.filters), "why": limits_text(ready.spec.over(arch))}
        for arch in ready.left_out
    ]


def _finalist(ready: Prepared, last: FinishedRung, network: int, row: Mapping[str, Any]) -> dict[str, Any]:
    scores = last.scores[last.rung.entered.index(network)].reshape(len(ready.grid.seeds), -1)
    by_fold, by_seed = (list(map(float, scores.mean(axis=axis))) for axis in (0, 1))
    return {
        **row,
        "by_fold": by_fold,
        "by_seed": by_seed,
        "sd_folds": stdev(by_fold) if len(by_fold) > 1 else None,
        "sd_seeds": stdev(by_seed) if len(by_seed) > 1 else None,
    }


def _rung(ready: Prepared, compared: FinishedRung) -> dict[str, Any]:
    rung = compared.rung
    trials = ready.plans[rung.number].trials
    final = rung.number + 1 == len(ready.plans)
    ranked = [*compared.kept, *sorted(compared.left, key=lambda n: -_or_least(compared.means[n]))]
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
                "macro_f1": mean if mean == mean else None,
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


def write_summary(out: Path, summary: Mapping[str, Any]) -> None:
    """Write ``search.json``, and the settings of the next training where options cannot say them."""
    write_file(out / SUMMARY, json.dumps(summary, ensure_ascii=False, indent=1, allow_nan=False))
    settings = _settings(summary["grid"])
    if settings:
        write_file(out / SETTINGS, settings)


def _settings(grid: Mapping[str, Any]) -> str:
    """Return the settings that ``train`` has no option for as a configuration file; empty where all are defaults."""
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
    """Return the command that trains the winner on everybody."""
    words = ["plushsense", "train", str(dataset), "--arch", winner["arch"]]
    words += ["--filters", winner["filters"].replace("/", ","), "--preset", grid.preset]
    words += ["--padding", grid.padding, "--context", grid.context, "--classes", grid.classes]
    words += ["--epochs", str(winner["epochs"]), "--batch", str(winner["batch"])]
    words += [] if grid.norm == "batch" else ["--norm", grid.norm]
    words += ["--config", str(out / SETTINGS)] if _settings(grid.to_dict()) else []
    return words


def _or_least(value: float) -> float:
    return value if value == value else float("-inf")
