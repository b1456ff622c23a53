"""Events from logits: one event for each gesture, with a beginning and an end, in integers only.

This module is the specification that ``deploy/c/plushsense.c`` implements. A step is one answer of the network. Counts
are in steps, shares (probabilities) in steps of 2^-15, logits in steps of 1/256. Times are in the caller's unit
(milliseconds in the toy).

In each step, in this order:

1. The probabilities and the known score (`fixed.known_score`) are smoothed (`fixed.smooth`).
2. The step's `Answer` is ``idle`` when the best class is idle; else ``unknown`` when the known score is below
   ``known``; else it depends on the conformal set, every class of at least ``sure``: one class is ``sure``, several of
   one affect (not ``none``) are ``affect``, anything else is ``unsure``.
3. The candidate is the gesture of the best class if it reaches ``enter``, else an affect whose classes together reach
   ``enter_affect``; there is none if the answer is idle or unknown.
4. If no event is open, one begins when the candidate was the same for ``least`` steps in a row (the same affect;
   without one, the same gesture), and not within ``rest`` steps of the last event, the refractory time. It begins with
   its affect, and with the gesture when that was the candidate for ``least`` steps too.
5. If an event is open, it gets its gesture once, when one of its affect was the candidate for ``least`` steps. Another
   gesture or affect that was the candidate for ``switch`` steps in a row, after at least ``hold`` steps, ends it and
   begins the next. It ends after ``end`` steps in a row in which its gesture (without one: its affect's classes
   together) was below ``leave`` (``leave_affect``), or the best class was an idle one and reached ``enter``; never
   before its minimum duration of ``hold`` steps.

The gate fires between steps (`EventMachine.gate`): its event begins at once and cannot be ended or replaced for
``wait`` steps, during which the network may name it. If the gate fires during an event of the same affect, or one that
it began, it prolongs that event: ``wait`` restarts. While the network is warming, steps have no answer and are no
evidence for an event (`EventMachine.blind_step`). A suspect step (`plushsense.runtime.health`) does not begin, name or
end an event, and neither adds to nor interrupts a row of steps.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from plushsense.core.errors import BundleError
from plushsense.core.gestures import GestureSet
from plushsense.runtime.fixed import (
    LOGIT_LIMIT,
    PROBABILITY_BITS,
    SMOOTH_EXTRA_BITS,
    Ints,
    known_score,
    smooth,
    softmax,
)

ONE = 1 << PROBABILITY_BITS
NO_GESTURE = 255
AFFECT_CODES = {"none": 0, "positive": 1, "neutral": 2, "negative": 3}
AFFECTS = tuple(AFFECT_CODES)
MOST_STEPS = (1 << 16) - 1

IDLE, UNKNOWN, UNSURE, AFFECT, SURE = range(5)
ANSWERS = ("idle", "unknown", "unsure", "affect", "sure")
CNN, GATE = range(2)
SOURCES: tuple[Literal["cnn", "gate"], ...] = ("cnn", "gate")
BEGUN, NAMED, ENDED = 1, 2, 3
KINDS: dict[int, Literal["begun", "named", "ended"]] = {BEGUN: "begun", NAMED: "named", ENDED: "ended"}


@dataclass(frozen=True)
class EventSettings:
    """Settings of `EventMachine`; the defaults report the best class of every step (argmax).

    Raises:
        BundleError: for a value out of its range.
    """

    enter: int = 0
    leave: int = 0
    enter_affect: int = ONE + 1  # above the maximum: never by affect alone
    leave_affect: int = 0
    sure: int = ONE // 2
    known: int = -LOGIT_LIMIT
    least: int = 1
    switch: int = 1
    end: int = 1
    hold: int = 0
    rest: int = 0
    wait: int = 0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = RANGES[field.name]
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise BundleError(f"The event setting {field.name} is {value!r}; accepted are {low} to {high}.")


RANGES = {
    **dict.fromkeys(("enter", "leave", "enter_affect", "leave_affect", "sure"), (0, ONE + 1)),
    "known": (-LOGIT_LIMIT, LOGIT_LIMIT),
    **dict.fromkeys(("least", "switch", "end"), (1, MOST_STEPS)),
    **dict.fromkeys(("hold", "rest", "wait"), (0, MOST_STEPS)),
}


@dataclass(frozen=True, slots=True)
class Update:
    """Change of an event.

    ``number`` counts events from 1; ``affect`` a code of `AFFECT_CODES`; ``gesture`` a class index or `NO_GESTURE`;
    ``source`` what began it, `CNN` or `GATE`; ``since`` the time of the step in which it was first the candidate (for
    an end: first below its threshold), ``now`` the time of the change. If one event replaces another, or the signal is
    lost, ``since`` is ``now``.
    """

    kind: int
    number: int
    affect: int
    gesture: int
    source: int
    since: int
    now: int


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of the network at one step.

    ``best`` class, its smoothed ``share`` (2^-15), ``kind`` an index into `ANSWERS`, and ``known``, the smoothed known
    score in steps of 1/256.
    """

    best: int
    share: int
    kind: int
    known: int


class EventMachine:
    """Decides the events of one stream. ``mean`` holds the smoothed probabilities (K,) in steps of 2^-27, then the
    smoothed known score in steps of 2^-20; None before the first step.

    ``sensitivity`` (-128 to 127) is how readily the network begins and keeps events: each step takes 1/512 from
    ``enter``, ``leave``, ``enter_affect`` and ``leave_affect``, unless they are above 1. The gate does not change.
    """

    def __init__(self, settings: EventSettings, smoothing: int, gestures: GestureSet) -> None:
        self.settings, self.smoothing, self.sensitivity = settings, smoothing, 0
        self._affects = [AFFECT_CODES[a] for a in gestures.affects]
        self._idle = np.array([g.idle for g in gestures.gestures], dtype=np.bool_)
        self.reset()

    def reset(self) -> None:
        """Begin a new stream and set the number of events to 0."""
        self.number = 0
        self._clear()

    def _clear(self) -> None:
        self.mean: Ints | None = None
        self.open = False
        self._close(rest=0)
        self._candidate = -1  # an affect's code, or 4 + gesture where the gesture has no affect
        self._candidate_steps, self._candidate_since = 0, 0
        self._gesture, self._gesture_steps = NO_GESTURE, 0

    def _close(self, rest: int) -> None:
        self.open = False
        self.affect, self.gesture, self.source = 0, NO_GESTURE, CNN
        self.since = 0
        self._lasted = self._away = self._wait = 0
        self._away_since = 0
        self._resting = rest

    def lost(self, now: int) -> list[Update]:
        """End the open event after a gap, a clock reset or a fault, and reset all but the number of events."""
        updates = [self._end(now, now)] if self.open else []
        self._clear()
        return updates

    def gate(self, affect: int, gesture: int, now: int) -> list[Update]:
        """Process a firing of the gate, with the affect and gesture (or `NO_GESTURE`) of its rule.

        Returns the changes of events.
        """
        updates: list[Update] = []
        if self.open and (self.affect == affect or self.source == GATE):
            self._wait, self._away = self.settings.wait, 0
            return updates
        if self.open:
            updates.append(self._end(now, now))
        self._wait = 0
        updates.append(self._begin(affect, gesture, GATE, now, now))
        self._wait = self.settings.wait
        return updates

    def step(self, logits: Ints, now: int, suspect: bool = False) -> tuple[Answer, list[Update]]:
        """Process the logits (K,) of a step; return the answer and the changes of events."""
        both = np.append(softmax(logits), known_score(logits, self._idle))
        self.mean = smooth(self.mean, both, self.smoothing)
        rows = (self.mean >> SMOOTH_EXTRA_BITS).tolist()
        shares, known = rows[:-1], rows[-1]
        # Compare all bits, like the toy; of equal ones take the first.
        best = int(self.mean[:-1].argmax())
        answer = Answer(best, shares[best], self._kind(shares, best, known), known)
        return answer, self.follow(shares, best, *self._candidate_of(shares, answer), now, suspect)

    def follow(
        self, shares: list[int], best: int, gesture: int, affect: int, now: int, suspect: bool = False
    ) -> list[Update]:
        """Process a step with given shares, best class and candidate; return the changes of events."""
        if suspect:
            gesture, affect = NO_GESTURE, 0
        else:
            self._count(gesture, affect, now)
        if not self.open:
            return self._closed_step(gesture, affect, now)
        return self._open_step(shares, best, gesture, affect, now, suspect)

    def skip(self, steps: int, now: int) -> None:
        """Skip ``steps`` steps without a candidate while no event is open; only the refractory time is updated."""
        if steps:
            self._count(NO_GESTURE, 0, now)
            self._resting = max(0, self._resting - steps)

    def stay(self, steps: int, gesture: int, affect: int, now: int) -> None:
        """Process ``steps`` steps with the same candidate, none of them suspect, in which the open event continues.

        The candidate is none or that of the event, and in each step the event's share is high enough and no idle class
        prevails.
        """
        self._count(gesture, affect, now)
        if self._candidate >= 0:
            self._candidate_steps += steps - 1
        if gesture != NO_GESTURE:
            self._gesture_steps += steps - 1
        self._lasted += steps
        self._wait = max(0, self._wait - steps)
        self._away = 0

    def blind_step(self, now: int) -> list[Update]:
        """Process a step without an answer, while the network is warming; it can end an event of the gate."""
        if not self.open:
            return []
        self._lasted += 1
        if self._wait > 0:
            self._wait -= 1
            return []
        return self._miss(now)

    def _miss(self, now: int) -> list[Update]:
        """Count a step without evidence for the open event, and end the event after enough of them."""
        if self._away == 0:
            self._away_since = now
        self._away += 1
        if self._away >= self.settings.end and self._lasted >= self.settings.hold:
            return [self._end(self._away_since, now)]
        return []

    def _level(self, trained: int) -> int:
        return trained if trained > ONE else trained - ONE // 512 * self.sensitivity

    def _kind(self, shares: list[int], best: int, known: int) -> int:
        settings = self.settings
        if self._idle[best]:
            return IDLE
        if known < settings.known:
            return UNKNOWN
        members = [k for k, share in enumerate(shares) if share >= settings.sure]
        if len(members) == 1:
            return SURE
        affects = {self._affects[k] for k in members}
        if len(affects) == 1 and 0 not in affects and not any(self._idle[k] for k in members):
            return AFFECT
        return UNSURE

    def _affect_shares(self, shares: list[int]) -> list[int]:
        """Return the summed share of the classes of each affect, by affect code, without idle classes."""
        totals = [0, 0, 0, 0]
        for share, affect, idle in zip(shares, self._affects, self._idle, strict=True):
            if not idle:
                totals[affect] += share
        return totals

    def _candidate_of(self, shares: list[int], answer: Answer) -> tuple[int, int]:
        """Return the candidate of a step: gesture (or `NO_GESTURE`) and affect; (`NO_GESTURE`, 0) for none."""
        if answer.kind in (UNKNOWN, IDLE):
            return NO_GESTURE, 0
        if answer.share >= self._level(self.settings.enter):
            return answer.best, self._affects[answer.best]
        totals = self._affect_shares(shares)
        most = max(range(1, 4), key=lambda a: (totals[a], -a))
        return NO_GESTURE, most if totals[most] >= self._level(self.settings.enter_affect) else 0

    def _count(self, gesture: int, affect: int, now: int) -> None:
        """Count successive steps with the same candidate."""
        candidate = affect if affect else 4 + gesture if gesture != NO_GESTURE else -1
        if candidate != self._candidate:
            self._candidate, self._candidate_steps, self._candidate_since = candidate, 0, now
        if candidate >= 0:
            self._candidate_steps += 1
        if gesture != self._gesture:
            self._gesture, self._gesture_steps = gesture, 0
        if gesture != NO_GESTURE:
            self._gesture_steps += 1

    def _closed_step(self, gesture: int, affect: int, now: int) -> list[Update]:
        if self._resting > 0:
            self._resting -= 1
            return []
        if (gesture != NO_GESTURE or affect) and self._candidate_steps >= self.settings.least:
            return [self._begin(affect, self._named(gesture), CNN, self._candidate_since, now)]
        return []

    def _named(self, gesture: int) -> int:
        return gesture if gesture != NO_GESTURE and self._gesture_steps >= self.settings.least else NO_GESTURE

    def _open_step(
        self, shares: list[int], best: int, gesture: int, affect: int, now: int, suspect: bool
    ) -> list[Update]:
        settings = self.settings
        self._lasted += 1
        locked = self._wait > 0
        if locked:
            self._wait -= 1
        if self.gesture == NO_GESTURE and self._named(gesture) != NO_GESTURE and self.affect in (0, affect):
            self.gesture, self.affect = gesture, affect
            self._away = 0
            return [Update(NAMED, self.number, affect, gesture, self.source, self.since, now)]
        if locked or suspect:
            return []
        another = (affect and affect != self.affect) or (gesture not in (NO_GESTURE, self.gesture))
        if another and self.gesture == NO_GESTURE and affect == self.affect:
            another = False  # the event has no gesture yet and may get this one
        row = self._gesture_steps if gesture != NO_GESTURE and affect == self.affect else self._candidate_steps
        if another and row >= settings.switch and self._lasted >= settings.hold:
            ended = self._end(now, now)
            return [ended, self._begin(affect, self._named(gesture), CNN, now, now)]
        share = shares[self.gesture] if self.gesture != NO_GESTURE else self._affect_shares(shares)[self.affect]
        stays = share >= self._level(settings.leave if self.gesture != NO_GESTURE else settings.leave_affect)
        if self.gesture == NO_GESTURE and self.affect == 0:
            stays = False  # begun by the gate without affect: no share to compare
        if self._idle[best] and shares[best] >= settings.enter:
            stays = False
        if stays:
            self._away = 0
            return []
        return self._miss(now)

    def _begin(self, affect: int, gesture: int, source: int, since: int, now: int) -> Update:
        self.number += 1
        self.open = True
        self.affect, self.gesture, self.source, self.since = affect, gesture, source, since
        self._lasted = self._away = self._wait = 0
        return Update(BEGUN, self.number, affect, gesture, source, since, now)

    def _end(self, since: int, now: int) -> Update:
        update = Update(ENDED, self.number, self.affect, self.gesture, self.source, since, now)
        self._close(self.settings.rest)
        return update
