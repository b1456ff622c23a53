"""The results folder of a sweep: tables of trials, runs and curves, and a summary; whole at any moment.

Everything in it follows from the plan and the journal, so that it can be deleted and made again.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, need
from plushsense.core.files import replacing_file, write_file
from plushsense.core.version import __version__
from plushsense.dataset.store import Dataset
from plushsense.models.arch import slashed
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts, column_metrics
from plushsense.trials.columns import TRIAL_COLUMNS, trial_row
from plushsense.trials.paper import CHOSEN
from plushsense.trials.plan import CURVE, Plan, PlannedRun, PlannedTrial, TrainingOutcome, outcome
from plushsense.workflow.reporting import check_folder, machine

SUMMARY, TRIALS, TRIALS_CSV, RUNS, CURVES = (
    "sweep.json",
    "trials.parquet",
    "trials.csv",
    "runs.parquet",
    "curves.parquet",
)
BEST = 10

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


class Tables:
    """The folder, and all that is known so far. ``writing`` guards the folder, as that of a `Journal` does."""

    def __init__(
        self,
        plan: Plan,
        out: Path,
        head: Mapping[str, Any],
        every_s: float = 5.0,
        writing: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self.plan, self.out, self.head, self._writing = plan, out, dict(head), writing
        self.outcomes: dict[str, TrainingOutcome] = {}
        self.resumed: set[str] = set()
        self.lost: dict[str, str] = {}
        self.best: dict[str, Any] | None = None
        self._of: dict[str, list[tuple[PlannedTrial, PlannedRun]]] = {}
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
        """Return one row for each trial, in the order of the grid."""
        return [self._row(planned) for planned in self.plan.trials]

    def _row(self, planned: PlannedTrial) -> dict[str, Any]:
        return trial_row(planned, self.outcomes, self.head)

    def summary(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``."""
        rows = self.trial_rows()
        done = [row for row in rows if row["status"] == "done"]
        best = sorted(filter(_ranked, rows), key=_rank)
        # Among equals the smallest, then the first of the grid: the test part has no say.
        chosen = min(
            filter(_ranked, rows),
            key=lambda row: (-(row["validation_macro_f1"] or 0.0), row["parameters"]),
            default=None,
        )
        shown = self._confusions_kept(best)
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
        with self._writing():
            return self._write()

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
        # Large tables are written more seldom: never more than a twentieth of the time.
        now = time.monotonic()
        self._due = now + max(self._every_s, 20 * (now - began))
        return summary

    def _run_row(self, planned: PlannedTrial, run: PlannedRun) -> dict[str, Any] | None:
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
        """Return one row for each run and epoch, built by column, as there may be millions."""
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

    def _confusions_kept(self, best: Sequence[Mapping[str, Any]]) -> list[PlannedTrial]:
        """Return the trials whose confusions are kept: the best, those of each filter set, the paper's network."""
        picked = [row["trial"] for row in best[:BEST]]
        seen: set[str] = set()
        for row in best:
            if row["filter_set"] not in seen or (row["arch"], row["filters"]) == CHOSEN:
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


def _ranked(row: Mapping[str, Any]) -> bool:
    return row["status"] == "done" and row["accuracy"] is not None


def _rank(row: Mapping[str, Any]) -> tuple[float, int]:
    """Return a sort key: the most accurate first, of equal ones the smallest."""
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


def check_place(out: Path, identity: str, *, replace: bool = False) -> None:
    """Refuse an output folder that cannot be written to or holds another sweep.

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


def summary_head(dataset: Dataset, planned: Plan) -> dict[str, Any]:
    """Return the part of a summary on data, grid and machine."""
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
