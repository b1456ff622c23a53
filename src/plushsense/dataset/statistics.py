"""Compute statistics of a data set: durations by gesture and group of people.

Durations have the statistics of the authors' ``b_training_data_analysis.m``: mean, median, variance and range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.gestures import NOBODY
from plushsense.dataset.quality.measurements import NEVER_STOPPED_FACTOR
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

    Recordings without a rate (one row) are left out.

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
            SummaryStatistics.of([r.whole_seconds for r in recordings]),
            SummaryStatistics.of([r.seconds for r in recordings]),
            SummaryStatistics.of([r.rows for r in recordings]),
            SummaryStatistics.of([r.stop - r.start for r in recordings]),
        )
        for (gesture, group_name), recordings in sorted(
            cells.items(), key=lambda cell: (_class_order(dataset, cell[0][0]), cell[0])
        )
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
        seconds = np.array(list(groups[gesture].values()))
        mean = float(seconds[seconds <= NEVER_STOPPED_FACTOR * np.median(seconds)].mean())
        statistics = SummaryStatistics.of(seconds.tolist())
        bands.append(DurationBand(gesture, groups[gesture], statistics, mean, mean * (1 - share), mean * (1 + share)))
    return bands


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
