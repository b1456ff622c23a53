"""Compute the logits of a whole stream once, then replay gate and events with any settings.

`trace_of` and `replay` use the classes of `runtime.machine`; `TraceReplayer` computes the same updates faster.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.core.recorder_csv import Frames
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
from plushsense.runtime.fixed import SMOOTH_EXTRA_BITS, Ints, known_score, smooth, smoothing_weight, softmax
from plushsense.runtime.gate import Gate, GateSettings
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.machine import Break, FloatLogits, FrameReader, InputRows, LogitStream, Sample, SampleReader


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
    reader = FrameReader(model.layout, own if health is None else health)
    parts: list[Part] = []
    samples: list[Sample] = []

    def end(time_us: int) -> None:
        if samples:
            inputs = np.array([s.inputs for s in samples], dtype=np.int64)
            suspect = np.array([s.suspect for s in samples], dtype=np.bool_)
            network.reset()
            parts.append(Part(samples[0].time_us, time_us, inputs, suspect, network.push(inputs)))
            samples.clear()

    for ms, values in zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        for item in reader.push(ms, values):
            if isinstance(item, Sample):
                samples.append(item)
            else:
                end(item.time_us)
    end(reader.time_us)
    first_ms = int(frames.device_ms[0]) if len(frames) else 0
    return Trace(network.arch, model.layout.period_us, model.gestures, first_ms, tuple(parts), reader.health.faults)


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


def gate_hits(part: Part, settings: GateSettings) -> list[tuple[int, int]]:
    """Return the sample index and rule index of every firing of the gate in a part."""
    if not settings.rules:
        return []
    gate = Gate(settings)
    rows, suspects = part.inputs.tolist(), part.suspect.tolist()
    fired = [gate.push(row, suspect) for row, suspect in zip(rows, suspects, strict=True)]
    return [(at, rule) for at, rule in enumerate(fired) if rule >= 0]


Hits = list[list[tuple[int, int]]]


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
class SmoothedPart:
    """Smoothed values of the n steps of a part.

    ``shares`` (n, K): probabilities in units of 2^-15; ``best`` (n,): most probable class, before rounding; ``known``
    (n,): known score in units of 1/256; ``affect_shares`` (n, 4): sum of the shares of each affect, without idle.
    """

    shares: Ints
    best: Ints
    known: Ints
    affect_shares: Ints


class TraceReplayer:
    """Replay one trace with many settings, with the same updates as `replay`, but faster.

    Probabilities are computed once, and smoothed once for each weight; the candidates of all steps are computed as
    arrays; steps without a candidate are skipped while no event is open.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.step_s = trace.arch.step * trace.period_us / 1e6
        self._affects = np.array([AFFECT_CODES[a] for a in trace.gestures.affects], dtype=np.int64)
        self._idle = np.array([g.idle for g in trace.gestures.gestures], dtype=np.bool_)
        self._smoothed: dict[int, list[SmoothedPart]] = {}
        self._hits: dict[GateSettings, Hits] = {}

    @cached_property
    def _probabilities(self) -> list[Ints]:
        """Probabilities and known score (n, K + 1) of each part."""
        k = len(self.trace.gestures)
        rows = [np.array([softmax(row) for row in part.logits], dtype=np.int64) for part in self.trace.parts]
        return [
            np.column_stack([row.reshape(-1, k), known_score(part.logits.reshape(-1, k), self._idle)])
            for row, part in zip(rows, self.trace.parts, strict=True)
        ]

    def smoothed(self, weight: int) -> list[SmoothedPart]:
        """Return the values of each part smoothed with ``weight``; they are cached."""
        if weight not in self._smoothed:
            self._smoothed[weight] = [self._smooth(rows, weight) for rows in self._probabilities]
        return self._smoothed[weight]

    def clear_cache(self) -> None:
        """Drop the cached smoothed values, which need many times the memory of the trace."""
        self._smoothed.clear()

    def _smooth(self, rows: Ints, weight: int) -> SmoothedPart:
        means = np.empty_like(rows)
        mean: Ints | None = None
        for at, row in enumerate(rows):
            mean = smooth(mean, row, weight)
            means[at] = mean
        shares = means >> SMOOTH_EXTRA_BITS
        totals = np.zeros((len(rows), 4), dtype=np.int64)
        for code in range(4):
            totals[:, code] = shares[:, :-1][:, (self._affects == code) & ~self._idle].sum(axis=1)
        return SmoothedPart(shares[:, :-1], means[:, :-1].argmax(axis=1), shares[:, -1], totals)

    def hits(self, gate: GateSettings) -> Hits:
        """Return the `gate_hits` of each part; they are cached."""
        if gate not in self._hits:
            self._hits[gate] = [gate_hits(part, gate) for part in self.trace.parts]
        return self._hits[gate]

    def replay(self, rules: Rules, weight: int) -> list[Update]:
        """Return the same updates as `replay`, with times in microseconds."""
        machine = EventMachine(rules.events, weight, self.trace.gestures)
        updates: list[Update] = []
        for part, smoothed, hits in zip(self.trace.parts, self.smoothed(weight), self.hits(rules.gate), strict=True):
            updates += self._replay_part(machine, part, smoothed, hits, rules)
            updates += machine.lost(part.ends_us)
        return updates

    def updates(self, spec: DecideSpec) -> list[Update]:
        """Return the updates of events with the settings ``spec``, times in microseconds."""
        return self.replay(spec.rules(self.step_s), smoothing_weight(spec.smoothing_s, self.step_s))

    def events(self, spec: DecideSpec) -> list[ReportedEvent]:
        """Return the events with the settings ``spec``."""
        return reported_events(self.updates(spec))

    def _candidates(self, smoothed: SmoothedPart, settings: EventSettings) -> tuple[Ints, Ints]:
        """Return gesture (n,) (or `NO_GESTURE`) and affect (n,) of the candidate of each step, as in `EventMachine`."""
        share = np.take_along_axis(smoothed.shares, smoothed.best[:, None], axis=1)[:, 0]
        known = (smoothed.known >= settings.known) & ~self._idle[smoothed.best]
        sure = known & (share >= settings.enter)
        totals = smoothed.affect_shares[:, 1:]
        leans = known & ~sure & (totals.max(axis=1) >= settings.enter_affect)
        gesture = np.where(sure, smoothed.best, NO_GESTURE)
        return gesture, np.where(sure, self._affects[smoothed.best], np.where(leans, totals.argmax(axis=1) + 1, 0))

    def _replay_part(
        self,
        machine: EventMachine,
        part: Part,
        smoothed: SmoothedPart,
        hits: Sequence[tuple[int, int]],
        rules: Rules,
    ) -> Iterator[Update]:
        step, span, period = self.trace.arch.step, self.trace.arch.span, self.trace.period_us
        first = (span % step or step) - 1
        blind = (span - 1 - first) // step  # steps before the first answer
        at_sample = np.arange(first, len(part.inputs), step)
        n, times = len(at_sample), (part.start_us + at_sample * period).tolist()
        gestures, affects = self._candidates(smoothed, rules.events)
        suspects = part.suspect[at_sample[blind:]]
        lively = blind + np.flatnonzero((gestures != NO_GESTURE) | (affects > 0) | suspects)
        next_lively = np.append(lively, n)[np.searchsorted(lively, np.arange(n + 1))].tolist()
        rows = list(zip(smoothed.best.tolist(), gestures.tolist(), affects.tolist(), strict=True))
        doubts: list[bool] = suspects.tolist()
        at = 0
        # If the gate fires, it does so before the step of the same sample.
        for sample, rule in [*hits, (len(part.inputs), -1)]:
            stop = min(-((first - sample) // step), n) if rule >= 0 else n
            while at < stop:
                quiet = at if machine.open else min(next_lively[at], stop)
                if quiet > at:
                    machine.skip(max(0, quiet - max(at, blind)), times[at])
                    at = quiet
                    continue
                if at < blind:
                    yield from machine.blind_step(times[at])
                else:
                    k = at - blind
                    yield from machine.follow(smoothed.shares[k].tolist(), *rows[k], times[at], doubts[k])
                at += 1
            if rule >= 0:
                fired = rules.gate.rules[rule]
                yield from machine.gate(fired.affect, fired.gesture, part.start_us + sample * period)


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
