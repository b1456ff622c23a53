"""Write the results folder of a sweep: tables of trials, runs and curves, and a summary.

All files are made from the plan and the journal, so that the folder can be deleted and written again. Each column of
the table of trials is an entry of the registry `TRIAL_COLUMNS`, from which Parquet, CSV, ``sweep.json``, the page, the
command line, notebooks and MLflow are made.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal

import numpy as np

from plushsense.core.errors import ArchError, ConfigError, nearest, need
from plushsense.core.files import replacing_file, write_file
from plushsense.core.version import __version__
from plushsense.dataset.store import Dataset
from plushsense.evaluation.scores import gather_predictions, write_predictions
from plushsense.jobs.journal import Result
from plushsense.models.arch import parse_symbol, slashed
from plushsense.reports.table import Column, Kind
from plushsense.scoring.metrics import Counts, accuracy_complexity_ratio, class_results, column_metrics
from plushsense.trials.grid import CHOSEN, SECOND
from plushsense.trials.plan import CURVE, Plan, PlannedRun, PlannedTrial, Scored, TrainingOutcome, outcome
from plushsense.workflow.reporting import PREDICTIONS, machine

SUMMARY = "sweep.json"
TRIALS, TRIALS_CSV, RUNS, CURVES = "trials.parquet", "trials.csv", "runs.parquet", "curves.parquet"
BEST = 10
# Shortest time between two updates of the files.
_EVERY_S = 5.0

_RUN_COLUMNS: dict[str, type[Any]] = {
    "trial": str,
    "run": str,
    "arch": str,
    "filters": str,
    "epochs": int,
    "batch": int,
    "seed": int,
    "fold": str,
    "test_windows": int,
    **dict.fromkeys(column_metrics(), float),
    "validation_accuracy": float,
    "train_loss": float,
    "seconds": float,
}
_CURVE_COLUMNS: dict[str, type[Any]] = {
    "run": str,
    "arch": str,
    "filters": str,
    "batch": int,
    "seed": int,
    "fold": str,
    "epoch": int,
    **dict.fromkeys(CURVE, float),
}


@dataclass(frozen=True)
class TrialScores:
    """A planned trial with the scores of its runs; ``head`` has data and split, as in ``sweep.json``."""

    planned: PlannedTrial
    scored: tuple[Scored, ...]
    status: Literal["waiting", "partial", "done", "failed"]
    head: Mapping[str, Any]

    @classmethod
    def of(cls, planned: PlannedTrial, outcomes: Mapping[str, TrainingOutcome], head: Mapping[str, Any]) -> TrialScores:
        """Collect the scores of a trial from ``outcomes``, the outcomes of trainings by job id."""
        finished = [outcomes[run.job] for run in planned.runs if run.job in outcomes]
        epochs = planned.trial.epochs
        scored = tuple(outcome.scored[epochs] for outcome in finished if epochs in outcome.scored)
        if len(scored) < len(finished):
            # A run failed, and the mean of the other runs would be biased.
            return cls(planned, (), "failed", head)
        if not scored:
            return cls(planned, (), "waiting", head)
        return cls(planned, scored, "done" if len(scored) == len(planned.runs) else "partial", head)

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over the finished runs; None if one of them lacks it."""
        values = [s.figures[name] for s in self.scored]
        return fmean(numbers) if (numbers := [v for v in values if v is not None]) and None not in values else None

    def sd(self, name: str) -> float | None:
        """Return the standard deviation (n - 1) of a figure; None for fewer than two runs, or if one lacks it."""
        values = [v for s in self.scored if (v := s.figures[name]) is not None]
        return stdev(values) if len(values) == len(self.scored) > 1 else None


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


def _field_s(trial: TrialScores) -> float:
    return round(float(trial.planned.trial.arch.receptive_field / trial.head["rate_hz"]), 3)


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
PAPER_CHOICE, BEST_ONLY, EVERY = "chosen", "best", "all"


def networks_to_keep(plan: Plan, choice: str) -> frozenset[Network]:
    """Return the networks of a plan whose predictions and confusions are kept; those of the best trial always are.

    Args:
        choice: words joined by commas. "chosen": the two networks that the paper shows (Figures 10 and 11), where the
            plan has them; "best": none besides the best trial; "all"; or the symbol of a network, with one of its
            filter sets (``14d1_39d2_41d4:8/12/16``) or without, for all of them.

    Raises:
        ConfigError: for any other word, or a network that is not in the plan.
    """
    networks = {_network(planned): None for planned in plan.trials}
    kept: set[Network] = set()
    for word in filter(None, map(str.strip, choice.split(","))):
        symbol, _, filters = word.partition(":")
        if word in (PAPER_CHOICE, BEST_ONLY, EVERY):
            chosen = {PAPER_CHOICE: {CHOSEN, SECOND}, BEST_ONLY: set[Network](), EVERY: set(networks)}[word]
            kept |= chosen & set(networks)
            continue
        mine = {n for n in networks if _same_symbol(symbol, n[0]) and filters in ("", n[1])}
        if not mine:
            known = list(dict.fromkeys(name for name, _ in networks))
            raise ConfigError(
                f"Predictions of '{word}' cannot be kept: accepted are {PAPER_CHOICE}, {BEST_ONLY}, {EVERY}, and the "
                f"networks of the grid, such as {known[0]} or {':'.join(next(iter(networks)))}."
                f"{nearest(symbol, (PAPER_CHOICE, BEST_ONLY, EVERY, *known))}"
            )
        kept |= mine
    return frozenset(kept)


def _same_symbol(text: str, symbol: str) -> bool:
    try:
        return parse_symbol(text) == parse_symbol(symbol)
    except ArchError:
        return False


def _network(planned: PlannedTrial) -> Network:
    return planned.trial.arch.symbol, slashed(planned.trial.arch.filters)


def prediction_files(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the names of the files of predictions by trial; in folders of earlier versions only the best has one."""
    files = summary.get("predictions")
    if isinstance(files, Mapping):
        return {str(trial): str(name) for trial, name in files.items()}
    return {str(summary["predicted"]): PREDICTIONS} if summary.get("predicted") else {}


class Tables:
    """Collects the outcomes of trainings and writes the results folder, each time in the context ``writing()``.

    ``keep`` are the networks whose predictions and confusions are kept besides those of the best trial.
    """

    def __init__(
        self,
        plan: Plan,
        out: Path,
        head: Mapping[str, Any],
        writing: Callable[[], AbstractContextManager[object]] = nullcontext,
        keep: Collection[Network] = (),
    ) -> None:
        self.plan, self.out, self.head, self._writing, self.keep = plan, out, dict(head), writing, frozenset(keep)
        self.outcomes: dict[str, TrainingOutcome] = {}
        self.resumed: set[str] = set()
        self.lost: dict[str, str] = {}
        self.best: dict[str, Any] | None = None
        self.predictions: dict[str, str] = {}
        self._of: dict[str, list[tuple[PlannedTrial, PlannedRun]]] = {}
        for planned in plan.trials:
            for run in planned.runs:
                self._of.setdefault(run.job, []).append((planned, run))
        self._due = 0.0
        self._began = time.monotonic()

    def add(self, job: str, result: Mapping[str, Any], resumed: bool) -> None:
        """Add a finished training, and update the files if they are due."""
        self.outcomes[job] = outcome(self.plan, self._of[job][0][1], result)
        for planned, _ in self._of[job]:
            row = self._row(planned)
            if _ranked(row) and (self.best is None or _rank(row) < _rank(self.best)):
                self.best = row
        if resumed:
            self.resumed.add(job)
        elif time.monotonic() >= self._due:
            # On Windows, a file that another program has open cannot be written; the update at the end will.
            with suppress(OSError):
                self.write()

    def lose(self, job: str, why: str) -> None:
        """Record a training that failed for the reason ``why``; its trials stay without scores."""
        self.lost[job] = why

    def trial_rows(self) -> list[dict[str, Any]]:
        """Return one row for each trial, in the order of the grid."""
        return [self._row(planned) for planned in self.plan.trials]

    def _row(self, planned: PlannedTrial) -> dict[str, Any]:
        """Return the row of a trial with every column; None where there is no value yet."""
        trial = TrialScores.of(planned, self.outcomes, self.head)
        return {key: column.value(trial) for key, column in TRIAL_COLUMNS.items()}

    def summary(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``."""
        rows = self.trial_rows()
        done = [row for row in rows if row["status"] == "done"]
        best = sorted(filter(_ranked, rows), key=_rank)
        # Choose by validation only; of equal trials the smallest network, then the first in the grid.
        chosen = min(
            filter(_ranked, rows),
            key=lambda row: (-(row["validation_macro_f1"] or 0.0), row["parameters"]),
            default=None,
        )
        detailed = self._with_confusions(best)
        failed = [
            {"run": job, **_words(*self._of[job][0]), "epochs": epochs, "why": why}
            for job, finished in self.outcomes.items()
            for epochs, why in finished.failed.items()
        ]
        failed += [
            {"run": job, **_words(*self._of[job][0]), "epochs": self._of[job][-1][0].trial.epochs, "why": why}
            for job, why in self.lost.items()
        ]
        return {
            **self.head,
            "trials": len(rows),
            "done": len(done),
            "resumed": sum(all(run.job in self.resumed for run in t.runs) for t in self.plan.trials),
            "trainings": len(self.plan.jobs),
            "trainings_done": len(self.outcomes),
            "trainings_resumed": len(self.resumed),
            "trainings_lost": len(self.lost),
            "failed": sorted(failed, key=lambda f: (f["run"], f["epochs"])),
            "seconds": round(time.monotonic() - self._began, 1),
            "training_seconds": round(sum(finished.seconds for finished in self.outcomes.values()), 1),
            "ranked_by": "accuracy",
            "best": best[:BEST],
            "best_on_validation": chosen,
            "predictions": self.predictions,
            "confusions": {p.id: self._counts(p).tolist() for p in detailed},
            "per_class": {
                p.id: [row._asdict() for row in class_results(self._counts(p), self.plan.gestures.labels)]
                for p in detailed
            },
        }

    def write(self, results: Mapping[str, Result] | None = None) -> dict[str, Any]:
        """Write all files, each by replacing it in one step, and return the summary.

        Args:
            results: those of all trainings by job; with them, the predictions are written, too.
        """
        with self._writing():
            self.predictions = self._write_predictions(results) if results else {}
            return self._write()

    def _write_predictions(self, results: Mapping[str, Result]) -> dict[str, str]:
        """Write what the best trial, and the best one of each kept network, predicted; return the files by trial.

        A file has the predictions of every seed and fold, as the confusions count them. Files of networks that are no
        longer kept are removed.
        """
        files: dict[str, str] = {}
        self.out.mkdir(parents=True, exist_ok=True)
        ranked = sorted(filter(_ranked, self.trial_rows()), key=_rank)
        for planned in self._first_of(ranked, self.keep):
            name = PREDICTIONS if not files else f"predictions-{'-'.join(_network(planned)).replace('/', '-')}.parquet"
            runs = planned.runs
            tested = [(run.fold, self.plan.folds[run.span][run.fold_index].test) for run in runs]
            parts = []
            for run in runs:
                result = results[run.job]
                parts.append(result["probabilities"][list(result["epochs"]).index(planned.trial.epochs)])
            write_predictions(self.out / name, gather_predictions(self.plan.sets[runs[0].span], tested, parts))
            files[planned.id] = name
        for path in self.out.glob("predictions-*.parquet"):
            if path.name not in files.values():
                path.unlink()
        return files

    def _first_of(self, ranked: Sequence[Mapping[str, Any]], networks: Collection[Network]) -> list[PlannedTrial]:
        """Return the first of the ``ranked`` trials, then the first of each other one of ``networks``."""
        first: dict[Network, str] = {}
        for row in ranked:
            network = (row["arch"], row["filters"])
            if not first or network in networks:
                first.setdefault(network, row["trial"])
        by_id = {planned.id: planned for planned in self.plan.trials}
        return [by_id[trial] for trial in first.values()]

    def _write(self) -> dict[str, Any]:
        began = time.monotonic()
        self.out.mkdir(parents=True, exist_ok=True)
        polars = need("polars", "train")
        trials = _frame(polars, self.trial_rows(), {key: column.type for key, column in TRIAL_COLUMNS.items()})
        with replacing_file(self.out / TRIALS) as part:
            trials.write_parquet(part)
        with replacing_file(self.out / TRIALS_CSV) as part:
            trials.write_csv(part)
        runs = [
            row
            for planned in self.plan.trials
            for run in planned.runs
            if (row := self._run_row(planned, run)) is not None
        ]
        with replacing_file(self.out / RUNS) as part:
            _frame(polars, runs, _RUN_COLUMNS).write_parquet(part)
        with replacing_file(self.out / CURVES) as part:
            self._curves(polars).write_parquet(part)
        summary = self.summary()
        write_file(self.out / SUMMARY, json.dumps(summary, ensure_ascii=False, indent=1, allow_nan=False))
        # Limit writing to about a twentieth of the time.
        now = time.monotonic()
        self._due = now + max(_EVERY_S, 20 * (now - began))
        return summary

    def _run_row(self, planned: PlannedTrial, run: PlannedRun) -> dict[str, Any] | None:
        finished = self.outcomes.get(run.job)
        scored = None if finished is None else finished.scored.get(planned.trial.epochs)
        if scored is None:
            return None
        figures = {name: scored.figures[name] for name in _RUN_COLUMNS if name in scored.figures}
        return {
            "trial": planned.id,
            "run": run.job,
            **_words(planned, run),
            "epochs": planned.trial.epochs,
            "test_windows": scored.windows,
            **figures,
            "seconds": scored.seconds,
        }

    def _curves(self, polars: Any) -> Any:
        """Return the table of curves, a row for each training and epoch; it is built by column for speed."""
        parts = []
        for job in sorted(self.outcomes):
            curve = self.outcomes[job].curve
            part = polars.DataFrame({name: curve[:, i] for i, name in enumerate(CURVE)}).fill_nan(None)
            words = {"run": job, **_words(*self._of[job][0])}
            parts.append(
                part.with_columns(
                    epoch=polars.int_range(1, len(curve) + 1, eager=True, dtype=polars.Int64),
                    **{
                        name: polars.lit(value, dtype=_kind(polars, _CURVE_COLUMNS[name]))
                        for name, value in words.items()
                    },
                ).select(list(_CURVE_COLUMNS))
            )
        return polars.concat(parts) if parts else _frame(polars, [], _CURVE_COLUMNS)

    def _with_confusions(self, ranked: Sequence[Mapping[str, Any]]) -> list[PlannedTrial]:
        """Return the trials whose confusions are stored.

        They are the best, and the best of each filter set, of each kept network and of the two that the paper shows.
        """
        picked = {row["trial"] for row in ranked[:BEST]}
        picked |= {planned.id for planned in self._first_of(ranked, self.keep | {CHOSEN, SECOND})}
        seen: set[str] = set()
        for row in ranked:
            if row["filter_set"] not in seen:
                seen.add(row["filter_set"])
                picked.add(row["trial"])
        return [planned for planned in self.plan.trials if planned.id in picked]

    def _counts(self, planned: PlannedTrial) -> Counts:
        total: Counts = sum(
            (self.outcomes[run.job].scored[planned.trial.epochs].counts for run in planned.runs),
            start=np.zeros((1, 1), dtype=np.int64),
        )
        return total


def _ranked(row: Mapping[str, Any]) -> bool:
    return row["status"] == "done" and row["accuracy"] is not None


def _rank(row: Mapping[str, Any]) -> tuple[float, int]:
    """Return a sort key for rows: the most accurate trial first, of equal ones the smallest network."""
    return -row["accuracy"], row["parameters"]


def _words(planned: PlannedTrial, run: PlannedRun) -> dict[str, Any]:
    arch = planned.trial.arch
    return {
        "arch": arch.symbol,
        "filters": slashed(arch.filters),
        "batch": run.batch,
        "seed": run.seed,
        "fold": run.fold,
    }


def _kind(polars: Any, kind: type[Any]) -> Any:
    return {str: polars.String, int: polars.Int64, float: polars.Float64, bool: polars.Boolean}[kind]


def _frame(polars: Any, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, type[Any]]) -> Any:
    schema = {name: _kind(polars, kind) for name, kind in columns.items()}
    return polars.DataFrame([[row[name] for name in columns] for row in rows], schema=schema, orient="row")


def summary_head(dataset: Dataset, planned: Plan) -> dict[str, Any]:
    """Return the part of a summary that describes data, grid and machine."""
    grid = planned.grid
    return {
        "name": grid.name,
        "id": planned.id,
        "dataset": dataset.head.name,
        "dataset_hash": dataset.hash,
        "simulated": dataset.head.simulated,
        "rate_hz": dataset.layout.rate_hz,
        "split": planned.split.text,
        "leaky": planned.split.leaky,
        "context": grid.context,
        "preset": grid.preset,
        "grid": grid.to_dict(),
        "labels": list(planned.gestures.labels),
        "affects": list(planned.gestures.affects),
        "windows": max(len(windows) for windows in planned.sets.values()),
        "machine": machine(
            f"{os.cpu_count() or '?'} processors",
            f"{grid.threads} thread{'s' * (grid.threads > 1)} a training",
            f"PyTorch {need('torch', 'train').__version__}",
        ),
        "code_version": __version__,
    }
