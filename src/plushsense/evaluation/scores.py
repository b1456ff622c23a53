"""Predictions of an evaluation, their files, and the scores computed from them.

With a split by people, means are over people, and recordings of nobody (subject "none": the toy at rest) are reported
separately; otherwise means are over folds. Pooled scores, classes and confusions count every window, as in the paper.
Every figure of a result is one of these two, and is called *mean* or *pooled*.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, need
from plushsense.core.files import replacing_file
from plushsense.core.gestures import NOBODY
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts
from plushsense.scoring.splits import Index
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


def with_accuracy(history: Iterable[Mapping[str, Any]], apart: bool) -> list[dict[str, Any]]:
    """Return the epochs of a training with ``accuracy``, that of validation as `compute_scores` counts it."""
    key = "validation_accuracy_people" if apart else "validation_accuracy"
    return [{**row, "accuracy": row.get(key)} for row in history]


def votes_by_person(predictions: Predictions) -> dict[str, dict[str, Any]]:
    """Return for each person the scores of the vote over each recording's windows, and the number of recordings."""
    scorer = _Scorer(predictions)
    people = sorted(set(predictions.subject.tolist()) - {NOBODY})
    return {person: scorer.by_recording(predictions.subject == person) for person in people}


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FoldRecord:
    """A fold without its predictions; ``windows`` counts those for training, validation and test."""

    name: str
    subjects: tuple[str, ...]
    windows: tuple[int, int, int]
    epochs: int
    seconds: float


def compute_scores(
    predictions: Predictions, folds: list[FoldRecord], affects: tuple[str, ...], apart: bool
) -> dict[str, Any]:
    """Compute all scores as plain values; those that cannot be computed are None.

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
    affect_names, by_affect = metrics.grouped(everything, affects)
    return {
        **{name: metrics.summary([f[name] for f in parts]) for name in metrics.METRICS},
        "macro_f1_all_classes": all_classes,
        "with_rest": None
        if people.all() or not apart
        else {
            "accuracy": metrics.summary([metrics.METRICS["accuracy"].function(c) for c in whole]),
            "macro_recall": metrics.summary([metrics.macro_recall(c, all_classes=True) for c in whole]),
            "macro_f1": all_classes,
        },
        "over": "subjects" if apart else "folds",
        "by_recording": scorer.by_recording(counted),
        "pooled": _plain(metrics.scores_of(everything)),
        "per_class": [
            {"label": row["label"], "affect": affect, **row}
            for row, affect in zip(metrics.class_rows(everything, predictions.labels), affects, strict=True)
        ],
        "confusion": {"labels": list(predictions.labels), "counts": everything.tolist()},
        "confusion_affect": {"labels": list(affect_names), "counts": by_affect.tolist()},
        "by_context": scorer.by_context(counted),
        "nobody": None if people.all() else scorer.size(~people) | {"accuracy": scorer.figures(~people)["accuracy"]},
        "folds": [_fold(fold, scorer, mask & counted) for fold, mask in zip(folds, of_fold, strict=True)],
        "subjects": [_person(name, scorer, m) for name, m in zip(people_codes, of_person, strict=True)],
    }


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

    def size(self, mask: Mask) -> dict[str, int]:
        return {"windows": int(mask.sum()), "recordings": len(np.unique(self._recording[mask]))}

    def by_recording(self, mask: Mask) -> dict[str, Any]:
        """Return the scores of the vote over each recording's windows."""
        recording = self._recording[mask]
        ids, predicted = metrics.vote(self._all.probabilities[mask], recording)
        _, first = np.unique(recording, return_index=True)
        figures = metrics.scores_of(metrics.confusion(self._all.truth[mask][first], predicted, self._classes))
        return _plain(figures) | {"recordings": len(ids)}

    def by_context(self, mask: Mask) -> dict[str, Any]:
        table = {}
        for kind in ("stream", "inside", "loop", "rows"):
            selected = mask & (self._all.context == kind)
            if selected.any():
                table[kind] = self.size(selected) | _plain({"accuracy": self.figures(selected)["accuracy"]})
        return table


def _plain(figures: dict[str, float]) -> dict[str, float | None]:
    """Replace NaN, which JSON cannot represent, by None."""
    return {name: float(value) if np.isfinite(value) else None for name, value in figures.items()}


def _fold(fold: FoldRecord, scorer: _Scorer, mask: Mask) -> dict[str, Any]:
    return {
        "fold": fold.name,
        "subject": fold.subjects[0] if len(fold.subjects) == 1 else None,
        "subjects": list(fold.subjects),
        "train_windows": fold.windows[0],
        "validation_windows": fold.windows[1],
        "test_windows": fold.windows[2],
        **_plain(scorer.figures(mask)),
        "by_recording_accuracy": scorer.by_recording(mask)["accuracy"],
        "epochs": fold.epochs,
        "seconds": fold.seconds,
    }


def _person(name: str, scorer: _Scorer, mask: Mask) -> dict[str, Any]:
    figures = _plain(scorer.figures(mask))
    return {
        "subject": name,
        **scorer.size(mask),
        **{key: figures[key] for key in metrics.column_metrics()},
        "by_recording_accuracy": scorer.by_recording(mask)["accuracy"],
    }
