"""Run the trainings of a sweep and score them."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DivergedError
from plushsense.core.gestures import NOBODY
from plushsense.jobs.journal import Journal, Result, keep_if_possible
from plushsense.jobs.pool import Report
from plushsense.models.arch import Arch
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts
from plushsense.scoring.splits import Fold, Split
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

# The columns of a training's curve, which has a row for each epoch.
CURVE = ("train_loss", "train_accuracy", "validation_loss", "validation_accuracy", "learning_rate")


@dataclass(frozen=True)
class Task:
    """A job of a sweep: train a network on one fold, and score it after each of ``epochs``.

    ``span`` selects the windows, ``id`` is the job's.

    The training continues from ``start`` (a `FitState`), if given, which took ``spent_s`` seconds; the weights do not
    depend on it. If ``stateful``, the result includes the final state, from which another training can continue.
    """

    arch: Arch
    spec: TrainSpec
    epochs: tuple[int, ...]
    span: int
    fold: int
    id: str = ""
    start: Any = None
    spent_s: float = 0.0
    stateful: bool = False

    @property
    def nested(self) -> bool:
        """Whether one training gives the scores of all its numbers of ``epochs``: not if it may stop early."""
        return self.spec.patience is None


def processes(workers: int, threads: int) -> int:
    """Return the number of trainings at a time: ``workers``, or for 0 as many as the processor cores allow."""
    if workers < 0:
        raise ConfigError(f"workers is {workers}: accepted are whole numbers from 0 up.")
    return workers or max(1, (os.cpu_count() or 1) // threads)


@dataclass(frozen=True)
class TrainAndScore:
    """The work of one job: train a network and predict the test windows after each number of epochs to score.

    The result has ``probabilities`` (E, N, K) float32 after each of the E numbers of ``epochs``, the ``validation``
    scores (E, 2) and the ``curve``, with the columns of `CURVE`. ``at`` are the epochs whose weights were used.

    If a training diverges, it is repeated with the next smaller number of epochs; ``failed`` has the reason for each
    number that failed. A long training saves its state in ``unfinished`` once a minute, and continues from there after
    an interruption.
    """

    unfinished: Journal | None = None

    def __call__(self, shared: Any, task: Task, report: Report, /) -> Result:
        from plushsense.training.engine import FitState
        from plushsense.training.fit import StoreSpec, fit, predict

        sets, folds = shared
        windows, fold = sets[task.span], folds[task.span][task.fold]
        train, validation, test = (windows.take(index) for index in (fold.train, fold.validation, fold.test))
        epochs_left, failed, fitted = task.epochs, dict[str, str](), None
        before = None if self.unfinished is None else self.unfinished.find(task.id)
        start = task.start if before is None else FitState.from_arrays(before)

        def save(state: FitState) -> None:
            if self.unfinished is not None:
                keep_if_possible(self.unfinished, task.id, state.to_arrays())

        while epochs_left and fitted is None:
            spec = replace(task.spec, epochs=epochs_left[-1])
            try:
                store = StoreSpec(start, epochs_left, save) if task.nested else StoreSpec(start)
                shown = lambda at, of, row: report((at, of, row["train_loss"]))  # noqa: E731
                fitted = fit(train, validation, task.arch, spec, shown, store)
            except DivergedError as cause:
                failed[str(epochs_left[-1])] = str(cause)
                epochs_left, start = epochs_left[:-1], None
        # If every training diverged, ``fitted`` is None and ``epochs_left`` is empty.
        tested, watched = [], []
        for epochs in epochs_left:
            assert fitted is not None
            weights = fitted.kept[epochs] if task.nested else fitted.weights
            tested.append(predict(task.arch, weights, fitted.scaler, test, task.spec.device))
            read = predict(task.arch, weights, fitted.scaler, validation, task.spec.device).argmax(axis=1)
            counts = metrics.confusion(validation.y, read.astype(np.int64), len(validation.labels))
            watched.append((metrics.accuracy(counts), metrics.macro_f1(counts)))
        history: list[dict[str, Any]] = [] if fitted is None else [dict(row) for row in fitted.history]
        result: Result = {
            "epochs": list(epochs_left),
            "at": list(epochs_left) if task.nested or fitted is None else [fitted.best_epoch],
            "probabilities": np.array(tested, dtype=np.float32).reshape(
                len(epochs_left), len(test), len(windows.labels)
            ),
            "validation": np.array(watched, dtype=np.float64).reshape(-1, 2),
            "curve": np.array([[row[name] for name in CURVE] for row in history], np.float64).reshape(-1, len(CURVE)),
            "seconds": 0 if fitted is None else task.spent_s + fitted.seconds,
            "failed": failed,
        }
        state = fitted.state if fitted is not None and task.stateful and not failed else None
        # Another training does not need the intermediate weights in ``kept``.
        return result if state is None else {**result, **replace(state, kept={}).to_arrays()}


@dataclass(frozen=True)
class RunScores:
    """The scores of one run, and the confusion matrix of all its test windows; ``windows`` is the number scored."""

    figures: dict[str, float | None]
    counts: Counts
    windows: int
    seconds: float


@dataclass(frozen=True)
class TrainingResult:
    """Result of one training: scores by number of epochs, the learning curve, and the reason of each failure."""

    scored: dict[int, RunScores]
    curve: NDArray[np.float64]
    failed: dict[int, str]
    seconds: float


def score_training(windows: WindowSet, fold: Fold, split: Split, result: Mapping[str, Any]) -> TrainingResult:
    """Score the stored ``result`` of a training; in splits by person, recordings of `NOBODY` are not scored."""
    truth, classes = windows.y[fold.test], len(windows.labels)
    counted = windows.subject[fold.test] != NOBODY if split.separates_people else np.ones(len(truth), dtype=np.bool_)
    scored, before, seconds = dict[int, RunScores](), 0, float(result["seconds"])
    for i, epochs in enumerate(result["epochs"]):
        read = np.argmax(result["probabilities"][i], axis=1).astype(np.int64)
        counts = metrics.confusion(truth[counted], read[counted], classes)
        accuracy, f1 = result["validation"][i]
        figures = {
            **{key: metric.function(counts) for key, metric in metrics.column_metrics().items()},
            "validation_accuracy": float(accuracy),
            "validation_macro_f1": float(f1),
            "train_loss": float(result["curve"][result["at"][i] - 1, 0]),
        }
        # Divide the time of a training among its trials, so that their times add up to it.
        share = seconds * (epochs - before) / result["epochs"][-1]
        before = epochs
        scored[epochs] = RunScores(
            {name: value if math.isfinite(value) else None for name, value in figures.items()},
            metrics.confusion(truth, read, classes),
            int(counted.sum()),
            share,
        )
    return TrainingResult(scored, result["curve"], {int(e): why for e, why in result["failed"].items()}, seconds)
