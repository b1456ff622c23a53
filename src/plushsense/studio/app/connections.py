"""Limit the number of open connections and the time a request may take to arrive.

Each connection uses a file descriptor of the process that also records.
"""

from __future__ import annotations

import asyncio
import ipaddress
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

_MOST, _MOST_PER_PEER = 256, 32
"""Default limits: all connections, and those of one peer. A browser opens up to six, plus a websocket per page."""


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on the number of open connections and on how long each may wait.

    Attributes:
        total: maximum number of connections; ``per_peer`` of them are reserved for browsers on this computer.
        per_peer: maximum number of connections of one peer, see `peer_of`.
        head_s: maximum time from connecting, or from the previous response, until the head of a request is complete.
        body_s: maximum time without new data while the body of a request is incomplete, or in which the client reads
            nothing of a response.
        keep_alive_s: time after a response until a connection without a new request is closed.
        backlog: maximum number of connections waiting to be accepted; each is open briefly before it can be refused.
    """

    total: int = _MOST
    per_peer: int = _MOST_PER_PEER
    head_s: float = 10.0
    body_s: float = 30.0
    keep_alive_s: int = 5
    backlog: int = 128

    @classmethod
    def of_process(cls) -> ConnectionLimits:
        """Return limits that let connections use at most a quarter of this process's file descriptors."""
        try:
            import resource
        except ImportError:  # Windows, where sockets do not count as open files
            return cls()
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        total = _MOST if files == resource.RLIM_INFINITY else max(4, min(_MOST, files // 4))
        return cls(total=total, per_peer=min(_MOST_PER_PEER, total // 2), backlog=total // 2)


@lru_cache(maxsize=1024)
def peer_of(client: str, server: str) -> str:
    """Return the name under which the connections of a client are counted.

    The name is "" for this computer, whichever of its addresses is used. Otherwise it is the IPv4 address, or the /64
    network of an IPv6 address, because a host can choose the remaining bits itself.
    """
    try:
        address = ipaddress.ip_address(client.partition("%")[0])
    except ValueError:
        return client
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    if address.is_loopback or client == server:
        return ""
    return str(ipaddress.ip_network((address, 64), strict=False) if address.version == 6 else address)


class _WriteWatch(asyncio.Protocol):
    """Part of uvicorn's protocol classes: notes since when a client has not read what was sent."""

    _blocked_since: float | None = None

    def pause_writing(self) -> None:
        self._blocked_since = time.monotonic()
        super().pause_writing()

    def resume_writing(self) -> None:
        self._blocked_since = None
        super().resume_writing()


class LimitedProtocol(_WriteWatch, H11Protocol):
    """An HTTP connection, until it is closed or upgraded to a websocket, within `limits`.

    uvicorn limits the time *after* a response and the length of a head, but not the time a request takes to arrive.
    Its ``limit_concurrency`` answers complete requests with 503 but keeps incomplete ones open. This class closes the
    connection that has been idle longest to make room for a new one.
    """

    limits: ClassVar[ConnectionLimits] = ConnectionLimits()
    # By time.monotonic, because the clock of uvloop counts whole milliseconds.
    _idle_since = _data_at = 0.0
    _timer: Any = None

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        base: Any = self.ws_protocol_class
        self.ws_protocol_class = base and limited_websocket(self.limits.body_s, base)

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._idle_since = time.monotonic()
        if self._find_room():
            self._timer = self.loop.call_later(self.limits.head_s, self._expire)
        else:
            self._drop()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._data_at = time.monotonic()
        super().data_received(data)

    def on_response_complete(self) -> None:
        self._idle_since = time.monotonic()
        super().on_response_complete()

    @property
    def _idle(self) -> bool:
        """True if the connection is waiting for the head of a request and has nothing left to send."""
        if self.conn.their_state is h11.SEND_BODY or self.transport.get_write_buffer_size():
            return False
        return self.cycle is None or self.cycle.response_complete

    def _find_room(self) -> bool:
        """Return whether this connection may stay, after dropping an idle one if necessary."""
        own_peer = _peer(self)
        others = [(_peer(c), c) for c in self.connections if c is not self]
        rivals = [c for name, c in others if name == own_peer]
        if len(rivals) < self.limits.per_peer:
            # The connections reserved for this computer are not available to other peers.
            rivals = [c for name, c in others if name] if own_peer else []
            if len(rivals) < self.limits.total - self.limits.per_peer:
                return True
        idle = [c for c in rivals if isinstance(c, LimitedProtocol) and c._idle]
        if idle:
            min(idle, key=lambda c: c._idle_since)._drop()
        return bool(idle)

    def _drop(self) -> None:
        # Remove it now: the transport reports the closing only in the next iteration of the event loop.
        self.connections.discard(self)
        self.transport.abort()

    def _expire(self) -> None:
        """Drop the connection if the rest of a request or reading the response is overdue; else check later."""
        now, limits = time.monotonic(), self.limits
        if self not in self.connections:
            return  # it is a websocket now
        left = limits.head_s
        if self._blocked_since is not None:
            left = self._blocked_since + limits.body_s - now
        elif self.conn.their_state is h11.SEND_BODY:
            if self.flow.read_paused:
                self._data_at = now
            left = self._data_at + limits.body_s - now
        elif self._idle:
            left = self._idle_since + limits.head_s - now
        if left <= 0.0:
            self._drop()
        else:
            self._timer = self.loop.call_later(min(left, limits.head_s), self._expire)


def limited_protocol(limits: ConnectionLimits) -> type[LimitedProtocol]:
    """Return a protocol class that enforces ``limits``, to pass to uvicorn as ``http``."""
    return type("LimitedProtocol", (LimitedProtocol,), {"limits": limits})


def _peer(connection: Any) -> str:
    client, server = connection.client, connection.server
    return peer_of(client[0] if client else "?", server[0] if server else "")


@lru_cache(maxsize=4)
def limited_websocket(body_s: float, base: Any) -> type[Any]:
    """Return uvicorn's websocket protocol class ``base`` with an end to connections whose client does not read.

    uvicorn's pings end such a connection too, but it stays open until the client has read everything that was sent.
    """

    class LimitedWebSocket(_WriteWatch, base):  # type: ignore[misc]
        """A websocket that is aborted if its client reads nothing, or does not close it, for ``body_s``."""

        _closing = False
        _check: Any = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._check = self.loop.call_later(body_s / 2, self._expire)

        def connection_lost(self, exc: Exception | None) -> None:
            self._check.cancel()
            super().connection_lost(exc)

        def _expire(self) -> None:
            blocked = self._blocked_since is not None and time.monotonic() - self._blocked_since >= body_s
            if blocked or self._closing:
                self.transport.abort()
                return
            self._closing = self.transport.is_closing()
            self._check = self.loop.call_later(body_s / 2, self._expire)

    return LimitedWebSocket


UNSENT_MESSAGES, UNSENT_BYTES = 1000, 1 << 26
"""Most messages, and most characters in them, that may wait for a client; it reads 25 a second on the page Live."""


async def drop_slow_clients(server: Any, most: int = UNSENT_MESSAGES, most_bytes: int = UNSENT_BYTES) -> None:
    """End the connections of an Engine.IO server for which more messages wait; a browser connects anew.

    A client that reads less than it is sent, or never asks for its messages, stays connected as long as it answers
    pings, and Engine.IO's queue of messages for it has no limit.
    """
    for connection in list(server.sockets.values()):
        waiting = connection.queue
        size = sum(len(packet.data or "") for packet in waiting._queue if packet is not None)
        if connection.closed or (waiting.qsize() <= most and size <= most_bytes):
            continue
        await connection.close(wait=False, abort=True)
        while not waiting.empty():
            waiting.get_nowait()
            waiting.task_done()
        waiting.put_nowait(None)  # ends the writer
