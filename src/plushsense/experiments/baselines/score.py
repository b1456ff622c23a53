"""Compare several programs on the same windows under several splits: their scores, sizes and times.

Each combination of program, split and fold is one job of the journal. A program is a picklable callable, as in
``crossval``, so that this module needs neither scikit-learn nor PyTorch. Sizes and times of all programs are measured
here in the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, need
from plushsense.core.gestures import NOBODY
from plushsense.evaluation.crossval import context_of, fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.evaluation.scores import FoldRecord, compute_scores, gather_predictions
from plushsense.jobs.journal import Journal, Result, job_id
from plushsense.jobs.pool import Job, Report, run_jobs
from plushsense.jobs.progress import JobInfo, JobProgress, JobsReporter
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


@dataclass(frozen=True)
class _Task:
    contender: Contender
    fold: Fold


def compare(
    windows: WindowSet,
    contenders: Sequence[Contender],
    splits: Sequence[str],
    *,
    journal: Journal | None = None,
    workers: int = 1,
    cluster: str | None = None,
    seed: int = 0,
    progress: Callable[[JobProgress], None] | None = None,
) -> dict[str, Any]:
    """Fit and score every contender in every fold of every split, all on the same windows.

    Programs are fitted to the training windows of a fold; its validation windows are for early stopping only.

    Returns:
        ``context``, ``splits``, ``windows``, ``recordings``, ``subjects``, ``labels``, ``seed``, ``jobs``,
        ``resumed``; ``models``, one row for each contender and split; ``gaps`` (see `gaps`).

    Raises:
        ConfigError: for a contender or split that is given twice, an unknown split, or none of either.
        BadInput: for a split that the windows do not allow.
        MissingExtraError: without threadpoolctl, which comes with scikit-learn.
    """
    need("threadpoolctl", extra="baselines")
    if not contenders:
        raise ConfigError("No program is left to compare: give one or more, such as  --models forest,knn")
    parsed = _parsed(splits)
    folds = {split.text: fold_windows(windows, windows, split, seed) for split in parsed}
    base = {"version": _VERSION, "windows": windows_fingerprint(windows), "rate_hz": windows.rate_hz}
    names = [(c.name, c.features, c.pca) for c in contenders]
    if len(set(names)) < len(names):
        raise ConfigError("A program is given twice: name each once.")
    prints = {text: [fold_fingerprint(fold) for fold in made] for text, made in folds.items()}
    jobs: dict[tuple[int, str], list[Job]] = {}
    for i, contender in enumerate(contenders):
        key = {**base, "model": names[i], "key": dict(contender.key)}
        for text, made in folds.items():
            jobs[i, text] = [
                Job(job_id({**key, "fold": mark}), _Task(contender, fold))
                for fold, mark in zip(made, prints[text], strict=True)
            ]
    everything = [job for some in jobs.values() for job in some]
    infos = {job.id: JobInfo(f"{job.task.contender.words}, {job.task.fold.name}", 1.0) for job in everything}
    reporter = JobsReporter(infos, progress=progress)
    results = run_jobs(
        everything, _work, shared=windows, workers=workers, journal=journal, cluster=cluster, on_done=reporter.on_done
    )
    rows = [
        _row(contenders[i], split, folds[split.text], [results[job.id] for job in jobs[i, split.text]], windows)
        for i in range(len(contenders))
        for split in parsed
    ]
    return {
        "context": context_of(windows),
        "splits": [{"split": split.text, "leaky": split.leaky, "folds": len(folds[split.text])} for split in parsed],
        "windows": len(windows),
        "recordings": len(np.unique(windows.recording)),
        "subjects": len(set(windows.subject.tolist()) - {NOBODY}),
        "labels": list(windows.labels),
        "seed": seed,
        "jobs": len(everything),
        "resumed": len(reporter.state.resumed),
        "models": rows,
        "gaps": gaps(rows),
    }


def gaps(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return how much higher each program scores under each leaky split than under each split by person."""
    found = []
    for honest in (row for row in rows if row["apart"]):
        for leaky in (row for row in rows if row["leaky"]):
            if any(honest[name] != leaky[name] for name in ("name", "features", "pca")):
                continue
            found.append(
                {
                    **{name: honest[name] for name in ("name", "title", "features", "pca")},
                    "split": honest["split"],
                    "leaky_split": leaky["split"],
                    **{m: leaky[m]["mean"] - honest[m]["mean"] for m in column_metrics()},
                }
            )
    return found


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


def _row(
    contender: Contender, split: Split, folds: list[Fold], outcomes: list[Result], windows: WindowSet
) -> dict[str, Any]:
    records = [
        FoldRecord(f.name, f.subjects, (len(f.train), len(f.validation), len(f.test)), 0, float(o["train_s"]))
        for f, o in zip(folds, outcomes, strict=True)
    ]
    predictions = gather_predictions(windows, [(f.name, f.test) for f in folds], [o["probabilities"] for o in outcomes])
    table = compute_scores(predictions, records, windows.affects, split.separates_people)

    def middle(name: str) -> float:
        return float(np.median([o[name] for o in outcomes]))

    return {
        "name": contender.name,
        "title": contender.title,
        "features": contender.features,
        "pca": contender.pca,
        "span_s": (contender.samples or windows.integers.shape[2]) / windows.rate_hz,
        "split": split.text,
        "leaky": split.leaky,
        "apart": split.separates_people,
        "over": table["over"],
        "folds": len(folds),
        **{name: table[name] for name in (*column_metrics(), "pooled")},
        "by_recording": table["by_recording"],
        "size_bytes": round(middle("size_bytes")),
        "predict_ms": middle("predict_ms"),
        "predict_batch_ms": middle("predict_batch_ms"),
        "train_s": middle("train_s"),
        "train_s_in_all": float(sum(o["train_s"] for o in outcomes)),
    }
