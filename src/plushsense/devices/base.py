"""Devices: an open toy with frames to read, counters of faults, and reconnection to a toy that was unplugged."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Literal, NamedTuple, Self

from plushsense.core.errors import DeviceError, python_warning
from plushsense.core.layouts import Layout
from plushsense.core.sentences import Message


class Frame(NamedTuple):
    """A sample of all channels.

    ``host_ms`` is the time of arrival (milliseconds since 1970); ``device_ms`` is the time on the toy's clock, used for
    rate and loss; ``values`` (C,) are in integer steps, in the order of ``layout.channels``.
    """

    host_ms: int
    device_ms: int
    values: tuple[int, ...]


@dataclass
class Counters:
    """Numbers of received frames and of transmission faults.

    Attributes:
        frames: complete frames.
        lost: frames that are missing according to the device clock.
        malformed: lines that are not a frame (wrong number of fields, not a number, too long, incomplete).
        garbage: frames with a value outside its channel's valid range; they are kept and also counted in ``frames``.
        reconnects: how often the connection was restored.
    """

    frames: int = 0
    lost: int = 0
    malformed: int = 0
    garbage: int = 0
    reconnects: int = 0

    def to_dict(self) -> dict[str, int]:
        """Return plain values, ready for JSON."""
        return asdict(self)


_AROUND = 8  # frames before and after a long step that are compared
_FEW = 20
# Difference in frames up to which a count stays; above a half, as clocks drift.
_SAME = 0.65
# Mean distance of the usual steps from their mean, relative to it, up to which a clock counts as even.
_EVEN, _EVEN_FEW = 0.16, 0.08


@dataclass
class _LongStep:
    """A step that may hide lost frames: its position and length, the clock in the frames before, what was counted."""

    at: int
    step: int
    before: list[int]
    counted: int = 0


class LossCounter:
    """Count lost frames by the device clock.

    A step of at least 1.5 periods means lost frames only if the frames after it stay as late as it was: time stamps
    that vary, a late frame that the next ones make up for, and frames stamped several at once are no loss. The period
    is measured, because the rate of a toy is not exactly that of its layout. Where steps vary by about a third, it is
    their mean, so that frames lost evenly look like a lower rate.

    If the clock goes back or advances by more than ``pause_ms``, it was reset or paused, and no frames are counted.
    """

    def __init__(self, span: int = 101, pause_ms: int = 10_000) -> None:
        self._steps: deque[int] = deque(maxlen=span)
        self._recent: deque[int] = deque(maxlen=_AROUND + 1)
        self._long: list[_LongStep] = []
        self._pause_ms = pause_ms
        self._frames = self._stale = 0
        self._period = 0.0

    def push(self, device_ms: int) -> int:
        """Return by how much this frame changes the number of lost ones; negative if some of them were only late."""
        recent = self._recent
        step = device_ms - recent[-1] if recent else -1
        if not 0 <= step <= self._pause_ms:
            recent.clear()
            self._long = []
        recent.append(device_ms)
        self._frames += 1
        if len(recent) < 2:
            return 0
        self._steps.append(step)
        # The mean of many steps changes slowly, so it is computed only every 20 frames.
        self._stale += 1
        if self._stale >= _FEW or len(self._steps) < _FEW:
            self._period, self._stale = self._measure_period(), 0
        if 0.0 < 1.5 * self._period <= step:
            self._long.append(_LongStep(self._frames, step, list(recent)[:-1]))
        elif not self._long:
            return 0
        change = 0
        for one in self._long:
            counted = self._lost_in(one)
            change += counted - one.counted
            one.counted = counted
        wait = [_AROUND + round(one.step / max(self._period, 1.0)) for one in self._long]
        self._long = [one for one, n in zip(self._long, wait, strict=True) if self._frames - one.at < n]
        return change

    def _measure_period(self) -> float:
        """Return the time between two frames; 0 if it is not known, or if frames are stamped several at once."""
        steps, n = sorted(self._steps), len(self._steps)
        median, mean = steps[n // 2], sum(steps) / n
        if steps[(n - 1) // 4] < mean / 4:
            return 0.0
        usual = steps[bisect_left(steps, 0.5 * median) : bisect_right(steps, 1.5 * median)]
        period = sum(usual) / len(usual)
        few = n < _FEW
        spread = sum(abs(step - period) for step in usual) / len(usual)
        if 2 * len(usual) >= n and spread <= (_EVEN_FEW if few else _EVEN) * period:
            return 0.0 if few and steps[0] < 0.5 * median else period
        return 0.0 if few else mean

    def _lost_in(self, one: _LongStep) -> int:
        """Return how many frames are lost in a long step, by how much later the frames after it are than those before.

        Both the earliest and the latest of them must be later, measured from an even clock through the last one before.
        """
        period, last = self._period, one.before[-1]
        if period <= 0.0:
            return 0
        since = self._frames - one.at + 1
        after = list(self._recent)[-min(since, _AROUND) :]
        late = [ms - last - (since - n) * period for n, ms in enumerate(reversed(after))]
        usual = [ms - last + n * period for n, ms in enumerate(reversed(one.before))]
        shift = min(max(late) - max(usual), min(late) - min(usual)) / period
        if since > 1 and abs(shift - one.counted) < _SAME:
            return one.counted
        return min(max(0, round(shift)), max(1, round(one.step / period) - 1))


class Device(ABC):
    """An open toy. Use it as a context manager and iterate over its frames, or call `read` repeatedly.

    Iteration ends when the source ends (a file, or a connection that the other side closed properly) or when `close` is
    called, even from another thread. A lost connection raises DeviceError. Lines that cannot be read give a
    PlushSenseWarning.

    Attributes:
        url: the URL with which it was opened.
        layout: layout of the frames.
        counters: numbers of frames and faults so far.
        wait_s: longest wait of `read`; 0 does not wait, for reading many toys in turn.
        arrived_s: time at which the bytes of the last frames arrived, before they were parsed, by `time.perf_counter`;
            for a replay or a virtual toy, the time at which the first of them was due. None if unknown.
        notes: sentences for the user on what was assumed about the frames.
    """

    def __init__(self, url: str, layout: Layout) -> None:
        self.url = url
        self.layout = layout
        self.counters = Counters()
        self.closed = False
        self.wait_s = 0.1
        self.arrived_s: float | None = None
        self.notes: tuple[str, ...] = ()

    @abstractmethod
    def read(self) -> list[Frame] | None:
        """Return the frames since the last call, waiting at most about ``wait_s``; return None at the end.

        Raises:
            DeviceError: if the connection is lost.
        """

    @property
    def mismatch(self) -> Message:
        """Why lines of the toy cannot be read, with the first of them, and what to do; "" if they can, or none came."""
        return Message()

    def reopen(self) -> Device | None:
        """Return a device that continues, or ends, after a lost connection; None: it must be opened anew by its URL.

        Raises:
            DeviceError: if the toy is not connected yet.
        """
        return None

    def _shut(self) -> None:  # noqa: B027, RUF100
        """Release resources; called only once."""

    def close(self) -> None:
        """Close the device. Closing it again has no effect."""
        if not self.closed:
            self.closed = True
            self._shut()

    def batches(self, warn: Callable[[str], None] = python_warning) -> Iterator[list[Frame]]:
        """Yield what `read` returns, until the device ends; call ``warn`` once with why lines cannot be read."""
        reported = {""}
        while not self.closed:
            frames = self.read()
            mismatch = self.mismatch if not frames else Message()
            if mismatch.template not in reported:
                reported.add(mismatch.template)
                warn(mismatch)
            if frames is None:
                return
            yield frames

    def __iter__(self) -> Iterator[Frame]:
        for frames in self.batches():
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
    """Return the host time in milliseconds since 1970."""
    return time.time_ns() // 1_000_000


class Pacer:
    """Compute when the frames of a source are due, at ``speed`` times the pace of their clock; 0 means at once.

    Times are computed from the start, so that errors do not add up. There is no wait for a gap in the clock of more
    than ``longest_s``, or for a clock that goes back.
    """

    def __init__(self, speed: float, longest_s: float = 2.0) -> None:
        self._speed = speed
        self._longest_ms = longest_s * 1000.0
        self._start = 0.0
        self._passed_ms = 0.0
        self._last: int | None = None

    def due_s(self, device_ms: int) -> float:
        """Return the seconds until a frame with this device time is due; 0 or less if it is due now."""
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
    """A device whose frames come from a file or a simulation, delivered at ``speed`` times the pace of their clock.

    Args:
        speed: 1 for real time, 0 for as fast as they are read.
    """

    def __init__(self, url: str, layout: Layout, speed: float) -> None:
        super().__init__(url, layout)
        self._pacer = Pacer(speed)
        self._due_s: float | None = None

    @abstractmethod
    def _next_ms(self) -> int | None:
        """Return the device time of the next frame; None at the end."""

    def _due(self, most: int) -> Iterator[int]:
        """Yield the device times of at most ``most`` frames that are due; wait up to about ``wait_s`` for the first.

        The caller must advance to the next frame before it continues the iteration.
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
