"""Serial ports (of a cable or a Bluetooth driver; with pyserial), TCP connections, and toys that send lines there."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import sys
import time
from abc import ABC, abstractmethod
from pathlib import Path

import serial as pyserial
from serial.tools import list_ports

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.core.layouts import Layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Device, Frame, now_ms
from plushsense.devices.opening import DeviceAddress, DeviceInfo, DeviceListing, parse_url
from plushsense.devices.wire import LineParser

BAUD = 115_200
SEND_S = 10.0
_SERIAL_S = 0.1

# SerialException is an OSError; a port that disappears while it is opened or read raises one of the others.
_FAULTS: tuple[type[Exception], ...] = (OSError, TypeError, ValueError)
if sys.platform != "win32":
    import termios

    _FAULTS = (*_FAULTS, termios.error)


def serial_ports() -> list[tuple[str, str]]:
    """Return names and descriptions of the serial ports of this computer."""
    return sorted((str(p.device), str(p.description or "")) for p in list_ports.comports())


def search_serial(_: float) -> DeviceListing:
    """List the serial ports, but none of the mainboard: Linux lists those also where nothing is connected."""
    found = [(name, "" if about == "n/a" else about) for name, about in serial_ports()]
    ports = [(name, about) for name, about in found if not name.startswith("/dev/ttyS")]
    notes: list[str] = [] if ports else [Message("This computer has no serial port now.")]
    return DeviceListing([DeviceInfo(f"serial://{name}", "serial", name, about) for name, about in ports], notes)


class Link(ABC):
    """An open connection that carries bytes both ways."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.closed = False

    @abstractmethod
    def receive(self, wait_s: float) -> bytes | None:
        """Return the received bytes, waiting at most ``wait_s`` for the first; None after the other side has closed.

        Raises:
            DeviceError: if the connection is lost.
        """

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send bytes; raise DeviceError if the connection is lost, or nothing was taken for `SEND_S`."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection, also while another thread reads."""


class LineDevice(Device):
    """A toy that sends lines. A link that is closed properly ends the frames; a lost one raises DeviceError."""

    def __init__(self, url: str, layout: Layout, link: Link, *, joining: bool) -> None:
        super().__init__(url, layout)
        self._link = link
        self._parser = LineParser(layout, self.counters, joining=joining)

    def read(self) -> list[Frame] | None:
        """Return the received frames, waiting at most ``wait_s``; return None after the other side has closed."""
        try:
            data = self._link.receive(self.wait_s)
        except DeviceError:
            self._parser.finish()
            raise
        if data is None:
            if not self.closed:
                self._parser.finish()
            return None
        if not data:
            return []
        self.arrived_s = time.perf_counter()
        return self._parser.frames(data, now_ms())

    @property
    def mismatch(self) -> Message:
        """As in `Device`."""
        return self._parser.mismatch(self.url)

    def _shut(self) -> None:
        self._link.close()


class SerialLink(Link):
    """A serial port."""

    def __init__(self, url: str, port: str, baud: int = BAUD) -> None:
        super().__init__(url)
        try:
            # Two readers would each get only part of the bytes, so a second one is refused (Windows always does so).
            alone = True if os.name == "posix" else None
            self._port = pyserial.Serial(port, baud, timeout=_SERIAL_S, write_timeout=SEND_S, exclusive=alone)
        except _FAULTS as cause:
            raise _refusal(url, port, cause) from None

    def receive(self, wait_s: float) -> bytes | None:
        """As in `Link`, waiting at most 0.1 s, or not at all if ``wait_s`` is 0; None only after `close`."""
        try:
            waiting = self._port.in_waiting
            if not waiting and wait_s <= 0.0:
                return b""
            return bytes(self._port.read(max(1, min(waiting, 65536))))
        except _FAULTS as cause:  # pyserial raises various errors for a port closed by another thread
            if self.closed:
                return None
            raise self._gone(cause) from None

    def send(self, data: bytes) -> None:
        """As in `Link`."""
        try:
            self._port.write(data)
        except _FAULTS as cause:
            raise self._gone(cause) from None

    def _gone(self, cause: Exception) -> DeviceError:
        return DeviceError(
            "'{url}' went away ({reason}): was it unplugged or switched off?", url=self.url, reason=_reason(cause)
        )

    def close(self) -> None:
        """As in `Link`."""
        self.closed = True
        with contextlib.suppress(*_FAULTS):
            self._port.close()


def _reason(cause: Exception) -> str:
    number = getattr(cause, "errno", None)
    return os.strerror(number) if number else " ".join(str(cause).split()) or type(cause).__name__


def _refusal(url: str, port: str, cause: Exception) -> DeviceError:
    number = getattr(cause, "errno", None)
    cannot = DeviceError(
        "'{url}' cannot be opened: {cause}.", url=url, cause=cause if isinstance(cause, ValueError) else _reason(cause)
    )
    if isinstance(cause, ValueError):
        return cannot
    busy = DeviceError("'{url}': another program is using {port}; close it first.", url=url, port=port)
    if os.name == "posix" and Path(port).exists():
        if number in (13, 1):
            return DeviceError(
                "'{url}': this user may not open {port}; on Linux join the group dialout and log in again.",
                url=url,
                port=port,
            )
        if number == 11 or "lock" in str(cause).lower():
            return busy
        return cannot
    if "access is denied" in str(cause).lower() or "PermissionError" in str(cause):
        return busy
    return _no_port(url, port)


def _no_port(url: str, port: str) -> DeviceError:
    ports = ", ".join(name for name, _ in serial_ports())
    here = f"the ports here are {ports}" if ports else "this computer has no serial port now"
    return DeviceError("'{url}': there is no port {port}; {here}.", url=url, port=port, here=here, ports=ports or "–")


def _port_of(address: DeviceAddress) -> str:
    """Return the name of the port; raise an error for an address that is not ``serial://PORT``."""
    address.check_keys(("baud",))
    if not address.place.strip("/"):
        raise DeviceError("'{url}' names no port: write serial:///dev/ttyUSB0 or serial://COM3.", url=address.url)
    place = address.place
    return place[1:] if place.startswith("/") and place[1:].upper().startswith("COM") else place


def check_serial(address: DeviceAddress) -> None:
    """Raise DeviceError if the port does not exist."""
    port = _port_of(address)
    if not Path(port).exists() and port.upper() not in [name.upper() for name, _ in serial_ports()]:
        raise _no_port(address.url, port)


def _serial_link(address: DeviceAddress) -> SerialLink:
    return SerialLink(address.url, _port_of(address), address.whole("baud", BAUD, 50, 4_000_000))


def open_serial(address: DeviceAddress, layout: Layout) -> LineDevice:
    """Open ``serial:///dev/ttyUSB0?baud=115200`` or ``serial://COM3``."""
    return LineDevice(address.url, layout, _serial_link(address), joining=True)


CONNECT_S = 5.0
_KEEPALIVE = {"TCP_KEEPIDLE": 3, "TCP_KEEPALIVE": 3, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""Seconds of silence (TCP_KEEPALIVE on macOS), seconds between probes, number of probes."""


class TcpLink(Link):
    """A TCP connection."""

    def __init__(self, url: str, host: str, port: int) -> None:
        super().__init__(url)
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except socket.gaierror:
            raise DeviceError("'{url}': there is no host '{host}'; check the name.", url=url, host=host) from None
        except ConnectionRefusedError:
            raise DeviceError(
                "'{url}': nobody listens on port {port} of {host}; start the toy there (plushsense toy --tcp {port}).",
                url=url,
                port=port,
                host=host,
            ) from None
        except (TimeoutError, OSError, UnicodeError) as cause:
            silent = isinstance(cause, TimeoutError)
            reason = "no answer" if silent else getattr(cause, "strerror", None) or cause
            raise DeviceError("'{url}' cannot be reached: {reason}.", url=url, reason=reason) from None
        _enable_keepalive(self._socket)

    def receive(self, wait_s: float) -> bytes | None:
        """As in `Link`."""
        try:
            self._socket.settimeout(wait_s)
            return self._socket.recv(65536) or None
        except BlockingIOError:
            return b""
        except OSError as cause:
            if self.closed:
                return None
            if isinstance(cause, TimeoutError) and cause.errno is None:  # our timeout; others have a number
                return b""
            raise self._gone(cause) from None

    def send(self, data: bytes) -> None:
        """As in `Link`."""
        try:
            self._socket.settimeout(SEND_S)
            self._socket.sendall(data)
        except OSError as cause:
            raise self._gone(cause) from None

    def _gone(self, cause: OSError) -> DeviceError:
        return DeviceError("'{url}' went away: {why}.", url=self.url, why=cause.strerror or cause)

    def close(self) -> None:
        """As in `Link`."""
        self.closed = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _enable_keepalive(connection: socket.socket) -> None:
    """Enable TCP keepalive, so that a toy without power is detected within 6 s."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def check_tcp(address: DeviceAddress) -> tuple[str, int]:
    """Return host and port; raise an error for an address that is not ``tcp://host:port``."""
    address.check_keys(())
    match = re.fullmatch(r"(\[[^\]]+\]|[^:/\[\]]+):(\d{1,5})/?", address.place, re.ASCII)
    if match is None or not 1 <= int(match[2]) <= 65535:
        raise DeviceError("'{url}': a network toy is tcp://host:port, with a port from 1 to 65535.", url=address.url)
    return match[1].strip("[]"), int(match[2])


def open_tcp(address: DeviceAddress, layout: Layout) -> LineDevice:
    """Open ``tcp://host:port``."""
    return LineDevice(address.url, layout, TcpLink(address.url, *check_tcp(address)), joining=False)


def open_link(url: str) -> Link:
    """Open ``serial://…`` or ``tcp://host:port`` for any bytes.

    Raises:
        ConfigError: for another scheme, or a setting that is unknown or out of range.
        DeviceError: for a port or host that does not exist or cannot be opened.
    """
    address = parse_url(url)
    if "layout" in address.query:
        raise ConfigError(f"'{url}': no lines are read here, so leave out layout.")
    if address.scheme == "serial":
        return _serial_link(address)
    if address.scheme == "tcp":
        return TcpLink(address.url, *check_tcp(address))
    raise ConfigError(f"'{url}' carries no bytes both ways: accepted are serial:///dev/ttyUSB0 and tcp://host:port.")
