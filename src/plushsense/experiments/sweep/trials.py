"""The results of trials: their columns in tables, and the choice of those whose predictions are kept.

Each column of the table of trials is an entry of the registry `TRIAL_COLUMNS`, from which Parquet, CSV, ``sweep.json``,
the page, the command line and notebooks are made.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from statistics import fmean, stdev
from typing import Any, Literal, Self

import numpy as np

from plushsense.core.errors import ConfigError, check_known, need
from plushsense.core.version import __version__
from plushsense.dataset.store import Dataset
from plushsense.experiments.sweep.grid import CHOSEN, SECOND, GridSpec
from plushsense.experiments.sweep.plan import Plan, Trial
from plushsense.experiments.sweep.trainings import RunScores, TrainingResult
from plushsense.models.arch import slashed
from plushsense.reports.table import Column, Kind
from plushsense.scoring.metrics import Counts, accuracy_complexity_ratio, column_metrics
from plushsense.workflow.reporting import machine


@dataclass(frozen=True)
class SweepHead:
    """Data, grid and machine of a sweep."""

    name: str
    id: str
    dataset: str
    dataset_hash: str
    simulated: bool
    rate_hz: float
    split: str
    leaky: bool
    context: str
    preset: str
    grid: GridSpec
    labels: tuple[str, ...]
    affects: tuple[str, ...]
    windows: int
    machine: str
    code_version: str

    @classmethod
    def of(cls, dataset: Dataset, plan: Plan) -> Self:
        """Describe a planned sweep on this machine."""
        grid = plan.grid
        return cls(
            name=grid.name,
            id=plan.id,
            dataset=dataset.head.name,
            dataset_hash=dataset.hash,
            simulated=dataset.head.simulated,
            rate_hz=dataset.layout.rate_hz,
            split=plan.split.text,
            leaky=plan.split.leaky,
            context=grid.context,
            preset=grid.preset,
            grid=grid,
            labels=tuple(plan.gestures.labels),
            affects=tuple(plan.gestures.affects),
            windows=max(len(windows) for windows in plan.sets.values()),
            machine=machine(
                f"{os.cpu_count() or '?'} processors",
                f"{grid.threads} thread{'s' * (grid.threads > 1)} a training",
                f"PyTorch {need('torch', 'train').__version__}",
            ),
            code_version=__version__,
        )

    def to_json(self) -> dict[str, object]:
        """Return plain values, as in ``sweep.json``."""
        return asdict(self) | {"grid": self.grid.to_json()}


@dataclass(frozen=True)
class TrialResult:
    """A trial with the scores of its finished runs.

    ``status`` is "waiting" without any finished run, "partial" with some, "done" with all; "failed" if a training
    diverged, and "dropped" if halving did not train it.
    """

    trial: Trial
    scored: tuple[RunScores, ...]
    status: Literal["waiting", "partial", "done", "failed", "dropped"]
    head: SweepHead

    @classmethod
    def of(cls, trial: Trial, trained: Mapping[str, TrainingResult], head: SweepHead, dropped: bool = False) -> Self:
        """Collect the scores of a trial from the results of trainings by job id."""
        finished = [trained[run.job] for run in trial.runs if run.job in trained]
        scored = tuple(result.scored[trial.epochs] for result in finished if trial.epochs in result.scored)
        if len(scored) < len(finished):
            # A run failed, and the mean of the other runs would be biased.
            return cls(trial, (), "failed", head)
        if not scored:
            return cls(trial, (), "dropped" if dropped else "waiting", head)
        return cls(trial, scored, "done" if len(scored) == len(trial.runs) else "partial", head)

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over the finished runs; None if one of them lacks it."""
        values = [s.figures[name] for s in self.scored]
        return fmean(numbers) if (numbers := [v for v in values if v is not None]) and None not in values else None

    def sd(self, name: str) -> float | None:
        """Return the standard deviation (n - 1) of a figure; None for fewer than two runs, or if one lacks it."""
        values = [v for s in self.scored if (v := s.figures[name]) is not None]
        return stdev(values) if len(values) == len(self.scored) > 1 else None

    @property
    def complete(self) -> bool:
        """Whether the trial takes part in rankings: every one of its trainings is finished and has an accuracy."""
        return self.status == "done" and self.mean("accuracy") is not None

    def rank(self, measure: str = "accuracy") -> tuple[float, int]:
        """Return a sort key: the highest value first, of equal ones the smallest network."""
        return -(self.mean(measure) or 0.0), self.trial.arch.parameters

    @property
    def counts(self) -> Counts:
        """The confusion matrix (K, K) of all runs."""
        total: Counts = np.sum([scored.counts for scored in self.scored], axis=0, dtype=np.int64)
        return total

    def row(self) -> dict[str, object]:
        """Return the row in the table of trials, with every column; None where there is no value yet."""
        return {key: column.value(self) for key, column in TRIAL_COLUMNS.items()}


def ranked(results: Iterable[TrialResult]) -> list[TrialResult]:
    """Return the complete trials, the most accurate first."""
    return sorted((result for result in results if result.complete), key=TrialResult.rank)


def best_on_validation(results: Iterable[TrialResult]) -> TrialResult | None:
    """Return the trial that validation alone chooses; of equal ones the smallest network, then the first."""
    complete = (result for result in results if result.complete)
    return min(complete, key=lambda result: result.rank("validation_macro_f1"), default=None)


@dataclass(frozen=True)
class TrialColumn:
    """A column of the table of trials: the type of its values, the function that returns them, and how it is printed.

    Args:
        type: str, int, float or bool.
        value: called with the trial; returns None if there is no value yet.
        name: heading in lists of trials; a column without one is only in the files.
        kind: format in lists (see `plushsense.reports.table.Kind`).
        score: whether the values depend on the split, so that the heading marks a leaky one.
        terminal: whether the command line lists the column too, and not only the page.
    """

    type: type[Any]
    value: Callable[[TrialResult], Any]
    name: str = ""
    kind: Kind = "text"
    score: bool = False
    terminal: bool = True


def _of_network(key: str, name: str = "") -> TrialColumn:
    return TrialColumn(int, lambda t: getattr(t.trial.arch, key), name, "count")


def _of_sweep(key: str, kind: type[Any]) -> TrialColumn:
    return TrialColumn(kind, lambda t: getattr(t.head, key))


def _mean(key: str, name: str = "", kind: Kind = "share") -> TrialColumn:
    return TrialColumn(float, lambda t: t.mean(key), name, kind, score=True, terminal=key in column_metrics())


def _sd(key: str, kind: Kind) -> TrialColumn:
    return TrialColumn(float, lambda t: t.sd(key), "± sd", kind, score=True, terminal=False)


def _metric_columns() -> dict[str, TrialColumn]:
    columns: dict[str, TrialColumn] = {}
    for key, metric in column_metrics().items():
        kind: Kind = "percent" if metric.percent else "share"
        columns |= {key: _mean(key, metric.name, kind), f"{key}_sd": _sd(key, kind)}
    return columns


def _seconds(trial: TrialResult) -> float | None:
    return sum(s.seconds for s in trial.scored) if trial.scored else None


def _field_s(trial: TrialResult) -> float:
    return round(float(trial.trial.arch.receptive_field / trial.head.rate_hz), 3)


def _acr(trial: TrialResult) -> float | None:
    return accuracy_complexity_ratio(trial.mean("accuracy"), trial.trial.arch.parameters)


TRIAL_COLUMNS: dict[str, TrialColumn] = {
    "trial": TrialColumn(str, lambda t: t.trial.id, "trial", terminal=False),
    "arch": TrialColumn(str, lambda t: t.trial.arch.symbol, "architecture"),
    "filters": TrialColumn(str, lambda t: slashed(t.trial.arch.filters), "filters"),
    "filter_set": TrialColumn(str, lambda t: slashed(t.trial.filter_set)),
    "padding": TrialColumn(str, lambda t: t.trial.arch.padding),
    "norm": TrialColumn(str, lambda t: t.trial.arch.norm),
    "epochs": TrialColumn(int, lambda t: t.trial.epochs, "epochs", "count"),
    "batch": TrialColumn(int, lambda t: max(run.batch for run in t.trial.runs)),
    "batch_asked": TrialColumn(str, lambda t: str(t.trial.batch), "batch"),
    "seeds": TrialColumn(int, lambda t: len({run.seed for run in t.trial.runs})),
    "folds": TrialColumn(int, lambda t: len({run.fold for run in t.trial.runs})),
    "parameters": _of_network("parameters", "parameters"),
    "receptive_field": _of_network("receptive_field"),
    "receptive_field_s": TrialColumn(float, _field_s, "reads (s)", "share"),
    "span": _of_network("span"),
    "macs_per_window": _of_network("macs_per_window"),
    "macs_per_step": _of_network("macs_per_step", "MAC/step"),
    "state_bytes_int8": _of_network("state_bytes_int8"),
    **_metric_columns(),
    "validation_accuracy": _mean("validation_accuracy", "accuracy on validation", "percent"),
    "validation_macro_f1": _mean("validation_macro_f1"),
    "train_loss": _mean("train_loss"),
    "acr": TrialColumn(float, _acr, "ACR", "percent", score=True),
    "seconds": TrialColumn(float, _seconds),
    "status": TrialColumn(str, lambda t: t.status),
    "split": _of_sweep("split", str),
    "leaky": _of_sweep("leaky", bool),
    "simulated": _of_sweep("simulated", bool),
}


def listed_columns(*, terminal: bool = False) -> list[Column]:
    """Return the columns of a list of trials, for a page or with ``terminal`` the command line; the id is the last."""
    listed = {key: c for key, c in TRIAL_COLUMNS.items() if c.name and (c.terminal or not terminal)}
    return [
        Column(key, c.name[0].upper() + c.name[1:], c.kind, c.score, plain=c.name)
        for key, c in sorted(listed.items(), key=lambda item: item[0] == "trial")
    ]


Network = tuple[str, str]
"""Symbol and filters of a network, as in the table of trials."""
PAPER_CHOICE = "chosen"
KEPT: dict[str, Callable[[set[Network]], set[Network]]] = {
    "best": lambda networks: set(),
    PAPER_CHOICE: lambda networks: networks & {CHOSEN, SECOND},
    "all": lambda networks: networks,
}
"""The networks of a sweep whose predictions are kept besides those of the best trial."""


def networks_to_keep(plan: Plan, choice: str) -> set[Network]:
    """Return the networks of a plan that a key of `KEPT` chooses."""
    check_known(choice, tuple(KEPT), "choice of predictions to keep", ConfigError)
    return KEPT[choice]({trial.network for trial in plan.trials})
