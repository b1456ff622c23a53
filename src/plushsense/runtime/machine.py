"""Computation of a toy, from frames to events: the one definition, which every reader of frames drives.

1. `FrameReader` makes even samples of frames: a gap or a reset of the device clock breaks the stream; then sensor
   health, the clock rule, and the inputs of the network.
2. `SampleReader` reads the samples: the gate with each of them; the network, the decision and the events every
   ``step`` samples, counted so that the first answer falls on the sample that fills the span. A break ends the event
   that is going on, and everything begins again.
3. `ToyMachine` is both: frames in, moments out.

Only a float network computes in floats; its logits are rounded to steps of 1/256, and all else is in integers.
``deploy/c/plushsense.c`` repeats this order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import Answer, EventMachine, Update
from plushsense.runtime.fixed import Ints, integer_logits
from plushsense.runtime.gate import Gate, Rule
from plushsense.runtime.health import Health, HealthSettings
from plushsense.windows.clock import SampleClock
from plushsense.windows.features import SampleInputs

InputRows = Sequence[Sequence[int]] | NDArray[np.int64]
"""Raw integer inputs (n, I) of a network."""
BreakReason = Literal["no signal", "sensor fault"]


class LogitStream(Protocol):
    """A network that reads one stream: `FloatLogits`, or an `IntegerStepper`."""

    @property
    def arch(self) -> Arch:
        """The architecture of the network."""

    def reset(self) -> None:
        """Forget the past."""

    def push(self, samples: InputRows) -> Ints:
        """Read raw integer inputs (n, I); return the logits (m, K), in steps of 1/256, of the decisions now due."""


class FloatLogits:
    """The float network of a bundle as a `LogitStream`: scaling, network, logits rounded to steps of 1/256."""

    def __init__(self, bundle: Bundle) -> None:
        self.arch, self._scaler = bundle.arch, bundle.scaler
        self._stepper = bundle.network().stepper()

    def reset(self) -> None:
        """Forget the past."""
        self._stepper.reset()

    def push(self, samples: InputRows) -> Ints:
        """Read raw integer inputs (n, I); return the logits (m, K) of the decisions now due."""
        return integer_logits(self._stepper.push(self._scaler.apply_sample(np.asarray(samples, dtype=np.int64))))


class Sample(NamedTuple):
    """The inputs (I,) of the network at an even sample; ``suspect`` as `Health` has it at the newest frame."""

    time_us: int
    inputs: list[int]
    suspect: bool


class Break(NamedTuple):
    """The end of a piece of the stream: everything that remembers the past begins again."""

    time_us: int
    reason: BreakReason


class FrameReader:
    """Makes the even samples of one stream of frames.

    Times are in microseconds since the first frame. A gap counts in full; a device clock that was set back goes on one
    sample after the last frame. While sensors are at fault there are no samples.

    Attributes:
        zero_us: device time at which the time of the stream is 0; it changes when the device clock is reset.
        time_us: time of the newest frame.
        clock: counts restarts and invalid values.
        health: says whether sensors are at fault, and counts faults.
    """

    def __init__(self, layout: Layout, health: HealthSettings) -> None:
        self.layout = layout
        self._inputs = SampleInputs(layout)
        self.health = Health(health, layout)
        self.reset()

    def reset(self) -> None:
        """Begin a new stream at time 0, with every count at 0."""
        self.clock = SampleClock(self.layout)
        self.health.reset()
        self._begun = False
        self.zero_us = self.time_us = 0

    def count_from(self, other: FrameReader) -> None:
        """Go on with the counts of another reader."""
        self.health.faults = other.health.faults
        self.clock.restarts, self.clock.invalid = other.clock.restarts, other.clock.invalid

    def push(self, device_ms: int, values: Sequence[int]) -> Iterator[Sample | Break]:
        """Read one frame; yield what it brings about. Counts and ``zero_us`` are those of the item just yielded."""
        clock, health = self.clock, self.health
        device_us = int(device_ms) * 1000
        if not self._begun:
            self._begun, self.zero_us = True, device_us
        gap_us = device_us - self.zero_us - self.time_us
        if gap_us < 0 or gap_us > self.layout.gap_ms * 1000:
            if not health.fault:
                yield Break(self.time_us, "no signal")
            health.clear()
        if gap_us < 0:
            self.zero_us += gap_us - self.layout.period_us
        self.time_us = device_us - self.zero_us
        change = health.push(int(device_ms), values)
        if change:
            clock.forget()
        if change == "fault":
            yield Break(self.time_us, "sensor fault")
        if health.fault:
            return
        samples = clock.rows(device_ms, values)
        if samples:
            suspect, period = health.suspect, self.layout.period_us
            time_us = (clock.now_us or 0) - (len(samples) - 1) * period - self.zero_us
            for n, sample in enumerate(samples):
                yield Sample(time_us + n * period, self._inputs(sample), suspect)


@dataclass(frozen=True, slots=True)
class Moment:
    """Result of the machine at one moment, with the numbers behind it.

    Attributes:
        cause: ``step``, a step of the network; ``gate``, the gate fired and changed an event; or the reason of a break.
        time_us: its time, in microseconds since the first frame of the stream.
        updates: changes of events, in order.
        rule: rule of the gate that fired.
        answer: what the network says; None in any moment but a step, and while warming.
        logits: (K,) logits of the step in steps of 1/256; None where there is no answer.
        smoothed: (K,) smoothed probabilities in steps of 2^-27, from which gesture and events are decided.
    """

    cause: Literal["step", "gate", "no signal", "sensor fault"]
    time_us: int
    updates: list[Update]
    rule: Rule | None = None
    answer: Answer | None = None
    logits: Ints | None = None
    smoothed: Ints | None = None


class SampleReader:
    """Reads the even samples of one stream: gate, network, decision, events.

    ``samples`` counts them since the start or the last break.
    """

    def __init__(self, network: LogitStream, gestures: GestureSet, rules: Rules, smoothing: int) -> None:
        arch = network.arch
        self._span, self._step, self._phase = arch.span, arch.step, arch.span % arch.step
        self._network, self._rules = network, rules.gate.rules
        self._gate = Gate(rules.gate)
        self._events = EventMachine(rules.events, smoothing, gestures)
        self.reset()

    def reset(self) -> None:
        """Begin a new stream, with no event counted."""
        self._events.reset()
        self._restart()

    def count_from(self, other: SampleReader) -> None:
        """Go on with the numbers of another reader's events."""
        self._events.number = other._events.number

    def _restart(self) -> None:
        self._network.reset()
        self._gate.reset()
        self.samples = 0
        self._block: list[list[int]] = []  # inputs since the last step: one call of the network for all of them

    @property
    def warming(self) -> bool:
        """Whether fewer samples than the span have come since the start or the last break."""
        return self.samples < self._span

    @property
    def in_event(self) -> bool:
        """Whether an event is open."""
        return self._events.open

    def read(self, items: Iterable[Sample | Break]) -> Iterator[Moment]:
        """Read samples and breaks; yield the moments that they bring about."""
        for item in items:
            if isinstance(item, Sample):
                yield from self._sample(*item)
            else:
                yield self.lose(item.time_us, item.reason)
                self._restart()

    def lose(self, time_us: int, reason: BreakReason) -> Moment:
        """End the open event: the signal is lost."""
        return Moment(reason, time_us, self._events.lost(time_us))

    def _sample(self, time_us: int, inputs: list[int], suspect: bool) -> list[Moment]:
        moments: list[Moment] = []
        self.samples += 1
        fired = self._gate.push(inputs, suspect)
        if fired >= 0:
            rule = self._rules[fired]
            updates = self._events.gate(rule.affect, rule.gesture, time_us)
            if updates:
                moments.append(Moment("gate", time_us, updates, rule))
        self._block.append(inputs)
        if self.samples % self._step == self._phase:
            moments.append(self._decide(time_us, suspect))
        return moments

    def _decide(self, time_us: int, suspect: bool) -> Moment:
        block, self._block = self._block, []
        logits = self._network.push(block)
        if not len(logits):
            return Moment("step", time_us, self._events.blind_step(time_us))
        answer, updates = self._events.step(logits[-1], time_us, suspect)
        assert self._events.mean is not None
        return Moment("step", time_us, updates, None, answer, logits[-1], self._events.mean[:-1])


class ToyMachine:
    """Computes what a toy computes: frames in, moments out.

    Args:
        network: reads the inputs; float or integer.
        layout: of the frames.
        gestures: in class order.
        rules: settings of health, gate and events.
        smoothing: weight of a new step, in steps of 2^-15 (`plushsense.runtime.fixed.smoothing_weight`).
    """

    def __init__(
        self, network: LogitStream, layout: Layout, gestures: GestureSet, rules: Rules, smoothing: int
    ) -> None:
        self.frames = FrameReader(layout, rules.health)
        self.samples = SampleReader(network, gestures, rules, smoothing)

    def reset(self) -> None:
        """Begin a new stream at time 0, with every count at 0."""
        self.frames.reset()
        self.samples.reset()

    def push(self, device_ms: int, values: Sequence[int]) -> Iterator[Moment]:
        """Read one frame; yield its moments. Counts of `frames` and `samples` are those of the moment just yielded."""
        return self.samples.read(self.frames.push(device_ms, values))

    def continue_from(self, other: ToyMachine) -> Moment:
        """Take the place of another machine on the same stream, as ``plush_swap`` does: counts go on, nothing else.

        Returns:
            The end of the event that is open in ``other``.
        """
        ended = other.silence()
        self.samples.count_from(other.samples)
        self.frames.count_from(other.frames)
        return ended

    def silence(self) -> Moment:
        """End the open event: no frame came for a while.

        The next frame goes on, or restarts after a gap.
        """
        return self.samples.lose(self.frames.time_us, "no signal")
