"""The result of a sweep, and its folder: tables of trials, runs and curves, predictions, and a summary.

All files are made from the plan and the journal, so that the folder can be deleted and written again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

from plushsense.core.errors import need
from plushsense.core.files import replacing_file, write_file
from plushsense.evaluation.scores import gather_predictions, write_predictions
from plushsense.experiments.sweep.grid import CHOSEN, SECOND
from plushsense.experiments.sweep.halving import Halving
from plushsense.experiments.sweep.plan import Plan, Trial, TrialRun
from plushsense.experiments.sweep.trainings import CURVE, TrainingResult, score_training
from plushsense.experiments.sweep.trials import (
    TRIAL_COLUMNS,
    Network,
    SweepHead,
    TrialResult,
    best_on_validation,
    ranked,
)
from plushsense.jobs.journal import Result
from plushsense.models.arch import slashed
from plushsense.scoring.metrics import class_results, column_metrics
from plushsense.workflow.reporting import PREDICTIONS

SUMMARY, SETTINGS = "sweep.json", "train.toml"
TRIALS, TRIALS_CSV, RUNS, CURVES = "trials.parquet", "trials.csv", "runs.parquet", "curves.parquet"
BEST = 10
# Shortest time between two updates of the files.
_EVERY_S = 5.0

_RUN_COLUMNS: dict[str, type[Any]] = {
    **dict.fromkeys(("trial", "run", "arch", "filters"), str),
    **dict.fromkeys(("epochs", "batch", "seed"), int),
    "fold": str,
    "test_windows": int,
    **dict.fromkeys(column_metrics(), float),
    "validation_accuracy": float,
    "train_loss": float,
    "seconds": float,
}
_CURVE_COLUMNS: dict[str, type[Any]] = {
    **dict.fromkeys(("run", "arch", "filters"), str),
    "batch": int,
    "seed": int,
    "fold": str,
    "epoch": int,
    **dict.fromkeys(CURVE, float),
}


def prediction_files(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the names of the files of predictions by trial, from the content of ``sweep.json``."""
    files = summary.get("predictions")
    return {str(trial): str(name) for trial, name in files.items()} if isinstance(files, Mapping) else {}


class SweepFolder:
    """Collects the results of trainings and writes the folder, each time in the context ``writing()``.

    ``keep`` are the networks whose predictions and confusions are kept besides those of the best trial.
    """

    def __init__(
        self,
        plan: Plan,
        out: Path,
        head: SweepHead,
        writing: Callable[[], AbstractContextManager[object]] = nullcontext,
        keep: Collection[Network] = (),
    ) -> None:
        self.plan, self.out, self.head, self._writing, self._keep = plan, out, head, writing, frozenset(keep)
        self.trained: dict[str, TrainingResult] = {}
        self.resumed: set[str] = set()
        self.lost: dict[str, str] = {}
        self.dropped: set[str] = set()
        self.halving: Halving | None = None
        self.best: TrialResult | None = None
        self._of: dict[str, list[tuple[Trial, TrialRun]]] = {}
        for trial in plan.trials:
            for run in trial.runs:
                self._of.setdefault(run.job, []).append((trial, run))
        self._predictions: dict[str, str] = {}
        self._due = 0.0
        self._began = time.monotonic()

    def add(self, job: str, result: Result, resumed: bool) -> None:
        """Add a finished training, and update the files if they are due."""
        run = self._of[job][0][1]
        fold = self.plan.folds[run.span][run.fold_index]
        self.trained[job] = score_training(self.plan.sets[run.span], fold, self.plan.split, result)
        for trial, _ in self._of[job]:
            found = self.result_of(trial)
            if found.complete and (self.best is None or found.rank() < self.best.rank()):
                self.best = found
        if resumed:
            self.resumed.add(job)
        elif time.monotonic() >= self._due:
            # On Windows, a file that another program has open cannot be written; the update at the end will.
            with suppress(OSError):
                self.write()

    def lose(self, job: str, why: str) -> None:
        """Record a training that failed for the reason ``why``; its trials stay without scores."""
        self.lost[job] = why

    def result_of(self, trial: Trial) -> TrialResult:
        """Return the result of a trial so far."""
        return TrialResult.of(trial, self.trained, self.head, trial.id in self.dropped)

    def _failures(self) -> list[dict[str, Any]]:
        """Return each training that diverged or raised an error, with the reason, as in ``sweep.json``."""
        diverged = (
            (self._of[j][0], e, why) for j, trained in self.trained.items() for e, why in trained.failed.items()
        )
        lost = ((self._of[job][0], self._of[job][-1][0].epochs, why) for job, why in self.lost.items())
        rows = [
            {**_training_columns(trial, run), "epochs": epochs, "why": why}
            for (trial, run), epochs, why in (*diverged, *lost)
        ]
        return sorted(rows, key=lambda row: (row["run"], row["epochs"]))

    def summary(self) -> dict[str, object]:
        """Return the content of ``sweep.json``.

        Confusions are those of the best trials, and of the best of each filter set, of each kept network and of the two
        that the paper shows.
        """
        results = [self.result_of(trial) for trial in self.plan.trials]
        best = ranked(results)
        chosen = best_on_validation(results)
        sets = {result.trial.filter_set: result for result in reversed(best)}
        shown = {r.trial.id for r in (*best[:BEST], *_first(best, {*self._keep, CHOSEN, SECOND}), *sets.values())}
        detailed = [result for result in results if result.trial.id in shown]
        return {
            **self.head.to_json(),
            "trials": len(results),
            "done": sum(result.status == "done" for result in results),
            "resumed": sum(all(run.job in self.resumed for run in r.trial.runs) for r in results),
            "trainings": len(self.plan.jobs),
            "trainings_done": len(self.trained),
            "trainings_resumed": len(self.resumed),
            "trainings_lost": len(self.lost),
            "failed": self._failures(),
            "seconds": round(time.monotonic() - self._began, 1),
            "training_seconds": round(sum(trained.seconds for trained in self.trained.values()), 1),
            "ranked_by": "accuracy",
            "best": [result.row() for result in best[:BEST]],
            "best_on_validation": None if chosen is None else chosen.row(),
            "predictions": dict(self._predictions),
            "confusions": {result.trial.id: result.counts.tolist() for result in detailed},
            "per_class": {
                result.trial.id: [row._asdict() for row in class_results(result.counts, self.head.labels)]
                for result in detailed
            },
            **({} if self.halving is None else {"halving": self.halving.to_json()}),
        }

    def write(self, results: Mapping[str, Result] | None = None) -> None:
        """Write all files, each by replacing it in one step.

        Args:
            results: those of all trainings by job; with them, the predictions are written, too.
        """
        began = time.monotonic()
        with self._writing():
            self.out.mkdir(parents=True, exist_ok=True)
            self._predictions = self._write_predictions(results) if results else {}
            self._write_tables()
            write_file(self.out / SUMMARY, json.dumps(self.summary(), ensure_ascii=False, indent=1, allow_nan=False))
            if self.halving is not None:
                write_file(self.out / SETTINGS, self.halving.training_config())
        # Limit writing to about a twentieth of the time.
        now = time.monotonic()
        self._due = now + max(_EVERY_S, 20 * (now - began))

    def _write_predictions(self, results: Mapping[str, Result]) -> dict[str, str]:
        """Write what the best trial, and the best one of each kept network, predicted; return the files by trial.

        A file has the predictions of every seed and fold, as the confusions count them. Files of networks that are no
        longer kept are removed.
        """
        files: dict[str, str] = {}
        for kept in _first(ranked([self.result_of(trial) for trial in self.plan.trials]), self._keep):
            trial = kept.trial
            name = PREDICTIONS if not files else f"predictions-{'-'.join(trial.network).replace('/', '-')}.parquet"
            tested = [(run.fold, self.plan.folds[run.span][run.fold_index].test) for run in trial.runs]
            parts = []
            for run in trial.runs:
                result = results[run.job]
                parts.append(result["probabilities"][list(result["epochs"]).index(trial.epochs)])
            windows = self.plan.sets[trial.runs[0].span]
            write_predictions(self.out / name, gather_predictions(windows, tested, parts))
            files[trial.id] = name
        for path in self.out.glob("predictions-*.parquet"):
            if path.name not in files.values():
                path.unlink()
        return files

    def _write_tables(self) -> None:
        polars = need("polars", "train")
        kinds = {key: column.type for key, column in TRIAL_COLUMNS.items()}
        trials = _frame(polars, (self.result_of(trial).row() for trial in self.plan.trials), kinds)
        with replacing_file(self.out / TRIALS_CSV) as part:
            trials.write_csv(part)
        runs = _frame(polars, self._run_rows(), _RUN_COLUMNS)
        for name, frame in ((TRIALS, trials), (RUNS, runs), (CURVES, self._curves(polars))):
            with replacing_file(self.out / name) as part:
                frame.write_parquet(part)

    def _run_rows(self) -> Iterable[dict[str, Any]]:
        for trial in self.plan.trials:
            for run in trial.runs:
                trained = self.trained.get(run.job)
                scored = None if trained is None else trained.scored.get(trial.epochs)
                if scored is not None:
                    yield {
                        "trial": trial.id,
                        **_training_columns(trial, run),
                        "epochs": trial.epochs,
                        "test_windows": scored.windows,
                        **{name: scored.figures[name] for name in _RUN_COLUMNS if name in scored.figures},
                        "seconds": scored.seconds,
                    }

    def _curves(self, polars: Any) -> Any:
        """Return the table of curves, a row for each training and epoch; it is built by column for speed."""
        parts = []
        for job in sorted(self.trained):
            curve = self.trained[job].curve
            part = polars.DataFrame({name: curve[:, i] for i, name in enumerate(CURVE)}).fill_nan(None)
            training = _training_columns(*self._of[job][0])
            parts.append(
                part.with_columns(
                    epoch=polars.int_range(1, len(curve) + 1, eager=True),
                    **{name: polars.lit(value) for name, value in training.items()},
                )
                .select(list(_CURVE_COLUMNS))
                .cast(_CURVE_COLUMNS)
            )
        return polars.concat(parts) if parts else _frame(polars, [], _CURVE_COLUMNS)


def _first(ranked: Sequence[TrialResult], networks: Collection[Network]) -> list[TrialResult]:
    """Return the best trial, then the best one of each other network among ``networks``."""
    first: dict[Network, TrialResult] = {}
    for result in ranked:
        if not first or result.trial.network in networks:
            first.setdefault(result.trial.network, result)
    return list(first.values())


def _training_columns(trial: Trial, run: TrialRun) -> dict[str, Any]:
    return {
        "run": run.job,
        "arch": trial.arch.symbol,
        "filters": slashed(trial.arch.filters),
        "batch": run.batch,
        "seed": run.seed,
        "fold": run.fold,
    }


def _frame(polars: Any, rows: Iterable[Mapping[str, Any]], columns: Mapping[str, type[Any]]) -> Any:
    return polars.DataFrame([[row[name] for name in columns] for row in rows], schema=dict(columns), orient="row")
