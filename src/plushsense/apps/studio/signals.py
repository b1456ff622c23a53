"""What a toy sends, kept for the screens: the last seconds in a ring that many pages read at their own pace."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.studio.house import Bell
from plushsense.devices.base import Device, Frame
from plushsense.devices.reconnect import Gap

KEPT_S = 60.0


class Piece(NamedTuple):
    """Samples after a place in the stream: ``seconds`` (N,) on the toy's clock, ``values`` (N, C) in integer steps;
    ``upto``: where the next piece begins."""

    seconds: NDArray[np.float64]
    values: NDArray[np.float64]
    upto: int


class Ring:
    """The newest ``size`` samples of ``channels`` values; one thread writes, any thread reads."""

    def __init__(self, channels: int, size: int) -> None:
        self._seconds = np.zeros(size)
        self._values = np.zeros((size, channels))
        self._clocks = np.zeros((size, 2), dtype=np.int64)
        self._lock = threading.Lock()
        self._count = 0
        self._first_ms: int | None = None
        self._seen_ms = 0
        self._offset_ms = 0

    @property
    def count(self) -> int:
        """Samples that ever came: the place after the newest."""
        return self._count

    def add(self, frames: list[Frame]) -> None:
        """Take frames in. A clock that was reset goes on from where it stood."""
        with self._lock:
            size = len(self._seconds)
            for frame in frames:
                if self._first_ms is None:
                    self._first_ms = self._seen_ms = frame.device_ms
                if frame.device_ms < self._seen_ms:
                    self._offset_ms += self._seen_ms - frame.device_ms
                self._seen_ms = frame.device_ms
                at = self._count % size
                self._seconds[at] = (frame.device_ms - self._first_ms + self._offset_ms) / 1000.0
                self._values[at] = frame.values
                self._clocks[at] = frame.host_ms, frame.device_ms
                self._count += 1

    def since(self, place: int, most: int = 1 << 30) -> Piece:
        """What came after ``place``, at most the newest ``most`` samples."""
        with self._lock:
            at = self._places(place, most)
            return Piece(self._seconds[at], self._values[at], self._count)

    def frames(self, seconds: float) -> list[Frame]:
        """The frames of the last so many seconds, as they came."""
        with self._lock:
            at = self._places(0, len(self._seconds))
            at = at[self._seconds[at] >= self._seconds[at[-1:]] - seconds] if len(at) else at
            clocks, values = self._clocks[at].tolist(), self._values[at].astype(np.int64).tolist()
        return [Frame(host, device, tuple(v)) for (host, device), v in zip(clocks, values, strict=True)]

    def _places(self, place: int, most: int) -> NDArray[np.int64]:
        size = len(self._seconds)
        first = max(place, self._count - min(size, most), 0)
        return np.arange(first, self._count) % size


class TappedDevice(Device):
    """A toy whose frames also go into a `Ring`, for screens beside whoever reads it.

    ``taps``: called with the frames of every reading that brought some, in the thread that reads; they must not wait.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(device.url, device.layout)
        self.device = device
        self.counters = device.counters
        self.wait_s = device.wait_s
        self.ring = Ring(len(device.layout.channels), int(KEPT_S * device.layout.rate_hz))
        self.bell = Bell()
        self.taps: list[Callable[[list[Frame]], None]] = []

    @property
    def inner(self) -> Device:
        """The device beneath all that is wrapped around it."""
        return getattr(self.device, "inner", self.device)

    @property
    def state(self) -> str:
        """Whether the toy is there: as of a `plushsense.devices.reconnect.ReconnectingDevice`."""
        return str(getattr(self.device, "state", "connected"))

    @property
    def gaps(self) -> list[Gap]:
        """Times without the toy."""
        return list(getattr(self.device, "gaps", ()))

    def read(self) -> list[Frame] | None:
        """As the device's; see there."""
        self.device.wait_s = self.wait_s
        frames = self.device.read()
        self.arrived_s = self.device.arrived_s
        if frames:
            self.ring.add(frames)
            for tap in tuple(self.taps):
                tap(frames)
            self.bell.ring()
        return frames

    def _shut(self) -> None:
        self.device.close()
