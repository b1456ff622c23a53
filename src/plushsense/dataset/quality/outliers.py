"""Find failed readings: a few values far beyond all others, such as the largest number that a converter can send.

The distance of every reading from the median of its file and channel is counted by its number of bits, so that one pass
over the files is enough and a channel of any unit and range is judged alike. Readings failed if no distance lies within
`OCTAVES` below theirs, and they are few: a movement seldom jumps over three decades without a value between. Numbers
that are the limit of a 16-, 24- or 32-bit integer need only `LIMIT_OCTAVES`. A hit can do both, but not in any gesture.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recorder_csv import Frames
from plushsense.core.sentences import join_names
from plushsense.dataset.store import Dataset

OCTAVES = 10  # a factor of over 1000
LIMIT_OCTAVES = 3
SHARE = 0.01
# A channel that never leaves its median by 8 steps has no usual distance: its first touch would be far from all others.
_LEAST_BITS = 4
# A failed reading is followed by a good one; what lasts longer may be a touch or a disconnected sensor.
_LONGEST = 3
# A hit is a matter of the gesture: the gestures with most of the readings must be this share of the recordings.
_MOST, _SPREAD = 0.9, 0.5
_BITS = 64
_LIMITS = [limit for bits in (16, 24, 32) for half in (1 << (bits - 1),) for limit in (-half, 1 - half, half - 1)]
_LIMITS += [(1 << bits) - 1 for bits in (16, 24, 32)]


def _bits(values: NDArray[np.integer], middle: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the number of bits of the distance of values (..., C) from their ``middle`` (C,)."""
    bits: NDArray[np.int64] = np.frexp(np.floor(np.abs(values - np.floor(middle))))[1].astype(np.int64)
    return bits


def _usual_bits(counts: NDArray[np.int64], octaves: int) -> int:
    """Return the number of bits of the largest distance that is not far from the others; 0 if none is far.

    ``counts`` are the readings of a channel by the number of bits of their distance.
    """
    beyond = counts[::-1].cumsum()[::-1]
    for low, high in itertools.pairwise(np.flatnonzero(counts).tolist()):
        if low >= _LEAST_BITS and high - low > octaves and beyond[high] <= SHARE * counts.sum():
            return int(low)
    return 0


@dataclass(frozen=True)
class FailedReadings:
    """The failed readings of a channel, in the values of the files.

    ``low`` and ``high`` are the least and the largest of the other readings; ``longest`` is the number of rows of the
    longest run of failed ones. ``gestures`` are those with most of the failed readings, if they are few.
    """

    channel: str
    n: int
    of: int
    people: tuple[str, ...]
    low: float
    high: float
    longest: int
    gestures: tuple[str, ...]

    @property
    def doubt(self) -> str:
        """Why the readings may be real; "" if each is single, or nearly, and comes in any gesture."""
        if self.longest > _LONGEST:
            return f"in up to {self.longest} rows in succession"
        return f"most of them in {join_names(self.gestures)}, so they may be hits" if self.gestures else ""


def find_failed_readings(dataset: Dataset) -> list[FailedReadings]:
    """Return the failed readings of each channel but switches and counters; those outside its valid range are known."""
    layout = dataset.layout
    counts = np.zeros((layout.n_channels, _BITS), dtype=np.int64)
    for _, frames, _ in _files(dataset):
        valid, bits = _measured(frames, dataset)
        for c, at in enumerate(valid.T):
            counts[c] += np.bincount(bits[at, c], minlength=_BITS)
    usual = {c: _usual_bits(counts[c], LIMIT_OCTAVES) for c, ch in enumerate(layout.channels) if not ch.is_discrete}
    described = [
        _failed_of(dataset, c, limit, _usual_bits(counts[c], OCTAVES) == limit) for c, limit in usual.items() if limit
    ]
    return [failed for failed in described if failed is not None]


def _files(dataset: Dataset) -> Iterator[tuple[str, Frames, list[tuple[int, int, str]]]]:
    """Yield the person, the frames, and the first row, the end and the gesture of each recording in them.

    These are of every stream, and of every used recording that is in no stream.
    """
    for stream in dataset.streams:
        spans = [
            (r.stream_row + r.start, r.stream_row + r.stop, r.gesture) for r in dataset.used if r.stream == stream.id
        ]
        yield stream.subject, dataset.read_stream(stream.id), spans
    for recording in dataset.used:
        if recording.stream_row < 0 and not dataset.layout.is_labelled:
            frames = dataset.read(recording)
            yield recording.subject, frames, [(0, len(frames), recording.gesture)]


def _few_gestures(dataset: Dataset, found: Counter[str]) -> tuple[str, ...]:
    """Return the gestures with most of the readings ``found``; none if these come in any gesture, or at idle."""
    total = Counter(r.gesture for r in dataset.used)
    most: list[str] = []
    for gesture, _ in found.most_common():
        most.append(gesture)
        if sum(found[g] for g in most) >= _MOST * found.total():
            break
    spread = "" in most or sum(total[g] for g in most) >= _SPREAD * total.total()
    return () if spread else tuple(most)


def _measured(frames: Frames, dataset: Dataset) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which values (T, C) are in their valid range, and the bits (T, C) of their distance from the median."""
    values, layout = frames.values, dataset.layout
    if not len(values):
        return np.zeros(values.shape, dtype=np.bool_), np.zeros(values.shape, dtype=np.int64)
    valid: NDArray[np.bool_] = np.logical_and(values >= layout.valid_min_int, values <= layout.valid_max_int)
    return valid, _bits(values, np.median(values, axis=0))


def _failed_of(dataset: Dataset, c: int, usual_bits: int, very_far: bool) -> FailedReadings | None:
    """Describe the readings of channel ``c`` beyond ``usual_bits``; None if they may be real after all.

    That is so unless they are ``very_far`` or all are limits of integers.
    """
    step = dataset.layout.channels[c].step
    people: dict[str, None] = {}
    failed, others, longest, rows, gestures = list[int](), list[int](), 0, 0, Counter[str]()
    for subject, frames, spans in _files(dataset):
        valid, bits = _measured(frames, dataset)
        values, far = frames.values[:, c], valid[:, c] & (bits[:, c] > usual_bits)
        if (usual := values[valid[:, c] & ~far]).size:
            others += [int(usual.min()), int(usual.max())]
        rows += int(valid[:, c].sum())
        if far.any():
            people[subject] = None
            failed += values[far].tolist()
            for row in np.flatnonzero(far).tolist():
                gestures[next((name for begin, end, name in spans if begin <= row < end), "")] += 1
            edges = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]])))
            longest = max(longest, int((edges[1::2] - edges[::2]).max()))
    if not very_far and not {round(value * step) for value in failed} <= {*_LIMITS}:
        return None
    low, high = (float(f"{edge * step:.12g}") for edge in (min(others), max(others)))
    # Always the same number, beyond the 16 bits of a converter at its end stop, is an error code and no hit.
    code = very_far and len(failed) > 2 and len(set(failed)) == 1 and abs(failed[0]) > 0xFFFF
    few = () if code else _few_gestures(dataset, gestures)
    return FailedReadings(dataset.layout.names[c], len(failed), rows, tuple(people), low, high, longest, few)


def far_inputs(x: NDArray[np.integer]) -> dict[int, NDArray[np.bool_]]:
    """Return the samples (N, T) of some inputs of windows (N, F, T) that alone set the scale of their input.

    They are far from all others (`LIMIT_OCTAVES`), few, and make more than half of the input's variance.
    """
    found = {}
    for c in range(x.shape[1] if x.size else 0):
        values = x[:, c, :]
        middle = np.asarray(np.median(values))
        distance = np.abs(values - middle)
        # A gap leaves at most that share of the samples above the octave of the largest one and those below.
        if (distance > distance.max() / 2**LIMIT_OCTAVES).mean() > SHARE:
            continue
        bits = _bits(values, middle)
        if usual := _usual_bits(np.bincount(bits.ravel(), minlength=_BITS), LIMIT_OCTAVES):
            far = bits > usual
            squares = np.square(distance)
            if squares[far].sum() > squares[~far].sum():
                found[c] = far
    return found
