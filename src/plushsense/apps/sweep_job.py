"""The trainings of a sweep or a search: how they are handed out, what one does, and what its result scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.sweep_plan import Plan, Run, Task
from plushsense.core.errors import DivergedError, PlushSenseError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import Dataset
from plushsense.runs.journal import Journal, Result
from plushsense.runs.pool import Job, Report, run_jobs
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts
from plushsense.windows.cut import WindowSet

# In the data set's folder: finished trainings, and where long ones stand.
JOURNAL, UNFINISHED = ("cache", "sweeps"), ("cache", "unfinished")

# The columns of a training's curve, as its result holds them; the epoch is the row.
CURVE = ("train_loss", "train_accuracy", "validation_loss", "validation_accuracy", "learning_rate")


def train_all(
    dataset: Dataset,
    planned: Plan,
    jobs: Sequence[Job],
    *,
    workers: int,
    cluster: str | None,
    on_done: Callable[[Job, Result, bool], None],
    on_start: Callable[[Job], None] | None = None,
    on_report: Callable[[Job, Any], None] | None = None,
    on_failed: Callable[[Job, Exception], None] | None = None,
) -> dict[str, Result]:
    """Do those ``jobs`` on the windows of a plan that the data set's journal does not hold; as `run_jobs` else."""
    unfinished = Journal(dataset.path.joinpath(*UNFINISHED))

    def done(job: Job, result: Result, resumed: bool) -> None:
        unfinished.discard(job.id)
        on_done(job, result, resumed)

    return run_jobs(
        jobs,
        # Nodes of a cluster do not share a disk: there a training is done whole.
        TrainAndScore(unfinished if cluster is None else None),
        shared=(planned.sets, planned.folds),
        workers=workers,
        threads=planned.grid.threads,
        journal=Journal(dataset.path.joinpath(*JOURNAL)),
        cluster=cluster,
        gpus=1.0 if cluster is not None and planned.grid.device == "cuda" else 0.0,
        on_start=on_start,
        on_report=on_report,
        on_done=done,
        on_failed=on_failed,
    )


@dataclass(frozen=True)
class TrainAndScore:
    """One training as a job: probabilities of the tested windows after each number of epochs that is scored.

    A training whose loss is no longer a number is no reason to stop the others: it is trained up to the longest that
    goes well, and says why not further. ``at`` is the epoch whose weights are scored. In ``unfinished`` a long training
    keeps where it stands, once a minute, and goes on from there.
    """

    unfinished: Journal | None = None

    def __call__(self, shared: Any, task: Task, report: Report, /) -> Result:
        from plushsense.training.fit import fit, predict
        from plushsense.training.state import FitState

        sets, folds = shared
        windows, fold = sets[task.span], folds[task.span][task.fold]
        train, validation, test = (windows.take(index) for index in (fold.train, fold.validation, fold.test))
        wanted, failed, fitted = task.epochs, dict[str, str](), None
        before = None if self.unfinished is None else self.unfinished.find(task.id)
        start = task.start if before is None else FitState.from_arrays(before)

        def save(state: FitState) -> None:
            if self.unfinished is not None:
                # What cannot be kept (a full disk) costs minutes if it is stopped now; giving it up costs all of it.
                with suppress(PlushSenseError):
                    self.unfinished.save(task.id, state.to_arrays())

        while wanted and fitted is None:
            spec = replace(task.spec, epochs=wanted[-1])
            keep = wanted if task.nested else ()
            try:
                fitted = fit(
                    train, validation, task.arch, spec, lambda at, of, row: report((at, of, row["train_loss"])), keep,
                    start=start, save=save if task.nested else None,
                )  # fmt: skip
            except DivergedError as cause:
                failed[str(wanted[-1])] = str(cause)
                wanted, start = wanted[:-1], None
        if fitted is None:
            return _result(
                (), np.zeros((0, len(test), len(windows.labels))), [], [], np.zeros((0, len(CURVE))), 0, failed
            )
        tested, watched = [], []
        for epochs in wanted:
            weights = fitted.kept[epochs] if task.nested else fitted.weights
            tested.append(predict(task.arch, weights, fitted.scaler, test, task.spec.device))
            watched.append(
                _watched(predict(task.arch, weights, fitted.scaler, validation, task.spec.device), validation)
            )
        curve = np.array([[row[name] for name in CURVE] for row in fitted.history], dtype=np.float64)
        at = list(wanted) if task.nested else [fitted.best_epoch]
        seconds = task.spent_s + fitted.seconds
        result = _result(wanted, np.stack(tested), watched, at, curve, seconds, failed)
        state = fitted.state if task.stateful and not failed else None
        # Weights that were scored on the way are of no more use.
        return result if state is None else {**result, **replace(state, kept={}).to_arrays()}


def _result(
    epochs: tuple[int, ...],
    probabilities: NDArray[Any],
    validation: list[tuple[float, float]],
    at: list[int],
    curve: NDArray[Any],
    seconds: float,
    failed: dict[str, str],
) -> Result:
    """(E, n, K) float32, (E, 2) accuracy and macro-F1, (epochs trained, 5) columns as in `CURVE`."""
    return {
        "epochs": list(epochs),
        "at": at,
        "probabilities": probabilities.astype(np.float32),
        "validation": np.array(validation, dtype=np.float64).reshape(-1, 2),
        "curve": curve,
        "seconds": seconds,
        "failed": failed,
    }


def _watched(probabilities: NDArray[Any], windows: WindowSet) -> tuple[float, float]:
    counts = metrics.confusion(windows.y, np.argmax(probabilities, axis=1).astype(np.int64), len(windows.labels))
    return metrics.accuracy(counts), metrics.macro_f1(counts)


@dataclass(frozen=True)
class Scored:
    """A trial's part of one training: its figures, and confusions of all windows that were tested."""

    figures: dict[str, float | None]
    counts: Counts
    windows: int
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What a sweep keeps of one training: a score for each number of epochs, its curve, and what went wrong."""

    scored: dict[int, Scored]
    curve: NDArray[np.float64]
    failed: dict[int, str]
    seconds: float


def outcome(plan: Plan, run: Run, result: Mapping[str, Any]) -> Outcome:
    """Score one training's probabilities. Where people are kept apart, the toy at rest with nobody is not counted."""
    windows, fold = plan.sets[run.span], plan.folds[run.span][run.fold_index]
    truth, classes = windows.y[fold.test], len(windows.labels)
    counted = windows.subject[fold.test] != NOBODY if plan.split.apart else np.ones(len(truth), dtype=np.bool_)
    scored, before, seconds = dict[int, Scored](), 0, float(result["seconds"])
    for i, epochs in enumerate(result["epochs"]):
        read = np.argmax(result["probabilities"][i], axis=1).astype(np.int64)
        counts = metrics.confusion(truth[counted], read[counted], classes)
        accuracy, f1 = result["validation"][i]
        figures = {
            "accuracy": metrics.accuracy(counts),
            "macro_f1": metrics.macro_f1(counts),
            "validation_accuracy": float(accuracy),
            "validation_macro_f1": float(f1),
            "train_loss": float(result["curve"][result["at"][i] - 1, 0]),
        }
        # A training that contains others is paid for once: each number of epochs its own stretch.
        share = seconds * (epochs - before) / result["epochs"][-1]
        before = epochs
        scored[epochs] = Scored(
            {name: value if math.isfinite(value) else None for name, value in figures.items()},
            metrics.confusion(truth, read, classes),
            int(counted.sum()),
            share,
        )
    return Outcome(scored, result["curve"], {int(e): why for e, why in result["failed"].items()}, seconds)
