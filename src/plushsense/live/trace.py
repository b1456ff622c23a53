"""What a model hears in a whole stream, once; then any rules over it, as often as one likes.

`replay` gives the very events that a `StreamReader` gives frame by frame: the network is read only once, so that many
settings can be tried, and compared, on one person's stream.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.core.recfile import Frames
from plushsense.live.stream import whole_logits
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.events import Answer, EventMachine, Update
from plushsense.models.fixed import Ints
from plushsense.models.gate import Gate, GatePlan
from plushsense.models.health import Health, HealthPlan
from plushsense.models.image import IntegerModel
from plushsense.models.rules import Rules
from plushsense.windows.clock import resample
from plushsense.windows.features import inputs


@dataclass(frozen=True, eq=False)
class Part:
    """Even samples without a break.

    ``start_us`` the time of sample 0 since the stream's first frame, ``ends_us`` that at which it was over: of the last
    frame, or of the one with which a fault began; ``inputs`` (T, I) raw; ``suspect`` (T,); ``logits`` (n, K) in steps
    of 1/256, of every step from the one that fills the span.
    """

    start_us: int
    ends_us: int
    inputs: NDArray[np.int64]
    suspect: NDArray[np.bool_]
    logits: Ints


@dataclass(frozen=True, eq=False)
class Trace:
    """One stream as a model heard it; ``first_ms`` is the device time of the first frame, ``faults`` of its sensors.

    Time is counted as a `StreamReader` counts it: from the first frame, and over a reset of the clock it goes on.
    """

    arch: Arch
    period_us: int
    gestures: GestureSet
    first_ms: int
    parts: tuple[Part, ...]
    faults: int

    @property
    def seconds(self) -> float:
        """How long the parts are together."""
        return sum(len(p.inputs) for p in self.parts) * self.period_us / 1e6

    def step_times_us(self, part: Part) -> NDArray[np.int64]:
        """(n,) times of a part's answers."""
        at = np.arange(len(part.logits)) * self.arch.step + self.arch.span - 1
        return part.start_us + at * self.period_us


def trace_of(frames: Frames, model: Bundle | IntegerModel, health: HealthPlan | None = None) -> Trace:
    """Read a stream through a model.

    Args:
        frames: the whole stream, as recorded.
        model: a bundle is read by the float network, an integer model by the deployed one.
        health: when sensors cannot be believed; the model's own settings when left out.
    """
    from plushsense.live.decide import DecideSpec

    integer = isinstance(model, IntegerModel)
    network = model.network if isinstance(model, IntegerModel) else model.network()
    if health is None:
        health = model.rules.health if isinstance(model, IntegerModel) else DecideSpec.from_dict(model.decision).health
    layout = model.layout
    parts: list[Part] = []
    follower = Health(health, layout)
    for zero_us, first, last, end, suspects in _stretches(frames, follower, layout.gap_ms, layout.period_us):
        for segment in resample(frames.slice(first, last), layout):
            values = inputs(segment.data, layout)
            stepper = network.stepper()
            if integer:
                due = stepper.push(values)
            else:
                assert isinstance(model, Bundle)
                due = stepper.push(model.scaler.apply_sample(values))
            logits = np.array(due).reshape(len(due), len(model.gestures))
            parts.append(
                Part(
                    segment.start_us - zero_us,
                    int(frames.device_ms[end]) * 1000 - zero_us,
                    values,
                    suspects[segment.row_of],
                    logits.astype(np.int64) if integer else whole_logits(logits),
                )
            )
    first_ms = int(frames.device_ms[0]) if len(frames) else 0
    return Trace(network.arch, layout.period_us, model.gestures, first_ms, tuple(parts), follower.faults)


def _stretches(
    frames: Frames, health: Health, gap_ms: int, period_us: int
) -> Iterator[tuple[int, int, int, int, NDArray[np.bool_]]]:
    """Rows without a break or a fault: (device time in us at which the stream's time is 0, first row, last row
    exclusive, the row with which it was over, suspect of each row)."""
    ms = frames.device_ms.astype(np.int64)
    if not len(ms):
        return
    step = np.diff(ms)
    edges = [0, *(np.flatnonzero((step < 0) | (step > gap_ms)) + 1).tolist(), len(ms)]
    zero_us = int(ms[0]) * 1000
    for first, last in itertools.pairwise(edges):
        if first and ms[first] < ms[first - 1]:
            zero_us += int(ms[first] - ms[first - 1]) * 1000 - period_us
        health.clear()
        suspects = np.zeros(last - first, dtype=bool)
        begin = None if health.fault else 0
        times, rows = ms[first:last].tolist(), frames.values[first:last].tolist()
        for at, (now, values) in enumerate(zip(times, rows, strict=True)):
            said = health.push(now, values)
            suspects[at] = health.suspect
            if said == "fault":
                if begin is not None and at > begin:
                    yield zero_us, first + begin, first + at, first + at, suspects[begin:at]
                begin = None
            elif said == "recovered":
                begin = at
        if begin is not None and last - first > begin:
            yield zero_us, first + begin, last, last - 1, suspects[begin:]


def gate_hits(part: Part, plan: GatePlan) -> list[tuple[int, int]]:
    """(sample, rule) of every firing of the gate in a part."""
    if not plan.rules:
        return []
    gate = Gate(plan)
    rows, suspects = part.inputs.tolist(), part.suspect.tolist()
    fired = [gate.push(row, suspect) for row, suspect in zip(rows, suspects, strict=True)]
    return [(at, rule) for at, rule in enumerate(fired) if rule >= 0]


@dataclass(frozen=True, eq=False)
class Replayed:
    """``updates`` of events; ``answers`` of every step with its time in microseconds, where they were asked for."""

    updates: tuple[Update, ...]
    answers: tuple[tuple[int, Answer], ...]


def replay(
    trace: Trace,
    rules: Rules,
    smoothing: int,
    *,
    hits: list[list[tuple[int, int]]] | None = None,
    answers: bool = False,
) -> Replayed:
    """What rules make of a trace; times of the updates in microseconds.

    Args:
        smoothing: weight of a new step, in steps of 2^-15 (`fixed.smoothing_weight`).
        hits: of each part, when `gate_hits` was already asked.
        answers: keep every step's answer too.
    """
    machine = EventMachine(rules.events, smoothing, trace.gestures)
    updates: list[Update] = []
    kept: list[tuple[int, Answer]] = []
    step, span, period = trace.arch.step, trace.arch.span, trace.period_us
    phase = span % step
    for number, part in enumerate(trace.parts):
        fired = dict(gate_hits(part, rules.gate) if hits is None else hits[number])
        n, at = len(part.inputs), (phase or step) - 1
        steps = range(at, n, step)
        for at in sorted({*steps, *fired}) if fired else steps:
            now = part.start_us + at * period
            if at in fired:
                rule = rules.gate.rules[fired[at]]
                updates += machine.gate(rule.affect, rule.gesture, now)
            if (at + 1) % step != phase:
                continue
            due = (at + 1 - span) // step
            if due < 0:
                updates += machine.blind_step(now)
                continue
            answer, more = machine.step(part.logits[due], now, bool(part.suspect[at]))
            updates += more
            if answers:
                kept.append((now, answer))
        updates += machine.lost(part.ends_us)
    return Replayed(tuple(updates), tuple(kept))
