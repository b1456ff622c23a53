"""The figures of an evaluation, all from its predictions.

Where people are kept apart, one value a person is averaged, and the toy at rest with nobody (subject "none") is
reported apart; elsewhere one value a fold, over all it tested. The pooled figures, the classes and the confusions
count every scored window, nobody's included, as the paper does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY
from plushsense.evaluation.predictions import Predictions
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FoldRecord:
    """What is known of a fold besides its predictions; ``windows`` are (trained on, validated on, tested)."""

    name: str
    subjects: tuple[str, ...]
    windows: tuple[int, int, int]
    epochs: int
    seconds: float


def scores(predictions: Predictions, folds: list[FoldRecord], affects: tuple[str, ...], apart: bool) -> dict[str, Any]:
    """All figures, as plain values; what cannot be computed is None.

    Args:
        affects: the affect of each class; apart: whether people are kept apart.
    """
    board = _Board(predictions)
    people = predictions.subject != NOBODY
    counted = people if apart else np.ones(len(people), dtype=np.bool_)
    named = sorted(set(predictions.subject[people].tolist()))
    of_fold = [predictions.fold == fold.name for fold in folds]
    of_person = [predictions.subject == person for person in named]
    single = [board.figures(m) for m in (of_person if apart else [m & counted for m in of_fold])]
    # The paper's average runs over all 18 classes, so the toy at rest with nobody counts in its fold.
    all_classes = [metrics.macro_f1(board.counts(m), all_classes=True) for m in of_fold]
    everything = board.counts(np.ones(len(people), dtype=np.bool_))
    return {
        **{name: metrics.summary([f[name] for f in single]) for name in ("accuracy", "macro_f1", "macro_recall")},
        "macro_f1_all_classes": metrics.summary(all_classes),
        "over": "subjects" if apart else "folds",
        "by_recording": board.by_recording(counted),
        "pooled": _plain(_of_counts(everything)),
        "per_class": _per_class(everything, predictions.labels, affects),
        "confusion": {"labels": list(predictions.labels), "counts": everything.tolist()},
        "confusion_affect": _grouped(everything, affects),
        "by_context": board.by_context(counted),
        "nobody": None if people.all() else board.size(~people) | {"accuracy": board.figures(~people)["accuracy"]},
        "folds": [_fold(fold, board, mask & counted) for fold, mask in zip(folds, of_fold, strict=True)],
        "subjects": [_person(name, board, m) for name, m in zip(named, of_person, strict=True)],
    }


class _Board:
    """Figures of any part of the predictions."""

    def __init__(self, predictions: Predictions) -> None:
        self._all = predictions
        self._classes = len(predictions.labels)
        self._read = predictions.predicted
        _, self._recording = np.unique(predictions.recording, return_inverse=True)

    def counts(self, mask: Mask) -> Counts:
        return metrics.confusion(self._all.truth[mask], self._read[mask], self._classes)

    def figures(self, mask: Mask) -> dict[str, float]:
        return _of_counts(self.counts(mask))

    def size(self, mask: Mask) -> dict[str, int]:
        return {"windows": int(mask.sum()), "recordings": len(np.unique(self._recording[mask]))}

    def by_recording(self, mask: Mask) -> dict[str, Any]:
        """Accuracy and macro-F1 of the vote over each recording's windows."""
        recording = self._recording[mask]
        ids, read = metrics.vote(self._all.probabilities[mask], recording)
        _, first = np.unique(recording, return_index=True)
        found = _of_counts(metrics.confusion(self._all.truth[mask][first], read, self._classes))
        return _plain(found) | {"recordings": len(ids)}

    def by_context(self, mask: Mask) -> dict[str, Any]:
        table = {}
        for kind in ("stream", "inside", "loop"):
            mine = mask & (self._all.context == kind)
            if mine.any():
                table[kind] = self.size(mine) | _plain({"accuracy": self.figures(mine)["accuracy"]})
        return table


def _of_counts(counts: Counts) -> dict[str, float]:
    return {
        "accuracy": metrics.accuracy(counts),
        "macro_recall": metrics.macro_recall(counts),
        "macro_f1": metrics.macro_f1(counts),
    }


def _plain(figures: dict[str, float]) -> dict[str, float | None]:
    """Figures for JSON, which knows no NaN."""
    return {name: float(value) if np.isfinite(value) else None for name, value in figures.items()}


def _per_class(counts: Counts, labels: tuple[str, ...], affects: tuple[str, ...]) -> list[dict[str, Any]]:
    by_class = metrics.class_scores(counts)
    return [
        {
            "label": labels[k],
            "affect": affects[k],
            "precision": float(by_class.precision[k]),
            "recall": float(by_class.recall[k]),
            "f1": float(by_class.f1[k]),
            "support": int(by_class.support[k]),
        }
        for k in range(len(labels))
    ]


def _grouped(counts: Counts, groups: tuple[str, ...]) -> dict[str, Any]:
    names, table = metrics.grouped(counts, groups)
    return {"labels": list(names), "counts": table.tolist()}


def _fold(fold: FoldRecord, board: _Board, mask: Mask) -> dict[str, Any]:
    return {
        "fold": fold.name,
        "subject": fold.subjects[0] if len(fold.subjects) == 1 else None,
        "subjects": list(fold.subjects),
        "train_windows": fold.windows[0],
        "validation_windows": fold.windows[1],
        "test_windows": fold.windows[2],
        **_plain(board.figures(mask)),
        "by_recording_accuracy": board.by_recording(mask)["accuracy"],
        "epochs": fold.epochs,
        "seconds": fold.seconds,
    }


def _person(name: str, board: _Board, mask: Mask) -> dict[str, Any]:
    found = _plain(board.figures(mask))
    return {
        "subject": name,
        **board.size(mask),
        "accuracy": found["accuracy"],
        "macro_f1": found["macro_f1"],
        "by_recording_accuracy": board.by_recording(mask)["accuracy"],
    }
