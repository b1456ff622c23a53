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
from plushsense.models.reference import softmax
from plushsense.windows.clock import Clock
from plushsense.windows.features import SampleInputs

_DECIMALS = 4


@dataclass(frozen=True, slots=True)
class Decision:
    """What the toy feels now.

    Attributes:
        t_s: device time of the newest sample it saw, in seconds since the stream's first frame. A gap counts
            in full; over a reset of the device clock the time goes on where it was.
        gesture: the label, or None while warming.
        affect: ``positive``, ``neutral``, ``negative`` or ``none`` (None while warming).
        confidence: smoothed probability of the gesture, 0 to 1, or None while warming.
        source: who decided; ``cnn``, the network.
        state: ``warming`` until the span has been seen since the start or a restart; then ``tracking``.
        probabilities: smoothed probabilities in class order, or None while warming.
    """

    t_s: float
    gesture: str | None
    affect: str | None
    confidence: float | None
    source: Literal["cnn", "gate"]
    state: Literal["warming", "tracking"]
    probabilities: tuple[float, ...] | None

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
        }


class StreamReader(ABC):
    """Reads the frames of one toy: clock and derived channels here; what answers is the subclass's.

    Decisions come every ``step`` even samples, counted so that the first answer falls on the sample that
    fills the span. After a gap beyond the layout's ``gap_ms`` or a reset of the device clock everything
    restarts.
    """

    def __init__(self, arch: Arch, layout: Layout, gestures: GestureSet) -> None:
        self.arch, self.layout = arch, layout
        self.step_s = arch.step * layout.period_us / 1e6
        self._step, self._phase = arch.step, arch.span % arch.step
        self._labels, self._affects = gestures.labels, gestures.affects
        self._inputs = SampleInputs(layout)

    @property
    def restarts(self) -> int:
        """How often a gap or a clock reset made everything begin again."""
        return self._clock.restarts

    @property
    def invalid(self) -> int:
        """Values outside their channel's valid range, which the last valid one stood in for."""
        return self._clock.invalid

    @property
    def time_s(self) -> float:
        """Device time of the newest frame, in seconds since the stream's first."""
        return 0.0 if self._zero_us is None else (self._seen_us - self._zero_us) / 1e6

    def reset(self) -> None:
        """Begin a new stream at time 0, with every count at 0."""
        self._clock = Clock(self.layout)
        self._zero_us: int | None = None
        self._seen_us = 0
        self._restart()

    def _restart(self) -> None:
        self._forget()
        self._samples = 0
        self._block: list[list[int]] = []

    def push(self, frame: Frame) -> list[Decision]:
        """The decisions, mostly none or one, that this frame completes."""
        period = self.layout.period_us
        device_us = int(frame.device_ms) * 1000
        if self._zero_us is None:
            self._zero_us = device_us
        elif device_us < self._seen_us:
            self._zero_us += device_us - self._seen_us - period
        self._seen_us = device_us
        samples = self._clock.push(frame.device_ms, frame.values)
        if self._clock.restarted:
            self._restart()
        due = []
        for later, sample in zip(range(len(samples) - 1, -1, -1), samples, strict=True):
            self._samples += 1
            self._block.append(self._inputs(sample))
            if self._samples % self._step == self._phase:
                newest_us = (self._clock.now_us or 0) - later * period
                due.append(self._decide((newest_us - self._zero_us) / 1e6))
        return due

    def _decide(self, t_s: float) -> Decision:
        # The samples of a step go through the network together: a fifth of the calls, the same numbers.
        block, self._block = self._block, []
        found = self._answer(block)
        if found is None:
            return Decision(t_s, None, None, None, "cnn", "warming", None)
        best, confidence, probabilities = found
        return Decision(
            t_s,
            self._labels[best],
            self._affects[best],
            confidence,
            "cnn",
            "tracking",
            tuple(probabilities.tolist()),
        )

    @abstractmethod
    def _forget(self) -> None:
        """Forget the past of network and smoothing."""

    @abstractmethod
    def _answer(self, block: list[list[int]]) -> tuple[int, float, NDArray[np.float64]] | None:
        """Take the inputs of a step's samples in: class, confidence, smoothed probabilities; None while warming."""


class StreamClassifier(StreamReader):
    """Reads the frames of one toy through a bundle: clock, derived channels, scaling, network, smoothing.

    Works with every padding; ``mirror`` and ``causal`` compute the whole window anew at each step.

    Args:
        bundle: the model.
        decide: how decisions are made; the bundle's own settings when left out.
    """

    def __init__(self, bundle: Bundle, decide: DecideSpec | None = None) -> None:
        super().__init__(bundle.arch, bundle.layout, bundle.gestures)
        self.bundle = bundle
        self.spec = decide or DecideSpec.from_dict(bundle.decision)
        self._stepper = bundle.network().stepper()
        self._smoother = Smoother(self.spec, self.step_s)
        self.reset()

    def _forget(self) -> None:
        self._stepper.reset()
        self._smoother.reset()

    def _answer(self, block: list[list[int]]) -> tuple[int, float, NDArray[np.float64]] | None:
        logits = self._stepper.push(self.bundle.scaler.apply_sample(np.array(block, dtype=np.float64)))
        if not logits:
            return None
        smooth = self._smoother.update(softmax(logits[-1]))
        best = int(smooth.argmax())
        return best, float(smooth[best]), smooth


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
