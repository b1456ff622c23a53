"""Scores of reported events against true gestures: detections, latency, and the cost of errors.

The counts are those of the event analysis of Ward, Lukowicz and Gellersen, *Performance metrics for activity
recognition*, ACM TIST 2(1), 2011, article 6. Labels are gestures, families or affects; one of these levels is scored at
a time. A *truth* is the labelled interval of a gesture that was really made.

*Overlap.* An event lasts from the time at which its label was reported to its end. It belongs to a truth if it begins
before the truth and ends in it or later, or if it begins in the truth or less than ``late_s`` after its end, because an
event cannot be reported within a hit of 0.2 s. It does not belong to a truth that has ended if the next truth of the
same label has begun before the event.

Categories of truths and events of one label, by which of them belong together:

========================  =============================================================================================
of a truth                of an event
========================  =============================================================================================
deletion: no event        insertion: no truth
fragmented: two or more   fragmenting: one of several of its truth, which is its only one
merged: its event has     merging: several truths, of which none has another event
another truth too
fragmented and merged     fragmenting and merging
correct: none of these    correct: none of these
========================  =============================================================================================

Each truth and each event is in one category. ``hits`` are truths with an event, ``matched`` are events with a truth. An
event with a wrong label is an insertion, and its truth is a deletion if it has no event of its own label. An insertion
that belongs to the time of a truth with another label is ``confused``, any other is ``outside``. An event without a
label (as when gestures are scored and the gate reported only an affect) is ``unnamed`` if it belongs to the time of a
truth; it is then neither right nor wrong.

*Practice* is an interval in which a gesture was practised, perhaps several times. An event that would be an insertion
but belongs to a practice of its label is ``matched`` and ``practised``. With another label it is ``confused``. A
practice is no truth: it is neither a hit nor a deletion.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

UNNAMED = ""
LATE_S = 1.0


@dataclass(frozen=True, slots=True)
class Interval:
    """A labelled interval: a truth, or an event, which starts when it is reported. The label of an event may be ""."""

    start_s: float
    stop_s: float
    label: str


@dataclass
class Tally:
    """Counts of the categories for one label, or sums over several labels; the module describes the categories.

    ``latencies`` are the seconds from the onset of each hit to the report of its first event. ``early`` is the number
    of hits whose event was reported before the onset; their latency is 0.
    """

    truths: int = 0
    hits: int = 0
    deletions: int = 0
    fragmented: int = 0
    merged: int = 0
    fragmented_merged: int = 0
    events: int = 0
    matched: int = 0
    practised: int = 0
    insertions: int = 0
    confused: int = 0
    unnamed: int = 0
    fragmenting: int = 0
    merging: int = 0
    fragmenting_merging: int = 0
    early: int = 0
    latencies: list[float] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add the counts of another stream, person or label."""
        for f in fields(self):
            setattr(self, f.name, getattr(self, f.name) + getattr(other, f.name))

    @property
    def outside(self) -> int:
        """Number of insertions that belong to the time of no truth."""
        return self.insertions - self.confused

    @property
    def recall(self) -> float | None:
        """Share of the truths that are hits; None without truths."""
        return self.hits / self.truths if self.truths else None

    @property
    def precision(self) -> float | None:
        """Share of the events, without unnamed ones, that are matched; None without such events."""
        named = self.events - self.unnamed
        return self.matched / named if named else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of recall and precision; 0 if one of them is undefined, None without truths and events."""
        if not self.truths and not self.events:
            return None
        recall, precision = self.recall or 0.0, self.precision or 0.0
        return 2 * recall * precision / (recall + precision) if recall + precision else 0.0

    def latency_s(self) -> dict[str, float | None]:
        """Return the median and 90th percentile of ``latencies``."""
        return latency_summary(self.latencies)

    def to_dict(self) -> dict[str, object]:
        """Return counts and scores as plain values, ready for JSON; of the latencies only a summary."""
        table = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "latencies"}
        return table | {
            "outside": self.outside,
            "fragmentations": self.fragmented + self.fragmented_merged,
            "merges": self.merged + self.fragmented_merged,
            "recall": self.recall,
            "precision": self.precision,
            "f1": self.f1,
            "latency_s": self.latency_s(),
        }

    def kept(self) -> dict[str, object]:
        """Return all fields as plain values; ``Tally(**values)`` restores the tally."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


Tallies = dict[str, Tally]


def latency_summary(latencies: Sequence[float]) -> dict[str, float | None]:
    """Return ``{median, p90}`` in seconds; both are None without latencies."""
    if not latencies:
        return {"median": None, "p90": None}
    return {"median": float(np.median(latencies)), "p90": float(np.percentile(latencies, 90))}


def pooled(tallies: Iterable[Tally]) -> Tally:
    """Return the sum of several tallies."""
    total = Tally()
    for tally in tallies:
        total.add(tally)
    return total


def overlaps(truths: Sequence[Interval], events: Sequence[Interval], late_s: float = LATE_S) -> NDArray[np.bool_]:
    """Return whether each event belongs to the time of each truth, (T, E), whatever their labels."""
    if not truths or not events:
        return np.zeros((len(truths), len(events)), dtype=np.bool_)
    start = np.array([t.start_s for t in truths])[:, None]
    until = _until(truths, late_s)[:, None]
    start_of_event = np.array([e.start_s for e in events])
    end = np.array([e.stop_s for e in events])
    return np.asarray((start_of_event < until) & ((end > start) | (start_of_event >= start)))


def _until(truths: Sequence[Interval], late_s: float) -> NDArray[np.float64]:
    """Return the time (T,) before which an event must begin to belong to each truth."""
    until = np.array([t.stop_s + late_s for t in truths])
    following: dict[str, float] = {}
    for at in sorted(range(len(truths)), key=lambda i: (truths[i].start_s, truths[i].stop_s), reverse=True):
        t = truths[at]
        next_s = following.get(t.label, np.inf)
        until[at] = max(min(until[at], next_s), t.stop_s)
        following[t.label] = t.start_s
    return until


def tally(
    truths: Sequence[Interval],
    events: Sequence[Interval],
    late_s: float = LATE_S,
    practice: Sequence[Interval] = (),
) -> Tallies:
    """Count the categories of each label in one stream; `pooled` adds the labels up.

    Args:
        truths, events, practice: in any order; the label of an event may be "".
    """
    over = overlaps(truths, events, late_s)
    in_practice = overlaps(practice, events, late_s)
    of_truth = np.array([t.label for t in truths], dtype=np.str_)
    of_event = np.array([e.label for e in events], dtype=np.str_)
    of_practice = np.array([p.label for p in practice], dtype=np.str_)
    practised = (in_practice & (of_practice[:, None] == of_event[None, :])).any(axis=0)
    same = over & (of_truth[:, None] == of_event[None, :]) & (of_event != UNNAMED)[None, :]
    per_truth, per_event = same.sum(axis=1), same.sum(axis=0)
    # A truth is merged if one of its events has another truth; an event is fragmenting if its truth has another event.
    merged: list[bool] = (same & (per_event > 1)[None, :]).any(axis=1).tolist()
    fragmenting: list[bool] = (same & (per_truth > 1)[:, None]).any(axis=0).tolist()
    anything = [bool(n) for n in over.sum(axis=0) + in_practice.sum(axis=0)]
    tallies: Tallies = {}

    def at(label: str) -> Tally:
        return tallies.setdefault(label, Tally())

    for i, truth in enumerate(truths):
        row = at(truth.label)
        row.truths += 1
        if not per_truth[i]:
            row.deletions += 1
            continue
        row.hits += 1
        split, joined = bool(per_truth[i] > 1), merged[i]
        row.fragmented += split and not joined
        row.merged += joined and not split
        row.fragmented_merged += split and joined
        after = min(events[j].start_s for j in np.flatnonzero(same[i]).tolist()) - truth.start_s
        row.early += bool(after < 0)
        row.latencies.append(round(max(0.0, float(after)), 4))
    for j, event in enumerate(events):
        row = at(event.label)
        row.events += 1
        if event.label == UNNAMED and anything[j]:
            row.unnamed += 1
        elif not per_event[j] and practised[j]:
            row.matched += 1
            row.practised += 1
        elif not per_event[j]:
            row.insertions += 1
            row.confused += anything[j]
        else:
            row.matched += 1
            split, joined = fragmenting[j], bool(per_event[j] > 1)
            row.fragmenting += split and not joined
            row.merging += joined and not split
            row.fragmenting_merging += split and joined
    return tallies


def outside_insertions(
    truths: Sequence[Interval], events: Sequence[Interval], late_s: float = LATE_S
) -> list[Interval]:
    """Return the events that belong to the time of no truth."""
    anything = overlaps(truths, events, late_s).sum(axis=0) > 0
    return [event for event, any_truth in zip(events, anything, strict=True) if not any_truth]


@dataclass(frozen=True)
class ErrorCosts:
    """Costs of the kinds of errors.

    The values are judgements, not measurements: that a hug taken for a blow is worse for a family than one scratch
    taken for another, and that a toy which reacts for no reason is worse than one that misses something.

    The cost of an event is the lowest over the truths to whose time it belongs: 0 for the first event of the right
    gesture; ``again`` for each further one; ``family`` for another gesture of the same family, or if only the affect
    was reported and is right; ``confused`` for another family of the same affect, or if an affect is unknown;
    ``affect`` for another affect. It is ``outside`` without such a truth. A truth without any event costs ``missed``.

    Decision settings are fitted by the same costs (`plushsense.tuning.events`) and by two more, which `cost` does not
    use: ``late_s`` for each second until a gesture is named, and ``unmarked``, instead of ``outside``, for an event in
    a time of which nothing is known, because people may have practised then.
    """

    again: float = 0.5
    family: float = 1.0
    confused: float = 2.0
    missed: float = 2.0
    outside: float = 3.0
    affect: float = 5.0
    late_s: float = 0.4
    unmarked: float = 0.5


def cost(
    truths: Sequence[Interval],
    events: Sequence[Interval],
    affects: Sequence[str],
    kinds: Mapping[str, tuple[str, str]],
    weights: ErrorCosts | None = None,
    late_s: float = LATE_S,
    practice: Sequence[Interval] = (),
) -> float:
    """Return the total cost of the errors in one stream.

    Args:
        truths, events, practice: with gestures as labels; the label of an event may be "".
        affects: affect of each event (E,); "none" if unknown.
        kinds: family and affect of each gesture; the affect "none" means unknown.
    """
    weights = weights or ErrorCosts()
    # Of several truths of an event's gesture, the earliest is taken first, in whatever order they are given.
    truths = sorted(truths, key=lambda t: (t.start_s, t.stop_s))
    over = np.vstack([overlaps(truths, events, late_s), overlaps(practice, events, late_s)])
    total = float(weights.missed * (len(truths) - int(over[: len(truths)].any(axis=1).sum() if len(events) else 0)))
    labelled = [*truths, *practice]
    right: set[int] = set()
    order = sorted(range(len(events)), key=lambda j: (events[j].start_s, events[j].stop_s, events[j].label))
    for j in order:
        there = np.flatnonzero(over[:, j])
        if not len(there):
            total += weights.outside
            continue
        charges = []
        for i in there.tolist():
            truth, event = labelled[i], events[j]
            family, affect = kinds[truth.label]
            if event.label == truth.label:
                charges.append((weights.again if i in right else 0.0, i))
            elif event.label != UNNAMED and kinds[event.label][0] == family:
                charges.append((weights.family, -1))
            elif "none" in (affects[j], affect):
                charges.append((weights.confused, -1))
            elif affects[j] != affect:
                charges.append((weights.affect, -1))
            else:
                charges.append((weights.family if event.label == UNNAMED else weights.confused, -1))
        least, hit = min(charges)
        total += least
        if 0 <= hit < len(truths):
            right.add(hit)
    return total


def uncovered_s(spans: Sequence[tuple[float, float]], covered: Iterable[tuple[float, float]]) -> float:
    """Return the duration of ``spans`` (start, stop; without overlap) outside all spans of ``covered``, in seconds."""
    union: list[list[float]] = []
    for start, stop in sorted(covered):
        if union and start <= union[-1][1]:
            union[-1][1] = max(union[-1][1], stop)
        else:
            union.append([start, stop])
    total = sum(stop - start for start, stop in spans)
    inside = sum(max(0.0, min(stop, b) - max(start, a)) for start, stop in spans for a, b in union)
    return total - inside


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (recall, false events) on the Pareto front, in order of recall."""
    best: list[int] = []
    least = float("inf")
    for at in sorted(range(len(points)), key=lambda i: (-points[i][0], points[i][1], i)):
        if points[at][1] < least:
            least = points[at][1]
            best.append(at)
    return best[::-1]


def at_recall(points: Sequence[tuple[float, float]], recall: float) -> float | None:
    """Return the false events at ``recall``, interpolated on the `front` of ``points``; None beyond its ends."""
    chosen = [points[i] for i in front(points)]
    if not chosen or not chosen[0][0] <= recall <= chosen[-1][0]:
        return None
    return float(np.interp(recall, [p[0] for p in chosen], [p[1] for p in chosen]))
