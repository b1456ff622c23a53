"""The search finds what suits people, and its costs are those that are stated."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.models.arch import Arch
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import AFFECT_CODES, NO_GESTURE
from plushsense.runtime.replay import TraceReplayer
from plushsense.runtime.trace import Part, Trace
from plushsense.scoring.events import ErrorCosts
from plushsense.tuning.events import (
    OTHER,
    MarkedStream,
    TimedEvent,
    Truth,
    compare_costs,
    event_costs,
    timed_events,
    tune,
)

SET = GestureSet(
    "five",
    (
        Gesture("rest", "neutral", idle=True),
        Gesture("stroke", "positive", family="touch"),
        Gesture("pat", "positive", family="touch"),
        Gesture("hug", "positive"),
        Gesture("hit", "negative"),
    ),
)
PLAIN = GestureSet("two", (Gesture("a"), Gesture("b")))
POSITIVE, NEGATIVE = AFFECT_CODES["positive"], AFFECT_CODES["negative"]
S = 1_000_000


def heard(*truths):
    arch = Arch.parse("5d1", (4,), channels=3, classes=5, padding="stream", window=48, step=5)
    return MarkedStream("P1", Trace(arch, 10_000, SET, 0, (), 0), truths)


def said(gesture, at_s, until_s=None, affect=POSITIVE, named_s=None):
    named = at_s if named_s is None else named_s
    return TimedEvent(int(at_s * S), affect, gesture, int(named * S), int((until_s or at_s + 1) * S))


STROKE = Truth(10 * S, 12 * S, 1)


@pytest.mark.parametrize(
    ("events", "cost"),
    [
        ([], 2.0),
        ([said(1, 10)], 0.0),
        ([said(1, 11)], 0.4),
        ([said(1, 12.9)], 1.16),
        ([said(1, 13.1)], 2.5),  # too late to be its own: missed, and one of which nobody knows
        ([said(1, 10, named_s=11)], 0.4),
        ([said(NO_GESTURE, 11)], 1.4),
        ([said(NO_GESTURE, 11, affect=NEGATIVE)], 5.0),
        ([said(2, 10)], 1.0),
        ([said(3, 10)], 2.0),
        ([said(4, 10, affect=NEGATIVE)], 5.0),
        ([said(4, 10, affect=NEGATIVE), said(1, 11)], 0.4 + 0.5 + 2.5),
        ([said(1, 10), said(1, 11)], 0.0 + 0.5),
        ([said(1, 9.8)], 0.0),
        ([said(1, 5, 11.5)], 0.0 + 0.5),  # it went on from before: right, though it began where nobody knows
        ([said(1, 5, 10.5)], 2.0 + 0.5),
        ([said(4, 30)], 2.0 + 3.0),  # in a stretch at rest
        ([said(4, 50)], 2.0),  # in a gesture that the network does not know
        ([said(4, 70)], 2.0 + 0.5),
    ],
)
def test_costs_are_those_that_are_stated(events, cost):
    truths = (STROKE, Truth(29 * S, 32 * S, 0), Truth(49 * S, 52 * S, OTHER))
    assert event_costs(heard(*truths), events, SET, ErrorCosts()).tolist() == pytest.approx([cost])


def test_where_no_affect_is_told_another_gesture_is_as_bad_as_none():
    assert event_costs(heard(Truth(0, S, 0)), [said(1, 0, affect=0)], PLAIN, ErrorCosts()).tolist() == [2.0]


def test_an_event_of_nothing_counts_with_the_nearest_gesture():
    found = event_costs(
        heard(STROKE, Truth(40 * S, 42 * S, 2)), [said(1, 10), said(2, 40), said(4, 30)], SET, ErrorCosts()
    )
    assert found.tolist() == pytest.approx([0.0, 0.5])


def flickering(people=3, gestures=30):
    """Streams in which a class flickers up for one step between gestures, which last for twenty."""
    arch = Arch.parse("5d1", (4,), channels=3, classes=5, padding="stream", window=48, step=5)
    first, out = arch.span - 1, []
    for person in range(people):
        logits = np.full((gestures * 100, 5), 0, dtype=np.int64)
        logits[:, 0] = 1200
        truths = []
        for g in range(gestures):
            at = g * 100
            logits[at + 40 : at + 60] = [0, 1200, 0, 0, 0]
            for k in range(4):
                logits[at + 70 + 6 * k : at + 72 + 6 * k] = [0, 0, 0, 0, 2400]
            t = [((at + i) * 5 + first) * 10_000 for i in (40, 59)]
            truths.append(Truth(t[0], t[1], 1))
        inputs = np.zeros((len(logits) * 5 + arch.span - 5, 3), dtype=np.int64)
        part = Part(0, len(inputs) * 10_000, inputs, np.zeros(len(inputs), dtype=bool), logits)
        out.append(MarkedStream(f"P{person}", Trace(arch, 10_000, SET, 0, (part,), 0), tuple(truths)))
    return out


@pytest.mark.slow
def test_the_search_learns_to_pass_over_what_flickers_and_keeps_what_tells_nothing():
    start = DecideSpec(smoothing_s=0.05, enter=0.5, leave=0.3, least_s=0.05, end_s=0.05, rest_s=0.0, hold_s=0.0)
    streams = flickering()
    before = timed_events(TraceReplayer(streams[0].trace).updates(start))
    assert sum(e.gesture == 4 for e in before) == 4 * 30
    tuned = tune(streams, start, SET)
    after = timed_events(TraceReplayer(streams[0].trace).updates(tuned.spec))
    assert [e.gesture for e in after] == [1] * 30
    assert tuned.cost < 0.2 < 1.8 < tuned.cost_before
    assert "wait_s" not in tuned.moved  # there is no gate
    assert tuned.spec.known_margin is None and tuned.spec.sure == start.sure
    kept = tune(streams, start, SET, keep=("least_s", "smoothing_s"))
    assert (kept.spec.least_s, kept.spec.smoothing_s) == (0.05, 0.05)
    assert not {"least_s", "smoothing_s"} & set(kept.moved)


def test_a_gain_within_its_error_is_none():
    rng = np.random.default_rng(0)
    before = [rng.normal(1, 1, 40) for _ in range(3)]
    gain, error, share = compare_costs(before, [b + rng.normal(0, 1, 40) for b in before], ["a", "b", "c"])
    assert abs(gain) < 2 * error
    assert compare_costs(before, [b - 0.5 for b in before], ["a", "b", "c"]) == pytest.approx((0.5, 0.0, 1.0))
    assert compare_costs([], [], []) == (0.0, np.inf, 0.0)
    # People count alike, however many gestures they made.
    gain, _, share = compare_costs([np.ones(40), np.ones(10)], [np.zeros(40), np.full(10, 2.0)], ["a", "b"])
    assert (gain, share) == (0.0, 0.5)
