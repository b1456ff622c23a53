"""What the plot of the review page shows: a recording's signals, and all recordings of a gesture over each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.studio.review_prepared import FULL, Shape
from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.dataset.trim import seconds_of_rows
from plushsense.reports.quality_figures import deviation

ALL, ACTIVITY = "all", "activity"
BEFORE_S = 2.0
"""How much of the stream before a recording is shown."""
_POINTS = 3000
_LANE = 2.1
_GRID = 240


@dataclass(frozen=True)
class Signals:
    """One whole recording, read.

    Attributes:
        seconds: (T + 1,) the device clock since the first row, at each row and at the end.
        values: (K + T, C) in the channels' units, NaN where a value is garbage; ``at`` (K + T,) seconds. The first K
            are the stream's before the recording.
        activity: (T,) how far all channels together are from their rest, 1 as usual; NaN while no scale is known.
    """

    info: RecordingInfo
    layout: Layout
    seconds: NDArray[np.float64]
    at: NDArray[np.float64]
    values: NDArray[np.float64]
    activity: NDArray[np.float64]

    @property
    def groups(self) -> list[str]:
        """What may be shown: all channels, those of one kind, or the activity."""
        kinds = list(dict.fromkeys(c.kind for c in self.layout.channels))
        return [ALL, *(kinds if len(kinds) > 1 else []), ACTIVITY]

    @cached_property
    def _centred(self) -> NDArray[np.float64]:
        whole = np.isnan(self.values).all(axis=0)
        return np.asarray(self.values - np.nanmedian(np.where(whole, 0.0, self.values), axis=0))

    def row_at(self, second: float) -> int:
        """The row (or the end, T) whose time is nearest."""
        return int(np.abs(self.seconds - second).argmin())

    def shown(self, group: str, low: float | None = None, high: float | None = None) -> dict[str, Any]:
        """Curves of a group, from ``low`` to ``high`` seconds, thinned where there are more than some thousand rows.

        Returns: ``x``, ``curves`` (None: a hole), ``names``, ``unit`` ("" for shares), ``lanes`` [(position, kind)]
        where channels of several kinds stand above each other, each in shares of its kind's largest swing;
        ``thinned``.
        """
        at, table, lanes, unit = self.at, self.values, [], ""
        channels = [i for i, c in enumerate(self.layout.channels) if group in (ALL, c.kind)]
        names = [self.layout.names[i] for i in channels]
        kinds = list(dict.fromkeys(self.layout.channels[i].kind for i in channels))
        if group == ACTIVITY:
            at, table, names = self.seconds[:-1], self.activity[:, None], [ACTIVITY]
        elif len(kinds) > 1:
            table = self._centred[:, channels].copy()
            for lane, kind in enumerate(kinds):
                mine = [k for k, i in enumerate(channels) if self.layout.channels[i].kind == kind]
                swing = float(np.nanmax(np.abs(table[:, mine]), initial=0.0)) or 1.0
                table[:, mine] = table[:, mine] / swing - _LANE * lane
                lanes.append((-_LANE * lane, kind))
        else:
            table, unit = table[:, channels], self.layout.channels[channels[0]].unit
        if low is not None and high is not None:
            first, last = np.searchsorted(at, (low, high))
            part = slice(max(0, int(first) - 1), int(last) + 1)
            # The ends stay, so that the whole is still there to zoom out to.
            keep = np.unique(np.r_[0, np.arange(len(at))[part], len(at) - 1])
            at, table = at[keep], table[keep]
        thinned = len(at) > _POINTS
        if thinned:
            at, table = _thinned(at, table)
        return {
            "x": np.round(at, 4).tolist(),
            "curves": [_plain(column) for column in table.T],
            "names": names,
            "unit": unit,
            "lanes": lanes,
            "thinned": thinned,
        }


def signals(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> Signals:
    """Read a recording, and what its stream held before."""
    layout = dataset.layout
    frames = dataset.read(replace(info, start=0, stop=info.rows))
    before, before_at = _before(dataset, info, frames)
    seconds = seconds_of_rows(frames)
    raw = np.concatenate([before, frames.values])
    bad = (raw < layout.valid_min_int) | (raw > layout.valid_max_int)
    steps = np.array([c.step for c in layout.channels])
    active = deviation(frames, layout, scale) if len(scale) and len(frames) else np.full(len(frames), np.nan)
    return Signals(
        info,
        layout,
        seconds,
        np.concatenate([before_at, seconds[:-1]]),
        np.where(bad, np.nan, raw * steps),
        np.round(active, 4),
    )


def _before(dataset: Dataset, info: RecordingInfo, frames: Frames) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The stream's rows just before a recording, back to the last gap, and their (negative) seconds."""
    nothing = frames.values[:0], np.empty(0)
    if info.stream_row <= 0 or not len(frames):
        return nothing
    stream = dataset.read_stream(info.stream)
    many = int(np.ceil(BEFORE_S * max(info.rate_hz, 1.0)))
    past = stream.slice(max(0, info.stream_row - many), info.stream_row)
    # The clock of the stream: a recording of delays alone begins at 0.
    clock = np.append(past.device_ms, stream.device_ms[info.stream_row])
    steps = np.diff(clock)
    broken = np.flatnonzero((steps < 0) | (steps > max(dataset.layout.gap_ms, 3000 / max(info.rate_hz, 1.0))))
    first = int(broken[-1]) + 1 if len(broken) else 0
    return past.values[first:], (clock[first:-1] - clock[-1]) / 1000.0


def _thinned(at: NDArray[np.float64], table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of each stretch of rows the lowest and the highest value of each channel; the ends stay."""
    size = -(-len(at) // (_POINTS // 2))
    whole = len(at) // size * size
    blocks = table[:whole].reshape(-1, size, table.shape[1])
    empty = np.asarray(np.isnan(blocks).all(axis=1))
    filled = np.where(empty[:, None, :], 0.0, blocks)
    low, high = np.nanmin(filled, axis=1), np.nanmax(filled, axis=1)
    low[empty] = high[empty] = np.nan
    pairs = np.stack([low, high], axis=1).reshape(-1, table.shape[1])
    times = np.stack([at[:whole:size], at[size // 2 : whole : size]], axis=1).ravel()
    return np.append(times, at[-1]), np.vstack([pairs, table[-1:]])


def _plain(column: NDArray[np.float64]) -> list[float | None]:
    rounded = np.round(column, 3)
    if not np.isnan(rounded).any():
        return list(rounded.tolist())
    return [None if value != value else value for value in rounded.tolist()]


@dataclass(frozen=True)
class Curve:
    """A recording in an overlay: ``size`` (N,) at even steps over ``seconds``; ``why`` names what is odd about it."""

    recording: str
    seconds: float
    size: NDArray[np.float64]
    why: str = ""


def curve(identity: str, path: Shape, start_s: float, stop_s: float, why: str = "") -> Curve:
    """What is left of a recording's path from ``start_s`` to ``stop_s``."""
    size = np.array(path.size, dtype=np.float64) / FULL
    at = np.linspace(0.0, path.seconds, len(size)) if len(size) else size
    inside = (at >= start_s) & (at <= stop_s) if len(size) else size.astype(bool)
    return Curve(identity, max(0.0, stop_s - start_s), size[inside], why)


@dataclass(frozen=True)
class Overlay:
    """All recordings of a gesture over each other, on one time axis ``x`` (G,); ``curves`` one (G,) a recording."""

    drawn: tuple[Curve, ...]
    x: NDArray[np.float64]
    curves: NDArray[np.float64]

    @property
    def top(self) -> float:
        """How high it is drawn: one fall of the toy would press all else flat."""
        heights = [float(np.percentile(c.size, 99.5)) for c in self.drawn if len(c.size)]
        return 1.25 * float(np.percentile(heights, 98)) if heights else 1.0

    def nearest(self, x: float, y: float) -> str:
        """The recording whose curve passes nearest to a point; "" where none is."""
        if not len(self.drawn):
            return ""
        at = int(np.abs(self.x - x).argmin())
        around = slice(max(0, at - 2), at + 3)
        far = np.abs(self.curves[:, around] - y)
        far = np.where(np.isnan(far), np.inf, far).min(axis=1)
        best = int(far.argmin())
        return self.drawn[best].recording if np.isfinite(far[best]) else ""


def overlay(curves: Sequence[Curve]) -> Overlay:
    """Curves on one axis, those that are odd last, so that they are drawn on top."""
    drawn = tuple(sorted((c for c in curves if len(c.size) > 1), key=lambda c: bool(c.why)))
    lengths = np.array([c.seconds for c in drawn]) if drawn else np.ones(1)
    # One that never stopped would squeeze all others to the left.
    end = min(float(lengths.max()), 4.0 * float(np.median(lengths))) or 1.0
    x = np.linspace(0.0, end, _GRID)
    table = [np.interp(x, np.linspace(0.0, c.seconds, len(c.size)), c.size, right=np.nan) for c in drawn]
    return Overlay(drawn, x, np.array(table).reshape(len(drawn), _GRID))
