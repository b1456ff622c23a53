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
from plushsense.deploy.golden import (
    ANSWER,
    COLUMNS,
    EVENT,
    HEAD,
    HEALTH,
    TRACKING,
    Ints,
    Maker,
    answers_of,
    column,
    measured,
)
from plushsense.models.events import ANSWERS, BEGUN, ENDED, GATE, KINDS, NO_GESTURE, ONE, SOURCES, EventPlan
from plushsense.models.fixed import LOGIT_LIMIT, LogitScale, split_ratio
from plushsense.models.gate import JERK, LEVEL, Gate, GatePlan, Rule, Signal, Term
from plushsense.models.health import HealthPlan
from plushsense.models.image import IntegerModel
from plushsense.models.integer import IntegerDense
from plushsense.models.rules import Rules
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler, inputs

_LEAST_DRILLS, _MOST_DRILLS = 2, 4
_SPREAD = 450  # of a logit over the frames, in steps of 1/256
_AFFECTS: tuple[tuple[str, bool], ...] = (
    ("positive", False),
    ("neutral", True),
    ("negative", False),
    ("none", False),
    ("neutral", False),
)


@dataclass(frozen=True, eq=False)
class Drill:
    """A model, made-up frames (n, 1 + C), the frames after which nothing is heard, the rows (m, 12 + 2 K) they get."""

    model: IntegerModel
    frames: Ints
    silences: tuple[int, ...]
    rows: NDArray[np.int32]


def drills_of(model: IntegerModel, scaler: Scaler) -> list[Drill]:
    """A few drills for a model, the same ones each time: until they reach everything (`reached`), or it is enough.

    Every second one has events that are held for long and end soon, the others such as rather give way to others.
    """
    found: list[Drill] = []
    have: set[str] = set()
    for seed in range(1, _MOST_DRILLS + 1):
        drill = _drill(model, scaler, seed)
        new = reached(drill) - have
        if new or seed <= _LEAST_DRILLS:
            found.append(drill)
            have |= new
        if have >= everything() and seed >= _LEAST_DRILLS:
            break
    return found


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
                if after is not None and after[0] == EVENT and after[at["what"]] == BEGUN and after[frame] == row[frame]:
                    found.add("replaced by the gate" if after[at["source"]] == GATE else "replaced")
                elif after is not None and after[0] == HEALTH and after[frame] == row[frame] and after[state] == 2:
                    found.add("lost in a fault")
                elif row[frame] in drill.silences and row[at["since"]] == row[at["ms"]]:
                    found.add("lost in silence")
                elif after is not None and after[HEAD - 2] > row[HEAD - 2]:
                    found.add("lost in a gap")
    return found


def _drill(model: IntegerModel, scaler: Scaler, seed: int) -> Drill:
    rng = np.random.default_rng(seed)
    health = _health(model, scaler, rng)
    frames, silences = _frames(model, scaler, health, rng)
    plain = replace(model, rules=Rules(), gestures=_gestures(model))
    drilled = _levelled(plain, column_logits(answers_of(plain, frames)))
    drilled = replace(drilled, smoothing=int(rng.choice([6000, 12_000, 1 << 15])))
    shares = column(answers_of(drilled, frames), "confidence")
    known = column(answers_of(drilled, frames), "known")
    tracking = column(answers_of(drilled, frames), "state") == TRACKING
    held = bool(seed % 2)
    events = _events(shares[tracking], known[tracking], held, rng)
    rules = Rules(events, _gate(model, frames, held, rng), health)
    drilled = replace(drilled, rules=rules)
    return Drill(drilled, frames, silences, answers_of(drilled, frames, silences))


def column_logits(rows: NDArray[np.int32]) -> Ints:
    """The logits (n, K) of the answers of a toy that tracks."""
    classes = (rows.shape[1] - HEAD) // 2
    told = (rows[:, 0] == ANSWER) & (rows[:, COLUMNS[ANSWER].index("state")] == TRACKING)
    found: Ints = rows[told, HEAD : HEAD + classes].astype(np.int64)
    return found


def _gestures(model: IntegerModel) -> GestureSet:
    told = [_AFFECTS[k % len(_AFFECTS)] if k < 5 else _AFFECTS[(0, 2, 4)[k % 3]] for k in range(len(model.gestures))]
    gestures = tuple(
        Gesture(g.label, affect, idle=idle) for g, (affect, idle) in zip(model.gestures.gestures, told, strict=True)
    )
    return GestureSet(model.gestures.name, gestures)


def _levelled(model: IntegerModel, logits: Ints) -> IntegerModel:
    """With a last layer whose logits are 0 on the average and all spread alike, so that classes take turns."""
    dense = model.network.dense
    if not len(logits):
        return model
    spread = np.maximum(logits.std(axis=0), 1.0)
    bias, rows = dense.bias.copy(), []
    for k, (mean, own) in enumerate(zip(logits.mean(axis=0), spread, strict=True)):
        before, multiplier, after = (int(getattr(dense.scale, n)[k]) for n in ("before", "multiplier", "after"))
        ratio = max(multiplier, 1) / 2.0 ** (before + after)
        bias[k] -= round(mean / ratio)
        ratio *= float(np.clip(_SPREAD / own, 1 / 64, 64))
        rows.append(split_ratio(ratio, 2 * LOGIT_LIMIT / ratio))
    try:
        level = IntegerDense(dense.weights, bias, LogitScale(*np.array(rows, dtype=np.int64).T))
        return replace(model, network=replace(model.network, dense=level))
    except BundleError:  # a sum could leave 32 bits
        return model


def _events(shares: NDArray[np.int32], known: NDArray[np.int32], held: bool, rng: np.random.Generator) -> EventPlan:
    def share(low: float, high: float) -> int:
        """A share that so many of the steps stay below."""
        return int(np.quantile(shares, rng.uniform(low, high))) if len(shares) else ONE // 2

    def steps(low: int, high: int) -> int:
        return int(rng.integers(low, high + 1))

    enter = share(0.35, 0.6)
    return EventPlan(
        enter=enter,
        leave=min(enter, share(0.2, 0.4) if held else share(0.0, 0.05) // 2),
        enter_affect=min(ONE, share(0.4, 0.7)),
        leave_affect=share(0.1, 0.4),
        sure=int(rng.integers(ONE // 8, ONE // 3)),
        known=int(np.quantile(known, 0.1)) if len(known) else 0,
        least=steps(2, 3),
        switch=steps(2, 4),
        end=steps(1, 2) if held else steps(3, 4),
        hold=steps(5, 9) if held else steps(1, 4),
        rest=steps(1, 4),
        wait=steps(2, 6),
    )


def _health(model: IntegerModel, scaler: Scaler, rng: np.random.Generator) -> HealthPlan:
    """Limits about six spreads from the mean, within what is valid, so that the ends of a range lie beyond."""
    layout = model.layout
    mean, spread = measured(layout, scaler)
    low = np.clip(np.rint(mean - 6 * spread), layout.valid_min_int, layout.valid_max_int).astype(np.int64)
    high = np.clip(np.rint(mean + 6 * spread), layout.valid_min_int, layout.valid_max_int).astype(np.int64)
    times = {name: int(rng.integers(80, 260)) for name in ("fault_ms", "still_ms", "recover_ms")}
    return HealthPlan(tuple(low.tolist()), tuple(high.tolist()), **times)


def _frames(
    model: IntegerModel, scaler: Scaler, health: HealthPlan, rng: np.random.Generator
) -> tuple[Ints, tuple[int, ...]]:
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


def _gate(model: IntegerModel, frames: Ints, rarely: bool, rng: np.random.Generator) -> GatePlan:
    """Signals of every kind, and thresholds that the frames reach now and then; unless ``rarely``, often."""
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
    often = () if rarely else (Rule((term(1, 0.5, 1, 4),), 2, NO_GESTURE, within=0, deaf=3),)
    return GatePlan(
        signals,
        (
            Rule((term(0, 0.97, 1, 2), term(2, 0.8, 0, 1)), 3, NO_GESTURE, within=3, deaf=int(rng.integers(5, 25))),
            Rule((term(3, 0.9, -1, 3), term(1, 0.9, 0, 1)), 1, gesture, within=6, deaf=int(rng.integers(0, 12))),
            Rule((term(2, 0.93, 1, 2), term(3, 0.5, 0, 1), term(1, 0.5, 1, 1)), 0, NO_GESTURE, within=4, deaf=30),
            *often,
        ),
    )
