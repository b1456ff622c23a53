"""Offer the virtual toy to other programs, on a pseudo terminal or a local TCP port."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.core.layouts import Layout, load_layout
from plushsense.devices.base import Pacer
from plushsense.devices.virtual.stream import PerformedGesture, Prompts, ToySpec, ToyStream

HOST = "127.0.0.1"
_STALL_S = 0.5
"""Time after which lines are dropped if nobody reads them, as on a real serial line."""
_FAST_STALL_S = 10.0
"""The same for a toy faster than real time, which must wait for readers that are slowed by writing a file."""
_NAME_S = 2.0
"""How long a toy that was disconnected waits for the name of its pseudo terminal, which its reader may still use."""
_LAST_S = 0.05
_FAST_QUEUE = 512
"""Limit of unread bytes of such a toy on a pseudo terminal, whose buffer would hold seconds of data."""


@dataclass
class ToyCounters:
    """Numbers of lines sent, lines dropped because nobody read them, gestures begun, and connections accepted."""

    sent: int = 0
    dropped: int = 0
    gestures: int = 0
    connections: int = 0


@dataclass
class _Outlet:
    """Non-blocking output that waits for a slow reader, and drops whole lines if there is none."""

    write: Callable[[bytes | memoryview], int]
    fileno: int
    stall_s: float
    absent: bool = False
    unread: Callable[[], int] | None = None
    _rest: bytes = b""

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """Send lines; return False if some were dropped. Raise OSError if the reader has closed the connection."""
        whole = self._rest + data
        pending = memoryview(whole)
        deadline = time.monotonic() + (0.0 if self.absent else self.stall_s)
        self.wait_for_reader(_FAST_QUEUE, stop)
        while pending:
            try:
                pending = pending[self.write(pending) :]
                self.absent = False
            except BlockingIOError:
                left = deadline - time.monotonic()
                if left > 0.0 and not stop.is_set():
                    select.select([], [self.fileno], [], min(left, 0.05))
                    continue
                self.absent = True
                if at := len(whole) - len(pending):
                    self._rest = b"" if whole[at - 1 : at] == b"\n" else whole[at : whole.find(b"\n", at) + 1]
                return False
        self._rest = b""
        return True

    def wait_for_reader(self, most: int, stop: threading.Event) -> None:
        """Wait until at most ``most`` bytes are unread, if that is known and there is a reader."""
        deadline = time.monotonic() + self.stall_s
        if self.unread is not None and not self.absent:
            while self.unread() > most and time.monotonic() < deadline and not stop.wait(0.0005):
                pass


def _ignore(_: object) -> None:
    """Do nothing."""


@dataclass
class ToyServer:
    """A server for the virtual toy, with settings and callbacks.

    Attributes:
        spec: settings of the toy; the default is person 1.
        layout: layout of the lines.
        speed: 1 for real time, 0 for as fast as the reader accepts lines (then the toy waits for a reader).
        seconds: device time after which the toy ends; 0: never.
        on_ready: called with the URL when the toy can be opened.
        on_performed: called with each gesture as it begins.
        on_sent: called with the lines that were sent, without dropped ones.
        prompts: source of gestures that the person shall make; None: the gestures of ``spec``, or random ones.
        stop: event that ends the toy when it is set.
    """

    spec: ToySpec = field(default_factory=ToySpec)
    layout: Layout = field(default_factory=lambda: load_layout("plush-15"))
    speed: float = 1.0
    seconds: float = 0.0
    on_ready: Callable[[str], None] = _ignore
    on_performed: Callable[[PerformedGesture], None] = _ignore
    on_sent: Callable[[bytes], None] = _ignore
    prompts: Prompts | None = None
    stop: threading.Event = field(default_factory=threading.Event)

    def serve_tcp(self, port: int) -> ToyCounters:
        """Serve on ``127.0.0.1:port`` (0: any free port), to one reader at a time, until `stop` is set.

        Unless ``speed`` is 0, the toy continues while nobody is connected, as a real one does, but a scenario begins
        with the first reader. While a scenario disconnects the toy, nobody listens on the port.

        Raises:
            DeviceError: if the port is in use or not allowed.
            ConfigError: for an invalid port or speed, or a layout that the virtual toy does not support.
        """
        if not 0 <= port <= 65535:
            raise ConfigError(f"The port is {port}; a whole number from 0 (a free one) to 65535 is accepted.")
        if not 0.0 <= self.speed < float("inf"):
            raise ConfigError(f"The toy's speed is {self.speed}: accepted are 0 (fastest) and finite numbers above.")
        return self._run(_TcpPort(self, port))

    def serve_pty(self) -> ToyCounters:
        """Serve on a pseudo terminal that looks like a serial port, until `stop` is set. Linux and macOS.

        A speed of 0 is refused, since perhaps nobody reads the port. A toy faster than real time waits up to 10 s for a
        slow reader, so that its speed causes no losses. After a scenario has disconnected the toy, the port may have
        another name, which ``on_ready`` is called with.

        Raises:
            DeviceError: on Windows, which has no pseudo terminals.
            ConfigError: for a speed of 0, or a layout that the virtual toy does not support.
        """
        if sys.platform == "win32":
            raise DeviceError("Windows has no pseudo terminals: serve the toy over TCP instead (toy --tcp PORT).")
        if not 0.0 < self.speed < float("inf"):
            raise ConfigError(f"The toy's speed on a terminal is {self.speed:g}: accepted are finite numbers above 0.")
        return self._run(_Terminal(self))

    @property
    def stall_s(self) -> float:
        """Time after which lines are dropped if nobody reads them."""
        return _STALL_S if 0.0 < self.speed <= 1.0 else _FAST_STALL_S

    def _run(self, port: _Port) -> ToyCounters:
        """Send each line when it is due; disconnect while the toy shall not be connected."""
        counters = ToyCounters()
        stream = ToyStream(self.spec, self.layout, self.prompts)
        pacer = Pacer(self.speed)
        batch, lines = bytearray(), 0
        largest = 4096 if self.speed <= 1.0 else _FAST_QUEUE

        def flush() -> None:
            nonlocal lines
            if not batch:
                return
            if port.send(bytes(batch)):
                counters.sent += lines
                self.on_sent(bytes(batch))
            else:
                counters.dropped += lines
            batch.clear()
            lines = 0

        try:
            port.open()
            for line in stream:
                if self.stop.is_set() or (self.seconds and line.passed_ms >= self.seconds * 1000.0):
                    break
                due = pacer.due_s(line.passed_ms)
                if due > 0.0 or len(batch) > largest:
                    flush()
                    if due > 0.0 and self.stop.wait(due):
                        break
                if line.begins is not None:
                    counters.gestures += 1
                    self.on_performed(line.begins)
                if not line.connected:
                    flush()
                    port.disconnect()
                batch += line.data
                lines += max(line.data.count(b"\n"), bool(line.data))
            flush()
        finally:
            port.disconnect()
        counters.connections = port.connections
        return counters


class _Port(ABC):
    """The end of a connection at which the toy of a server is, and which others read."""

    def __init__(self, toy: ToyServer) -> None:
        self.toy = toy
        self.connections = 0
        self.outlet: _Outlet | None = None

    @abstractmethod
    def open(self) -> None:
        """Make the port ready for its first reader, after which `ToyServer.on_ready` is called."""

    @abstractmethod
    def send(self, data: bytes) -> bool:
        """Send lines, connected again if needed; return False if some were dropped."""

    @abstractmethod
    def disconnect(self) -> None:
        """Close what is open."""


class _TcpPort(_Port):
    """A port of this computer, with one reader at a time."""

    def __init__(self, toy: ToyServer, port: int) -> None:
        super().__init__(toy)
        self.port = port
        self.server: socket.socket | None = None
        self.client: socket.socket | None = None

    def open(self) -> None:
        """As in `_Port`; for a scenario, wait for the first reader."""
        self.server = _listen(self.port)
        self.port = self.server.getsockname()[1]
        self.toy.on_ready(f"tcp://{HOST}:{self.port}")
        if self.toy.spec.scenario is not None:
            self.send(b"")

    def send(self, data: bytes) -> bool:
        """As in `_Port`; wait for a reader if there are no lines, or they need not be on time."""
        server = self.server = self.server or _listen(self.port)
        while self.client is None and not self.toy.stop.is_set():
            try:
                self.client, _ = server.accept()
            except BlockingIOError:
                if data and self.toy.speed > 0.0:
                    return False
                select.select([server], [], [], 0.05)
                continue
            self.client.setblocking(False)
            self.client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.outlet = _Outlet(self.client.send, self.client.fileno(), self.toy.stall_s)
            self.connections += 1
        if self.client is None or self.outlet is None:
            return False
        try:
            return self.outlet.send(data, self.toy.stop)
        except OSError:  # the reader has disconnected: accept the next one
            self.client.close()
            self.client = self.outlet = None
            return False

    def disconnect(self) -> None:
        """As in `_Port`; first stop listening, since a reader may connect again as soon as it sees the end."""
        for end in (self.server, self.client):
            if end is not None:
                end.close()
        self.server = self.client = self.outlet = None


class _Terminal(_Port):
    """A pseudo terminal, whose slave end stays open, so that readers may come and go."""

    def __init__(self, toy: ToyServer) -> None:
        super().__init__(toy)
        self.ends: tuple[int, int] = (-1, -1)
        self.name = ""

    def open(self) -> None:
        """As in `_Port`."""
        if sys.platform == "win32":
            return
        import pty
        import tty

        master, slave = self.ends = _open_pty(pty.openpty, self.name)
        tty.setraw(slave)  # no echo, unchanged line ends
        os.set_blocking(master, False)
        if os.ttyname(slave) != self.name:
            self.name = os.ttyname(slave)
            self.toy.on_ready(f"serial://{self.name}")
        fast = self.toy.speed > 1.0
        unread = (lambda: _unread(slave)) if fast else None
        write = partial(os.write, master)
        self.outlet = _Outlet(write, master, self.toy.stall_s, absent=not fast, unread=unread)

    def send(self, data: bytes) -> bool:
        """As in `_Port`."""
        if self.outlet is None:
            self.open()
        return self.outlet is not None and self.outlet.send(data, self.toy.stop)

    def disconnect(self) -> None:
        """As in `_Port`."""
        outlet, self.outlet = self.outlet, None
        if outlet is not None:
            # Closing discards what was not read, and the last bytes take a moment to arrive.
            outlet.wait_for_reader(0, self.toy.stop)
            self.toy.stop.wait(_LAST_S if self.toy.speed > 1.0 else 0.0)
            outlet.wait_for_reader(0, self.toy.stop)
            for end in self.ends:
                os.close(end)


def _listen(port: int) -> socket.socket:
    """Listen on a port of this computer; raise DeviceError if that is not possible."""
    try:
        server = socket.create_server((HOST, port))
    except OSError as cause:
        raise DeviceError(
            f"The toy cannot listen on port {port} of {HOST}: {cause.strerror or cause}; choose another port."
        ) from None
    server.setblocking(False)
    return server


def _open_pty(openpty: Callable[[], tuple[int, int]], name: str) -> tuple[int, int]:
    """Open a pseudo terminal, of this ``name`` if it is free again within `_NAME_S`; "" for any."""
    until = time.monotonic() + _NAME_S
    while True:
        ends = openpty()
        if not name or os.ttyname(ends[1]) == name or time.monotonic() > until:
            return ends
        for end in ends:
            os.close(end)
        time.sleep(0.01)


def _unread(slave: int) -> int:
    """Return the number of unread bytes on a pseudo terminal."""
    if sys.platform == "win32":
        return 0
    import fcntl
    import struct
    import termios

    waiting = fcntl.ioctl(slave, termios.FIONREAD, b"\0" * 4)
    return int(struct.unpack("i", waiting)[0])
