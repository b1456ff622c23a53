"""The interface of an open toy: frames to iterate over, counters of faults, and closing."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import NamedTuple, Self

from plushsense.core.layouts import Layout


class Frame(NamedTuple):
    """A sample of all channels.

    ``host_ms`` when it arrived (epoch), ``device_ms`` on the toy's own clock (the truth for rate and loss),
    ``values`` (C,) in integer steps, in the order of ``layout.channels``.
    """

    host_ms: int
    device_ms: int
    values: tuple[int, ...]


@dataclass
class Counters:
    """Numbers of received frames and of transmission faults.

    Attributes:
        frames: whole frames.
        lost: frames that the device clock says are missing.
        malformed: lines that are no frame (wrong number of fields, not a number, too long, cut).
        garbage: frames with a value outside its channel's valid range; kept, and counted in ``frames`` too.
        reconnects: how often the connection was made again.
    """

    frames: int = 0
    lost: int = 0
    malformed: int = 0
    garbage: int = 0
    reconnects: int = 0

    def to_dict(self) -> dict[str, int]:
        """Return plain values, ready for JSON."""
        return asdict(self)


class LossCounter:
    """Count lost frames by the device clock: a step well above the running median period is a gap.

    A clock that goes back, or advances by more than ``pause_ms``, was restarted or paused: nothing is counted.
    """

    def __init__(self, span: int = 101, pause_ms: int = 10_000) -> None:
        self._steps: deque[int] = deque(maxlen=span)
        self._last: int | None = None
        self._pause_ms = pause_ms
        self._median = 0.0
        self._stale = 0

    def push(self, device_ms: int) -> int:
        """Return how many frames are missing between the previous frame and this one."""
        last, self._last = self._last, device_ms
        if last is None:
            return 0
        step = device_ms - last
        if not 0 <= step <= self._pause_ms:
            return 0
        self._steps.append(step)
        # A median of 101 steps changes slowly, so it is computed only now and then.
        self._stale += 1
        if self._median <= 0.0 or self._stale >= 10 or len(self._steps) < 20:
            self._median = float(sorted(self._steps)[len(self._steps) // 2])
            self._stale = 0
        if self._median <= 0.0 or step < 1.5 * self._median:
            return 0
        return max(1, round(step / self._median) - 1)


class Device(ABC):
    """An open toy. Use it as a context manager and iterate over it; or call `read` again and again.

    Iterating ends when the source has ended (a file, a connection that the other side closed in order) or
    when `close` is called, also from another thread; a toy that went away raises DeviceError.

    Attributes:
        url: the URL that opened it.
        layout: layout of the frames.
        counters: numbers of frames and faults so far.
        wait_s: longest wait of `read`; 0 polls, for reading many toys in turn.
        arrived_s: time at which the bytes of the last frames arrived, before they were parsed, by `time.perf_counter`;
            for a replay or a virtual toy, the time at which the first of them was due. None where it is unknown.
    """

    def __init__(self, url: str, layout: Layout) -> None:
        self.url = url
        self.layout = layout
        self.counters = Counters()
        self.closed = False
        self.wait_s = 0.1
        self.arrived_s: float | None = None

    @abstractmethod
    def read(self) -> list[Frame] | None:
        """Return the frames since the last call, waiting at most about ``wait_s``; return None at the end.

        Raises:
            DeviceError: when the toy went away.
        """

    def _shut(self) -> None:  # noqa: B027, RUF100
        """Release the resources; called once."""

    def close(self) -> None:
        """Close the device. Closing twice is harmless."""
        if not self.closed:
            self.closed = True
            self._shut()

    def __iter__(self) -> Iterator[Frame]:
        while not self.closed:
            frames = self.read()
            if frames is None:
                return
            yield from frames

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.url} ({self.layout.name}), {self.counters.frames} frames>"


def now_ms() -> int:
    """Return the host time, milliseconds since 1970."""
    return time.time_ns() // 1_000_000


class Pacer:
    """Pace a source by its own clock, ``speed`` times as fast; speed 0 never waits.

    Times are computed from the start, so that errors do not add up. A gap in the clock of more than
    ``longest_s``, or a clock that goes back, is not waited for.
    """

    def __init__(self, speed: float, longest_s: float = 2.0) -> None:
        self._speed = speed
        self._longest_ms = longest_s * 1000.0
        self._start = 0.0
        self._passed_ms = 0.0
        self._last: int | None = None

    def due_s(self, device_ms: int) -> float:
        """Return the seconds until this moment of the device clock is due; 0 or less when it is due now."""
        if self._speed <= 0.0:
            return 0.0
        if self._last is None:
            self._start = time.monotonic()
        else:
            step = device_ms - self._last
            self._passed_ms += step if 0 <= step <= self._longest_ms else 0.0
        self._last = device_ms
        return self._start + self._passed_ms / 1000.0 / self._speed - time.monotonic()


class PacedDevice(Device):
    """A source of existing frames (a file, a simulation), delivered at ``speed`` times the pace of their clock.

    Args:
        speed: 1 real time, 0 as fast as frames are taken.
    """

    def __init__(self, url: str, layout: Layout, speed: float) -> None:
        super().__init__(url, layout)
        self._pacer = Pacer(speed)
        self._due_s: float | None = None

    @abstractmethod
    def _next_ms(self) -> int | None:
        """Return the device time of the next item; None at the end."""

    def _due(self, most: int) -> Iterator[int]:
        """Yield the device times of the items that are due, at most ``most``; wait for the first about ``wait_s``.

        The caller takes the item before it asks for the next one.
        """
        until = time.monotonic() + self.wait_s
        for n in range(most):
            device_ms = None if self.closed else self._next_ms()
            if device_ms is None:
                return
            if self._due_s is None:
                self._due_s = time.monotonic() + self._pacer.due_s(device_ms)
            while (wait := self._due_s - time.monotonic()) > 0.0:
                if n:
                    return
                time.sleep(min(wait, max(0.0, until - time.monotonic())))
                if time.monotonic() >= until or self.closed:
                    return
            self._due_s = None
            if not n:
                self.arrived_s = time.perf_counter() + wait
            yield device_ms
