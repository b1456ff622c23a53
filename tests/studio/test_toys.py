"""Toys are found in the background, chosen with care, and tested in a second."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DeviceError
from plushsense.devices import base
from plushsense.devices.opening import DeviceListing, list_devices
from plushsense.studio.app import toys as room
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.workspace import Workspace


@pytest.fixture
def toys(tmp_path: Path) -> Toys:
    return Toys(Workspace(tmp_path / "home", devices=("replay:///given.csv",), toy="virtual://?person=2", speed=20.0))


def test_looking_does_not_wait_and_rings(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    looks, may_look = list[tuple[float, bool]](), threading.Event()

    def later(scan_s: float, network: bool) -> DeviceListing:
        looks.append((scan_s, network))
        assert may_look.wait(30)
        return list_devices(scan_s, network=network)

    monkeypatch.setattr(room, "list_devices", later)
    # Both return although nothing may be found yet, and the second joins the first.
    toys.search(0.2, network=False)
    toys.search(0.2)
    assert toys.searching and not toys.searched
    may_look.set()
    end = time.monotonic() + 30
    while toys.searching or not toys.searched:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert [d.kind for d in toys.listing.devices][-1] == "virtual"
    assert looks == [(0.2, False)]


@pytest.mark.parametrize(
    "url",
    [
        "",
        "http://x",
        "/etc/passwd",
        "replay:///etc/passwd",
        "replay://../../secret.csv",
        "virtual://?layout=/etc/passwd",
        "virtual://?layout=../../x.toml",
        "tcp://host:1?layout",
    ],
)
def test_addresses_that_no_toy_can_have_are_refused(toys: Toys, url: str) -> None:
    with pytest.raises(ConfigError):
        toys.choose(url)


def test_a_toy_named_at_start_may_lie_anywhere(toys: Toys) -> None:
    assert toys.choose("replay:///given.csv") == "replay:///given.csv"
    assert toys.choose(" virtual://?layout=plush-14 ") == "virtual://?layout=plush-14"


class Clock:
    """A clock that only sleeping moves, in place of the module `time`: a machine that stands still changes no rate."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    perf_counter = monotonic

    def time_ns(self) -> int:
        return round(1e9 * self.now_s)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_the_virtual_toy_passes(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    for module in (room, base):
        monkeypatch.setattr(module, "time", clock)
    done = toys.test()
    assert done.fits and done.on_time
    assert done.layout == "plush-15"
    assert done.frames > 1000
    assert 15.0 < done.seconds < 30.0


def test_a_toy_of_another_layout_does_not_fit(toys: Toys, server: Callable[[bytes], str]) -> None:
    with pytest.raises(DeviceError, match=r"lines that are not of the layout plush-15"):
        toys.test(server(b"1 2 3\n"))


def test_the_layout_of_another_firmware_is_found(toys: Toys, server: Callable[[bytes], str]) -> None:
    url = toys.choose(server(b" ".join([b"1"] * 13) + b" 10\n"))
    toys.try_out()
    end = time.monotonic() + 60
    while toys.trial is None or toys.trial.running:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert (toys.trial.result, toys.trial.layout) == (None, "plush-14")
    assert room.with_layout(f"{url}?layout=x&a=1", "plush-14") == f"{url}?a=1&layout=plush-14"


def test_a_slow_toy_fits_but_not_on_time(toys: Toys, server: Callable[[bytes], str]) -> None:
    done = toys.test(server(b" ".join([b"1"] * 13) + b" 100 10\n" + b"x" * 4) + "?layout=plush-15")
    assert not done.on_time or not done.fits


def test_a_silent_toy_and_none_at_all(
    toys: Toys, server: Callable[[bytes], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(room, "_TIMEOUT_S", 0.3)
    with pytest.raises(DeviceError, match=r"sent nothing for 0\.3 s"):
        toys.test(server(b""))
    with pytest.raises(DeviceError):
        toys.test("tcp://127.0.0.1:9")
    with pytest.raises(ConfigError, match="No toy is chosen"):
        Toys(Workspace(Path("nowhere"))).test()
