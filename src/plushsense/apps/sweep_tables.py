"""The results folder of a sweep: tables of trials, runs and curves, and a summary; whole at any moment.

Everything in it follows from the plan and the journal, so that it can be deleted and made again.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np

from plushsense.apps.places import check_folder
from plushsense.apps.sweep_job import CURVE, Outcome, outcome
from plushsense.apps.sweep_plan import Plan, PlannedTrial, Run
from plushsense.core.errors import ConfigError
from plushsense.core.extras import need
from plushsense.dataset.store import write_atomically
from plushsense.models.arch import DEFAULT_FILTERS
from plushsense.models.symbol import slashed
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts

SUMMARY, TRIALS, TRIALS_CSV, RUNS, CURVES = (
    "sweep.json",
    "trials.parquet",
    "trials.csv",
    "runs.parquet",
    "curves.parquet",
)
BEST = 10
# Paper, section 3.6.2: the network that it chose.
PAPERS_CHOICE = ("14d1_39d2_41d4", DEFAULT_FILTERS)

_TRIAL_COLUMNS: dict[str, type[Any]] = {
    "trial": str,
    "arch": str,
    "filters": str,
    "filter_set": str,
    "padding": str,
    "norm": str,
    "epochs": int,
    "batch": int,
    "batch_asked": str,
    "seeds": int,
    "folds": int,
    "parameters": int,
    "receptive_field": int,
    "span": int,
    "macs_per_window": int,
    "macs_per_step": int,
    "state_bytes_int8": int,
    "accuracy": float,
    "accuracy_sd": float,
    "macro_f1": float,
    "macro_f1_sd": float,
    "validation_accuracy": float,
    "validation_macro_f1": float,
    "train_loss": float,
    "acr": float,
    "seconds": float,
    "status": str,
    "split": str,
    "leaky": bool,
    "simulated": bool,
}
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
    "accuracy": float,
    "macro_f1": float,
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
# Their means make a trial's.
_MEANS = ("accuracy", "macro_f1", "validation_accuracy", "validation_macro_f1", "train_loss")


class Tables:
    """The folder, and all that is known so far."""

    def __init__(self, plan: Plan, out: Path, head: Mapping[str, Any], every_s: float = 5.0) -> None:
        self.plan, self.out, self.head = plan, out, dict(head)
        self.outcomes: dict[str, Outcome] = {}
        self.resumed: set[str] = set()
        self.lost: dict[str, str] = {}
        self.best: dict[str, Any] | None = None
        self._of: dict[str, list[tuple[PlannedTrial, Run]]] = {}
        for planned in plan.trials:
            for run in planned.runs:
                self._of.setdefault(run.job, []).append((planned, run))
        self._every_s, self._due = every_s, 0.0
        self._began = time.monotonic()

    def add(self, job: str, result: Mapping[str, Any], resumed: bool) -> None:
        """Take in a training that is done; the files follow when it is time."""
        self.outcomes[job] = outcome(self.plan, self._of[job][0][1], result)
        for planned, _ in self._of[job]:
            row = self._row(planned)
            if _ranked(row) and (self.best is None or _rank(row) < _rank(self.best)):
                self.best = row
        if resumed:
            self.resumed.add(job)
        elif time.monotonic() >= self._due:
            # One that somebody holds open (Windows) stays as it is; the last writing is not so lenient.
            with suppress(OSError):
                self.write()

    def lose(self, job: str, why: str) -> None:
        """Note a training that was given up; its trials wait for another run."""
        self.lost[job] = why

    def trial_rows(self) -> list[dict[str, Any]]:
        """One row a trial, in the order of the grid."""
        return [self._row(planned) for planned in self.plan.trials]

    def _row(self, planned: PlannedTrial) -> dict[str, Any]:
        marks = {key: self.head[key] for key in ("split", "leaky", "simulated")}
        return {**_trial_row(planned, self.outcomes), **marks}

    def summary(self) -> dict[str, Any]:
        """What ``sweep.json`` holds."""
        rows = self.trial_rows()
        done = [row for row in rows if row["status"] == "done"]
        best = sorted(filter(_ranked, rows), key=_rank)
        # Among equals the smallest, then the first of the grid: the test part has no say.
        chosen = min(
            filter(_ranked, rows),
            key=lambda row: (-(row["validation_macro_f1"] or 0.0), row["parameters"]),
            default=None,
        )
        shown = self._shown(best)
        failed = [
            {"run": job, **_words(*self._of[job][0]), "epochs": epochs, "why": why}
            for job, found in self.outcomes.items()
            for epochs, why in found.failed.items()
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
            "training_seconds": round(sum(found.seconds for found in self.outcomes.values()), 1),
            "ranked_by": "accuracy",
            "best": best[:BEST],
            "best_on_validation": chosen,
            "confusions": {planned.id: self._counts(planned).tolist() for planned in shown},
            "per_class": {planned.id: self._classes(planned) for planned in shown},
        }

    def write(self) -> dict[str, Any]:
        """Write all files, each in one step; returns the summary."""
        began = time.monotonic()
        self.out.mkdir(parents=True, exist_ok=True)
        polars = need("polars", "train")
        trials = _frame(polars, self.trial_rows(), _TRIAL_COLUMNS)
        _replaced(self.out / TRIALS, trials.write_parquet)
        _replaced(self.out / TRIALS_CSV, trials.write_csv)
        runs = [
            row
            for planned in self.plan.trials
            for run in planned.runs
            if (row := self._run_row(planned, run)) is not None
        ]
        _replaced(self.out / RUNS, _frame(polars, runs, _RUN_COLUMNS).write_parquet)
        _replaced(self.out / CURVES, self._curves(polars).write_parquet)
        summary = self.summary()
        write_atomically(self.out / SUMMARY, json.dumps(summary, ensure_ascii=False, indent=1, allow_nan=False))
        # Large tables are written more seldom: never more than a twentieth of the time.
        now = time.monotonic()
        self._due = now + max(self._every_s, 20 * (now - began))
        return summary

    def _run_row(self, planned: PlannedTrial, run: Run) -> dict[str, Any] | None:
        found = self.outcomes.get(run.job)
        scored = None if found is None else found.scored.get(planned.trial.epochs)
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
        """One row a run and epoch; column by column, as there may be millions."""
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

    def _shown(self, best: Sequence[Mapping[str, Any]]) -> list[PlannedTrial]:
        """The trials whose confusions are kept: the best, the best of each filter set, and the paper's network."""
        picked = [row["trial"] for row in best[:BEST]]
        seen: set[str] = set()
        for row in best:
            papers = (row["arch"], row["filters"]) == (PAPERS_CHOICE[0], slashed(PAPERS_CHOICE[1]))
            if row["filter_set"] not in seen or papers:
                seen.add(row["filter_set"])
                picked.append(row["trial"])
        return [planned for planned in self.plan.trials if planned.id in picked]

    def _counts(self, planned: PlannedTrial) -> Counts:
        total: Counts = sum(
            (self.outcomes[run.job].scored[planned.trial.epochs].counts for run in planned.runs),
            start=np.zeros((1, 1), dtype=np.int64),
        )
        return total

    def _classes(self, planned: PlannedTrial) -> list[dict[str, Any]]:
        found = metrics.class_scores(self._counts(planned))
        return [
            {
                "label": label,
                "f1": float(found.f1[k]),
                "recall": float(found.recall[k]),
                "precision": float(found.precision[k]),
                "support": int(found.support[k]),
            }
            for k, label in enumerate(self.plan.gestures.labels)
        ]


def _trial_row(planned: PlannedTrial, outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    trial, arch = planned.trial, planned.trial.arch
    there = [outcomes[run.job] for run in planned.runs if run.job in outcomes]
    scored = [found.scored[trial.epochs] for found in there if trial.epochs in found.scored]
    if len(scored) < len(there):
        # Those that are left would flatter: they are the ones that went well.
        status, scored = "failed", []
    elif not scored:
        status = "waiting"
    else:
        status = "done" if len(scored) == len(planned.runs) else "partial"
    row: dict[str, Any] = {
        "trial": planned.id,
        "arch": arch.symbol,
        "filters": slashed(arch.filters),
        "filter_set": slashed(trial.filter_set),
        "padding": arch.padding,
        "norm": arch.norm,
        "epochs": trial.epochs,
        "batch": max(run.batch for run in planned.runs),
        "batch_asked": str(trial.batch),
        "seeds": len({run.seed for run in planned.runs}),
        "folds": len({run.fold for run in planned.runs}),
        **{
            name: getattr(arch, name)
            for name in (
                "parameters", "receptive_field", "span", "macs_per_window", "macs_per_step", "state_bytes_int8"
            )
        },
    }  # fmt: skip
    for name in _MEANS:
        values = [value for s in scored if (value := s.figures[name]) is not None]
        whole = len(values) == len(scored) > 0
        row[name] = fmean(values) if whole else None
        if name in ("accuracy", "macro_f1"):
            row[f"{name}_sd"] = stdev(values) if whole and len(values) > 1 else None
    accuracy = row["accuracy"]
    row["acr"] = None if accuracy is None else accuracy / math.log10(arch.parameters)
    row["seconds"] = sum(s.seconds for s in scored) if scored else None
    row["status"] = status
    return {name: row[name] for name in _TRIAL_COLUMNS if name in row}


def _ranked(row: Mapping[str, Any]) -> bool:
    return row["status"] == "done" and row["accuracy"] is not None


def _rank(row: Mapping[str, Any]) -> tuple[float, int]:
    """The most accurate first; of equals the smallest."""
    return -row["accuracy"], row["parameters"]


def _words(planned: PlannedTrial, run: Run) -> dict[str, Any]:
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


def _replaced(path: Path, write: Callable[[Path], object]) -> None:
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        write(part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def check_place(out: Path, identity: str, *, replace: bool = False) -> None:
    """Whether a sweep may be written to a folder: better asked before hours of training than after.

    Raises:
        ConfigError: where ``out`` cannot be a folder, or holds (not with ``replace``) a sweep of another grid or data.
    """
    check_folder(out, "A sweep")
    path = out / SUMMARY
    if replace or not path.exists():
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        other = held["id"] != identity
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigError(
            f"'{path}' is no summary of a sweep: choose another --out, or --force to replace it."
        ) from None
    if other:
        raise ConfigError(
            f"'{out}' holds a sweep of another grid or other data ({held.get('name')}, {held.get('split')}): choose "
            "another --out, or --force to replace it; its trainings stay in the journal."
        )
