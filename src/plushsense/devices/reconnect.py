"""Reconnect to a toy after it was unplugged, switched off or out of reach, and record the gap."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal

from plushsense.core.errors import DeviceError
from plushsense.core.layouts import Layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Counters, Device, Frame, now_ms

ConnectionState = Literal["connected", "waiting"]

RETRY_S = 0.5


@dataclass
class ConnectionGap:
    """A time without connection, from the last frame before it to the first one after.

    Attributes:
        host_ms_begin: host time of the last frame before; if there was none, of the loss of the connection.
        host_ms_end: host time of the first frame after; None while the gap lasts.
        device_ms_before: the toy's clock at the last frame before; None if there was none.
        device_ms_after: the toy's clock at the first frame after; None while the gap lasts. It has restarted if the toy
            was switched off, but not if only the cable was unplugged.
        reason: what went wrong, in one sentence.
    """

    host_ms_begin: int
    host_ms_end: int | None = None
    device_ms_before: int | None = None
    device_ms_after: int | None = None
    reason: str = ""

    def to_dict(self) -> dict[str, int | str | None]:
        """Return plain values, ready for JSON."""
        return asdict(self)


class ReconnectingDevice(Device):
    """A device that reopens its toy when the connection is lost, trying every 0.5 s.

    Counters continue over all connections; ``lost`` does not include frames lost in ``gaps``. While the toy is not
    connected, `read` waits about ``wait_s`` and returns no frames.

    Args:
        url: URL for messages.
        layout: layout of the frames.
        open_inner: function that opens the toy. Its first failure is raised; later it is tried again.
        for_s: longest time to wait for the toy, after which DeviceError is raised; None: no limit.
        ends: whether the device ends with its inner device (a file); else that counts as a lost connection (a server).

    Attributes:
        state: "connected" or "waiting".
        gaps: all gaps so far; ``host_ms_end`` of the last one is None until a frame has arrived.
        inner: the current inner device; None while waiting.
    """

    def __init__(
        self,
        url: str,
        layout: Layout,
        open_inner: Callable[[], Device],
        *,
        for_s: float | None = None,
        ends: bool = False,
    ) -> None:
        super().__init__(url, layout)
        self.state: ConnectionState = "connected"
        self.gaps: list[ConnectionGap] = []
        self._open_inner = open_inner
        self._for_s = for_s
        self._ends = ends
        self._before = Counters()
        self._last: Frame | None = None
        self._lock = threading.Lock()
        self._awake = threading.Event()
        self._waiting_since = 0.0
        self._found: Device | Exception | None = None
        self.inner: Device | None = open_inner()
        self.notes = self.inner.notes
        self._count()

    def read(self) -> list[Frame] | None:
        """Return the received frames, waiting at most about ``wait_s``; none while the toy is not connected.

        Raises:
            DeviceError: if the toy could not be reopened within ``for_s``.
        """
        if self.closed:
            return None
        inner = self.inner
        if inner is None:
            return self._wait()
        try:
            inner.wait_s = self.wait_s
            frames = inner.read()
            self.arrived_s = inner.arrived_s
        except DeviceError as cause:
            if self.closed:
                return None
            return self._lost(inner, str(cause))
        self._count()
        if frames is None:
            if self.closed or self._ends:
                return None
            return self._lost(inner, f"'{self.url}' closed the connection.")
        if frames:
            gap = self.gaps[-1] if self.gaps else None
            if gap is not None and gap.host_ms_end is None:
                gap.host_ms_end, gap.device_ms_after = frames[0].host_ms, frames[0].device_ms
            self._last = frames[-1]
        return frames

    @property
    def mismatch(self) -> Message:
        """As in `Device`, of the connected toy."""
        inner = self.inner
        return inner.mismatch if inner is not None else Message()

    def _count(self) -> None:
        inner = self.inner
        if inner is None:
            return
        for name in ("frames", "lost", "malformed", "garbage"):
            setattr(self.counters, name, getattr(self._before, name) + getattr(inner.counters, name))

    def _lost(self, inner: Device, reason: str) -> list[Frame]:
        self._count()
        self._before = Counters(**self.counters.to_dict())
        # Disconnected again before a frame arrived: the gap continues, and the next try is delayed.
        again = bool(self.gaps) and self.gaps[-1].host_ms_end is None
        if not again:
            last = self._last
            begin, before = (last.host_ms, last.device_ms) if last is not None else (now_ms(), None)
            self.gaps.append(ConnectionGap(begin, device_ms_before=before, reason=reason))
            self._waiting_since = time.monotonic()
        with self._lock:
            self.inner = None
            self.state = "waiting"
        # Closing and opening may take seconds (a scan, a host that does not answer), so another thread does it.
        self._awake.clear()
        threading.Thread(target=self._seek, args=(inner, again), name="plushsense-reconnect", daemon=True).start()
        return []

    def _seek(self, gone: Device, pause: bool) -> None:
        """Try to open the toy until it succeeds, the device is closed or a permanent error occurs."""
        gone.close()
        while not self.closed:
            if pause:
                self._awake.wait(RETRY_S)
                pause = False
                continue
            result: Device | Exception
            try:
                result = gone.reopen() or self._open_inner()
            except DeviceError:
                pause = True
                continue
            except Exception as cause:  # noqa: BLE001, RUF100
                result = cause
            with self._lock:
                if not self.closed:
                    self._found = result
                    self._awake.set()
                    return
            if isinstance(result, Device):
                result.close()

    def _wait(self) -> list[Frame] | None:
        if not self._awake.wait(self.wait_s):
            waited = time.monotonic() - self._waiting_since
            if self._for_s is not None and waited >= self._for_s:
                self.close()
                raise DeviceError(
                    f"'{self.url}' went away and did not come back within {self._for_s:g} s: "
                    "plug it in or switch it on, and begin again."
                )
            return []
        with self._lock:
            if self.closed:
                return None
            result, self._found = self._found, None
            if isinstance(result, Device):
                self.inner = result
                self.state = "connected"
                self.counters.reconnects += 1
        if isinstance(result, Exception):
            self.close()
            raise result
        return []

    def _shut(self) -> None:
        self._awake.set()
        with self._lock:
            result, self._found = self._found, None
            inner = self.inner
        for device in (inner, result):
            if isinstance(device, Device):
                device.close()
