"""Every single prediction of an evaluation, and the Parquet file that keeps them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.extras import need
from plushsense.scoring.splits import Index
from plushsense.windows.cut import WindowSet

_P = "p_"


@dataclass(frozen=True)
class Predictions:
    """One row a scored window, fold after fold; in a hold-out split only what was tested.

    ``recording`` is the recording's id, ``window`` the window's number within it (from 0), ``context`` what its past
    is, ``truth`` and ``predicted`` class indices into ``labels``, ``probabilities`` (N, K) float32.
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
        """The class of the highest probability, (N,)."""
        best: NDArray[np.int64] = np.argmax(self.probabilities, axis=1).astype(np.int64)
        return best


def gather(
    windows: WindowSet, folds: Sequence[tuple[str, Index]], probabilities: Sequence[NDArray[np.float32]]
) -> Predictions:
    """The predictions of all folds: (name, index of the windows it tested) and their probabilities, a fold each."""
    order = np.concatenate([test for _, test in folds])
    ids = np.array(windows.recording_ids, dtype=np.str_)
    # The windows of a recording stand in the order of time.
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
    """Write subject, recording, window, context, fold, truth, predicted and a ``p_<label>`` a class, as Parquet.

    Truth and prediction are written as labels. The file is replaced in one step.

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
    part = path.with_name(path.name + ".part")
    polars.DataFrame(columns).write_parquet(part)
    os.replace(part, path)
    return path


def read_predictions(path: str | Path) -> Predictions:
    """What `write_predictions` wrote.

    Raises:
        MissingExtraError: without polars (extra ``train``); BadInput: for a file that is missing, or of something else.
    """
    polars = need("polars", extra="train")
    path = Path(path)
    again = "evaluate again"
    if not path.is_file():
        raise BadInput(f"There are no predictions at '{path}': they were moved or deleted; {again}.")
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
        raise BadInput(f"'{path}' holds no predictions of an evaluation ({cause}): {again}.") from None
