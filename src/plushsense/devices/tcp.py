"""A toy behind a network socket: the wire format over TCP."""

from __future__ import annotations

import contextlib
import re
import socket
import time

from plushsense.core.errors import DeviceError
from plushsense.core.signal import Layout
from plushsense.devices.base import Device, Frame, now_ms
from plushsense.devices.opening import Address
from plushsense.devices.wire import LineParser

CONNECT_S = 5.0
_KEEPALIVE = {"TCP_KEEPIDLE": 3, "TCP_KEEPALIVE": 3, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""Seconds of silence, seconds between probes, probes; TCP_KEEPALIVE is what macOS calls the first."""


class TcpDevice(Device):
    """Frames from a TCP connection. One closed in order ends the frames; a broken one raises DeviceError."""

    def __init__(self, url: str, layout: Layout, host: str, port: int) -> None:
        super().__init__(url, layout)
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except socket.gaierror:
            raise DeviceError(f"'{url}': there is no host '{host}'; check the name.") from None
        except ConnectionRefusedError:
            raise DeviceError(
                f"'{url}': nobody listens on port {port} of {host}; start the toy there (plushsense toy --tcp {port})."
            ) from None
        except (TimeoutError, OSError, UnicodeError) as cause:
            silent = isinstance(cause, TimeoutError)
            reason = "no answer" if silent else getattr(cause, "strerror", None) or cause
            raise DeviceError(f"'{url}' cannot be reached: {reason}.") from None
        _notice_silence(self._socket)
        self._parser = LineParser(layout, self.counters)

    def read(self) -> list[Frame] | None:
        """What has arrived, waiting at most ``wait_s``; None when the other side closed in order."""
        try:
            self._socket.settimeout(self.wait_s)
            data = self._socket.recv(65536)
        except BlockingIOError:
            return []
        except OSError as cause:
            if self.closed:
                return None
            if isinstance(cause, TimeoutError) and cause.errno is None:  # ours; the network's has a number
                return []
            self._parser.finish()
            raise DeviceError(f"'{self.url}' went away: {cause.strerror or cause}.") from None
        self.arrived_s = time.perf_counter()
        if not data:
            self._parser.finish()
            return None
        host = now_ms()
        return [Frame(host, line.device_ms, line.values) for line in self._parser.feed(data)]

    def _shut(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _notice_silence(connection: socket.socket) -> None:
    """Let the system ask after a toy that says nothing: one without power closes no connection. Found out in 6 s."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def open_url(address: Address, layout: Layout) -> TcpDevice:
    """Open ``tcp://host:port``."""
    address.check_keys(())
    match = re.fullmatch(r"(\[[^\]]+\]|[^:/\[\]]+):(\d{1,5})/?", address.place, re.ASCII)
    if match is None or not 1 <= int(match[2]) <= 65535:
        raise DeviceError(f"'{address.url}': a network toy is tcp://host:port, with a port from 1 to 65535.")
    return TcpDevice(address.url, layout, match[1].strip("[]"), int(match[2]))
