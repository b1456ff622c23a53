"""The vectorised form of gate and events, which gives exactly what the toy's machine gives, for many settings quickly.

The rules are specified by `plushsense.runtime.gate` and `plushsense.runtime.events`, and repeated nowhere else in
Python but here: `firings` gives the firings of a `Gate`, and `TraceReplayer` the updates of
`plushsense.runtime.trace.replay`. Tests with random streams and settings hold both equal; a change of a rule changes
its machine, this module and ``deploy/c/plushsense.c``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from plushsense.runtime.decisions import DecideSpec, Rules
from plushsense.runtime.events import AFFECT_CODES, NO_GESTURE, EventMachine, EventSettings, Update
from plushsense.runtime.fixed import PROBABILITY_BITS, SMOOTH_EXTRA_BITS, Ints, known_score, smoothing_weight, softmax
from plushsense.runtime.gate import (
    DOUBT,
    EXTRA_BITS,
    HELD,
    LEVEL,
    NOISE_CLIP,
    THRESHOLD_BITS,
    Gate,
    GateSettings,
    Signal,
)
from plushsense.runtime.trace import ReportedEvent, Trace, reported_events

Bools = NDArray[np.bool_]

Firings = list[tuple[int, int]]
"""Sample and rule of every firing of a gate."""

_CELLS = 1 << 24  # number of stretches times samples times signals computed together, which limits memory
_ROWS = 500  # samples whose baselines are kept at once
_TOGETHER = 2  # fewer stretches at once are slower than one sample at a time


def firings(
    settings: GateSettings, xs: Sequence[NDArray[np.int64]], suspects: Sequence[NDArray[np.bool_]] | None = None
) -> list[Firings]:
    """Return the firings of a `Gate` in each of several stretches.

    Args:
        xs: inputs (T, I) of each; suspects: which samples (T,) are suspect, by default none.
    """
    if not settings.rules:
        return [[] for _ in xs]
    if suspects is None:
        suspects = [np.zeros(len(x), dtype=np.bool_) for x in xs]
    if sum(map(len, xs)) < _TOGETHER * max(map(len, xs), default=0):
        return [_one_by_one(settings, x, suspect) for x, suspect in zip(xs, suspects, strict=True)]
    pieces: list[tuple[int, NDArray[np.int64]]] = []  # of which stretch, and its samples that are not skipped
    for n, (x, suspect) in enumerate(zip(xs, suspects, strict=True)):
        at = np.flatnonzero(~suspect)
        forgets = np.flatnonzero(np.diff(at) > DOUBT) + 1
        kept = np.append(True, (x[at[1:]] != x[at[:-1]]).any(axis=1))[: len(at)]
        kept[forgets] = True
        pieces += [(n, some[keep]) for some, keep in zip(np.split(at, forgets), np.split(kept, forgets), strict=True)]
    found: list[dict[int, int]] = [{} for _ in xs]
    order = sorted(range(len(pieces)), key=lambda k: -len(pieces[k][1]))
    while order:
        longest = len(pieces[order[0]][1])
        together = max(1, _CELLS // max(1, longest * len(settings.signals)))
        some, order = [pieces[k] for k in order[:together]], order[together:]
        block = np.zeros((longest, len(some), len(settings.signals)), dtype=np.int32)
        for column, (n, at) in enumerate(some):
            block[: len(at), column] = raw_signals(xs[n][at], settings.signals)
        follow(block, settings.signals)
        for column, (n, at) in enumerate(some):
            fired = _judge_all(settings, block[: len(at), column])
            hit = np.flatnonzero(fired >= 0)
            found[n].update(zip(at[hit].tolist(), fired[hit].tolist(), strict=True))
    out: list[Firings] = []
    for hits in found:
        heard: Firings = []
        for sample, rule in sorted(hits.items()):
            if not heard or sample > heard[-1][0] + settings.rules[heard[-1][1]].deaf:
                heard.append((sample, rule))
        out.append(heard)
    return out


def _one_by_one(settings: GateSettings, x: NDArray[np.int64], suspect: NDArray[np.bool_]) -> Firings:
    gate = Gate(settings)
    fired = [gate.push(row, doubt) for row, doubt in zip(x.tolist(), suspect.tolist(), strict=True)]
    return [(at, rule) for at, rule in enumerate(fired) if rule >= 0]


def raw_signals(x: NDArray[np.int64], signals: Sequence[Signal]) -> NDArray[np.int64]:
    """Return the values (T, S) of signals, before their baseline is subtracted, from inputs (T, I)."""
    keys = [(s.kind, s.inputs, s.lag, s.shift) for s in signals]
    known: dict[tuple[object, ...], NDArray[np.int64]] = {}
    for key in dict.fromkeys(keys):
        kind, inputs, lag, shift = key
        columns: NDArray[np.int64] = np.clip(x[:, list(inputs)] >> shift, -HELD, HELD)
        if kind == LEVEL:
            known[key] = columns[:, 0]
        else:
            known[key] = np.zeros(len(x), dtype=np.int64)
            known[key][lag:] = np.minimum(np.abs(columns[lag:] - columns[:-lag]).sum(axis=1), HELD)
    return np.stack([known[key] for key in keys], axis=1)


def follow(block: NDArray[np.int32], signals: Sequence[Signal], deviations: bool = False) -> NDArray[np.int32]:
    """Replace raw signals (T, stretches, S) by their sizes with the sign of the deviation, in place.

    With ``deviations``, they are replaced by the deviations instead.
    """
    slow = np.array([s.baseline for s in signals], dtype=np.int32)
    slower = np.array([s.noise for s in signals], dtype=np.int32)
    floor = np.array([s.floor for s in signals], dtype=np.int32)
    if not len(block):
        return block
    base = block[0] << EXTRA_BITS
    noise, change = np.zeros_like(base), np.zeros_like(base)
    for first in range(0, len(block), _ROWS):
        values = block[first : first + _ROWS]
        bases, noises = np.empty_like(values), np.empty_like(values)
        for high, before in zip(values << EXTRA_BITS, bases, strict=True):
            before[...] = base
            np.subtract(high, base, out=change)
            np.right_shift(change, slow, out=change)
            base += change
        values -= bases >> EXTRA_BITS
        if deviations:
            continue
        sizes = np.abs(values)
        for size, before in zip(sizes, noises, strict=True):
            before[...] = noise
            np.right_shift(noise, EXTRA_BITS, out=change)
            np.add(change, floor, out=change)
            np.multiply(change, NOISE_CLIP, out=change)
            np.minimum(change, size, out=change)
            np.left_shift(change, EXTRA_BITS, out=change)
            np.subtract(change, noise, out=change)
            np.right_shift(change, slower, out=change)
            noise += change
        sizes = (sizes << THRESHOLD_BITS) // ((noises >> EXTRA_BITS) + floor)
        np.multiply(np.sign(values), sizes, out=values)
    return block


def _judge_all(settings: GateSettings, sizes: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the first rule whose terms hold at each sample (T,), or -1, from sizes (T, S) with a sign."""
    at = np.arange(len(sizes))
    fired = np.full(len(sizes), -1, dtype=np.int64)
    for number, rule in enumerate(settings.rules):
        every = fired < 0
        for term in rule.terms:
            size = sizes[:, term.signal]
            reached = (size * term.sign if term.sign else np.abs(size)) >= term.threshold
            row = at - np.maximum.accumulate(np.where(reached, -1, at))
            last = np.maximum.accumulate(np.where(row >= term.times, at, -1 - rule.within))
            every &= at - last <= rule.within
        fired[every] = number
    return fired


@dataclass(frozen=True, eq=False)
class SmoothedSteps:
    """Smoothed values of n steps.

    ``shares`` (n, K): probabilities in units of 2^-15; ``best`` (n,): most probable class, before rounding; ``known``
    (n,): known score in units of 1/256; ``affect_shares`` (n, 4): sum of the shares of each affect, without idle.
    """

    shares: Ints
    best: Ints
    known: Ints
    affect_shares: Ints

    def between(self, first: int, last: int) -> SmoothedSteps:
        """Return the steps from ``first`` to ``last`` (exclusive)."""
        return SmoothedSteps(*(getattr(self, f.name)[first:last] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Candidate of each of n steps: ``gesture`` (or `NO_GESTURE`) and ``affect``.

    ``until``: the first later step with another candidate, or before or after a suspect step; ``idle`` (n,): whether an
    idle class has at least ``enter``.
    """

    gesture: list[int]
    affect: list[int]
    until: list[int]
    idle: Bools


# Fewer steps are processed faster one by one; more are rarely of use at once, as the event ends before.
_FEW_STEPS, _MANY_STEPS = 4, 100


class TraceReplayer:
    """Replay one trace with many settings, with the same updates as `replay`, but faster.

    Probabilities are computed once, and smoothed once for each weight; the candidates of all steps are computed as
    arrays; steps without a candidate while no event is open, and those in which an open event just continues, are
    processed many at a time.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.step_s = trace.arch.step * trace.period_us / 1e6
        self._affects = np.array([AFFECT_CODES[a] for a in trace.gestures.affects], dtype=np.int64)
        self._idle = np.array([g.idle for g in trace.gestures.gestures], dtype=np.bool_)
        self._edges = np.cumsum([0, *(len(part.logits) for part in trace.parts)]).tolist()
        self._smoothed: dict[int, SmoothedSteps] = {}
        self._hits: dict[GateSettings, list[Firings]] = {}
        self._candidates: tuple[tuple[int, ...], _Candidates] | None = None

    @cached_property
    def _probabilities(self) -> Ints:
        """Probabilities and known score (n, K + 1) of the steps of all parts."""
        logits = np.concatenate([np.empty((0, len(self._idle)), dtype=np.int64), *(p.logits for p in self.trace.parts)])
        return np.column_stack([softmax(logits), known_score(logits, self._idle)])

    @cached_property
    def _steps(self) -> list[tuple[list[int], int]]:
        """Times of the steps of each part, and how many of them come before its first answer."""
        step, span, period = self.trace.arch.step, self.trace.arch.span, self.trace.period_us
        first = (span % step or step) - 1
        steps = []
        for part in self.trace.parts:
            times = (part.start_us + np.arange(first, len(part.inputs), step) * period).tolist()
            steps.append((times, (span - 1 - first) // step))
        return steps

    @cached_property
    def _suspect(self) -> Bools:
        """Whether each step (n,) with an answer is suspect."""
        step, span = self.trace.arch.step, self.trace.arch.span
        return np.concatenate([np.zeros(0, dtype=np.bool_), *(p.suspect[span - 1 :: step] for p in self.trace.parts)])

    def smoothed(self, weight: int) -> list[SmoothedSteps]:
        """Return the values of each part smoothed with ``weight``; they are cached."""
        whole = self._smooth(weight)
        return [whole.between(first, last) for first, last in pairwise(self._edges)]

    def clear_cache(self) -> None:
        """Drop the cached smoothed values, which need many times the memory of the trace."""
        self._smoothed.clear()
        self._candidates = None

    def smooth(self, weights: Collection[int]) -> None:
        """Smooth with several weights at once, which takes little longer than with one, and cache the values."""
        missing = sorted({*weights} - self._smoothed.keys())
        if not missing:
            return
        rows = self._probabilities[:, None] << SMOOTH_EXTRA_BITS
        means = np.empty((len(rows), len(missing), rows.shape[2]), dtype=np.int64)
        weight, half = np.array(missing)[:, None], 1 << (PROBABILITY_BITS - 1)
        for first, last in pairwise(self._edges):
            means[first:last] = rows[first:last]
            for mean, now in pairwise(means[first:last]):
                # As in `fixed.smooth`, but without new arrays.
                now -= mean
                now *= weight
                now += half
                now >>= PROBABILITY_BITS
                now += mean
        for at, one in enumerate(missing):
            shares = means[:, at] >> SMOOTH_EXTRA_BITS
            totals = np.zeros((len(rows), 4), dtype=np.int64)
            for code in range(4):
                totals[:, code] = shares[:, :-1][:, (self._affects == code) & ~self._idle].sum(axis=1)
            best = means[:, at, :-1].argmax(axis=1)
            self._smoothed[one] = SmoothedSteps(shares[:, :-1], best, shares[:, -1], totals)

    def _smooth(self, weight: int) -> SmoothedSteps:
        self.smooth([weight])
        return self._smoothed[weight]

    def hits(self, gate: GateSettings) -> list[Firings]:
        """Return the firings of the gate in each part; they are cached."""
        if gate not in self._hits:
            parts = self.trace.parts
            self._hits[gate] = firings(gate, [part.inputs for part in parts], [part.suspect for part in parts])
        return self._hits[gate]

    def replay(self, rules: Rules, weight: int) -> list[Update]:
        """Return the same updates as `replay`, with times in microseconds."""
        machine = EventMachine(rules.events, weight, self.trace.gestures)
        candidates = self._candidates_of(weight, rules.events)
        updates: list[Update] = []
        for at, part in enumerate(self.trace.parts):
            updates += self._replay_part(machine, at, self._smoothed[weight], candidates, rules)
            updates += machine.lost(part.ends_us)
        return updates

    def updates(self, spec: DecideSpec) -> list[Update]:
        """Return the updates of events with the settings ``spec``, times in microseconds."""
        return self.replay(spec.rules(self.step_s), self.weight(spec.smoothing_s))

    def weight(self, smoothing_s: float) -> int:
        """Return the weight of a new step for a time constant."""
        return smoothing_weight(smoothing_s, self.step_s)

    def events(self, spec: DecideSpec) -> list[ReportedEvent]:
        """Return the events with the settings ``spec``."""
        return reported_events(self.updates(spec))

    def _candidates_of(self, weight: int, settings: EventSettings) -> _Candidates:
        """Return the candidates of all steps, as in `EventMachine`; those of the last settings are cached."""
        key = weight, settings.enter, settings.enter_affect, settings.known
        smoothed = self._smooth(weight)
        if self._candidates is not None and self._candidates[0] == key:
            return self._candidates[1]
        share = np.take_along_axis(smoothed.shares, smoothed.best[:, None], axis=1)[:, 0]
        high, idle = share >= settings.enter, self._idle[smoothed.best]
        known = (smoothed.known >= settings.known) & ~idle & ~self._suspect
        sure = known & high
        totals = smoothed.affect_shares[:, 1:]
        leans = known & ~sure & (totals.max(axis=1) >= settings.enter_affect)
        gesture = np.where(sure, smoothed.best, NO_GESTURE)
        affect = np.where(sure, self._affects[smoothed.best], np.where(leans, totals.argmax(axis=1) + 1, 0))
        differs = np.ones(len(share), dtype=np.bool_)
        for one in (gesture, affect):
            differs[1:] &= one[1:] == one[:-1]
        differs[1:] = ~differs[1:] | self._suspect[1:] | self._suspect[:-1]
        begins = np.append(np.flatnonzero(differs), len(share))
        until = np.repeat(begins[1:], np.diff(begins)).tolist()
        found = _Candidates(gesture.tolist(), affect.tolist(), until, idle & high)
        self._candidates = key, found
        return found

    def _replay_part(
        self, machine: EventMachine, number: int, smoothed: SmoothedSteps, candidates: _Candidates, rules: Rules
    ) -> Iterator[Update]:
        part, (times, blind), base = self.trace.parts[number], self._steps[number], self._edges[number]
        step, n, at = self.trace.arch.step, len(times), 0
        first = (self.trace.arch.span % step or step) - 1
        # If the gate fires, it does so before the step of the same sample.
        for sample, rule in [*self.hits(rules.gate)[number], (len(part.inputs), -1)]:
            stop = min(-((first - sample) // step), n) if rule >= 0 else n
            while at < stop:
                if at < blind:
                    if machine.open:
                        yield from machine.blind_step(times[at])
                        at += 1
                    else:
                        at = min(blind, stop)
                    continue
                k = base + at - blind
                gesture, affect = candidates.gesture[k], candidates.affect[k]
                same = min(candidates.until[k] - k, stop - at)
                if machine.open:
                    if same > _FEW_STEPS and affect in (0, machine.affect) and gesture in (NO_GESTURE, machine.gesture):
                        stays = self._staying(machine, k, min(same, _MANY_STEPS), smoothed, candidates.idle)
                        if stays:
                            machine.stay(stays, gesture, affect, times[at])
                            at += stays
                            continue
                elif gesture == NO_GESTURE and not affect and not self._suspect[k]:
                    machine.skip(same, times[at])
                    at += same
                    continue
                doubt = bool(self._suspect[k])
                # Shares are only needed for an open event.
                shares, best = smoothed.shares[k].tolist() if machine.open else [], int(smoothed.best[k])
                yield from machine.follow(shares, best, gesture, affect, times[at], doubt)
                at += 1
            if rule >= 0:
                fired = rules.gate.rules[rule]
                yield from machine.gate(fired.affect, fired.gesture, part.start_us + sample * self.trace.period_us)

    @staticmethod
    def _staying(machine: EventMachine, at: int, steps: int, smoothed: SmoothedSteps, idle: Bools) -> int:
        """Return how many of the ``steps`` from ``at`` on do not speak against the open event, from the first."""
        settings = machine.settings
        if machine.gesture != NO_GESTURE:
            stays = smoothed.shares[at : at + steps, machine.gesture] >= settings.leave
        elif machine.affect:
            stays = smoothed.affect_shares[at : at + steps, machine.affect] >= settings.leave_affect
        else:
            return 0
        stays &= ~idle[at : at + steps]
        against = int(stays.argmin())
        return steps if stays[against] else against
