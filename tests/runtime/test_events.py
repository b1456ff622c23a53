"""From logits to events: every rule of the room's docstring, each by a stream that shows it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import BundleError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.runtime.classifier import events_of
from plushsense.runtime.events import (
    AFFECT,
    AFFECT_CODES,
    ANSWERS,
    BEGUN,
    CNN,
    ENDED,
    GATE,
    IDLE,
    MOST_STEPS,
    NAMED,
    NO_GESTURE,
    ONE,
    SURE,
    UNKNOWN,
    UNSURE,
    EventMachine,
    EventSettings,
    Update,
)
from plushsense.runtime.fixed import LOGIT_LIMIT, known_score, smooth, softmax

STROKE, SCRATCH, HOLD, HIT, PULL, REST, THING = range(7)
SET = GestureSet(
    "seven",
    (
        Gesture("stroke", "positive"),
        Gesture("scratch", "positive"),
        Gesture("hold", "neutral"),
        Gesture("hit", "negative"),
        Gesture("pull", "negative"),
        Gesture("rest", "neutral", idle=True),
        Gesture("thing"),
    ),
)
POSITIVE, NEUTRAL, NEGATIVE = (AFFECT_CODES[a] for a in ("positive", "neutral", "negative"))
UNSMOOTHED = ONE
SETTINGS = EventSettings(
    enter=round(0.6 * ONE), leave=round(0.3 * ONE), enter_affect=round(0.8 * ONE), leave_affect=round(0.4 * ONE),
    least=3, switch=5, end=4,
)  # fmt: skip


def logits(shares: dict[int, float], most: float = 10.0, classes: int = 7) -> np.ndarray:
    """Logits of about these probabilities, the rest spread evenly; the highest is ``most``."""
    rest = (1 - sum(shares.values())) / max(1, classes - len(shares))
    logs = np.log([max(shares.get(k, rest), 1e-9) for k in range(classes)])
    return np.clip(np.rint((logs - logs.max() + most) * 256), -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.int64)


IDLE_CLASSES = np.array([g.idle for g in SET.gestures])


def sure_of(gesture: int) -> dict[int, float]:
    return {gesture: 0.94}


STROKES, SCRATCHES, HITS, HOLDS, RESTS = (sure_of(k) for k in (STROKE, SCRATCH, HIT, HOLD, REST))
BOTH_POSITIVE = {STROKE: 0.47, SCRATCH: 0.47}
BOTH_NEGATIVE = {HIT: 0.47, PULL: 0.47}
NOTHING: dict[int, float] = {}


def played(
    steps: list[dict[int, float]],
    settings: EventSettings = SETTINGS,
    *,
    gate: dict[int, tuple[int, int]] | None = None,
    suspect: range = range(0),
    gestures: GestureSet = SET,
    machine: EventMachine | None = None,
) -> list[tuple[int, str, int, int, int, int]]:
    """(step, what, affect, gesture, number, since) of every update; the gate fires before the step."""
    machine = machine or EventMachine(settings, UNSMOOTHED, gestures)
    found: list[Update] = []
    for now, shares in enumerate(steps):
        if gate and now in gate:
            found += machine.gate(*gate[now], now)
        _, updates = machine.step(logits(shares, classes=len(gestures.gestures)), now, now in suspect)
        found += updates
    names = {BEGUN: "begun", NAMED: "named", ENDED: "ended"}
    return [(u.now, names[u.kind], u.affect, u.gesture, u.number, u.since) for u in found]


def answered(shares: dict[int, float], settings: EventSettings = SETTINGS, most: float = 10.0) -> str:
    answer, _ = EventMachine(settings, UNSMOOTHED, SET).step(logits(shares, most), 0)
    return ANSWERS[answer.kind]


# 1. Smoothing


def test_the_known_score_of_few_gestures() -> None:
    logits = np.array([[30, -20, 7, 11]])
    for idle, score in (
        ([False] * 4, 30 - 7),
        ([False, True, True, False], 30 + LOGIT_LIMIT),
        ([False, True, True, True], 30 + LOGIT_LIMIT),
        ([True] * 4, 0),
    ):
        assert known_score(logits, np.array(idle)).tolist() == [min(score, LOGIT_LIMIT)]


def test_probabilities_and_the_known_score_are_smoothed_alike() -> None:
    machine = EventMachine(SETTINGS, 6000, SET)
    mean = None
    for at, (shares, most) in enumerate([(STROKES, 9.0), (HITS, 3.0), (HITS, -2.0), (NOTHING, 20.0)]):
        row = logits(shares, most)
        mean = smooth(mean, np.append(softmax(row), known_score(row, IDLE_CLASSES)), 6000)
        answer, _ = machine.step(row, at)
        assert machine.mean is not None
        np.testing.assert_array_equal(machine.mean, mean)
        assert answer.known == int(mean[-1]) >> 12
        assert answer.share == int(mean[:-1].max()) >> 12
        assert answer.best == int(mean[:-1].argmax())


def test_of_two_that_look_equal_the_best_is_the_one_with_more_bits_and_of_equal_ones_the_first() -> None:
    machine = EventMachine(SETTINGS, 1, SET)
    both = logits({SCRATCH: 0.4, HIT: 0.4})
    assert machine.step(both, 0)[0].best == SCRATCH
    assert machine.mean is not None
    machine.mean[HIT] += 1  # less than a step of a share
    assert machine.step(both, 1)[0].best == HIT
    shares = machine.mean >> 12
    assert shares[HIT] == shares[SCRATCH]


# 2. The answer of a step


def test_the_kinds_of_an_answer() -> None:
    settings = replace(SETTINGS, sure=round(0.3 * ONE))
    # The logit of the stroke is log(94) = 4.54 above all others.
    assert answered(STROKES, replace(settings, known=round(4.6 * 256))) == "unknown"
    assert answered(STROKES, replace(settings, known=round(4.5 * 256))) == "sure"
    assert answered(STROKES, replace(settings, known=round(4.5 * 256)), most=-5.0) == "sure", "its height is no matter"
    assert answered(BOTH_POSITIVE, replace(settings, known=round(3.6 * 256))) == "affect", "two gestures stand out"
    assert answered({STROKE: 0.3, SCRATCH: 0.3, HIT: 0.3}, replace(settings, known=256)) == "unknown", "three do not"
    assert answered(RESTS, replace(settings, known=256)) == "idle", "idle goes before unknown"
    assert answered({REST: 0.4, HIT: 0.3}, settings) == "idle", "the best class is idle, sure or not"
    assert answered(BOTH_POSITIVE, settings) == "affect"
    assert answered({STROKE: 0.45, HIT: 0.45}, settings) == "unsure", "two affects"
    assert answered(NOTHING, settings) == "unsure", "no class is in the set"
    assert answered({THING: 0.6, STROKE: 0.32}, settings) == "unsure", "a class without a told affect"
    assert answered({HOLD: 0.5, REST: 0.4}, settings) == "unsure", "an idle class in the set, though of the same affect"
    assert answered({THING: 0.6, STROKE: 0.2}, settings) == "sure", "one class needs no affect"
    untold = GestureSet("untold", tuple(Gesture(g) for g in "abc"))
    answer, _ = EventMachine(settings, UNSMOOTHED, untold).step(logits({0: 0.47, 1: 0.47}, classes=3), 0)
    assert answer.kind == UNSURE, "none is no affect that could be told"
    assert tuple(range(5)) == (IDLE, UNKNOWN, UNSURE, AFFECT, SURE) and len(ANSWERS) == 5


def test_a_class_of_exactly_sure_is_in_the_set_and_known_exactly_is_known() -> None:
    row = logits({STROKE: 0.5, HIT: 0.4})
    shares = softmax(row)
    machine = EventMachine(
        replace(SETTINGS, sure=int(shares[HIT]), known=int(known_score(row, IDLE_CLASSES))), UNSMOOTHED, SET
    )
    assert machine.step(row, 0)[0].kind == UNSURE
    machine = EventMachine(replace(SETTINGS, sure=int(shares[HIT]) + 1), UNSMOOTHED, SET)
    assert machine.step(row, 0)[0].kind == SURE


# 3. What a step wants


def test_a_gesture_is_wanted_from_enter_on_an_affect_by_its_classes_together_and_nothing_while_idle_or_unknown() -> (
    None
):
    assert played([{STROKE: 0.62}] * 3)[0][1:4] == ("begun", POSITIVE, STROKE)
    assert played([{STROKE: 0.58, HIT: 0.4}] * 9) == []
    assert played([BOTH_NEGATIVE] * 3)[0][1:4] == ("begun", NEGATIVE, NO_GESTURE)
    assert played([{HIT: 0.38, PULL: 0.38, STROKE: 0.24}] * 9) == []
    assert played([RESTS] * 9) == []
    assert played([{HOLD: 0.41, REST: 0.57}] * 9) == [], "idle"
    assert played([{HOLD: 0.5, REST: 0.48}] * 9) == [], "an idle class counts for no affect"
    assert played([STROKES] * 9, replace(SETTINGS, known=5 * 256)) == [], "unknown"
    assert played([STROKES] * 9, replace(SETTINGS, known=4 * 256)) != []


def test_exactly_enter_is_enough_and_exactly_leave_stays() -> None:
    shares = softmax(logits(STROKES))
    for more, n in ((0, 1), (1, 0)):
        by_gesture = replace(SETTINGS, enter=int(shares[STROKE]) + more, enter_affect=ONE + 1)
        assert len(played([STROKES] * 9, by_gesture)) == n
        alone = replace(SETTINGS, enter=ONE + 1, enter_affect=int(shares[STROKE] + shares[SCRATCH]) + more)
        assert len(played([STROKES] * 9, alone)) == n
    low = {STROKE: 0.28}
    at = int(softmax(logits(low))[STROKE])
    assert len(played([STROKES] * 3 + [low] * 9, replace(SETTINGS, leave=at))) == 1
    assert len(played([STROKES] * 3 + [low] * 9, replace(SETTINGS, leave=at + 1))) == 2


def test_of_two_affects_of_equal_weight_the_first_code_is_wanted() -> None:
    settings = replace(SETTINGS, enter=ONE + 1, enter_affect=round(0.4 * ONE), least=1)
    row = np.zeros(7, dtype=np.int64) - 5000
    row[[SCRATCH, PULL]] = 0
    _, updates = EventMachine(settings, UNSMOOTHED, SET).step(row, 0)
    assert updates[0].affect == POSITIVE


# 4. Beginning


def test_an_event_begins_when_the_same_was_wanted_for_least_steps_in_a_row() -> None:
    assert played([STROKES] * 2 + [NOTHING] + [STROKES] * 2) == []
    assert played([NOTHING, STROKES, STROKES, STROKES]) == [(3, "begun", POSITIVE, STROKE, 1, 1)]
    # The same affect is the same; the gesture that only just came is not said.
    assert played([STROKES, STROKES, SCRATCHES]) == [(2, "begun", POSITIVE, NO_GESTURE, 1, 0)]
    assert played([STROKES, BOTH_POSITIVE, BOTH_POSITIVE]) == [(2, "begun", POSITIVE, NO_GESTURE, 1, 0)]
    assert played([STROKES, HITS, STROKES, HITS] * 3) == []
    # Where no affect is told it must be the same gesture.
    plain = GestureSet("plain", tuple(Gesture(g) for g in "abc"))
    assert played([{0: 0.9}, {0: 0.9}, {1: 0.9}, {1: 0.9}], gestures=plain) == []
    assert played([{1: 0.9}] * 3, gestures=plain) == [(2, "begun", 0, 1, 1, 0)]


def test_affect_first_then_the_gesture_once() -> None:
    found = played([BOTH_NEGATIVE] * 4 + [HITS] * 3 + [BOTH_NEGATIVE] * 2 + [HITS] * 5)
    assert found == [(2, "begun", NEGATIVE, NO_GESTURE, 1, 0), (6, "named", NEGATIVE, HIT, 1, 0)]


def test_being_named_breaks_the_row_of_misses() -> None:
    settings = replace(SETTINGS, leave_affect=ONE + 1)
    found = played([BOTH_NEGATIVE] * 3 + [HITS] * 3 + [{HIT: 0.1}] * 9, settings)
    assert [f[:2] for f in found] == [(2, "begun"), (5, "named"), (9, "ended")]


def test_no_event_begins_within_rest_steps_of_the_last() -> None:
    stream = [STROKES] * 3 + [NOTHING] * 4 + [HITS] * 10
    assert [f[0] for f in played(stream)] == [2, 6, 9]
    for rest in (4, 6):
        settings = replace(SETTINGS, rest=rest)
        begun = played(stream, settings)[-1]
        assert begun[:2] == (6 + rest + 1, "begun") and begun[5] == 7, "it was wanted all the while"


# 5. In an event


def test_another_takes_its_place_after_switch_steps_in_a_row_and_hold() -> None:
    start = [STROKES] * 3
    for other, what in ((HITS, (NEGATIVE, HIT)), (SCRATCHES, (POSITIVE, SCRATCH)), (BOTH_NEGATIVE, (NEGATIVE, 255))):
        settings = replace(SETTINGS, end=9)
        assert played(start + [other] * 4 + [STROKES] + [other] * 4, settings)[1:] == [], "not in a row"
        assert played(start + [other] * 5, settings)[1:] == [
            (7, "ended", POSITIVE, STROKE, 1, 7),
            (7, "begun", *what, 2, 7),
        ]
        held = played(start + [other] * 12, replace(SETTINGS, end=50, hold=8))
        assert [f[:2] for f in held] == [(2, "begun"), (10, "ended"), (10, "begun")]
    # An affect wanted without a gesture is no other than the event's own.
    assert played(start + [BOTH_POSITIVE] * 20) == played(start)


def test_a_gesture_of_its_own_affect_names_it_and_replaces_nothing() -> None:
    settings = replace(SETTINGS, switch=1, least=4)
    assert played([BOTH_POSITIVE] * 4 + [SCRATCHES] * 5, settings) == [
        (3, "begun", POSITIVE, NO_GESTURE, 1, 0),
        (7, "named", POSITIVE, SCRATCH, 1, 0),
    ]


def test_it_ends_after_end_steps_below_leave_in_a_row() -> None:
    start, low, kept = [STROKES] * 3, {STROKE: 0.28}, {STROKE: 0.32}
    assert played(start + [low] * 3 + [kept] + [low] * 3) == played(start)
    assert played(start + [low] * 4)[-1] == (6, "ended", POSITIVE, STROKE, 1, 3)
    assert played(start + [low] * 4, replace(SETTINGS, hold=6))[1:] == []
    assert played(start + [low] * 6, replace(SETTINGS, hold=6))[-1] == (8, "ended", POSITIVE, STROKE, 1, 3)
    # One without a gesture goes by its affect's classes together.
    first = [BOTH_NEGATIVE] * 3
    assert played(first + [{HIT: 0.21, PULL: 0.21, STROKE: 0.5}] * 9) == played(first)
    assert played(first + [{HIT: 0.19, PULL: 0.19, STROKE: 0.5}] * 4)[-1][:2] == (6, "ended")
    # Unknown is no reason to end.
    machine = EventMachine(replace(SETTINGS, known=2 * 256), UNSMOOTHED, SET)
    vague = {STROKE: 0.5, SCRATCH: 0.25, HIT: 0.25}
    found = [u for now in range(20) for u in machine.step(logits(STROKES if now < 3 else vague), now)[1]]
    assert len(found) == 1


def test_it_ends_when_the_best_class_is_idle_and_reached_enter() -> None:
    settings = replace(SETTINGS, leave=0)
    start = [STROKES] * 3
    assert played(start + [{REST: 0.62, STROKE: 0.38}] * 4, settings)[-1][:2] == (6, "ended")
    assert played(start + [{REST: 0.58, STROKE: 0.42}] * 9, settings) == played(start, settings)
    # Taken at its word (enter 0), an idle class that is not the best ends nothing.
    assert played([STROKES] * 3 + [{STROKE: 0.6, REST: 0.4}] * 9, EventSettings()) == [
        (0, "begun", POSITIVE, STROKE, 1, 0)
    ]


def test_the_defaults_are_plain_argmax() -> None:
    found = played([STROKES, HITS, BOTH_POSITIVE, RESTS, RESTS, HITS], EventSettings())
    assert [f[:4] for f in found] == [
        (0, "begun", POSITIVE, STROKE),
        (1, "ended", POSITIVE, STROKE),
        (1, "begun", NEGATIVE, HIT),
        (2, "ended", NEGATIVE, HIT),
        (2, "begun", POSITIVE, STROKE),
        (3, "ended", POSITIVE, STROKE),
        (5, "begun", NEGATIVE, HIT),
    ]


# The gate


def test_the_gates_event_begins_at_once_also_in_the_rest() -> None:
    settings = replace(SETTINGS, rest=50)
    found = played([STROKES] * 3 + [NOTHING] * 5, settings, gate={7: (NEGATIVE, NO_GESTURE)})
    assert found[-1] == (7, "begun", NEGATIVE, NO_GESTURE, 2, 7)


def test_the_gate_and_the_network_make_one_event_not_two() -> None:
    settings = replace(SETTINGS, wait=10)
    found = played([NOTHING] * 2 + [HITS] * 6, settings, gate={1: (NEGATIVE, NO_GESTURE)})
    assert found == [(1, "begun", NEGATIVE, NO_GESTURE, 1, 1), (4, "named", NEGATIVE, HIT, 1, 1)]
    # The other way round: the network has begun, then the gate fires of the same affect.
    found = played([HITS] * 4 + [NOTHING] * 20, settings, gate={3: (NEGATIVE, NO_GESTURE)})
    assert [f[:2] for f in found] == [(2, "begun"), (16, "ended")], "and prolongs it: 10 to wait, then 4 to end"
    # It had been missed for 3 steps: that is forgotten.
    found = played([HITS] * 3 + [NOTHING] * 20, replace(SETTINGS, wait=0), gate={6: (NEGATIVE, NO_GESTURE)})
    assert found[1:] == [(9, "ended", NEGATIVE, HIT, 1, 6)]
    # One of another affect gives way at once.
    found = played([STROKES] * 4, settings, gate={3: (NEGATIVE, NO_GESTURE)})
    assert [f[:4] for f in found[1:]] == [(3, "ended", POSITIVE, STROKE), (3, "begun", NEGATIVE, NO_GESTURE)]


def test_what_the_gate_began_is_neither_ended_nor_replaced_for_wait_steps() -> None:
    settings = replace(SETTINGS, wait=10, switch=1, end=1)
    found = played([STROKES] * 12, settings, gate={0: (NEGATIVE, NO_GESTURE)})
    assert [f[:4] for f in found[1:]] == [(10, "ended", NEGATIVE, NO_GESTURE), (10, "begun", POSITIVE, STROKE)]
    found = played([NOTHING] * 14, settings, gate={0: (NEGATIVE, NO_GESTURE)})
    assert found[1:] == [(10, "ended", NEGATIVE, NO_GESTURE, 1, 10)]


def test_a_gate_that_fires_again_prolongs_its_event_whatever_its_affect() -> None:
    settings = replace(SETTINGS, wait=5)
    for affect in (NEGATIVE, POSITIVE):
        found = played([NOTHING] * 20, settings, gate={0: (NEGATIVE, NO_GESTURE), 4: (affect, NO_GESTURE)})
        assert [f[:3] for f in found] == [(0, "begun", NEGATIVE), (12, "ended", NEGATIVE)]


def test_a_gate_that_tells_no_affect_takes_that_of_the_gesture_that_names_it() -> None:
    settings = replace(SETTINGS, wait=10)
    found = played([HITS] * 5, settings, gate={0: (0, NO_GESTURE)})
    assert found == [(0, "begun", 0, NO_GESTURE, 1, 0), (2, "named", NEGATIVE, HIT, 1, 0)]
    for nothing_known in (NOTHING, {THING: 0.5, HIT: 0.3}):
        assert played([nothing_known] * 20, settings, gate={0: (0, NO_GESTURE)})[-1][:2] == (13, "ended")


def test_source_tells_who_began() -> None:
    machine = EventMachine(replace(SETTINGS, wait=9), UNSMOOTHED, SET)
    assert [u.source for u in machine.gate(NEGATIVE, NO_GESTURE, 0)] == [GATE]
    updates = [u for now in range(4) for u in machine.step(logits(HITS), now)[1]]
    assert [(u.kind, u.source) for u in updates] == [(NAMED, GATE)], "though the network named it"
    machine.reset()
    updates = [u for now in range(4) for u in machine.step(logits(HITS), now)[1]]
    assert [(u.kind, u.source) for u in updates] == [(BEGUN, CNN)]


def test_while_warming_an_event_of_the_gate_ends_in_its_time() -> None:
    machine = EventMachine(replace(SETTINGS, wait=6, end=4, hold=0), UNSMOOTHED, SET)
    assert machine.blind_step(0) == []
    machine.gate(NEGATIVE, NO_GESTURE, 0)
    found = [u for now in range(1, 20) for u in machine.blind_step(now)]
    assert [(u.kind, u.since, u.now) for u in found] == [(ENDED, 7, 10)]
    machine = EventMachine(replace(SETTINGS, wait=6, end=4, hold=15), UNSMOOTHED, SET)
    machine.gate(NEGATIVE, NO_GESTURE, 0)
    found = [u for now in range(1, 20) for u in machine.blind_step(now)]
    assert [(u.kind, u.since, u.now) for u in found] == [(ENDED, 7, 15)]


# Suspect steps


def test_a_suspect_step_neither_counts_nor_breaks_a_row() -> None:
    assert played([STROKES] * 20, suspect=range(20)) == []
    # Two before and one after make three in a row, whatever the suspect ones said.
    stream = [STROKES] * 2 + [HITS] * 5 + [STROKES]
    assert played(stream, suspect=range(2, 7)) == [(7, "begun", POSITIVE, STROKE, 1, 0)]
    start, low = [STROKES] * 3, {STROKE: 0.1}
    assert played([*start, *[low] * 20], suspect=range(3, 23)) == played(start), "it ends nothing"
    between = [*start, *[low] * 3, STROKES, STROKES, low]
    assert played(between, suspect=range(6, 8))[-1] == (8, "ended", POSITIVE, STROKE, 1, 3), "nor breaks that row"
    assert played([*start, *[HITS] * 20], suspect=range(3, 23)) == played(start), "and replaces nothing"
    assert played([*[BOTH_POSITIVE] * 3, *[STROKES] * 9], suspect=range(3, 12)) == played([BOTH_POSITIVE] * 3)


# Losing the signal


def test_when_the_signal_is_lost_its_event_ends_and_all_but_the_count_is_forgotten() -> None:
    settings = replace(SETTINGS, rest=50)
    machine = EventMachine(settings, 3000, SET)
    for now in range(60):
        machine.step(logits(STROKES), now)
    lost = machine.lost(70)
    assert [(u.kind, u.number, u.gesture, u.since, u.now) for u in lost] == [(ENDED, 1, STROKE, 70, 70)]
    assert machine.lost(71) == [] and machine.mean is None
    fresh = EventMachine(settings, 3000, SET)
    fresh.number = 1
    for now in range(80, 130):
        row = logits(HITS if now % 20 < 12 else NOTHING)
        assert machine.step(row, now) == fresh.step(row, now)
    machine.reset()
    assert machine.number == 0


# One odd step

SHARES = st.sampled_from([STROKES, SCRATCHES, HITS, HOLDS, RESTS, BOTH_POSITIVE, BOTH_NEGATIVE, NOTHING])
PLANS = st.builds(
    EventSettings,
    enter=st.integers(0, ONE + 1),
    leave=st.integers(0, ONE + 1),
    enter_affect=st.integers(0, ONE + 1),
    leave_affect=st.integers(0, ONE + 1),
    sure=st.integers(0, ONE + 1),
    known=st.integers(-3000, 3000),
    least=st.integers(1, 6),
    switch=st.integers(1, 6),
    end=st.integers(1, 6),
    hold=st.integers(0, 9),
    rest=st.integers(0, 9),
    wait=st.integers(0, 9),
)


@settings(max_examples=80)
@given(PLANS, SHARES, st.integers(5, 30), st.integers(0, 32767))
@pytest.mark.slow
def test_a_single_step_never_flips_a_hug_to_a_hit(
    settings: EventSettings, odd: dict[int, float], at: int, smoothing: int
) -> None:
    settings = replace(settings, switch=max(2, settings.switch), least=max(2, settings.least))
    machine = EventMachine(settings, UNSMOOTHED, SET)
    for now in range(60):
        _, updates = machine.step(logits(odd if now == at else STROKES), now)
        assert all(u.affect == POSITIVE and u.gesture in (STROKE, NO_GESTURE) for u in updates), now


@settings(max_examples=100)
@given(
    PLANS,
    st.lists(st.tuples(SHARES, st.integers(0, 19)), min_size=1, max_size=80),
    st.sampled_from([UNSMOOTHED, 9000]),
)
@pytest.mark.slow
def test_events_follow_one_another_whatever_comes(settings: EventSettings, stream: list[Any], smoothing: int) -> None:
    """Begun, perhaps named once, ended; numbers go up by one; ``hold`` and ``rest`` are kept; what is said fits."""
    machine = EventMachine(settings, smoothing, SET)
    going: Update | None = None
    named, number, began, ended, steps = False, 0, 0, -99, 0
    for now, (shares, what) in enumerate(stream):
        batches = []
        if what in (0, 1):
            batches.append((machine.gate((NEGATIVE, POSITIVE)[what], NO_GESTURE, now), "gate"))
        if what == 2:
            batches.append((machine.lost(now), "lost"))
        elif what == 3:
            batches.append((machine.blind_step(now), "step"))
        else:
            batches.append((machine.step(logits(shares), now, suspect=what == 4)[1], "step"))
        for updates, cause in batches:
            switched, open_before = len(updates) == 2, going is not None
            for u in updates:
                assert u.since <= u.now == now
                if u.kind == BEGUN:
                    assert going is None and u.number == number + 1
                    if cause == "step" and not switched:
                        assert steps - ended > settings.rest
                    going, number, named, began = u, u.number, u.gesture != NO_GESTURE, steps
                elif u.kind == NAMED:
                    assert going is not None and not named and u.number == number and u.gesture != NO_GESTURE
                    assert u.affect == going.affect == AFFECT_CODES[SET.affects[u.gesture]]
                    named = True
                else:
                    assert going is not None and u.number == number
                    if cause == "step":
                        assert steps + 1 - began >= settings.hold and what != 4
                    going, ended = None, -99 if cause == "lost" else steps
            if cause == "step" and (what != 3 or open_before):
                steps += 1
            if cause == "lost":
                ended = -99
        assert machine.open == (going is not None)


def test_updates_as_events_with_labels_and_seconds() -> None:
    updates = [
        Update(NAMED, 2, NEGATIVE, HIT, GATE, 5_000_000, 9_000_000),
        Update(ENDED, 2, 0, NO_GESTURE, CNN, 5_000_000, 9_000_000),
    ]
    named, ended = (event.to_dict() for event in events_of(updates, SET))
    assert named == {
        "what": "named", "number": 2, "affect": "negative", "gesture": "hit", "source": "gate", "since_s": 5, "t_s": 9,
    }  # fmt: skip
    assert (ended["gesture"], ended["affect"], ended["source"]) == (None, "none", "cnn")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("enter", ONE + 2), ("leave", -1), ("least", 0), ("switch", 0), ("end", MOST_STEPS + 1), ("hold", -1),
        ("rest", 1.5), ("wait", True), ("known", LOGIT_LIMIT + 1), ("sure", math.nan), ("enter_affect", None),
    ],
)  # fmt: skip
def test_a_setting_that_the_toy_could_not_hold_is_refused(name: str, value: Any) -> None:
    with pytest.raises(BundleError, match=name):
        EventSettings(**{name: value})


@given(st.data())
@pytest.mark.slow
def test_many_steps_at_once_are_those_steps_one_by_one(data: st.DataObject) -> None:
    """`skip` and `stay` leave the machine as `follow` does."""
    machine = EventMachine(replace(SETTINGS, rest=3, wait=4, hold=2), UNSMOOTHED, SET)
    candidates = st.sampled_from(
        [(NO_GESTURE, 0), (STROKE, POSITIVE), (SCRATCH, POSITIVE), (NO_GESTURE, POSITIVE), (THING, 0)]
    )
    now = 0
    for gesture, affect in data.draw(st.lists(candidates, max_size=14)):
        if data.draw(st.sampled_from([False, False, True])):
            machine.gate(POSITIVE, data.draw(st.sampled_from([NO_GESTURE, STROKE])), now)
        machine.follow([ONE // 7] * 7, STROKE, gesture, affect, now)
        now += 1
    steps = data.draw(st.integers(1, 6))
    one_by_one = copy.deepcopy(machine)
    if not machine.open:
        for at in range(steps):
            assert one_by_one.follow([], STROKE, NO_GESTURE, 0, now + at) == []
        machine.skip(steps, now)
    elif machine.gesture != NO_GESTURE or machine.affect:
        stays = [(NO_GESTURE, 0), (NO_GESTURE, machine.affect), (machine.gesture, machine.affect)]
        gesture, affect = data.draw(st.sampled_from(stays))
        for at in range(steps):
            assert one_by_one.follow([ONE] * 7, STROKE, gesture, affect, now + at) == []
        machine.stay(steps, gesture, affect, now)
    else:
        return
    # The time of the first step away only counts while steps are away.
    apart = {"_idle", "_away_since"}
    assert {k: v for k, v in vars(machine).items() if k not in apart} == {
        k: v for k, v in vars(one_by_one).items() if k not in apart
    }
