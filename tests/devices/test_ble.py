"""A Bluetooth toy through bleak's own backend hooks: the virtual toy's bytes in pieces that cut lines anywhere."""

from __future__ import annotations

import asyncio
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest

from plushsense.core.errors import ConfigError, DeviceError, MissingExtraError
from plushsense.core.layouts import load_layout
from plushsense.devices import ble
from plushsense.devices.base import ReconnectingDevice
from plushsense.devices.ble import UART_SERVICE, UART_TX, BleBackends, BleDevice, BleTarget
from plushsense.devices.opening import list_devices, open_device, parse_url
from plushsense.devices.virtual.faults import Fault
from plushsense.devices.virtual.scenario import ScenarioPart, ToyScenario
from plushsense.devices.virtual.stream import ToySpec, ToyStream, received
from plushsense.devices.wire import LineParser

try:
    import bleak
except ImportError:  # a module of classes on bleak's own: no fixture can skip it
    if "ble" in os.environ.get("PLUSHSENSE_REQUIRE", "").split(","):
        raise
    pytest.skip("the extra 'ble' is not installed", allow_module_level=True)

PLUSH = load_layout("plush-15")
ADDRESS = "C0:FF:EE:00:00:01"
OTHER = "0000abcd-0000-1000-8000-00805f9b34fb"


def sent(count: int) -> bytes:
    """So many lines of the virtual toy, noise and all."""
    spec = ToySpec(person=3, lost=0.02, garbled=0.02)
    return b"".join(line.data for line in itertools.islice(iter(ToyStream(spec, PLUSH)), count))


class Air:
    """What the fake adapter sees, and what went on."""

    devices: ClassVar[list[tuple[str, str | None, list[str]]]] = []
    services: ClassVar[dict[str, list[tuple[str, list[str]]]]] = {}
    fault: ClassVar[Exception | None] = None
    hang: ClassVar[bool] = False
    clients: ClassVar[list[Any]] = []
    connected: ClassVar[list[Any]] = []
    broken: ClassVar[bool] = False
    aborted: ClassVar[bool] = False


@pytest.fixture(autouse=True)
def air() -> Iterator[type[Air]]:
    Air.devices = [("11:22:33:44:55:66", "Lamp", []), (ADDRESS, "Plush Bear", [UART_SERVICE])]
    Air.services = {UART_SERVICE: [("6e400002-b5a3-f393-e0a9-e50e24dcca9e", ["write"]), (UART_TX, ["notify"])]}
    Air.fault, Air.hang, Air.clients, Air.connected = None, False, [], []
    Air.broken = Air.aborted = False
    yield Air
    for client in Air.clients:
        assert not client.connected, "a connection was left open"


class Scanner(bleak.backends.scanner.BaseBleakScanner):
    def __init__(self, detection_callback: Any, service_uuids: Any, scanning_mode: str, **_: Any) -> None:
        super().__init__(detection_callback, service_uuids)

    async def start(self) -> None:
        if Air.fault is not None:
            raise Air.fault
        for address, name, services in Air.devices:
            data = bleak.backends.scanner.AdvertisementData(name, {}, {}, services, None, -60, ())
            device = self.create_or_update_device(address, address, name, None, data)
            self.call_detection_callbacks(device, data)

    async def stop(self) -> None:
        pass


class Client(bleak.backends.client.BaseBleakClient):
    """Connects to anything; `play` and `drop` are called by the test, from its own thread."""

    mtu_size = 23
    connected = False
    callback: Callable[[bytearray], None] | None = None

    async def connect(self, pair: bool, **_: Any) -> None:
        if Air.hang:
            await asyncio.sleep(3600)
        if Air.aborted:
            self._disconnected_callback()  # bleak tries again by itself
            await asyncio.sleep(0.01)
        self.loop = asyncio.get_running_loop()
        self.services = bleak.backends.service.BleakGATTServiceCollection()
        handle = itertools.count(1)
        for uuid, characteristics in Air.services.items():
            service = bleak.backends.service.BleakGATTService(None, next(handle), uuid)
            self.services.add_service(service)
            for tx, properties in characteristics:
                self.services.add_characteristic(
                    bleak.backends.characteristic.BleakGATTCharacteristic(
                        None, next(handle), tx, properties, lambda: 20, service
                    )
                )
        self.connected = True
        Air.clients.append(self)

    async def disconnect(self) -> None:
        """Call back before returning, as bleak does on all systems; the answer of the radio takes a while."""
        if self.connected:
            self.connected = False
            self._disconnected_callback()
        await asyncio.sleep(0.01)

    @property
    def is_connected(self) -> bool:
        return self.connected

    async def start_notify(self, characteristic: Any, callback: Any, **_: Any) -> None:
        if Air.broken and len(Air.clients) == 1:
            raise bleak.exc.BleakDBusError("org.freedesktop.DBus.Error.UnknownObject", ["no such object"])
        self.tx, self.callback = characteristic.uuid, callback

    async def stop_notify(self, characteristic: Any) -> None:
        self.callback = None

    async def pair(self, *_: Any, **__: Any) -> None: ...
    async def unpair(self) -> None: ...
    async def read_gatt_char(self, *_: Any, **__: Any) -> bytearray:
        return bytearray()

    async def read_gatt_descriptor(self, *_: Any, **__: Any) -> bytearray:
        return bytearray()

    async def write_gatt_char(self, *_: Any, **__: Any) -> None: ...
    async def write_gatt_descriptor(self, *_: Any, **__: Any) -> None: ...

    def play(self, data: bytes, sizes: tuple[int, ...] = (20, 1, 7, 13)) -> None:
        """Notify in pieces of these sizes, over and over."""
        at, turns = 0, itertools.cycle(sizes)
        while at < len(data):
            size = next(turns)
            assert self.callback is not None
            self.loop.call_soon_threadsafe(self.callback, bytearray(data[at : at + size]))
            at += size

    def drop(self) -> None:
        self.connected = False
        self.loop.call_soon_threadsafe(self._disconnected_callback)


class Adapter:
    """Knows the devices that other programs left connected."""

    @classmethod
    async def get(cls, **_: Any) -> Adapter:
        return cls()

    async def get_connected_devices(self, service_uuids: frozenset[str]) -> list[Any]:
        assert UART_SERVICE in service_uuids
        return Air.connected


FAKE = BleBackends(Client, Scanner, Adapter)


def opened(**target: Any) -> BleDevice:
    return BleDevice("ble://test", PLUSH, BleTarget(**({"name": "Plush Bear", "find_s": 0.2} | target)), FAKE)


def take(device: BleDevice | ReconnectingDevice, frames: int) -> list[Any]:
    got: list[Any] = []
    end = time.monotonic() + 10
    while len(got) < frames:
        assert time.monotonic() < end
        got += device.read() or []
    return got


@pytest.mark.parametrize("sizes", [(20, 1, 7, 13), (1,), (244,)])
@pytest.mark.slow
def test_what_the_toy_says_is_read_however_it_is_cut(sizes: tuple[int, ...]) -> None:
    data = sent(600)
    parser = LineParser(PLUSH, joining=True)
    expected = parser.feed(data[5:])
    with opened() as device:
        Air.clients[0].play(data[5:], sizes)
        frames = take(device, len(expected))
        assert [(f.device_ms, f.values) for f in frames] == [(p.device_ms, p.values) for p in expected]
        assert device.counters == parser.counters
        assert device.counters.malformed > 3 and device.counters.lost > 3
        assert abs(frames[-1].host_ms - time.time() * 1000) < 5000
    assert device.read() is None


def test_a_scenario_is_read_over_bluetooth_as_anywhere() -> None:
    faults = (
        Fault("torn", 1.0, 1.0, share=0.3),
        Fault("stall", 2.5, 0.5),
        Fault("disconnect", 4.0, 0.5),
        Fault("unended", 5.0, 0.2),
        Fault("reset", 6.0, 0.5),
    )
    scenario = ToyScenario((ScenarioPart("perform", 3, gestures=("Hold strong",)),), wrap_s=3.5, faults=faults)
    spec = ToySpec.of(scenario)
    expected = [(f.device_ms, f.values) for _, frames, _ in received(spec, PLUSH) for f in frames]
    lines = list(ToyStream(spec, PLUSH))
    got: list[tuple[int, tuple[int, ...]]] = []
    with ReconnectingDevice("ble://test", PLUSH, opened) as device:
        for connected, stretch in itertools.groupby(lines, key=lambda line: line.connected):
            if not connected:
                Air.clients[-1].drop()
                end = time.monotonic() + 60
                while len(Air.clients) < 2 or Air.clients[1].callback is None or device.state != "connected":
                    assert not device.read()
                    assert time.monotonic() < end
                continue
            data = b"".join(line.data for line in stretch)
            count = len(LineParser(PLUSH, joining=True).feed(data))
            Air.clients[-1].play(data)
            got += [(f.device_ms, f.values) for f in take(device, count)]
        assert device.counters.reconnects == 1
    # A radio may join in the middle of a line, so that the first one of each connection is left out.
    missing = [n for n, frame in enumerate(expected) if frame not in got]
    assert len(missing) == 2 and missing[0] == 0
    assert got == [frame for n, frame in enumerate(expected) if n not in missing]


@pytest.mark.parametrize("address", [ADDRESS, ADDRESS.lower(), ADDRESS.replace(":", "-")])
def test_by_address(address: str) -> None:
    with opened(name=None, address=address):
        assert Air.clients[0].address == ADDRESS
        assert Air.clients[0].tx == UART_TX


def test_other_uuids() -> None:
    Air.services = {OTHER: [("00000001" + OTHER[8:], ["write"]), ("00000002" + OTHER[8:], ["indicate"])]}
    with opened(service=OTHER, tx=None):
        assert Air.clients[0].tx.startswith("00000002")
    Air.services[OTHER].append(("00000003" + OTHER[8:], ["notify"]))
    with opened(service=OTHER, tx="00000003" + OTHER[8:]):
        assert Air.clients[1].tx.startswith("00000003")
    with pytest.raises(DeviceError, match="00000002.*00000003.*&tx=UUID"):
        opened(service=OTHER, tx=None)
    with pytest.raises(DeviceError, match="00000001.* is none of those"):
        opened(service=OTHER, tx="00000001" + OTHER[8:])


def test_refusals_name_what_is_there() -> None:
    with pytest.raises(DeviceError, match=r"named 'Teddy' advertised within 0.2 s; there are Lamp .*, Plush Bear"):
        opened(name="Teddy")
    Air.devices = [("11:22:33:44:55:66", None, [])]
    with pytest.raises(DeviceError, match="there are 1 without a name"):
        opened()
    Air.devices = []
    with pytest.raises(DeviceError, match="address 11:22.*nothing advertises here"):
        opened(name=None, address="11:22:33:44:55:66")
    Air.devices = [(ADDRESS, "Plush Bear", [])]
    Air.services = {OTHER: []}
    with pytest.raises(DeviceError, match=f"has no service {UART_SERVICE}; it has {OTHER}"):
        opened()


def test_a_toy_that_does_not_let_itself_be_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ble, "_CONNECT_S", 0.2)
    Air.hang = True
    with pytest.raises(DeviceError, match="could not be connected within 0.2 s"):
        opened()


def test_a_first_try_of_bleak_that_fails_is_not_the_end() -> None:
    Air.aborted = True
    with opened() as device:
        Air.clients[0].play(b"\n1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n")
        assert len(take(device, 1)) == 1


def still_connected(name: str = "Plush Bear", address: str = ADDRESS) -> None:
    """The toy is connected, so that it does not advertise."""
    Air.connected = [bleak.backends.device.BLEDevice(address, name, None)]
    Air.devices = [device for device in Air.devices if device[0] != address]


needs_adapter = pytest.mark.skipif(not hasattr(bleak, "BleakAdapter"), reason="this bleak is older than 3.1")


@needs_adapter
def test_a_toy_that_was_left_connected_is_found_without_a_search() -> None:
    still_connected()
    for target in ({}, {"name": None, "address": ADDRESS.lower()}):
        with opened(**target):
            assert Air.clients[-1].tx == UART_TX
    Air.services = {OTHER: []}
    with pytest.raises(DeviceError, match=f"has no service {UART_SERVICE}; it has {OTHER}"):
        opened()


@needs_adapter
def test_the_refusal_names_what_is_still_connected_to_this_computer() -> None:
    still_connected()
    with pytest.raises(DeviceError, match=r"Lamp \(.*\); still connected to this computer: Plush Bear \(C0:FF.*\);"):
        opened(name="Teddy")
    Air.hang = True
    with pytest.MonkeyPatch.context() as patch, pytest.raises(DeviceError, match="is still connected to this computer"):
        patch.setattr(ble, "_CONNECT_S", 0.05)
        opened()


@needs_adapter
def test_a_toy_that_the_system_wrongly_takes_for_connected_is_searched() -> None:
    Air.connected = [bleak.backends.device.BLEDevice(ADDRESS, "Plush Bear", None)]
    Air.broken = True
    with opened():
        assert len(Air.clients) == 2 and not Air.clients[0].connected


def test_without_the_list_of_connected_devices_the_toy_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """bleak before 3.1, or a system that cannot list them."""
    monkeypatch.delattr(bleak, "BleakAdapter", raising=False)
    with opened():
        assert len(Air.clients) == 1
    with pytest.raises(DeviceError, match="not still connected to this computer or to another"):
        opened(name="Teddy")


def test_a_toy_that_stops_sending_is_given_up_and_one_that_has_not_begun_is_not() -> None:
    line = b"\n1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n"
    with opened(silence_s=0.01) as device:
        device.wait_s = 0.02
        assert device.read() == []
        Air.clients[0].play(line)
        assert len(take(device, 1)) == 1
        with pytest.raises(DeviceError, match=r"has stopped sending for 0.01 s.*silence_s=0"):
            while True:
                device.read()
    with opened(silence_s=0) as device:
        device.wait_s = 0.02
        Air.clients[1].play(line)
        assert len(take(device, 1)) == 1
        assert device.read() == []


def test_a_connection_that_was_given_up_is_opened_anew() -> None:
    """As after a crash of the Bluetooth service, of which bleak says nothing."""
    line = b"\n1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n"
    with ReconnectingDevice("ble://test", PLUSH, lambda: opened(silence_s=0.01)) as device:
        device.wait_s = 0.02
        Air.clients[0].play(line)
        take(device, 1)
        end = time.monotonic() + 10
        while len(Air.clients) < 2 or device.state == "waiting":
            assert time.monotonic() < end
            device.read()
        Air.clients[1].play(line)
        take(device, 1)
        assert "stopped sending" in device.gaps[0].reason and device.counters.reconnects == 1


def not_available(name: str) -> Exception:
    reasons = getattr(bleak.exc, "BleakBluetoothNotAvailableReason", None)
    if reasons is None:
        pytest.skip("this bleak is older than 2.0")
    error: Exception = bleak.exc.BleakBluetoothNotAvailableError("No.", reasons[name])
    return error


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("POWERED_OFF", "switched off: switch it on"),
        ("NO_BLUETOOTH", "no Bluetooth adapter"),
        ("NO_BLE_CENTRAL_ROLE", "no Bluetooth adapter"),
        ("DENIED_BY_USER", "may not use Bluetooth"),
        (bleak.exc.BleakError("No Bluetooth adapters found."), "no Bluetooth adapter"),
        (bleak.exc.BleakError("Bluetooth device is turned off"), "switched off"),
        (bleak.exc.BleakDBusError("org.bluez.Error.NotReady", ["Resource Not Ready"]), "switched off"),
        (
            bleak.exc.BleakDBusError("org.freedesktop.DBus.Error.ServiceUnknown", ["org.bluez was not provided"]),
            "system service does not answer",
        ),
        (FileNotFoundError(2, "No such file or directory"), "system service does not answer"),
        (bleak.exc.BleakError("something else."), "Bluetooth reports: something else"),
        (ZeroDivisionError(), "Bluetooth reports: ZeroDivisionError"),
    ],
)
def test_bluetooth_that_cannot_be_used_is_one_sentence(fault: str | Exception, words: str) -> None:
    Air.fault = not_available(fault) if isinstance(fault, str) else fault
    for use in (opened, lambda: ble.scan(0.1, FAKE)):
        with pytest.raises(DeviceError, match=words) as caught:
            use()
        message = str(caught.value)
        assert message.endswith(".") and ".." not in message and "\n" not in message


def test_a_toy_that_disconnects_gives_what_it_said_and_then_an_error() -> None:
    with opened() as device:
        client = Air.clients[0]
        client.play(b"\n1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n1 2")
        client.drop()
        assert len(take(device, 1)) == 1
        for _ in range(2):
            with pytest.raises(DeviceError, match="went away"):
                for _frame in device:
                    pass
        assert device.counters.malformed >= 1


def test_closing_from_another_thread_ends_the_frames() -> None:
    device = opened()
    closing = threading.Timer(0.1, device.close)
    closing.start()
    begun = time.monotonic()
    assert list(device) == []
    assert time.monotonic() - begun < 3
    closing.join(5)


def test_it_comes_back() -> None:
    data = b"\n" + b"".join(b"1 2 3 4 5 6 7 8 9 10 11 12 13 %d 10\n" % t for t in range(0, 1000, 10))
    with ReconnectingDevice("ble://test", PLUSH, opened) as device:
        Air.clients[0].play(data)
        take(device, 100)
        Air.clients[0].drop()
        end = time.monotonic() + 10
        while len(Air.clients) < 2 or device.state == "waiting":
            assert time.monotonic() < end
            device.read()
        Air.clients[1].play(data)
        take(device, 100)
        assert device.counters.reconnects == 1 and device.counters.frames == 200
        assert "went away" in device.gaps[0].reason


def test_scan_lists_what_advertises() -> None:
    first, second = ble.scan(0.1, FAKE)
    assert (first.name, first.services) == ("Lamp", ())
    assert (second.address, second.name, second.rssi, second.services) == (ADDRESS, "Plush Bear", -60, (UART_SERVICE,))


@pytest.mark.parametrize(
    ("url", "error", "words"),
    [
        ("ble://", DeviceError, "names no Bluetooth toy"),
        ("ble://name:", DeviceError, "ble://name:PlushName"),
        ("ble://Teddy", DeviceError, "AA:BB:CC:DD:EE:FF"),
        (f"ble://{ADDRESS}?tx=12", ConfigError, "tx is '12'"),
        (f"ble://{ADDRESS}?service=x", ConfigError, "service is 'x'"),
        (f"ble://{ADDRESS}?baud=1", ConfigError, "find_s"),
        (f"ble://{ADDRESS}?find_s=0", ConfigError, "find_s"),
    ],
)
def test_urls_that_are_refused(url: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        open_device(url)


@pytest.mark.parametrize(
    ("url", "target"),
    [
        ("ble://name:Plush%20Bear", BleTarget("Plush Bear")),
        (f"ble://{ADDRESS}?find_s=3", BleTarget(address=ADDRESS, find_s=3)),
        (f"ble://{ADDRESS}?silence_s=0", BleTarget(address=ADDRESS, silence_s=0)),
        (
            "ble://12345678-ABCD-abcd-abcd-1234567890ab?service=ABCD",
            BleTarget(address="12345678-ABCD-abcd-abcd-1234567890ab", service=OTHER, tx=None),
        ),
        (f"ble://{ADDRESS}?tx=abcd", BleTarget(address=ADDRESS, tx=OTHER)),
    ],
)
def test_urls(url: str, target: BleTarget, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(ble, "BleDevice", lambda *given: asked.append(given))
    ble.open_ble(parse_url(url), PLUSH)
    assert asked == [(url, PLUSH, target)]


def test_without_bleak(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'plushsense\[ble\]'"):
        open_device(f"ble://{ADDRESS}")


def test_toys_are_listed_by_service_or_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ble, "search_bluetooth", partial(ble.search_bluetooth, backends=FAKE))
    Air.devices = [
        ("11:22:33:44:55:66", "Lamp", []),
        (ADDRESS, None, [UART_SERVICE.upper()]),
        ("C0:FF:EE:00:00:02", "MyTeddy", []),
    ]
    listing = list_devices(0.1)
    toys = {d.url: d for d in listing.devices if d.kind == "ble"}
    assert set(toys) == {f"ble://{ADDRESS}", "ble://C0:FF:EE:00:00:02"}
    assert toys[f"ble://{ADDRESS}"].description == "-60 dBm, Nordic UART service"
    assert toys["ble://C0:FF:EE:00:00:02"].name == "MyTeddy"
    assert "Bluetooth: 1 more device advertises, by name and service no toy; ble://ADDRESS opens any." in listing.notes
    Air.fault = FileNotFoundError(2, "No such file or directory")
    listing = list_devices(0.1)
    assert [d for d in listing.devices if d.kind == "ble"] == []
    assert sum("Bluetooth cannot be used here" in note for note in listing.notes) == 1
