"""Label the rows of a table by a file beside it that has the start, the end and the label of intervals of time."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError
from plushsense.dataset.importing.pattern import INTERVAL_COLUMNS, LABELS, ROLES, UNITS, ImportPattern
from plushsense.dataset.importing.table_files import ImportedColumns, date_ms, unit_in_name

# BIDS measures onsets in seconds from the first sample.
_ONSET = "onset"


@dataclass(frozen=True)
class IntervalFile:
    """Intervals of one file, in the order of their starts.

    Attributes:
        name: name of the file in messages.
        place: parts of its path.
        start: start of each interval (N,), in units of ``unit``.
        end: end of each interval (N,).
        labels: label of each interval.
        unit: unit of the times, "" if it is that of the clock of the samples.
        of_first_sample: whether times are surely counted from the first sample.
    """

    name: str
    place: Mapping[str, str]
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    labels: list[str]
    unit: str
    of_first_sample: bool

    def fits(self, place: Mapping[str, str]) -> bool:
        """Return whether a path with the parts ``place`` has no other parts than this file."""
        return all(place[part] == text for part, text in self.place.items() if part in place)


def interval_columns(names: Sequence[str], given: Mapping[str, str] | None = None) -> dict[str, int]:
    """Return the index of ``start``, ``end`` or ``duration``, and ``label`` in the names of columns.

    Returns nothing unless there are a start, an end or a duration, and a label.
    """
    plain = [name.strip().casefold() for name in names]
    bare = [name.removesuffix(f"_{unit_in_name(name)}") for name in plain]
    found: dict[str, int] = {}
    for role, known in (INTERVAL_COLUMNS | {"label": (*ROLES["label"], *LABELS)}).items():
        wanted = ((given or {}).get(role, "").strip().casefold(),) if role in (given or {}) else known
        at = next((k for name in wanted for k, own in enumerate(zip(plain, bare, strict=True)) if name in own), None)
        if at is not None:
            found[role] = at
    return found if {"start", "label"} <= set(found) and {"end", "duration"} & set(found) else {}


def read_intervals(path: Path, name: str, pattern: ImportPattern, place: Mapping[str, str]) -> IntervalFile:
    """Read the intervals of a table of text with a header.

    Raises:
        FileFormatError: for a table without the columns or without an interval.
    """
    try:
        lines = path.read_text(encoding=pattern.text_encoding).splitlines()
    except UnicodeError:
        raise FileFormatError(f"'{name}' is not {pattern.encoding.upper()}: save it as UTF-8") from None
    separator = max(",;\t", key=lines[0].count) if lines else ","
    header, *rows = list(csv.reader(lines, delimiter=separator)) or [[]]
    at = interval_columns(header, pattern.columns)
    if not at:
        listed = ", ".join(text.strip()[:30] for text in header[:20])
        raise FileFormatError(
            f"'{name}' has no intervals: it needs columns start, end (or duration) and label, which [columns] of the "
            f"pattern can name; it has {listed}"
        )
    unit = unit_in_name(header[at["start"]]) or ("s" if header[at["start"]].strip().casefold() == _ONSET else "")
    found = []
    for row in (row for row in rows if len(row) == len(header)):
        start, is_date = _moment(row[at["start"]], pattern)
        last, _ = _moment(row[at["end"] if "end" in at else at["duration"]], pattern)
        end = last if "end" in at else start + last
        unit = "ms" if is_date else unit
        if isfinite(start) and isfinite(end) and end > start:
            found.append((start, end, row[at["label"]].strip()))
    if not found:
        raise FileFormatError(f"'{name}' has no interval whose end is after its start")
    found.sort()
    return IntervalFile(
        name,
        place,
        np.array([start for start, _, _ in found]),
        np.array([end for _, end, _ in found]),
        [label for _, _, label in found],
        unit,
        header[at["start"]].strip().casefold() == _ONSET,
    )


def _moment(text: str, pattern: ImportPattern) -> tuple[float, bool]:
    """Return the number in a cell, or the milliseconds of a date, and whether it is a date; NaN for anything else."""
    with contextlib.suppress(ValueError):
        return float(text.replace(",", ".") if pattern.decimal == "," else text), False
    return date_ms(text), True


def label_rows(
    columns: ImportedColumns, clock_ms: NDArray[np.float64], intervals: IntervalFile, factor: float
) -> tuple[ImportedColumns, list[str]]:
    """Return ``columns`` with the label of the interval of each row, "" between intervals, and notes.

    Args:
        clock_ms: time of each row (T,).
        factor: milliseconds in a unit of the clock of the samples.
    """
    scale = UNITS[intervals.unit] if intervals.unit else factor
    start, end = intervals.start * scale, intervals.end * scale
    known = clock_ms[np.isfinite(clock_ms)]
    first, last = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    slack = 0.01 * (last - first)
    inside = [int(np.sum((start + add >= first - slack) & (end + add <= last + slack))) for add in (0.0, first)]
    notes = []
    if first and (intervals.of_first_sample or inside[1] > inside[0]):
        start, end = start + first, end + first
        notes.append(f"the times in '{intervals.name}' are counted from the first row")
    labels = np.zeros(len(clock_ms), dtype=np.int64)
    for k, (a, b) in enumerate(zip(start, end, strict=True), 1):
        labels[(clock_ms >= a) & (clock_ms < b)] = k
    notes += _doubts(intervals, start, end, labels)
    texts = ["", *intervals.labels]
    parts = {"label": [texts[k] for k in labels], "recording": [str(k) for k in labels]}
    names = columns.names | {"label": f"label in {intervals.name}", "recording": f"row of {intervals.name}"}
    return replace(columns, names=names, texts=columns.texts | parts), notes


def _doubts(
    intervals: IntervalFile, start: NDArray[np.float64], end: NDArray[np.float64], labels: NDArray[np.int64]
) -> Iterator[str]:
    without = len(start) - len(set(labels.tolist()) - {0})
    if without:
        yield f"{without} of {len(start)} intervals in '{intervals.name}' have no row of their own"
    if overlapping := int(np.sum(start[1:] < end[:-1])):
        yield f"{overlapping} intervals in '{intervals.name}' overlap the one before, which ends where they begin"
