"""What is kept of a recording after its rows were read: few numbers, by which recordings are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.quality.examined import seconds_of
from plushsense.dataset.quality.finding import Limits
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo

LEVEL_KINDS = ("capacitive", "proximity")
"""Kinds of channel with a baseline: their level says that something touches. Others turn with the toy."""
_HOP_S = 0.1
_CHUNK_S = 10.0
_NOISE = 2.0
# A channel that never does more than this many times its noise says little.
_MOVED = 10.0


@dataclass(frozen=True)
class Outline:
    """A recording or stream in few numbers; C channels.

    ``activity`` (B, C) float32: how much each channel does in each 0.1 s, its range over 0.2 s; for channels of
    `LEVEL_KINDS` at least its height over the recording's low. ``hop`` rows a block. ``runs`` (C,) the longest stretch
    of one value in rows, from ``run_at``; ``top_runs`` the same at the highest or lowest
    value, which is ``top`` and is reached in ``top_rows``. ``spread`` (C,) from
    the 2nd to the 98th percentile; ``low`` the 10th. ``lows`` (K, C): the 10th percentile of every 10 s of a stream.
    """

    info: RecordingInfo | StreamInfo
    rows: int
    seconds: float
    period_ms: float
    hop: int
    activity: NDArray[np.float32]
    runs: NDArray[np.int64]
    run_at: NDArray[np.int64]
    top_runs: NDArray[np.int64]
    top_at: NDArray[np.int64]
    top: NDArray[np.int64]
    top_rows: NDArray[np.int64]
    spread: NDArray[np.float64]
    low: NDArray[np.float64]
    content: bytes
    lows: NDArray[np.float64] | None = None

    @property
    def first_row(self) -> int:
        """Where the rows examined begin in the recording."""
        return self.info.start if isinstance(self.info, RecordingInfo) else 0


def _longest(same: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Per column of ``same`` (T, C): the longest stretch that holds, and its first row."""
    rows = np.arange(len(same))[:, None]
    broken = np.maximum.accumulate(np.where(same, -1, rows), axis=0)
    length = np.where(same, rows - broken, 0)
    end = length.argmax(axis=0)
    longest = length[end, np.arange(same.shape[1])]
    return longest, end - longest + 1


def _activity(values: NDArray[np.float64], hop: int, level: NDArray[np.bool_]) -> NDArray[np.float32]:
    n = max(1, len(values) // hop)
    blocks = values[: n * hop].reshape(n, -1, values.shape[1])
    high, low = blocks.max(axis=1), blocks.min(axis=1)
    both = slice(None, -1), slice(1, None)
    if n > 1:
        moved = np.maximum(high[both[0]], high[both[1]]) - np.minimum(low[both[0]], low[both[1]])
        moved = np.vstack([moved, moved[-1:]])
    else:
        moved = high - low
    if level.any():
        raised = (high + low)[:, level] / 2
        moved[:, level] = np.maximum(moved[:, level], raised - np.percentile(raised, 10, axis=0))
    made: NDArray[np.float32] = moved.astype(np.float32)
    return made


def outline(info: RecordingInfo | StreamInfo, frames: Frames, layout: Layout) -> Outline:
    """The outline of some rows; invalid values are drawn to the valid range, so that one does not hide the rest."""
    values = np.clip(frames.values, layout.valid_min_int, layout.valid_max_int)
    t, c = values.shape
    stream = isinstance(info, StreamInfo)
    steps = np.diff(frames.device_ms)
    forward = steps[(steps > 0) & (steps <= 1000)]
    mean_ms = float(steps[(steps >= 0) & (steps <= 1000)].mean()) if len(forward) else 1000.0 / layout.rate_hz
    hop = max(1, round(_HOP_S * 1000 / max(mean_ms, 1e-3)))
    level = np.array([ch.kind in LEVEL_KINDS for ch in layout.channels])
    same = np.vstack([np.zeros((1, c), dtype=bool), values[1:] == values[:-1]])
    runs, at = _longest(same)
    held_top, top_at = _longest(values == values.max(axis=0))
    held_low, low_at = _longest(values == values.min(axis=0))
    # Where nothing touches, a level rests at its lowest: that is no stop.
    held_low[level] = 0
    top_at = np.where(held_low > held_top, low_at, top_at)
    top = values[top_at, np.arange(c)]
    low, q2, q98 = (
        np.percentile(values, (10, 2, 98), axis=0) if not stream else np.percentile(values[::10], (10, 2, 98), axis=0)
    )
    lows = None
    if stream:
        rows = max(1, round(_CHUNK_S * 1000 / max(mean_ms, 1e-3)))
        n = t // rows
        lows = np.percentile(values[: n * rows].reshape(n, rows, c)[:, ::5], 10, axis=1) if n else None
    return Outline(
        info,
        t,
        seconds_of(frames),
        mean_ms,
        hop,
        np.zeros((0, c), np.float32) if stream else _activity(values.astype(np.float64), hop, level),
        runs + 1,
        at - 1,
        np.maximum(held_top, held_low),
        top_at,
        top,
        (values == top).sum(axis=0),
        q98 - q2,
        low,
        b"" if stream else _content(frames),
        lows,
    )


def _content(frames: Frames) -> bytes:
    """The same for recordings that hold the same values, whatever their clocks and names say."""
    import hashlib

    return hashlib.sha256(np.ascontiguousarray(frames.values).tobytes()).digest()


@dataclass(frozen=True)
class Whole:
    """All that is compared: the outlines of the recordings that are used, and of the streams."""

    dataset: Dataset
    recordings: Sequence[Outline]
    streams: Sequence[Outline]
    limits: Limits

    @cached_property
    def groups(self) -> dict[str, list[Outline]]:
        """Recordings that should be alike: of one gesture, and of one person where the gesture is free choice."""
        found: dict[str, list[Outline]] = {}
        for o in self.recordings:
            gesture = self.dataset.gestures.find(o.info.gesture) if isinstance(o.info, RecordingInfo) else None
            free = gesture is not None and gesture.free_choice
            found.setdefault(f"{gesture_of(o)}\n{o.info.subject}" if free else gesture_of(o), []).append(o)
        return found

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """What each channel does when nothing happens, (C,): the quiet moments of the quietest recordings."""
        quiet = [np.percentile(o.activity, 10, axis=0) for o in self.recordings if len(o.activity)]
        floor: NDArray[np.float64] = np.percentile(quiet or np.zeros((1, self.dataset.layout.n_channels)), 5, axis=0)
        return floor

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """What each channel does when something happens to it, (C,): so channels of all kinds can be compared."""
        peaks = [np.percentile(o.activity, 95, axis=0) for o in self.recordings if len(o.activity)]
        table = np.asarray(peaks or np.zeros((1, self.dataset.layout.n_channels)), dtype=np.float64)
        high: NDArray[np.float64] = np.percentile(table, 90, axis=0)
        return np.maximum(high - _NOISE * self.noise, np.maximum(_MOVED * self.noise, 1.0))

    def activity(self, o: Outline) -> NDArray[np.float64]:
        """How much happens in each block of a recording over all channels, beyond their noise, (B,)."""
        beyond = np.maximum(o.activity - _NOISE * self.noise, 0.0) / self.scale
        total: NDArray[np.float64] = np.sqrt(np.square(beyond).sum(axis=1))
        return total

    @cached_property
    def usual_run_ms(self) -> NDArray[np.float64]:
        """The median over the recordings of each channel's longest stretch of one value in ms, (C,)."""
        return _median([o.runs * o.period_ms for o in self.recordings])

    @cached_property
    def usual_top_ms(self) -> NDArray[np.float64]:
        """The same for stretches at the highest or lowest value."""
        return _median([o.top_runs * o.period_ms for o in self.recordings])


def _median(rows: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    middle: NDArray[np.float64] = np.median(rows, axis=0)
    return middle


def gesture_of(o: Outline) -> str:
    """The gesture of a recording's outline."""
    return o.info.gesture if isinstance(o.info, RecordingInfo) else ""
