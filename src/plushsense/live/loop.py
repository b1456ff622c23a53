"""A device and a model run together: decisions as they fall, and in the end a summary."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError
from plushsense.devices.base import Device
from plushsense.live.integer import BothEngines
from plushsense.live.stream import Decision, StreamReader, check_layout

_KEPT = 72_000  # latencies kept: the last hour at 20 decisions a second


@dataclass(frozen=True)
class Summary:
    """What a live run did.

    Attributes:
        decisions: all of them; ``warming`` of these came without an answer.
        seconds: device time from the first frame to the newest.
        wall_s: time on the host's clock.
        decisions_per_s: decisions a second of device time.
        restarts: gaps and clock resets after which everything began again.
        invalid: values outside their valid range.
        counters: of the device (frames, lost, malformed, garbage, reconnects).
        latency_ms: p50 and p95 of the time from the device handing a frame over to its decision, over the
            last hour; a replay that does not wait hands over hundreds at once, and they stand in a queue.
    """

    decisions: int
    warming: int
    seconds: float
    wall_s: float
    decisions_per_s: float
    restarts: int
    invalid: int
    counters: dict[str, int]
    latency_ms: dict[str, float | None]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "decisions": self.decisions,
            "warming": self.warming,
            "seconds": round(self.seconds, 3),
            "wall_s": round(self.wall_s, 3),
            "decisions_per_s": round(self.decisions_per_s, 3),
            "restarts": self.restarts,
            "invalid": self.invalid,
            "counters": dict(self.counters),
            "latency_ms": dict(self.latency_ms),
        }


class Run(Iterator[Decision]):
    """A live run: iterate for decisions; `summary` tells at any time how it went."""

    def __init__(self, device: Device, classifier: StreamReader | BothEngines, seconds: float | None) -> None:
        self.device = device
        self.classifier = classifier
        self._seconds = seconds
        self._begun = time.perf_counter()
        self._decisions = self._warming = 0
        self._latencies: list[float] = []
        self._flow = self._decide()

    def __iter__(self) -> Run:
        return self

    def __next__(self) -> Decision:
        return next(self._flow)

    def _decide(self) -> Iterator[Decision]:
        limit = self._seconds
        heard = time.perf_counter()
        while not self.device.closed:
            frames = self.device.read()
            if frames is None:
                return
            arrived = time.perf_counter()
            if not frames and limit is not None and arrived - heard >= limit:
                return
            heard = arrived if frames else heard
            for frame in frames:
                decisions = self.classifier.push(frame)
                if limit is not None and self.classifier.time_s >= limit:
                    return
                for decision in decisions:
                    self._note(decision, time.perf_counter() - arrived)
                    yield decision

    def _note(self, decision: Decision, latency_s: float) -> None:
        self._decisions += 1
        self._warming += decision.state == "warming"
        if len(self._latencies) < _KEPT:
            self._latencies.append(latency_s)
        else:
            self._latencies[self._decisions % _KEPT] = latency_s

    def summary(self) -> Summary:
        """How it went so far."""
        seconds = self.classifier.time_s
        p50, p95 = (
            (round(float(v) * 1000.0, 3) for v in np.percentile(self._latencies, (50, 95)))
            if self._latencies
            else (None, None)
        )
        return Summary(
            self._decisions,
            self._warming,
            seconds,
            time.perf_counter() - self._begun,
            self._decisions / seconds if seconds > 0 else 0.0,
            self.classifier.restarts,
            self.classifier.invalid,
            self.device.counters.to_dict(),
            {"p50": p50, "p95": p95},
        )


def run(device: Device, classifier: StreamReader | BothEngines, *, seconds: float | None = None) -> Run:
    """Run a model on an open device.

    Args:
        device: an open one; closing it stays with the caller.
        classifier: it begins a new stream.
        seconds: stop after so much device time (so that a replay at any speed ends at the same place), or
            when the device has said nothing for so long; None runs until the device ends.

    Raises:
        ConfigError: when the device's channels are not those of the model, or ``seconds`` is not positive.
        DeviceError: while iterating, when the toy went away.
    """
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"seconds is {seconds!r}; give a positive duration, or leave it out to run until the end.")
    check_layout(device.layout, classifier.layout)
    classifier.reset()
    return Run(device, classifier, seconds)
