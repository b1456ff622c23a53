"""Find copies of stretches of recordings inside other recordings, by a rolling hash of their rows.

Stretches of half a second are compared, whatever their place, clock and label. Equal ones are copies if they are too
improbable to be chance. Each row counts as the information, in bits, of its values, of their change, or of the change
of that, whichever is least by its frequency in all recordings together. A sensor at rest, the steps of a coarse one, a
ramp and a switch that is pressed have little.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.dataset.store import Dataset, RecordingInfo

STRETCH_S = 0.5
_LEAST_ROWS = 10
# Bits beyond those with which some two of all stretches are equal by chance: 1 in a million.
_SURE_BITS = 20
# A row is common if it occurs so often; copies seldom have so many copies.
_COMMON = 32
_BASE = np.uint64(0x9E3779B97F4A7C15)
_INVERSE = np.uint64(pow(int(_BASE), -1, 1 << 64))

Hashes = NDArray[np.uint64]


@dataclass(frozen=True)
class HashedRows:
    """The rows of a recording: ``hashes`` (3, T) of the values, of their change, and of the change of that."""

    info: RecordingInfo
    hashes: Hashes

    @classmethod
    def of(cls, info: RecordingInfo, values: NDArray[np.int64]) -> HashedRows:
        """Hash the rows of values (T, C)."""
        orders = [values]
        for _ in range(2):
            orders.append(np.diff(orders[-1], axis=0, prepend=orders[-1][:1]))
        return cls(info, np.stack([_hash_rows(order) for order in orders]))


@dataclass(frozen=True)
class CopiedStretch:
    """A stretch of ``rows`` rows from ``second_row`` of ``second`` on, which ``first`` has from ``first_row`` on."""

    first: RecordingInfo
    second: RecordingInfo
    first_row: int
    second_row: int
    rows: int


def _hash_rows(values: NDArray[np.int64]) -> Hashes:
    hashes = np.zeros(len(values), dtype=np.uint64)
    for column in values.T:
        hashes = (hashes ^ column.astype(np.uint64)) * _BASE
        hashes ^= hashes >> np.uint64(29)
    return hashes


def find_copied_stretches(recordings: Sequence[HashedRows], rate_hz: float) -> Iterator[CopiedStretch]:
    """Yield the stretches that two recordings share, those of each pair and shift as one; the first is the earlier id.

    Rows that are the same rows of one stream are no copies.
    """
    rows = max(_LEAST_ROWS, round(STRETCH_S * rate_hz))
    recordings = sorted(recordings, key=lambda r: r.info.id)
    if sum(r.hashes.shape[1] for r in recordings) < 2 * rows:
        return
    hashes = np.concatenate([r.hashes for r in recordings], axis=1)
    lengths = [r.hashes.shape[1] for r in recordings]
    owner, row = np.repeat(np.arange(len(recordings)), lengths), np.concatenate([np.arange(n) for n in lengths])
    begins = np.flatnonzero(owner[: 1 - rows] == owner[rows - 1 :])
    bits = np.concatenate([[0.0], _information(hashes).cumsum()])
    begins = begins[bits[begins + rows] - bits[begins] > 2 * np.log2(len(owner)) + _SURE_BITS]
    keys = _rolling(hashes[0], rows)[begins]
    order = np.argsort(keys, kind="stable")
    begins, keys = begins[order], keys[order]
    opens = np.concatenate([[True], keys[1:] != keys[:-1]])
    firsts = begins[np.maximum.accumulate(np.where(opens, np.arange(len(keys)), 0))]
    pair = (owner[firsts] != owner[begins]) & ~_same_place(recordings, owner, row, firsts, begins)
    found = np.stack([owner[firsts], owner[begins], row[begins] - row[firsts], row[begins]], axis=1)[pair]
    found = found[np.lexsort(found.T[::-1])]
    edges = np.flatnonzero((found[1:, :3] != found[:-1, :3]).any(axis=1)) + 1
    for stretch in np.split(found, edges) if len(found) else ():
        first, second, shift, begin = stretch[0].tolist()
        # Hits that overlap are one stretch, of the rows from the first of one to the last of the other.
        shared = rows + int(np.minimum(np.diff(stretch[:, 3]), rows).sum())
        yield CopiedStretch(recordings[first].info, recordings[second].info, begin - shift, begin, shared)


def _information(hashes: Hashes) -> NDArray[np.float64]:
    """Return the bits of information (T,) of each row: the least of its hashes (3, T), by their frequency.

    After a row that is common, it is their frequency after such rows: at rest, rest follows.
    """
    least = np.full(hashes.shape[1], np.inf)
    for order in hashes:
        _, number, counts = np.unique(order, return_inverse=True, return_counts=True)
        before = np.roll(number, 1)
        _, pair, pairs = np.unique(before * len(counts) + number, return_inverse=True, return_counts=True)
        after = np.where(counts[before] >= _COMMON, counts[before] / pairs[pair], np.inf)
        least = np.minimum(least, np.log2(np.minimum(len(number) / counts[number], after)))
    return least


def _rolling(hashes: Hashes, rows: int) -> Hashes:
    """Return a hash of the ``rows`` rows from each row on."""
    powers = np.full(len(hashes), _BASE)
    inverses = np.full(len(hashes), _INVERSE)
    powers[0] = inverses[0] = 1
    powers, inverses = np.cumprod(powers), np.cumprod(inverses)
    sums = np.concatenate([np.zeros(1, np.uint64), np.cumsum(hashes * powers)])
    keys: Hashes = (sums[rows:] - sums[:-rows]) * inverses[: len(hashes) - rows + 1]
    return keys


def _same_place(
    recordings: Sequence[HashedRows],
    owner: NDArray[np.int64],
    row: NDArray[np.int64],
    one: NDArray[np.int64],
    other: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Return which pairs of rows are the same row of a stream."""
    infos = [r.info for r in recordings]
    numbers = {stream: n for n, stream in enumerate({i.stream for i in infos})}
    stream = np.array([numbers[i.stream] if i.stream and i.stream_row >= 0 else -1 - n for n, i in enumerate(infos)])
    place = np.array([i.stream_row + i.start for i in infos])[owner] + row
    same: NDArray[np.bool_] = (stream[owner[one]] == stream[owner[other]]) & (place[one] == place[other])
    return same


def copied_recordings(dataset: Dataset, ids: Iterable[str]) -> set[tuple[str, str]]:
    """Return the pairs, in both orders, of recordings of ``ids`` that share a stretch, maybe one of a third."""
    chosen = set(ids)
    hashed = [HashedRows.of(r, dataset.read(r).values) for r in dataset.used if r.id in chosen]
    alike: dict[str, set[str]] = {}
    for stretch in find_copied_stretches(hashed, dataset.layout.rate_hz):
        alike.setdefault(stretch.first.id, {stretch.first.id}).add(stretch.second.id)
    return {pair for group in alike.values() for pair in itertools.permutations(sorted(group), 2)}
