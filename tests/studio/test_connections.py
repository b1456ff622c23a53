"""Connections that ask for nothing are bounded, and the studio has files left to record with."""

from __future__ import annotations

import contextlib
import http.client
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from plushsense.core.recorder_csv import STREAM_NAME
from plushsense.studio.app import connections
from plushsense.studio.app.connections import ConnectionLimits, drop_slow_clients, limited_protocol, peer_of
from plushsense.studio.app.guard import Guard, Visitors
from support.browsing import connected
from support.recording_pages import CALM, begun, files, showing, start_recording, stop, take
from support.waiting import until

Fixture = Callable[..., Any]
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: "
WHOLE = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
WAIT_S = 60.0
OPEN_FILES = 256
"""The soft limit of macOS."""


@pytest.mark.parametrize(
    ("client", "server", "peer"),
    [
        ("127.0.0.1", "127.0.0.1", ""),
        ("127.3.2.1", "127.0.0.1", ""),
        ("::1", "::1", ""),
        ("::ffff:127.0.0.1", "::ffff:127.0.0.1", ""),
        ("192.168.1.5", "192.168.1.5", ""),
        ("192.168.1.6", "192.168.1.5", "192.168.1.6"),
        ("::ffff:192.168.1.6", "::ffff:192.168.1.5", "192.168.1.6"),
        ("2001:db8:1:2:3::4", "2001:db8:1:2::1", "2001:db8:1:2::/64"),
        ("fe80::5%eth0", "fe80::1%eth0", "fe80::/64"),
        ("?", "", "?"),
    ],
)
def test_peers(client: str, server: str, peer: str) -> None:
    assert peer_of(client, server) == peer


def test_limits_leave_files_for_everything_else() -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        for files, total, per_peer, backlog in ((256, 64, 32, 32), (400, 100, 32, 50), (64, 16, 8, 8)):
            resource.setrlimit(resource.RLIMIT_NOFILE, (files, before[1]))
            limits = ConnectionLimits.of_process()
            assert (limits.total, limits.per_peer, limits.backlog) == (total, per_peer, backlog)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


# A server of this process ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def serving(limits: ConnectionLimits, app: Any) -> Iterator[int]:
    """Serve ``app`` behind the guard with these limits; its port."""
    uvicorn = pytest.importorskip("uvicorn")
    visitors = Visitors("127.0.0.1")
    with socket.create_server(("0.0.0.0", 0)) as reader:
        config = uvicorn.Config(
            Guard(app, visitors),
            http=limited_protocol(limits),
            ws="wsproto",  # NiceGUI's choice
            lifespan="off",
            log_level="error",
            timeout_keep_alive=limits.keep_alive_s,
            backlog=limits.backlog,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [reader]}, daemon=True)
        thread.start()
        try:
            until(lambda: server.started, WAIT_S)
            yield int(reader.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(WAIT_S)


async def length(scope: Any, receive: Any, send: Any) -> None:
    """Answer with the length of the body; ``/wait`` only when the client has gone; ``/much`` with 32 MB."""
    if scope["path"] == "/much":
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(512):
            await send({"type": "http.response.body", "body": bytes(65536), "more_body": True})
        await send({"type": "http.response.body", "body": b""})
        return
    body, more = b"", True
    while more or scope["path"] == "/wait":
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        body += message["body"]
        more = message["more_body"]
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": str(len(body)).encode()})


def connect(stack: contextlib.ExitStack, port: int, data: bytes, source: str = "127.0.0.1") -> socket.socket:
    made = stack.enter_context(socket.create_connection(("127.0.0.1", port), WAIT_S, (source, 0)))
    made.sendall(data)
    return made


def ended(connection: socket.socket) -> bool:
    """Wait until the server has closed the connection; whether it did so without an answer."""
    try:
        return connection.recv(65536) == b""
    except ConnectionError:
        return True


def answered(connection: socket.socket) -> bool:
    """Read the whole answer, which may come in pieces."""
    answer = b""
    while not answer.endswith(b"\r\n0\r\n\r\n") and (data := connection.recv(65536)):
        answer += data
    return answer.startswith(b"HTTP/1.1 200")


def is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


@pytest.mark.parametrize("data", [b"", HALF, WHOLE], ids=["nothing", "half a head", "an answered request"])
def test_a_head_that_does_not_arrive_ends_the_connection(data: bytes) -> None:
    with serving(ConnectionLimits(head_s=0.5, keep_alive_s=600), length) as port, contextlib.ExitStack() as stack:
        connection = connect(stack, port, data)
        assert data != WHOLE or answered(connection)
        assert ended(connection)


def test_a_head_that_comes_a_byte_at_a_time_is_no_excuse() -> None:
    with serving(ConnectionLimits(head_s=0.5), length) as port, contextlib.ExitStack() as stack:
        connection, limit = connect(stack, port, HALF), time.monotonic() + WAIT_S
        connection.settimeout(0.05)
        while True:
            assert time.monotonic() < limit
            with contextlib.suppress(TimeoutError):
                try:
                    connection.sendall(b"x")
                    assert connection.recv(1) == b""
                except ConnectionError:
                    pass
                break


def test_a_body_that_does_not_arrive_ends_the_connection_and_one_that_does_is_read() -> None:
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 12\r\n\r\n"
    limits = ConnectionLimits(head_s=2.0, body_s=4.0)
    with serving(limits, length) as port, contextlib.ExitStack() as stack:
        assert ended(connect(stack, port, head + b"x"))
        slow, start = connect(stack, port, head), time.monotonic()
        slow.settimeout(0.5)
        # Longer than either limit, but never without data for long.
        for _ in range(12):
            with contextlib.suppress(TimeoutError):
                assert slow.recv(65536).startswith(b"HTTP/1.1 200"), "ended too soon"
                break
            slow.sendall(b"x")
        slow.settimeout(WAIT_S)
        assert answered(slow)
        assert time.monotonic() - start > limits.body_s


def test_an_answer_that_is_not_read_ends_the_connection_and_one_that_is_read_slowly_does_not() -> None:
    request = b"GET /much HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    with serving(ConnectionLimits(head_s=0.1, body_s=0.5), length) as port, contextlib.ExitStack() as stack:
        lazy, slow = connect(stack, port, request), connect(stack, port, request)
        received = 0
        for _ in range(8):
            time.sleep(0.2)
            while received % 4_000_000 < 3_900_000 and (data := slow.recv(100_000)):
                received += len(data)
            received += len(slow.recv(200_000))
        while data := slow.recv(1_000_000):
            received += len(data)
        assert received > 512 * 65536
        left = 0
        with contextlib.suppress(ConnectionError):
            while data := lazy.recv(1_000_000):
                left += len(data)
        assert left < 512 * 65536


def test_a_new_connection_takes_the_place_of_the_one_that_waits_longest() -> None:
    with serving(ConnectionLimits(per_peer=4, head_s=600), length) as port, contextlib.ExitStack() as stack:
        busy = [connect(stack, port, b"GET /wait HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") for _ in range(2)]
        idle = [connect(stack, port, WHOLE)]
        assert answered(idle[0])
        idle.append(connect(stack, port, WHOLE))
        assert answered(idle[1])
        for n in range(4):
            idle.append(connect(stack, port, WHOLE))
            assert answered(idle[-1])
            assert ended(idle[n])
        # Where all are being answered, nobody is sent away for a newcomer.
        busy += [connect(stack, port, b"GET /wait HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") for _ in range(2)]
        assert ended(idle[4]) and ended(idle[5])
        assert ended(connect(stack, port, WHOLE))
        busy.pop().close()

        def room() -> bool:
            with contextlib.suppress(ConnectionError):
                return answered(connect(stack, port, WHOLE))
            return False

        until(room, WAIT_S)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has all addresses of 127.0.0.0/8")
def test_peers_share_what_this_machine_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "peer_of", lambda client, _server: "" if client == "127.0.0.1" else client)
    wait = b"GET /wait HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    limits = ConnectionLimits(total=8, per_peer=3, head_s=600)
    with serving(limits, length) as port, contextlib.ExitStack() as stack:
        for peer in (2, 2, 2, 3, 3):
            connect(stack, port, wait, f"127.0.0.{peer}")
        for peer in (2, 3, 4):
            assert ended(connect(stack, port, WHOLE, f"127.0.0.{peer}"))
        for _ in range(2):
            connect(stack, port, wait)
        assert answered(connect(stack, port, WHOLE))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has all addresses of 127.0.0.0/8")
def test_two_hundred_clients_are_all_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each address asks and keeps its connection: no more than the limit stay open, and this computer is answered."""
    monkeypatch.setattr(connections, "peer_of", lambda client, _server: "" if client == "127.0.0.1" else client)
    limits = ConnectionLimits(total=40, per_peer=8, head_s=600, keep_alive_s=600)
    with serving(limits, length) as port, contextlib.ExitStack() as stack:
        clients = []
        for peer in range(2, 202):
            clients.append(connect(stack, port, WHOLE, f"127.0.0.{peer}"))
            assert answered(clients[-1])
        assert answered(connect(stack, port, WHOLE))
        kept = limits.total - limits.per_peer
        assert [is_open(client) for client in clients] == [False] * (200 - kept) + [True] * kept


# Websockets --------------------------------------------------------------------------------------------------------

UPGRADE = (
    b"Host: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def upgraded(stack: contextlib.ExitStack, port: int, path: str = "/") -> socket.socket:
    """Return a websocket that has read the answer to its upgrade, and has little room for more."""
    made = stack.enter_context(socket.socket())
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    made.settimeout(WAIT_S)
    made.connect(("127.0.0.1", port))
    made.sendall(f"GET {path} HTTP/1.1\r\n".encode() + UPGRADE)
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += made.recv(1)
    assert answer.startswith(b"HTTP/1.1 101")
    return made


def say(websocket: socket.socket, text: str) -> bool:
    """Send a message of up to 125 characters; whether the connection is still there."""
    data = text.encode()
    try:
        websocket.sendall(bytes([0x81, 0x80 | len(data), 0, 0, 0, 0]) + data)
    except ConnectionError:
        return False
    return True


def test_a_websocket_that_reads_nothing_is_ended_and_one_that_reads_slowly_is_not() -> None:
    from uvicorn.protocols.utils import ClientDisconnected

    sent, ends = {"/lazy": 0, "/slow": 0}, dict[str, str]()

    async def stream(scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        try:
            while sent[scope["path"]] < 256:
                await send({"type": "websocket.send", "bytes": bytes(65536)})
                sent[scope["path"]] += 1
            ends[scope["path"]] = "sent"
        except ClientDisconnected:
            ends[scope["path"]] = "gone"

    with serving(ConnectionLimits(body_s=1.0), stream) as port, contextlib.ExitStack() as stack:
        lazy, slow = upgraded(stack, port, "/lazy"), upgraded(stack, port, "/slow")
        received, begun = 0, time.monotonic()
        while "/lazy" not in ends:
            assert time.monotonic() - begun < WAIT_S
            say(lazy, "3")
            received += len(slow.recv(65536))
        assert ends["/lazy"] == "gone" and sent["/lazy"] < 256
        until(lambda: not say(lazy, "3"), WAIT_S)
        while "/slow" not in ends:
            received += len(slow.recv(1 << 20))
        assert ends["/slow"] == "sent"


def test_messages_do_not_pile_up_for_a_client_that_answers_pings_and_reads_too_little() -> None:
    """Both transports: a websocket that is not read, and a client that only posts and never asks for its messages."""
    socketio = pytest.importorskip("socketio")
    server = socketio.AsyncServer(async_mode="asgi", cors_allowed_origins="*")
    largest, seen = dict[str, int](), set[str]()
    left: list[str] = []
    server.on("disconnect", lambda sid, *_: left.append(sid))
    stop = threading.Event()

    async def send(sid: str) -> None:
        while sid not in left and not stop.is_set():
            await server.emit("update", "x" * 20_000, to=sid)
            largest[sid] = max(largest.get(sid, 0), *(c.queue.qsize() for c in server.eio.sockets.values()), 0)
            await server.sleep(0)

    async def watch() -> None:
        while not stop.is_set():
            await drop_slow_clients(server.eio, most=300)
            await server.sleep(0.02)

    @server.on("connect")
    async def begin(sid: str, *_: Any) -> None:
        seen.add(sid)
        if len(seen) == 1:
            server.start_background_task(watch)
        server.start_background_task(send, sid)

    path = "/socket.io/?EIO=4&transport="
    with serving(ConnectionLimits(body_s=1.0), socketio.ASGIApp(server)) as port, contextlib.ExitStack() as stack:
        try:
            lazy = upgraded(stack, port, f"{path}websocket")
            say(lazy, "40")
            until(lambda: len(left) == 1, WAIT_S)
            until(lambda: not say(lazy, "3"), WAIT_S)
            poller = stack.enter_context(
                contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S))
            )
            poller.request("GET", f"{path}polling")
            identity = re.search(r'"sid":"([^"]+)"', poller.getresponse().read().decode())
            assert identity is not None
            poller.request("POST", f"{path}polling&sid={identity[1]}", "40")
            assert poller.getresponse().read() is not None
            until(lambda: len(left) == 2, WAIT_S)
        finally:
            stop.set()
    assert len(seen) == 2 and seen == set(left)
    # The client may be dropped before the message that was one too many is counted here.
    assert all(300 <= most < 30_000 for most in largest.values())


# Against the real server ------------------------------------------------------------------------------------------


def flood(stack: contextlib.ExitStack, port: int, count: int) -> None:
    """Send this many halves of requests; those that the studio ends at once have been sent, too."""

    def send(_: int) -> None:
        with contextlib.suppress(ConnectionError):
            connect(stack, port, HALF)

    # Side by side: a connection beyond the backlog waits for a second.
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(send, range(count)))


def status(port: int, **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    with contextlib.closing(connection):
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on open files")
def test_half_requests_of_a_stranger_end_no_recording(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    """More halves of requests than the studio may open files: the recording is saved, and a visitor is answered."""
    import resource

    home, count = tmp_path / "home", OPEN_FILES + 64
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(before[0], min(4096, before[1])), before[1]))
    try:
        options = ("--host", "0.0.0.0", "--device", CALM, "--speed", "2")
        server, browser = studio(*options, open_files=OPEN_FILES), look()
        at = f"http://127.0.0.1:{server.port}"
        page = browser.open(f"{at}/?{urlsplit(server.url).query}")
        page = begun(page, at, "S01")
        take(page, 0, 0.8)
        with contextlib.ExitStack() as stack:
            assert start_recording(page, 1)
            flood(stack, server.port, count)
            stop(page)
            showing(page, "idle.2.2.")
            assert status(server.port) == 401
            flood(stack, server.port, count)
            take(page, 2, 0.8)
            second = browser.context.new_page()
            second.goto(at)
            connected(second)
            take(page, 3, 0.8)
            showing(page, "finished.")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    folder = home / "recordings" / "S01" / "1"
    stream = (folder / STREAM_NAME).read_text("utf-8").splitlines()
    kept = files(home)
    assert [k["gaps"] for k in kept] == [[]] * 4
    for beside in kept:
        rows = (folder / beside["file"]).read_text("utf-8").splitlines()[1:]
        assert len(rows) == beside["rows"] > 0
        assert rows == stream[beside["stream_row"] : beside["stream_row"] + len(rows)]
        assert re.search(rf"_{len(rows)}\.csv$", beside["file"])
    assert browser.complaints == []
