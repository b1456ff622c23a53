"""How far the gate's signals stand out, for many people's samples at once: what its thresholds are chosen on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.models.gate import EXTRA_BITS, HELD, LEVEL, NOISE_CLIP, THRESHOLD_BITS, Signal

LEAD = 1200
"""Samples read before a piece, in which a baseline settles."""
PIECE = 4800
_CELLS = 12_000  # pieces times signals that go side by side: more no longer fit the cache


def raw_signal(x: NDArray[np.int64], signal: Signal) -> NDArray[np.int64]:
    """A signal of inputs (T, I) before its baseline: (T,)."""
    columns: NDArray[np.int64] = np.clip(x[:, list(signal.inputs)] >> signal.shift, -HELD, HELD)
    if signal.kind == LEVEL:
        return np.asarray(columns[:, 0])
    out = np.zeros(len(x), dtype=np.int64)
    out[signal.lag :] = np.abs(columns[signal.lag :] - columns[: -signal.lag]).sum(axis=1)
    return np.minimum(out, HELD)


def follow(
    xs: Sequence[NDArray[np.int64]], signals: Sequence[Signal], deviations: bool = False
) -> list[NDArray[np.int32]]:
    """Sizes of the signals, with the deviation's sign: of each stretch (T, I) an array (T, S).

    As `plushsense.models.gate.Gate` computes them, but for two things: stretches are read in pieces that each begin
    `LEAD` samples early, and samples that repeat the one before count like others. Then many pieces go side by side.
    With ``deviations`` these are given instead.
    """
    out = [np.zeros((len(x), len(signals)), dtype=np.int32) for x in xs]
    pieces = [(n, at, max(0, at - LEAD)) for n, x in enumerate(xs) for at in range(0, len(x), PIECE)]
    pieces.sort(key=lambda p: p[2] - min(p[1] + PIECE, len(xs[p[0]])))  # the longest first
    per = max(1, _CELLS // max(1, len(signals)))
    for first in range(0, len(pieces), per):
        some = pieces[first : first + per]
        stops = [min(at + PIECE, len(xs[n])) for n, at, _ in some]
        # A jerk looks back behind the piece, so that signals are made with the samples before.
        block = np.zeros((stops[0] - some[0][2], len(some), len(signals)), dtype=np.int32)
        for column, ((n, _, begin), stop) in enumerate(zip(some, stops, strict=True)):
            back = max(0, begin - 16)
            for s, signal in enumerate(signals):
                block[: stop - begin, column, s] = raw_signal(xs[n][back:stop], signal)[begin - back :]
        sizes = _follow_block(block, signals, deviations)
        for column, ((n, at, begin), stop) in enumerate(zip(some, stops, strict=True)):
            out[n][at:stop] = sizes[at - begin : stop - begin, column]
    return out


def _follow_block(block: NDArray[np.int32], signals: Sequence[Signal], deviations: bool) -> NDArray[np.int32]:
    """(T, pieces, S) raw signals: their sizes, in the same place."""
    slow = np.array([s.baseline for s in signals], dtype=np.int32)
    slower = np.array([s.noise for s in signals], dtype=np.int32)
    floor = np.array([s.floor for s in signals], dtype=np.int32)
    base = block[0] << EXTRA_BITS
    noise = np.zeros_like(base)
    for t in range(len(block)):
        value = block[t]
        deviation = value - (base >> EXTRA_BITS)
        size = np.abs(deviation)
        level = (noise >> EXTRA_BITS) + floor
        base += ((value << EXTRA_BITS) - base) >> slow
        noise += ((np.minimum(size, NOISE_CLIP * level) << EXTRA_BITS) - noise) >> slower
        block[t] = deviation if deviations else np.sign(deviation) * ((size << THRESHOLD_BITS) // level)
    return block
