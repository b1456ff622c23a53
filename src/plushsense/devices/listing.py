"""What toys are there: serial ports, Bluetooth, LSL streams, and the virtual one; each with the URL that opens it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from plushsense.core.errors import ConfigError, MissingExtraError, PlushSenseError
from plushsense.devices.ble import UART_SERVICE, Backends, scan
from plushsense.devices.lsl import load_pylsl, stream_url
from plushsense.devices.serial import serial_ports

SCAN_S = 3.0
_GRACE_S = 2.0
_TOY_WORDS = ("plush", "toy", "teddy", "bear")


@dataclass(frozen=True)
class Found:
    """One toy, or what may be one: ``url`` opens it, ``kind`` is serial, ble, lsl or virtual."""

    url: str
    kind: str
    name: str
    description: str


@dataclass
class Listing:
    """What is there, and notes on what could not be looked at, a sentence each."""

    devices: list[Found] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"devices": [asdict(d) for d in self.devices], "notes": list(self.notes)}


def list_devices(scan_s: float = SCAN_S, backends: Backends | None = None) -> Listing:
    """Look for toys everywhere at once, for ``scan_s`` seconds.

    Bluetooth devices are listed when they advertise the Nordic UART service or have a name like a toy's; all LSL
    streams are. What is not installed or not there is a note, never an error.

    Raises:
        ConfigError: for a time that is not above 0 and at most 600 s.
    """
    if not 0.0 < scan_s <= 600.0:
        raise ConfigError(f"The time to look for toys is {scan_s:g} s; accepted is above 0 to 600.")
    searches: dict[str, Callable[[], Listing]] = {
        "Serial ports": _serial,
        "Bluetooth": lambda: _bluetooth(scan_s, backends),
        "LSL": lambda: _streams(scan_s),
    }
    results: dict[str, Listing] = {}

    def look(what: str, search: Callable[[], Listing]) -> None:
        try:
            results[what] = search()
        except MissingExtraError as refusal:
            results[what] = Listing(notes=[f"{what}: not looked at. {refusal}"])
        except PlushSenseError as refusal:
            results[what] = Listing(notes=[str(refusal)])
        except Exception as cause:  # noqa: BLE001 (one broken driver must not hide the other toys)
            results[what] = Listing(notes=[f"{what} cannot be used: {' '.join(str(cause).split())}."])

    threads = [threading.Thread(target=look, args=item, daemon=True) for item in searches.items()]
    for thread in threads:
        thread.start()
    listing = Listing()
    for thread, what in zip(threads, searches, strict=True):
        thread.join(scan_s + _GRACE_S)
        part = results.get(what) or Listing(notes=[f"{what} did not answer within {scan_s + _GRACE_S:g} s."])
        listing.devices += part.devices
        listing.notes += part.notes
    listing.devices.append(Found("virtual://?person=7", "virtual", "virtual toy", "in this program; a simulation"))
    return listing


def _serial() -> Listing:
    ports = [(name, "" if about == "n/a" else about) for name, about in serial_ports()]
    notes = [] if ports else ["This computer has no serial port now."]
    return Listing([Found(f"serial://{name}", "serial", name, about) for name, about in ports], notes)


def _bluetooth(scan_s: float, backends: Backends | None) -> Listing:
    seen = scan(scan_s, backends)
    toys = []
    for device in seen:
        uart = UART_SERVICE in device.services
        if uart or any(word in device.name.lower() for word in _TOY_WORDS):
            about = f"{device.rssi} dBm, {'Nordic UART service' if uart else 'advertises no Nordic UART service'}"
            toys.append(Found(f"ble://{device.address}", "ble", device.name or device.address, about))
    others = len(seen) - len(toys)
    if not others:
        return Listing(toys)
    who = "1 more device advertises" if others == 1 else f"{others} more devices advertise"
    return Listing(toys, [f"Bluetooth: {who}, by name and service no toy; ble://ADDRESS opens any."])


def _streams(scan_s: float) -> Listing:
    streams = {s.uid(): s for s in load_pylsl().resolve_streams(scan_s)}.values()
    names = Counter(s.name() for s in streams)
    found = [
        Found(
            stream_url(s, unique_name=names[s.name()] == 1),
            "lsl",
            s.name(),
            f"{s.type() or 'no type'}, {s.channel_count()} channels, {s.nominal_srate():g} Hz, on {s.hostname()}",
        )
        for s in streams
    ]
    return Listing(sorted(found, key=lambda d: (d.name, d.url)))
