"""Search for event settings with the lowest cost of wrong, late and missing events.

The network is computed once for each stream (`plushsense.runtime.trace`); the toy's event machine then replays its
outputs with each candidate setting.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import AFFECT_CODES, BEGUN, ENDED, NAMED, NO_GESTURE, Update
from plushsense.runtime.replay import TraceReplayer
from plushsense.runtime.trace import Trace
from plushsense.scoring.events import ErrorCosts

OTHER = -1


@dataclass(frozen=True, slots=True)
class Truth:
    """A marked part of a stream, with a class index, or `OTHER` for a gesture that the network does not know."""

    start_us: int
    stop_us: int
    gesture: int


@dataclass(frozen=True, eq=False)
class MarkedStream:
    """The trace of a stream of one person, with its marked parts."""

    person: str
    trace: Trace
    truths: tuple[Truth, ...]

    @cached_property
    def replayer(self) -> TraceReplayer:
        """The replayer of the trace."""
        return TraceReplayer(self.trace)


@dataclass(slots=True)
class TimedEvent:
    """A reported event; ``named_us`` is the time at which its gesture was named."""

    begun_us: int
    affect: int
    gesture: int
    named_us: int
    ended_us: int = 0


def timed_events(updates: Sequence[Update]) -> list[TimedEvent]:
    """Combine updates into whole events."""
    out: list[TimedEvent] = []
    for u in updates:
        if u.kind == BEGUN:
            out.append(TimedEvent(u.now, u.affect, u.gesture, u.now))
        elif u.kind == NAMED:
            out[-1].gesture, out[-1].affect, out[-1].named_us = u.gesture, u.affect, u.now
        elif u.kind == ENDED:
            out[-1].ended_us = u.now
    return out


# An event belongs to a gesture if it begins from this long before the gesture to this long after it.
_EARLY_US, _GRACE_US = 250_000, 1_000_000
_LATEST_S = 3.0  # a later event costs no more for being late


def event_costs(
    stream: MarkedStream, events: Sequence[TimedEvent], gestures: GestureSet, prices: ErrorCosts
) -> NDArray[np.float64]:
    """Return the cost (n,) of each of the n gestures of a stream, in order of time.

    A gesture costs ``missed`` if it has no event, else as much as its best event and the time until that was named.
    Every further event costs ``again`` and half its error. The cost of an event without a gesture, ``outside`` at rest
    and ``unmarked`` elsewhere, is added to that of the nearest gesture.
    """
    idle = [g.idle for g in gestures.gestures]
    active = [t for t in stream.truths if t.gesture != OTHER and not idle[t.gesture]]
    resting = [t for t in stream.truths if t.gesture != OTHER and idle[t.gesture]]
    others = [t for t in stream.truths if t.gesture == OTHER]
    if not active:
        return np.zeros(0)
    starts = np.array([t.start_us for t in active])
    answers: list[list[TimedEvent]] = [[] for _ in active]
    total = np.zeros(len(active))
    for event in events:
        at = _place(event, active)
        if at is not None:
            answers[at].append(event)
            continue
        nearest = int(np.abs(starts - event.begun_us).argmin())
        if _within(event, resting, 0):
            total[nearest] += prices.outside
        elif not _within(event, others, _GRACE_US):
            total[nearest] += prices.unmarked
    for at, (truth, reported) in enumerate(zip(active, answers, strict=True)):
        # A correct event may have begun earlier, if it lasts for at least half of the gesture.
        continuing = [
            e
            for e in events
            if e.gesture == truth.gesture
            and e.begun_us < truth.start_us - _EARLY_US
            and 2 * (min(e.ended_us, truth.stop_us) - truth.start_us) >= truth.stop_us - truth.start_us
        ]
        answer_costs = [_price(e, truth, gestures, prices) for e in reported]
        if continuing:
            answer_costs.insert(0, (True, 0.0))
        if not answer_costs:
            total[at] += prices.missed
            continue
        first = min(range(len(answer_costs)), key=lambda i: answer_costs[i][1])
        total[at] += answer_costs[first][1]
        total[at] += sum(
            prices.again + (0.0 if right else cost / 2) for i, (right, cost) in enumerate(answer_costs) if i != first
        )
    return total


def _within(event: TimedEvent, truths: Sequence[Truth], grace_us: int) -> bool:
    return any(t.start_us - _EARLY_US <= event.begun_us <= t.stop_us + grace_us for t in truths)


def _place(event: TimedEvent, truths: Sequence[Truth]) -> int | None:
    """Return the index of the gesture that an event belongs to: the same gesture, if possible, else the latest one."""
    around = [i for i, t in enumerate(truths) if t.start_us - _EARLY_US <= event.begun_us <= t.stop_us + _GRACE_US]
    own = [i for i in around if truths[i].gesture == event.gesture]
    near = own or around
    return near[-1] if near else None


def _price(event: TimedEvent, truth: Truth, gestures: GestureSet, prices: ErrorCosts) -> tuple[bool, float]:
    """Return whether an event is correct for a gesture, and its cost."""
    real = gestures.gestures[truth.gesture]
    late = prices.late_s * min(max(event.named_us - truth.start_us, 0) / 1e6, _LATEST_S)
    if event.gesture == truth.gesture:
        return True, late
    if event.gesture == NO_GESTURE:
        right = event.affect in (0, AFFECT_CODES[real.affect])
        return right, prices.family + late if right else prices.affect
    as_which = gestures.gestures[event.gesture]
    if as_which.family == real.family:
        return False, prices.family + late
    if as_which.affect != real.affect:
        return False, prices.affect
    return False, prices.confused + late


# Values to try, in this order and twice; settings with the largest effect come first.
TRIED: dict[str, tuple[float, ...]] = {
    "enter": (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9),
    "least_s": (0.05, 0.1, 0.2, 0.3, 0.5),
    "smoothing_s": (0.1, 0.2, 0.3, 0.5, 0.8),
    "rest_s": (0.0, 0.2, 0.5, 1.0),
    "switch_s": (0.1, 0.3, 0.5, 1.0),
    "end_s": (0.1, 0.3, 0.6, 1.0),
    "leave": (0.1, 0.2, 0.3, 0.4, 0.5),
    "hold_s": (0.0, 0.2, 0.5),
}
TRIED_AFFECT: dict[str, tuple[float, ...]] = {
    "enter_affect": (0.6, 0.7, 0.8, 0.9, 0.95),
    "leave_affect": (0.2, 0.4, 0.6),
}
TRIED_GATE: dict[str, tuple[float, ...]] = {"wait_s": (0.5, 1.0, 1.5, 2.5)}
_BLOCK = 10  # consecutive gestures, whose mean is one sample for the standard error


@dataclass(frozen=True)
class TunedEvents:
    """The result of `tune`: costs are per gesture, ``tried`` is the number of settings tried, ``moved`` (old, new)."""

    spec: DecideSpec
    cost: float
    cost_before: float
    tried: int
    moved: dict[str, tuple[float, float]]


def tune(
    streams: Sequence[MarkedStream],
    spec: DecideSpec,
    gestures: GestureSet,
    prices: ErrorCosts | None = None,
    keep: Collection[str] = (),
) -> TunedEvents:
    """Search for the event settings with the lowest cost per gesture, averaged over people.

    Each setting in turn is changed to its best value, in two passes, if the gain is larger than its standard error over
    blocks of 10 gestures and at least half of the people do not lose by it.

    Args:
        spec: start of the search; gate, health, ``known`` and ``sure`` are not changed.
        keep: settings not to change.
    """
    prices = prices or ErrorCosts()
    gate = bool(spec.gate.rules)
    settings = TRIED | (TRIED_AFFECT if gestures.has_affect else {}) | (TRIED_GATE if gate else {})
    settings = {name: values for name, values in settings.items() if name not in keep}
    for h in streams:
        h.replayer.smooth([h.replayer.weight(s) for s in (spec.smoothing_s, *settings.get("smoothing_s", ()))])
    costs: dict[tuple[Any, ...], list[NDArray[np.float64]]] = {}

    def cost(candidate: DecideSpec) -> list[NDArray[np.float64]]:
        key = tuple(getattr(candidate, name) for name in settings)
        if key not in costs:
            costs[key] = [
                event_costs(h, timed_events(h.replayer.updates(candidate)), gestures, prices) for h in streams
            ]
        return costs[key]

    people = [h.person for h in streams]
    now = before = cost(spec)
    moved: dict[str, tuple[float, float]] = {}
    for _ in range(2):
        changed = False
        for name, values in settings.items():
            best, best_gain = None, 0.0
            for value in values:
                if value == getattr(spec, name) or (name == "leave" and value > spec.enter):
                    continue
                changes: dict[str, Any] = {name: value}
                if name == "enter":
                    changes["leave"] = min(spec.leave, value)
                candidate = replace(spec, **changes)
                gain, error, share = compare_costs(now, cost(candidate), people)
                if gain > max(best_gain, error) and share >= 0.5:
                    best, best_gain = candidate, gain
            if best is not None:
                moved[name] = (moved.get(name, (getattr(spec, name), 0.0))[0], getattr(best, name))
                spec, now, changed = best, cost(best), True
        if not changed:
            break
    return TunedEvents(spec, _mean(now, people), _mean(before, people), len(costs), moved)


def _mean(each: Sequence[NDArray[np.float64]], people: Sequence[str]) -> float:
    by_person = _by_person(each, people)
    return float(np.mean([c.mean() for c in by_person])) if by_person else float("nan")


def _by_person(each: Sequence[NDArray[np.float64]], people: Sequence[str]) -> list[NDArray[np.float64]]:
    out = [np.concatenate([c for c, p in zip(each, people, strict=True) if p == who]) for who in dict.fromkeys(people)]
    return [c for c in out if len(c)]


def compare_costs(
    before: Sequence[NDArray[np.float64]], after: Sequence[NDArray[np.float64]], people: Sequence[str]
) -> tuple[float, float, float]:
    """Compare the costs ``before`` and ``after`` of each stream.

    Returns:
        the mean gain per gesture, its standard error over blocks of gestures, and the share of people without a loss.
    """
    gains = [a - b for a, b in zip(_by_person(before, people), _by_person(after, people), strict=True)]
    if not gains:
        return 0.0, float("inf"), 0.0
    blocks = np.array([g[at : at + _BLOCK].mean() for g in gains for at in range(0, len(g), _BLOCK)])
    error = float(blocks.std(ddof=1) / np.sqrt(len(blocks))) if len(blocks) > 1 else float("inf")
    return float(np.mean([g.mean() for g in gains])), error, float(np.mean([g.mean() >= 0 for g in gains]))
