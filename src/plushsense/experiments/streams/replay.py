"""The true gestures of whole streams, and scores of events against them.

The truth of a stream does not depend on a model. Streams are read once with a model, whose stored outputs then give the
events of any decision settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.marks import HANDLING, REST
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, RecordingInfo, StreamInfo
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import AFFECTS, NO_GESTURE
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.replay import TraceReplayer
from plushsense.runtime.trace import ReportedEvent, trace_of
from plushsense.scoring.events import (
    LATE_S,
    UNNAMED,
    ErrorCosts,
    Interval,
    Tallies,
    Tally,
    cost,
    outside_insertions,
    overlaps,
    pooled,
    tally,
    uncovered_s,
)
from plushsense.windows.clock import resample, row_times_us
from plushsense.windows.cut import recordings_in_time

Stretch = tuple[float, float]


@dataclass(frozen=True)
class StreamTruth:
    """The true intervals of one stream, in seconds since its first frame, and its length.

    ``truths`` are gestures that are classes, ``rest`` idle ones, ``other`` gestures that are not among the classes.
    ``doubtful`` are excluded recordings and those not stopped in time; events there are not counted. ``labelled`` tells
    whether every sample of the stream has a label. ``stop_s`` is the time of the last frame. ``hours`` are those
    without gaps and doubtful stretches, ``free_hours`` without true and practised gestures as well, ``rest_hours``
    those at rest, and ``known_hours`` those with a recording or a label.

    From the labels of stretches between recordings, ``practice`` are gestures that are classes, and ``handling`` is
    where the toy was picked up, turned or put down; rest and other gestures are in ``rest`` and ``other``.
    """

    stream: str
    subject: str
    labelled: bool
    truths: tuple[Interval, ...]
    rest: tuple[Stretch, ...]
    other: tuple[Stretch, ...]
    doubtful: tuple[Stretch, ...]
    stop_s: float
    hours: float
    free_hours: float
    rest_hours: float
    known_hours: float
    practice: tuple[Interval, ...] = ()
    handling: tuple[Stretch, ...] = ()


def truth_of(dataset: Dataset, stream: StreamInfo, frames: Frames, gestures: GestureSet) -> StreamTruth:
    """Return the true intervals of ``stream``, whose rows are ``frames``; ``gestures`` are the classes."""
    in_time = {r.id for r in recordings_in_time(dataset.used)}
    times = row_times_us(frames, dataset.layout) / 1e6
    truths: list[Interval] = []
    rest: list[Stretch] = []
    other: list[Stretch] = []
    doubtful: list[Stretch] = []
    practice: list[Interval] = []
    handling: list[Stretch] = []
    for r in located(dataset, stream):
        first = r.stream_row + r.start
        last = min(r.stream_row + r.stop, len(times)) - 1
        if last <= first:
            continue
        stretch = (float(times[first]), float(times[last]))
        gesture = gestures.find(r.gesture)
        if r.id not in in_time:
            doubtful.append(stretch)
        elif _is_idle(r.gesture, gestures, dataset.gestures):
            rest.append(stretch)
        elif gesture is None:
            other.append(stretch)
        else:
            truths.append(Interval(*stretch, gesture.label))
    for labelled in (s for s in dataset.stretches if s.stream == stream.id and s.stop - s.start > 1):
        stretch = (float(times[labelled.start]), float(times[labelled.stop - 1]))
        gesture = gestures.find(labelled.gesture)
        if labelled.label == HANDLING:
            handling.append(stretch)
        elif labelled.label == REST or _is_idle(labelled.gesture, gestures, dataset.gestures):
            rest.append(stretch)
        elif gesture is None:
            other.append(stretch)
        else:
            practice.append(Interval(*stretch, gesture.label))
    parts = [(float(times[s.first_row]), float(times[s.last_row - 1])) for s in resample(frames, dataset.layout)]
    marked = [(t.start_s, t.stop_s) for t in (*truths, *practice)]
    seconds, left = uncovered_s(parts, []), uncovered_s(parts, doubtful)
    return StreamTruth(
        stream.id,
        stream.subject,
        dataset.layout.is_labelled,
        tuple(truths),
        tuple(rest),
        tuple(other),
        tuple(doubtful),
        stop_s=float(times[-1]) if len(times) else 0.0,
        hours=left / 3600,
        free_hours=uncovered_s(parts, [*marked, *doubtful]) / 3600,
        rest_hours=(seconds - uncovered_s(parts, rest)) / 3600,
        known_hours=(left - uncovered_s(parts, [*marked, *rest, *other, *handling, *doubtful])) / 3600,
        practice=tuple(practice),
        handling=tuple(handling),
    )


def _is_idle(label: str, gestures: GestureSet, others: GestureSet) -> bool:
    """Return whether a gesture of a model, or else of the data set, is idle."""
    gesture = gestures.find(label) or others.find(label)
    return gesture is not None and gesture.idle


def located(dataset: Dataset, stream: StreamInfo) -> list[RecordingInfo]:
    """Return the recordings that lie in a stream, ordered by position."""
    mine = [r for r in dataset.recordings if r.stream == stream.id and r.stream_row >= 0]
    return sorted(mine, key=lambda r: r.stream_row)


def scored_streams(dataset: Dataset, subjects: Iterable[str]) -> list[StreamInfo]:
    """Return the streams of ``subjects`` that have a recording in them, person by person."""
    return [s for person in subjects for s in dataset.streams if s.subject == person and located(dataset, s)]


def people_with_streams(dataset: Dataset) -> list[str]:
    """Return the sorted codes of people with a recording in a stream, without `NOBODY` and `UNKNOWN_SUBJECT`."""
    with_truth = {r.stream for r in dataset.recordings if r.stream_row >= 0}
    return sorted({s.subject for s in dataset.streams if s.id in with_truth} - {NOBODY, UNKNOWN_SUBJECT})


# What an event is compared by: its gesture, the family, the affect, or only that there is an event.
LEVELS = ("gesture", "family", "affect", "anything")
PLACES = ("rest", "handling", "other", "unmarked")


@dataclass(frozen=True, eq=False)
class StreamTrace:
    """One stream with its truth and the stored outputs of a model."""

    truth: StreamTruth
    replayer: TraceReplayer


def read_streams(dataset: Dataset, model: Bundle | IntegerModel, subjects: Sequence[str]) -> list[StreamTrace]:
    """Run the model once over every stream of ``subjects`` that has a recording in it."""
    traces = []
    for stream in scored_streams(dataset, subjects):
        frames = dataset.read_stream(stream.id)
        truth = truth_of(dataset, stream, frames, model.gestures)
        traces.append(StreamTrace(truth, TraceReplayer(trace_of(frames, model))))
    return traces


StreamEvents = tuple[StreamTruth, Sequence[ReportedEvent]]


def model_events(
    dataset: Dataset, model: Bundle | IntegerModel, subjects: Sequence[str], spec: DecideSpec
) -> Iterator[StreamEvents]:
    """Yield the truth of every stream of ``subjects``, with the events that the model reports in it."""
    for person in subjects:
        for stream in read_streams(dataset, model, [person]):
            yield stream.truth, stream.replayer.events(spec)


@dataclass
class StreamScore:
    """Scores of one setting on some streams.

    ``levels`` holds the tallies of each of `LEVELS` by label. ``places`` counts the events outside true and practised
    gestures: at rest (``rest``), where the toy is picked up, turned or put down (``handling``), in gestures that are
    not classes of the model (``other``), and elsewhere (``unmarked``, where people may have practised).
    """

    levels: dict[str, Tallies] = field(default_factory=lambda: {level: {} for level in LEVELS})
    places: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PLACES, 0))
    cost: float = 0.0
    hours: float = 0.0
    free_hours: float = 0.0
    rest_hours: float = 0.0
    known_hours: float = 0.0
    gate_events: int = 0

    def add(self, other: StreamScore) -> None:
        """Add the counts of ``other`` to this score."""
        for level, tallies in other.levels.items():
            for label, counts in tallies.items():
                self.levels[level].setdefault(label, Tally()).add(counts)
        for place, n in other.places.items():
            self.places[place] += n
        for name in ("cost", "hours", "free_hours", "rest_hours", "known_hours", "gate_events"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def total(self, level: str = "gesture") -> Tally:
        """Return the pooled tally of all labels of a level."""
        return pooled(self.levels[level].values())

    def to_journal(self) -> dict[str, object]:
        """Return plain values, as a journal stores them."""
        levels = {level: {k: t.kept() for k, t in tallies.items()} for level, tallies in self.levels.items()}
        return {**vars(self), "levels": levels, "places": dict(self.places)}

    @classmethod
    def from_journal(cls, table: Mapping[str, Any]) -> StreamScore:
        """Restore a score from the result of `to_journal`."""
        levels = {level: {k: Tally(**t) for k, t in rows.items()} for level, rows in table["levels"].items()}
        return cls(**{**table, "levels": levels})

    def to_dict(self) -> dict[str, object]:
        """Return the figures that reports show, ready for JSON."""
        gesture = self.total()
        counts = gesture.to_dict()
        errors = ("deletions", "insertions", "fragmentations", "merges")
        names = ("truths", "events", "hits", *errors, "recall", "precision", "f1", "confused")
        return {
            **{name: counts[name] for name in names},
            "outside": self.places | {"all": counts["outside"]},
            "false_events_per_hour": rate(gesture.insertions, self.hours),
            "outside_per_uncovered_hour": rate(gesture.outside, self.free_hours),
            "at_rest_per_hour": rate(self.places["rest"], self.rest_hours),
            "practised": gesture.practised,
            "false_events_per_known_hour": rate(gesture.insertions - self.places["unmarked"], self.known_hours),
            "hours": round(self.hours, 4),
            "uncovered_hours": round(self.free_hours, 4),
            "rest_hours": round(self.rest_hours, 4),
            "known_hours": round(self.known_hours, 4),
            "latency_s": counts["latency_s"],
            "cost_per_truth": self.cost / gesture.truths if gesture.truths else None,
            "gate_events": self.gate_events,
            "levels": {level: pooled(rows.values()).to_dict() for level, rows in self.levels.items() if rows},
            "per_class": {label: row.to_dict() for label, row in sorted(self.levels["gesture"].items()) if label},
        }


def rate(count: float, hours: float) -> float | None:
    """Return a count per hour; None if ``hours`` is 0."""
    return count / hours if hours > 0 else None


def counted_events(truth: StreamTruth, events: Sequence[ReportedEvent]) -> list[ReportedEvent]:
    """Return the events that do not begin in a doubtful stretch."""
    return [e for e in events if not any(a <= e.start_s < b for a, b in truth.doubtful)]


def gesture_intervals(events: Sequence[ReportedEvent], gestures: GestureSet) -> list[Interval]:
    """Return events as labelled intervals, each from the time when its gesture was named."""
    labels = gestures.labels
    return [Interval(e.named_s, e.stop_s, UNNAMED if e.gesture == NO_GESTURE else labels[e.gesture]) for e in events]


@dataclass
class EventCounts:
    """Counts for curves and tuning: gestures hit and events matched, their totals, and the hours of the streams.

    ``latencies`` are those of `Tally`.
    """

    hits: int = 0
    truths: int = 0
    matched: int = 0
    insertions: int = 0
    hours: float = 0.0
    latencies: list[float] = field(default_factory=list)

    @property
    def recall(self) -> float:
        """Share of the true gestures that were hit; 0 if there are none."""
        return self.hits / self.truths if self.truths else 0.0

    @property
    def false_per_hour(self) -> float:
        """Insertions per hour of stream; 0 without any stream."""
        return self.insertions / self.hours if self.hours else 0.0

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        events = self.matched + self.insertions
        precision = self.matched / events if events else 0.0
        both = precision + self.recall
        return 2 * precision * self.recall / both if both else 0.0

    def add(self, other: EventCounts) -> None:
        """Add the counts of another stream."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


def count_events(streams: Sequence[StreamTrace], spec: DecideSpec, late_s: float = LATE_S) -> EventCounts:
    """Return only the counts at the level of gestures, equal to those of `score` but faster to compute."""
    counts = EventCounts()
    for stream in streams:
        gestures = stream.replayer.trace.gestures
        counts.add(count_matches(stream.truth, stream.replayer.events(spec), gestures, late_s))
    return counts


def count_matches(
    truth: StreamTruth, events: Sequence[ReportedEvent], gestures: GestureSet, late_s: float = LATE_S
) -> EventCounts:
    """Return only the counts of `score_events` at the level of gestures."""
    truths, intervals = truth.truths, gesture_intervals(counted_events(truth, events), gestures)
    over = overlaps(truths, intervals, late_s)
    number = {label: n for n, label in enumerate(gestures.labels)}
    predicted = np.array([number.get(e.label, -1) for e in intervals], dtype=np.int64)
    same = over & (np.array([number[t.label] for t in truths], dtype=np.int64)[:, None] == predicted)
    over_practice = overlaps(truth.practice, intervals, late_s)
    practised = np.array([number[p.label] for p in truth.practice], dtype=np.int64)[:, None] == predicted
    matched = same.any(axis=0) | (over_practice & practised).any(axis=0)
    anything = over.any(axis=0) | over_practice.any(axis=0)
    insertions = ~matched & ~((predicted < 0) & anything)
    latencies = []
    for true, mine in zip(truths, same, strict=True):
        if mine.any():
            first = min(intervals[j].start_s for j in np.flatnonzero(mine).tolist())
            latencies.append(max(0.0, first - true.start_s))
    return EventCounts(len(latencies), len(truths), int(matched.sum()), int(insertions.sum()), truth.hours, latencies)


def score(
    stream: StreamTrace, spec: DecideSpec, weights: ErrorCosts | None = None, late_s: float = LATE_S
) -> StreamScore:
    """Return the scores of one decision setting on one stream."""
    return score_events(stream.truth, stream.replayer.events(spec), stream.replayer.trace.gestures, weights, late_s)


def score_events(
    truth: StreamTruth,
    events: Sequence[ReportedEvent],
    gestures: GestureSet,
    weights: ErrorCosts | None = None,
    late_s: float = LATE_S,
) -> StreamScore:
    """Return the scores of events in one stream; ``gestures`` are the classes of ``truth`` and of the events."""
    events = counted_events(truth, events)
    families = dict(zip(gestures.labels, gestures.families, strict=True))
    affects = dict(zip(gestures.labels, gestures.affects, strict=True))
    by_gesture = gesture_intervals(events, gestures)
    truths, practice = truth.truths, truth.practice
    out = StreamScore(hours=truth.hours, free_hours=truth.free_hours, rest_hours=truth.rest_hours)
    out.known_hours = truth.known_hours
    out.gate_events = sum(bool(e.source) for e in events)

    def tallied(names: Mapping[str, str], named: Sequence[Interval]) -> Tallies:
        return tally(_called(truths, names), named, late_s, _called(practice, names))

    out.levels["gesture"] = tally(truths, by_gesture, late_s, practice)
    out.levels["family"] = tallied(families, _called(by_gesture, families))
    if gestures.has_affect:
        by_affect = [
            Interval(e.start_s, e.stop_s, AFFECTS[e.affect] if e.affect or e.gesture != NO_GESTURE else UNNAMED)
            for e in events
        ]
        out.levels["affect"] = tallied(affects, by_affect)
    whole = [Interval(e.start_s, e.stop_s, "anything") for e in events]
    out.levels["anything"] = tallied(dict.fromkeys(gestures.labels, "anything"), whole)
    for event in outside_insertions((*truths, *practice), by_gesture, late_s):
        out.places[_place(event, truth)] += 1
    named_affects = [AFFECTS[e.affect] for e in events]
    kinds = {g.label: (families[g.label], g.affect) for g in gestures.gestures}
    out.cost = cost(truths, by_gesture, named_affects, kinds, weights, late_s, practice)
    return out


def people_scores(
    streams: Iterable[StreamEvents],
    gestures: GestureSet,
    weights: ErrorCosts | None = None,
    late_s: float = LATE_S,
) -> dict[str, StreamScore]:
    """Return the scores of each person, from the truth and the events of every stream."""
    scores: dict[str, StreamScore] = {}
    for truth, events in streams:
        mine = score_events(truth, events, gestures, weights, late_s)
        scores.setdefault(truth.subject, StreamScore()).add(mine)
    return scores


def _called(intervals: Sequence[Interval], names: Mapping[str, str]) -> list[Interval]:
    return [Interval(i.start_s, i.stop_s, names.get(i.label, UNNAMED)) for i in intervals]


def _place(event: Interval, truth: StreamTruth) -> str:
    for name, stretches in (("rest", truth.rest), ("handling", truth.handling), ("other", truth.other)):
        if any(a <= event.start_s < b for a, b in stretches):
            return name
    return "unmarked"
