"""Cut windows anywhere in a session's stream, as a network in use gets them: with onsets, ends and idle time.

A *position* is a sample of a stream at which a window ends. Positions lie every ``every_s`` along the streams of the
data set. The label of a position is

- a gesture, from ``onset_s`` after the start of its recording (after trimming) to ``after_s`` after its end;
- idle, in recordings of an idle gesture, and outside recordings if none has ended within the last ``settle_s``;
- none, elsewhere: just after a start or an end, in recordings that are not used (excluded, of a gesture that is not a
  class, not stopped in time), and where two recordings overlap. Such positions are left out.

People also practise between recordings, which is not idle time. Therefore the share ``busy_share`` of a stream's
positions outside recordings, those with the most movement in the last second, is left out too. Labels of stretches
replace this guess: positions in a practised gesture, and up to ``settle_s`` after it, are left out, and those at rest
or where the toy is picked up, turned or put down are idle however much it moves. Of the remaining idle positions,
evenly spaced ones are taken, so that ``idle_share`` of all windows are idle.

A recording that is in no stream (or has no position there) is cut as in `plushsense.windows.cut`, and marked. If a
recording of a session has no place in the stream, the session gives no idle positions outside recordings, since its
stream may contain that gesture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.dataset.marks import LabelledStretch
from plushsense.dataset.store import Dataset, Progress, RecordingInfo, StreamInfo
from plushsense.windows.clock import Segment
from plushsense.windows.cut import (
    ANYWHERE,
    RecordingCutter,
    WindowCut,
    WindowSet,
    WindowSpec,
    assemble,
    drop_long_recordings,
)
from plushsense.windows.features import network_inputs
from plushsense.windows.sessions import SessionReader

IDLE_LABEL = "Idle"
_LIVELY_S = 1.0
NOTHING, FREE, IDLE = -1, -2, -3


@dataclass(frozen=True)
class AnywhereSpec:
    """Settings for choosing positions; the docstring of the module explains how they work together.

    Attributes:
        every_s: time between the positions in a stream at which windows may end (above 0 to 60).
        onset_s: time after the start of a recording from which a window that ends there has the gesture's label
            (0 to 60).
        after_s: time after the end of a recording until which it still has (0 to 60).
        settle_s: time after the end of a recording from which nothing happens; not below ``after_s`` (0 to 60).
        idle_share: share of idle windows among all windows (0 to below 1).
        busy_share: share of the positions outside recordings, those with the most movement, that is left out because
            people may practise there (0 to 1).
    """

    every_s: float = 0.4
    onset_s: float = 0.3
    after_s: float = 0.2
    settle_s: float = 1.0
    idle_share: float = 0.3
    busy_share: float = 0.3

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            low, high = (0.0, 1.0) if f.name.endswith("_share") else (0.0, 60.0)
            if not low <= value <= high or (f.name == "every_s" and value == 0.0):
                raise ConfigError(f"{f.name} is {value}: accepted is {low:g} to {high:g}.")
        if self.idle_share >= 1.0:
            raise ConfigError(f"idle_share is {self.idle_share:g}: accepted is 0 up to, not including, 1.")
        if self.settle_s < self.after_s:
            raise ConfigError(
                f"settle_s is {self.settle_s:g} and after_s {self.after_s:g}: settle_s must not be below after_s."
            )


def add_idle_gesture(gestures: GestureSet, dataset: Dataset) -> GestureSet:
    """Return the gesture set with an idle class added, if it has none and there are recordings within streams."""
    if any(g.idle for g in gestures.gestures) or dataset.layout.is_labelled:
        return gestures
    if not any(r.stream_row >= 0 for r in dataset.used):
        return gestures
    own = [g for g in dataset.gestures.gestures if g.idle]
    if own:
        known = {*gestures.labels, own[0].label}
        return dataset.gestures.subset([label for label in dataset.gestures.labels if label in known])
    affect = "neutral" if gestures.has_affect else "none"
    idle = Gesture(IDLE_LABEL, affect, nobody=True, idle=True, description="Nothing happens to the toy")
    if gestures.find(IDLE_LABEL) is not None:
        raise DatasetError(
            f"The gesture '{IDLE_LABEL}' of '{dataset.head.name}' is not marked as idle: "
            "set  idle = true  in its gesture set, or rename it."
        )
    return GestureSet(gestures.name, (*gestures.gestures, idle), gestures.inferred)


@dataclass(frozen=True, eq=False)
class _Place:
    """A position: the first ``at`` samples of ``segment``; ``x`` (T, F) are the network inputs of the segment."""

    x: NDArray[np.int64]
    segment: Segment
    at: int

    def cut(self, reach: int) -> WindowCut:
        """Return the window that ends at the position."""
        rows = (int(self.segment.row_of[self.at - reach]), int(self.segment.row_of[self.at - 1]) + 1)
        return WindowCut(self.x[self.at - reach : self.at], ANYWHERE, rows)


def cut_anywhere(
    dataset: Dataset,
    spec: WindowSpec,
    gestures: GestureSet,
    anywhere: AnywhereSpec | None = None,
    progress: Progress | None = None,
) -> WindowSet:
    """Cut windows at positions along the streams of ``dataset``, for training.

    Args:
        gestures: the classes (see `add_idle_gesture`). Without an idle one, only positions in recordings are used.
        progress: called with (streams done, total number of streams).

    Returns:
        Windows with the ``context`` "anywhere"; those of recordings without a stream, or with too little of it before
        them, are cut as by the context "stream". The idle windows of a stream form one recording of the stream's
        person; no window contains a gap or reset of the clock.

    Raises:
        DatasetError: if there is no window.
    """
    anywhere = anywhere or AnywhereSpec()
    cutter = RecordingCutter(dataset, replace(spec, context=ANYWHERE))
    reach = cutter.reach
    used, left_out = drop_long_recordings([r for r in dataset.used if r.gesture in gestures.labels], spec)
    idle = next((g for g in gestures.gestures if g.idle), None)
    adrift = {(r.subject, r.session) for r in dataset.recordings if r.stream_row < 0}
    # Whoever excludes all recordings of a stream excludes it.
    excluded = {r.stream for r in dataset.recordings} - {r.stream for r in dataset.used}
    moving, resting = list[tuple[RecordingInfo, _Place]](), list[tuple[RecordingInfo, _Place]]()
    free: list[tuple[RecordingInfo, _Place]] = []
    for done, stream in enumerate(dataset.streams):
        in_recordings, unmarked = _positions(dataset, stream, used, reach, anywhere)
        for recording, place in in_recordings:
            (resting if gestures.get(recording.gesture).idle else moving).append((recording, place))
        if idle is not None and (stream.subject, stream.session) not in adrift and stream.id not in excluded:
            # An idle recording without rows, so that it overlaps no other.
            name, file = f"{stream.id} (unmarked)", stream.file
            key = (name, stream.subject, stream.session, idle.label, file)
            nobody = RecordingInfo(*key, 0, 0, 0, 0, stream.id, 0, 0, 0, 0.0, False, (), "")
            free += [(nobody, place) for place in unmarked]
        if progress is not None:
            progress(done + 1, len(dataset.streams))
    reached = {r.id for r, _ in (*moving, *resting)}
    cuts = [(recording, cut) for recording in used if recording.id not in reached for cut in cutter.cut(recording)]
    gesturing = len(moving) + sum(not gestures.get(r.gesture).idle for r, _ in cuts)
    n_idle = round(gesturing * anywhere.idle_share / (1.0 - anywhere.idle_share))
    quiet = _evenly(resting, max(n_idle // 2, n_idle - len(free)))
    quiet += _evenly(free, n_idle - len(quiet))
    cuts += [(recording, place.cut(reach)) for recording, place in (*moving, *quiet)]
    if not cuts:
        cutter.refuse_none(used, gestures)
    return replace(assemble(cuts, gestures, dataset), left_out=(*left_out, *cutter.left_out))


def _evenly(places: Sequence[tuple[RecordingInfo, _Place]], most: int) -> list[tuple[RecordingInfo, _Place]]:
    """Return at most ``most`` of the places, evenly spaced."""
    if len(places) <= most:
        return list(places)
    return [places[at] for at in (np.arange(max(0, most)) * len(places) // max(1, most)).tolist()]


def _positions(
    dataset: Dataset, stream: StreamInfo, used: Sequence[RecordingInfo], reach: int, spec: AnywhereSpec
) -> tuple[list[tuple[RecordingInfo, _Place]], list[_Place]]:
    """Return the positions of a stream in recordings, with the recording, and those outside to use as idle."""
    mine = [r for r in used if r.stream == stream.id and r.stream_row >= 0]
    chosen = {r.id for r in mine}
    barred = [r for r in dataset.recordings if r.stream == stream.id and r.stream_row >= 0 and r.id not in chosen]
    stretches = [s for s in dataset.stretches if s.stream == stream.id]
    held: list[tuple[RecordingInfo, _Place]] = []
    free: list[_Place] = []
    lively: list[float] = []
    segments = SessionReader(dataset).stream(stream.id)
    whole = [network_inputs(segment.data, dataset.layout) for segment in segments]
    spread = np.std(np.concatenate(whole), axis=0) if whole else np.zeros(0)
    for segment, x in zip(segments, whole, strict=True):
        if len(segment) < reach:
            continue
        labels = position_labels(segment, mine, barred, dataset.layout.rate_hz, spec, stretches)
        moved = _moved(x, dataset.layout.samples(_LIVELY_S), spread)
        for at in range(reach, len(x) + 1, dataset.layout.samples(spec.every_s)):
            if labels[at] >= 0:
                held.append((mine[labels[at]], _Place(x, segment, at)))
            elif labels[at] in (FREE, IDLE):
                free.append(_Place(x, segment, at))
                # Positions that are labelled as idle are kept, however much the signals move.
                lively.append(float(moved[at - 1]) if labels[at] == FREE else -np.inf)
    unsure = int(np.isfinite(lively).sum())
    quietest = np.sort(np.argsort(lively, kind="stable")[: len(free) - round(spec.busy_share * unsure)])
    return held, [free[at] for at in quietest.tolist()]


def position_labels(
    segment: Segment,
    used: Sequence[RecordingInfo],
    barred: Sequence[RecordingInfo],
    rate_hz: float,
    spec: AnywhereSpec,
    stretches: Sequence[LabelledStretch] = (),
) -> NDArray[np.int64]:
    """Return the label of each position of a segment, (n + 1,): an index into ``used``, `FREE`, `IDLE` or `NOTHING`.

    Args:
        used: recordings of the stream whose gesture is a class; only their rows after trimming are labelled.
        barred: the other recordings of the stream; all their rows become `NOTHING`.
        stretches: labelled stretches of the stream; `FREE` positions become `NOTHING` in practised gestures and until
            they have settled, and `IDLE` in the others.
    """
    labels = np.full(len(segment) + 1, FREE, dtype=np.int64)
    onset, after, settle = (round(s * rate_hz) for s in (spec.onset_s, spec.after_s, spec.settle_s))

    def samples(first: int, last: int) -> tuple[int, int]:
        begin, end = np.searchsorted(segment.row_of, (first, last), side="left")
        return int(begin), int(end)

    def rows(recording: RecordingInfo) -> tuple[int, int]:
        return recording.stream_row + recording.start, recording.stream_row + recording.stop

    spans = [(number, *samples(*rows(r))) for number, r in enumerate(used)]
    spans = [(number, begin, end) for number, begin, end in spans if end > begin]
    # A position is a number of samples: the first ``begin`` are before the recording, the first ``end`` include it.
    for _, _, end in spans:
        labels[end + 1 : end + settle + 1] = NOTHING
    for number, _, end in spans:
        labels[end + 1 : end + after + 1] = number
    for number, begin, end in spans:
        inside = labels[begin + 1 : end + 1]
        claimed = np.zeros(len(inside), dtype=bool)
        for other, first, last in spans:
            if other != number:
                claimed[max(0, first - begin) : max(0, last - begin)] = True
        inside[:] = np.where(claimed, NOTHING, number)
    for _, begin, _ in spans:
        labels[begin + 1 : begin + onset] = NOTHING
    for r in barred:
        begin, end = samples(r.stream_row, r.stream_row + r.rows)
        if end > begin:
            labels[begin + 1 : end + settle + 1] = NOTHING
    # The last pass is for practice, since a gesture may still be settling where a stretch at rest begins.
    for stretch in sorted(stretches, key=lambda s: bool(s.gesture)):
        begin, end = samples(stretch.start, stretch.stop)
        if end > begin:
            positions = labels[begin + 1 : end + (settle if stretch.gesture else 0) + 1]
            positions[positions < NOTHING] = NOTHING if stretch.gesture else IDLE
    return labels


def _moved(x: NDArray[np.int64], samples: int, usual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the movement (T,): standard deviation in the last ``samples``, relative to ``usual`` (F,), averaged."""
    values = x - x.mean(axis=0)
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    squares = np.vstack([np.zeros(values.shape[1]), np.cumsum(values**2, axis=0)])
    last = np.arange(1, len(x) + 1)
    first = np.maximum(last - samples, 0)
    n = (last - first)[:, None]
    variance = (squares[last] - squares[first]) / n - ((sums[last] - sums[first]) / n) ** 2
    spread = np.sqrt(np.maximum(variance, 0.0))
    return np.asarray((spread / np.where(usual > 0, usual, 1.0)).mean(axis=1))
