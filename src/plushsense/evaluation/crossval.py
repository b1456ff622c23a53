"""Cross-validation: folds, one training a fold through the journal, every prediction kept, scores at the end.

What trains is handed in: a picklable callable, so that this room needs no PyTorch and folds run side by side.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.evaluation.deployed import beside
from plushsense.evaluation.folds import WindowFold, fold_windows
from plushsense.evaluation.predictions import Predictions, gather, write_predictions
from plushsense.evaluation.scores import FoldRecord, scores
from plushsense.runs.journal import Journal, Result, job_id
from plushsense.runs.pool import Job, Report, run_jobs
from plushsense.scoring.splits import Split, parse_split
from plushsense.windows.cut import WindowSet

# Part of every job's id: raise it when the meaning of a stored fold changes.
_VERSION = 1


@dataclass(frozen=True)
class FoldOutput:
    """What one training leaves: probabilities (N, K) of the test windows, the history's rows, time, best epoch.

    ``deployed`` (N, K): what the same network says of them once it is deployed; None where nobody asked.
    """

    probabilities: NDArray[np.float32]
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    best_epoch: int = 0
    deployed: NDArray[np.float32] | None = None


EpochProgress = Callable[[int, int, dict[str, Any]], None]


class FitPredict(Protocol):
    """Trains on the first windows, watches the second, reads the third; picklable, the same for the same input."""

    def __call__(
        self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: EpochProgress, /
    ) -> FoldOutput:
        """``progress`` is called with (epoch, epochs at most, the epoch's row)."""
        ...


class FoldProgress(NamedTuple):
    """Where an evaluation stands: ``epoch`` of ``epochs`` in ``fold``; epoch 0: that fold is done.

    ``row``: the epoch's row of the history, where what trains gives one.
    """

    done: int
    folds: int
    fold: str
    epoch: int
    epochs: int
    resumed: int
    row: dict[str, Any] | None = None


@dataclass
class Evaluation:
    """The outcome of `evaluate`. ``to_dict`` is what a report or ``--json`` shows."""

    split: Split
    context: str
    train_context: str
    seeds: list[int]
    table: dict[str, Any]
    histories: list[list[dict[str, Any]]]
    predictions: Predictions
    predictions_path: Path | None = None

    def write_predictions(self, path: str | Path) -> Path:
        """Write every prediction to a Parquet file, and remember where."""
        self.predictions_path = write_predictions(path, self.predictions)
        return self.predictions_path

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "split": self.split.text,
            "context": self.context,
            "train_context": self.train_context,
            "leaky": self.split.leaky,
            "seeds": self.seeds,
            **self.table,
            "histories": self.histories,
            "predictions": None if self.predictions_path is None else str(self.predictions_path),
        }

    def __repr__(self) -> str:
        shown = self.table["accuracy"]["mean"]
        leaky = ", leaky" if self.split.leaky else ""
        return (
            f"Evaluation({self.split.text}{leaky}, trained on {self.train_context}, scored on {self.context}: "
            f"accuracy {shown:.3f} over {len(self.predictions)} windows)"
        )


def evaluate(
    train_windows: WindowSet,
    score_windows: WindowSet,
    split: str,
    fit_predict: FitPredict,
    *,
    journal: Journal | None = None,
    key: Mapping[str, Any] | None = None,
    workers: int = 1,
    cluster: str | None = None,
    seed: int = 0,
    progress: Callable[[FoldProgress], None] | None = None,
) -> Evaluation:
    """Train and score once a fold of ``split``.

    Args:
        train_windows, score_windows: the same recordings, possibly cut with another context; one set for both is fine.
        split: "leave-one-subject-out", "by-subject:5", "by-recording:5", "windows:5", "windows:holdout".
        journal: where finished folds are kept, and looked for first.
        key: with a journal, everything that ``fit_predict`` depends on (network, schedule, its seed). The windows
            and the folds go into a job's id by themselves.
        workers: folds at a time, each in a process of its own.
        cluster: address of a Ray cluster that does the folds instead.
        seed: of the split.

    Raises:
        BadInput: for a split that cannot be made; PlushSenseError: what ``fit_predict`` raises.
    """
    if journal is not None and key is None:
        raise ConfigError("A journal needs a key that says what was trained: give evaluate(..., key={...}).")
    asked = parse_split(split)
    folds = fold_windows(train_windows, score_windows, asked, seed)
    base = {"version": _VERSION, "key": dict(key or {}), "windows": _prints(train_windows, score_windows)}
    jobs = [Job(job_id({**base, "fold": fold_print(fold)}), fold) for fold in folds]
    told = _Teller(len(folds), progress)
    results = run_jobs(
        jobs,
        _FoldWork(fit_predict),
        shared=(train_windows, None if score_windows is train_windows else score_windows),
        workers=workers,
        cluster=cluster,
        journal=journal,
        on_done=told.done,
        on_report=told.epoch,
    )
    outcomes = [results[job.id] for job in jobs]
    records = [
        FoldRecord(
            fold.name,
            fold.subjects,
            (len(fold.train), len(fold.validation), len(fold.test)),
            int(outcome["best_epoch"]) if not outcome["history"] else len(outcome["history"]),
            float(outcome["seconds"]),
        )
        for fold, outcome in zip(folds, outcomes, strict=True)
    ]
    tested = [(fold.name, fold.test) for fold in folds]
    predictions = gather(score_windows, tested, [outcome["probabilities"] for outcome in outcomes])
    table = scores(predictions, records, score_windows.affects, asked.apart)
    if all("deployed" in outcome for outcome in outcomes):
        deployed = gather(score_windows, tested, [outcome["deployed"] for outcome in outcomes])
        after = scores(deployed, records, score_windows.affects, asked.apart)
        table["int8"] = beside(table, after, predictions, deployed)
    return Evaluation(
        split=asked,
        context=context_of(score_windows),
        train_context=context_of(train_windows),
        seeds=[seed],
        table=table,
        histories=[list(outcome["history"]) for outcome in outcomes],
        predictions=predictions,
    )


@dataclass(frozen=True)
class _FoldWork:
    """One fold as a job."""

    fit_predict: FitPredict

    def __call__(self, shared: Any, task: WindowFold, report: Report, /) -> Result:
        train, score = shared
        score = train if score is None else score

        def progress(epoch: int, epochs: int, row: dict[str, Any]) -> None:
            report((epoch, epochs, row))

        out = self.fit_predict(train.take(task.train), train.take(task.validation), score.take(task.test), progress)
        found = {"probabilities": out.probabilities}
        if out.deployed is not None:
            found["deployed"] = out.deployed
        wanted = (len(task.test), len(score.labels))
        for what, probabilities in found.items():
            found[what] = probabilities = np.asarray(probabilities, dtype=np.float32)
            if probabilities.shape != wanted:
                raise ConfigError(
                    f"fit_predict gave {what} of the shape {probabilities.shape}; {wanted} (windows, classes) is "
                    "expected."
                )
        return {
            **found,
            "history": out.history,
            "seconds": out.seconds,
            "best_epoch": out.best_epoch,
        }


class _Teller:
    """Turns what jobs say into `FoldProgress`."""

    def __init__(self, folds: int, progress: Callable[[FoldProgress], None] | None) -> None:
        self._folds, self._progress = folds, progress
        self._done = self._resumed = 0

    def done(self, job: Job, result: Result, resumed: bool) -> None:
        self._done += 1
        self._resumed += resumed
        self._tell(job, 0, 0)

    def epoch(self, job: Job, message: tuple[int, int, dict[str, Any]]) -> None:
        self._tell(job, *message)

    def _tell(self, job: Job, epoch: int, epochs: int, row: dict[str, Any] | None = None) -> None:
        if self._progress is not None:
            at = (self._done, self._folds, job.task.name, epoch, epochs, self._resumed)
            self._progress(FoldProgress(*at, row))


def context_of(windows: WindowSet) -> str:
    """The kind of context of a set: "anywhere" or "stream" where any window has a real past, else "loop" or
    "inside"."""
    present = set(np.unique(windows.context).tolist())
    return next((kind for kind in ("anywhere", "stream", "loop") if kind in present), "inside")


def _prints(train: WindowSet, score: WindowSet) -> list[str]:
    """The content of both sets, hashed: other windows are other jobs."""
    first = windows_print(train)
    return [first, first if score is train else windows_print(score)]


def windows_print(windows: WindowSet) -> str:
    """The content of a set, hashed: what jobs on it go by."""
    digest = hashlib.sha256(repr((windows.x.shape, windows.labels, windows.recording_ids)).encode())
    for array in (windows.x, windows.y, windows.recording):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def fold_print(fold: WindowFold) -> str:
    """Which windows a fold trains on, validates on and tests, hashed."""
    digest = hashlib.sha256()
    for index in (fold.train, fold.validation, fold.test):
        digest.update(len(index).to_bytes(8, "little") + index.astype("<i8").tobytes())
    return digest.hexdigest()
