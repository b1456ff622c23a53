"""The result of a sweep, and its folder: tables of trials, runs and curves, predictions, and a summary.

All files are made from the plan and the journal, so that the folder can be deleted and written again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Self

from plushsense.core.errors import need
from plushsense.core.files import replacing_file, write_file
from plushsense.evaluation.scores import gather_predictions, write_predictions
from plushsense.experiments.sweep.grid import CHOSEN, SECOND
from plushsense.experiments.sweep.halving import Halving
from plushsense.experiments.sweep.plan import Plan, Trial, TrialRun
from plushsense.experiments.sweep.trainings import CURVE, TrainingResult, score_training
from plushsense.experiments.sweep.trials import TRIAL_COLUMNS, Network, SweepHead, TrialResult, listed_columns
from plushsense.jobs.journal import Result
from plushsense.models.arch import slashed
from plushsense.reports.table import Table
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


@dataclass(frozen=True)
class FailedTraining:
    """A training that failed at a number of epochs, and why."""

    run: str
    arch: str
    filters: str
    batch: int
    seed: int
    fold: str
    epochs: int
    why: str

    @classmethod
    def of(cls, trial: Trial, run: TrialRun, epochs: int, why: str) -> Self:
        return cls(run.job, *trial.network, run.batch, run.seed, run.fold, epochs, why)


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep; its folder ``out`` has it as ``sweep.json``.

    Attributes:
        results: one for each trial, in the order of the grid.
        trainings, trainings_done, trainings_lost: numbers of trainings; a lost one raised an error.
        resumed_jobs: ids of the trainings that the journal had.
        failed: trainings that diverged or raised an error.
        seconds, training_seconds: time since the start, and of all trainings together.
        predictions: names of the files of predictions by trial.
        networks: those whose confusions are kept besides the best ones.
        halving: the rungs and costs of halving, or None.
    """

    out: Path
    head: SweepHead
    results: tuple[TrialResult, ...]
    trainings: int
    trainings_done: int
    trainings_lost: int
    resumed_jobs: frozenset[str]
    failed: tuple[FailedTraining, ...]
    seconds: float
    training_seconds: float
    predictions: Mapping[str, str] = field(default_factory=dict)
    networks: Collection[Network] = ()
    halving: Halving | None = None

    @cached_property
    def trials(self) -> Any:
        """The table of trials, a polars frame with a row for each network, number of epochs and batch."""
        return need("polars", "train").read_parquet(self.out / TRIALS)

    @cached_property
    def runs(self) -> Any:
        """The table of runs, a polars frame with a row for each trial, seed and fold."""
        return need("polars", "train").read_parquet(self.out / RUNS)

    @property
    def done(self) -> list[TrialResult]:
        """The trials with every run finished."""
        return [result for result in self.results if result.status == "done"]

    @cached_property
    def ranked(self) -> list[TrialResult]:
        """The trials that have an accuracy, the best first."""
        return sorted((result for result in self.results if result.ranked), key=lambda result: result.rank)

    @property
    def best_on_validation(self) -> TrialResult | None:
        """The trial that validation alone chooses; of equal ones the smallest network, then the first in the grid."""
        ranked = (result for result in self.results if result.ranked)
        return min(ranked, key=lambda result: result.validation_rank, default=None)

    @property
    def resumed(self) -> int:
        """Number of trials of which the journal had every training."""
        return sum(all(run.job in self.resumed_jobs for run in r.trial.runs) for r in self.results)

    def first_of(self, networks: Collection[Network]) -> list[TrialResult]:
        """Return the best trial, then the best one of each other network among ``networks``."""
        first: dict[Network, TrialResult] = {}
        for result in self.ranked:
            if not first or result.trial.network in networks:
                first.setdefault(result.trial.network, result)
        return list(first.values())

    def _with_confusions(self) -> list[TrialResult]:
        """Return the trials whose confusions are stored.

        They are the best, and the best of each filter set, of each kept network and of the two that the paper shows.
        """
        picked = [*self.ranked[:BEST], *self.first_of({*self.networks, CHOSEN, SECOND})]
        by_filters: dict[tuple[int, ...], TrialResult] = {}
        for result in self.ranked:
            by_filters.setdefault(result.trial.filter_set, result)
        ids = {result.trial.id for result in (*picked, *by_filters.values())}
        return [result for result in self.results if result.trial.id in ids]

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``."""
        chosen, detailed = self.best_on_validation, self._with_confusions()
        return {
            **self.head.to_json(),
            "trials": len(self.results),
            "done": len(self.done),
            "resumed": self.resumed,
            "trainings": self.trainings,
            "trainings_done": self.trainings_done,
            "trainings_resumed": len(self.resumed_jobs),
            "trainings_lost": self.trainings_lost,
            "failed": [asdict(one) for one in self.failed],
            "seconds": self.seconds,
            "training_seconds": self.training_seconds,
            "ranked_by": "accuracy",
            "best": [result.row() for result in self.ranked[:BEST]],
            "best_on_validation": None if chosen is None else chosen.row(),
            "predictions": dict(self.predictions),
            "confusions": {result.trial.id: result.counts.tolist() for result in detailed},
            "per_class": {
                result.trial.id: [row._asdict() for row in class_results(result.counts, self.head.labels)]
                for result in detailed
            },
            **({} if self.halving is None else {"halving": self.halving.to_json()}),
        }

    def best_table(self) -> Table:
        """Return the table of the best trials, which the command line and notebooks show."""
        rows = tuple(result.row() for result in self.ranked[:BEST])
        columns, head = tuple(listed_columns(terminal=True)), self.head
        return Table("best", "The best trials", columns, rows, leaky=head.leaky, simulated=head.simulated)

    def _described(self) -> str:
        marks = ", leaky" * self.head.leaky + ", SIMULATION" * self.head.simulated
        return (
            f"{len(self.done)} of {len(self.results)} trials of the grid '{self.head.name}', {self.head.split}{marks}"
        )

    def __repr__(self) -> str:
        first = ""
        if self.ranked:
            best = self.ranked[0]
            first = f"; best {' '.join(best.trial.network)}: accuracy {best.mean('accuracy'):.3f}"
        return f"SweepResult({self._described()}{first}; {self.out})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(self._described())}</p>{self.best_table().html()}"


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
            if found.ranked and (self.best is None or found.rank < self.best.rank):
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

    def result(self) -> SweepResult:
        """Return the result of the sweep so far."""
        failed = [
            FailedTraining.of(*self._of[job][0], epochs, why)
            for job, trained in self.trained.items()
            for epochs, why in trained.failed.items()
        ]
        lost = ((self._of[job], why) for job, why in self.lost.items())
        failed += [FailedTraining.of(*trials[0], trials[-1][0].epochs, why) for trials, why in lost]
        return SweepResult(
            self.out,
            self.head,
            tuple(map(self.result_of, self.plan.trials)),
            trainings=len(self.plan.jobs),
            trainings_done=len(self.trained),
            trainings_lost=len(self.lost),
            resumed_jobs=frozenset(self.resumed),
            failed=tuple(sorted(failed, key=lambda one: (one.run, one.epochs))),
            seconds=round(time.monotonic() - self._began, 1),
            training_seconds=round(sum(trained.seconds for trained in self.trained.values()), 1),
            predictions=self._predictions,
            networks=self._keep,
            halving=self.halving,
        )

    def write(self, results: Mapping[str, Result] | None = None) -> SweepResult:
        """Write all files, each by replacing it in one step, and return the result.

        Args:
            results: those of all trainings by job; with them, the predictions are written, too.
        """
        began = time.monotonic()
        with self._writing():
            self.out.mkdir(parents=True, exist_ok=True)
            self._predictions = self._write_predictions(results) if results else {}
            result = self.result()
            self._write_tables(result)
            text = json.dumps(result.to_json(), ensure_ascii=False, indent=1, allow_nan=False)
            write_file(self.out / SUMMARY, text)
            if self.halving is not None:
                write_file(self.out / SETTINGS, self.halving.training_config())
        # Limit writing to about a twentieth of the time.
        now = time.monotonic()
        self._due = now + max(_EVERY_S, 20 * (now - began))
        return result

    def _write_predictions(self, results: Mapping[str, Result]) -> dict[str, str]:
        """Write what the best trial, and the best one of each kept network, predicted; return the files by trial.

        A file has the predictions of every seed and fold, as the confusions count them. Files of networks that are no
        longer kept are removed.
        """
        files: dict[str, str] = {}
        for kept in self.result().first_of(self._keep):
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

    def _write_tables(self, result: SweepResult) -> None:
        polars = need("polars", "train")
        kinds = {key: column.type for key, column in TRIAL_COLUMNS.items()}
        trials = _frame(polars, (one.row() for one in result.results), kinds)
        with replacing_file(self.out / TRIALS) as part:
            trials.write_parquet(part)
        with replacing_file(self.out / TRIALS_CSV) as part:
            trials.write_csv(part)
        with replacing_file(self.out / RUNS) as part:
            _frame(polars, self._run_rows(), _RUN_COLUMNS).write_parquet(part)
        with replacing_file(self.out / CURVES) as part:
            self._curves(polars).write_parquet(part)

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
