"""Scores from truth and prediction: confusion, accuracy, macro recall, macro-F1, votes, spread over people.

Everything but the vote is counted from a confusion matrix (K, K): rows are the truth, columns what was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput

Counts = NDArray[np.int64]

RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_260


def confusion(truth: NDArray[np.int64], predicted: NDArray[np.int64], classes: int) -> Counts:
    """Counts (classes, classes) of each truth (n,) read as each class; BadInput for an index out of range."""
    for name, index in (("truth", truth), ("prediction", predicted)):
        if len(index) and (int(index.min()) < 0 or int(index.max()) >= classes):
            raise BadInput(f"A class index of the {name} is out of range: accepted are 0 to {classes - 1}.")
    flat = np.bincount(truth * classes + predicted, minlength=classes * classes)
    return flat.reshape(classes, classes).astype(np.int64)


def accuracy(counts: Counts) -> float:
    """Share of units read right; NaN without any."""
    total = int(counts.sum())
    return float(np.trace(counts) / total) if total else float("nan")


@dataclass(frozen=True)
class ClassScores:
    """Precision, recall and F1 of each class, (K,) each; 0 where nothing was read or nothing was there."""

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    f1: NDArray[np.float64]
    support: Counts


def class_scores(counts: Counts) -> ClassScores:
    """Precision, recall and F1 by class."""
    right = np.diag(counts).astype(np.float64)
    support, read = counts.sum(axis=1), counts.sum(axis=0)
    return ClassScores(
        precision=_ratio(right, read),
        recall=_ratio(right, support),
        f1=_ratio(2 * right, support + read),
        support=support,
    )


def macro_recall(counts: Counts) -> float:
    """Mean recall of the classes that are present in the truth; NaN without any."""
    return _mean(class_scores(counts).recall[counts.sum(axis=1) > 0])


def macro_f1(counts: Counts, all_classes: bool = False) -> float:
    """Mean F1 of the classes that are present in the truth; NaN without any.

    Args:
        all_classes: average every class, as the paper does over its 18; one that is absent counts as 0.
    """
    scores = class_scores(counts)
    if not all_classes:
        return _mean(scores.f1[scores.support > 0])
    return _mean(scores.f1) if counts.sum() else float("nan")


def grouped(counts: Counts, groups: Sequence[str]) -> tuple[tuple[str, ...], Counts]:
    """The confusion of groups of classes (affects, families): their names as they appear, and counts (G, G).

    Args:
        groups: the group of each class, (K,).
    """
    names = tuple(dict.fromkeys(groups))
    member = np.array([[group == name for name in names] for group in groups], dtype=np.int64)
    return names, member.T @ counts @ member


def vote(
    probabilities: NDArray[np.floating[Any]], recording: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """What each recording is read as: the class of the highest mean probability over its windows.

    Args:
        probabilities: (N, K); recording: (N,) any integer for each recording.

    Returns:
        the recordings in ascending order (R,), and the class of each (R,).
    """
    ids, place = np.unique(recording, return_inverse=True)
    total = np.zeros((len(ids), probabilities.shape[1]), dtype=np.float64)
    np.add.at(total, place, probabilities)
    windows = np.bincount(place, minlength=len(ids))[:, None]
    return ids, np.argmax(total / np.maximum(windows, 1), axis=1).astype(np.int64)


def summary(values: Sequence[float] | NDArray[np.float64]) -> dict[str, Any]:
    """``{mean, sd, ci95}`` of one value a person (or a fold).

    ``sd`` divides by n − 1. ``ci95`` is the percentile bootstrap of the mean: 10 000 resamples with a fixed seed.
    Values that are not numbers are left out; what cannot be said of the rest is None.
    """
    table = np.asarray(values, dtype=np.float64)
    table = table[np.isfinite(table)]
    if not len(table):
        return {"mean": None, "sd": None, "ci95": None}
    if len(table) == 1:
        return {"mean": float(table[0]), "sd": None, "ci95": None}
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    means = table[rng.integers(0, len(table), size=(RESAMPLES, len(table)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return {"mean": float(table.mean()), "sd": float(table.std(ddof=1)), "ci95": [float(low), float(high)]}


def _ratio(part: NDArray[np.float64], whole: Counts) -> NDArray[np.float64]:
    return np.divide(part, whole, out=np.zeros(len(part), dtype=np.float64), where=whole > 0)


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
