"""Folds of windows: which windows each fold of a split trains on, validates on and tests.

Windows to train on and to score may be cut from the same recordings with different contexts; the split is made over
recordings and so is the same for both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError
from plushsense.scoring.splits import Fold, Index, Split, make_folds, purge
from plushsense.windows.cut import WindowSet


@dataclass(frozen=True)
class WindowFold:
    """A fold of windows: ``train`` and ``validation`` index the windows to train on, ``test`` those to score."""

    name: str
    subjects: tuple[str, ...]
    train: Index
    validation: Index
    test: Index


def fold_windows(train: WindowSet, score: WindowSet, split: Split, seed: int = 0) -> list[WindowFold]:
    """Return the folds of ``split`` as windows.

    No window that touches a tested recording in its stream is trained or validated on.

    Raises:
        BadInput: when the two sets do not belong together, or the split cannot be made of them.
    """
    if train.labels != score.labels or train.inputs != score.inputs:
        raise BadInput("The windows to train on and those to score differ in gestures or channels: cut both alike.")
    if split.leaky:
        if train is not score and not _same(train, score):
            raise ConfigError(
                f"The split {split.text} divides windows, so it scores the very windows it drew from: "
                "cut both with the same context, or use by-recording:5."
            )
        folds = make_folds(split, score.subject, score.y, seed)
        return [WindowFold(f.name, f.subjects, f.train, f.validation, f.test) for f in folds]
    recordings = _Recordings.of(train, score)
    of_train, of_score = recordings.place(train), recordings.place(score)
    found = []
    for fold in make_folds(split, recordings.subject, recordings.y, seed):
        keep = purge(train.stream, train.window_rows, *recordings.rows(fold.test))
        found.append(
            WindowFold(
                fold.name,
                fold.subjects,
                np.flatnonzero(np.isin(of_train, fold.train) & keep),
                np.flatnonzero(np.isin(of_train, fold.validation) & keep),
                np.flatnonzero(np.isin(of_score, fold.test)),
            )
        )
        _whole(found[-1], fold, split)
    return found


@dataclass(frozen=True)
class _Recordings:
    """The recordings (R,) of both sets; rows in a stream as ids and (R, 2), −1 where there is none."""

    ids: NDArray[np.str_]
    subject: NDArray[np.str_]
    y: Index
    stream: NDArray[np.str_]
    stream_rows: Index

    @classmethod
    def of(cls, *sets: WindowSet) -> _Recordings:
        ids = np.concatenate([_ids(s) for s in sets])
        subject, stream = (np.concatenate([getattr(s, name) for s in sets]) for name in ("subject", "stream"))
        y = np.concatenate([s.y for s in sets])
        rows = np.concatenate([s.recording_rows for s in sets])
        # Of all windows of a recording, take one whose place in a stream is known.
        order = np.lexsort((rows[:, 0] < 0, ids))
        unique, first = np.unique(ids[order], return_index=True)
        pick = order[first]
        return cls(unique, subject[pick], y[pick], stream[pick], rows[pick])

    def place(self, windows: WindowSet) -> Index:
        """Return the recording of each window as an index into these, (N,)."""
        return np.searchsorted(self.ids, _ids(windows)).astype(np.int64)

    def rows(self, index: Index) -> tuple[NDArray[np.str_], Index]:
        """Return stream and rows of some recordings, as `purge` takes them."""
        return self.stream[index], self.stream_rows[index]


def _ids(windows: WindowSet) -> NDArray[np.str_]:
    return np.array(windows.recording_ids, dtype=np.str_)[windows.recording]


def _same(one: WindowSet, other: WindowSet) -> bool:
    return one.x.shape == other.x.shape and bool(
        np.array_equal(one.x, other.x) and np.array_equal(_ids(one), _ids(other))
    )


def _whole(fold: WindowFold, units: Fold, split: Split) -> None:
    for name in ("train", "test"):
        if not len(getattr(fold, name)):
            reason = (
                ": every window that could train touches a tested recording in its stream"
                if len(getattr(units, name))
                else ""
            )
            raise BadInput(f"Split {split.text} leaves {fold.name} no windows to {name} with{reason}: use fewer folds.")
