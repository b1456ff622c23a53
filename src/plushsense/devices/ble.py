"""Bluetooth Low Energy toys, which send the wire format in notifications of a UART-like service (with bleak)."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import queue
import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from types import ModuleType
from typing import Any
from urllib.parse import unquote

from plushsense.core.errors import ConfigError, DeviceError, need
from plushsense.core.layouts import Layout
from plushsense.core.sentences import Message, join_names
from plushsense.devices.base import Device, Frame, now_ms
from plushsense.devices.opening import DeviceAddress, DeviceInfo, DeviceListing
from plushsense.devices.wire import LineParser

UART_SERVICE = "6e400001-b5a3-f393-e0a9-e50e24dcca9e"
UART_TX = "6e400003-b5a3-f393-e0a9-e50e24dcca9e"
"""Nordic UART service and its notifying characteristic (Nordic Semiconductor, nRF Connect SDK, "NUS")."""
_GATT_SERVICE = "1801"  # of nearly all devices

FIND_S = 10.0
SILENCE_S = 10.0
_TOY_WORDS = ("plush", "toy", "teddy", "bear")
_CONNECT_S = 20.0
_MAC = re.compile(r"[0-9A-F]{2}(?:[:-][0-9A-F]{2}){5}\Z", re.IGNORECASE)
_UUID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\Z")


@dataclass(frozen=True)
class BleTarget:
    """The device to connect to and the characteristic to read.

    Attributes:
        name: advertised name, if it is searched by name.
        address: address, if it is searched by address: six bytes, or a UUID on macOS.
        service: UUID of the service.
        tx: UUID of the notifying characteristic; None: the only one of the service.
        find_s: longest duration of the search, in seconds.
        silence_s: time without notifications after which a toy that has sent some counts as disconnected, in seconds;
            0: no limit.
    """

    name: str | None = None
    address: str | None = None
    service: str = UART_SERVICE
    tx: str | None = UART_TX
    find_s: float = FIND_S
    silence_s: float = SILENCE_S


@dataclass(frozen=True)
class BleBackends:
    """Client, scanner and adapter backend classes of bleak; None: those of the platform."""

    client: type[Any] | None = None
    scanner: type[Any] | None = None
    adapter: type[Any] | None = None


@dataclass(frozen=True)
class BleAdvertisement:
    """An advertising device: address, name ("" for none), signal strength in dBm, advertised services."""

    address: str
    name: str
    rssi: int
    services: tuple[str, ...]


_started = threading.Lock()
_loops: list[asyncio.AbstractEventLoop] = []


def bluetooth_loop() -> asyncio.AbstractEventLoop:
    """Return the event loop shared by all Bluetooth devices; bleak ties its connection to the system to it."""
    with _started:
        if not _loops:
            loop = asyncio.new_event_loop()
            threading.Thread(target=loop.run_forever, name="plushsense-ble", daemon=True).start()
            _loops.append(loop)
        return _loops[0]


class BleDevice(Device):
    """A Bluetooth toy that sends notifications. Reading raises DeviceError after it has disconnected.

    bleak runs in the event loop of another thread (`bluetooth_loop`), which queues the notifications for `read`.
    Notifications may end within a line; the first line may be incomplete, as on a serial port.

    bleak does not report that the system's Bluetooth service has crashed, so that notifications that stop for
    ``silence_s`` end the connection, too. A toy that has not sent anything yet may be silent for any time. The system
    keeps a connection whose program has ended: the device closes at the latest when Python ends.
    """

    def __init__(self, url: str, layout: Layout, target: BleTarget, backends: BleBackends | None = None) -> None:
        super().__init__(url, layout)
        self._bleak = need("bleak", extra="ble")
        self._target = target
        self._backends = backends or BleBackends()
        self._parser = LineParser(layout, self.counters, joining=True)
        self._received: queue.SimpleQueue[tuple[float, int, bytes] | None] = queue.SimpleQueue()
        self._over: asyncio.Event | None = None
        self._received_s: float | None = None
        self._loop = bluetooth_loop()
        atexit.register(self.close)
        opened: Future[None] = Future()
        self._task = asyncio.run_coroutine_threadsafe(self._work(opened), self._loop)
        try:
            opened.result()
        except BaseException:
            self.close()  # also for KeyboardInterrupt
            raise

    def read(self) -> list[Frame] | None:
        """Return the received frames, waiting at most ``wait_s``."""
        frames: list[Frame] = []
        wait = True
        while not self.closed:
            try:
                received = self._received.get(timeout=self.wait_s) if wait else self._received.get_nowait()
            except queue.Empty:
                if not frames:
                    self._check_silence()
                return frames
            if received is None:
                if self.closed:
                    return None
                self._received.put(None)  # so that the next call raises, if this one has frames to return
                if frames:
                    return frames
                self._parser.finish()
                raise DeviceError(
                    "'{url}' went away (disconnected): was it switched off or out of reach?", url=self.url
                )
            at, host, data = received
            if wait:
                self.arrived_s = at
            frames += self._parser.frames(data, host)
            wait = False
        return None

    def _check_silence(self) -> None:
        limit_s = self._target.silence_s
        if self._received_s is not None and 0.0 < limit_s <= time.perf_counter() - self._received_s:
            self._parser.finish()
            raise DeviceError(
                "'{url}' has stopped sending for {limit_s:g} s, so its connection is given up: is it still near, and "
                "Bluetooth running? For a toy that pauses, write ?silence_s=0.",
                url=self.url,
                limit_s=limit_s,
            )

    def _on_notification(self, _: Any, data: bytearray) -> None:
        self._received_s = time.perf_counter()
        self._received.put((self._received_s, now_ms(), bytes(data)))

    @property
    def mismatch(self) -> Message:
        """As in `Device`."""
        return self._parser.mismatch(self.url)

    def _shut(self) -> None:
        atexit.unregister(self.close)
        self._loop.call_soon_threadsafe(self._end)
        self._received.put(None)
        with contextlib.suppress(TimeoutError):
            self._task.result(5.0)

    def _end(self) -> None:
        if self._over is not None:
            self._over.set()

    async def _work(self, opened: Future[None]) -> None:
        """Find the toy, connect and receive, until it disconnects or `close` is called."""
        self._over = over = asyncio.Event()
        if self.closed:
            over.set()
        steps = asyncio.ensure_future(self._listen(over, opened))
        stop = asyncio.ensure_future(over.wait())
        try:
            # Closing also ends a search or a connection in progress.
            await asyncio.wait((steps, stop), return_when=asyncio.FIRST_COMPLETED)
            if not steps.done() and not opened.done():
                steps.cancel()
            stop.cancel()
            await asyncio.wait((steps,))
            cause = None if steps.cancelled() else steps.exception()
            if not opened.done():
                broken = cause
                if not isinstance(cause, Exception):
                    broken = DeviceError("'{url}' broke off while it was being connected; try again.", url=self.url)
                elif not isinstance(cause, DeviceError):
                    broken = DeviceError("'{url}': {in_words}.", url=self.url, in_words=in_words(cause))
                opened.set_exception(broken)
        finally:
            self._received.put(None)

    async def _listen(self, over: asyncio.Event, opened: Future[None]) -> None:
        # A toy does not advertise while it is connected, be it by a program that ended without disconnecting.
        connected = await _connected(self._bleak, self._backends, self._target.service)
        for device in connected:
            if self._matches(device.address, device.name):
                # The system may be wrong: after a crash of its service, only a scan brings the toy back.
                with contextlib.suppress(self._bleak.exc.BleakError):
                    await self._receive(device, f"'{self.url}' is still connected to this computer", over, opened)
                    return
        device = await self._find(connected)
        await self._receive(device, f"'{self.url}' was found", over, opened)

    async def _receive(self, device: Any, found: str, over: asyncio.Event, opened: Future[None]) -> None:
        connected = False

        def disconnected(_: Any) -> None:
            # bleak calls this also while it tries to connect, and before its `disconnect` returns.
            if connected:
                self._loop.call_soon_threadsafe(over.set)

        chosen = {} if self._backends.client is None else {"backend": self._backends.client}
        client = self._bleak.BleakClient(device, disconnected, timeout=_CONNECT_S, **chosen)
        try:
            await asyncio.wait_for(client.connect(), _CONNECT_S)
        except TimeoutError:
            raise DeviceError(
                "{found} but could not be connected within {connect_s:g} s: is another computer or phone connected "
                "to it? Switching it off and on disconnects all.",
                found=found,
                connect_s=_CONNECT_S,
                url=self.url,
            ) from None
        connected = True
        try:
            characteristic = self._characteristic(list(client.services))
            await client.start_notify(characteristic, self._on_notification)
            opened.set_result(None)
            await over.wait()
        finally:
            connected = False
            with contextlib.suppress(Exception):
                await asyncio.wait_for(client.disconnect(), 3.0)

    def _matches(self, address: str, name: str | None) -> bool:
        target = self._target
        return _same(address, target.address) if target.address is not None else name == target.name

    async def _find(self, connected: list[Any]) -> Any:
        """Scan for the device, since connecting to an address without a scan is unreliable (see bleak's manual)."""
        target = self._target
        device_found: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        names: dict[str, str] = {}

        def advertised(device: Any, data: Any) -> None:
            name = data.local_name or device.name or ""
            names[device.address] = name
            if self._matches(device.address, name) and not device_found.done():
                device_found.set_result(device)

        with contextlib.suppress(TimeoutError):
            async with _scanner(self._bleak, self._backends, advertised):
                return await asyncio.wait_for(asyncio.shield(device_found), target.find_s)
        there = [f"{name} ({address})" for address, name in sorted(names.items(), key=lambda kv: kv[1]) if name]
        if there:
            here = f"there are {join_names(there, most=8)}"
        else:
            here = f"there are {len(names)} without a name" if names else "nothing advertises here"
        if connected:
            still = join_names(f"{device.name or 'a device without a name'} ({device.address})" for device in connected)
            here += f"; still connected to this computer: {still}"
        described = f"named '{target.name}'" if target.address is None else f"with the address {target.address}"
        raise DeviceError(
            "'{url}': no Bluetooth device {described} advertised within {find_s:g} s; {here}; is it switched on, "
            "near, and not still connected to this computer or to another?",
            url=self.url,
            described=described,
            find_s=target.find_s,
            here=here,
            name=target.name or target.address,
        )

    def _characteristic(self, services: list[Any]) -> Any:
        target = self._target
        service = next((s for s in services if s.uuid.lower() == target.service), None)
        if service is None:
            raise DeviceError(
                f"'{self.url}' has no service {target.service}; it has {join_names(sorted(s.uuid for s in services))}: "
                "write ?service=UUID&tx=UUID."
            )
        notifying = [c for c in service.characteristics if {"notify", "indicate"} & set(c.properties)]
        if target.tx is None and len(notifying) == 1:
            return notifying[0]
        match = next((c for c in notifying if c.uuid.lower() == target.tx), None)
        if match is None:
            wrong = "names none of those" if target.tx is None else f"{target.tx} is none of those"
            raise DeviceError(
                f"'{self.url}': of service {target.service} the characteristics that notify are "
                f"{join_names(sorted(c.uuid for c in notifying))}, and the URL's tx {wrong}: write &tx=UUID."
            )
        return match


def scan(seconds: float, backends: BleBackends | None = None) -> list[BleAdvertisement]:
    """Return the devices that advertise within ``seconds``, the strongest signal first.

    Raises:
        DeviceError: if Bluetooth cannot be used.
        MissingExtraError: if bleak is not installed.
    """
    bleak = need("bleak", extra="ble")
    seen: dict[str, BleAdvertisement] = {}

    def advertised(device: Any, data: Any) -> None:
        name = data.local_name or device.name or ""
        services = tuple(str(uuid).lower() for uuid in data.service_uuids)
        seen[device.address] = BleAdvertisement(device.address, name, int(data.rssi), services)

    async def look() -> None:
        async with _scanner(bleak, backends or BleBackends(), advertised):
            await asyncio.sleep(seconds)

    try:
        asyncio.run_coroutine_threadsafe(look(), bluetooth_loop()).result()
    except Exception as cause:  # noqa: BLE001, RUF100
        words = in_words(cause)
        raise DeviceError("{why}.", why=words[0].upper() + words[1:]) from None
    return sorted(seen.values(), key=lambda s: (-s.rssi, s.name, s.address))


def search_bluetooth(scan_s: float, backends: BleBackends | None = None) -> DeviceListing:
    """List the devices that advertise the Nordic UART service or have a name like a toy's."""
    seen = scan(scan_s, backends)
    toys = []
    for device in seen:
        uart = UART_SERVICE in device.services
        if uart or any(word in device.name.lower() for word in _TOY_WORDS):
            template = "{dbm} dBm, Nordic UART service" if uart else "{dbm} dBm, advertises no Nordic UART service"
            about = Message(template, dbm=device.rssi)
            toys.append(DeviceInfo(f"ble://{device.address}", "ble", device.name or device.address, about))
    others = len(seen) - len(toys)
    if not others:
        return DeviceListing(toys)
    who = "1 more device advertises" if others == 1 else f"{others} more devices advertise"
    return DeviceListing(
        toys, [Message("Bluetooth: {who}, by name and service no toy; ble://ADDRESS opens any.", who=who, n=others)]
    )


async def _connected(bleak: ModuleType, backends: BleBackends, service: str) -> list[Any]:
    """Return the devices that are connected to this computer; none if bleak, before 3.1, or the system cannot tell."""
    chosen = {} if backends.adapter is None else {"backend": backends.adapter}
    with contextlib.suppress(Exception):
        adapter = await bleak.BleakAdapter.get(**chosen)
        return list(await adapter.get_connected_devices([service, _GATT_SERVICE]))
    return []


def _scanner(bleak: ModuleType, backends: BleBackends, advertised: Callable[[Any, Any], None]) -> Any:
    chosen = {} if backends.scanner is None else {"backend": backends.scanner}
    return bleak.BleakScanner(detection_callback=advertised, **chosen)


def in_words(cause: Exception) -> str:
    """Describe an error of bleak or of the system in words, without a full stop at the end."""
    reason = str(getattr(getattr(cause, "reason", None), "name", ""))
    text = " ".join(" ".join(str(part) for part in cause.args).split()) or type(cause).__name__
    low = text.lower()
    if reason == "POWERED_OFF" or "turned off" in low or "not powered" in low or "org.bluez.error.notready" in low:
        return "Bluetooth is switched off: switch it on"
    if reason.startswith("DENIED") or "accessdenied" in low or "not authorized" in low:
        return "this program may not use Bluetooth: allow it in the system's settings"
    if reason in ("NO_BLUETOOTH", "NO_BLE_CENTRAL_ROLE") or re.search(r"no bluetooth|adapters? (was )?not found", low):
        return "this computer has no Bluetooth adapter that can be used"
    if isinstance(cause, OSError) or "serviceunknown" in low:
        why = getattr(cause, "strerror", None) or text
        return f"Bluetooth cannot be used here: its system service does not answer ({why})"
    return f"Bluetooth reports: {text.rstrip('.')}"


def _same(address: str, other: str) -> bool:
    return address.replace("-", ":").lower() == other.replace("-", ":").lower()


def _uuid(address: DeviceAddress, key: str) -> str | None:
    text = address.query.get(key)
    if text is None:
        return None
    full = text.lower()
    if re.fullmatch(r"[0-9a-f]{4}", full):
        full = f"0000{full}-0000-1000-8000-00805f9b34fb"  # the short form of the Bluetooth base UUID
    if _UUID.match(full) is None:
        raise ConfigError(
            f"'{address.url}': {key} is '{text}'; accepted is a UUID like {UART_SERVICE}, or 4 hex digits."
        )
    return full


def open_ble(address: DeviceAddress, layout: Layout) -> BleDevice:
    """Open ``ble://AA:BB:CC:DD:EE:FF?service=UUID&tx=UUID`` or ``ble://name:PlushName?find_s=10&silence_s=10``."""
    address.check_keys(("service", "tx", "find_s", "silence_s"))
    place = unquote(address.place).strip("/")
    named, colon, name = place.partition(":")
    by_name = named.lower() == "name" and colon != ""
    if not (name.strip() if by_name else _MAC.match(place) or _UUID.match(place.lower())):
        raise DeviceError(
            "'{url}' names no Bluetooth toy: write ble://AA:BB:CC:DD:EE:FF, the UUID that macOS gives in its place, "
            "or ble://name:PlushName (plushsense devices lists them).",
            url=address.url,
        )
    service, tx = _uuid(address, "service"), _uuid(address, "tx")
    target = BleTarget(
        name if by_name else None,
        None if by_name else place,
        service or UART_SERVICE,
        tx or (UART_TX if service in (None, UART_SERVICE) else None),
        address.number("find_s", FIND_S, 0.1, 600.0),
        address.number("silence_s", SILENCE_S, 0.0, 3600.0),
    )
    return BleDevice(address.url, layout, target)
