"""The columns of a sweep's table of trials. A column is a function and a line in `TRIAL_COLUMNS`.

The table as Parquet and CSV, ``sweep.json``, the page, the command line, notebooks and MLflow read this registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any, Literal

from plushsense.models.arch import slashed
from plushsense.reports.table import Column, Kind
from plushsense.scoring.metrics import accuracy_complexity_ratio, column_metrics
from plushsense.trials.plan import PlannedTrial, Scored, TrainingOutcome


@dataclass(frozen=True)
class TrialScores:
    """A planned trial with the scores of its runs; ``head`` holds what ``sweep.json`` tells of data and split."""

    planned: PlannedTrial
    scored: tuple[Scored, ...]
    status: Literal["waiting", "partial", "done", "failed"]
    head: Mapping[str, Any]

    @classmethod
    def of(cls, planned: PlannedTrial, outcomes: Mapping[str, TrainingOutcome], head: Mapping[str, Any]) -> TrialScores:
        """Return the scores of a trial from the outcomes of trainings by job."""
        finished = [outcomes[run.job] for run in planned.runs if run.job in outcomes]
        epochs = planned.trial.epochs
        scored = tuple(outcome.scored[epochs] for outcome in finished if epochs in outcome.scored)
        if len(scored) < len(finished):
            # The mean of the runs that went well would flatter.
            return cls(planned, (), "failed", head)
        if not scored:
            return cls(planned, (), "waiting", head)
        return cls(planned, scored, "done" if len(scored) == len(planned.runs) else "partial", head)

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over the runs; None where a run lacks it."""
        values = [s.figures[name] for s in self.scored]
        return fmean(numbers) if (numbers := [v for v in values if v is not None]) and None not in values else None

    def sd(self, name: str) -> float | None:
        """Return the standard deviation of a figure over the runs (n - 1); None for fewer than two."""
        values = [v for s in self.scored if (v := s.figures[name]) is not None]
        return stdev(values) if len(values) == len(self.scored) > 1 else None


@dataclass(frozen=True)
class TrialColumn:
    """A column: the type of its values, the function that gives them, and how it is printed.

    Args:
        type: str, int, float or bool.
        value: called with the trial; None where it has no value yet.
        name: the heading in lists of trials; without one the column is in the files only.
        kind: format in lists.
        score: whether the values depend on the split, so that a leaky one is marked.
        terminal: whether the list of the command line has it, beside that of the page.
    """

    type: type[Any]
    value: Callable[[TrialScores], Any]
    name: str = ""
    kind: Kind = "text"
    score: bool = False
    terminal: bool = True


def _of_network(key: str, name: str = "") -> TrialColumn:
    return TrialColumn(int, lambda t: getattr(t.planned.trial.arch, key), name, "count")


def _of_sweep(key: str, kind: type[Any]) -> TrialColumn:
    return TrialColumn(kind, lambda t: t.head[key])


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


def _seconds(trial: TrialScores) -> float | None:
    return sum(s.seconds for s in trial.scored) if trial.scored else None


def _acr(trial: TrialScores) -> float | None:
    return accuracy_complexity_ratio(trial.mean("accuracy"), trial.planned.trial.arch.parameters)


TRIAL_COLUMNS: dict[str, TrialColumn] = {
    "trial": TrialColumn(str, lambda t: t.planned.id, "trial", terminal=False),
    "arch": TrialColumn(str, lambda t: t.planned.trial.arch.symbol, "architecture"),
    "filters": TrialColumn(str, lambda t: slashed(t.planned.trial.arch.filters), "filters"),
    "filter_set": TrialColumn(str, lambda t: slashed(t.planned.trial.filter_set)),
    "padding": TrialColumn(str, lambda t: t.planned.trial.arch.padding),
    "norm": TrialColumn(str, lambda t: t.planned.trial.arch.norm),
    "epochs": TrialColumn(int, lambda t: t.planned.trial.epochs, "epochs", "count"),
    "batch": TrialColumn(int, lambda t: max(run.batch for run in t.planned.runs)),
    "batch_asked": TrialColumn(str, lambda t: str(t.planned.trial.batch), "batch"),
    "seeds": TrialColumn(int, lambda t: len({run.seed for run in t.planned.runs})),
    "folds": TrialColumn(int, lambda t: len({run.fold for run in t.planned.runs})),
    "parameters": _of_network("parameters", "parameters"),
    "receptive_field": _of_network("receptive_field"),
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


def trial_row(
    planned: PlannedTrial, outcomes: Mapping[str, TrainingOutcome], head: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the row of a trial: every column's value, None where there is none yet."""
    trial = TrialScores.of(planned, outcomes, head)
    return {key: column.value(trial) for key, column in TRIAL_COLUMNS.items()}


def listed_columns(*, terminal: bool = False) -> list[Column]:
    """Return the columns of a list of trials on a page, or on a terminal; the trial's name is the last."""
    listed = {key: c for key, c in TRIAL_COLUMNS.items() if c.name and (c.terminal or not terminal)}
    return [
        Column(key, c.name[0].upper() + c.name[1:], c.kind, c.score, plain=c.name)
        for key, c in sorted(listed.items(), key=lambda item: item[0] == "trial")
    ]
