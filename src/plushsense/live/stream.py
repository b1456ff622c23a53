"""A model reads a live stream: frames in, a decision every step out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.signal import Layout
from plushsense.devices.base import Frame
from plushsense.live.decide import DecideSpec, Smoother
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.events import (
    AFFECTS,
    ANSWERS,
    KINDS,
    NO_GESTURE,
    ONE,
    SOURCES,
    Answer,
    EventMachine,
    Update,
)
from plushsense.models.fixed import LOGIT_LIMIT, PROBABILITY_BITS, SMOOTH_EXTRA_BITS, Ints, smoothing_weight
from plushsense.models.gate import Gate, Rule
from plushsense.models.health import Health
from plushsense.models.reference import softmax
from plushsense.models.rules import Rules
from plushsense.windows.clock import Clock
from plushsense.windows.features import SampleInputs

_DECIMALS = 4
_SMOOTH = float(1 << (PROBABILITY_BITS + SMOOTH_EXTRA_BITS))


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to an event: one for each gesture, with a beginning and an end.

    Attributes:
        what: ``begun``, ``named`` (its gesture became sure) or ``ended``.
        number: counts the events of a stream, from 1.
        affect: ``positive``, ``neutral``, ``negative`` or ``none``.
        gesture: the label, or None while only the affect is sure.
        source: who began it: ``gate``, the threshold rules, or ``cnn``, the network.
        since_s: when it was first wanted; of an end, when it was first missed.
        t_s: when it is said.
    """

    what: Literal["begun", "named", "ended"]
    number: int
    affect: str
    gesture: str | None
    source: Literal["cnn", "gate"]
    since_s: float
    t_s: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "what": self.what,
            "number": self.number,
            "affect": self.affect,
            "gesture": self.gesture,
            "source": self.source,
            "since_s": round(self.since_s, _DECIMALS),
            "t_s": round(self.t_s, _DECIMALS),
        }


State = Literal["warming", "tracking", "no signal", "sensor fault"]


@dataclass(frozen=True, slots=True)
class Decision:
    """What the toy feels now.

    Attributes:
        t_s: device time of the newest sample it saw, in seconds since the stream's first frame. A gap counts
            in full; over a reset of the device clock the time goes on where it was.
        gesture: the best label, sure or not, or None while there is no answer; of the gate, its rule's, or None.
        affect: ``positive``, ``neutral``, ``negative`` or ``none`` (None while there is no answer).
        confidence: smoothed probability of the gesture, 0 to 1, or None.
        source: who decided; ``cnn``, the network, or ``gate``, the threshold rules, between two steps.
        state: ``warming`` until the span has been seen since the start or a restart; then ``tracking``; ``no signal``
            when nothing was heard; ``sensor fault`` when a sensor cannot be believed.
        probabilities: smoothed probabilities in class order, or None.
        answer: ``sure`` (of one gesture), ``affect`` (of an affect only), ``unsure``, ``unknown`` (not a known
            gesture) or ``idle``; None while there is no answer.
        events: what happened to events at this moment, in order; mostly nothing.
    """

    t_s: float
    gesture: str | None
    affect: str | None
    confidence: float | None
    source: Literal["cnn", "gate"]
    state: State
    probabilities: tuple[float, ...] | None
    answer: str | None = None
    events: tuple[Event, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The line that ``plushsense live`` prints."""
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


class StreamReader(ABC):
    """Reads the frames of one toy: health, clock, derived channels, gate, events here; the network is the subclass's.

    Decisions come every ``step`` even samples, counted so that the first answer falls on the sample that
    fills the span; between them when the gate fires, when the signal was lost, and when sensors fail. After a gap
    beyond the layout's ``gap_ms`` or a reset of the device clock (``no signal``, said with the first frame after it,
    at the time of the last one before) and after a sensor fault everything restarts. In a fault nothing is decided.
    """

    def __init__(self, arch: Arch, layout: Layout, gestures: GestureSet, rules: Rules, smoothing: int) -> None:
        self.arch, self.layout, self.rules = arch, layout, rules
        self.step_s = arch.step * layout.period_us / 1e6
        self._step, self._phase = arch.step, arch.span % arch.step
        self._labels, self._affects = gestures.labels, gestures.affects
        self._inputs = SampleInputs(layout)
        self._health = Health(rules.health, layout)
        self._gate = Gate(rules.gate)
        self._machine = EventMachine(rules.events, smoothing, gestures)

    @property
    def restarts(self) -> int:
        """How often a gap or a clock reset made everything begin again."""
        return self._clock.restarts

    @property
    def invalid(self) -> int:
        """Values outside their channel's valid range, which the last valid one stood in for."""
        return self._clock.invalid

    @property
    def faults(self) -> int:
        """How often sensors could not be believed."""
        return self._health.faults

    @property
    def in_event(self) -> bool:
        """Whether an event is going on."""
        return self._machine.open

    @property
    def time_s(self) -> float:
        """Device time of the newest frame, in seconds since the stream's first."""
        return 0.0 if self._zero_us is None else (self._seen_us - self._zero_us) / 1e6

    def reset(self) -> None:
        """Begin a new stream at time 0, with every count at 0."""
        self._clock = Clock(self.layout)
        self._health.reset()
        self._machine.reset()
        self._zero_us: int | None = None
        self._seen_us = 0
        self._silent = False
        self._restart()

    def _restart(self) -> None:
        self._forget()
        self._gate.reset()
        self._samples = 0
        self._block: list[list[int]] = []

    def silence(self) -> Decision:
        """Nothing was heard for a while: what was going on ends. The next frame goes on, or restarts after a gap."""
        self._silent = True
        return self._gone("no signal", self._machine.lost(self._seen_us - (self._zero_us or 0)))

    def push(self, frame: Frame) -> list[Decision]:
        """The decisions, mostly none or one, that this frame completes."""
        period, clock = self.layout.period_us, self._clock
        device_us = int(frame.device_ms) * 1000
        due: list[Decision] = []
        gap_us = device_us - self._seen_us
        if self._zero_us is not None and (gap_us < 0 or gap_us > self.layout.gap_ms * 1000):
            # Also in a fault, when the clock sees no frames.
            ended = self._machine.lost(self._seen_us - self._zero_us)
            if not (self._health.fault or self._silent):
                due.append(self._gone("no signal", ended))
            self._health.clear()
        if self._zero_us is None:
            self._zero_us = device_us
        elif gap_us < 0:
            self._zero_us += gap_us - period
        self._seen_us = device_us
        health = self._health.push(int(frame.device_ms), frame.values)
        if health == "fault":
            due.append(self._gone("sensor fault", self._machine.lost(device_us - self._zero_us)))
        if health:
            clock.forget()
            self._restart()
        silent, self._silent = self._silent, False
        if self._health.fault:
            if silent and not due:
                due.append(self._gone("sensor fault", []))  # it goes on
            return due
        suspect = self._health.suspect
        samples = clock.rows(frame.device_ms, frame.values)
        if clock.restarted:
            self._restart()
        for later, sample in zip(range(len(samples) - 1, -1, -1), samples, strict=True):
            self._samples += 1
            inputs = self._inputs(sample)
            now_us = (clock.now_us or 0) - later * period - self._zero_us
            fired = self._gate.push(inputs, suspect)
            if fired >= 0:
                rule = self.rules.gate.rules[fired]
                updates = self._machine.gate(rule.affect, rule.gesture, now_us)
                if updates:
                    due.append(self._from_gate(rule, now_us, updates))
            self._block.append(inputs)
            if self._samples % self._step == self._phase:
                due.append(self._decide(now_us, suspect))
        return due

    def _decide(self, now_us: int, suspect: bool) -> Decision:
        # The samples of a step go through the network together: a fifth of the calls, the same numbers.
        block, self._block = self._block, []
        logits = self._answer(block)
        if logits is None:
            events = self._told(self._machine.blind_step(now_us))
            return Decision(now_us / 1e6, None, None, None, "cnn", "warming", None, None, events)
        answer, updates = self._machine.step(logits, now_us, suspect)
        best, confidence, probabilities = self._said(answer)
        return Decision(
            now_us / 1e6,
            self._labels[best],
            self._affects[best],
            confidence,
            "cnn",
            "tracking",
            tuple(probabilities.tolist()),
            ANSWERS[answer.kind],
            self._told(updates),
        )

    def _from_gate(self, rule: Rule, now_us: int, updates: list[Update]) -> Decision:
        gesture = None if rule.gesture == NO_GESTURE else self._labels[rule.gesture]
        warm = self._samples >= self.arch.span
        return Decision(
            now_us / 1e6,
            gesture,
            AFFECTS[rule.affect],
            None,
            "gate",
            "tracking" if warm else "warming",
            None,
            None,
            self._told(updates),
        )

    def _gone(self, state: State, updates: list[Update]) -> Decision:
        return Decision(self.time_s, None, None, None, "cnn", state, None, None, self._told(updates))

    def _told(self, updates: list[Update]) -> tuple[Event, ...]:
        return tuple(
            Event(
                KINDS[u.kind],
                u.number,
                AFFECTS[u.affect],
                None if u.gesture == NO_GESTURE else self._labels[u.gesture],
                SOURCES[u.source],
                u.since / 1e6,
                u.now / 1e6,
            )
            for u in updates
        )

    @abstractmethod
    def _forget(self) -> None:
        """Forget the past of the network."""

    @abstractmethod
    def _answer(self, block: list[list[int]]) -> Ints | None:
        """Take the inputs of a step's samples in: logits (K,) in steps of 1/256; None while warming."""

    def _said(self, answer: Answer) -> tuple[int, float, NDArray[np.float64]]:
        """Class, confidence and smoothed probabilities of the step that was just answered."""
        assert self._machine.mean is not None
        return answer.best, answer.share / ONE, self._machine.mean[:-1] / _SMOOTH


class StreamClassifier(StreamReader):
    """Reads the frames of one toy through a bundle: clock, derived channels, scaling, network, smoothing.

    Works with every padding; ``mirror`` and ``causal`` compute the whole window anew at each step. Gesture, confidence
    and probabilities are those of the float network; events follow its logits rounded to steps of 1/256.

    Args:
        bundle: the model.
        decide: how decisions are made; the bundle's own settings when left out.
    """

    def __init__(self, bundle: Bundle, decide: DecideSpec | None = None) -> None:
        self.bundle = bundle
        self.spec = decide or DecideSpec.from_dict(bundle.decision)
        step_s = bundle.arch.step * bundle.layout.period_us / 1e6
        weight = smoothing_weight(self.spec.smoothing_s, step_s)
        super().__init__(bundle.arch, bundle.layout, bundle.gestures, self.spec.rules(step_s), weight)
        self._stepper = bundle.network().stepper()
        self._smoother = Smoother(self.spec, self.step_s)
        self.reset()

    def _forget(self) -> None:
        self._stepper.reset()
        self._smoother.reset()

    def _answer(self, block: list[list[int]]) -> Ints | None:
        logits = self._stepper.push(self.bundle.scaler.apply_sample(np.array(block, dtype=np.float64)))
        if not logits:
            return None
        self._smooth = self._smoother.update(softmax(logits[-1]))
        return whole_logits(logits[-1])

    def _said(self, answer: Answer) -> tuple[int, float, NDArray[np.float64]]:
        best = int(self._smooth.argmax())
        return best, float(self._smooth[best]), self._smooth


def whole_logits(logits: NDArray[Any]) -> Ints:
    """Float logits (..., K) in steps of 1/256, held as the toy holds them: what events follow."""
    return np.clip(np.rint(np.asarray(logits, dtype=np.float64) * 256), -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.int64)


def check_layout(sent: Layout, read: Layout) -> None:
    """Refuse a device whose frames are not those that a model reads.

    What a frame holds is compared (channels, units, integer steps, valid ranges), not the line format: older
    firmware of the same toy will do. The model's own rate, gap and inputs hold.

    Raises:
        ConfigError: naming both layouts and the first channel that differs.
    """
    if sent.channels == read.channels:
        return
    ask = f"open the device with ?layout={read.name}, or take a model made for '{sent.name}'"
    if sent.names != read.names:
        raise ConfigError(
            f"The device sends layout '{sent.name}' ({', '.join(sent.names)}), but the model reads "
            f"'{read.name}' ({', '.join(read.names)}): {ask}."
        )
    other = next(a.name for a, b in zip(sent.channels, read.channels, strict=True) if a != b)
    raise ConfigError(
        f"The device sends layout '{sent.name}', in which channel '{other}' has another unit, scale, step or "
        f"valid range than in the model's '{read.name}': {ask}."
    )
