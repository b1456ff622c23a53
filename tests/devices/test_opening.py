"""Device URLs: what is accepted, and one clear sentence for everything else."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DeviceError, LayoutError, PlushSenseError
from plushsense.core.layouts import load_layout
from plushsense.devices.opening import SCHEMES, open_device, parse_url


@pytest.mark.parametrize(
    ("url", "scheme", "place", "query"),
    [
        ("serial:///dev/ttyUSB0?baud=115200", "serial", "/dev/ttyUSB0", {"baud": "115200"}),
        ("serial://COM3", "serial", "COM3", {}),
        ("tcp://127.0.0.1:5005", "tcp", "127.0.0.1:5005", {}),
        ("replay:///a/b.csv?speed=2&layout=accel-3", "replay", "/a/b.csv", {"speed": "2", "layout": "accel-3"}),
        ("replay:///C:/x.csv", "replay", "/C:/x.csv", {}),
        ("replay:some/b.csv", "replay", "some/b.csv", {}),
        ("virtual://?person=7&seed=1", "virtual", "", {"person": "7", "seed": "1"}),
        ("virtual://?gestures=Tail%20hit+1", "virtual", "", {"gestures": "Tail hit 1"}),
        ("some/where/b.csv?speed=0", "replay", "some/where/b.csv", {"speed": "0"}),
        ("C:\\data\\x.csv", "replay", "C:\\data\\x.csv", {}),
        ("C:/data/x.csv", "replay", "C:/data/x.csv", {}),
        ("TCP://host:1", "tcp", "host:1", {}),
    ],
)
def test_urls(url: str, scheme: str, place: str, query: dict[str, str]) -> None:
    address = parse_url(url)
    assert (address.scheme, address.place, address.query) == (scheme, place, query)


@pytest.mark.parametrize(
    ("url", "error", "words"),
    [
        ("", ConfigError, ["accepted"]),
        ("virtal://", ConfigError, ["virtal", "Did you mean 'virtual'"]),
        ("http://x/y", ConfigError, ["http", "serial", "replay"]),
        ("virtual://?persn=7", ConfigError, ["persn", "Did you mean 'person'"]),
        ("virtual://?person=seven", ConfigError, ["person", "seven", "whole number"]),
        ("virtual://?person=-1", ConfigError, ["person"]),
        ("virtual://?speed=fast", ConfigError, ["speed", "fast", "number"]),
        ("virtual://?speed=-1", ConfigError, ["speed"]),
        ("virtual://?speed=nan", ConfigError, ["speed"]),
        ("virtual://?person", ConfigError, ["key=value"]),
        ("virtual://?person=1&person=2", ConfigError, ["twice"]),
        ("virtual://?lost=2", ConfigError, ["lost"]),
        ("virtual://?gestures=Tail+hitt+1", ConfigError, ["Did you mean 'Tail hit 1'"]),
        ("virtual://?layout=plush-51", LayoutError, ["plush-51", "plush-15"]),
        ("virtual://?layout=phone-6", ConfigError, ["x_acc", "phone-6"]),
        ("tcp://localhost", DeviceError, ["tcp://host:port"]),
        ("tcp://localhost:99999", DeviceError, ["port"]),
        ("tcp://localhost:1?speed=2", ConfigError, ["speed"]),
        ("serial://", DeviceError, ["names no port"]),
        ("serial:///dev/no-such-port", DeviceError, ["/dev/no-such-port", "port"]),
        ("serial:///dev/no-such-port?baud=quick", ConfigError, ["baud"]),
        ("replay:///no/such/file.csv", DeviceError, ["no file", "/no/such/file.csv"]),
        ("no-such-file.csv", DeviceError, ["no file"]),
        ("replay://", DeviceError, ["no file"]),
    ],
)
def test_refusals_are_one_sentence(url: str, error: type[PlushSenseError], words: list[str]) -> None:
    with pytest.raises(error) as caught:
        open_device(url)
    message = str(caught.value)
    assert "\n" not in message and "Traceback" not in message
    assert message.rstrip().endswith((".", "?"))
    for word in words:
        assert word in message


def test_refused_connection() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match=f"nobody listens on port {port}"):
        open_device(f"tcp://127.0.0.1:{port}")


def test_layout_in_the_url_wins() -> None:
    with open_device("virtual://?layout=plush-14&speed=0", "plush-15") as device:
        assert device.layout.name == "plush-14"
    with open_device("virtual://?speed=0", load_layout("plush-14")) as device:
        assert device.layout.name == "plush-14"
    with open_device("virtual://?speed=0") as device:
        assert device.layout.name == "plush-15"


def test_own_layout_by_path(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "src/plushsense/core/data/layouts/accel-3.toml"
    own = tmp_path / "mine.toml"
    own.write_text(source.read_text(encoding="utf-8").replace('name = "accel-3"', 'name = "mine"'), encoding="utf-8")
    with open_device(f"virtual://?speed=0&layout={own}") as device:
        assert device.layout.name == "mine"
        assert len(next(iter(device)).values) == 3


def test_every_scheme_has_a_function_of_its_own() -> None:
    import importlib

    assert len(set(SCHEMES.values())) == len(SCHEMES)
    for opener in SCHEMES.values():
        module, function = opener.split(":")
        assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize("port", ["/dev/ttyUSB99", "COM77"])
def test_a_bare_port_is_told_its_url(port: str) -> None:
    with pytest.raises(ConfigError, match=f"write serial://{port}"):
        parse_url(port)
