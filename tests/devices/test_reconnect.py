"""A toy that goes away and comes back: counters go on, the gap is kept, nobody waits longer than a moment."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.core.layouts import load_layout
from plushsense.devices.base import Device, Frame, ReconnectingDevice
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import ToySpec

PLUSH = load_layout("plush-15")
CLEAN = ToySpec(lost=0.0, garbled=0.0)
needs_pty = pytest.mark.usefixtures("pty_possible")


def line(device_ms: int) -> bytes:
    return b"1 2 3 4 5 6 7 8 9 10 11 12 13 %d 10\n" % device_ms


def opened(url: str, **options: float) -> ReconnectingDevice:
    device = open_device(url, reconnect=True, reconnect_s=options.get("for_s"))
    assert isinstance(device, ReconnectingDevice)
    return device


def collect(device: Device, until: Callable[[list[Frame]], bool], patience_s: float = 10.0) -> list[Frame]:
    """Read until a condition holds; every single read must be prompt."""
    frames: list[Frame] = []
    end = time.monotonic() + patience_s
    while not until(frames):
        assert time.monotonic() < end, "it took too long"
        begun = time.monotonic()
        got = device.read()
        assert time.monotonic() - begun < 2.0  # about 0.1 s, on a busy machine
        assert got is not None
        frames += got
    return frames


class Gone(Device):
    """A toy that is away after its first frame."""

    def read(self) -> list[Frame] | None:
        if self.counters.frames:
            raise DeviceError("'x' went away.")
        self.counters.frames = 1
        return [Frame(0, 0, (0,) * PLUSH.n_channels)]


def test_one_that_went_away_is_closed_before_it_is_opened_again() -> None:
    """Its port is locked for others as long as it is open, for ourselves, too."""
    made: list[Device] = []

    def open_inner() -> Device:
        assert all(device.closed for device in made)
        made.append(Gone("x", PLUSH))
        return made[-1]

    with ReconnectingDevice("x", PLUSH, open_inner) as device:
        assert len(collect(device, lambda frames: len(frames) == 3)) == 3
    assert (device.counters.reconnects, len(made)) == (2, 3)
    assert all(device.closed for device in made)


@contextmanager
def tcp_toy(port: int = 0) -> Iterator[str]:
    ready, stop, url = threading.Event(), threading.Event(), [""]

    def on_ready(text: str) -> None:
        url[0] = text
        ready.set()

    thread = threading.Thread(
        target=lambda: ToyServer(CLEAN, speed=5, on_ready=on_ready, stop=stop).serve_tcp(port), daemon=True
    )
    thread.start()
    assert ready.wait(5)
    try:
        yield url[0]
    finally:
        stop.set()
        thread.join(5)


class Pty:
    """A bare pseudo terminal behind a link, as a cable that is plugged in."""

    def __init__(self, link: Path) -> None:
        import pty
        import tty

        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self.slave))

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def unplug(self) -> None:
        os.close(self.slave)
        os.close(self.master)


@needs_pty
def test_a_serial_toy_is_unplugged_and_comes_back_on_another_port(tmp_path: Path) -> None:
    link = tmp_path / "toy"
    first = Pty(link)
    with opened(f"serial://{link}") as device:
        first.send(b"half\n" + b"".join(line(t) for t in range(1000, 1100, 10)) + b"1 2 3")
        before = collect(device, lambda f: len(f) == 10)
        assert device.state == "connected" and device.gaps == []
        first.unplug()
        link.unlink()
        collect(device, lambda _: device.state == "waiting")
        (gap,) = device.gaps
        assert (gap.host_ms_begin, gap.host_ms_end) == (before[-1].host_ms, None)
        assert (gap.device_ms_before, gap.device_ms_after) == (1090, None)
        assert "unplugged" in gap.reason
        begun = time.monotonic()
        assert device.read() == []
        assert time.monotonic() - begun < 2.0
        assert device.counters.malformed == 2  # half a line at either end
        second = Pty(link)
        try:
            collect(device, lambda _: device.state == "connected")
            second.send(b"cut\n" + b"".join(line(t) for t in range(0, 50, 10)))  # the toy began anew
            after = collect(device, lambda f: len(f) == 5)
            assert device.gaps == [gap]
            assert (gap.host_ms_end, gap.device_ms_after) == (after[0].host_ms, 0)
            assert gap.to_dict()["device_ms_after"] == 0
            assert gap.host_ms_end is not None and gap.host_ms_end > gap.host_ms_begin
            assert device.counters.to_dict() == {
                "frames": 15, "lost": 0, "malformed": 3, "garbage": 0, "reconnects": 1,
            }  # fmt: skip
        finally:
            second.unplug()


def test_a_tcp_toy_is_stopped_and_started_on_its_port() -> None:
    with tcp_toy() as url:
        device = opened(url)
        collect(device, lambda f: len(f) >= 100)
    # The server closed in order: for a toy that may come back this is going away too.
    collect(device, lambda _: device.state == "waiting")
    frames = device.counters.frames
    counters = device.counters
    with tcp_toy(int(url.rpartition(":")[2])), device:
        after = collect(device, lambda f: len(f) >= 100)
        assert counters is device.counters
        assert counters.reconnects == 1
        assert counters.frames == frames + len(after)
        assert counters.lost == 0
        (gap,) = device.gaps
        assert "closed the connection" in gap.reason
        assert gap.device_ms_after == after[0].device_ms
        assert gap.host_ms_end == after[0].host_ms


def test_a_connection_that_only_opens_and_breaks_is_one_gap_and_no_storm() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with opened(url) as device:
            server.accept()[0].close()
            begun, accepted = time.monotonic(), 0
            server.settimeout(0.01)
            while accepted < 3:
                assert time.monotonic() - begun < 20
                device.read()
                try:
                    server.accept()[0].close()
                    accepted += 1
                except TimeoutError:
                    continue
            assert time.monotonic() - begun > 0.9  # the first try at once, then one every 0.5 s
            assert len(device.gaps) == 1 and device.gaps[0].host_ms_end is None


def test_it_does_not_come_back() -> None:
    with tcp_toy() as url:
        device = opened(url, for_s=0.4)
        collect(device, lambda f: len(f) >= 10)
    with pytest.raises(DeviceError, match="did not come back within 0.4 s"):
        collect(device, lambda _: False)
    assert device.closed
    assert list(device) == []


def test_the_first_opening_raises() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match="nobody listens"):
        open_device(f"tcp://127.0.0.1:{port}", reconnect=True)
    with pytest.raises(ConfigError, match="speed"):
        open_device("virtual://?speed=fast", reconnect=True)


@pytest.mark.parametrize("away", [False, True])
def test_closing_from_another_thread_ends_it(away: bool) -> None:
    with tcp_toy() as url:
        device = opened(url)
        collect(device, lambda f: len(f) >= 10)
        if not away:
            threading.Timer(0.1, device.close).start()
            begun = time.monotonic()
            for _ in device:
                pass
            assert time.monotonic() - begun < 5
    if away:
        collect(device, lambda _: device.state == "waiting")
        threading.Timer(0.1, device.close).start()
        begun = time.monotonic()
        for _ in device:
            pass
        assert time.monotonic() - begun < 5
    assert device.read() is None
    device.close()


def test_what_is_found_after_closing_is_closed_again() -> None:
    asked, let_go, made = threading.Event(), threading.Event(), []

    def slow() -> Device:
        if made:
            asked.set()
            assert let_go.wait(5)
        made.append(open_device(url))
        return made[-1]

    with tcp_toy() as url:
        device = ReconnectingDevice(url, PLUSH, slow)
        collect(device, lambda f: len(f) >= 10)
        made[0].close()  # its next read is None, which here means going away
        collect(device, lambda _: device.state == "waiting")
        assert asked.wait(5)
        device.close()
        let_go.set()
        end = time.monotonic() + 5
        while len(made) < 2 or not made[1].closed:
            assert time.monotonic() < end
            time.sleep(0.01)


def test_an_error_that_trying_again_will_not_mend_is_raised() -> None:
    calls = []

    def once() -> Device:
        calls.append(1)
        if len(calls) > 1:
            raise ConfigError("no such thing.")
        return open_device("virtual://?speed=0&seconds=1")

    device = ReconnectingDevice("virtual://", PLUSH, once)
    with pytest.raises(ConfigError, match="no such thing"):
        for _ in device:
            pass
    assert device.closed and len(calls) == 2


def test_the_end_of_what_ends_stays_the_end(tmp_path: Path) -> None:
    with opened("virtual://?speed=0&seconds=5&lost=0&garbled=0") as device:
        assert len(list(device)) == pytest.approx(500, abs=10)
        assert device.gaps == [] and device.counters.reconnects == 0
    file = tmp_path / "fulldatastream.csv"
    row = "; ".join(["1"] * 13)
    file.write_text("".join(f"{row}; {1_700_000_000_000 + t}; {t}\n" for t in range(0, 500, 10)), encoding="utf-8")
    with opened(f"replay://{file}?speed=0") as device:
        assert len(list(device)) == 50
        assert device.counters.frames == 50 and device.gaps == []
