"""Compute the logits of a whole stream once, then replay gate and events with any settings.

All of it is done by the classes of `plushsense.runtime.machine`; `plushsense.runtime.replay` is its fast form.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
    BEGUN,
    ENDED,
    NAMED,
    Answer,
    Update,
)
from plushsense.runtime.fixed import (
    Ints,
)
from plushsense.runtime.health import Health, HealthSettings
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.machine import Break, FloatLogits, InputRows, LogitStream, Sample, SampleReader
from plushsense.windows.clock import reboots, resample, row_times_us
from plushsense.windows.features import network_inputs
from plushsense.windows.self_calibration import SelfCalibration

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
    rebooted, calibration = reboots(frames.device_ms, frames.host_ms, layout.gap_ms), SelfCalibration(layout)
    edges = [0, *np.flatnonzero(begins).tolist(), len(times)]
    parts: list[Part] = []
    for first, last in pairwise(edges):
        if rebooted[first : first + 1].any():
            calibration.reset()
        for segment in [] if fault[first:last].any() else resample(frames.slice(first, last), layout):
            inputs = network_inputs(calibration.apply(segment.data), layout)
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
