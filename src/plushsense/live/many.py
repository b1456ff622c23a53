"""Many toys in one process and one thread: each is asked in turn, and nobody waits for another."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.devices.base import Device
from plushsense.live.integer import BothEngines
from plushsense.live.loop import Run, percentiles_ms, run
from plushsense.live.stream import Decision, StreamReader

_PAUSE_S = 0.001  # when no toy had anything to say; a frame at 100 Hz comes every 10 ms


@dataclass(frozen=True)
class ManySummary:
    """What many toys did together.

    Attributes:
        toys: how many; ``decisions`` of all of them, ``late`` of these came more than a step after their bytes.
        wall_s: host time; ``cpu_s`` what this process computed in it, ``busy`` the share.
        latency_ms: p50, p95, p99 and max from the arrival of the bytes to the decision, over all toys.
    """

    toys: int
    decisions: int
    late: int
    wall_s: float
    cpu_s: float
    latency_ms: dict[str, float | None]

    @property
    def busy(self) -> float:
        """Share of one core."""
        return self.cpu_s / self.wall_s if self.wall_s > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "toys": self.toys,
            "decisions": self.decisions,
            "late": self.late,
            "wall_s": round(self.wall_s, 3),
            "cpu_s": round(self.cpu_s, 3),
            "busy": round(self.busy, 4),
            "latency_ms": dict(self.latency_ms),
        }


class ManyRun(Iterator[tuple[int, Decision]]):
    """Iterate for (number of the toy, decision); a toy that has ended is left out. `runs` holds each toy's own run."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self.runs = tuple(runs)
        self._begun, self._cpu = time.perf_counter(), time.process_time()
        self._flow = self._turns()

    def __iter__(self) -> ManyRun:
        return self

    def __next__(self) -> tuple[int, Decision]:
        return next(self._flow)

    def _turns(self) -> Iterator[tuple[int, Decision]]:
        going = list(enumerate(self.runs))
        while going:
            heard = False
            for number, one in going:
                before = one.device.counters.frames
                for decision in one.poll():
                    yield number, decision
                heard = heard or one.device.counters.frames != before
            going = [(number, one) for number, one in going if not one.over]
            if not heard:
                time.sleep(_PAUSE_S)

    def summary(self) -> ManySummary:
        """How it went so far."""
        each = [one.summary() for one in self.runs]
        latencies = [latency for one in self.runs for latency in one.latencies_s]
        return ManySummary(
            len(each),
            sum(one.decisions for one in each),
            sum(one.late for one in each),
            time.perf_counter() - self._begun,
            time.process_time() - self._cpu,
            percentiles_ms(latencies) | {"max": round(1000.0 * max(latencies), 3) if latencies else None},
        )


def run_many(toys: Sequence[tuple[Device, StreamReader | BothEngines]], *, seconds: float | None = None) -> ManyRun:
    """Run a model on each of many open devices, in one thread.

    Args:
        toys: devices, which are then read without waiting, each with a classifier of its own.
        seconds: as of `plushsense.live.loop.run`, for each.

    Raises:
        ConfigError: for a classifier that two toys share, and as `run` does.
        DeviceError: while iterating, when a toy went away; open devices with ``reconnect`` to wait for it.
    """
    if len({id(classifier) for _, classifier in toys}) < len(toys):
        raise ConfigError("Two toys share a classifier, which follows one stream: make one for each.")
    for device, _ in toys:
        device.wait_s = 0.0
    return ManyRun([run(device, classifier, seconds=seconds) for device, classifier in toys])
