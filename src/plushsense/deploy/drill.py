"""Drills: an export's network with other rules, so that every line of the rules in its C has something to say.

The rules of a trained model are chosen so that they seldom speak up; on made-up frames, maybe never, and a wrong line
would pass unseen. A drill keeps layers and inputs, shifts and scales the logits so that every class is the best at some
time, tells idle classes and affects otherwise, and takes settings from what the frames really reach: limits of health,
sizes of the gate, shares of the events.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.recfile import Frames
from plushsense.deploy.golden import ANSWER, COLUMNS, EVENT, HEAD, HEALTH, TRACKING, Ints, answers_of, column
from plushsense.deploy.made_frames import Maker, measured
from plushsense.models.events import ANSWERS, BEGUN, ENDED, GATE, KINDS, NO_GESTURE, ONE, SOURCES, EventPlan
from plushsense.models.fixed import LOGIT_LIMIT, PROBABILITY_BITS, LogitScale, split_ratio
from plushsense.models.gate import JERK, LEVEL, Gate, GatePlan, Rule, Signal, Term
from plushsense.models.health import HealthPlan
from plushsense.models.image import IntegerModel
from plushsense.models.integer import IntegerDense
from plushsense.models.rules import Rules
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler, inputs

_SPREAD = 450  # of a logit over the frames, in steps of 1/256
_INSIDE = 8  # of a valid range, at each end: room for a sensor to be stuck there
_AFFECTS: tuple[tuple[str, bool], ...] = (
    ("positive", False),
    ("neutral", True),
    ("negative", False),
    ("none", False),
    ("neutral", False),
)


@dataclass(frozen=True)
class _Course:
    """What a drill is about: with a gate that fires now and then, or ``often``, or none; whether the leave share is
    ``near``, that of entering, so that events end, or far from it, so that they give way to others."""

    gate: bool
    often: bool
    near: bool
    end: tuple[int, int]
    hold: tuple[int, int]
    smoothing: int


COURSES = (
    _Course(True, False, True, (1, 2), (5, 9), 12_000),
    _Course(True, True, False, (3, 4), (1, 4), 6000),
    _Course(False, False, True, (3, 3), (0, 2), 1 << PROBABILITY_BITS),
    _Course(False, False, False, (4, 8), (1, 4), 16_000),
)


@dataclass(frozen=True, eq=False)
class Drill:
    """A model, made-up frames (n, 1 + C), the frames after which nothing is heard, the rows (m, 12 + 2 K) they get."""

    model: IntegerModel
    frames: Ints
    silences: tuple[int, ...]
    rows: NDArray[np.int32]


def drills_of(model: IntegerModel, scaler: Scaler, again: int = 0) -> list[Drill]:
    """A few drills for a model, one of each of `COURSES`: the same ones each time, others for each ``again``."""
    return [
        _drill(replace(model, rules=Rules(), gestures=_gestures(model, course)), scaler, course, seed)
        for seed, course in enumerate(COURSES, 1 + again * len(COURSES))
    ]


def everything() -> set[str]:
    """What drills are to reach; a network whose classes cannot differ may not reach all of it."""
    events = {f"{what} by {source}" for what in KINDS.values() for source in SOURCES}
    ends = {"lost in silence", "lost in a gap", "lost in a fault", "replaced", "replaced by the gate"}
    health = {"fault", "recovery", "suspect only"}
    return events | ends | health | set(ANSWERS) | {"gate while warming", "unnamed", "without affect", "resting"}


def reached(drill: Drill) -> set[str]:
    """Which of `everything` a drill reaches."""
    rows, found = drill.rows.astype(np.int64), set()
    answered = column(rows, "answer")[column(rows, "state") == TRACKING]
    found |= {ANSWERS[k] for k in set(answered.tolist())}
    at = {name: n for n, name in enumerate(COLUMNS[EVENT])}
    state, warm, ended = COLUMNS[ANSWER].index("state"), False, None
    frame = COLUMNS[ANSWER].index("frame")
    for n, row in enumerate(rows.tolist()):
        after = rows[n + 1].tolist() if n + 1 < len(rows) else None
        if row[0] == ANSWER:
            warm = row[state] == TRACKING
        elif row[0] == HEALTH:
            fault, suspect = row[state] == 2, row[5]
            found.add("fault" if fault else "suspect only" if suspect else "recovery")
        else:
            what, source = row[at["what"]], row[at["source"]]
            found.add(f"{KINDS[what]} by {SOURCES[source]}")
            if what == BEGUN:
                if source == GATE and not warm:
                    found.add("gate while warming")
                if row[at["gesture"]] == NO_GESTURE:
                    found.add("unnamed")
                if row[at["affect"]] == 0:
                    found.add("without affect")
                if ended is not None and row[at["ms"]] - ended > 0:
                    found.add("resting")
            if what == ENDED:
                ended = row[at["ms"]]
                if (
                    after is not None
                    and after[0] == EVENT
                    and after[at["what"]] == BEGUN
                    and after[frame] == row[frame]
                ):
                    found.add("replaced by the gate" if after[at["source"]] == GATE else "replaced")
                elif after is not None and after[0] == HEALTH and after[frame] == row[frame] and after[state] == 2:
                    found.add("lost in a fault")
                elif row[frame] in drill.silences and row[at["since"]] == row[at["ms"]]:
                    found.add("lost in silence")
                elif after is not None and after[HEAD - 2] > row[HEAD - 2]:
                    found.add("lost in a gap")
    return found


def _drill(plain: IntegerModel, scaler: Scaler, course: _Course, seed: int) -> Drill:
    rng = np.random.default_rng(seed)
    health = _health(plain, scaler, rng)
    frames, silences = (_troubled if course.gate else _calm)(plain, scaler, health, rng)
    level = _Level(plain, _logits(answers_of(plain, frames)))
    gate = _gate(plain, frames, course.often, rng) if course.gate else GatePlan()
    rules = Rules(_events(level, course, rng), gate, health)
    drilled = replace(level.model, smoothing=course.smoothing, rules=rules)
    return Drill(drilled, frames, silences, answers_of(drilled, frames, silences))


def _logits(rows: NDArray[np.int32]) -> NDArray[np.float64]:
    """The logits (n, K) of the answers of a toy that tracks."""
    classes = (rows.shape[1] - HEAD) // 2
    told = (rows[:, 0] == ANSWER) & (rows[:, COLUMNS[ANSWER].index("state")] == TRACKING)
    return rows[told, HEAD : HEAD + classes].astype(np.float64)


def _gestures(model: IntegerModel, course: _Course) -> GestureSet:
    # Where events give way, mostly to one of the same affect.
    more = (0, 2, 4, 0, 2, 1) if course.near else (0, 0, 0, 2, 0, 1)
    told = [_AFFECTS[k if k < 5 else more[k % 6]] for k in range(len(model.gestures))]
    gestures = tuple(
        Gesture(g.label, affect, idle=idle) for g, (affect, idle) in zip(model.gestures.gestures, told, strict=True)
    )
    return GestureSet(model.gestures.name, gestures)


class _Level:
    """A model with a last layer whose logits (n, K) are 0 on the average and all spread alike, so that classes take
    turns; ``shares`` (n,) of the best class and the highest logits ``known`` (n,) come about as these say."""

    def __init__(self, model: IntegerModel, logits: NDArray[np.float64]) -> None:
        dense = model.network.dense
        mean, spread = logits.mean(axis=0), np.maximum(logits.std(axis=0), 1.0)
        gain = np.clip(_SPREAD / spread, 1 / 64, 64)
        bias, rows = dense.bias.copy(), []
        for k in range(len(gain)):
            before, multiplier, after = (int(getattr(dense.scale, n)[k]) for n in ("before", "multiplier", "after"))
            ratio = max(multiplier, 1) / 2.0 ** (before + after)
            bias[k] -= round(float(mean[k]) / ratio)
            rows.append(split_ratio(ratio * gain[k], 2 * LOGIT_LIMIT / (ratio * gain[k])))
        try:
            level = IntegerDense(dense.weights, bias, LogitScale(*np.array(rows, dtype=np.int64).T))
            self.model = replace(model, network=replace(model.network, dense=level))
            reached = (logits - mean) * gain
        except BundleError:  # a sum could leave 32 bits
            self.model, reached = model, logits
        reached = np.clip(reached, -LOGIT_LIMIT, LOGIT_LIMIT)
        self.known = reached.max(axis=1)
        self.shares = ONE / np.exp((reached - self.known[:, None]) / 256).sum(axis=1)


def _events(level: _Level, course: _Course, rng: np.random.Generator) -> EventPlan:
    def share(low: float, high: float) -> int:
        """A share that so many of the steps stay below."""
        return int(np.quantile(level.shares, rng.uniform(low, high)))

    def steps(low: int, high: int) -> int:
        return int(rng.integers(low, high + 1))

    enter = share(0.35, 0.6)
    return EventPlan(
        enter=enter,
        leave=enter if course.near else share(0.0, 0.05) // 2,
        enter_affect=share(0.4, 0.7),
        leave_affect=share(0.1, 0.4),
        sure=int(rng.integers(ONE // 8, ONE // 3)),
        known=int(np.quantile(level.known, 0.12)),
        least=steps(2, 3),
        switch=steps(2, 4),
        end=steps(*course.end),
        hold=steps(*course.hold),
        rest=steps(1, 4),
        wait=steps(2, 6),
    )


def _health(model: IntegerModel, scaler: Scaler, rng: np.random.Generator) -> HealthPlan:
    """Limits about six spreads from the mean, and inside the valid range, so that its ends lie beyond them."""
    layout = model.layout
    mean, spread = measured(layout, scaler)
    inside = np.minimum(_INSIDE, (layout.valid_max_int - layout.valid_min_int) // 2)
    ends = layout.valid_min_int + inside, layout.valid_max_int - inside
    low, high = (np.clip(np.rint(mean + way * spread), *ends).astype(np.int64) for way in (-6, 6))
    times = {name: int(rng.integers(80, 260)) for name in ("fault_ms", "still_ms", "recover_ms")}
    return HealthPlan(tuple(low.tolist()), tuple(high.tolist()), **times)


def _troubled(
    model: IntegerModel, scaler: Scaler, health: HealthPlan, rng: np.random.Generator
) -> tuple[Ints, tuple[int, ...]]:
    """Blows and failing sensors, also while the network is warming."""
    layout, span = model.layout, model.network.arch.span
    make, silences = Maker(layout, scaler, rng), []
    part = span + 400
    make.touches(part, blows=0.02, garbage=0.05 / len(make.mean))
    for _ in range(4):
        make.touches(int(rng.integers(20, 60)), blows=0.05)
        silences.append(len(make.rows) - 1)
    make.touches(200, lost=0.03, blows=0.02)
    for n in range(40):
        make.touches(7)
        make.frozen(4)
        if n % 2:  # else the gate would only prolong its event
            silences.append(len(make.rows) - 1)
    for _ in range(3):
        make.touches(30, blows=0.2)
        make.wait(layout.gap_ms + 1)
    make.touches(part, blows=0.03)
    make.troubles(health, span + 250)
    make.now = 7
    make.touches(part, garbage=0.15 / len(make.mean), blows=0.02)
    return np.array(make.rows, dtype=np.int64), tuple(silences)


def _calm(
    model: IntegerModel, scaler: Scaler, health: HealthPlan, rng: np.random.Generator
) -> tuple[Ints, tuple[int, ...]]:
    """Touches for long, now and then a frame in doubt, or silence."""
    make, silences = Maker(model.layout, scaler, rng), []
    make.touches(model.network.arch.span)
    for n in range(24):
        make.touches(170, garbage=(0.08 if n % 2 else 0.01) / len(make.mean))
        silences.append(len(make.rows) - 1)
    return np.array(make.rows, dtype=np.int64), tuple(silences)


def _gate(model: IntegerModel, frames: Ints, often: bool, rng: np.random.Generator) -> GatePlan:
    """Signals of every kind, and thresholds that the frames reach now and then, or ``often``."""
    arch, layout = model.network.arch, model.layout
    segments = [inputs(s.data, layout) for s in resample(Frames(frames[:, 1:], frames[:, 0]), layout) if len(s)]
    rows = max(segments, key=len)
    reach = int(np.abs(rows).max()).bit_length()

    def some(n: int) -> tuple[int, ...]:
        return tuple(int(i) for i in rng.integers(0, arch.channels, n))

    several, lag = some(min(3, arch.channels)), int(rng.integers(2, 5))
    signals = (
        Signal(JERK, several, lag=lag, shift=max(0, reach - 18), baseline=3, noise=4, floor=2),
        Signal(JERK, some(2), lag=1, shift=max(0, reach - 12), baseline=6, noise=6, floor=1),
        Signal(LEVEL, some(1), shift=max(0, reach - 20), baseline=5, noise=5, floor=3),
        Signal(LEVEL, some(1), shift=max(0, reach - 8), baseline=2, noise=7, floor=4),
    )
    loud = Rule((Term(0, 1 << 25),), 0, NO_GESTURE)
    gate = Gate(GatePlan(signals, (loud,)))
    sizes = np.array([(gate.push(row), list(gate.sizes))[1] for row in rows.tolist()])

    def term(signal: int, quantile: float, sign: int, times: int) -> Term:
        return Term(signal, max(1, int(np.quantile(sizes[:, signal], quantile, method="lower"))), sign, times)

    gesture = int(rng.integers(0, arch.classes))
    more = (Rule((term(1, 0.5, 1, 4),), 2, NO_GESTURE, within=0, deaf=3),) if often else ()
    return GatePlan(
        signals,
        (
            Rule((term(0, 0.97, 1, 2), term(2, 0.8, 0, 1)), 3, NO_GESTURE, within=3, deaf=int(rng.integers(5, 25))),
            Rule((term(3, 0.9, -1, 3), term(1, 0.9, 0, 1)), 1, gesture, within=6, deaf=int(rng.integers(0, 12))),
            Rule((term(2, 0.93, 1, 2), term(3, 0.5, 0, 1), term(1, 0.5, 1, 1)), 0, NO_GESTURE, within=4, deaf=30),
            *more,
        ),
    )
