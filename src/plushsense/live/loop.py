"""Run a model on the frames of an open device: decisions as they are made, and a summary."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from plushsense.core.errors import ConfigError, python_warning
from plushsense.core.sentences import Message
from plushsense.devices.base import Device, Frame
from plushsense.live.plausibility import PlausibilityMonitor
from plushsense.runtime.classifier import Decision, StreamReader, check_layout

_KEPT = 72_000  # number of latencies kept: the last hour at 20 decisions per second
SILENCE_S = 0.75
"""Host time without frames after which there is no signal; wireless links stall for shorter times."""


@dataclass(frozen=True)
class LiveSummary:
    """Summary of a live run.

    Attributes:
        decisions: number of decisions; ``warming`` is the number of those before the first full span, without answer.
        seconds: device time from the first frame to the newest.
        wall_s: duration on the host's clock.
        decisions_per_s: decisions per second of device time.
        restarts: number of gaps and clock resets, after which all computations restart.
        invalid: number of values outside their valid range.
        bad_stamps: number of frames whose time was earlier than, or equal to, that of the frame before, or impossible.
        interpolated: number of samples made up for frames that did not come, see `SampleClock`.
        rate_hz: frames per second by the device's clock, smoothed over the newest 16; None before the first.
        counters: those of the device (frames, lost, malformed, garbage, reconnects).
        latency_ms: p50, p95 and p99 of the time from the arrival of the bytes, before they are parsed, to the decision,
            over the last hour. A replay at speed 0 delivers hundreds of frames at once, so it includes waiting.
        late: number of decisions more than a step after their bytes.
        events: number of events that began.
        no_signal: number of times that no frame came, or the clock had a gap or was reset.
        faults: number of sensor faults.
        warnings: what differs from the training, or cannot be read; each once.
    """

    decisions: int
    warming: int
    seconds: float
    wall_s: float
    decisions_per_s: float
    restarts: int
    invalid: int
    bad_stamps: int
    interpolated: int
    rate_hz: float | None
    counters: dict[str, int]
    latency_ms: dict[str, float | None]
    late: int = 0
    events: int = 0
    no_signal: int = 0
    faults: int = 0
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        rounded = {name: round(getattr(self, name), 3) for name in ("seconds", "wall_s", "decisions_per_s")}
        return asdict(self) | rounded


class LiveRun(Iterator[Decision]):
    """A live run: iterate over it for decisions; call `summary` for its figures at any time.

    If the device sends no frame for ``silence_s``, there is one decision with the state ``no signal``, or
    ``unreadable`` if it sends lines that are none, which ends an open event; the same happens if an event is open when
    the device ends.

    Attributes:
        over: whether the run has ended.
        warnings: what differs from the training (see `PlausibilityMonitor`), or cannot be read; each once.
        latency_s: time from the arrival of the bytes to the decision, for the newest one; None before the first.
        latencies_s: the same for all decisions of the last hour.
    """

    def __init__(
        self,
        device: Device,
        classifier: StreamReader,
        seconds: float | None,
        silence_s: float = SILENCE_S,
        warn: Callable[[str], None] = python_warning,
    ) -> None:
        self.device = device
        self.classifier = classifier
        self.warnings: list[Message] = []
        self._warn = warn
        self._monitor = PlausibilityMonitor(classifier.layout, classifier.bundle)
        self._mismatch = Message()
        self._malformed = device.counters.malformed  # at the last frame
        self._seconds, self._silence_s = seconds, silence_s
        self._begun = self._last_frames_s = time.perf_counter()
        self._silent = False
        self._decisions = self._warming = self._late = self._events = self._no_signal = 0
        self.latencies_s: deque[float] = deque(maxlen=_KEPT)
        self.latency_s: float | None = None
        self._due: deque[Decision] = deque()
        self.over = False

    def __next__(self) -> Decision:
        while not self._due:
            if self.over:
                raise StopIteration
            self._due.extend(self.poll())
        return self._due.popleft()

    def poll(self) -> list[Decision]:
        """Read the device once; return the decisions. Sets `over` at the end of the run."""
        frames = None if self.device.closed else self.device.read()
        now = time.perf_counter()
        if frames is None:
            self.over = True
            unread = self._unread() != self._mismatch
            return [self._quiet()] if self.classifier.in_event or unread else []
        if not frames:
            return self._no_frames(now)
        arrived = self.device.arrived_s
        arrived = now if arrived is None else arrived
        decided = self._read(frames, arrived)
        for sentence in self._monitor.push(frames):
            self._note(sentence)
        if self.device.counters.malformed > self._malformed:
            self._note_unread(self.device.mismatch)
        self._malformed, self._mismatch = self.device.counters.malformed, Message()
        # Set after the computation, whose duration must not count as silence of the toy.
        self._last_frames_s, self._silent = time.perf_counter(), False
        return decided

    def _no_frames(self, now: float) -> list[Decision]:
        quiet = now - self._last_frames_s
        if self._seconds is not None and quiet >= self._seconds:
            self.over = True
        # Lines may come only after the silence began, as from a board that starts when its port is opened.
        if quiet < self._silence_s or (self._silent and self._unread() == self._mismatch):
            return []
        return [self._quiet()]

    def _unread(self) -> Message:
        """Return why the lines that came since the last frame cannot be read; "" if none came."""
        return self.device.mismatch if self.device.counters.malformed > self._malformed else Message()

    def _quiet(self) -> Decision:
        """Return the decision that ends an open event because no frame comes."""
        again, self._silent, self._mismatch = self._silent, True, self._unread()
        decision = self.classifier.silence()
        if not self._mismatch:
            return self._noted(decision)
        self._note_unread(self._mismatch)
        decision = replace(decision, state="unreadable")
        return decision if again else self._noted(decision)

    def _note(self, sentence: Message) -> None:
        self.warnings.append(sentence)
        self._warn(sentence)

    def _note_unread(self, mismatch: Message) -> None:
        # Once, although it may count the lines.
        if mismatch and mismatch.template not in {sentence.template for sentence in self.warnings}:
            self._note(mismatch)

    def _read(self, frames: list[Frame], arrived: float) -> list[Decision]:
        decided: list[Decision] = []
        for frame in frames:
            decisions = self.classifier.push(frame)
            if self._seconds is not None and self.classifier.time_s >= self._seconds:
                self.over = True
                break
            for decision in decisions:
                self.latency_s = time.perf_counter() - arrived
                self._late += self.latency_s > self.classifier.step_s
                self.latencies_s.append(self.latency_s)
                decided.append(self._noted(decision))
        return decided

    def _noted(self, decision: Decision) -> Decision:
        self._decisions += 1
        self._warming += decision.state == "warming"
        self._no_signal += decision.state in ("no signal", "unreadable")
        self._events += sum(event.kind == "begun" for event in decision.events)
        return decision

    def summary(self) -> LiveSummary:
        """Return the figures of the run so far."""
        seconds, clock = self.classifier.time_s, self.classifier.clock
        return LiveSummary(
            self._decisions,
            self._warming,
            seconds,
            time.perf_counter() - self._begun,
            self._decisions / seconds if seconds > 0 else 0.0,
            clock.restarts,
            clock.invalid,
            clock.bad_stamps,
            clock.interpolated,
            round(256_000 / clock.interval, 1) if clock.interval else None,
            self.device.counters.to_dict(),
            percentiles_ms(self.latencies_s),
            self._late,
            self._events,
            self._no_signal,
            self.classifier.faults,
            tuple(self.warnings),
        )


def percentiles_ms(latencies_s: Sequence[float]) -> dict[str, float | None]:
    """Return p50, p95 and p99 in milliseconds; all are None without latencies."""
    if not latencies_s:
        return {"p50": None, "p95": None, "p99": None}
    p50, p95, p99 = (round(float(v) * 1000.0, 3) for v in np.percentile(latencies_s, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99}


def run_live(
    device: Device,
    classifier: StreamReader,
    *,
    seconds: float | None = None,
    silence_s: float = SILENCE_S,
    warn: Callable[[str], None] = python_warning,
) -> LiveRun:
    """Run a model on an open device.

    Args:
        device: an open device; the caller closes it.
        classifier: the model; it is reset.
        seconds: device time after which the run stops (so a replay ends at the same place at any speed). The run also
            stops if the device sends nothing for this time. None: run until the device ends.
        silence_s: host time without frames after which there is no signal.
        warn: called with each sentence on what differs from the training or cannot be read.

    Raises:
        ConfigError: if the channels of the device are not those of the model, or ``seconds`` is not positive.
        DeviceError: while iterating, if the connection is lost.
    """
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"seconds is {seconds!r}; give a positive duration, or leave it out to run until the end.")
    check_layout(device.layout, classifier.layout)
    classifier.reset()
    return LiveRun(device, classifier, seconds, silence_s, warn)
