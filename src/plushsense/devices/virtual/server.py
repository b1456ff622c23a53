"""Offer the virtual toy to other programs, on a pseudo terminal or a local TCP port."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

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
        stream = ToyStream(self.spec, self.layout, self.prompts)
        counters = ToyCounters()
        listening = _listen(port)
        port = listening.getsockname()[1]
        server: socket.socket | None = listening
        client: socket.socket | None = None
        outlet: _Outlet | None = None
        self.on_ready(f"tcp://{HOST}:{port}")

        def send(data: bytes) -> bool:
            nonlocal server, client, outlet
            if server is None:
                server = _listen(port)
            while client is None and not self.stop.is_set():
                try:
                    client, _ = server.accept()
                except BlockingIOError:
                    if data and self.speed > 0.0:
                        return False
                    select.select([server], [], [], 0.05)
                    continue
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                outlet = _Outlet(client.send, client.fileno(), self._stall_s)
                counters.connections += 1
            if client is None or outlet is None:
                return False
            try:
                return outlet.send(data, self.stop)
            except OSError:  # the reader has disconnected: accept the next one
                client.close()
                client = outlet = None
                return False

        def disconnect() -> None:
            nonlocal server, client, outlet
            for end in (client, server):
                if end is not None:
                    end.close()
            server = client = outlet = None

        try:
            if self.spec.scenario is not None:
                send(b"")  # waits for the first reader
            self._run(stream, send, counters, disconnect)
        finally:
            disconnect()
        return counters

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
        import pty
        import tty

        if not 0.0 < self.speed < float("inf"):
            raise ConfigError(f"The toy's speed on a terminal is {self.speed:g}: accepted are finite numbers above 0.")
        stream = ToyStream(self.spec, self.layout, self.prompts)
        counters = ToyCounters()
        fast = self.speed > 1.0
        outlet: _Outlet | None = None
        ends: tuple[int, int] = (-1, -1)
        name = ""

        def plug() -> _Outlet:
            nonlocal ends, name
            master, slave = ends = _open_pty(pty.openpty, name)
            # Raw mode: no echo, unchanged line ends. The slave stays open, so that readers may come and go.
            tty.setraw(slave)
            os.set_blocking(master, False)
            if os.ttyname(slave) != name:
                name = os.ttyname(slave)
                self.on_ready(f"serial://{name}")
            return _Outlet(
                lambda data: os.write(master, data),
                master,
                self._stall_s,
                absent=not fast,
                unread=(lambda: _unread(slave)) if fast else None,
            )

        def send(data: bytes) -> bool:
            nonlocal outlet
            outlet = outlet or plug()
            return outlet.send(data, self.stop)

        def disconnect() -> None:
            nonlocal outlet
            if outlet is not None:
                # Closing discards what was not read, and the last bytes take a moment to arrive.
                outlet.wait_for_reader(0, self.stop)
                self.stop.wait(_LAST_S if fast else 0.0)
                outlet.wait_for_reader(0, self.stop)
                outlet = None
                for end in ends:
                    os.close(end)

        outlet = plug()
        try:
            self._run(stream, send, counters, disconnect)
        finally:
            disconnect()
        return counters

    @property
    def _stall_s(self) -> float:
        return _STALL_S if 0.0 < self.speed <= 1.0 else _FAST_STALL_S

    def _run(
        self,
        stream: ToyStream,
        send: Callable[[bytes], bool],
        counters: ToyCounters,
        disconnect: Callable[[], None],
    ) -> None:
        """Send each line when it is due, and call ``disconnect`` while the toy shall not be connected."""
        pacer = Pacer(self.speed)
        batch, lines = bytearray(), 0
        largest = 4096 if self.speed <= 1.0 else _FAST_QUEUE

        def flush() -> None:
            nonlocal lines
            if not batch:
                return
            if send(bytes(batch)):
                counters.sent += lines
                self.on_sent(bytes(batch))
            else:
                counters.dropped += lines
            batch.clear()
            lines = 0

        for line in stream:
            if self.stop.is_set():
                break
            if self.seconds and line.passed_ms >= self.seconds * 1000.0:
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
                disconnect()
            batch += line.data
            lines += max(line.data.count(b"\n"), bool(line.data))
        flush()


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
