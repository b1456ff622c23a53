"""Compare several programs on the same windows under several splits: their scores, sizes and times.

Each combination of program, split and fold is one job of the journal. A program is a picklable callable, as in
``crossval``, so that this module needs neither scikit-learn nor PyTorch. Sizes and times of all programs are measured
here in the same way.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, need
from plushsense.core.gestures import NOBODY
from plushsense.evaluation.crossval import SharedRows, context_of, fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.evaluation.leakage import LeakageResult, audit_leakage
from plushsense.evaluation.scores import FoldRecord, compute_scores, gather_predictions
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import JobsSpec, Report
from plushsense.jobs.study import Progress, StudyPart, StudyResults, run_study
from plushsense.scoring.metrics import column_metrics
from plushsense.scoring.splits import Fold, Split, parse_split
from plushsense.windows.cut import WindowSet

# Part of every job's id: increase it when the meaning of a stored fold changes.
_VERSION = 2
# Number of single windows that are timed for the latency, and of untimed ones before them that fill the caches.
_TIMED, _WARM = 20, 3
# Processor time of this process, which uses one thread, so that other programs on the machine hardly influence it.
_clock = time.process_time


Pca = bool | Literal["unscaled"]
"""Whether PCA reduces the features of a program; "unscaled" is a PCA of features that were not scaled before."""
UNSCALED: Final = "unscaled"


def reads(features: str, pca: Pca) -> str:
    """Return what a program reads, for tables: ``statistics, PCA unscaled``."""
    return features + (", PCA" if pca else "") + (" unscaled" if pca == UNSCALED else "")


class Reader(Protocol):
    """A fitted program: a call returns probabilities (N, K) for N windows; ``size_bytes`` is its size when stored."""

    @property
    def size_bytes(self) -> int: ...

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]: ...


Fit = Callable[[WindowSet, WindowSet], Reader]
"""A function that fits a program to the training windows; it may use the second argument, the validation windows.

It must be picklable and deterministic.
"""


@dataclass(frozen=True)
class Contender:
    """A program in the comparison: its name, its input features, and the function that fits it.

    ``key`` holds everything that ``fit`` depends on besides name, features and PCA. The program reads the last
    ``samples`` of each window; None: all of them.
    """

    name: str
    title: str
    features: str
    pca: Pca
    fit: Fit
    key: Mapping[str, Any]
    samples: int | None = None

    @property
    def words(self) -> str:
        """Title, features and PCA in one line, for progress and messages."""
        return f"{self.title}, {reads(self.features, self.pca)}"


Program = tuple[str, str, Pca]
"""Name, features, and whether and how PCA reduces them."""


@dataclass(frozen=True)
class ProgramScores:
    """Scores and costs of one program under one split.

    ``metrics`` holds mean, sd and interval of each of `column_metrics` over people or folds (``over``), and ``pooled``
    those of all windows. Sizes and times are medians over the folds.
    """

    name: str
    title: str
    features: str
    pca: Pca
    span_s: float
    split: str
    leaky: bool
    apart: bool
    over: str
    folds: int
    metrics: Mapping[str, Any]
    pooled: Mapping[str, Any]
    by_recording: Mapping[str, Any]
    size_bytes: int
    predict_ms: float
    predict_batch_ms: float
    train_s: float
    train_s_in_all: float

    @property
    def program(self) -> Program:
        return self.name, self.features, self.pca


@dataclass(frozen=True)
class ProgramGap:
    """How much higher a program scores under a leaky split than under one by person: the difference of each metric."""

    name: str
    title: str
    features: str
    pca: Pca
    split: str
    leaky_split: str
    metrics: Mapping[str, float]

    @property
    def program(self) -> Program:
        return self.name, self.features, self.pca


@dataclass(frozen=True)
class SplitFolds:
    """A split of the comparison, its number of folds, and what its folds share (see `audit_leakage`)."""

    split: str
    leaky: bool
    folds: int
    leakage: LeakageResult


@dataclass(frozen=True)
class ComparisonResult:
    """The result of `compare`; ``models`` has one row for each contender and split."""

    context: str
    splits: tuple[SplitFolds, ...]
    windows: int
    recordings: int
    subjects: int
    labels: tuple[str, ...]
    seed: int
    jobs: int
    resumed: int
    models: tuple[ProgramScores, ...]
    gaps: tuple[ProgramGap, ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values; the metrics of a row stand beside its other keys."""
        rows = {
            "splits": [{**vars(split), "leakage": split.leakage.to_json()} for split in self.splits],
            "labels": list(self.labels),
            "models": [flat(row) for row in self.models],
            "gaps": [flat(gap) for gap in self.gaps],
        }
        return {**vars(self), **rows}


@dataclass(frozen=True)
class BaselinesResult(ComparisonResult):
    """The result of `run_baselines.baselines`: that of `compare`, and what it was made of."""

    dataset: str
    dataset_hash: str
    simulated: bool
    preset: str
    training: Mapping[str, Any]
    window_s: float
    id: str
    machine: str
    code_version: str


def flat(row: ProgramScores | ProgramGap) -> dict[str, object]:
    """Return the values of a row by name, with its metrics among them."""
    values: dict[str, Any] = {}
    for name, value in vars(row).items():
        values |= value if name == "metrics" else {name: value}
    return values


@dataclass(frozen=True)
class _Task:
    contender: Contender
    split: Split
    fold: Fold


def compare(
    windows: WindowSet,
    contenders: Sequence[Contender],
    splits: Sequence[str],
    *,
    spec: JobsSpec | None = None,
    seed: int = 0,
    shared_rows: SharedRows = tuple,
    progress: Progress | None = None,
) -> ComparisonResult:
    """Fit and score every contender in every fold of every split, all on the same windows.

    Programs are fitted to the training windows of a fold; its validation windows are for early stopping only.

    Args:
        shared_rows: called for the argument ``shared_rows`` of `audit_leakage`.

    Raises:
        ConfigError: for a contender or split that is given twice, an unknown split, or none of either.
        BadInput: for a split that the windows do not allow.
        MissingExtraError: without threadpoolctl, which comes with scikit-learn.
    """
    need("threadpoolctl", extra="baselines")
    if not contenders:
        raise ConfigError("No program is left to compare: give one or more, such as  --models forest,knn")
    names = [(c.name, c.features, c.pca) for c in contenders]
    if len(set(names)) < len(names):
        raise ConfigError("A program is given twice: name each once.")
    folds = {split: fold_windows(windows, windows, split, seed) for split in _parsed(splits)}
    marks = {split: [fold_fingerprint(fold) for fold in made] for split, made in folds.items()}
    parts = [
        StudyPart(
            f"{contender.words}, {fold.name}",
            {"model": name, "key": dict(contender.key), "fold": mark},
            _Task(contender, split, fold),
        )
        for name, contender in zip(names, contenders, strict=True)
        for split, made in folds.items()
        for fold, mark in zip(made, marks[split], strict=True)
    ]

    def summarise(study: StudyResults) -> ComparisonResult:
        together = itertools.groupby(study.done, key=lambda done: (done[0].task.contender, done[0].task.split))
        rows = tuple(_row(windows, list(done)) for _, done in together)
        return ComparisonResult(
            context_of(windows),
            _audited(windows, folds, shared_rows()),
            len(windows),
            len(np.unique(windows.recording)),
            len(set(windows.subject.tolist()) - {NOBODY}),
            tuple(windows.labels),
            seed,
            len(parts),
            study.resumed,
            rows,
            gaps(rows),
        )

    key = {"version": _VERSION, "windows": windows_fingerprint(windows), "rate_hz": windows.rate_hz}
    return run_study(parts, _work, summarise, key=key, shared=windows, spec=spec, progress=progress)


def _audited(
    windows: WindowSet, folds: Mapping[Split, Sequence[Fold]], shared_rows: Collection[tuple[str, str]]
) -> tuple[SplitFolds, ...]:
    """Return each split with the leakage audit of its folds."""
    return tuple(
        SplitFolds(split.text, split.leaky, len(made), audit_leakage(windows, windows, made, shared_rows))
        for split, made in folds.items()
    )


def gaps(rows: Sequence[ProgramScores]) -> tuple[ProgramGap, ...]:
    """Return how much higher each program scores under each leaky split than under each split by person."""
    return tuple(
        ProgramGap(
            *(honest.name, honest.title, honest.features, honest.pca, honest.split, leaky.split),
            {m: leaky.metrics[m]["mean"] - honest.metrics[m]["mean"] for m in column_metrics()},
        )
        for honest in rows
        for leaky in rows
        if honest.apart and leaky.leaky and honest.program == leaky.program
    )


def _parsed(splits: Sequence[str]) -> list[Split]:
    if not splits:
        raise ConfigError("No split is given: name one or more, such as  --split leave-one-subject-out,windows:5")
    found = [parse_split(text) for text in splits]
    for i, split in enumerate(found):
        if split in found[:i]:
            raise ConfigError(f"The split {split.text} is given twice: name each once.")
    return found


def _work(windows: WindowSet, task: _Task, report: Report, /) -> Result:
    """Fit, time and score one program in one fold."""
    fit, fold = task.contender.fit, task.fold
    train, test = windows.take(fold.train), windows.take(fold.test)
    with _one_thread():
        began = _clock()
        reader = fit(train, windows.take(fold.validation))
        train_s = _clock() - began
        single = _latency(reader, test)
        began = _clock()
        probabilities = np.asarray(reader(test), dtype=np.float32)
        batch_s = _clock() - began
    wanted = (len(test), len(windows.labels))
    if probabilities.shape != wanted:
        raise ConfigError(
            f"{task.contender.words} gave probabilities of the shape {probabilities.shape}; {wanted} (windows, "
            "classes) is expected."
        )
    return {
        "probabilities": probabilities,
        "size_bytes": int(reader.size_bytes),
        "train_s": train_s,
        "predict_ms": 1000.0 * single,
        "predict_batch_ms": 1000.0 * batch_s / len(test),
    }


def _latency(reader: Reader, test: WindowSet) -> float:
    """Return the median time in seconds of a prediction for a single window."""
    ones = [test.take(np.array([i % len(test)])) for i in range(_WARM + _TIMED)]
    times = []
    for one in ones:
        began = _clock()
        reader(one)
        times.append(_clock() - began)
    return float(np.median(times[_WARM:]))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit the numeric libraries to one thread, for comparable times and sums in a fixed order."""
    with need("threadpoolctl", extra="baselines").threadpool_limits(limits=1):
        yield


def _row(windows: WindowSet, done: Sequence[tuple[StudyPart, Result]]) -> ProgramScores:
    """Return the scores of one program under one split; ``done`` are its folds with their results."""
    tasks, outcomes = [part.task for part, _ in done], [outcome for _, outcome in done]
    contender, split, folds = tasks[0].contender, tasks[0].split, [task.fold for task in tasks]
    records = [
        FoldRecord(f.name, f.subjects, (len(f.train), len(f.validation), len(f.test)), 0, float(o["train_s"]))
        for f, o in zip(folds, outcomes, strict=True)
    ]
    predictions = gather_predictions(windows, [(f.name, f.test) for f in folds], [o["probabilities"] for o in outcomes])
    scores = compute_scores(predictions, records, windows.affects, split.separates_people)

    def middle(name: str) -> float:
        return float(np.median([o[name] for o in outcomes]))

    return ProgramScores(
        contender.name,
        contender.title,
        contender.features,
        contender.pca,
        (contender.samples or windows.integers.shape[2]) / windows.rate_hz,
        split.text,
        split.leaky,
        split.separates_people,
        scores.over,
        len(folds),
        {name: scores.means[name].to_json() for name in column_metrics()},
        scores.pooled,
        scores.by_recording.to_json(),
        round(middle("size_bytes")),
        middle("predict_ms"),
        middle("predict_batch_ms"),
        middle("train_s"),
        float(sum(o["train_s"] for o in outcomes)),
    )
