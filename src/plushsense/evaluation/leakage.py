"""Audit folds for leakage: count the scored windows that a model has, in some form, been trained on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Message
from plushsense.dataset.quality.outliers import far_inputs
from plushsense.scoring.splits import Fold, Index
from plushsense.windows.cut import WindowSet

# A window is nearly a copy of another if, shifted by at most 0.5 s, it differs by less than 10 % of its own variation.
NEAR = 0.1
SHIFT_S = 0.5
# Candidates are the training windows with the most similar sorted values.
_CANDIDATES = 3
_QUANTILES = 16
# Two windows are compared sample by sample if their sorted values differ by less than this share of the variation:
# without a shift, they differ no more than the windows do.
_SIMILAR = 0.3
# Windows in which fewer samples differ from the one before are not judged: two people press a switch alike.
_CHANGING = 0.25
_LISTED = 10
_BLOCK = 64

KINDS = ("same_recording", "overlapping", "same_person", "copies", "near_duplicates", "shared_rows")

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CopiedRecording:
    """A scored recording with ``windows`` that are copies or near-duplicates of a trained one, or of its rows."""

    scored: str
    trained: str
    windows: int


@dataclass(frozen=True)
class LeakageResult:
    """The number of scored windows, and of those of each of `KINDS` that a model has been trained on.

    Attributes:
        same_recording, same_person: whose recording, or person, was also trained on.
        overlapping: that have samples in common with a training window.
        copies, near_duplicates: that are equal, or nearly, to a training window of another recording.
        shared_rows: of a recording that has rows of one trained on.
        pairs: the recordings with most copies, near-duplicates or shared rows.
    """

    windows: int
    same_recording: int
    overlapping: int
    same_person: int
    copies: int
    near_duplicates: int
    shared_rows: int
    pairs: tuple[CopiedRecording, ...]

    def share(self, kind: str) -> float:
        """Return the share of the scored windows that one of `KINDS` has."""
        return int(getattr(self, kind)) / max(self.windows, 1)

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {**vars(self), "pairs": [vars(pair) for pair in self.pairs]}

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> LeakageResult:
        """Return the result that `to_json` has written; a KeyError or TypeError for another table."""
        return cls(**{**table, "pairs": tuple(CopiedRecording(**pair) for pair in table["pairs"])})


def audit_leakage(
    train: WindowSet, score: WindowSet, folds: Sequence[Fold], shared_rows: Collection[tuple[str, str]] = ()
) -> LeakageResult:
    """Count the scored windows of all folds that have something in common with the windows trained on in their fold.

    Validation windows count as trained on. Nobody (recordings at rest) is no person. Windows that rarely change are
    neither copies nor near-duplicates: a toy at rest is equal to itself, and so are presses of a switch. Windows that
    share rows of a stream are not, either: they are counted as overlapping. Failed readings, which would make windows
    alike that share nothing else, are left out of the comparison.

    Args:
        train, score: the windows that the indices of ``folds`` refer to.
        shared_rows: pairs of recordings, in both orders, of which one has rows of the other
            (`plushsense.dataset.quality.copies`).
    """
    partners: dict[str, list[str]] = {}
    for one, twin in sorted(shared_rows):
        partners.setdefault(one, []).append(twin)
    compared = _without_far(train)
    signatures = _Signatures.of(compared, compared if score is train else _without_far(score))
    totals, pairs = dict.fromkeys(("windows", *KINDS), 0), Counter[tuple[str, str]]()
    for fold in folds:
        known = np.union1d(fold.train, fold.validation)
        test = fold.test
        people = np.setdiff1d(train.subject[known], [NOBODY])
        copies, near, twins = signatures.duplicates(known, test)
        mine, trained = _ids(score, test), set(_ids(train, known).tolist())
        copied = {r: twin for r in set(mine.tolist()) for twin in partners.get(r, ()) if twin in trained and r != twin}
        found = {
            "same_recording": np.isin(mine, list(trained)),
            "overlapping": _overlapping(train, known, score, test),
            "same_person": np.isin(score.subject[test], people),
            "copies": copies,
            "near_duplicates": near,
            "shared_rows": np.isin(mine, list(copied)),
        }
        totals["windows"] += len(test)
        for kind, mask in found.items():
            totals[kind] += int(mask.sum())
        for one, twin in zip(mine[near], _ids(train, twins[near]), strict=True):
            pairs[str(one), str(twin)] += 1
        for one in mine[found["shared_rows"] & ~near].tolist():
            pairs[one, copied[one]] += 1
    listed = tuple(CopiedRecording(a, b, n) for (a, b), n in pairs.most_common(_LISTED))
    return LeakageResult(**totals, pairs=listed)


def _without_far(windows: WindowSet) -> WindowSet:
    """Return windows in which the samples that alone set the scale of their input are the input's median."""
    found = far_inputs(windows.integers)
    if not found:
        return windows
    x = windows.integers.copy()
    for at, far in found.items():
        x[:, at][far] = np.median(x[:, at])
    return replace(windows, integers=x)


def warn_of_copies(audit: LeakageResult, warn: Callable[[str], None]) -> None:
    """Warn of scored windows with copies of what another recording trained on, naming two recordings."""
    if audit.pairs:
        first, n = audit.pairs[0], audit.near_duplicates
        what = "are copies, or nearly, of training windows of another recording"
        if audit.shared_rows > n:
            n, what = audit.shared_rows, "are of recordings that have rows of one trained on"
        warn(
            Message(
                "{n} of {windows} scored windows {what} (as {first} of {second}), so the scores are too high: "
                "exclude one of the two recordings",
                n=n,
                windows=audit.windows,
                what=what,
                first=first.scored,
                second=first.trained,
            )
        )


def _ids(windows: WindowSet, index: Index) -> NDArray[np.str_]:
    return np.array(windows.recording_ids, dtype=np.str_)[windows.recording[index]]


def _overlapping(train: WindowSet, known: Index, score: WindowSet, test: Index) -> Mask:
    """Return which scored windows (n,) share rows of a stream with a training window."""
    shared = np.zeros(len(test), dtype=np.bool_)
    rows, trained = score.window_rows[test], train.window_rows[known]
    for stream in np.setdiff1d(score.stream[test], [""]):
        mine = np.flatnonzero((score.stream[test] == stream) & (rows[:, 0] >= 0))
        theirs = trained[(train.stream[known] == stream) & (trained[:, 0] >= 0)]
        theirs = theirs[np.argsort(theirs[:, 0])]
        if not len(theirs) or not len(mine):
            continue
        # Of the training windows that begin before the end of a scored one, does any end after its beginning?
        before = np.searchsorted(theirs[:, 0], rows[mine, 1])
        latest = np.concatenate([[-1], np.maximum.accumulate(theirs[:, 1])])[before]
        shared[mine] = latest > rows[mine, 0]
    return shared


def _sharing_rows(score: WindowSet, mine: Index, train: WindowSet, theirs: Index) -> Mask:
    """Return which pairs (n,) of a scored and a training window share rows of a stream."""
    a, b = score.window_rows[mine], train.window_rows[theirs]
    located = (
        (score.stream[mine] == train.stream[theirs]) & (score.stream[mine] != "") & (a[:, 0] >= 0) & (b[:, 0] >= 0)
    )
    shared: Mask = located & (a[:, 0] < b[:, 1]) & (b[:, 0] < a[:, 1])
    return shared


class _Signatures:
    """Sorted values of windows, in which a window and its slightly shifted copy differ little."""

    def __init__(self, train: WindowSet, score: WindowSet, scale: NDArray[np.float32]) -> None:
        self._train, self._score, self._scale = train, score, scale
        self._shift = min(round(SHIFT_S * score.rate_hz), score.integers.shape[2] // 4)
        self._of_train = _sorted_values(train, scale)
        self._of_score = self._of_train if score is train else _sorted_values(score, scale)
        self._changes = np.array([(x[:, 1:] != x[:, :-1]).any(axis=0).mean() for x in score.integers])

    @classmethod
    def of(cls, train: WindowSet, score: WindowSet) -> _Signatures:
        spread = (
            train.integers.astype(np.float32).std(axis=(0, 2)) if len(train) else np.ones(len(train.inputs), np.float32)
        )
        return cls(train, score, (1 / np.where(spread > 0, spread, 1)).astype(np.float32))

    def duplicates(self, known: Index, test: Index) -> tuple[Mask, Mask, Index]:
        """Return which scored windows are copies, which are nearly, (n,) each, and the training window (n,) of each."""
        copies, near = np.zeros(len(test), dtype=np.bool_), np.zeros(len(test), dtype=np.bool_)
        twins = np.full(len(test), -1, dtype=np.int64)
        for at, candidates in self._candidates(known, test):
            for index in candidates.T:
                mine, theirs = test[at], known[index]
                other = _ids(self._score, mine) != _ids(self._train, theirs)
                other &= ~_sharing_rows(self._score, mine, self._train, theirs)
                pick = np.flatnonzero(other & ~near[at] & self._similar(mine, theirs))
                x, y = self._scaled(self._score, mine[pick]), self._scaled(self._train, theirs[pick])
                same = (x == y).all(axis=(1, 2))
                close = same | (_difference(x, y, self._shift) < NEAR)
                copies[at[pick]] = same
                near[at[pick[close]]] = True
                twins[at[pick[close]]] = theirs[pick[close]]
        return copies, near, twins

    def _similar(self, test: Index, known: Index) -> Mask:
        """Return for which pairs (n,) of windows that change the sorted values differ by less than `_SIMILAR`."""
        x, y = self._of_score[test], self._of_train[known]
        variation = x.reshape(len(x), -1, _QUANTILES).var(axis=2).sum(axis=1)
        error = np.square(x - y).reshape(len(x), -1, _QUANTILES).mean(axis=2).sum(axis=1)
        similar: Mask = (self._changes[test] >= _CHANGING) & (error < _SIMILAR**2 * variation)
        return similar

    def _scaled(self, windows: WindowSet, index: Index) -> NDArray[np.float32]:
        return windows.integers[index] * self._scale[:, None]

    def _candidates(self, known: Index, test: Index) -> Iterator[tuple[Index, Index]]:
        """Yield blocks of positions in ``test`` (b,) with the most similar positions in ``known`` (b, k)."""
        mine, theirs = self._of_score[test], self._of_train[known]
        squares = np.square(theirs).sum(axis=1)
        for start in range(0, len(test) if len(known) else 0, _BLOCK):
            at = np.arange(start, min(start + _BLOCK, len(test)))
            distance = squares - 2 * (mine[at] @ theirs.T)
            nearest = np.argpartition(distance, min(_CANDIDATES, len(known)) - 1, axis=1)
            yield at, nearest[:, :_CANDIDATES]


def _sorted_values(windows: WindowSet, scale: NDArray[np.float32]) -> NDArray[np.float32]:
    n, inputs, samples = windows.integers.shape
    places = np.linspace(0, samples - 1, _QUANTILES).round().astype(np.int64)
    out = np.empty((n, inputs * _QUANTILES), dtype=np.float32)
    for start in range(0, n, _BLOCK):
        ordered = np.sort(windows.integers[start : start + _BLOCK], axis=2)[:, :, places] * scale[:, None]
        out[start : start + _BLOCK] = ordered.reshape(len(ordered), -1)
    return out


def _difference(x: NDArray[np.float32], y: NDArray[np.float32], shift: int) -> NDArray[np.float64]:
    """Return the RMS difference (n,) of windows (n, F, T) at the best shift, as a share of the variation of ``x``.

    With both around the mean of ``x``, whose squares then lose no digits, it follows from the sums of squares of the
    samples that overlap and the cross-correlation.
    """
    samples = x.shape[2]
    middle = x.mean(axis=2, keepdims=True, dtype=np.float64)
    a, b = x - middle, y - middle
    size = 1 << (samples + shift - 1).bit_length()
    spectrum = (np.fft.rfft(a, size) * np.fft.rfft(b, size).conj()).sum(axis=1)
    lags = np.arange(-shift, shift + 1)
    products = np.fft.irfft(spectrum, size)[:, lags]
    first, last = np.maximum(lags, 0), samples + np.minimum(lags, 0)
    n = last - first

    def between(values: NDArray[np.float64], first: Index, last: Index) -> NDArray[np.float64]:
        sums = np.pad(values.cumsum(axis=-1), [(0, 0)] * (values.ndim - 1) + [(1, 0)])
        return np.asarray(sums[..., last] - sums[..., first])

    squares = between(np.square(a).sum(axis=1), first, last)
    variation = (squares - np.square(between(a, first, last)).sum(axis=1) / n) / n
    error = (squares + between(np.square(b).sum(axis=1), first - lags, last - lags) - 2 * products) / n
    best: NDArray[np.float64] = np.sqrt(np.maximum(error, 0) / np.maximum(variation, 1e-12)).min(axis=1)
    return best
