"""Many settings over one stream: what `plushsense.live.trace.replay` gives, event by event, at a fraction of the time.

Probabilities are made once a stream and smoothed once a smoothing; what a setting wants of every step is an array;
and the steps in which nothing is wanted and nothing is going on are skipped. Everything else is `EventMachine` itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.live.decide import DecideSpec
from plushsense.live.trace import Part, Trace, gate_hits
from plushsense.models.events import AFFECT_CODES, BEGUN, ENDED, NAMED, NO_GESTURE, EventMachine, EventPlan, Update
from plushsense.models.fixed import SMOOTH_EXTRA_BITS, Ints, smooth, smoothing_weight, softmax
from plushsense.models.gate import GatePlan
from plushsense.models.rules import Rules

Hits = list[list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class Said:
    """One event as a listener has it, in seconds since the stream's first frame.

    ``gesture`` a class index, `NO_GESTURE` where none was ever said; ``named_s`` when it was said (without one, when
    the event began); ``affect`` a code of `AFFECT_CODES`; ``source`` `CNN` or `GATE`.
    """

    start_s: float
    stop_s: float
    gesture: int
    named_s: float
    affect: int
    source: int


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A part's smoothed shares (n, K) in steps of 2^-15, the best class by all bits (n,), the highest logit (n,) in
    steps of 1/256; ``masses`` (n, 4) the shares of each affect together, idle classes left out."""

    shares: Ints
    best: Ints
    highest: Ints
    masses: Ints


class Listener:
    """One stream, ready to be replayed under many settings."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.step_s = trace.arch.step * trace.period_us / 1e6
        self._affects = np.array([AFFECT_CODES[a] for a in trace.gestures.affects], dtype=np.int64)
        self._idle = np.array([g.idle for g in trace.gestures.gestures], dtype=np.bool_)
        self._smoothed: dict[int, list[Smoothed]] = {}
        self._hits: dict[GatePlan, Hits] = {}

    @cached_property
    def _probabilities(self) -> list[Ints]:
        """Of each part the probabilities and the highest logit, (n, K + 1)."""
        k = len(self.trace.gestures)
        return [
            np.array([[*softmax(row), row.max()] for row in part.logits], dtype=np.int64).reshape(-1, k + 1)
            for part in self.trace.parts
        ]

    def smoothed(self, weight: int) -> list[Smoothed]:
        """What stands after smoothing, kept for the next time."""
        if weight not in self._smoothed:
            self._smoothed[weight] = [self._smooth(rows, weight) for rows in self._probabilities]
        return self._smoothed[weight]

    def forget(self) -> None:
        """Let go of what was smoothed: it is many times the trace."""
        self._smoothed.clear()

    def _smooth(self, rows: Ints, weight: int) -> Smoothed:
        means = np.empty_like(rows)
        mean: Ints | None = None
        for at, row in enumerate(rows):
            mean = smooth(mean, row, weight)
            means[at] = mean
        shares = means >> SMOOTH_EXTRA_BITS
        masses = np.zeros((len(rows), 4), dtype=np.int64)
        for code in range(4):
            masses[:, code] = shares[:, :-1][:, (self._affects == code) & ~self._idle].sum(axis=1)
        return Smoothed(shares[:, :-1], means[:, :-1].argmax(axis=1), shares[:, -1], masses)

    def hits(self, plan: GatePlan) -> Hits:
        """When the gate fires, asked once a plan."""
        if plan not in self._hits:
            self._hits[plan] = [gate_hits(part, plan) for part in self.trace.parts]
        return self._hits[plan]

    def updates(self, rules: Rules, weight: int) -> list[Update]:
        """The updates of `live.trace.replay`, times in microseconds."""
        machine = _Skipping(rules.events, weight, self.trace.gestures)
        hits = self.hits(rules.gate)
        updates: list[Update] = []
        for part, heard, fired in zip(self.trace.parts, self.smoothed(weight), hits, strict=True):
            said, affect = self._wanted(heard, rules.events)
            updates += machine.follow(self.trace, part, heard, said, affect, fired, rules.gate)
        return updates

    def said(self, spec: DecideSpec) -> list[Update]:
        """The updates under ``spec``."""
        return self.updates(spec.rules(self.step_s), smoothing_weight(spec.smoothing_s, self.step_s))

    def events(self, spec: DecideSpec) -> list[Said]:
        """What somebody who listens is told, under ``spec``."""
        return events_of(self.said(spec))

    def _wanted(self, heard: Smoothed, plan: EventPlan) -> tuple[Ints, Ints]:
        """What each step would say, as `EventMachine._wants` has it: (n,) gesture or `NO_GESTURE`, (n,) affect."""
        share = np.take_along_axis(heard.shares, heard.best[:, None], axis=1)[:, 0]
        speaks = (heard.highest >= plan.known) & ~self._idle[heard.best]
        sure = speaks & (share >= plan.enter)
        most = heard.masses[:, 1:].argmax(axis=1) + 1
        leans = speaks & ~sure & (heard.masses[:, 1:].max(axis=1) >= plan.enter_affect)
        said = np.where(sure, heard.best, NO_GESTURE)
        return said, np.where(sure, self._affects[heard.best], np.where(leans, most, 0))


class _Skipping(EventMachine):
    """An `EventMachine` that is told what its steps want, and passes over those that cannot change anything."""

    def follow(
        self,
        trace: Trace,
        part: Part,
        heard: Smoothed,
        said: Ints,
        affect: Ints,
        hits: Sequence[tuple[int, int]],
        gate: GatePlan,
    ) -> Iterator[Update]:
        """One part, from its first sample to the signal's end."""
        step, span, n = trace.arch.step, trace.arch.span, len(said)
        samples = part.start_us + (np.arange(n) * step + span - 1) * trace.period_us
        times: list[int] = samples.tolist()
        suspect = part.suspect[span - 1 :: step][:n] if n else np.zeros(0, dtype=np.bool_)
        lively: NDArray[np.int64] = np.flatnonzero((said != NO_GESTURE) | (affect > 0) | suspect)
        next_lively = np.append(lively, n)[np.searchsorted(lively, np.arange(n + 1))].tolist()
        wants, leans, doubts, best = said.tolist(), affect.tolist(), suspect.tolist(), heard.best.tolist()
        # A firing comes before the answer of its own sample; below 0 are the steps without an answer.
        fired = [(-((span - 1 - sample) // step), sample, rule) for sample, rule in hits]
        fired.append((len(part.inputs) + 1, 0, -1))
        first, queue = -((span - 1) // step), 0
        at = first
        last = (len(part.inputs) - span) // step  # of the blind ones too, where the part is too short for any answer
        while at <= last or queue < len(fired) - 1:
            while fired[queue][0] <= at or (at > last and queue < len(fired) - 1):
                _, sample, rule = fired[queue]
                spoken = gate.rules[rule]
                yield from self.gate(spoken.affect, spoken.gesture, part.start_us + sample * trace.period_us)
                queue += 1
            if at > last:
                break
            if not self.open:
                if at < 0:
                    at = min(max(at + 1, 0), max(fired[queue][0], at + 1)) if last >= 0 else at + 1
                    continue
                quiet = min(next_lively[at], fired[queue][0])
                if quiet > at:
                    self._count(NO_GESTURE, 0, times[at])
                    self._resting = max(0, self._resting - (quiet - at))
                    at = quiet
                    continue
            if at < 0:
                yield from self.blind_step(part.start_us + (at * step + span - 1) * trace.period_us)
            else:
                yield from self._told(heard.shares[at].tolist(), best[at], wants[at], leans[at], times[at], doubts[at])
            at += 1
        yield from self.lost(part.ends_us)

    def _told(self, shares: list[int], best: int, said: int, affect: int, now: int, suspect: bool) -> list[Update]:
        if suspect:
            said, affect = NO_GESTURE, 0
        else:
            self._count(said, affect, now)
        if not self.open:
            return self._closed_step(said, affect, now)
        return self._open_step(shares, best, said, affect, now, suspect)


def events_of(updates: Sequence[Update]) -> list[Said]:
    """Whole events from what happened to them, times in seconds; one that has not ended ends with the last update."""
    begun: dict[int, Update] = {}
    named: dict[int, Update] = {}
    found = []

    def close(number: int, now: int) -> None:
        first = begun.pop(number)
        name = named.pop(number, first)
        found.append(
            Said(first.now / 1e6, now / 1e6, name.gesture, name.now / 1e6, name.affect or first.affect, first.source)
        )

    for update in updates:
        if update.kind == BEGUN:
            begun[update.number] = update
        elif update.kind == NAMED:
            named[update.number] = update
        elif update.kind == ENDED:
            close(update.number, update.now)
    for number in list(begun):
        close(number, updates[-1].now)
    return found
