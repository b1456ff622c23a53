"""Compute the logits of a whole stream once, then replay gate and events with any settings.

`trace_of` and `replay` use the classes of `runtime.machine`; `TraceReplayer` computes the same updates faster.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import kept_rows
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec, Rules
from plushsense.runtime.events import (
    AFFECT_CODES,
    BEGUN,
    ENDED,
    NAMED,
    NO_GESTURE,
    Answer,
    EventMachine,
    EventSettings,
    Update,
)
from plushsense.runtime.fixed import (
    PROBABILITY_BITS,
    SMOOTH_EXTRA_BITS,
    Ints,
    known_score,
    smoothing_weight,
    softmax,
)
from plushsense.runtime.gate import Firings, GateSettings, firings
from plushsense.runtime.health import Health, HealthSettings
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.machine import Break, FloatLogits, InputRows, LogitStream, Sample, SampleReader
from plushsense.windows.clock import resample, row_times_us
from plushsense.windows.features import network_inputs

Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Part:
    """Evenly spaced samples of a stream without a break; times are since the first frame of the stream.

    ``start_us`` is the time of sample 0; ``ends_us`` is the time of the break that ended the part, or of the last frame
    of the stream; ``inputs`` (T, I) are raw; ``suspect`` (T,) marks suspect samples; ``logits`` (n, K), in steps of
    1/256, are those of every step from the first full span on.
    """

    start_us: int
    ends_us: int
    inputs: NDArray[np.int64]
    suspect: NDArray[np.bool_]
    logits: Ints


@dataclass(frozen=True, eq=False)
class Trace:
    """Inputs and logits of one stream. ``first_ms``: device time of the first frame; ``faults``: number of faults.

    Times are those of `FrameReader`: since the first frame, and continuing after a reset of the device clock.
    """

    arch: Arch
    period_us: int
    gestures: GestureSet
    first_ms: int
    parts: tuple[Part, ...]
    faults: int

    @property
    def seconds(self) -> float:
        """Total duration of the parts."""
        return sum(len(p.inputs) for p in self.parts) * self.period_us / 1e6

    def step_times_us(self, part: Part) -> NDArray[np.int64]:
        """Return the times (n,) of the logits of a part, in microseconds."""
        at = np.arange(len(part.logits)) * self.arch.step + self.arch.span - 1
        return part.start_us + at * self.period_us


def trace_of(frames: Frames, model: Bundle | IntegerModel, health: HealthSettings | None = None) -> Trace:
    """Compute samples and logits of a whole stream, a part at a time.

    Args:
        frames: the whole stream, as recorded.
        model: a bundle, for the float network, or an integer model, for the deployed one.
        health: settings of sensor health; by default those of the model.
    """
    network: LogitStream
    if isinstance(model, IntegerModel):
        network, own = model.network.stepper(), model.rules.health
    else:
        network, own = FloatLogits(model), DecideSpec.from_dict(model.decision).health
    layout = model.layout
    times = row_times_us(frames, layout)
    kept = kept_rows(frames.device_ms, layout.gap_ms)
    frames, times = frames.take(kept), times[kept]
    suspect, fault, faults = _health_of(frames, layout, own if health is None else health)
    step_ms = np.diff(frames.device_ms, prepend=frames.device_ms[:1])
    begins = (step_ms < 0) | (step_ms > layout.gap_ms)
    begins[1:] |= fault[1:] != fault[:-1]
    edges = [0, *np.flatnonzero(begins).tolist(), len(times)]
    parts: list[Part] = []
    for first, last in pairwise(edges):
        for segment in [] if fault[first:last].any() else resample(frames.slice(first, last), layout):
            inputs = network_inputs(segment.data, layout)
            network.reset()
            # A fault ends a part when it is found, a gap at the frame before.
            ends_us = int(times[last] if last < len(times) and fault[last] else times[last - 1])
            start_us = segment.start_us - int(frames.device_ms[first]) * 1000 + int(times[first])
            parts.append(Part(start_us, ends_us, inputs, suspect[first + segment.row_of], network.push(inputs)))
    first_ms = int(frames.device_ms[0]) if len(frames) else 0
    return Trace(network.arch, layout.period_us, model.gestures, first_ms, tuple(parts), faults)


def _health_of(frames: Frames, layout: Layout, settings: HealthSettings) -> tuple[Bools, Bools, int]:
    """Return for each frame whether it is suspect (T,) and whether there is a fault after it (T,), and count faults.

    `Health` checks only the frames at which it may find something, and during faults.
    """
    x, ms = frames.values, frames.device_ms
    health = Health(settings, layout)
    low, high = np.array(health.inside, dtype=np.int64).reshape(-1, 2).T
    unusual: Bools = np.any((x < low) | (x > high), axis=1)
    unusual[1:] |= (x[1:] == x[:-1]).all(axis=1)
    suspect, fault = np.zeros(len(x), dtype=np.bool_), np.zeros(len(x), dtype=np.bool_)
    checked = 0
    for at in np.flatnonzero(unusual).tolist():
        if at < checked:
            continue
        if at > checked:
            # Nothing of the frames between matters but the last one.
            health.clear()
            health.push(int(ms[at - 1]), x[at - 1].tolist())
        while at < len(x) and (unusual[at] or health.fault):
            if at and not 0 <= ms[at] - ms[at - 1] <= layout.gap_ms:
                health.clear()
            health.push(int(ms[at]), x[at].tolist())
            suspect[at], fault[at] = health.suspect, health.fault
            at += 1
        checked = at
    return suspect, fault, health.faults


@dataclass(frozen=True, eq=False)
class Replayed:
    """Result of `replay`: ``updates`` of events, and ``answers`` with the time (microseconds) of each step."""

    updates: tuple[Update, ...]
    answers: tuple[tuple[int, Answer], ...]


def replay(trace: Trace, rules: Rules, smoothing: int) -> Replayed:
    """Compute events and answers of a trace with other settings of gate and events; times in microseconds.

    Args:
        smoothing: weight of a new step, in units of 2^-15 (`fixed.smoothing_weight`).
    """
    reader = SampleReader(_TracedLogits(trace), trace.gestures, rules, smoothing)
    moments = list(reader.read(_items(trace)))
    return Replayed(
        tuple(update for moment in moments for update in moment.updates),
        tuple((moment.time_us, moment.answer) for moment in moments if moment.answer is not None),
    )


def _items(trace: Trace) -> Iterator[Sample | Break]:
    for part in trace.parts:
        rows = zip(part.inputs.tolist(), part.suspect.tolist(), strict=True)
        for at, (inputs, suspect) in enumerate(rows):
            yield Sample(part.start_us + at * trace.period_us, inputs, suspect)
        yield Break(part.ends_us, "no signal")


class _TracedLogits:
    """The logits of a trace as a `LogitStream`; each reset selects the next part."""

    def __init__(self, trace: Trace) -> None:
        self.arch = trace.arch
        self._parts = iter([*(part.logits for part in trace.parts), np.empty((0, trace.arch.classes), dtype=np.int64)])

    def reset(self) -> None:
        """Select the next part."""
        self._logits = next(self._parts)
        self._samples = 0

    def push(self, samples: InputRows) -> Ints:
        """Return the logits of the steps that these samples complete."""
        before, self._samples = self._samples, self._samples + len(samples)
        return self._logits[self._due(before) : self._due(self._samples)]

    def _due(self, samples: int) -> int:
        return max(0, (samples - self.arch.span) // self.arch.step + 1)


@dataclass(frozen=True, slots=True)
class ReportedEvent:
    """A whole event; times are in seconds since the first frame of the stream.

    ``gesture`` is a class index, or `NO_GESTURE` if none was named; ``named_s`` is the time at which it was named, else
    that of the beginning; ``affect`` is a code of `AFFECT_CODES`; ``source`` is `CNN` or `GATE`.
    """

    start_s: float
    stop_s: float
    gesture: int
    named_s: float
    affect: int
    source: int


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


def reported_events(updates: Sequence[Update]) -> list[ReportedEvent]:
    """Combine updates into whole events; an event that has not ended gets the time of the last update as its end."""
    begun: dict[int, Update] = {}
    named: dict[int, Update] = {}
    events = []

    def close(number: int, now: int) -> None:
        first = begun.pop(number)
        name = named.pop(number, first)
        affect = name.affect or first.affect
        events.append(ReportedEvent(first.now / 1e6, now / 1e6, name.gesture, name.now / 1e6, affect, first.source))

    for update in updates:
        if update.kind == BEGUN:
            begun[update.number] = update
        elif update.kind == NAMED:
            named[update.number] = update
        elif update.kind == ENDED:
            close(update.number, update.now)
    for number in list(begun):
        close(number, updates[-1].now)
    return events
