"""Compute the durations of the gestures of a data set.

They have the statistics of the authors' ``b_training_data_analysis.m``: mean, median, variance and range.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.dataset.quality.comparisons import usual_seconds
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, RecordingInfo
from plushsense.recording.takes import duration_s


@dataclass(frozen=True)
class SummaryStatistics:
    """Summary of numbers; ``variance`` is the sample variance (divisor n − 1, as in MATLAB), None for one number."""

    mean: float
    median: float
    variance: float | None
    min: float
    max: float

    @classmethod
    def of(cls, numbers: Sequence[float]) -> SummaryStatistics:
        """Return the summary of at least one number."""
        x = np.asarray(numbers, dtype=np.float64)
        variance = float(x.var(ddof=1)) if len(x) > 1 else None
        return cls(float(x.mean()), float(np.median(x)), variance, float(x.min()), float(x.max()))


@dataclass(frozen=True)
class Duration:
    """Durations of one gesture, before and after trimming.

    ``before_s`` and ``after_s`` are in seconds (variance in s²), ``before_rows`` and ``after_rows`` in rows.
    ``recordings`` and ``people`` are counts, ``trimmed`` is the number of recordings that a mark shortens.
    """

    gesture: str
    recordings: int
    people: int
    trimmed: int
    before_s: SummaryStatistics
    after_s: SummaryStatistics
    before_rows: SummaryStatistics
    after_rows: SummaryStatistics


def duration_table(dataset: Dataset) -> list[Duration]:
    """Return the durations of the used recordings by gesture, in class order, without those of one row."""
    by_gesture: dict[str, list[RecordingInfo]] = {}
    for r in dataset.used:
        if r.rate_hz > 0:
            by_gesture.setdefault(r.gesture, []).append(r)
    order = sorted(by_gesture.items(), key=lambda item: (_class_order(dataset, item[0]), item[0]))
    return [
        Duration(
            gesture,
            len(recordings),
            len({r.subject for r in recordings} - {NOBODY, UNKNOWN_SUBJECT}),
            sum(r.stop - r.start < r.rows for r in recordings),
            SummaryStatistics.of([r.whole_seconds for r in recordings]),
            SummaryStatistics.of([r.seconds for r in recordings]),
            SummaryStatistics.of([r.rows for r in recordings]),
            SummaryStatistics.of([r.stop - r.start for r in recordings]),
        )
        for gesture, recordings in order
    ]


@dataclass(frozen=True)
class DurationBand:
    """Durations of the recordings of a gesture, and the band around their mean; outliers lie outside of it.

    ``seconds`` are the durations by recording id, in the order of recording. ``mean_s`` leaves out recordings that were
    never stopped, like the check ``duration``; ``statistics`` are of all.
    """

    gesture: str
    seconds: dict[str, float]
    statistics: SummaryStatistics
    mean_s: float
    low_s: float
    high_s: float

    @property
    def outliers(self) -> list[str]:
        """Ids of the recordings outside the band."""
        return [i for i, s in self.seconds.items() if not self.low_s <= s <= self.high_s]


def duration_bands(dataset: Dataset, share: float = 0.4) -> list[DurationBand]:
    """Return the durations of the used recordings after trimming by gesture, in class order.

    Args:
        share: half the height of the band, as a share of the mean (the paper: 0.4).
    """
    groups: dict[str, dict[str, float]] = {}
    for r in sorted(dataset.used, key=lambda r: (r.epoch_ms, r.id)):
        if r.rate_hz > 0:
            groups.setdefault(r.gesture, {})[r.id] = r.seconds
    bands = []
    for gesture in sorted(groups, key=lambda g: (_class_order(dataset, g), g)):
        seconds = list(groups[gesture].values())
        mean, statistics = usual_seconds(seconds), SummaryStatistics.of(seconds)
        bands.append(DurationBand(gesture, groups[gesture], statistics, mean, mean * (1 - share), mean * (1 + share)))
    return bands


def _class_order(dataset: Dataset, gesture: str) -> int:
    """Return the class index; labels that the gesture set does not contain come last."""
    labels = dataset.gestures.labels
    return labels.index(gesture) if gesture in labels else len(labels)


def median_gesture_s(dataset: Dataset, gestures: Iterable[str] | None = None) -> float | None:
    """Return the median duration of the used recordings in seconds, of all or some gestures; None without any."""
    chosen = None if gestures is None else set(gestures)
    seconds = [
        duration_s(r.stop - r.start, r.rate_hz or dataset.layout.rate_hz)
        for r in dataset.used
        if chosen is None or r.gesture in chosen
    ]
    return float(np.median(seconds)) if seconds else None


def fitting_window_s(usual_s: float) -> float:
    """Return the longest window in tenths of a second, from 0.5 s, that is no longer than the usual gesture."""
    return max(0.5, math.floor(10.0 * usual_s + 1e-6) / 10.0)
