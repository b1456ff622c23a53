"""Label stretches of streams by marks: practised gestures, handling of the toy, and rest; read and write them as CSV.

`relabel_recordings` states by a mark that another gesture was made than a recording is named after.

Times are in seconds of the device clock since the first frame of the stream (`row_times_s`). Rows of located recordings
need no label: they keep the gesture of the recording, whatever the marks say (`Dataset.stretches`).
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.files import check_output_file, write_file
from plushsense.dataset.index import as_dataset
from plushsense.dataset.marks import (
    HANDLING,
    PRACTICE,
    REST,
    LabelledStretch,
    Mark,
    MarkState,
    match_ids,
    read_marks,
)
from plushsense.dataset.quality.checking import author_name
from plushsense.dataset.store import Dataset, StreamInfo, read_csv_rows
from plushsense.dataset.trimming import row_times_s

COLUMNS = {
    "stream": "id of the stream, such as P01/fulldatastream; must be there, as the others",
    "start_s": "first second of the stretch, counted from the first frame of the stream",
    "stop_s": "second at which it ends",
    "label": "what happens: practice:GESTURE, handling (the toy is picked up, turned, put down) or rest",
}


@dataclass(frozen=True)
class TimedStretch:
    """A labelled stretch in seconds since the first frame of its stream."""

    stream: str
    start_s: float
    stop_s: float
    label: str


def check_label(dataset: Dataset, label: str) -> str:
    """Return ``label`` with the gesture as the data set writes it.

    Raises:
        DatasetError: for a label that is not handling, rest, or practice: and a gesture of the data set.
    """
    word, colon, gesture = label.strip().partition(":")
    kind = word.strip().casefold()
    if kind in (HANDLING, REST) and not colon:
        return kind
    if kind + colon == PRACTICE and (found := dataset.gestures.find(gesture.strip())) is not None:
        return PRACTICE + found.label
    known = [HANDLING, REST, *(PRACTICE + each for each in dataset.gestures.labels)]
    raise DatasetError(
        "The label '{label}' is unknown: accepted are {handling}, {rest}, and {practice} with a gesture of "
        "'{dataset}', such as '{known}'.{hint}",
        label=label,
        handling=HANDLING,
        rest=REST,
        practice=PRACTICE,
        dataset=dataset.head.name,
        known=known[-1],
        hint=nearest(label, known),
    )


def find_streams(dataset: Dataset, pattern: str = "*") -> list[StreamInfo]:
    """Return the streams that ``pattern`` (an id, or with ``*`` and ``?``) matches.

    Raises:
        DatasetError: if there is none, or every row of the streams already has a label.
    """
    if dataset.layout.is_labelled:
        raise DatasetError(
            "The streams of '{dataset}' have a label on every row (layout '{layout}'): nothing between the "
            "recordings is left to label.",
            dataset=dataset.head.name,
            layout=dataset.layout.name,
        )
    if not dataset.streams:
        raise DatasetError(
            "'{dataset}' has no streams: labels are for streams, between the recordings.", dataset=dataset.head.name
        )
    ids = {s.id: s for s in dataset.streams}
    return [ids[identity] for identity in match_ids(pattern, ids, "stream")]


def _one_stream(dataset: Dataset, pattern: str) -> StreamInfo:
    (stream, *others) = find_streams(dataset, pattern)
    if others:
        raise DatasetError(f"'{pattern}' names {1 + len(others)} streams: give one.")
    return stream


def rows_between(stream: StreamInfo, seconds: NDArray[np.float64], start_s: float, stop_s: float) -> tuple[int, int]:
    """Return the rows of a stream from ``start_s`` to before ``stop_s``; ``seconds`` are its `row_times_s`.

    Raises:
        DatasetError: for times outside the stream, or without a row between them.
    """
    for value in (start_s, stop_s):
        if not 0.0 <= value <= seconds[-1] + 0.01:
            raise DatasetError(f"'{stream.id}' has no {value:g} s: it runs from 0 to {seconds[-1]:.3f} s.")
    # Allow half a millisecond, since displayed times are rounded to milliseconds.
    start, stop = (int(row) for row in np.searchsorted(seconds, (start_s - 5e-4, stop_s - 5e-4)))
    stop = min(stop, stream.rows)
    if stop <= start:
        raise DatasetError(f"'{stream.id}' has no row from {start_s:g} to {stop_s:g} s: label more.")
    return start, stop


def timed_stretches(dataset: Dataset, streams: Iterable[StreamInfo]) -> list[TimedStretch]:
    """Return the labelled stretches of ``streams`` in seconds."""
    out = []
    for stream in streams:
        if mine := [s for s in dataset.stretches if s.stream == stream.id]:
            seconds = row_times_s(dataset.read_stream(stream.id), dataset.layout.gap_ms).round(3)
            out += [TimedStretch(s.stream, float(seconds[s.start]), float(seconds[s.stop]), s.label) for s in mine]
    return out


def label_stretches(
    dataset: Dataset, stretches: Iterable[LabelledStretch], who: str | None = None, why: str = ""
) -> int:
    """Label stretches by marks, in their order; return how many the marks did not state already.

    Earlier labels of the same rows are replaced. ``dataset`` is not updated: open it again.

    Raises:
        DatasetError: for an unknown label or stream, or rows that do not exist. No mark is written then.
    """
    name, marks = author_name(who), []
    for s in stretches:
        (stream,) = find_streams(dataset, s.stream)
        if not 0 <= s.start < s.stop <= stream.rows:
            raise DatasetError(
                "'{stream}' has rows 0 to {rows}: {start} to {stop} cannot be labelled.",
                stream=s.stream,
                rows=stream.rows,
                start=s.start,
                stop=s.stop,
            )
        label = check_label(dataset, s.label)
        marks.append(Mark(stream.id, "label", name, why, start=s.start, stop=s.stop, label=label))
    return len(dataset.append_marks(marks))


def relabel_recordings(
    dataset: Dataset, recordings: Iterable[str], gesture: str, who: str | None = None, why: str = ""
) -> tuple[str, ...]:
    """State that ``gesture`` was made in ``recordings`` (ids or patterns); "" restores the recorded one.

    The raw files stay as they are. ``dataset`` is not updated: open it again.

    Returns:
        The ids of the recordings whose gesture changes.

    Raises:
        DatasetError: for a gesture that is not in the gesture set, or an unknown recording. No mark is written then.
    """
    return tuple(m.recording for m in dataset.append_marks(_relabelling(dataset, recordings, gesture, who, why)))


def _relabelling(dataset: Dataset, recordings: Iterable[str], gesture: str, who: str | None, why: str) -> list[Mark]:
    known = {r.id: r.recorded for r in dataset.recordings}
    found = dataset.gestures.find(gesture) if gesture else None
    if gesture and found is None:
        raise DatasetError(
            "'{dataset}' has no gesture '{gesture}': accepted are {labels}.{hint}",
            dataset=dataset.head.name,
            gesture=gesture,
            labels=", ".join(dataset.gestures.labels),
            hint=nearest(gesture, dataset.gestures.labels),
        )
    label, name = found.label if found is not None else "", author_name(who)
    return [
        Mark(identity, "relabel", name, why, gesture="" if label == known[identity] else label)
        for pattern in recordings
        for identity in match_ids(pattern, known, "recording")
    ]


def remove_labels(dataset: Dataset, stream: str, rows: tuple[int, int], who: str | None = None, why: str = "") -> int:
    """Remove the labels of ``rows`` (start, stop) of a stream; return the number of stretches that change."""
    start, stop = rows
    standing = read_marks(dataset.path).get(stream, MarkState()).stretches
    dataset.append_marks([Mark(stream, "unlabel", author_name(who), why, start=start, stop=stop)])
    return sum(s.outside(start, stop) != [s] for s in standing)


def read_stretches(dataset: Dataset, path: str | os.PathLike[str]) -> list[LabelledStretch]:
    """Read a CSV file with the columns `COLUMNS`.

    Raises:
        DatasetError: for a missing file or column, or a line with an unknown stream, label or time.
    """
    try:
        columns, rows = read_csv_rows(Path(path), "file of labels")
    except FileNotFoundError:
        raise DatasetError(f"There is no file '{path}': give a CSV file with {', '.join(COLUMNS)}.") from None
    if missing := [c for c in COLUMNS if c not in columns]:
        raise DatasetError(f"The file of labels '{path}' lacks {', '.join(missing)}: it needs {', '.join(COLUMNS)}.")
    out = []
    times: dict[str, NDArray[np.float64]] = {}
    for line, cells in rows:
        try:
            stream = _one_stream(dataset, cells["stream"])
            if stream.id not in times:
                times[stream.id] = row_times_s(dataset.read_stream(stream.id), dataset.layout.gap_ms)
            between = _seconds(cells["start_s"]), _seconds(cells["stop_s"])
            start, stop = rows_between(stream, times[stream.id], *between)
            out.append(LabelledStretch(stream.id, start, stop, check_label(dataset, cells["label"])))
        except DatasetError as cause:
            raise DatasetError(f"The file of labels '{path}' line {line}: {cause}") from None
    return out


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise DatasetError(f"'{text}' is no time: seconds are accepted, such as 12.5.") from None


def check_labels_path(path: str | os.PathLike[str]) -> None:
    """Raise DatasetError if labels cannot be written to a file, or would replace another kind of file."""
    check_output_file(Path(path), ",".join(COLUMNS), "a file of labels", DatasetError)


def write_stretches(path: str | os.PathLike[str], stretches: Sequence[TimedStretch]) -> None:
    """Write stretches as CSV with the columns `COLUMNS`, as `read_stretches` reads it.

    Raises:
        DatasetError: if the file exists and has no labels.
    """
    check_labels_path(path)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows((s.stream, f"{s.start_s:.3f}", f"{s.stop_s:.3f}", s.label) for s in stretches)
    write_file(Path(path), out.getvalue())


@dataclass(frozen=True)
class LabelResult:
    """Result of `decide_labels`.

    Attributes:
        stretches: the labelled stretches of all streams afterwards.
        labelled, undone: numbers of stretches that were labelled anew, and of those whose labels were removed.
        relabelled: ids of the recordings whose gesture changed.
    """

    dataset: Dataset
    stretches: tuple[TimedStretch, ...]
    labelled: int = 0
    undone: int = 0
    relabelled: tuple[str, ...] = ()


Seconds: TypeAlias = tuple[float | None, float | None]
"""Begin and end in seconds; None: the begin or the end of the stream."""


def decide_labels(
    dataset: Dataset | str | os.PathLike[str],
    *,
    label: Iterable[tuple[str, Seconds, str]] = (),
    unlabel: Iterable[tuple[str, Seconds]] = (),
    relabel: Iterable[tuple[str, str]] = (),
    file: str | os.PathLike[str] | None = None,
    who: str | None = None,
    why: str = "",
) -> LabelResult:
    """Write marks for the given decisions, and return the labelled stretches.

    Args:
        label: id of a stream, seconds, and what happens there: handling, rest, or practice: and a gesture.
        unlabel: id of a stream, or a pattern, and the seconds whose labels are removed.
        relabel: id of a recording, or a pattern, and the gesture that was made; "" restores the recorded one.
        file: a CSV file of stretches to label, see `read_stretches`.
        who, why: name (by default the login name) and reason for the marks.

    Raises:
        DatasetError: for an unknown stream, recording, label or gesture, or times outside the stream. No mark is
            written then.
    """
    dataset = as_dataset(dataset)
    new = read_stretches(dataset, file) if file is not None else []
    new += [
        LabelledStretch(*_rows_of(dataset, stream, times), check_label(dataset, name)) for stream, times, name in label
    ]
    removed = [_rows_of(dataset, s.id, times) for stream, times in unlabel for s in find_streams(dataset, stream)]
    changes = [mark for pattern, gesture in relabel for mark in _relabelling(dataset, [pattern], gesture, who, why)]
    labelled = label_stretches(dataset, new, who, why) if new else 0
    undone = sum(remove_labels(dataset, stream, (start, stop), who, why) for stream, start, stop in removed)
    changed = tuple(mark.recording for mark in dataset.append_marks(changes))
    again = as_dataset(dataset.path)
    streams = again.streams if not again.layout.is_labelled else []
    return LabelResult(again, tuple(timed_stretches(again, streams)), labelled, undone, changed)


def _rows_of(dataset: Dataset, stream: str, times: Seconds) -> tuple[str, int, int]:
    """Return the id of one stream and its rows between two times."""
    found = _one_stream(dataset, stream)
    seconds = row_times_s(dataset.read_stream(found.id), dataset.layout.gap_ms)
    start_s, stop_s = times
    start, stop = rows_between(
        found, seconds, 0.0 if start_s is None else start_s, float(seconds[-1]) if stop_s is None else stop_s
    )
    return found.id, start, stop
