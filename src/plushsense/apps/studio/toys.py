"""The toys that can be reached, and whether the chosen one sends what it should."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from plushsense.apps.studio.house import Bell, House
from plushsense.core.errors import ConfigError, DeviceError, PlushSenseError
from plushsense.core.signal import layout_names
from plushsense.devices.listing import SCAN_S, Listing, list_devices
from plushsense.devices.opening import open_device, parse_url
from plushsense.recording.toy import is_virtual, speed_of, with_speed

PERSONS = 25
TEST_S = 1.0
_PATIENCE_S = 6.0
# Beside this share of lines that are no frames a toy is taken for one of another layout.
_FEW = 0.2
_SLOW, _FAST = 0.8, 1.25


@dataclass(frozen=True)
class Tested:
    """What came of a test: ``frames`` in ``seconds`` of the toy's time, lines that were no frame, and the layout's
    rate. ``fits``: enough of the lines were frames; ``on_time``: about as many came as the layout says."""

    url: str
    layout: str
    frames: int
    malformed: int
    garbage: int
    seconds: float
    rate_hz: float

    @property
    def fits(self) -> bool:
        return self.frames > 0 and self.malformed <= _FEW * (self.frames + self.malformed)

    @property
    def on_time(self) -> bool:
        return _SLOW <= self.frames / (self.seconds * self.rate_hz) <= _FAST


class Toys:
    """The list of toys, looked for in the background; ``bell`` rings when it changed."""

    def __init__(self, house: House) -> None:
        self.bell = Bell()
        self.listing = Listing()
        self.looking = False
        self.looked = False
        self._house = house
        self._lock = threading.Lock()

    def look(self, scan_s: float = SCAN_S) -> None:
        """Begin to look, unless that is going on; does not wait."""
        with self._lock:
            if self.looking:
                return
            self.looking = True
        self.bell.ring()
        threading.Thread(target=self._look, args=(scan_s,), daemon=True).start()

    def _look(self, scan_s: float) -> None:
        try:
            self.listing, self.looked = list_devices(scan_s), True
        finally:
            self.looking = False
            self.bell.ring()

    def choose(self, url: str) -> str:
        """Make this the toy of all pages; returns its URL.

        Raises:
            ConfigError: for a URL that no toy can have, and for files outside the studio's folders.
        """
        url = url.strip()
        if url not in self._house.devices:
            address = parse_url(url)
            if address.scheme == "replay":
                self._house.inside(address.place)
            layout = address.query.get("layout")
            if layout is not None and layout not in layout_names():
                self._house.inside(layout)
        self._house.toy = url
        self.bell.ring()
        return url

    def person(self, number: int) -> str:
        """Choose the virtual toy that this person touches."""
        if not 1 <= number <= PERSONS:
            raise ConfigError(f"There is no virtual person {number}: give 1 to {PERSONS}.")
        return self.choose(f"virtual://?person={number}")

    @property
    def simulated(self) -> bool:
        """Whether the toy that is chosen is the virtual one."""
        return bool(self._house.toy) and is_virtual(self._house.toy)

    def test(self, url: str = "") -> Tested:
        """Listen to a toy (the chosen one) for a second; blocks for some.

        Raises:
            DeviceError: when it cannot be reached, or sends nothing.
        """
        url = url or self._house.toy
        if not url:
            raise ConfigError("No toy is chosen: choose one first.")
        url = with_speed(url, self._house.speed)
        speed = speed_of(url) or 1.0
        frames, first, last = 0, None, None
        until = time.monotonic() + _PATIENCE_S
        with open_device(url) as device:
            while time.monotonic() < until:
                came = device.read()
                if came is None:
                    break
                if came:
                    if first is None:
                        first, until = time.monotonic(), time.monotonic() + TEST_S
                    frames += len(came)
                    last = time.monotonic()
            layout, counters = device.layout, device.counters
        if first is None or last is None:
            if counters.malformed:
                raise DeviceError(
                    f"'{url}' sends no frames of the layout '{layout.name}' but other lines ({counters.malformed}): "
                    "name its layout, as in ?layout=plush-14 at the end of the address."
                )
            raise DeviceError(f"'{url}' sent nothing within {_PATIENCE_S:g} s: check that the toy is switched on.")
        seconds = max(last - first, 1.0 / layout.rate_hz) * speed
        return Tested(url, layout.name, frames, counters.malformed, counters.garbage, seconds, layout.rate_hz)


def refusal(cause: BaseException) -> str:
    """What to say of a toy that could not be tested."""
    return str(cause) if isinstance(cause, PlushSenseError) else " ".join(str(cause).split()) or type(cause).__name__
