"""The toy that a session is recorded from, opened so that it may be unplugged and come back."""

from __future__ import annotations

from plushsense.core.signal import Layout
from plushsense.devices.base import Device
from plushsense.devices.opening import open_device, parse_url
from plushsense.devices.virtual.device import VirtualDevice
from plushsense.recording.engine import Recorder
from plushsense.recording.status import Status

_SIMULATED = "virtual"


def open_toy(url: str, layout: Layout | str | None = None) -> Device:
    """Open a toy by its URL; once it worked, a toy that goes away is waited for and the gap is kept.

    Raises:
        ConfigError, LayoutError, DeviceError: as `plushsense.devices.opening.open_device`.
    """
    return open_device(url, layout, reconnect=True)


def is_virtual(url: str) -> bool:
    """Whether this URL is of the virtual toy in this process."""
    return parse_url(url).scheme == _SIMULATED


def with_speed(url: str, speed: float) -> str:
    """The URL of a virtual or replayed toy at this speed, where it names none itself."""
    address = parse_url(url)
    if address.scheme not in (_SIMULATED, "replay") or "speed" in address.query:
        return url
    return f"{url}{'&' if '?' in url else '?'}speed={speed:g}"


def speed_of(url: str) -> float:
    """The speed that the URL of a virtual or replayed toy names; 1 for any other."""
    address = parse_url(url)
    return address.number("speed", 1.0) if address.scheme in (_SIMULATED, "replay") else 1.0


def prompt_virtual(recorder: Recorder) -> None:
    """Have the person of a virtual toy make the gestures that are asked for, when they are recorded.

    Any other toy is told nothing. Call it before the recorder starts.
    """
    inner = getattr(recorder.device, "inner", recorder.device)
    if not isinstance(inner, VirtualDevice):
        return
    inner.follow()

    def tell(what: str, status: Status) -> None:
        if what == "countdown" and status.state == "countdown":
            inner.perform(status.step.gesture, recorder.begins_ms)

    recorder.listen(tell)
