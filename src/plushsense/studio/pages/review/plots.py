"""Signals of one recording and overlays of a gesture, and the component that plots them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from nicegui.element import Element
from nicegui.events import GenericEventArguments
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.dataset.trimming import row_times_s
from plushsense.reports.quality_figures import deviation
from plushsense.studio.pages.review.preparation import FULL, DeviationShape

_VENDOR = Path(__file__).parents[2] / "widgets" / "vendor" / "uplot"


class ReviewPlot(Element, component="review_plot.js"):
    """Browser component that plots curves over seconds with marks, and reports clicks and keys.

    Args:
        label: text alternative while nothing is plotted.
        on_pick: called with {x, y, button ("left" or "right"), shift, shown (id of the plotted recording)}.
        on_key: called with {key, shift, shown}, except for keys typed into a field or a dialog.
        on_zoom: called with {low, high, shown} after zooming into thinned curves.
    """

    def __init__(
        self,
        label: str,
        *,
        height: int = 330,
        legend: bool = True,
        on_pick: Callable[[dict[str, Any]], Any],
        on_key: Callable[[dict[str, Any]], Any] | None = None,
        on_zoom: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__()
        self.add_resource(_VENDOR)
        self._props["label"] = label
        self._props["height"] = height
        self._props["legend"] = legend
        self._props["keyed"] = on_key is not None
        self.classes("w-full")
        for event, card in (("pick", on_pick), ("key", on_key), ("zoomed", on_zoom)):
            if card is not None:
                self.on(event, _with_args(card))

    def show(
        self,
        identity: str,
        label: str,
        x: Sequence[float],
        curves: Sequence[Sequence[float | None]],
        series: Sequence[dict[str, Any]],
        *,
        x_title: str,
        y_title: str = "",
        lanes: Sequence[tuple[float, str]] = (),
        limits: tuple[float, float] | None = None,
        marks: Sequence[dict[str, Any]] = (),
        cut: Sequence[tuple[float, float]] = (),
        thinned: bool = False,
        keep: bool = False,
    ) -> None:
        """Plot another set of curves.

        Args:
            identity: id sent back with every click and key.
            label: text alternative.
            lanes: (position, name) that replace the numbers of the y-axis.
            limits: range of the y-axis.
            marks: vertical lines with ``x``, ``label``, ``stroke`` and ``dash``.
            cut: shaded ranges (from, to).
            keep: whether to keep the zoom if the recording is the same.
        """
        payload = {
            "id": identity,
            "label": label,
            "data": [x, *curves],
            "series": list(series),
            "xTitle": x_title,
            "y": y_title,
            "lanes": [list(lane) for lane in lanes],
            "range": list(limits) if limits else None,
            "marks": list(marks),
            "cut": [list(c) for c in cut],
            "from": x[0] if x else 0.0,
            "thinned": thinned,
            "keep": keep,
        }
        self.run_method("show", payload)

    def remark(
        self, identity: str, marks: Sequence[dict[str, Any]], cut: Sequence[tuple[float, float]], label: str
    ) -> None:
        """Move the marks of the plotted recording."""
        self.run_method("remark", identity, list(marks), [list(c) for c in cut], label)

    def zoom(self, factor: float) -> None:
        """Scale the visible range by ``factor`` around the first mark; 0 displays the whole recording."""
        self.run_method("zoom", factor)


def _with_args(card: Callable[[dict[str, Any]], Any]) -> Callable[[GenericEventArguments], Any]:
    return lambda event: card(dict(event.args))


ALL, ACTIVITY = "all", "activity"
BEFORE_S = 2.0
"""Seconds of the stream plotted before a recording."""
_POINTS = 3000
_LANE = 2.1
_GRID = 240


@dataclass(frozen=True)
class RecordingSignals:
    """The signals of one whole recording.

    Attributes:
        seconds: (T + 1,) device clock since the first row, at each row and at the end.
        at: (K + T,) seconds of ``values``.
        values: (K + T, C) in the units of the channels, NaN for invalid values; the first K rows precede the
            recording in its stream.
        activity: (T,) deviation of all channels from rest, typically 1; NaN while the scale is unknown.
    """

    info: RecordingInfo
    layout: Layout
    seconds: NDArray[np.float64]
    at: NDArray[np.float64]
    values: NDArray[np.float64]
    activity: NDArray[np.float64]

    @property
    def groups(self) -> list[str]:
        """Groups of curves that can be plotted: all channels, the channels of one kind, or the activity."""
        kinds = list(dict.fromkeys(c.kind for c in self.layout.channels))
        return [ALL, *(kinds if len(kinds) > 1 else []), ACTIVITY]

    @cached_property
    def _centred(self) -> NDArray[np.float64]:
        whole = np.isnan(self.values).all(axis=0)
        return np.asarray(self.values - np.nanmedian(np.where(whole, 0.0, self.values), axis=0))

    def row_at(self, second: float) -> int:
        """Return the row nearest to a time, or T for the end."""
        return int(np.abs(self.seconds - second).argmin())

    def curves(self, group: str, low: float | None = None, high: float | None = None) -> dict[str, Any]:
        """Return the curves of a group from ``low`` to ``high`` seconds, thinned to at most 3000 rows.

        Channels of several kinds are plotted in lanes above each other, scaled by the largest deviation of each kind.

        Returns:
            A dictionary with ``x``, ``curves`` (None for a gap), ``names``, ``unit`` ("" for scaled values),
            ``lanes`` [(position, kind)] and ``thinned``.
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
            # Keep both ends, so that the plot can zoom out to the whole recording.
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


def read_signals(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> RecordingSignals:
    """Read a recording and the part of its stream just before it."""
    layout = dataset.layout
    frames = dataset.read(replace(info, start=0, stop=info.rows))
    before, before_at = _before(dataset, info, frames)
    seconds = row_times_s(frames)
    raw = np.concatenate([before, frames.values])
    bad = (raw < layout.valid_min_int) | (raw > layout.valid_max_int)
    steps = np.array([c.step for c in layout.channels])
    active = deviation(frames, layout, scale) if len(scale) and len(frames) else np.full(len(frames), np.nan)
    return RecordingSignals(
        info,
        layout,
        seconds,
        np.concatenate([before_at, seconds[:-1]]),
        np.where(bad, np.nan, raw * steps),
        np.round(active, 4),
    )


def _before(dataset: Dataset, info: RecordingInfo, frames: Frames) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the stream rows just before a recording, back to the last gap, and their negative seconds."""
    nothing = frames.values[:0], np.empty(0)
    if info.stream_row <= 0 or not len(frames):
        return nothing
    stream = dataset.read_stream(info.stream)
    many = int(np.ceil(BEFORE_S * max(info.rate_hz, 1.0)))
    past = stream.slice(max(0, info.stream_row - many), info.stream_row)
    # Use the clock of the stream: a recording that holds only delays begins at 0.
    clock = np.append(past.device_ms, stream.device_ms[info.stream_row])
    steps = np.diff(clock)
    broken = np.flatnonzero((steps < 0) | (steps > max(dataset.layout.gap_ms, 3000 / max(info.rate_hz, 1.0))))
    first = int(broken[-1]) + 1 if len(broken) else 0
    return past.values[first:], (clock[first:-1] - clock[-1]) / 1000.0


def _thinned(at: NDArray[np.float64], table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keep the lowest and the highest value of each channel per block of rows, and the last row."""
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
class DeviationCurve:
    """A recording in an overlay: ``size`` (N,) at even steps over ``seconds``; ``why`` names flagging checks."""

    recording: str
    seconds: float
    size: NDArray[np.float64]
    why: str = ""


def trimmed_curve(identity: str, path: DeviationShape, start_s: float, stop_s: float, why: str = "") -> DeviationCurve:
    """Return the curve of a recording between ``start_s`` and ``stop_s``."""
    size = np.array(path.size, dtype=np.float64) / FULL
    at = np.linspace(0.0, path.seconds, len(size)) if len(size) else size
    inside = (at >= start_s) & (at <= stop_s) if len(size) else size.astype(bool)
    return DeviationCurve(identity, max(0.0, stop_s - start_s), size[inside], why)


@dataclass(frozen=True)
class GestureOverlay:
    """Recordings of a gesture on one time axis ``x`` (G,), with one curve (G,) for each recording."""

    drawn: tuple[DeviationCurve, ...]
    x: NDArray[np.float64]
    curves: NDArray[np.float64]

    @property
    def top(self) -> float:
        """Upper limit of the y-axis, from high percentiles so that one outlier does not flatten the others."""
        heights = [float(np.percentile(c.size, 99.5)) for c in self.drawn if len(c.size)]
        return 1.25 * float(np.percentile(heights, 98)) if heights else 1.0

    def nearest(self, x: float, y: float) -> str:
        """Return the recording whose curve passes nearest to a point, or "" if there is none."""
        if not len(self.drawn):
            return ""
        at = int(np.abs(self.x - x).argmin())
        around = slice(max(0, at - 2), at + 3)
        far = np.abs(self.curves[:, around] - y)
        far = np.where(np.isnan(far), np.inf, far).min(axis=1)
        best = int(far.argmin())
        return self.drawn[best].recording if np.isfinite(far[best]) else ""


def build_overlay(curves: Sequence[DeviationCurve]) -> GestureOverlay:
    """Put curves onto one time axis, with flagged recordings last so that they are drawn on top."""
    drawn = tuple(sorted((c for c in curves if len(c.size) > 1), key=lambda c: bool(c.why)))
    lengths = np.array([c.seconds for c in drawn]) if drawn else np.ones(1)
    # A recording that was never stopped would compress all others.
    end = min(float(lengths.max()), 4.0 * float(np.median(lengths))) or 1.0
    x = np.linspace(0.0, end, _GRID)
    table = [np.interp(x, np.linspace(0.0, c.seconds, len(c.size)), c.size, right=np.nan) for c in drawn]
    return GestureOverlay(drawn, x, np.array(table).reshape(len(drawn), _GRID))
