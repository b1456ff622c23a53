"""What really happened in a session's stream: the recordings that are located in it, or its runs of labels.

Time is that of `plushsense.live.trace`: seconds since the stream's first frame, going on over a reset of the clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.recfile import Frames
from plushsense.dataset.quality import NEVER_STOPPED_FACTOR
from plushsense.dataset.store import RECORDINGS, UNKNOWN_SUBJECT, Dataset, RecordingInfo, StreamInfo
from plushsense.scoring.events import Interval

Stretch = tuple[float, float]


@dataclass(frozen=True)
class StreamTruth:
    """One stream: ``truths`` are its gestures, idle ones are ``rest``, gestures that the model does not know
    ``other``. ``doubtful`` are recordings that a mark excludes or that nobody stopped: what happens there is not
    counted at all. ``labelled``: every sample has a label, so that nothing happened unseen.
    """

    stream: str
    subject: str
    labelled: bool
    truths: tuple[Interval, ...]
    rest: tuple[Stretch, ...]
    other: tuple[Stretch, ...]
    doubtful: tuple[Stretch, ...]


def row_times_s(frames: Frames, period_us: int) -> NDArray[np.float64]:
    """(T,) seconds of every row as a `plushsense.live.trace.Trace` counts them."""
    ms = frames.device_ms.astype(np.int64)
    if not len(ms):
        return np.zeros(0)
    step = np.diff(ms)
    # The clock that was set back goes on one sample after the last.
    step_us = np.where(step < 0, period_us, step * 1000)
    return np.asarray(np.concatenate([[0], np.cumsum(step_us)]) / 1e6)


def usual_rows(dataset: Dataset) -> dict[str, float]:
    """Of each gesture the median number of rows, by which `truth_of` knows a recording that nobody stopped."""
    rows: dict[str, list[int]] = {}
    for r in dataset.used:
        rows.setdefault(r.gesture, []).append(r.stop - r.start)
    return {gesture: float(np.median(found)) for gesture, found in rows.items()}


def truth_of(
    dataset: Dataset, stream: StreamInfo, frames: Frames, gestures: GestureSet, usual: dict[str, float]
) -> StreamTruth:
    """What happened in ``stream``, whose rows are ``frames``, in the words of a model's ``gestures``."""
    times = row_times_s(frames, dataset.layout.period_us)
    truths: list[Interval] = []
    rest: list[Stretch] = []
    other: list[Stretch] = []
    doubtful: list[Stretch] = []
    for r in located(dataset, stream):
        first = r.stream_row + r.start
        last = min(r.stream_row + r.stop, len(times)) - 1
        if last <= first:
            continue
        stretch = (float(times[first]), float(times[last]))
        gesture = gestures.find(r.gesture)
        if r.excluded or _never_stopped(r, usual):
            doubtful.append(stretch)
        elif gesture is None:
            known = dataset.gestures.find(r.gesture)
            (rest if known is not None and known.idle else other).append(stretch)
        elif gesture.idle:
            rest.append(stretch)
        else:
            truths.append(Interval(*stretch, gesture.label))
    return StreamTruth(
        stream.id, stream.subject, dataset.layout.is_labelled, tuple(truths), tuple(rest), tuple(other), tuple(doubtful)
    )


def located(dataset: Dataset, stream: StreamInfo) -> list[RecordingInfo]:
    """The recordings that lie in a stream, in its order."""
    mine = [r for r in dataset.recordings if r.stream == stream.id and r.stream_row >= 0]
    return sorted(mine, key=lambda r: r.stream_row)


def streams_of(dataset: Dataset, subjects: Sequence[str]) -> list[StreamInfo]:
    """The streams of some people in which there is any recording."""
    with_truth = {r.stream for r in dataset.recordings if r.stream_row >= 0}
    return [s for s in dataset.streams if s.subject in subjects and s.id in with_truth]


def people_with_streams(dataset: Dataset) -> list[str]:
    """Whose streams can be scored, sorted: nobody and the unknown are not people."""
    with_truth = {r.stream for r in dataset.recordings if r.stream_row >= 0}
    return sorted({s.subject for s in dataset.streams if s.id in with_truth} - {NOBODY, UNKNOWN_SUBJECT})


def _never_stopped(r: RecordingInfo, usual: dict[str, float]) -> bool:
    # Runs of labels are as long as they are.
    own_file = r.file.startswith(f"{RECORDINGS}/")
    return own_file and r.stop - r.start > NEVER_STOPPED_FACTOR * usual.get(r.gesture, float("inf"))
