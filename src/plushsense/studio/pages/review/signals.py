"""Compute signals, deviation curves and overlays of recordings, and prepare a review in a background thread.

Trim suggestions and deviation shapes depend only on the raw files. They are cached in the folder ``cache/`` of the
data set, which may be deleted, is not part of backups, and is emptied when a person's data are erased. Findings also
depend on the marks; they are not cached but computed again on request.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, ForgottenError, PlushSenseError
from plushsense.core.files import write_file
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.onset import SPEC, Suggestion
from plushsense.dataset.quality.checking import CheckReport, check
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo
from plushsense.dataset.trimming import row_times_s, suggest_trims
from plushsense.reports.quality import scale_of
from plushsense.reports.quality_figures import deviation, line
from plushsense.studio.app.workspace import ChangeSignal

ALL, ACTIVITY = "all", "activity"
BEFORE_S = 2.0
"""Length of the part of the stream plotted before a recording, in seconds."""
_POINTS = 3000
_LANE = 2.1
_GRID = 240


class PlottedCurves(NamedTuple):
    """Curves to plot: None is a gap, a ``unit`` of "" means scaled values, ``lanes`` are pairs of position and kind.

    ``limits`` of the y-axis are given where those of the values would enlarge small changes.
    """

    x: list[float]
    curves: list[list[float | None]]
    names: list[str]
    unit: str
    lanes: list[tuple[float, str]]
    thinned: bool
    limits: tuple[float, float] | None


@dataclass(frozen=True)
class RecordingSignals:
    """The signals of one untrimmed recording of T rows.

    Attributes:
        seconds: (T + 1,) time by the device clock since the first row, of each row and of the end.
        at: (K + T,) times of the rows of ``values``, in seconds.
        values: (K + T, C) values in the units of the C channels, NaN if invalid; the first K rows precede the
            recording in its stream.
        activity: (T,) deviation of all channels from rest, where 1 is typical; NaN while the scale is unknown.
        usual: (C,) typical spread of the channels in recordings of the data set; 0 where it is unknown.
    """

    info: RecordingInfo
    layout: Layout
    seconds: NDArray[np.float64]
    at: NDArray[np.float64]
    values: NDArray[np.float64]
    activity: NDArray[np.float64]
    usual: NDArray[np.float64]

    @cached_property
    def _centred(self) -> NDArray[np.float64]:
        whole = np.isnan(self.values).all(axis=0)
        return np.asarray(self.values - np.nanmedian(np.where(whole, 0.0, self.values), axis=0))

    def row_at(self, second: float) -> int:
        """Return the row nearest to a time; T means the end of the recording."""
        return int(np.abs(self.seconds - second).argmin())

    def curves(
        self, group: str, low: float | None = None, high: float | None = None, enlarged: bool = False
    ) -> PlottedCurves:
        """Return the curves of a group from ``low`` to ``high`` seconds, thinned to about 3000 points.

        If there are several kinds of channels, each kind has its own lane and is scaled by its largest deviation. What
        is below the usual spread of the channels looks small, unless it is ``enlarged``.
        """
        usual = 0.0 * self.usual if enlarged else self.usual
        limits: tuple[float, float] | None = None
        at, table, unit = self.at, self.values, ""
        lanes: list[tuple[float, str]] = []
        channels = [i for i, c in enumerate(self.layout.channels) if group in (ALL, c.kind)]
        names = [self.layout.names[i] for i in channels]
        kinds = list(dict.fromkeys(self.layout.channels[i].kind for i in channels))
        if group == ACTIVITY:
            at, table, names = self.seconds[:-1], self.activity[:, None], [ACTIVITY]
        elif len(kinds) > 1:
            table = self._centred[:, channels].copy()
            for lane, kind in enumerate(kinds):
                mine = [k for k, i in enumerate(channels) if self.layout.channels[i].kind == kind]
                swing = float(np.nanmax(np.abs(table[:, mine]), initial=usual[channels][mine].max())) or 1.0
                table[:, mine] = table[:, mine] / swing - _LANE * lane
                lanes.append((-_LANE * lane, kind))
            limits = (1.08 - _LANE * len(lanes), 1.08)
        else:
            table, unit = table[:, channels], self.layout.channels[channels[0]].unit
        if not lanes:
            limits = _widened(
                table, 1.0 if group == ACTIVITY and not enlarged else float(usual[channels].max(initial=0.0))
            )
        if low is not None and high is not None:
            first, last = np.searchsorted(at, (low, high))
            part = slice(max(0, int(first) - 1), int(last) + 1)
            # Keep the first and last row, so that the plot can zoom out to the whole recording.
            keep = np.unique(np.r_[0, np.arange(len(at))[part], len(at) - 1])
            at, table = at[keep], table[keep]
        thinned = len(at) > _POINTS
        if thinned:
            at, table = _thinned(at, table)
        curves = [_plain(column) for column in table.T]
        return PlottedCurves(np.round(at, 4).tolist(), curves, names, unit, lanes, thinned, limits)


def _widened(table: NDArray[np.float64], least: float) -> tuple[float, float] | None:
    """Return limits ``least`` apart around the values; None if these are further apart themselves, or all invalid."""
    low, high = np.nanmin(table, initial=np.inf), np.nanmax(table, initial=-np.inf)
    if not 0.0 <= high - low < least:
        return None
    middle = float(low + high) / 2.0
    return middle - 0.6 * least, middle + 0.6 * least


def read_signals(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> RecordingSignals:
    """Read a recording and the part of its stream just before it."""
    layout = dataset.layout
    whole = info.id == info.stream
    frames = dataset.read_stream(info.stream) if whole else dataset.read(replace(info, start=0, stop=info.rows))
    before, before_at = _before(dataset, info, frames)
    seconds = row_times_s(frames, layout.gap_ms)
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
        scale * steps if len(scale) else np.zeros(len(steps)),
    )


def read_stream_signals(dataset: Dataset, stream: StreamInfo) -> RecordingSignals:
    """Read a stream as if it were one recording, without activity."""
    key = (stream.id, stream.subject, stream.session, "", stream.file)
    info = RecordingInfo(*key, 0, stream.rows, 0, stream.rows, stream.id, 0, 0, 0, 0.0, False, stream.flags, "")
    return read_signals(dataset, info, np.empty(0))


def _before(dataset: Dataset, info: RecordingInfo, frames: Frames) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the stream rows of the last `BEFORE_S` before a recording, but none before a gap, and their times < 0."""
    nothing = frames.values[:0], np.empty(0)
    if info.stream_row <= 0 or not len(frames):
        return nothing
    stream = dataset.read_stream(info.stream)
    many = int(np.ceil(BEFORE_S * max(info.rate_hz, 1.0)))
    past = stream.slice(max(0, info.stream_row - many), info.stream_row)
    # Use the clock of the stream, because the clock of a recording stored as delays begins at 0.
    clock = np.append(past.device_ms, stream.device_ms[info.stream_row])
    steps = np.diff(clock)
    broken = np.flatnonzero((steps < 0) | (steps > max(dataset.layout.gap_ms, 3000 / max(info.rate_hz, 1.0))))
    first = int(broken[-1]) + 1 if len(broken) else 0
    return past.values[first:], (clock[first:-1] - clock[-1]) / 1000.0


def _thinned(at: NDArray[np.float64], table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reduce each block of rows to the lowest and highest value of each channel; keep the last row."""
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
    """A recording in an overlay: deviations ``size`` (N,), evenly spaced over ``seconds``; ``why`` names its flags."""

    recording: str
    seconds: float
    size: NDArray[np.float64]
    why: str = ""


def trimmed_curve(identity: str, shape: DeviationShape, start_s: float, stop_s: float, why: str = "") -> DeviationCurve:
    """Return the curve of a recording between ``start_s`` and ``stop_s``."""
    size = np.array(shape.size, dtype=np.float64) / FULL
    at = np.linspace(0.0, shape.seconds, len(size)) if len(size) else size
    inside = (at >= start_s) & (at <= stop_s) if len(size) else size.astype(bool)
    return DeviationCurve(identity, max(0.0, stop_s - start_s), size[inside], why)


@dataclass(frozen=True)
class GestureOverlay:
    """Recordings of a gesture on a common time axis ``x`` (G,); ``curves`` (R, G) has one row per recording."""

    drawn: tuple[DeviationCurve, ...]
    x: NDArray[np.float64]
    curves: NDArray[np.float64]

    @property
    def top(self) -> float:
        """Upper limit of the y-axis, computed from percentiles so that one outlier does not flatten the others."""
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
    """Resample curves to a common time axis; flagged recordings come last, so that they are drawn on top."""
    drawn = tuple(sorted((c for c in curves if len(c.size) > 1), key=lambda c: bool(c.why)))
    lengths = np.array([c.seconds for c in drawn]) if drawn else np.ones(1)
    # Limit the axis, because a recording that was never stopped would compress all others.
    end = min(float(lengths.max()), 4.0 * float(np.median(lengths))) or 1.0
    x = np.linspace(0.0, end, _GRID)
    table = [np.interp(x, np.linspace(0.0, c.seconds, len(c.size)), c.size, right=np.nan) for c in drawn]
    return GestureOverlay(drawn, x, np.array(table).reshape(len(drawn), _GRID))


CACHE_FILE = "review.json"
FULL = 1000
"""Value in `DeviationShape.size` that stands for a typical deviation."""
_BATCH = 25
# Minimum time between two notifications of progress.
_NOTIFY_S = 0.3
# Pauses after each recording, so that other threads can run; longer for `_BUSY_S` after a page was used.
_PAUSE_S = 0.0005
_LONG_PAUSE_S = 0.015
_BUSY_S = 1.5


class _Closed(Exception):
    """Raised in the background thread when the review closes."""


@dataclass(frozen=True)
class DeviationShape:
    """The deviation of an untrimmed recording from rest, reduced to a few points.

    ``size`` (at most 160 points): deviation of all channels, where `FULL` is typical, evenly spaced over ``seconds``.
    """

    seconds: float
    size: tuple[int, ...]


@dataclass
class ReviewPreparation:
    """Background thread that prepares a review, and its results so far.

    Attributes:
        scale: (C,) typical deviation of each channel; empty until it has been computed.
        progress: (step, done, total), or None if the thread is idle; ``step`` is "suggestions" or "checks".
        error: why the last run failed, or None.
    """

    changed: ChangeSignal
    suggestions: dict[str, Suggestion] = field(default_factory=dict)
    shapes: dict[str, DeviationShape] = field(default_factory=dict)
    scale: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    checked: CheckReport | None = None
    progress: tuple[str, int, int] | None = None
    error: PlushSenseError | None = None
    _thread: threading.Thread | None = field(default=None, repr=False)
    _next: Dataset | None = field(default=None, repr=False)
    _lock: Any = field(default_factory=threading.Lock, repr=False)
    _closed: bool = False
    _notified_s: float = 0.0
    _used_s: float = 0.0

    def begin(self, dataset: Dataset) -> None:
        """Start to compute missing results and to check ``dataset`` with its marks, in the background.

        If a run is in progress, another run with the latest ``dataset`` follows it.
        """
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                self._next = dataset
                return
            self._thread = threading.Thread(target=self._run, args=(dataset,), daemon=True)
            self._thread.start()

    def step_back(self) -> None:
        """Slow the background thread down for a while, so that pages respond quickly."""
        self._used_s = time.monotonic()

    def wait(self, seconds: float) -> None:
        """Wait until the background thread has ended, but at most ``seconds``."""
        if self._thread is not None:
            self._thread.join(seconds)

    def close(self) -> None:
        """Stop the background thread and wait a few seconds for its end."""
        self._closed = True
        self.wait(5.0)

    def _run(self, dataset: Dataset | None) -> None:
        while dataset is not None:
            try:
                self.error = None
                self._make(dataset)
                self.progress = ("checks", 0, len(dataset.recordings))
                self.checked = check(dataset, progress=self._steps("checks"))
            except _Closed:
                return
            except PlushSenseError as refusal:
                self.error = refusal
            except OSError as cause:
                why = cause.strerror or str(cause)
                self.error = DatasetError("“{name}” cannot be read: {why}.", name=dataset.path.name, why=why)
            with self._lock:
                dataset, self._next = self._next, None
                if dataset is None:
                    self.progress, self._thread = None, None
            self.changed.notify()

    def _steps(self, stage: str, before: int = 0, total: int = 0) -> Callable[[int, int], None]:
        def step(done: int, of: int) -> None:
            if self._closed:
                raise _Closed
            self.progress = (stage, before + done, total or of)
            time.sleep(_LONG_PAUSE_S if time.monotonic() - self._used_s < _BUSY_S else _PAUSE_S)
            if time.monotonic() - self._notified_s > _NOTIFY_S:
                self._notified_s = time.monotonic()
                self.changed.notify()

        return step

    def _make(self, dataset: Dataset) -> None:
        keys = {r.id: _key(r) for r in dataset.recordings}
        self._read_cache(dataset, keys)
        missing = [r for r in dataset.recordings if r.id not in self.shapes]
        if not missing:
            return
        if not len(self.scale):
            self.scale = scale_of(dataset)
        total, before = len(dataset.recordings), len(dataset.recordings) - len(missing)
        missing.sort(key=lambda r: (r.stream, r.id))
        for first in range(0, len(missing), _BATCH):
            part, step = missing[first : first + _BATCH], self._steps("suggestions", before + first, total)
            if not dataset.layout.is_labelled:
                self.suggestions |= {t.recording.id: t.suggestion for t in suggest_trims(dataset, part, step)}
            self.shapes |= {r.id: shape_of(dataset, r, self.scale) for r in part}
            step(len(part), total)
        self._write_cache(dataset, keys)

    def _read_cache(self, dataset: Dataset, keys: dict[str, str]) -> None:
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            cached = json.loads((dataset.path / CACHE / CACHE_FILE).read_text(encoding="utf-8"))
            if cached["made_by"] != _made_by() or len(cached["scale"]) != dataset.layout.n_channels:
                return
            self.scale = np.array(cached["scale"], dtype=np.float64)
            for identity, (key, suggestion, seconds, size) in cached["recordings"].items():
                if keys.get(identity) != key:
                    continue
                if suggestion is not None:
                    self.suggestions[identity] = Suggestion(*suggestion)
                self.shapes[identity] = DeviationShape(float(seconds), tuple(map(int, size)))

    def _write_cache(self, dataset: Dataset, keys: dict[str, str]) -> None:
        recordings = {
            identity: (
                key,
                astuple(self.suggestions[identity]) if identity in self.suggestions else None,
                self.shapes[identity].seconds,
                self.shapes[identity].size,
            )
            for identity, key in keys.items()
        }
        content = json.dumps({"made_by": _made_by(), "scale": self.scale.tolist(), "recordings": recordings})
        # If the cache cannot be written, the results are computed again each time.
        with contextlib.suppress(OSError, ForgottenError), dataset.generation.writing():
            (dataset.path / CACHE).mkdir(exist_ok=True)
            write_file(dataset.path / CACHE / CACHE_FILE, content)


def shape_of(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> DeviationShape:
    """Compute the deviation shape of one untrimmed recording."""
    frames = dataset.read(replace(info, start=0, stop=info.rows))
    if not len(frames):
        return DeviationShape(0.0, ())
    curve = line(frames, dataset.layout, scale, float(row_times_s(frames, dataset.layout.gap_ms)[-1]))
    size = np.minimum(np.rint(curve.size * FULL), 1e6).astype(int)
    return DeviationShape(round(curve.lasts, 3), tuple(size.tolist()))


def _made_by() -> str:
    return hashlib.sha256(f"1 {__version__} {SPEC}".encode()).hexdigest()[:16]


def _key(r: RecordingInfo) -> str:
    """Return a hash of everything in the index on which a trim suggestion depends."""
    source = repr((r.sha256, r.first_row, r.rows, r.gesture, r.stream, r.stream_row))
    return hashlib.sha256(source.encode()).hexdigest()[:16]
