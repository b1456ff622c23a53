"""One person's streams as a model hears them, beside what really happened: any setting scored in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.evaluation.truth import StreamTruth, streams_of, truth_of, usual_rows
from plushsense.live.decide import DecideSpec
from plushsense.live.replaying import Listener, Said
from plushsense.live.trace import trace_of
from plushsense.models.bundle import Bundle
from plushsense.models.events import AFFECTS, NO_GESTURE
from plushsense.models.image import IntegerModel
from plushsense.scoring.events import (
    LATE_S,
    UNNAMED,
    Costs,
    Interval,
    Tallies,
    Tally,
    cost,
    inserted,
    overlaps,
    pooled,
    tally,
    uncovered_s,
)

# Of what an event is asked: its gesture, the family, the affect, and whether anything was said at all.
LEVELS = ("gesture", "family", "affect", "anything")
PLACES = ("rest", "other", "unmarked")


@dataclass(frozen=True, eq=False)
class Heard:
    """One stream with its truth. ``hours`` that the model heard; ``free_hours`` of these without any truth;
    ``rest_hours`` in recordings of rest."""

    truth: StreamTruth
    listener: Listener
    hours: float
    free_hours: float
    rest_hours: float


def hear(dataset: Dataset, model: Bundle | IntegerModel, subjects: Sequence[str]) -> list[Heard]:
    """Read every stream of some people once."""
    usual = usual_rows(dataset)
    found = []
    for stream in streams_of(dataset, subjects):
        frames = dataset.read_stream(stream.id)
        trace = trace_of(frames, model)
        truth = truth_of(dataset, stream, frames, model.gestures, usual)
        parts = [(p.start_us / 1e6, p.ends_us / 1e6) for p in trace.parts]
        marked = [(t.start_s, t.stop_s) for t in truth.truths]
        left = uncovered_s(parts, truth.doubtful)
        free = uncovered_s(parts, [*marked, *truth.doubtful])
        rest = uncovered_s(parts, []) - uncovered_s(parts, truth.rest)
        found.append(Heard(truth, Listener(trace), left / 3600, free / 3600, rest / 3600))
    return found


@dataclass
class StreamScore:
    """What one setting gave on some streams.

    ``levels`` holds the tallies of each of `LEVELS` by label; ``places`` where the events outside of any truth were:
    in recordings of rest, in recordings of gestures that the model does not know, anywhere else (``unmarked``, where
    people may have practised).
    """

    levels: dict[str, Tallies] = field(default_factory=lambda: {level: {} for level in LEVELS})
    places: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PLACES, 0))
    cost: float = 0.0
    hours: float = 0.0
    free_hours: float = 0.0
    rest_hours: float = 0.0
    gate_events: int = 0

    def add(self, other: StreamScore) -> None:
        """Count other streams in."""
        for level, tallies in other.levels.items():
            for label, counts in tallies.items():
                self.levels[level].setdefault(label, Tally()).add(counts)
        for place, n in other.places.items():
            self.places[place] += n
        for name in ("cost", "hours", "free_hours", "rest_hours", "gate_events"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def total(self, level: str = "gesture") -> Tally:
        """All labels of a level."""
        return pooled(self.levels[level].values())

    def kept(self) -> dict[str, Any]:
        """Plain values: what a journal keeps."""
        levels = {level: {k: t.kept() for k, t in tallies.items()} for level, tallies in self.levels.items()}
        return {**vars(self), "levels": levels, "places": dict(self.places)}

    @classmethod
    def from_kept(cls, table: Mapping[str, Any]) -> StreamScore:
        """What `kept` gave."""
        levels = {level: {k: Tally(**t) for k, t in rows.items()} for level, rows in table["levels"].items()}
        return cls(**{**table, "levels": levels})

    def to_dict(self) -> dict[str, Any]:
        """The figures that are shown, ready for JSON."""
        gesture = self.total()
        said = gesture.to_dict()
        names = ("events", "hits", "deletions", "insertions", "fragmentations", "merges")
        return {
            "truths": said["truths"],
            **{name: said[name] for name in names},
            "recall": said["recall"],
            "precision": said["precision"],
            "f1": said["f1"],
            "confused": said["confused"],
            "outside": self.places | {"all": said["outside"]},
            "false_events_per_hour": rate(gesture.insertions, self.hours),
            "outside_per_uncovered_hour": rate(gesture.outside, self.free_hours),
            "at_rest_per_hour": rate(self.places["rest"], self.rest_hours),
            "hours": round(self.hours, 4),
            "uncovered_hours": round(self.free_hours, 4),
            "rest_hours": round(self.rest_hours, 4),
            "latency_s": said["latency_s"],
            "cost_per_truth": self.cost / gesture.truths if gesture.truths else None,
            "gate_events": self.gate_events,
            "levels": {level: pooled(rows.values()).to_dict() for level, rows in self.levels.items() if rows},
            "per_class": {label: row.to_dict() for label, row in sorted(self.levels["gesture"].items()) if label},
        }


def rate(count: float, hours: float) -> float | None:
    """So many an hour; None where there was no time."""
    return count / hours if hours > 0 else None


def kept_events(heard: Heard, spec: DecideSpec) -> list[Said]:
    """The events of a setting, without those that begin in a doubtful stretch."""
    doubtful = heard.truth.doubtful
    return [e for e in heard.listener.events(spec) if not any(a <= e.start_s < b for a, b in doubtful)]


def gesture_intervals(events: Sequence[Said], gestures: GestureSet) -> list[Interval]:
    """Events as they count when gestures are asked: from when the gesture was said."""
    labels = gestures.labels
    return [Interval(e.named_s, e.stop_s, UNNAMED if e.gesture == NO_GESTURE else labels[e.gesture]) for e in events]


@dataclass
class Quick:
    """All that most tuning asks of a setting: gestures hit and events matched, of how many, in how many hours."""

    hits: int = 0
    truths: int = 0
    matched: int = 0
    insertions: int = 0
    hours: float = 0.0

    @property
    def recall(self) -> float:
        """Hits of the truths; 0 without any."""
        return self.hits / self.truths if self.truths else 0.0

    @property
    def false_per_hour(self) -> float:
        """Insertions an hour of stream."""
        return self.insertions / self.hours if self.hours else 0.0

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        said = self.matched + self.insertions
        precision = self.matched / said if said else 0.0
        both = precision + self.recall
        return 2 * precision * self.recall / both if both else 0.0


def quick(heard: Sequence[Heard], spec: DecideSpec, late_s: float = LATE_S) -> Quick:
    """The counts of gestures alone, as `score` would count them."""
    found = Quick()
    for h in heard:
        gestures, truths = h.listener.trace.gestures, h.truth.truths
        events = gesture_intervals(kept_events(h, spec), gestures)
        found.hours += h.hours
        found.truths += len(truths)
        over = overlaps(truths, events, late_s)
        number = {label: n for n, label in enumerate(gestures.labels)}
        said = np.array([number.get(e.label, -1) for e in events], dtype=np.int64)
        same = over & (np.array([number[t.label] for t in truths], dtype=np.int64)[:, None] == said)
        matched = same.any(axis=0)
        found.hits += int(same.any(axis=1).sum())
        found.matched += int(matched.sum())
        found.insertions += int((~matched & ~((said < 0) & over.any(axis=0))).sum())
    return found


def score(heard: Heard, spec: DecideSpec, weights: Costs | None = None, late_s: float = LATE_S) -> StreamScore:
    """Everything about one setting on one stream."""
    gestures = heard.listener.trace.gestures
    events = kept_events(heard, spec)
    families = dict(zip(gestures.labels, gestures.families, strict=True))
    affects = dict(zip(gestures.labels, gestures.affects, strict=True))
    by_gesture = gesture_intervals(events, gestures)
    truths = heard.truth.truths
    out = StreamScore(hours=heard.hours, free_hours=heard.free_hours, rest_hours=heard.rest_hours)
    out.gate_events = sum(bool(e.source) for e in events)
    out.levels["gesture"] = tally(truths, by_gesture, late_s)
    out.levels["family"] = tally(_called(truths, families), _called(by_gesture, families), late_s)
    if gestures.tells_affect:
        said = [
            Interval(e.start_s, e.stop_s, AFFECTS[e.affect] if e.affect or e.gesture != NO_GESTURE else UNNAMED)
            for e in events
        ]
        out.levels["affect"] = tally(_called(truths, affects), said, late_s)
    whole = [Interval(e.start_s, e.stop_s, "anything") for e in events]
    out.levels["anything"] = tally([Interval(t.start_s, t.stop_s, "anything") for t in truths], whole, late_s)
    for event in inserted(truths, by_gesture, late_s):
        out.places[_place(event, heard.truth)] += 1
    told = [AFFECTS[e.affect] for e in events]
    out.cost = cost(truths, by_gesture, told, families, affects, weights, late_s)
    return out


def _called(intervals: Sequence[Interval], names: Mapping[str, str]) -> list[Interval]:
    return [Interval(i.start_s, i.stop_s, names.get(i.label, UNNAMED)) for i in intervals]


def _place(event: Interval, truth: StreamTruth) -> str:
    for name, stretches in (("rest", truth.rest), ("other", truth.other)):
        if any(a <= event.start_s < b for a, b in stretches):
            return name
    return "unmarked"
