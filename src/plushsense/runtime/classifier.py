"""Classify a live stream of frames; return a `Decision` at every step.

A `StreamReader` runs a `plushsense.runtime.machine.ToyMachine` and converts its results to labels and seconds.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

from plushsense.core.errors import ArrayError, ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.devices.base import Frame
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec, Rules
from plushsense.runtime.events import AFFECTS, ANSWERS, KINDS, NO_GESTURE, ONE, SOURCES, Update
from plushsense.runtime.fixed import PROBABILITY_BITS, SMOOTH_EXTRA_BITS, smoothing_weight
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.machine import FloatLogits, LogitStream, Moment, ToyMachine
from plushsense.windows.clock import SampleClock

_DECIMALS = 4
_SMOOTH = float(1 << (PROBABILITY_BITS + SMOOTH_EXTRA_BITS))


@dataclass(frozen=True, slots=True)
class GestureEvent:
    """A change of an event. Each gesture of the person is one event with a beginning and an end.

    Attributes:
        kind: ``begun``, ``named`` (its gesture became certain) or ``ended``.
        number: number of the event in the stream, from 1.
        affect: ``positive``, ``neutral``, ``negative`` or ``none``.
        gesture: the label, or None while only the affect is certain.
        source: what began the event: ``gate``, the threshold rules, or ``cnn``, the network.
        since_s: first time at which the event was likely; for ``ended``, first time at which it no longer was.
        t_s: time of the report.
    """

    kind: Literal["begun", "named", "ended"]
    number: int
    affect: str
    gesture: str | None
    source: Literal["cnn", "gate"]
    since_s: float
    t_s: float

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        rounded = {"since_s": round(self.since_s, _DECIMALS), "t_s": round(self.t_s, _DECIMALS)}
        values = asdict(self) | rounded
        return {"what": values.pop("kind"), **values}


State = Literal["warming", "tracking", "no signal", "unreadable", "sensor fault"]


@dataclass(frozen=True, slots=True)
class Decision:
    """The decision at one time of a stream.

    Attributes:
        t_s: device time of the newest sample that it depends on, in seconds since the stream's first frame. Gaps are
            included; after a reset of the device clock the time continues.
        gesture: the most probable label, or None while there is no answer; for the gate, that of its rule, if any.
        affect: ``positive``, ``neutral``, ``negative`` or ``none`` (None while there is no answer).
        confidence: smoothed probability of the gesture, 0 to 1, or None.
        source: what decided: ``cnn``, the network, or, between two steps, ``gate``, the threshold rules.
        state: ``warming`` from the start or a restart until enough samples for the network were read; then
            ``tracking``; ``no signal`` when frames are missing; ``unreadable`` when lines come that are none;
            ``sensor fault`` when sensors are at fault.
        probabilities: smoothed probabilities in class order, or None.
        answer: ``sure`` (of one gesture), ``affect`` (of an affect only), ``unsure``, ``unknown`` (not a known
            gesture) or ``idle``; None while there is no answer.
        events: changes of events at this time, in order; usually none.
    """

    t_s: float
    gesture: str | None
    affect: str | None
    confidence: float | None
    source: Literal["cnn", "gate"]
    state: State
    probabilities: tuple[float, ...] | None
    answer: str | None = None
    events: tuple[GestureEvent, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return plain values for the line that ``plushsense live`` prints."""
        confidence = None if self.confidence is None else round(self.confidence, _DECIMALS)
        return {
            "t_s": round(self.t_s, _DECIMALS),
            "gesture": self.gesture,
            "affect": self.affect,
            "confidence": confidence,
            "source": self.source,
            "state": self.state,
            "answer": self.answer,
            "events": [event.to_dict() for event in self.events],
        }


class StreamReader:
    """Reads the frames of one toy and returns decisions.

    There is a decision every ``step`` samples, and also when the gate fires, the signal was lost or sensors fail. The
    second frame after a gap beyond the layout's ``gap_ms`` or a reset of the device clock gives ``no signal``, at the
    time of the last frame before; the first one is left out. During a sensor fault there are no decisions.

    The arguments are those of `ToyMachine`.

    Attributes:
        bundle: the model that it was made from, None if that is not known; `LiveRun` compares the frames with it.
    """

    bundle: Bundle | None = None

    def __init__(
        self, network: LogitStream, layout: Layout, gestures: GestureSet, rules: Rules, smoothing: int
    ) -> None:
        self.layout, self.gestures = layout, gestures
        self.step_s = network.arch.step * layout.period_us / 1e6
        self._machine = ToyMachine(network, layout, gestures, rules, smoothing)
        self._silent = False

    @property
    def clock(self) -> SampleClock:
        """The clock rule on this stream, with its counts and the measured interval."""
        return self._machine.frames.clock

    @property
    def restarts(self) -> int:
        """Number of gaps and clock resets after which the computation was restarted."""
        return self._machine.frames.clock.restarts

    @property
    def invalid(self) -> int:
        """Number of values outside their channel's valid range, replaced by the last valid one."""
        return self._machine.frames.clock.invalid

    @property
    def faults(self) -> int:
        """Number of sensor faults."""
        return self._machine.frames.health.faults

    @property
    def in_event(self) -> bool:
        """Whether an event is open."""
        return self._machine.samples.in_event

    @property
    def time_s(self) -> float:
        """Device time of the newest frame that was not left out, in seconds since the first frame of the stream."""
        return self._machine.frames.time_us / 1e6

    @property
    def sensitivity(self) -> int:
        """How readily the network begins and keeps events, see `EventMachine`; 0 as trained. A reset keeps it."""
        return self._machine.samples.sensitivity

    @sensitivity.setter
    def sensitivity(self, value: int) -> None:
        if not -128 <= value <= 127:
            raise ConfigError("The sensitivity is {value}: accepted are -128 to 127, 0 as trained.", value=value)
        self._set_sensitivity(value)

    def _set_sensitivity(self, value: int) -> None:
        self._machine.samples.sensitivity = value

    def reset(self) -> None:
        """Begin a new stream at time 0 and set all counts to 0."""
        self._machine.reset()
        self._silent = False

    def silence(self) -> Decision:
        """End the open event, because no frame has arrived for a while.

        The stream continues with the next frame, or restarts after a gap.
        """
        self._silent = True
        return self._decision(self._machine.silence())

    def push(self, frame: Frame) -> list[Decision]:
        """Process one frame and return the decisions that it completes, usually none or one.

        Raises:
            ArrayError: for a frame that does not have the layout's channels in whole steps, as `Layout.in_steps` gives
                them, and whole milliseconds.
        """
        frame = whole_frame(frame, self.layout)
        decisions = [
            self._decision(moment)
            for moment in self._machine.push(frame.device_ms, frame.values, frame.host_ms)
            if not (self._silent and moment.cause == "no signal")  # `silence` has reported it already
        ]
        if self._machine.frames.clock.left_out:
            return []
        silent, self._silent = self._silent, False
        if silent and not decisions and self._machine.frames.health.fault:
            decisions.append(Decision(self.time_s, None, None, None, "cnn", "sensor fault", None))
        return decisions

    def _decision(self, moment: Moment) -> Decision:
        t_s, labels = moment.time_us / 1e6, self.gestures.labels
        events = events_of(moment.updates, self.gestures)
        if moment.cause in ("no signal", "sensor fault"):
            return Decision(t_s, None, None, None, "cnn", moment.cause, None, None, events)
        if moment.rule is not None:
            gesture = None if moment.rule.gesture == NO_GESTURE else labels[moment.rule.gesture]
            state: State = "warming" if self._machine.samples.warming else "tracking"
            return Decision(t_s, gesture, AFFECTS[moment.rule.affect], None, "gate", state, None, None, events)
        answer = moment.answer
        if answer is None or moment.smoothed is None:
            return Decision(t_s, None, None, None, "cnn", "warming", None, None, events)
        return Decision(
            t_s,
            labels[answer.best],
            self.gestures.affects[answer.best],
            answer.share / ONE,
            "cnn",
            "tracking",
            tuple((moment.smoothed / _SMOOTH).tolist()),
            ANSWERS[answer.kind],
            events,
        )


def events_of(updates: Iterable[Update], gestures: GestureSet) -> tuple[GestureEvent, ...]:
    """Convert updates, with times in microseconds, to events with labels and seconds."""
    return tuple(
        GestureEvent(
            KINDS[u.kind],
            u.number,
            AFFECTS[u.affect],
            None if u.gesture == NO_GESTURE else gestures.labels[u.gesture],
            SOURCES[u.source],
            u.since / 1e6,
            u.now / 1e6,
        )
        for u in updates
    )


class StreamClassifier(StreamReader):
    """Classifies the frames of one toy with the float network of a bundle.

    Works with every padding; ``mirror`` and ``causal`` compute the whole window again at each step. Its logits are
    rounded to steps of 1/256; smoothing and decisions are then the same as in the toy.

    Args:
        bundle: the model.
        decide: decision settings; by default those of the bundle.
    """

    def __init__(self, bundle: Bundle, decide: DecideSpec | None = None) -> None:
        self.bundle = bundle
        self.spec = decide or DecideSpec.from_dict(bundle.decision)
        step_s = bundle.arch.step * bundle.layout.period_us / 1e6
        weight = smoothing_weight(self.spec.smoothing_s, step_s)
        super().__init__(FloatLogits(bundle), bundle.layout, bundle.gestures, self.spec.rules(step_s), weight)


class IntegerClassifier(StreamReader):
    """Classifies the frames of one toy with a deployed model, with exactly the results of the toy.

    ``confidence`` of a decision is a multiple of 2^-15, its ``probabilities`` of 2^-27; ``t_s`` in microseconds,
    counted from the first frame of the stream, is the time of the toy's answer.
    """

    def __init__(self, model: IntegerModel) -> None:
        super().__init__(model.network.stepper(), model.layout, model.gestures, model.rules, model.smoothing)


@dataclass(frozen=True)
class EngineAgreement:
    """Agreement of two networks on one stream.

    ``decisions`` counts those with an answer; ``gesture`` and ``affect`` are the shares of equal ones;
    ``largest_difference`` is that of smoothed probabilities. None without answers, or without affects.
    """

    decisions: int
    gesture: float | None
    affect: float | None
    largest_difference: float | None


class BothEngines(IntegerClassifier):
    """Classifies like the deployed model, and counts differences from its float original on the same frames."""

    def __init__(self, model: IntegerModel, original: StreamReader) -> None:
        super().__init__(model)
        self.original = original
        self._has_affects = any(g.affect != "none" for g in model.gestures.gestures)
        self._clear_counts()

    def _set_sensitivity(self, value: int) -> None:
        super()._set_sensitivity(value)
        self.original.sensitivity = value

    def silence(self) -> Decision:
        """End the open event like `StreamReader.silence`; return the deployed model's decision."""
        self.original.silence()
        return super().silence()

    def reset(self) -> None:
        """Begin a new stream and set all counts to 0."""
        super().reset()
        self.original.reset()
        self._clear_counts()

    def _clear_counts(self) -> None:
        self._compared = self._gesture = self._affect = 0
        self._largest = 0.0

    def push(self, frame: Frame) -> list[Decision]:
        """Process one frame like `StreamReader.push`; return the deployed model's decisions."""
        decisions = super().push(frame)
        both = (decisions, self.original.push(frame))
        answered = [[(d, d.probabilities) for d in part if d.probabilities is not None] for part in both]
        for (one, shares), (other, other_shares) in zip(*answered, strict=True):
            self._compared += 1
            self._gesture += one.gesture == other.gesture
            self._affect += one.affect == other.affect
            self._largest = max(self._largest, *(abs(a - b) for a, b in zip(shares, other_shares, strict=True)))
        return decisions

    def agreement(self) -> EngineAgreement:
        """Return how often both networks gave the same answer."""
        n = self._compared
        affect = self._affect / n if n and self._has_affects else None
        return EngineAgreement(n, self._gesture / n if n else None, affect, self._largest if n else None)


def whole_frame(frame: Frame, layout: Layout) -> Frame:
    """Return a frame as Python integers; raise ArrayError if it is not one of the layout, in whole steps."""
    host_ms, device_ms, values = frame
    if type(device_ms) is int and len(values) == layout.n_channels and {int}.issuperset(map(type, values)):
        return frame
    if len(values) != layout.n_channels:
        raise ArrayError(
            f"The frame has {len(values)} values, but layout '{layout.name}' has {layout.n_channels} channels: give "
            f"one for each of {', '.join(layout.names)}."
        )
    try:
        device_ms = operator.index(device_ms)
    except TypeError:
        raise ArrayError(
            f"device_ms is {device_ms!r} in a frame: accepted are whole milliseconds of the toy's clock."
        ) from None
    whole = []
    for channel, value in zip(layout.channels, values, strict=True):
        try:
            whole.append(operator.index(value))
        except TypeError:
            raise ArrayError(
                f"'{channel.name}' is {value!r} in a frame, whose values are whole numbers of steps, here of "
                f"{channel.step:g}: convert the sample by values=layout.in_steps(sample)."
            ) from None
    return Frame(host_ms, device_ms, tuple(whole))


def check_layout(sent: Layout, read: Layout) -> None:
    """Raise ConfigError if a model cannot read the frames that a device sends.

    The channels are compared, with their units and integer steps, but not the line format, so that older firmware of
    the same toy is accepted. Rate, gap, inputs, offsets and valid ranges are those of the model.

    Raises:
        ConfigError: naming both layouts and the first channel that differs.
    """
    if sent.reads_as(read):
        return
    ask = f"open the device with ?layout={read.name}, or take a model made for '{sent.name}'"
    if sent.names != read.names:
        raise ConfigError(
            "The device sends layout '{sent}' ({names}), but the model reads '{read}' ({model_names}): {ask}.",
            sent=sent.name,
            names=", ".join(sent.names),
            read=read.name,
            model_names=", ".join(read.names),
            ask=ask,
            field="network",
        )
    raise ConfigError(
        "The device sends layout '{sent}', in which channel '{unlike}' has another unit, scale, step or kind than in "
        "the model's '{read}': {ask}.",
        sent=sent.name,
        unlike=sent.unlike(read)[0],
        read=read.name,
        ask=ask,
        field="network",
    )
