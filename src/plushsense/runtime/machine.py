"""The computation of a toy, from frames to events. All readers of frames use this module.

1. `FrameReader` resamples frames to evenly spaced samples: it leaves out a single frame out of order, detects gaps and
   resets of the device clock, which break the stream, checks sensor health, applies the clock rule and the
   self-calibration, and computes the inputs of the network. Of the samples before a break, only the self-calibration
   knows: the sensor is still the same. After a reboot (rule 4 of the clock) it begins anew, too.
2. `SampleReader` passes each sample to the gate, and every ``step`` samples computes the network, the decision and the
   events. The steps are aligned so that the first answer is at the sample that completes the span. A break ends the
   open event and restarts everything.
3. `ToyMachine` combines both: it reads frames and yields moments.

Only a float network computes in floats; its logits are rounded to steps of 1/256, and all else is in integers.
``deploy/c/plushsense.c`` computes the same in the same order.
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
from plushsense.windows.self_calibration import SelfCalibration

InputRows = Sequence[Sequence[int]] | NDArray[np.int64]
"""Raw integer inputs (n, I) of a network."""
BreakReason = Literal["no signal", "sensor fault"]


class LogitStream(Protocol):
    """A network that reads one stream: `FloatLogits`, or an `IntegerStepper`."""

    @property
    def arch(self) -> Arch:
        """The architecture of the network."""

    def reset(self) -> None:
        """Discard all earlier samples."""

    def push(self, samples: InputRows) -> Ints:
        """Read raw integer inputs (n, I); return the logits (m, K), in steps of 1/256, of the decisions now due."""


class FloatLogits:
    """The float network of a bundle as a `LogitStream`: scaling, network, logits rounded to steps of 1/256."""

    def __init__(self, bundle: Bundle) -> None:
        self.arch, self._scaler = bundle.arch, bundle.scaler
        self._stepper = bundle.network().stepper()

    def reset(self) -> None:
        """Discard all earlier samples."""
        self._stepper.reset()

    def push(self, samples: InputRows) -> Ints:
        """Read raw integer inputs (n, I); return the logits (m, K) of the decisions now due."""
        return integer_logits(self._stepper.push(self._scaler.apply_sample(np.asarray(samples, dtype=np.int64))))


class Sample(NamedTuple):
    """The inputs (I,) of the network at one resampled time; ``suspect`` is that of `Health` at the newest frame."""

    time_us: int
    inputs: list[int]
    suspect: bool


class Break(NamedTuple):
    """A break in the stream, after which the computation is restarted."""

    time_us: int
    reason: BreakReason


class FrameReader:
    """Resamples one stream of frames and computes the inputs of the network.

    Times are in microseconds since the first frame and include gaps; if the device clock is reset, they continue one
    sample after the last frame. While sensors are at fault there are no samples.

    Attributes:
        zero_us: device time at which the stream's time is 0; it changes if the device clock is reset.
        time_us: time of the newest frame that was not left out.
        clock: leaves out single frames out of order; counts what becomes of frames, and measures their interval.
        health: detects and counts sensor faults.
    """

    def __init__(self, layout: Layout, health: HealthSettings) -> None:
        self.layout = layout
        self._calibration = SelfCalibration(layout)
        self._inputs = SampleInputs(layout)
        self._period_us = layout.period_us
        self.health = Health(health, layout)
        self.reset()

    def reset(self) -> None:
        """Begin a new stream at time 0 and set all counts to 0."""
        self.clock = SampleClock(self.layout)
        self._calibration.reset()
        self._inputs.reset()
        self.health.reset()
        self._begun = False
        self.zero_us = self.time_us = 0

    def count_from(self, other: FrameReader) -> None:
        """Continue with the counts of another reader."""
        self.health.faults = other.health.faults
        self.clock.count_from(other.clock)

    def prime(self, device_ms: int, values: Sequence[int], n: int) -> Iterator[Sample | Break]:
        """Begin a new segment with a frame; yield ``n`` samples of its values, none if they cannot be used."""
        self.clock.restart()
        self.health.clear()
        self._inputs.reset()
        for item in self.push(device_ms, values):
            yield item
            for _ in range(n - 1):
                yield Sample(self.time_us, self._inputs(self._calibration.push(list(values))), self.health.suspect)

    def recalibrate(self) -> None:
        """Forget all samples of self-calibrating sensors, as after a reboot, like ``plush_recalibrate``."""
        self._calibration.reset()

    def push(self, device_ms: int, values: Sequence[int], host_ms: int | None = None) -> Iterator[Sample | Break]:
        """Process one frame; yield samples and breaks. When one is yielded, counts and ``zero_us`` are valid for it.

        A frame that rule 1 of `plushsense.windows.clock` leaves out has no effect, as if it had been lost. Without
        ``host_ms``, no reboot is seen.
        """
        clock, health = self.clock, self.health
        device_us = int(device_ms) * 1000
        if not self._begun:
            self._begun, self.zero_us = True, device_us
        if not clock.accept(device_ms, host_ms):
            return
        if clock.rebooted:
            self.recalibrate()
        if clock.restarted:
            if not health.fault:
                yield Break(self.time_us, "no signal")
            health.clear()
            self._inputs.reset()
        gap_us = device_us - self.zero_us - self.time_us
        if gap_us < 0:
            self.zero_us += gap_us - self._period_us
        self.time_us = device_us - self.zero_us
        change = health.push(int(device_ms), values)
        if change:
            clock.forget()
            self._inputs.reset()
        if change == "fault":
            yield Break(self.time_us, "sensor fault")
        if health.fault:
            return
        samples = clock.samples(values)
        if samples:
            suspect, period = health.suspect, self._period_us
            time_us = (clock.now_us or 0) - (len(samples) - 1) * period - self.zero_us
            for n, sample in enumerate(samples):
                yield Sample(time_us + n * period, self._inputs(self._calibration.push(sample)), suspect)


@dataclass(frozen=True, slots=True)
class Moment:
    """Result of the machine at one time, with the numbers that led to it.

    Attributes:
        cause: ``step``, a step of the network; ``gate``, the gate fired and changed an event; or the reason of a break.
        time_us: in microseconds since the first frame of the stream.
        updates: changes of events, in order.
        rule: rule of the gate that fired.
        answer: result of the network; None while warming, and if ``cause`` is not ``step``.
        logits: (K,) logits in steps of 1/256; None if there is no answer.
        smoothed: (K,) smoothed probabilities in steps of 2^-27, which decide gesture and events.
    """

    cause: Literal["step", "gate", "no signal", "sensor fault"]
    time_us: int
    updates: list[Update]
    rule: Rule | None = None
    answer: Answer | None = None
    logits: Ints | None = None
    smoothed: Ints | None = None


class SampleReader:
    """Computes gate, network, decision and events on the samples of one stream.

    ``samples`` is their number since the start or the last break.
    """

    def __init__(self, network: LogitStream, gestures: GestureSet, rules: Rules, smoothing: int) -> None:
        arch = network.arch
        self._span, self._step, self._phase = arch.span, arch.step, arch.span % arch.step
        self._network, self._rules = network, rules.gate.rules
        self._gate = Gate(rules.gate)
        self._events = EventMachine(rules.events, smoothing, gestures)
        self.reset()

    def reset(self) -> None:
        """Begin a new stream and set the number of events to 0."""
        self._events.reset()
        self.restart()

    def count_from(self, other: SampleReader) -> None:
        """Continue with the event numbers of another reader."""
        self._events.number, self.sensitivity = other._events.number, other.sensitivity

    def restart(self) -> None:
        """Discard all earlier samples."""
        self._network.reset()
        self._gate.reset()
        self.samples = 0
        self._block: list[list[int]] = []  # inputs since the last step, for one call of the network

    @property
    def rest_samples(self) -> int:
        """Number of samples after which the next step has an answer."""
        return max(1, self._span - self._step)

    @property
    def sensitivity(self) -> int:
        """How readily the network begins events, see `EventMachine`."""
        return self._events.sensitivity

    @sensitivity.setter
    def sensitivity(self, value: int) -> None:
        self._events.sensitivity = value

    @property
    def warming(self) -> bool:
        """Whether there were fewer samples than the span since the start or the last break."""
        return self.samples < self._span

    @property
    def in_event(self) -> bool:
        """Whether an event is open."""
        return self._events.open

    def read(self, items: Iterable[Sample | Break]) -> Iterator[Moment]:
        """Process samples and breaks; yield the resulting moments."""
        for item in items:
            if isinstance(item, Sample):
                yield from self._sample(*item)
            else:
                yield self.lose(item.time_us, item.reason)
                self.restart()

    def lose(self, time_us: int, reason: BreakReason) -> Moment:
        """End the open event, because the signal is lost."""
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
    """Computes the same as a toy, from frames to moments.

    Args:
        network: float or integer network.
        layout: layout of the frames.
        gestures: gestures in class order.
        rules: settings of health, gate and events.
        smoothing: weight of a new step, in steps of 2^-15 (`plushsense.runtime.fixed.smoothing_weight`).

    Raises:
        BundleError: for rules that do not fit the network or the layout.
    """

    def __init__(
        self, network: LogitStream, layout: Layout, gestures: GestureSet, rules: Rules, smoothing: int
    ) -> None:
        rules.check(layout.n_channels, network.arch.channels, network.arch.classes)
        self.frames = FrameReader(layout, rules.health)
        self.samples = SampleReader(network, gestures, rules, smoothing)

    def reset(self) -> None:
        """Begin a new stream at time 0 and set all counts to 0."""
        self.frames.reset()
        self.samples.reset()

    def push(self, device_ms: int, values: Sequence[int], host_ms: int | None = None) -> Iterator[Moment]:
        """Process one frame; yield its moments. When one is yielded, the counts of the readers are valid for it."""
        return self.samples.read(self.frames.push(device_ms, values, host_ms))

    def continue_from(self, other: ToyMachine) -> Moment:
        """Replace another machine on the same stream, like ``plush_swap``: take over its counts, but no other state.

        Returns:
            The moment that ends the open event of ``other``.
        """
        ended = other.silence()
        self.samples.count_from(other.samples)
        self.frames.count_from(other.frames)
        return ended

    def prime(self, device_ms: int, values: Sequence[int]) -> Iterator[Moment]:
        """Begin again as if the values of a frame, of a toy at rest, had come for a span, like ``plush_prime``.

        The next step then has an answer, unless a value is out of its range or sensors are at fault. The first moment
        ends the open event.
        """
        yield self.silence()
        self.samples.restart()
        yield from self.samples.read(self.frames.prime(device_ms, values, self.samples.rest_samples))

    def silence(self) -> Moment:
        """End the open event, because no frame has arrived for a while.

        The stream continues with the next frame, or restarts after a gap.
        """
        return self.samples.lose(self.frames.time_us, "no signal")
