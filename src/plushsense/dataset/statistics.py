"""Compute statistics of a data set: durations by gesture and group of people, and channel values by gesture.

Durations have the statistics of the authors' ``b_training_data_analysis.m``: mean, median, variance and range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import PEOPLE, UNKNOWN_SUBJECT, Dataset, PersonInfo, RecordingInfo, read_people

NOT_GIVEN = "not said"


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
    """Durations of one gesture in one group of people ("" for all), before and after trimming.

    ``before_s`` and ``after_s`` are in seconds (variance in s²), ``before_rows`` and ``after_rows`` in rows.
    ``recordings`` and ``people`` are counts, ``trimmed`` is the number of recordings that a mark shortens.
    """

    gesture: str
    group: str
    recordings: int
    people: int
    trimmed: int
    before_s: SummaryStatistics
    after_s: SummaryStatistics
    before_rows: SummaryStatistics
    after_rows: SummaryStatistics


def duration_table(dataset: Dataset, by: str | None = None) -> list[Duration]:
    """Return the durations of the used recordings, one entry for each gesture and group of people.

    Seconds are rows divided by the measured rate of the recording; recordings without a rate (one row) are left out.

    Args:
        by: the column of subjects.csv to group by (age_group, gender or a user-defined one), or ``subject``.

    Raises:
        DatasetError: for a column that subjects.csv does not have.
    """
    group = _grouping(dataset, by.casefold() if by else "")
    cells: dict[tuple[str, str], list[RecordingInfo]] = {}
    for r in dataset.used:
        if r.rate_hz > 0:
            cells.setdefault((r.gesture, group(r.subject)), []).append(r)
    return [
        Duration(
            gesture,
            group_name,
            len(recordings),
            len({r.subject for r in recordings} - {NOBODY, UNKNOWN_SUBJECT}),
            sum(r.stop - r.start < r.rows for r in recordings),
            SummaryStatistics.of([r.rows / r.rate_hz for r in recordings]),
            SummaryStatistics.of([(r.stop - r.start) / r.rate_hz for r in recordings]),
            SummaryStatistics.of([r.rows for r in recordings]),
            SummaryStatistics.of([r.stop - r.start for r in recordings]),
        )
        for (gesture, group_name), recordings in sorted(
            cells.items(), key=lambda cell: (_class_order(dataset, cell[0][0]), cell[0])
        )
    ]


def _class_order(dataset: Dataset, gesture: str) -> int:
    """Return the class index; labels that the gesture set does not contain come last."""
    labels = dataset.gestures.labels
    return labels.index(gesture) if gesture in labels else len(labels)


def _grouping(dataset: Dataset, by: str) -> Callable[[str], str]:
    """Return a function that maps a person to the group in the column ``by`` of subjects.csv ("" if ``by`` is "")."""
    people = read_people(dataset.path) if by not in ("", "subject") else {}
    if by not in ("", "subject"):
        if not people:
            raise DatasetError(
                f"'{dataset.path}' has no {PEOPLE}: write one there with the columns subject,age_group,gender."
            )
        columns = {"age_group", "gender", *(key for p in people.values() for key in p.more)}
        if by not in columns:
            raise DatasetError(
                f"{PEOPLE} of '{dataset.head.name}' has no column '{by}': it has subject, "
                f"{', '.join(sorted(columns))}.{nearest(by, columns)}"
            )

    def group(subject: str) -> str:
        if not by:
            return ""
        if subject in (NOBODY, UNKNOWN_SUBJECT):
            return "nobody" if subject == NOBODY else NOT_GIVEN
        if by == "subject":
            return subject
        person = people.get(subject, PersonInfo(subject))
        return str((vars(person) | person.more).get(by) or NOT_GIVEN)

    return group


@dataclass(frozen=True)
class ChannelSummary:
    """Mean and standard deviation of one channel during one gesture, over all valid rows, in the raw unit."""

    gesture: str
    channel: str
    unit: str
    rows: int
    mean: float
    sd: float


def channel_table(dataset: Dataset) -> list[ChannelSummary]:
    """Compute mean and standard deviation of each channel by gesture, over the used recordings after trimming.

    This reads every recording. Values outside a channel's valid range are left out. All rows have equal weight, so a
    recording that was never stopped dominates.
    """
    layout = dataset.layout
    steps = np.array([c.step for c in layout.channels])
    sums: dict[str, NDArray[np.float64]] = {}
    for r in sorted(dataset.used, key=lambda r: (r.stream, r.id)):
        raw = dataset.read(r).values
        valid = (raw >= layout.valid_min_int) & (raw <= layout.valid_max_int)
        x = np.where(valid, raw * steps, 0.0)
        part = np.stack([valid.sum(axis=0), x.sum(axis=0), (x * x).sum(axis=0)])
        sums[r.gesture] = sums[r.gesture] + part if r.gesture in sums else part
    out = []
    for gesture in sorted(sums, key=lambda label: (_class_order(dataset, label), label)):
        count, total, squares = sums[gesture]
        mean = total / np.maximum(count, 1)
        sd = np.sqrt(np.maximum(squares / np.maximum(count, 1) - mean**2, 0.0))
        out += [
            ChannelSummary(gesture, c.name, c.unit, int(count[i]), float(mean[i]), float(sd[i]))
            for i, c in enumerate(layout.channels)
            if count[i]
        ]
    return out
