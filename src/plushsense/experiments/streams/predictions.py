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
        known: the gestures of the data set.
        streams: the streams that may be named.
        alone: the stream of all rows, if the file has no column for it.

    Raises:
        FileFormatError: for the first row that cannot be used, with its line.
    """
    place = Path(path)
    try:
        columns, rows = read_csv_rows(place, "predictions")
    except FileNotFoundError:
        raise FileFormatError(f"There is no file '{place}': give a CSV file of predictions.") from None
    accepted = EVENT_COLUMNS if "stop" in columns else DECISION_COLUMNS
    for name in ("t", "label"):
        if name not in columns:
            there = f"it has {', '.join(columns)}" if any(columns) else "it is empty"
            raise FileFormatError(
                f"'{place}' has no column '{name}' ({there}): give a header with t and label, and if needed "
                f"{', '.join(c for c in EVENT_COLUMNS if c not in ('t', 'label'))}."
            )
    for name in columns:
        if name not in accepted:
            raise FileFormatError(
                f"'{place}' has an unknown column '{name}': accepted are {', '.join(DECISION_COLUMNS)}, and for events "
                f"stop, affect and named.{nearest(name, EVENT_COLUMNS)}"
            )
    if not rows:
        raise FileFormatError(
            f"'{place}' has no rows below its header: give a row for each decision or event, and for a stream without "
            "events one with an empty label."
        )
    reader = _RowReader(str(place), columns, gestures, known, streams, alone)
    by_stream: dict[str, list[Prediction]] = {}
    for line, cells in rows:
        stream, row = reader.read(line, cells)
        mine = by_stream.setdefault(stream, [])
        if row is None:
            continue
        if not reader.are_events and mine and row.event.start_s <= mine[-1].event.start_s:
            raise FileFormatError(
                f"'{place}' line {line}: t is {cells['t']}, which is not after line {mine[-1].line} of stream "
                f"'{stream}': sort the rows of each stream by t, with one row a decision."
            )
        mine.append(row)
    return StreamPredictions(str(place), by_stream, reader.are_events, reader.scored)


class _RowReader:
    """Converts the cells of a row; messages name the file and the line."""

    def __init__(
        self,
        file: str,
        columns: Sequence[str],
        gestures: GestureSet,
        known: GestureSet,
        streams: Sequence[StreamInfo],
        alone: str | None,
    ) -> None:
        self._file, self._gestures, self._known, self._streams, self._alone = file, gestures, known, streams, alone
        self.are_events, self.scored = "stop" in columns, "score" in columns
        self._stream_column = next((c for c in ("stream", "subject") if c in columns), None)
        self._classes: dict[str, int] = {}
        self._ids: dict[str, str] = {}

    def read(self, line: int, cells: Mapping[str, str]) -> tuple[str, Prediction | None]:
        """Return the stream of a row and its prediction, or None for an event that is none."""
        where = f"'{self._file}' line {line}"
        stream = self._stream(cells.get(self._stream_column or "", ""), where)
        start_s = _number(cells, "t", where, "seconds since the first frame of the stream", 0.0)
        stop_s = _number(cells, "stop", where, "seconds, at least t", start_s) if self.are_events else start_s
        named_s = start_s
        if cells.get("named"):
            named_s = _number(cells, "named", where, "seconds from t to stop", start_s, stop_s)
        gesture = self._gesture(cells["label"], where)
        score = 1.0
        if self.scored and (gesture != NO_GESTURE or cells["score"]):
            score = _number(cells, "score", where, "0 to 1", 0.0, 1.0)
        affect = self._affect(cells.get("affect", ""), gesture, where)
        if self.are_events and gesture == NO_GESTURE and affect is None:
            return stream, None
        return stream, Prediction(line, ReportedEvent(start_s, stop_s, gesture, named_s, affect or 0, CNN), score)

    def _stream(self, name: str, where: str) -> str:
        if name not in self._ids:
            self._ids[name] = self._find_stream(name, where)
        return self._ids[name]

    def _find_stream(self, name: str, where: str) -> str:
        ids = [s.id for s in self._streams]
        if self._stream_column is None:
            if self._alone is None:
                raise FileFormatError(
                    f"'{self._file}' has no column 'stream', but several streams are scored: add one with their ids "
                    f"({shortened(ids)}), or name a single person with --subjects."
                )
            return self._alone
        if self._stream_column == "stream":
            if name not in ids:
                raise FileFormatError(
                    f"{where}: there is no stream '{name}' with a recording in it; accepted are {shortened(ids)}."
                    f"{nearest(name, ids)}"
                )
            return name
        theirs = [s.id for s in self._streams if s.subject == name]
        if len(theirs) != 1:
            people = list(dict.fromkeys(s.subject for s in self._streams))
            problem = f"has {len(theirs)} streams ({shortened(theirs)})" if theirs else "has no stream"
            advice = "add a column 'stream'" if theirs else f"accepted are {shortened(people)}"
            raise FileFormatError(f"{where}: subject '{name}' {problem}: {advice}.{nearest(name, people)}")
        return theirs[0]

    def _gesture(self, label: str, where: str) -> int:
        if label not in self._classes:
            self._classes[label] = self._find_class(label, where)
        return self._classes[label]

    def _find_class(self, label: str, where: str) -> int:
        """Return the class index of a label, or `NO_GESTURE` for one that means that nothing happens."""
        found = self._gestures.find(label) or self._known.find(label)
        if not label or (found is not None and found.idle):
            return NO_GESTURE
        if found in self._gestures.gestures:
            return self._gestures.gestures.index(found)
        if found is not None:
            raise FileFormatError(
                f"{where}: '{label}' is a gesture of the data set, but not one of the classes that are scored, "
                f"{', '.join(self._gestures.labels)}: choose others with --classes, such as --classes all, or leave "
                "the label empty."
            )
        raise FileFormatError(
            f"{where}: there is no gesture '{label}' in the data set; accepted are {', '.join(self._known.labels)}, "
            f"or nothing.{nearest(label, self._known.labels)}"
        )

    def _affect(self, text: str, gesture: int, where: str) -> int | None:
        """Return the code of an affect; without ``text`` that of the gesture, or None if there is none."""
        if text:
            try:
                return AFFECT_CODES[text]
            except KeyError:
                raise FileFormatError(
                    f"{where}: affect is '{text}': accepted are {', '.join(AFFECTS)}.{nearest(text, AFFECTS)}"
                ) from None
        return None if gesture == NO_GESTURE else AFFECT_CODES[self._gestures.affects[gesture]]


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
