"""What is listed can be opened; what cannot be looked at is a note."""

from __future__ import annotations

import sys
import time
import uuid

import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.devices import ble, bytestreams, opening
from plushsense.devices.lsl import LslOutlet
from plushsense.devices.opening import list_devices, open_device, parse_url


def test_the_virtual_toy_is_always_there_and_every_url_is_one() -> None:
    listing = list_devices(0.1)
    for device in listing.devices:
        assert parse_url(device.url).scheme == device.kind
    with open_device(listing.devices[-1].url) as device:
        assert len(device.read() or [0]) > 0
    assert all(note.endswith(".") and "\n" not in note for note in listing.notes)
    assert set(listing.to_dict()) == {"devices", "notes"}


def test_without_the_optional_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bleak", None)
    monkeypatch.setitem(sys.modules, "pylsl", None)
    listing = list_devices(0.1)
    assert {d.kind for d in listing.devices} <= {"serial", "virtual"}
    for what, extra in (("Bluetooth", "ble"), ("LSL", "lsl")):
        (note,) = (n for n in listing.notes if n.startswith(f"{what}: not looked at"))
        assert f"plushsense[{extra}]" in note


def test_serial_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bytestreams, "serial_ports", lambda: [("/dev/ttyUSB0", "CP2102 USB to UART"), ("COM3", "n/a")])
    found = [(d.url, d.description) for d in list_devices(0.1).devices if d.kind == "serial"]
    assert found == [("serial:///dev/ttyUSB0", "CP2102 USB to UART"), ("serial://COM3", "")]
    monkeypatch.setattr(bytestreams, "serial_ports", list)
    assert "This computer has no serial port now." in list_devices(0.1).notes


def test_what_hangs_or_breaks_hides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "_GRACE_S", 0.2)
    monkeypatch.setattr(ble, "scan", lambda *_: time.sleep(30))
    monkeypatch.setattr(bytestreams, "serial_ports", lambda: 1 / 0)
    begun = time.monotonic()
    listing = list_devices(0.1)
    assert time.monotonic() - begun < 5
    assert "Bluetooth did not answer within 0.3 s." in listing.notes
    assert "Serial ports cannot be used: division by zero." in listing.notes
    assert listing.devices[-1].kind == "virtual"


@pytest.mark.parametrize("scan_s", [0.0, -1.0, float("nan"), 1e9])
def test_times_that_are_refused(scan_s: float) -> None:
    with pytest.raises(ConfigError, match="accepted is above 0 to 600"):
        list_devices(scan_s)


@pytest.mark.usefixtures("lsl_possible")
def test_streams_by_name_or_where_that_is_not_unique_by_source() -> None:
    plush, tail = load_layout("plush-15"), uuid.uuid4().hex[:8]
    with LslOutlet(plush, f"one {tail}"), LslOutlet(plush, f"two {tail}"):
        import pylsl

        twin = pylsl.StreamOutlet(pylsl.StreamInfo(f"two {tail}", "EEG", 8, 0.0, "float32", f"amp {tail}"))
        urls = {d.url: d.description for d in list_devices(1.0).devices if tail in d.name}
        del twin
    assert f"lsl://one%20{tail}" in urls
    assert urls[f"lsl://source:amp%20{tail}"].startswith("EEG, 8 channels, 0 Hz, on ")
    assert len(urls) == 3


def test_without_the_network_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[str]()

    def search(scan_s: float) -> opening.DeviceListing:
        asked.append("x")
        return opening.DeviceListing()

    monkeypatch.setattr(
        opening, "SEARCHES", dict.fromkeys(("LSL", "Bluetooth", "Serial ports"), "support.nowhere:search")
    )
    monkeypatch.setattr(opening.pkgutil, "resolve_name", lambda name: search)
    list_devices(0.1, network=False)
    assert asked == ["x"]
    list_devices(0.1)
    assert asked == ["x"] * 4
