"""The virtual toy as a byte stream for other programs: over TCP and on a pseudo terminal."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.core.layouts import load_layout
from plushsense.devices.base import Device, ReconnectingDevice
from plushsense.devices.opening import open_device
from plushsense.devices.virtual import server
from plushsense.devices.virtual.faults import Fault
from plushsense.devices.virtual.scenario import ScenarioPart, ToyScenario
from plushsense.devices.virtual.server import ToyCounters, ToyServer
from plushsense.devices.virtual.stream import PerformedGesture, ToySpec, VirtualDevice

needs_pty = pytest.mark.usefixtures("pty_possible")


class Running:
    """A toy in a thread."""

    def __init__(self) -> None:
        self.url = ""
        self.performed: list[PerformedGesture] = []
        self.counters: ToyCounters | None = None


@contextmanager
def toy(serve: Callable[[ToyServer], ToyCounters], *args: Any, **options: Any) -> Iterator[Running]:
    running, ready, stop = Running(), threading.Event(), threading.Event()

    def on_ready(url: str) -> None:
        running.url = url
        ready.set()

    def work() -> None:
        running.counters = serve(
            ToyServer(*args, on_ready=on_ready, on_performed=running.performed.append, stop=stop, **options)
        )

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    assert ready.wait(5)
    try:
        yield running
    finally:
        stop.set()
        thread.join(5)
        assert not thread.is_alive()


def over_tcp(server: ToyServer) -> ToyCounters:
    return server.serve_tcp(0)


def test_tcp_serves_every_line_and_the_truth() -> None:
    spec = ToySpec(person=3, lost=0.0, garbled=0.0, gestures=("Tail hit 1", "Hold strong"))
    with toy(over_tcp, spec, speed=0, seconds=60) as running:
        with open_device(running.url) as device:
            frames = list(device)
        assert device.counters.to_dict() | {"garbage": 0} == {
            "frames": len(frames), "lost": 0, "malformed": 0, "garbage": 0, "reconnects": 0,
        }  # fmt: skip
    assert len(frames) == pytest.approx(6000, rel=0.01)
    assert [p.label for p in running.performed[:4]] == ["Tail hit 1", "Hold strong"] * 2
    assert running.counters is not None
    assert (running.counters.sent, running.counters.dropped) == (len(frames), 0)
    # The truth fits the stream: in a hug the belly feels far more than before it.
    hug = running.performed[1]
    belly = {f.device_ms: f.values[9] for f in frames}
    inside = [v for t, v in belly.items() if hug.start_ms + 600 < t < hug.end_ms - 600]
    outside = [v for t, v in belly.items() if t < running.performed[0].start_ms - 1000]
    assert min(inside) > 2 * max(outside)


@pytest.mark.slow
def test_tcp_counts_what_the_line_loses() -> None:
    with (
        toy(over_tcp, ToySpec(lost=0.02, garbled=0.02), speed=0, seconds=120) as running,
        open_device(running.url) as device,
    ):
        for _ in device:
            pass
    counters = device.counters
    assert counters.frames == pytest.approx(12_000 * 0.96, rel=0.02)
    assert 150 < counters.malformed < 350
    assert counters.frames + counters.lost == pytest.approx(12_000, abs=40)


def test_a_toy_as_fast_as_its_reader_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    # A toy in real time drops lines after this time.
    monkeypatch.setattr(server, "_STALL_S", 0.0)
    flood = scenario_with(Fault("flood", 0.0, 9.0, times=100))
    with toy(over_tcp, flood, speed=0) as running, socket.socket() as reader:
        reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        reader.connect(("127.0.0.1", int(running.url.rpartition(":")[2])))
        lines = sum(data.count(b"\n") for data in iter(lambda: reader.recv(4096), b""))
    assert running.counters is not None and running.counters.dropped == 0
    assert running.counters.sent == lines > 10_000


def test_one_reader_after_another() -> None:
    with toy(over_tcp, speed=20) as running:
        last = 0
        for _ in range(3):
            with open_device(running.url) as device:
                iterator = iter(device)
                now = [next(iterator).device_ms for _ in range(50)][-1]
            assert now > last
            last = now
            time.sleep(0.05)
    assert running.counters is not None and running.counters.connections == 3


def test_pace_does_not_drift() -> None:
    with (
        toy(over_tcp, ToySpec(lost=0.0, garbled=0.0), speed=5) as running,
        open_device(running.url) as device,
    ):
        iterator = iter(device)
        for _ in range(20):
            first = next(iterator)
        start = time.monotonic()
        # What drifts goes on drifting; a busy machine that stopped us for a moment does not.
        for until in range(3, 20):
            while time.monotonic() - start < until / 2:
                frame = next(iterator)
            said, passed = (frame.device_ms - first.device_ms) / 1000.0, time.monotonic() - start
            if said == pytest.approx(5 * passed, rel=0.04):
                break
    assert said == pytest.approx(5 * passed, rel=0.04)


def test_a_taken_port_is_one_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceError, match=f"port {port}"):
            ToyServer().serve_tcp(port)
    with pytest.raises(ConfigError, match="65535"):
        ToyServer().serve_tcp(70_000)
    for speed in (-1, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match="speed"):
            ToyServer(speed=speed).serve_tcp(0)


def test_a_broken_connection() -> None:
    import struct

    with socket.create_server(("127.0.0.1", 0)) as server:
        with open_device(f"tcp://127.0.0.1:{server.getsockname()[1]}") as device:
            peer, _ = server.accept()
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()  # with no time to linger: a reset
            with pytest.raises(DeviceError, match="went away"):
                list(device)
        with open_device(f"tcp://127.0.0.1:{server.getsockname()[1]}") as device:
            peer, _ = server.accept()
            peer.sendall(b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n1 2 3")
            peer.close()
            assert len(list(device)) == 1
            assert device.counters.malformed == 1


@needs_pty
def test_pty_with_two_readers_in_turn() -> None:
    with toy(ToyServer.serve_pty, ToySpec(lost=0.0, garbled=0.0), speed=10) as running:
        assert running.url.startswith("serial:///")
        for _ in range(2):
            with open_device(running.url + "?baud=115200") as device:
                for count, _frame in enumerate(device, 1):
                    if count >= 400:
                        break
            counters = device.counters
            assert counters.frames == pytest.approx(400, abs=60)
            # Half a line at the start is all that may go wrong.
            assert counters.malformed <= 1
            assert counters.lost <= 60
            time.sleep(0.05)


@needs_pty
def test_a_second_reader_of_a_serial_port_is_refused() -> None:
    with (
        toy(ToyServer.serve_pty, speed=1) as running,
        open_device(running.url),
        pytest.raises(DeviceError, match="another program is using"),
    ):
        open_device(running.url)


@needs_pty
def test_an_unplugged_toy_is_one_sentence() -> None:
    import pty
    import tty

    master, slave = pty.openpty()
    tty.setraw(slave)
    with open_device(f"serial://{os.ttyname(slave)}") as device:
        os.write(master, b"half\n" + b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n" * 3)
        iterator = iter(device)
        assert [next(iterator).device_ms for _ in range(3)] == [1000] * 3
        os.close(slave)
        os.close(master)
        with pytest.raises(DeviceError, match="unplugged"):
            for _ in iterator:
                pass


@needs_pty
def test_pty_speed_must_be_above_zero() -> None:
    with pytest.raises(ConfigError, match="above 0"):
        ToyServer(speed=0).serve_pty()


def test_windows_has_no_pty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(DeviceError, match="toy --tcp"):
        ToyServer().serve_pty()


FAULTS = (
    Fault("stall", 0.5, 0.5),
    Fault("torn", 1.0, 0.5, share=0.5),
    Fault("flood", 2.0, 0.2, times=5),
    Fault("junk", 2.5, 0.5),
    Fault("reset", 4.0, 0.3),
    Fault("unended", 5.0, 0.2, bytes=3000),
)
BREAK = Fault("disconnect", 6.0, 0.5)


def scenario_with(*faults: Fault) -> ToySpec:
    parts = (ScenarioPart("perform", 4, gestures=("Tail hit 1",)), ScenarioPart("perform", 9, gestures=("Tail pull",)))
    return ToySpec.of(ToyScenario(parts, seed=6, wrap_s=2.2, faults=faults))


def all_of(device: Device) -> list[tuple[int, tuple[int, ...]]]:
    return [(frame.device_ms, frame.values) for frame in device]


def in_process(spec: ToySpec) -> tuple[list[tuple[int, tuple[int, ...]]], list[PerformedGesture], dict[str, int]]:
    with VirtualDevice("virtual://", load_layout("plush-15"), spec, speed=0.0) as device:
        return all_of(device), device.performed, device.counters.to_dict()


def test_a_scenario_over_tcp_is_the_one_in_this_process() -> None:
    spec = scenario_with(*FAULTS)
    frames, made, counters = in_process(spec)
    assert counters["malformed"] > 60 and [g.person for g in made] == [4, 9]
    with toy(over_tcp, spec, speed=0) as running, open_device(running.url) as device:
        assert all_of(device) == frames
        assert device.counters.to_dict() == counters
    assert running.performed == made


def test_a_scenario_over_tcp_begins_with_its_reader() -> None:
    spec = scenario_with()
    with toy(over_tcp, spec, speed=1000) as running, open_device(running.url) as device:
        first = next(iter(device))
    assert (first.device_ms, first.values) == in_process(spec)[0][0]


@needs_pty
def test_a_scenario_over_a_serial_port_is_the_one_in_this_process() -> None:
    spec = scenario_with(*FAULTS)
    frames, made, counters = in_process(spec)
    got: list[tuple[int, tuple[int, ...]]] = []
    with toy(ToyServer.serve_pty, spec, speed=20) as running, open_device(running.url) as device:
        with pytest.raises(DeviceError, match="unplugged"):  # at the end of the toy
            for frame in device:
                got.append((frame.device_ms, frame.values))
        # The first lines may have been sent before, and the last ones been on their way when the port closed.
        first = frames.index(got[0])
        assert got == frames[first : first + len(got)]
        assert len(got) > len(frames) - 50
        assert device.counters.to_dict() == counters | {"frames": len(got)}
    assert running.performed == made
    assert running.counters is not None and running.counters.dropped == 0


def test_a_scenario_breaks_a_connection_and_takes_it_up_again() -> None:
    spec = scenario_with(*FAULTS, BREAK)
    with toy(over_tcp, spec, speed=0) as running, open_device(running.url, reconnect=True) as device:
        got: list[tuple[int, tuple[int, ...]]] = []
        assert isinstance(device, ReconnectingDevice)
        while running.counters is None or not device.counters.reconnects or device.state == "connected":
            got += [(frame.device_ms, frame.values) for frame in device.read() or []]
        assert device.counters.reconnects == 1
    expected = in_process(scenario_with(*FAULTS))[0]
    first = next(n for n, pair in enumerate(expected) if n >= len(got) or pair != got[n])
    assert got == expected[:first] + expected[first + 50 :], "half a second is missing"
    assert running.counters is not None and running.counters.connections == 2


def test_nobody_listens_any_more_when_a_reader_sees_the_end() -> None:
    refused = []

    class Reader:
        def close(self) -> None:
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((server.HOST, port.port), timeout=60)
            refused.append(True)

    port = server._TcpPort(ToyServer(), 0)
    port.open()
    port.client = Reader()  # type: ignore[assignment]
    port.disconnect()
    assert refused == [True]


@needs_pty
def test_a_scenario_unplugs_a_serial_port() -> None:
    with (
        toy(ToyServer.serve_pty, scenario_with(BREAK), speed=20) as running,
        open_device(running.url) as device,
        pytest.raises(DeviceError, match="unplugged"),
    ):
        for frame in device:
            last = frame
    assert running.url.startswith("serial://")
    before = [ms for ms, _ in in_process(scenario_with())[0]].index(last.device_ms)
    assert 400 < before <= 600, "it breaks off after 6 s"
