"""List available toys: serial ports, Bluetooth devices, LSL streams and the virtual toy, each with its URL."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from plushsense.core.errors import ConfigError, MissingExtraError, PlushSenseError
from plushsense.devices.ble import UART_SERVICE, BleBackends, scan
from plushsense.devices.bytestreams import serial_ports
from plushsense.devices.lsl import load_pylsl, stream_url

SCAN_S = 3.0
_GRACE_S = 2.0
_TOY_WORDS = ("plush", "toy", "teddy", "bear")


@dataclass(frozen=True)
class DeviceInfo:
    """A possible toy: ``url`` opens it, ``kind`` is serial, ble, lsl or virtual."""

    url: str
    kind: str
    name: str
    description: str


@dataclass
class DeviceListing:
    """The devices found, and a sentence for each kind of device that could not be searched."""

    devices: list[DeviceInfo] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"devices": [asdict(d) for d in self.devices], "notes": list(self.notes)}


def list_devices(scan_s: float = SCAN_S, backends: BleBackends | None = None) -> DeviceListing:
    """Search for toys on all transports at once, for ``scan_s`` seconds.

    Bluetooth devices are listed when they advertise the Nordic UART service or have a name like a toy's; all LSL
    streams are. A missing package or adapter is a note, not an error.

    Raises:
        ConfigError: for a time that is not above 0 and at most 600 s.
    """
    if not 0.0 < scan_s <= 600.0:
        raise ConfigError(f"The time to look for toys is {scan_s:g} s; accepted is above 0 to 600.")
    searches: dict[str, Callable[[], DeviceListing]] = {
        "Serial ports": _serial,
        "Bluetooth": lambda: _bluetooth(scan_s, backends),
        "LSL": lambda: _streams(scan_s),
    }
    results: dict[str, DeviceListing] = {}

    def look(what: str, search: Callable[[], DeviceListing]) -> None:
        try:
            results[what] = search()
        except MissingExtraError as refusal:
            results[what] = DeviceListing(notes=[f"{what}: not looked at. {refusal}"])
        except PlushSenseError as refusal:
            results[what] = DeviceListing(notes=[str(refusal)])
        except Exception as cause:  # noqa: BLE001, RUF100
            results[what] = DeviceListing(notes=[f"{what} cannot be used: {' '.join(str(cause).split())}."])

    threads = [threading.Thread(target=look, args=item, daemon=True) for item in searches.items()]
    for thread in threads:
        thread.start()
    listing = DeviceListing()
    for thread, what in zip(threads, searches, strict=True):
        thread.join(scan_s + _GRACE_S)
        part = results.get(what) or DeviceListing(notes=[f"{what} did not answer within {scan_s + _GRACE_S:g} s."])
        listing.devices += part.devices
        listing.notes += part.notes
    listing.devices.append(DeviceInfo("virtual://?person=7", "virtual", "virtual toy", "in this program; a simulation"))
    return listing


def _serial() -> DeviceListing:
    ports = [(name, "" if about == "n/a" else about) for name, about in serial_ports()]
    notes = [] if ports else ["This computer has no serial port now."]
    return DeviceListing([DeviceInfo(f"serial://{name}", "serial", name, about) for name, about in ports], notes)


def _bluetooth(scan_s: float, backends: BleBackends | None) -> DeviceListing:
    seen = scan(scan_s, backends)
    toys = []
    for device in seen:
        uart = UART_SERVICE in device.services
        if uart or any(word in device.name.lower() for word in _TOY_WORDS):
            about = f"{device.rssi} dBm, {'Nordic UART service' if uart else 'advertises no Nordic UART service'}"
            toys.append(DeviceInfo(f"ble://{device.address}", "ble", device.name or device.address, about))
    others = len(seen) - len(toys)
    if not others:
        return DeviceListing(toys)
    who = "1 more device advertises" if others == 1 else f"{others} more devices advertise"
    return DeviceListing(toys, [f"Bluetooth: {who}, by name and service no toy; ble://ADDRESS opens any."])


def _streams(scan_s: float) -> DeviceListing:
    streams = {s.uid(): s for s in load_pylsl().resolve_streams(scan_s)}.values()
    names = Counter(s.name() for s in streams)
    found = [
        DeviceInfo(
            stream_url(s, unique_name=names[s.name()] == 1),
            "lsl",
            s.name(),
            f"{s.type() or 'no type'}, {s.channel_count()} channels, {s.nominal_srate():g} Hz, on {s.hostname()}",
        )
        for s in streams
    ]
    return DeviceListing(sorted(found, key=lambda d: (d.name, d.url)))
