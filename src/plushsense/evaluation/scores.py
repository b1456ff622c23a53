"""Predictions of an evaluation, their files, and the scores computed from them.

With a split by people, means are over people, and recordings of nobody (subject "none": the toy at rest) are reported
separately; otherwise means are over folds. Pooled scores, classes and confusions count every window, as in the paper.
Every figure of a result is one of these two, and is called *mean* or *pooled*.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, need
from plushsense.core.files import replacing_file
from plushsense.core.gestures import NOBODY
from plushsense.scoring import metrics
from plushsense.scoring.metrics import ClassResult, Counts, Summary
from plushsense.scoring.splits import Index
from plushsense.training.spec import EpochRow
from plushsense.windows.cut import WindowSet

_P = "p_"


@dataclass(frozen=True)
class Predictions:
    """The predictions of an evaluation: one row for each scored window, fold after fold.

    ``recording`` is the recording's id, ``window`` the window's number within it (from 0), ``context`` the kind of data
    before it, ``truth`` and ``predicted`` class indices into ``labels``, ``probabilities`` (N, K) float32.
    """

    labels: tuple[str, ...]
    subject: NDArray[np.str_]
    recording: NDArray[np.str_]
    window: NDArray[np.int64]
    context: NDArray[np.str_]
    fold: NDArray[np.str_]
    truth: NDArray[np.int64]
    probabilities: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def predicted(self) -> NDArray[np.int64]:
        """The class with the highest probability, (N,)."""
        best: NDArray[np.int64] = np.argmax(self.probabilities, axis=1).astype(np.int64)
        return best

    def of_recordings(self, recordings: NDArray[np.str_]) -> Predictions:
        """Return the predictions for some recordings, given by their ids."""
        kept = np.isin(self.recording, recordings)
        return replace(self, **{name: value[kept] for name, value in vars(self).items() if name != "labels"})


def gather_predictions(
    windows: WindowSet, folds: Sequence[tuple[str, Index]], probabilities: Sequence[NDArray[np.float32]]
) -> Predictions:
    """Collect the predictions of all ``folds``, given as (name, index of test windows), and their probabilities."""
    order = np.concatenate([test for _, test in folds])
    ids = np.array(windows.recording_ids, dtype=np.str_)
    # The windows of a recording are in order of time.
    by_recording = np.argsort(windows.recording, kind="stable")
    sorted_recording = windows.recording[by_recording]
    number = np.empty(len(windows), dtype=np.int64)
    number[by_recording] = np.arange(len(windows)) - np.searchsorted(sorted_recording, sorted_recording)
    return Predictions(
        labels=windows.labels,
        subject=windows.subject[order],
        recording=ids[windows.recording[order]],
        window=number[order],
        context=windows.context[order],
        fold=np.repeat([name for name, _ in folds], [len(test) for _, test in folds]),
        truth=windows.y[order],
        probabilities=np.concatenate(probabilities),
    )


def write_predictions(path: str | Path, predictions: Predictions) -> Path:
    """Write predictions to a Parquet file, with a column ``p_<label>`` for each class.

    Truth and prediction are written as labels. The file is replaced atomically.

    Raises:
        MissingExtraError: without polars (extra ``train``).
    """
    polars = need("polars", extra="train")
    path = Path(path)
    label = np.array(predictions.labels, dtype=np.str_)
    columns: dict[str, NDArray[Any]] = {
        "subject": predictions.subject,
        "recording": predictions.recording,
        "window": predictions.window,
        "context": predictions.context,
        "fold": predictions.fold,
        "truth": label[predictions.truth],
        "predicted": label[predictions.predicted],
    }
    for k, name in enumerate(predictions.labels):
        columns[_P + name] = np.ascontiguousarray(predictions.probabilities[:, k])
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing_file(path) as part:
        polars.DataFrame(columns).write_parquet(part)
    return path


def read_predictions(path: str | Path) -> Predictions:
    """Read a file that `write_predictions` wrote.

    Raises:
        MissingExtraError: without polars (extra ``train``); BadInput: for a missing file, or one of another kind.
    """
    polars = need("polars", extra="train")
    path = Path(path)
    if not path.is_file():
        raise BadInput(f"There are no predictions at '{path}': they were moved or deleted; evaluate again.")
    try:
        table = polars.read_parquet(path)
        labels = tuple(name.removeprefix(_P) for name in table.columns if name.startswith(_P))
        of = {name: k for k, name in enumerate(labels)}
        text = {
            name: np.array(table[name].to_list(), dtype=np.str_) for name in ("subject", "recording", "context", "fold")
        }
        return Predictions(
            labels,
            window=table["window"].to_numpy().astype(np.int64),
            truth=np.array([of[label] for label in table["truth"].to_list()], dtype=np.int64),
            probabilities=table.select([_P + name for name in labels]).to_numpy().astype(np.float32),
            **text,
        )
    except (OSError, KeyError, polars.exceptions.PolarsError) as cause:
        raise BadInput(f"'{path}' holds no predictions of an evaluation ({cause}): evaluate again.") from None


def with_accuracy(history: Iterable[EpochRow], apart: bool) -> list[EpochRow]:
    """Return the epochs of a training with ``accuracy``, that of validation as `compute_scores` counts it."""
    return [
        {**row, "accuracy": row.get("validation_accuracy_people") if apart else row.get("validation_accuracy")}
        for row in history
    ]


def votes_by_person(predictions: Predictions) -> dict[str, VoteResult]:
    """Return for each person the scores of the vote over each recording's windows."""
    scorer = _Scorer(predictions)
    people = sorted(set(predictions.subject.tolist()) - {NOBODY})
    return {person: scorer.by_recording(predictions.subject == person) for person in people}


Mask = NDArray[np.bool_]


Metrics = dict[str, float | None]
"""The scores of some windows by the keys of `METRICS`; None where one is not defined."""


@dataclass(frozen=True)
class FoldRecord:
    """A fold without its predictions; ``windows`` counts those for training, validation and test."""

    name: str
    subjects: tuple[str, ...]
    windows: tuple[int, int, int]
    epochs: int
    seconds: float


@dataclass(frozen=True)
class FoldResult:
    """The scores of a fold; with a split by people, without recordings of nobody."""

    record: FoldRecord
    metrics: Metrics
    by_recording_accuracy: float | None

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        fold = self.record
        train, validation, test = fold.windows
        return {
            "fold": fold.name,
            "subject": fold.subjects[0] if len(fold.subjects) == 1 else None,
            "subjects": list(fold.subjects),
            "train_windows": train,
            "validation_windows": validation,
            "test_windows": test,
            **self.metrics,
            "by_recording_accuracy": self.by_recording_accuracy,
            "epochs": fold.epochs,
            "seconds": fold.seconds,
        }


@dataclass(frozen=True)
class PersonResult:
    """The scores of a person; ``metrics`` are those of `column_metrics`."""

    subject: str
    windows: int
    recordings: int
    metrics: Metrics
    by_recording_accuracy: float | None

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "subject": self.subject,
            "windows": self.windows,
            "recordings": self.recordings,
            **self.metrics,
            "by_recording_accuracy": self.by_recording_accuracy,
        }


@dataclass(frozen=True)
class VoteResult:
    """The scores of the vote over each recording's windows."""

    metrics: Metrics
    recordings: int

    def to_json(self) -> dict[str, float | int | None]:
        """Return plain values, ready for JSON."""
        return {**self.metrics, "recordings": self.recordings}


class PartResult(NamedTuple):
    """The accuracy on a part of the windows."""

    windows: int
    recordings: int
    accuracy: float | None


class ConfusionMatrix(NamedTuple):
    """A confusion matrix (K, K) with the names of its classes."""

    labels: tuple[str, ...]
    counts: Counts

    def to_json(self) -> dict[str, list[Any]]:
        """Return plain values, ready for JSON."""
        return {"labels": list(self.labels), "counts": self.counts.tolist()}


@dataclass(frozen=True)
class Scores:
    """All scores of predictions.

    Attributes:
        means: the summary of each metric over the people, or with other splits over the folds.
        macro_f1_all_classes: over the folds and all classes, including recordings of nobody, as in the paper.
        with_rest: with a split by people and recordings of nobody, the metrics over folds with them, as in the paper.
        over: what the means are over: "subjects" or "folds".
        by_recording: scores of the votes of all counted recordings.
        pooled: scores of all windows.
        per_class, affects: the scores of each class, and its affect.
        confusion, confusion_affect: of all windows, by class and by affect.
        by_context: the accuracy by the kind of data before the windows.
        nobody: the accuracy on recordings of nobody; None without them.
    """

    means: dict[str, Summary]
    macro_f1_all_classes: Summary
    with_rest: dict[str, Summary] | None
    over: str
    by_recording: VoteResult
    pooled: Metrics
    per_class: tuple[ClassResult, ...]
    affects: tuple[str, ...]
    confusion: ConfusionMatrix
    confusion_affect: ConfusionMatrix
    by_context: dict[str, PartResult]
    nobody: PartResult | None
    folds: tuple[FoldResult, ...]
    subjects: tuple[PersonResult, ...]

    def mean(self, metric: str) -> float | None:
        """Return the mean of a metric over people or folds."""
        return self.means[metric].mean

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        rest = self.with_rest
        return {
            **{name: found.to_json() for name, found in self.means.items()},
            "macro_f1_all_classes": self.macro_f1_all_classes.to_json(),
            "with_rest": None if rest is None else {name: found.to_json() for name, found in rest.items()},
            "over": self.over,
            "by_recording": self.by_recording.to_json(),
            "pooled": self.pooled,
            "per_class": [
                {"label": row.label, "affect": affect, **row._asdict()}
                for row, affect in zip(self.per_class, self.affects, strict=True)
            ],
            "confusion": self.confusion.to_json(),
            "confusion_affect": self.confusion_affect.to_json(),
            "by_context": {kind: part._asdict() for kind, part in self.by_context.items()},
            "nobody": None if self.nobody is None else self.nobody._asdict(),
            "folds": [fold.to_json() for fold in self.folds],
            "subjects": [person.to_json() for person in self.subjects],
        }


def compute_scores(
    predictions: Predictions, folds: Sequence[FoldRecord], affects: tuple[str, ...], apart: bool
) -> Scores:
    """Compute all scores.

    Args:
        affects: the affect of each class.
        apart: whether no person is in both training and test.
    """
    scorer = _Scorer(predictions)
    people = predictions.subject != NOBODY
    counted = people if apart else np.ones(len(people), dtype=np.bool_)
    people_codes = sorted(set(predictions.subject[people].tolist()))
    of_fold = [predictions.fold == fold.name for fold in folds]
    of_person = [predictions.subject == person for person in people_codes]
    parts = [scorer.figures(m) for m in (of_person if apart else [m & counted for m in of_fold])]
    # The paper averages over its folds and all 18 classes, including recordings of nobody (the toy at rest).
    whole = [scorer.counts(m) for m in of_fold]
    all_classes = metrics.summary([metrics.macro_f1(c, all_classes=True) for c in whole])
    everything = scorer.counts(np.ones(len(people), dtype=np.bool_))
    with_rest = None
    if apart and not people.all():
        with_rest = {
            "accuracy": metrics.summary([metrics.METRICS["accuracy"].function(c) for c in whole]),
            "macro_recall": metrics.summary([metrics.macro_recall(c, all_classes=True) for c in whole]),
            "macro_f1": all_classes,
        }
    return Scores(
        means={name: metrics.summary([f[name] for f in parts]) for name in metrics.METRICS},
        macro_f1_all_classes=all_classes,
        with_rest=with_rest,
        over="subjects" if apart else "folds",
        by_recording=scorer.by_recording(counted),
        pooled=_plain(metrics.scores_of(everything)),
        per_class=tuple(metrics.class_results(everything, predictions.labels)),
        affects=affects,
        confusion=ConfusionMatrix(predictions.labels, everything),
        confusion_affect=ConfusionMatrix(*metrics.grouped(everything, affects)),
        by_context=scorer.by_context(counted),
        nobody=None if people.all() else scorer.part(~people),
        folds=tuple(scorer.fold(fold, mask & counted) for fold, mask in zip(folds, of_fold, strict=True)),
        subjects=tuple(scorer.person(name, mask) for name, mask in zip(people_codes, of_person, strict=True)),
    )


class _Scorer:
    """Computes scores of subsets of the predictions, given as masks (N,)."""

    def __init__(self, predictions: Predictions) -> None:
        self._all = predictions
        self._classes = len(predictions.labels)
        self._predicted = predictions.predicted
        _, self._recording = np.unique(predictions.recording, return_inverse=True)

    def counts(self, mask: Mask) -> Counts:
        return metrics.confusion(self._all.truth[mask], self._predicted[mask], self._classes)

    def figures(self, mask: Mask) -> dict[str, float]:
        return metrics.scores_of(self.counts(mask))

    def part(self, mask: Mask) -> PartResult:
        accuracy = _plain(self.figures(mask))["accuracy"]
        return PartResult(int(mask.sum()), len(np.unique(self._recording[mask])), accuracy)

    def by_recording(self, mask: Mask) -> VoteResult:
        recording = self._recording[mask]
        ids, predicted = metrics.vote(self._all.probabilities[mask], recording)
        _, first = np.unique(recording, return_index=True)
        figures = metrics.scores_of(metrics.confusion(self._all.truth[mask][first], predicted, self._classes))
        return VoteResult(_plain(figures), len(ids))

    def by_context(self, mask: Mask) -> dict[str, PartResult]:
        kinds = ("stream", "inside", "rest", "loop", "rows")
        masks = {kind: mask & (self._all.context == kind) for kind in kinds}
        return {kind: self.part(selected) for kind, selected in masks.items() if selected.any()}

    def fold(self, record: FoldRecord, mask: Mask) -> FoldResult:
        return FoldResult(record, _plain(self.figures(mask)), self.by_recording(mask).metrics["accuracy"])

    def person(self, name: str, mask: Mask) -> PersonResult:
        part, figures = self.part(mask), _plain(self.figures(mask))
        shown = {key: figures[key] for key in metrics.column_metrics()}
        return PersonResult(name, part.windows, part.recordings, shown, self.by_recording(mask).metrics["accuracy"])


def _plain(figures: dict[str, float]) -> Metrics:
    """Replace NaN, which JSON cannot represent, by None."""
    return {name: float(value) if np.isfinite(value) else None for name, value in figures.items()}
