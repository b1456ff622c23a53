"""Search for toys, choose one, test its connection and buffer its samples."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DeviceError, PlushSenseError
from plushsense.core.layouts import Layout, layout_names
from plushsense.core.recorder_csv import Frames
from plushsense.core.sentences import Message
from plushsense.devices.base import ConnectionGap, Device, Frame
from plushsense.devices.opening import (
    DEFAULT_LAYOUT,
    SCAN_S,
    DeviceInfo,
    DeviceListing,
    is_virtual,
    list_devices,
    open_device,
    parse_url,
    speed_of,
    with_speed,
)
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.windows.clock import SampleClock

KEPT_S = 60.0


class Samples(NamedTuple):
    """Samples of a stream: ``seconds`` (N,) by the toy's clock since its first sample, ``values`` (N, C) of the C
    channels as integers, and ``end``, the position in the stream after the last of these samples.
    """

    seconds: NDArray[np.float64]
    values: NDArray[np.float64]
    end: int


class SampleBuffer:
    """Ring buffer of the newest ``size`` samples of a layout's channels; one thread writes, any thread reads.

    ``count`` is the number of samples received so far, which is the position after the newest sample.
    """

    def __init__(self, layout: Layout, size: int) -> None:
        self._seconds = np.zeros(size)
        self._values = np.zeros((size, layout.n_channels))
        self._clocks = np.zeros((size, 2), dtype=np.int64)
        self._lock = threading.Lock()
        self.count = 0
        self._clock = SampleClock(layout)
        self._first_ms: int | None = None
        self._seen_ms = 0
        self._offset_ms = 0

    def add(self, frames: list[Frame]) -> None:
        """Append frames; if the device clock is reset, the time continues from its last value.

        A frame that the clock rule leaves out has the time of the frame before.
        """
        with self._lock:
            size = len(self._seconds)
            for frame in frames:
                if self._first_ms is None:
                    self._first_ms = self._seen_ms = frame.device_ms
                if self._clock.accept(frame.device_ms):
                    self._offset_ms += max(0, self._seen_ms - frame.device_ms)
                    self._seen_ms = frame.device_ms
                at = self.count % size
                self._seconds[at] = (self._seen_ms - self._first_ms + self._offset_ms) / 1000.0
                self._values[at] = frame.values
                self._clocks[at] = frame.host_ms, frame.device_ms
                self.count += 1

    def since(self, place: int, most: int = 1 << 30) -> Samples:
        """Return the samples from position ``place`` on, but only the newest ``most`` of them."""
        with self._lock:
            at = self._places(place, most)
            return Samples(self._seconds[at], self._values[at], self.count)

    def frames(self, seconds: float) -> list[Frame]:
        """Return the frames of the last ``seconds`` with their original clocks and values."""
        with self._lock:
            at = self._places(0, len(self._seconds))
            at = at[self._seconds[at] >= self._seconds[at[-1:]] - seconds] if len(at) else at
            clocks, values = self._clocks[at].tolist(), self._values[at].astype(np.int64).tolist()
        return [Frame(host, device, tuple(v)) for (host, device), v in zip(clocks, values, strict=True)]

    def rows(self) -> tuple[float, Frames]:
        """Return all rows that are kept, and the time of the first of them by the toy's clock."""
        with self._lock:
            at = self._places(0, len(self._seconds))
            first_s = float(self._seconds[at[0]]) if len(at) else 0.0
            return first_s, Frames(self._values[at].astype(np.int64), self._clocks[at, 1])

    def _places(self, place: int, most: int) -> NDArray[np.int64]:
        size = len(self._seconds)
        first = max(place, self.count - min(size, most), 0)
        return np.arange(first, self.count) % size


class TappedDevice(Device):
    """A device that also stores its frames in a `SampleBuffer`, from which pages display them.

    The functions in ``taps`` are called with new frames in the reading thread; they must not block. ``release`` is
    called when the device is closed.
    """

    def __init__(self, device: Device, release: Callable[[], None] = lambda: None) -> None:
        super().__init__(device.url, device.layout)
        self.device = device
        self._release = release
        self.counters = device.counters
        self.wait_s = device.wait_s
        self.buffer = SampleBuffer(device.layout, int(KEPT_S * device.layout.rate_hz))
        self.changed = ChangeSignal()
        self.taps: list[Callable[[list[Frame]], None]] = []
        self._tried: list[Frame] = []

    def try_out(self) -> None:
        """Read until frames have arrived and most lines fit the layout; `read` returns these frames later.

        Raises:
            DeviceError: if the toy sends nothing within some seconds, or lines that do not fit the layout.
        """
        until = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < until:
            frames = self.device.read()
            if frames is None:
                break
            self._tried += frames
            good, bad = len(self._tried), self.counters.malformed
            if good + bad >= _ENOUGH and bad <= _MAX_MALFORMED * (good + bad):
                return
            if bad >= _MANY:
                break
        raise _unfit(self.url, self.device)

    @property
    def inner(self) -> Device:
        """The device that reads the toy, without the wrapper that reconnects; None while that is reconnecting."""
        return getattr(self.device, "inner", self.device)

    @property
    def state(self) -> str:
        """State of the connection, see `plushsense.devices.base.ReconnectingDevice`."""
        return str(getattr(self.device, "state", "connected"))

    @property
    def gaps(self) -> list[ConnectionGap]:
        """The periods without a connection."""
        return list(getattr(self.device, "gaps", ()))

    @property
    def mismatch(self) -> Message:
        """As in `Device`, of the wrapped device."""
        return self.device.mismatch

    def read(self) -> list[Frame] | None:
        """Read from the device, store new frames in the buffer and pass them to the taps."""
        self.device.wait_s = self.wait_s
        frames: list[Frame] | None = self._tried
        self._tried = []
        if not frames:
            frames = self.device.read()
        self.arrived_s = self.device.arrived_s
        if frames:
            self.buffer.add(frames)
            for tap in tuple(self.taps):
                tap(frames)
            self.changed.notify()
        return frames

    def _shut(self) -> None:
        self.device.close()
        self._release()


_USES: Texts = {
    "home": "{toy} is being tested on the page Home. Try it again in some seconds.",
    "record": "{toy} is in use: the session {name} on the page Record reads it.",
    "live": "{toy} is in use: the page Live reads it.",
}
# Toys of these kinds have one reader at a time; each opening of a virtual one or a file is another toy.
_SINGLE_READER = ("serial", "ble", "tcp")


@dataclass(frozen=True, eq=False)
class ToyUse:
    """A toy that is open.

    Attributes:
        toy: its URL.
        page: the page that reads it, a key of `plushsense.studio.app.shell.PAGES`.
        stop: closes the toy, and returns when it is closed; raises ConfigError if it must not be closed now.
        name: the session that is being recorded, or "".
        busy: whether somebody is using it; otherwise it is closed as soon as another page needs it.
    """

    toy: str
    page: str
    stop: Callable[[], None]
    name: str = ""
    busy: Callable[[], bool] = lambda: True


class ToyInUseError(DeviceError):
    """A toy that cannot be opened, because another page of the studio reads it in the way that ``use`` tells."""

    def __init__(self, use: ToyUse) -> None:
        super().__init__(_USES[use.page], toy=use.toy, name=use.name)
        self.use = use


def _same_toy(one: str, other: str) -> bool:
    """Return whether two URLs belong to a toy that only one reader can open."""
    first, second = parse_url(one), parse_url(other)
    return first.scheme in _SINGLE_READER and (first.scheme, first.place) == (second.scheme, second.place)


PERSONS = 25
TEST_S = 1.0
_TIMEOUT_S = 6.0
# So many lines are enough to try a toy, and so many unreadable ones to give up.
_ENOUGH, _MANY = 20, 100
# If the share of malformed lines is higher, the toy probably has another layout.
_MAX_MALFORMED = 0.2
# Without a single frame, as many malformed lines are enough to know that the layout is another.
_MALFORMED = 30
_SLOW, _FAST = 0.8, 1.25


@dataclass(frozen=True)
class ConnectionTest:
    """Result of a connection test: the layout, and the frames and malformed lines in ``seconds`` of device time."""

    layout: str
    frames: int
    malformed: int
    seconds: float
    rate_hz: float

    @property
    def fits(self) -> bool:
        """True if frames arrived and few lines were malformed, so that the layout is probably right."""
        return self.frames > 0 and self.malformed <= _MAX_MALFORMED * (self.frames + self.malformed)

    @property
    def on_time(self) -> bool:
        """True if the measured frame rate is close to the rate of the layout."""
        return _SLOW <= self.frames / (self.seconds * self.rate_hz) <= _FAST


def _unfit(url: str, device: Device) -> DeviceError:
    """Return the error for a toy that sends nothing, or lines that do not fit its layout."""
    layout, malformed = device.layout.name, device.counters.malformed
    if malformed:
        return DeviceError(
            "{url} sends {lines} lines that are not of the layout {layout}. {why}",
            url=url,
            layout=layout,
            lines=malformed,
            why=device.mismatch,
        )
    return DeviceError(
        "{url} sent nothing for {s} s. Check that the toy is switched on and near.", url=url, s=f"{_TIMEOUT_S:g}"
    )


@dataclass
class ToyTrial:
    """Test of a toy in the background: while ``running`` there is neither ``result`` nor ``error``.

    ``layout`` is another built-in layout that the toy's frames have, "" for none.
    """

    url: str
    running: bool = True
    result: ConnectionTest | None = None
    error: Exception | None = None
    layout: str = ""


def found_title(words: Words, toy: DeviceInfo) -> str:
    """Return the text for a toy that was found: its own name, if it has one."""
    return words.toy(toy.url) if toy.kind in ("serial", "virtual") else f"{toy.name} · {toy.url}"


def described(words: Words, toy: DeviceInfo) -> str:
    """Return the description of a toy that was found; that of a serial port is the text of the system."""
    about = toy.description
    return words.sentence(about) if isinstance(about, Message) else about


def with_layout(url: str, layout: str) -> str:
    """Return the URL of a toy with another layout."""
    place, _, settings = url.partition("?")
    kept = [s for s in settings.split("&") if s and not s.startswith("layout=")]
    return f"{place}?{'&'.join([*kept, f'layout={layout}'])}"


class Toys:
    """The toys found by a background search, and the choice of one; every change notifies `changed`.

    ``in_use`` are the open toys that somebody is using; a change of them notifies `in_use_changed`.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.changed, self.in_use_changed = ChangeSignal(), ChangeSignal()
        self.in_use: tuple[ToyUse, ...] = ()
        self._uses: tuple[ToyUse, ...] = ()
        self.listing = DeviceListing()
        self.trial: ToyTrial | None = None
        self.searching = False
        self.searched = False
        self._workspace = workspace
        self._choices = workspace.part(Choices)
        self._lock = threading.Lock()
        if not workspace.toy and (last := self._choices.last("toy")):
            with contextlib.suppress(PlushSenseError):
                self.choose(last)

    def search(self, scan_s: float = SCAN_S, *, network: bool = True) -> None:
        """Start a search in the background, unless one is running; see `list_devices`."""
        with self._lock:
            if self.searching:
                return
            self.searching = True
        self.changed.notify()
        threading.Thread(target=self._search, args=(scan_s, network), daemon=True).start()

    def _search(self, scan_s: float, network: bool) -> None:
        try:
            self.listing, self.searched = list_devices(scan_s, network=network), True
        finally:
            self.searching = False
            self.changed.notify()

    def choose(self, url: str) -> str:
        """Choose a toy for all pages and return its URL.

        Raises:
            ConfigError: for an invalid URL, or a file outside the folders of the studio.
        """
        url = url.strip()
        if url not in self._workspace.devices:
            address = parse_url(url)
            if address.scheme == "replay":
                self._workspace.inside(address.place)
            layout = address.query.get("layout")
            if layout is not None and layout not in layout_names():
                self._workspace.inside(layout)
        if url != self._workspace.toy:
            self._workspace.toy, self.trial = url, None
        self._choices.keep(toy=url)
        self.changed.notify()
        return url

    def open(self, use: ToyUse, opening: Callable[[], Device]) -> TappedDevice:
        """Open a toy by ``opening``; the use lasts until the device is closed. Call `update_uses` when it has begun.

        Raises:
            ToyInUseError: if another page uses this toy. Otherwise as ``opening``.
        """
        self._take(use)
        try:
            return TappedDevice(opening(), lambda: self._release(use))
        except BaseException:
            self._release(use)
            raise

    def _take(self, use: ToyUse) -> None:
        """Add a use; first close the same toy where nobody is using it."""
        for _ in range(2):
            with self._lock:
                other = next((o for o in self._uses if _same_toy(o.toy, use.toy)), None)
                if other is None:
                    self._uses = (*self._uses, use)
                    break
            if other.busy():
                break
            other.stop()
        if other is not None:
            raise ToyInUseError(other)

    def _release(self, use: ToyUse) -> None:
        with self._lock:
            self._uses = tuple(u for u in self._uses if u is not use)
        self.update_uses()

    def update_uses(self) -> None:
        """Find out which toys somebody is using; call this when that has changed."""
        in_use = tuple(use for use in self._uses if use.busy())
        if in_use != self.in_use:
            self.in_use = in_use
            self.in_use_changed.notify()

    def try_out(self) -> None:
        """Test the chosen toy in the background; `trial` has the state and the result."""
        trial = self.trial = ToyTrial(self._workspace.toy)
        self.changed.notify()
        threading.Thread(target=self._try_out, args=(trial,), daemon=True).start()

    def _try_out(self, trial: ToyTrial) -> None:
        try:
            trial.result = self.test(trial.url)
        except Exception as cause:  # noqa: BLE001, RUF100
            trial.error = cause
        unreadable = isinstance(trial.error, PlushSenseError) and "lines" in trial.error.message.values
        if unreadable or (trial.result is not None and not trial.result.fits):
            trial.layout = self._fitting_layout(trial.url)
        trial.running = False
        if trial is self.trial:
            self.changed.notify()

    def _fitting_layout(self, url: str) -> str:
        """Return the layout whose frames a toy sends, or "" if it is none of the built-in ones."""
        given = parse_url(url).query.get("layout") or DEFAULT_LAYOUT
        for name in layout_names():
            with contextlib.suppress(PlushSenseError):
                if name != given and self.test(with_layout(url, name)).fits:
                    return name
        return ""

    @property
    def simulated(self) -> bool:
        """True if the chosen toy is a virtual one."""
        return bool(self._workspace.toy) and is_virtual(self._workspace.toy)

    def test(self, url: str = "") -> ConnectionTest:
        """Read from a toy (by default the chosen one) for `TEST_S`; block for up to several seconds.

        Raises:
            ConfigError: if no URL is given and no toy is chosen.
            DeviceError: if the toy cannot be reached, sends no frames, or is used by another page.
        """
        url = url or self._workspace.toy
        if not url:
            raise ConfigError("No toy is chosen. Choose one first.", field="toy")
        ends, ended = threading.Event(), threading.Event()

        def stop() -> None:
            ends.set()
            ended.wait(_TIMEOUT_S)

        try:
            return self._measure(ToyUse(url, "home", stop, busy=lambda: False), ends)
        finally:
            ended.set()

    def _measure(self, use: ToyUse, ends: threading.Event) -> ConnectionTest:
        """Test a toy until ``ends`` is set; see `test`."""
        url = with_speed(use.toy, self._workspace.speed)
        speed = speed_of(url) or 1.0
        frames, first, last = 0, None, None
        until = time.monotonic() + _TIMEOUT_S
        with self.open(use, lambda: open_device(url)) as device:
            while time.monotonic() < until and (frames or device.counters.malformed < _MALFORMED):
                if ends.is_set():
                    raise DeviceError("The test was stopped, because another page uses {url} now.", url=use.toy)
                received = device.read()
                if received is None:
                    break
                if received:
                    if first is None:
                        first, until = time.monotonic(), time.monotonic() + TEST_S
                    frames += len(received)
                    last = time.monotonic()
            layout, counters, unfit = device.layout, device.counters, _unfit(url, device)
        if first is None or last is None:
            raise unfit
        seconds = max(last - first, 1.0 / layout.rate_hz) * speed
        return ConnectionTest(layout.name, frames, counters.malformed, seconds, layout.rate_hz)
