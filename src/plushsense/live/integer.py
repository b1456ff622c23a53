"""The deployed model reads a live stream: every decision is, bit for bit, the answer that the toy's C gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from plushsense.devices.base import Frame
from plushsense.live.stream import Decision, StreamReader
from plushsense.models import fixed
from plushsense.models.image import IntegerModel


class IntegerClassifier(StreamReader):
    """Reads the frames of one toy through a deployed model: clock, derived channels, then whole numbers only.

    ``confidence`` of a decision is a multiple of 2^-15, as in the toy, its ``probabilities`` of 2^-27;
    ``t_s`` in microseconds, counted from the stream's first frame, is the time of the toy's answer.
    """

    def __init__(self, model: IntegerModel) -> None:
        super().__init__(model.network.arch, model.layout, model.gestures, model.rules, model.smoothing)
        self.model = model
        self._stepper = model.network.stepper()
        self.reset()

    def _forget(self) -> None:
        self._stepper.reset()

    def _answer(self, block: list[list[int]]) -> fixed.Ints | None:
        logits = self._stepper.push(np.array(block, dtype=np.int64))
        return logits[-1] if logits else None


class BothEngines:
    """The deployed model and its float original on the same frames: decides as the first, counts where they differ."""

    def __init__(self, integer: IntegerClassifier, original: StreamReader) -> None:
        self.integer, self.original = integer, original
        self.layout, self.step_s = integer.layout, integer.step_s
        self._told = any(g.affect != "none" for g in integer.model.gestures.gestures)
        self.reset()

    @property
    def restarts(self) -> int:
        """As of the deployed model."""
        return self.integer.restarts

    @property
    def invalid(self) -> int:
        """As of the deployed model."""
        return self.integer.invalid

    @property
    def faults(self) -> int:
        """As of the deployed model."""
        return self.integer.faults

    @property
    def in_event(self) -> bool:
        """As of the deployed model."""
        return self.integer.in_event

    @property
    def time_s(self) -> float:
        """As of the deployed model."""
        return self.integer.time_s

    def silence(self) -> Decision:
        """Nothing was heard for a while; the deployed model's decision."""
        self.original.silence()
        return self.integer.silence()

    def reset(self) -> None:
        """Begin a new stream, with every count at 0."""
        self.integer.reset()
        self.original.reset()
        self._compared = self._gesture = self._affect = 0
        self._far = 0.0

    def push(self, frame: Frame) -> list[Decision]:
        """The deployed model's decisions that this frame completes."""
        decisions = self.integer.push(frame)
        answered = [d for d in decisions if d.probabilities is not None]
        others = [d for d in self.original.push(frame) if d.probabilities is not None]
        for one, other in zip(answered, others, strict=True):
            if one.probabilities is None or other.probabilities is None:
                continue
            self._compared += 1
            self._gesture += one.gesture == other.gesture
            self._affect += one.affect == other.affect
            apart = max(abs(a - b) for a, b in zip(one.probabilities, other.probabilities, strict=True))
            self._far = max(self._far, apart)
        return decisions

    def agreement(self) -> dict[str, Any]:
        """How often both said the same, of the ``decisions`` with an answer; None where there was none,
        and for affect where no gesture carries one.

        ``gesture`` and ``affect`` are shares, ``largest_difference`` that of any smoothed probability.
        """
        n = self._compared
        return {
            "decisions": n,
            "gesture": self._gesture / n if n else None,
            "affect": self._affect / n if n and self._told else None,
            "largest_difference": self._far if n else None,
        }
