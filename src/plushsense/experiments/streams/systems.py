"""The systems of the continuous benchmark, the decision settings to try, and the choice among them.

Settings are chosen on people who are not scored: for each target recall, the setting that reaches it with the fewest
false events; for single figures, the setting of highest F1, the quickest one whose F1 is nearly as high, the one of
highest F1 among those with few false events, and the one whose errors cost least.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plushsense.core.gestures import GestureSet
from plushsense.experiments.streams.replay import StreamScore, StreamTrace, count_events, score
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.gate import GateSettings
from plushsense.scoring.events import LATE_S, ErrorCosts, front

WINDOWS, ANYWHERE = "windows", "anywhere"
ENTERS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
SMOOTHINGS = (0.15, 0.3, 0.6, 1.0)
# The quickest setting may have an F1 that is lower than the highest by at most this.
PROMPT_F1 = 0.05
# The quiet setting may report this many false events per hour.
QUIET_PER_HOUR = 60.0
# Recalls to reach on the tuning people; the recall on the scored people may differ.
TARGETS = tuple(round(0.2 + 0.05 * n, 2) for n in range(16))

Grid = Callable[[GestureSet], list[DecideSpec]]


def _thresholds(*smoothings: float) -> Grid:
    """Return a grid of thresholds: each step's best class counts if its share is at least ``enter`` (0: always)."""

    def grid(_: GestureSet) -> list[DecideSpec]:
        return [replace(argmax_spec(s), enter=enter, leave=enter) for s in smoothings for enter in ENTERS]

    return grid


def _hysteresis(gestures: GestureSet) -> list[DecideSpec]:
    """Return the first settings to try: events begin above a threshold, end below a lower one, and end with a delay."""
    return [
        DecideSpec(
            smoothing_s=smoothing_s,
            enter=enter,
            leave=enter / 2,
            # If gestures have an affect, it may be reported before the gesture.
            enter_affect=max(enter, 0.8) if gestures.has_affect else 2.0,
            leave_affect=enter / 2,
            least_s=0.0,
            switch_s=0.3,
            end_s=end_s,
            hold_s=0.3,
            rest_s=0.2,
            wait_s=1.0,
        )
        for smoothing_s in (0.1, 0.3, 0.6)
        for enter in (0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95)
        for end_s in (0.3, 0.8)
    ]


# Values to try for one setting at a time, starting from the best settings found so far.
_STEPS: dict[str, tuple[Any, ...]] = {
    "least_s": (0.0, 0.2, 0.5),
    "switch_s": (0.3, 0.6, 1.0),
    "end_s": (0.3, 0.8, 1.5),
    "rest_s": (0.2, 1.0, 2.0),
}
_WAITS = (0.5, 1.5)


def _beside(spec: DecideSpec) -> list[DecideSpec]:
    """Return settings that differ from ``spec`` in one value of `_STEPS`, or in the ratio of leave to enter."""
    specs = [replace(spec, **{name: value}) for name, values in _STEPS.items() for value in values]
    specs += [replace(spec, leave=share * spec.enter, leave_affect=share * spec.enter) for share in (0.3, 0.5, 0.8)]
    return [each for each in specs if each != spec]


@dataclass(frozen=True)
class System:
    """A system of the benchmark.

    ``network`` names the network of a fold that it uses. The settings of ``grid`` are tried first; then, ``rounds``
    times, settings that differ from the best ones in one value. A system with ``gate_to`` does no search of its own: it
    adds a gate to the best settings of the system of that name.
    """

    title: str
    network: str
    grid: Grid
    rounds: int = 0
    gate_to: str | None = None


SYSTEMS: dict[str, System] = {
    "argmax": System("plain argmax", WINDOWS, _thresholds(0.0)),
    "smoothed": System("smoothed argmax", WINDOWS, _thresholds(*SMOOTHINGS)),
    "hysteresis": System("hysteresis", WINDOWS, _hysteresis, 1),
    "hybrid": System("hybrid (with gate)", WINDOWS, _hysteresis, 1, "hysteresis"),
    "anywhere-smoothed": System("stream training, smoothed argmax", ANYWHERE, _thresholds(*SMOOTHINGS)),
    "anywhere": System("stream training, hysteresis", ANYWHERE, _hysteresis, 1),
    "full": System("stream training, hybrid", ANYWHERE, _hysteresis, 1, "anywhere"),
}
REFERENCE = "smoothed"


@dataclass(frozen=True)
class TunedPoint:
    """A setting with its recall, false events per hour, F1 and median latency (0 without hits) on the tuning people."""

    spec: DecideSpec
    recall: float
    false_per_hour: float
    f1: float = 0.0
    latency_s: float = 0.0


def tried(streams: Sequence[StreamTrace], specs: Sequence[DecideSpec], late_s: float = LATE_S) -> list[TunedPoint]:
    """Score every setting on these streams; settings of equal smoothing run together to save memory."""
    points: dict[int, TunedPoint] = {}
    order = sorted(range(len(specs)), key=lambda i: specs[i].smoothing_s)
    for _, group in itertools.groupby(order, key=lambda i: specs[i].smoothing_s):
        for i in group:
            n = count_events(streams, specs[i], late_s)
            latency_s = float(np.median(n.latencies)) if n.latencies else 0.0
            points[i] = TunedPoint(specs[i], n.recall, n.false_per_hour, n.f1, latency_s)
        for stream in streams:
            stream.replayer.clear_cache()
    return [points[i] for i in range(len(specs))]


def searched(streams: Sequence[StreamTrace], system: System, late_s: float = LATE_S) -> list[TunedPoint]:
    """Try the settings of a system on these streams, without a gate, and return them all with their scores."""
    points = tried(streams, system.grid(streams[0].replayer.trace.gestures), late_s)
    for _ in range(system.rounds):
        known = {_key(p.spec) for p in points}
        more = {_key(s): s for spec in _best_specs(points) for s in _beside(spec)}
        points += tried(streams, [s for key, s in more.items() if key not in known], late_s)
    return points


def gated(
    streams: Sequence[StreamTrace], points: Sequence[TunedPoint], gate: GateSettings, late_s: float = LATE_S
) -> list[TunedPoint]:
    """Score the best of ``points`` with ``gate``, each with several times that a gate's event waits for the network.

    If the gate has no rules, ``points`` are returned unchanged.
    """
    if not gate.rules:
        return list(points)
    # Use every setting that could be chosen without the gate, so that the two systems differ only in the gate.
    base = {_key(spec): spec for spec in (*_best_specs(points), *(p.spec for p in best_of(points)))}
    specs = [replace(spec, gate=gate, wait_s=wait_s) for spec in base.values() for wait_s in _WAITS]
    return tried(streams, specs, late_s)


def _best_specs(points: Sequence[TunedPoint]) -> list[DecideSpec]:
    """Return the setting chosen for each target recall, and the one of the highest F1, without duplicates."""
    best = (*(fewest(points, target) for target in TARGETS), balanced(points))
    return list({_key(p.spec): p.spec for p in best}.values())


def _key(spec: DecideSpec) -> tuple[object, ...]:
    return tuple(value for name, value in vars(spec).items() if name not in ("gate", "health", "fitted"))


def best_of(points: Sequence[TunedPoint]) -> list[TunedPoint]:
    """Return the Pareto front of recall and false events, ordered by rising recall."""
    return [points[i] for i in front([(p.recall, p.false_per_hour) for p in points])]


def fewest(points: Sequence[TunedPoint], recall: float) -> TunedPoint:
    """Return the setting with the fewest false events that reaches ``recall``, or else the one of highest recall."""
    reach = [p for p in points if p.recall >= min(recall, max(p.recall for p in points))]
    return min(reach, key=lambda p: (p.false_per_hour, -p.recall))


def cheapest(
    streams: Sequence[StreamTrace],
    points: Sequence[TunedPoint],
    weights: ErrorCosts | None = None,
    late_s: float = LATE_S,
) -> TunedPoint:
    """Return the setting of the lowest cost among those of `best_of`; of equal ones, that of lower recall."""
    return min(
        best_of(points), key=lambda point: sum(score(stream, point.spec, weights, late_s).cost for stream in streams)
    )


def balanced(points: Sequence[TunedPoint]) -> TunedPoint:
    """Return the setting of the highest F1; of equal ones, that of higher recall."""
    return max(points, key=lambda p: (p.f1, p.recall))


def prompt(points: Sequence[TunedPoint]) -> TunedPoint:
    """Return the setting of the shortest median latency among those whose F1 is within `PROMPT_F1` of the highest."""
    least = balanced(points).f1 - PROMPT_F1
    return min((p for p in points if p.f1 >= least), key=lambda p: (p.latency_s, -p.f1))


def quiet(points: Sequence[TunedPoint]) -> TunedPoint:
    """Return the setting of the highest F1 with at most `QUIET_PER_HOUR` false events; if there is none, the fewest."""
    most = max(QUIET_PER_HOUR, min(p.false_per_hour for p in points))
    return balanced([p for p in points if p.false_per_hour <= most])


def total(
    streams: Sequence[StreamTrace], spec: DecideSpec, weights: ErrorCosts | None = None, late_s: float = LATE_S
) -> StreamScore:
    """Return the summed scores of one setting on several streams."""
    summed = StreamScore()
    for stream in streams:
        summed.add(score(stream, spec, weights, late_s))
    return summed
