"""How far the gate's signals stand out, for many people's samples at once: what its thresholds are chosen on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.models.gate import EXTRA_BITS, HELD, LEVEL, NOISE_CLIP, THRESHOLD_BITS, Signal

LEAD = 1200
"""Samples read before a piece, in which a baseline settles."""
PIECE = 4800


def raw_signal(x: NDArray[np.int64], signal: Signal) -> NDArray[np.int64]:
    """A signal of inputs (T, I) before its baseline: (T,)."""
    columns: NDArray[np.int64] = np.clip(x[:, list(signal.inputs)] >> signal.shift, -HELD, HELD)
    if signal.kind == LEVEL:
        return np.asarray(columns[:, 0])
    out = np.zeros(len(x), dtype=np.int64)
    out[signal.lag :] = np.abs(columns[signal.lag :] - columns[: -signal.lag]).sum(axis=1)
    return np.minimum(out, HELD)


def follow(xs: Sequence[NDArray[np.int64]], signals: Sequence[Signal]) -> list[NDArray[np.int32]]:
    """Sizes of the signals, with the deviation's sign: of each stretch (T, I) an array (T, S).

    As `plushsense.models.gate.Gate` computes them, but for two things: stretches are read in pieces that each begin
    `LEAD` samples early, and samples that repeat the one before count like others. Then many pieces go side by side.
    """
    pieces = [(n, at) for n, x in enumerate(xs) for at in range(0, len(x), PIECE)]
    out = [np.zeros((len(x), len(signals)), dtype=np.int32) for x in xs]
    values = [np.stack([raw_signal(x, s) for s in signals], axis=1).astype(np.int32) for x in xs]
    pieces.sort(key=lambda p: -_span(p, xs)[1])
    per = max(1, 600 // max(1, len(signals)) + 1) * 8
    for first in range(0, len(pieces), per):
        _follow_pieces(pieces[first : first + per], values, xs, signals, out)
    return out


def _span(piece: tuple[int, int], xs: Sequence[NDArray[np.int64]]) -> tuple[int, int]:
    """First sample read, and how many."""
    n, at = piece
    begin = max(0, at - LEAD)
    return begin, min(at + PIECE, len(xs[n])) - begin


def _follow_pieces(
    pieces: list[tuple[int, int]],
    values: list[NDArray[np.int32]],
    xs: Sequence[NDArray[np.int64]],
    signals: Sequence[Signal],
    out: list[NDArray[np.int32]],
) -> None:
    spans = [_span(p, xs) for p in pieces]
    longest = spans[0][1]
    block = np.zeros((longest, len(pieces), len(signals)), dtype=np.int32)
    for column, ((n, _), (begin, count)) in enumerate(zip(pieces, spans, strict=True)):
        block[:count, column] = values[n][begin : begin + count]
    slow = np.array([s.baseline for s in signals], dtype=np.int32)
    slower = np.array([s.noise for s in signals], dtype=np.int32)
    floor = np.array([s.floor for s in signals], dtype=np.int32)
    base = block[0] << EXTRA_BITS
    noise = np.zeros_like(base)
    sizes = np.zeros_like(block)
    for t in range(longest):
        value = block[t]
        deviation = value - (base >> EXTRA_BITS)
        size = np.abs(deviation)
        level = (noise >> EXTRA_BITS) + floor
        sizes[t] = np.sign(deviation) * ((size << THRESHOLD_BITS) // level)
        base += ((value << EXTRA_BITS) - base) >> slow
        noise += ((np.minimum(size, NOISE_CLIP * level) << EXTRA_BITS) - noise) >> slower
    for column, ((n, at), (begin, count)) in enumerate(zip(pieces, spans, strict=True)):
        out[n][at : begin + count] = sizes[at - begin : count, column]
