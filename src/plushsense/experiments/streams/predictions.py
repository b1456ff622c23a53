"""The predictions of any system for whole streams, as a CSV file.

A file has a header, and one of two forms:

- *Decisions*: each row is one step of the system, with the time ``t`` and the ``label`` of its best gesture, in order
  of time. Successive rows with the same label and at least the threshold's score become one event, which begins at the
  first of them and ends at the last.
- *Events*, with a column ``stop``: each row is an event from ``t`` to ``stop``.

Times are in seconds since the first frame of the stream. An empty label, or that of an idle gesture, means that nothing
happens. ``score`` (0 to 1) is optional. ``stream`` is the id of the stream; instead, ``subject`` may name a person who
has one stream; neither is needed if only one stream is scored. For events there are two more optional columns:
``affect``, if it is not that of the label, for a system that reports an affect without or before a gesture; and
``named``, the time at which the label is reported, if it is later than ``t``.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from plushsense.core.errors import BadInput, FileFormatError, nearest
from plushsense.core.files import check_output_file, write_file
from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import StreamInfo, read_csv_rows
from plushsense.experiments.streams.replay import StreamEvents, StreamTruth
from plushsense.runtime.events import AFFECT_CODES, AFFECTS, CNN, NO_GESTURE
from plushsense.runtime.trace import ReportedEvent

EVENT_COLUMNS = {
    "t": "time of the decision, or of the beginning of the event, in seconds since the first frame; must be there",
    "stop": "time of the end of the event; with this column each row is an event, otherwise a decision",
    "label": "the best gesture; empty: nothing happens; must be there",
    "score": "how sure the system is, 0 to 1; without it, 1",
    "stream": "id of the stream; needed if several streams are scored",
    "subject": "instead of stream: the person, who has one stream",
    "affect": "only for events: affect, if it is not that of the label",
    "named": "only for events: time at which the label is reported, if it is later than t",
}
DECISION_COLUMNS = tuple(name for name in EVENT_COLUMNS if name not in ("stop", "affect", "named"))
_THRESHOLDS = 21
Entry = TypeVar("Entry")
# What a row names its stream by, and what to do about one that cannot be found.
_NAMED_BY = {"subject": ("person", ", who have one stream; name streams in a column 'stream'")}
# Times may exceed the end of the stream by this, as systems round them.
_ROUNDING_S = 0.1


@dataclass(frozen=True, slots=True)
class Prediction:
    """A predicted event with its score, and its line in the file; a decision begins and ends at the same time."""

    line: int
    event: ReportedEvent
    score: float


@dataclass(frozen=True)
class StreamPredictions:
    """The rows of a file by stream.

    Attributes:
        rows: in the order of the file; a stream in which nothing happens has none.
        are_events: whether rows are events; otherwise they are decisions.
        scored: whether there is a column ``score``; otherwise all scores are 1.
    """

    file: str
    rows: Mapping[str, Sequence[Prediction]]
    are_events: bool
    scored: bool

    def events(self, stream: str, threshold: float = 0.0) -> list[ReportedEvent]:
        """Return the events of a stream, of predictions whose score is at least ``threshold``."""
        rows = self.rows.get(stream, ())
        if self.are_events:
            return [row.event for row in rows if row.score >= threshold]
        events = []
        for gesture, run in itertools.groupby(
            rows, lambda row: row.event.gesture if row.score >= threshold else NO_GESTURE
        ):
            if gesture != NO_GESTURE:
                first, *others = (row.event for row in run)
                events.append(replace(first, stop_s=others[-1].start_s) if others else first)
        return events

    def thresholds(self) -> list[float]:
        """Return at most 21 scores, evenly spaced by rank, as the thresholds of a curve; none without scores."""
        named = (r for rows in self.rows.values() for r in rows if self.are_events or r.event.gesture != NO_GESTURE)
        scores = [row.score for row in named] if self.scored else []
        if not scores:
            return []
        at = np.linspace(0.0, 1.0, _THRESHOLDS)
        return [float(score) for score in np.unique(np.quantile(scores, at, method="lower"))]

    def check_ends(self, truths: Iterable[StreamTruth]) -> None:
        """Raise FileFormatError for a time after the end of its stream."""
        for truth in truths:
            for row in self.rows.get(truth.stream, ()):
                for name, time_s in (("t", row.event.start_s), ("stop", row.event.stop_s)):
                    if time_s > truth.stop_s + _ROUNDING_S:
                        raise FileFormatError(
                            f"'{self.file}' line {row.line}: {name} is {time_s:g}, but stream '{truth.stream}' ends "
                            f"after {truth.stop_s:.2f} s: give seconds since the first frame of the stream."
                        )


def _read_rows(place: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the columns of a file of predictions, and its rows with their lines."""
    try:
        columns, rows = read_csv_rows(place, "predictions")
    except FileNotFoundError:
        raise FileFormatError(f"There is no file '{place}': give a CSV file of predictions.") from None
    _check_columns(place, columns)
    if not rows:
        raise FileFormatError(
            f"'{place}' has no rows below its header: give a row for each decision or event, and for a stream without "
            "events one with an empty label."
        )
    return columns, rows


def read_predictions(
    path: str | os.PathLike[str],
    gestures: GestureSet,
    known: GestureSet,
    streams: Sequence[StreamInfo],
    alone: str | None = None,
) -> StreamPredictions:
    """Read a file of predictions.

    Args:
        gestures: the classes that are scored.
        known: the gestures of the data set, of which idle ones may be named, too.
        streams: the streams that may be named.
        alone: the stream of all rows, if the file has no column for it.

    Raises:
        FileFormatError: for the first row that cannot be used, with its line.
    """
    place = Path(path)
    columns, rows = _read_rows(place)
    column = next((c for c in ("stream", "subject") if c in columns), None)
    named = _streams_by(column, streams, alone, place)
    idle = {g.label: NO_GESTURE for g in (*known.gestures, *gestures.gestures) if g.idle}
    classes = {"": NO_GESTURE, **{label: k for k, label in enumerate(gestures.labels)}, **idle}
    are_events, scored = "stop" in columns, "score" in columns
    by_stream: dict[str, list[Prediction]] = {}
    for line, cells in rows:
        where = f"'{place}' line {line}"
        stream = _entry(named, cells.get(column or "", ""), where, *_NAMED_BY.get(column or "", ("stream",)))
        mine = by_stream.setdefault(stream, [])
        start_s = _number(cells, "t", where, "seconds since the first frame of the stream", 0.0)
        stop_s = _number(cells, "stop", where, "seconds, at least t", start_s) if are_events else start_s
        named_s = start_s
        if cells.get("named"):
            named_s = _number(cells, "named", where, "seconds from t to stop", start_s, stop_s)
        label = cells["label"]
        if label not in classes and (found := gestures.find(label) or known.find(label)) is not None:
            label = found.label
        gesture = _entry(classes, label, where, "scored gesture", ", or nothing; choose others with --classes")
        affect = 0 if gesture == NO_GESTURE else AFFECT_CODES[gestures.affects[gesture]]
        if cells.get("affect"):
            affect = _entry(AFFECT_CODES, cells["affect"], where, "affect")
        elif are_events and gesture == NO_GESTURE:
            continue
        score = 1.0
        if scored and (gesture != NO_GESTURE or cells["score"]):
            score = _number(cells, "score", where, "0 to 1", 0.0, 1.0)
        if not are_events and mine and start_s <= mine[-1].event.start_s:
            raise FileFormatError(
                f"{where}: t is {cells['t']}, which is not after line {mine[-1].line} of stream '{stream}': sort the "
                "rows of each stream by t, with one row a decision."
            )
        mine.append(Prediction(line, ReportedEvent(start_s, stop_s, gesture, named_s, affect, CNN), score))
    return StreamPredictions(str(place), by_stream, are_events, scored)


def _check_columns(place: Path, columns: Sequence[str]) -> None:
    for name in ("t", "label"):
        if name not in columns:
            there = f"it has {', '.join(columns)}" if any(columns) else "it is empty"
            raise FileFormatError(
                f"'{place}' has no column '{name}' ({there}): give a header with t and label, and if needed "
                f"{', '.join(c for c in EVENT_COLUMNS if c not in ('t', 'label'))}."
            )
    for name in columns:
        if name not in (EVENT_COLUMNS if "stop" in columns else DECISION_COLUMNS):
            raise FileFormatError(
                f"'{place}' has an unknown column '{name}': accepted are {', '.join(DECISION_COLUMNS)}, and for events "
                f"stop, affect and named.{nearest(name, EVENT_COLUMNS)}"
            )


def _streams_by(column: str | None, streams: Sequence[StreamInfo], alone: str | None, place: Path) -> dict[str, str]:
    """Return the id of each stream that a row may name by its text in ``column``: an id, or a person."""
    if column == "stream":
        return {s.id: s.id for s in streams}
    if column == "subject":
        people = [s.subject for s in streams]
        return {s.subject: s.id for s in streams if people.count(s.subject) == 1}
    if alone is None:
        raise FileFormatError(
            f"'{place}' has no column 'stream', but several streams are scored: add one with their ids "
            f"({shortened([s.id for s in streams])}), or name a single person with --subjects."
        )
    return {"": alone}


def _entry(table: Mapping[str, Entry], name: str, where: str, noun: str, advice: str = "") -> Entry:
    if name not in table:
        names = [one for one in table if one]
        raise FileFormatError(
            f"{where}: there is no {noun} '{name}'; accepted are {shortened(names)}{advice}.{nearest(name, names)}"
        )
    return table[name]


def shortened(names: Sequence[str]) -> str:
    """Join at most ten names."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def _number(
    cells: Mapping[str, str], name: str, where: str, accepted: str, low: float, high: float = math.inf
) -> float:
    try:
        value = float(cells[name])
    except ValueError:
        value = math.nan
    if not low <= value <= high or math.isinf(value):
        raise FileFormatError(f"{where}: {name} is '{cells[name]}': accepted are {accepted}, as a number such as 0.85.")
    return value


_EVENT_COLUMNS = ("stream", "t", "stop", "label", "named", "affect")


def check_events_path(path: str | os.PathLike[str]) -> None:
    """Raise BadInput if events cannot be written to a file, or would replace another kind of file."""
    check_output_file(Path(path), ",".join(_EVENT_COLUMNS), "a file of events", BadInput)


def write_events(path: str | os.PathLike[str], streams: Iterable[StreamEvents], gestures: GestureSet) -> None:
    """Write the events of streams as a file that `read_predictions` reads; a stream without events has one empty row.

    Raises:
        BadInput: if the file cannot be written, or is one of another kind.
    """
    check_events_path(path)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_EVENT_COLUMNS)
    for truth, events in streams:
        for e in events:
            label = "" if e.gesture == NO_GESTURE else gestures.labels[e.gesture]
            writer.writerow((truth.stream, e.start_s, e.stop_s, label, e.named_s, AFFECTS[e.affect]))
        if not events:
            writer.writerow((truth.stream, 0.0, truth.stop_s, "", "", ""))
    try:
        write_file(Path(path), out.getvalue())
    except OSError as cause:
        raise BadInput(
            f"The events cannot be written to '{path}' ({cause.strerror or cause}): give another file."
        ) from None
