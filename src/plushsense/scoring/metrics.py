"""Scores of predictions: confusion matrix, accuracy, macro-F1, votes, Pareto front.

Confusion matrices (K, K) have the true class in rows and the predicted class in columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.gestures import NOBODY

Counts = NDArray[np.int64]

RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_260
_BINS = 15  # of confidence


def confusion(truth: NDArray[np.int64], predicted: NDArray[np.int64], classes: int) -> Counts:
    """Return the confusion matrix (classes, classes) of true and predicted class indices, both (n,).

    Raises:
        BadInput: if a class index is out of range.
    """
    for name, index in (("truth", truth), ("prediction", predicted)):
        if len(index) and (int(index.min()) < 0 or int(index.max()) >= classes):
            raise BadInput(f"A class index of the {name} is out of range: accepted are 0 to {classes - 1}.")
    flat = np.bincount(truth * classes + predicted, minlength=classes * classes)
    return flat.reshape(classes, classes).astype(np.int64)


def accuracy(counts: Counts) -> float:
    """Return the share of correct predictions; NaN if there are no predictions."""
    total = int(counts.sum())
    return float(np.trace(counts) / total) if total else float("nan")


def accuracy_over_people(
    truth: NDArray[np.int64], predicted: NDArray[np.int64], subject: NDArray[np.str_]
) -> float | None:
    """Return the mean over people of the share of their windows (n,) that are predicted correctly; None without people.

    Recordings of `NOBODY` (the toy at rest) do not count: they are easy, and would raise the score of every network.
    """
    right = truth == predicted
    shares = [float(right[subject == person].mean()) for person in sorted(set(subject.tolist()) - {NOBODY})]
    return float(np.mean(shares)) if shares else None


@dataclass(frozen=True)
class ClassScores:
    """Precision, recall, F1 and number of items (``support``) of each class, (K,) each; undefined scores are 0."""

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    f1: NDArray[np.float64]
    support: Counts


def class_scores(counts: Counts) -> ClassScores:
    """Compute the scores of each class from a confusion matrix."""
    right = np.diag(counts).astype(np.float64)
    support, read = counts.sum(axis=1), counts.sum(axis=0)
    return ClassScores(
        precision=_ratio(right, read),
        recall=_ratio(right, support),
        f1=_ratio(2 * right, support + read),
        support=support,
    )


class ClassResult(NamedTuple):
    """The scores of one class, and its number of items."""

    label: str
    precision: float
    recall: float
    f1: float
    support: int


def class_results(counts: Counts, labels: Sequence[str]) -> list[ClassResult]:
    """Return label and scores of each class of a confusion matrix."""
    scores = class_scores(counts)
    columns = (scores.precision.tolist(), scores.recall.tolist(), scores.f1.tolist(), scores.support.tolist())
    return [ClassResult(*row) for row in zip(labels, *columns, strict=True)]


def macro_recall(counts: Counts, all_classes: bool = False) -> float:
    """Return the mean recall of the classes that occur in the truth; NaN if there are none.

    Args:
        all_classes: as for `macro_f1`.
    """
    recall = class_scores(counts).recall
    if not all_classes:
        return _mean(recall[counts.sum(axis=1) > 0])
    return _mean(recall) if counts.sum() else float("nan")


def macro_f1(counts: Counts, all_classes: bool = False) -> float:
    """Return the mean F1 of the classes that occur in the truth; NaN if there are none.

    Args:
        all_classes: average over all classes, like the paper over its 18; a class that never occurs counts as 0.
    """
    scores = class_scores(counts)
    if not all_classes:
        return _mean(scores.f1[scores.support > 0])
    return _mean(scores.f1) if counts.sum() else float("nan")


class Metric(NamedTuple):
    """A score computed from a confusion matrix (K, K), with its name and format in tables.

    ``percent``: whether sweep tables print it in percent. ``column``: whether narrow tables (of people, of trials) have
    it as a column; otherwise only the full table of an evaluation has it.
    """

    function: Callable[[Counts], float]
    name: str
    note: str = ""
    percent: bool = False
    column: bool = True

    @property
    def title(self) -> str:
        """Name as a column heading."""
        return self.name[0].upper() + self.name[1:]


# To add a metric, add a line here: evaluations, reports, sweep tables and the command line use this table.
METRICS: dict[str, Metric] = {
    "accuracy": Metric(accuracy, "accuracy", percent=True),
    "macro_recall": Metric(macro_recall, "macro recall", column=False),
    "macro_f1": Metric(macro_f1, "macro-F1", note="gestures present"),
}


def column_metrics() -> dict[str, Metric]:
    """Return the metrics that are columns of narrow tables, by key."""
    return {key: metric for key, metric in METRICS.items() if metric.column}


def scores_of(counts: Counts) -> dict[str, float]:
    """Compute all metrics of a confusion matrix, by key; undefined ones are NaN."""
    return {key: metric.function(counts) for key, metric in METRICS.items()}


def grouped(counts: Counts, groups: Sequence[str]) -> tuple[tuple[str, ...], Counts]:
    """Sum a confusion matrix over groups of classes, such as affects or families.

    Returns:
        the names of the groups in order of appearance, and their confusion matrix (G, G).

    Args:
        groups: the group of each class, (K,).
    """
    names = tuple(dict.fromkeys(groups))
    member = np.array([[group == name for name in names] for group in groups], dtype=np.int64)
    return names, member.T @ counts @ member


def vote(
    probabilities: NDArray[np.floating[Any]], recording: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose the class of each recording by the highest mean probability over its windows.

    Args:
        probabilities: (N, K) class probabilities of each window.
        recording: (N,) number of the recording of each window.

    Returns:
        the numbers of the recordings in ascending order (R,), and the class of each (R,).
    """
    ids, place = np.unique(recording, return_inverse=True)
    total = np.zeros((len(ids), probabilities.shape[1]), dtype=np.float64)
    np.add.at(total, place, probabilities)
    windows = np.bincount(place, minlength=len(ids))[:, None]
    return ids, np.argmax(total / np.maximum(windows, 1), axis=1).astype(np.int64)


def calibration_error(probabilities: NDArray[np.floating[Any]], truth: NDArray[np.int64]) -> float:
    """Return the expected calibration error (ECE) of predictions (N, K); NaN without any.

    It is the difference between highest probability and accuracy, averaged over 15 bins of equal width by their numbers
    of predictions (Guo et al. 2017).
    """
    if not len(truth):
        return float("nan")
    return float(np.abs(_bin_gaps(probabilities, truth)).sum() / len(truth))


def calibration_interval(
    probabilities: NDArray[np.floating[Any]], truth: NDArray[np.int64], person: NDArray[np.str_]
) -> tuple[float, float] | None:
    """Return the 95 % interval of the calibration error over people; None for fewer than two.

    It is a percentile bootstrap of whole people. Few people raise the error of a resample, since their chance
    deviations do not cancel; so the interval errs on the high side.
    """
    people = [person == who for who in np.unique(person)]
    if len(people) < 2:
        return None
    gaps = np.stack([_bin_gaps(probabilities[own], truth[own]) for own in people])
    sizes = np.array([own.sum() for own in people])
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    drawn = rng.multinomial(len(people), np.full(len(people), 1 / len(people)), size=RESAMPLES)
    low, high = np.percentile(np.abs(drawn @ gaps).sum(axis=1) / (drawn @ sizes), [2.5, 97.5])
    return float(low), float(high)


def _bin_gaps(probabilities: NDArray[np.floating[Any]], truth: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sum of confidence minus correctness in each bin of confidence, (_BINS,)."""
    confidence = probabilities.max(axis=1).astype(np.float64)
    right = probabilities.argmax(axis=1) == truth
    place = np.minimum((confidence * _BINS).astype(np.int64), _BINS - 1)
    gaps = np.bincount(place, weights=confidence - right, minlength=_BINS)
    return np.asarray(gaps, dtype=np.float64)


class Summary(NamedTuple):
    """Mean, standard deviation (n − 1) and 95 % interval of the mean of some values; None if not computable."""

    mean: float | None
    sd: float | None
    ci95: tuple[float, float] | None

    def to_json(self) -> dict[str, float | list[float] | None]:
        """Return plain values, ready for JSON."""
        return {"mean": self.mean, "sd": self.sd, "ci95": None if self.ci95 is None else list(self.ci95)}


def summary(values: Sequence[float] | NDArray[np.float64]) -> Summary:
    """Return the summary of values, one for each person (or fold); those that are not finite are left out.

    The interval is a percentile bootstrap of the mean with 10 000 resamples and a fixed seed.
    """
    table = np.asarray(values, dtype=np.float64)
    table = table[np.isfinite(table)]
    if not len(table):
        return Summary(None, None, None)
    if len(table) == 1:
        return Summary(float(table[0]), None, None)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    means = table[rng.integers(0, len(table), size=(RESAMPLES, len(table)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Summary(float(table.mean()), float(table.std(ddof=1)), (float(low), float(high)))


def _ratio(part: NDArray[np.float64], whole: Counts) -> NDArray[np.float64]:
    return np.divide(part, whole, out=np.zeros(len(part), dtype=np.float64), where=whole > 0)


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def pareto_front(rows: Sequence[tuple[float, ...]]) -> list[bool]:
    """Return whether each row (score, cost, cost, …) is on the Pareto front: high score, low costs.

    A row is on it if no other row is at least as good in every value and better in one; so equal rows are both on it.
    """

    def beats(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
        pairs = [(a[0], b[0]), *((-x, -y) for x, y in zip(a[1:], b[1:], strict=True))]
        return all(x >= y for x, y in pairs) and any(x > y for x, y in pairs)

    return [not any(beats(other, row) for other in rows) for row in rows]


def accuracy_complexity_ratio(accuracy: float | None, parameters: int) -> float | None:
    """Return ACR = accuracy / log10(parameters) (paper, 3.6.3); None without accuracy or below 2 parameters."""
    return None if accuracy is None or parameters <= 1 else accuracy / math.log10(parameters)
