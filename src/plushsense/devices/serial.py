"""A toy on a serial port: a cable, or the port that a Bluetooth driver makes (through pyserial)."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

import serial as pyserial
from serial.tools import list_ports

from plushsense.core.errors import DeviceError
from plushsense.core.signal import Layout
from plushsense.devices.base import Device, Frame, now_ms
from plushsense.devices.opening import Address
from plushsense.devices.wire import LineParser

BAUD = 115_200

# SerialException is an OSError; a port that vanishes while it is set up or read shows as one of the others.
_FAULTS: tuple[type[Exception], ...] = (OSError, TypeError, ValueError)
if sys.platform != "win32":
    import termios

    _FAULTS = (*_FAULTS, termios.error)


def serial_ports() -> list[tuple[str, str]]:
    """The serial ports of this computer: name and description."""
    return sorted((str(p.device), str(p.description or "")) for p in list_ports.comports())


class SerialDevice(Device):
    """Frames from a serial port. A toy that is unplugged raises DeviceError."""

    def __init__(self, url: str, layout: Layout, port: str, baud: int = BAUD) -> None:
        super().__init__(url, layout)
        try:
            # Two readers would share the port's bytes between them: refuse the second (Windows always does).
            alone = True if os.name == "posix" else None
            self._port = pyserial.Serial(port, baud, timeout=0.1, exclusive=alone)
        except _FAULTS as cause:
            raise DeviceError(_refusal(url, port, cause)) from None
        self._parser = LineParser(layout, self.counters, joining=True)

    def read(self) -> list[Frame] | None:
        """What has arrived, waiting at most 0.1 s, or not at all with a ``wait_s`` of 0."""
        try:
            waiting = self._port.in_waiting
            if not waiting and self.wait_s <= 0.0:
                return []
            data = self._port.read(max(1, min(waiting, 65536)))
        except _FAULTS as cause:  # pyserial also trips over its own closed port
            if self.closed:
                return None
            self._parser.finish()
            raise DeviceError(f"'{self.url}' went away ({_reason(cause)}): was it unplugged or switched off?") from None
        self.arrived_s = time.perf_counter()
        host = now_ms()
        return [Frame(host, line.device_ms, line.values) for line in self._parser.feed(data)]

    def _shut(self) -> None:
        with contextlib.suppress(*_FAULTS):
            self._port.close()


def _reason(cause: Exception) -> str:
    number = getattr(cause, "errno", None)
    return os.strerror(number) if number else " ".join(str(cause).split()) or type(cause).__name__


def _refusal(url: str, port: str, cause: Exception) -> str:
    number = getattr(cause, "errno", None)
    if isinstance(cause, ValueError):
        return f"'{url}' cannot be opened: {cause}."
    if os.name == "posix" and Path(port).exists():
        if number in (13, 1):
            return f"'{url}': this user may not open {port}; on Linux join the group dialout and log in anew."
        if number == 11 or "lock" in str(cause).lower():
            return f"'{url}': another program is using {port}; close it first."
        return f"'{url}' cannot be opened: {_reason(cause)}."
    if "access is denied" in str(cause).lower() or "PermissionError" in str(cause):
        return f"'{url}': another program is using {port}; close it first."
    ports = [name for name, _ in serial_ports()]
    here = f"the ports here are {', '.join(ports)}" if ports else "this computer has no serial port now"
    return f"'{url}': there is no port {port}; {here}."


def open_url(address: Address, layout: Layout) -> SerialDevice:
    """Open ``serial:///dev/ttyUSB0?baud=115200`` or ``serial://COM3``."""
    address.check_keys(("baud",))
    if not address.place.strip("/"):
        raise DeviceError(f"'{address.url}' names no port: write serial:///dev/ttyUSB0 or serial://COM3.")
    place = address.place
    if place.startswith("/") and place[1:].upper().startswith("COM"):
        place = place[1:]
    return SerialDevice(address.url, layout, place, address.whole("baud", BAUD, 50, 4_000_000))
