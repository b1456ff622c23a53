"""A private D-Bus bus with a pretend BlueZ, for bleak's own client: one adapter, and a toy and a lamp near it.

As a program, ``bluez.py ADDRESS`` is the service on the bus with this address; it prints what happens to the toy.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TOY, LAMP = "C0:FF:EE:00:00:01", "11:22:33:44:55:66"
SERVICE = "6e400001-b5a3-f393-e0a9-e50e24dcca9e"
TX, BATTERY = "6e400003-b5a3-f393-e0a9-e50e24dcca9e", "00002a19-0000-1000-8000-00805f9b34fb"
FRAME = "1 2 3 4 5 6 7 8 9 10 11 12 13 {} 10\n"

_BUS = """<!DOCTYPE busconfig PUBLIC "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>session</type><listen>unix:path={}</listen><auth>EXTERNAL</auth><policy context="default">
<allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/><allow own="*"/></policy></busconfig>
"""
_ADAPTER = "/org/bluez/hci0"
_OBJECTS, _PROPERTIES = "org.freedesktop.DBus.ObjectManager", "org.freedesktop.DBus.Properties"


class Bluez:
    """A bus and its pretend BlueZ, each a process; ``events`` are what the service reports.

    The toy stays connected until it is asked to disconnect, even if the program that connected it has ended.
    """

    def __init__(self, folder: Path) -> None:
        config = folder / "bus.conf"
        config.write_text(_BUS.format(folder / "bus"), encoding="utf-8")
        command = ["dbus-daemon", f"--config-file={config}", "--print-address=1", "--nofork", "--nopidfile"]
        self._daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._daemon.stdout is not None
        self.address = self._daemon.stdout.readline().strip()
        self.events: queue.Queue[str] = queue.Queue()
        self.start()

    def start(self) -> None:
        """Start the service."""
        self._service = subprocess.Popen(
            [sys.executable, "-P", __file__, self.address], stdout=subprocess.PIPE, text=True
        )
        threading.Thread(target=self._work, args=(self._service,), daemon=True).start()
        self.expect("ready")

    def _work(self, service: subprocess.Popen[str]) -> None:
        assert service.stdout is not None
        for line in service.stdout:
            self.events.put(line.strip())

    def expect(self, event: str) -> None:
        """Wait until the service reports an event; those before it are forgotten."""
        while self.events.get(timeout=60) != event:
            pass

    def kill(self) -> None:
        """End the service without a word, as a crash does. The bus goes on."""
        self._service.kill()
        self._service.wait(10)

    def close(self) -> None:
        """End both processes."""
        self.kill()
        self._daemon.terminate()
        self._daemon.wait(10)


@contextlib.contextmanager
def private_bluez(folder: Path) -> Iterator[Bluez]:
    """Run a `Bluez`; ``folder`` needs a short path."""
    bluez = Bluez(folder)
    try:
        yield bluez
    finally:
        bluez.close()


def has_dbus() -> bool:
    return sys.platform == "linux" and shutil.which("dbus-daemon") is not None


def report(event: str) -> None:
    sys.stdout.write(f"{event}\n")
    sys.stdout.flush()


class _Service:
    """The objects of BlueZ that bleak uses, answered message by message."""

    def __init__(self, bus: Any) -> None:
        self.bus = bus
        self.connected = False
        self.known: set[str] = set()
        self.notifying: asyncio.Task[None] | None = None
        bus.add_message_handler(self.answer)

    @staticmethod
    def path(address: str) -> str:
        return f"{_ADAPTER}/dev_{address.replace(':', '_')}"

    @staticmethod
    def adapter() -> dict[str, Any]:
        from dbus_fast import Variant

        return {"org.bluez.Adapter1": {"Roles": Variant("as", ["central"]), "Powered": Variant("b", True)}}

    def device(self, address: str) -> dict[str, Any]:
        from dbus_fast import Variant

        toy = address == TOY
        name = "Plush Bear" if toy else "Lamp"
        return {
            "org.bluez.Device1": {
                "Address": Variant("s", address),
                "Alias": Variant("s", name),
                "Name": Variant("s", name),
                "Adapter": Variant("o", _ADAPTER),
                "Connected": Variant("b", toy and self.connected),
                "ServicesResolved": Variant("b", toy and self.connected),
                "Paired": Variant("b", False),
                "UUIDs": Variant("as", [SERVICE] if toy else []),
                "RSSI": Variant("n", -60),
            }
        }

    def services(self) -> dict[str, dict[str, Any]]:
        from dbus_fast import Variant

        service = f"{self.path(TOY)}/service0001"
        objects: dict[str, dict[str, Any]] = {
            service: {
                "org.bluez.GattService1": {
                    "UUID": Variant("s", SERVICE),
                    "Device": Variant("o", self.path(TOY)),
                    "Primary": Variant("b", True),
                }
            }
        }
        for handle, uuid in ((2, TX), (4, BATTERY)):
            objects[f"{service}/char{handle:04x}"] = {
                "org.bluez.GattCharacteristic1": {
                    "UUID": Variant("s", uuid),
                    "Service": Variant("o", service),
                    "Flags": Variant("as", ["notify"]),
                }
            }
        return objects

    async def emit(self, path: str, interface: str, member: str, signature: str, *body: Any) -> None:
        from dbus_fast import Message, MessageType

        await self.bus.send(
            Message(
                message_type=MessageType.SIGNAL,
                path=path, interface=interface, member=member, signature=signature, body=list(body),
            )
        )  # fmt: skip

    async def changed(self, path: str, interface: str, **values: Any) -> None:
        await self.emit(path, _PROPERTIES, "PropertiesChanged", "sa{sv}as", interface, values, [])

    async def added(self, path: str, interfaces: dict[str, Any]) -> None:
        await self.emit("/", _OBJECTS, "InterfacesAdded", "oa{sa{sv}}", path, interfaces)

    def answer(self, message: Any) -> Any:
        from dbus_fast import Message, MessageType

        if message.message_type is not MessageType.METHOD_CALL:
            return None
        if message.member == "GetManagedObjects":
            objects: dict[str, Any] = {_ADAPTER: self.adapter()}
            objects |= {self.path(address): self.device(address) for address in sorted(self.known)}
            objects |= self.services() if self.connected else {}
            return Message.new_method_return(message, "a{oa{sa{sv}}}", [objects])
        effect = getattr(self, f"on_{message.member}", None)
        if effect is None and message.member not in ("StopDiscovery", "SetDiscoveryFilter", "StopNotify"):
            return None
        if (
            effect is not None
            and message.path != _ADAPTER
            and message.path.split("/")[4] != self.path(TOY).split("/")[4]
        ):
            return Message.new_error(message, "org.bluez.Error.Failed", "only the toy can be connected")
        asyncio.get_running_loop().create_task(self.work(message, effect))
        return True

    async def work(self, message: Any, effect: Any) -> None:
        from dbus_fast import Message

        if effect is not None:
            await effect(message.path)
        await self.bus.send(Message.new_method_return(message))

    async def on_StartDiscovery(self, _: str) -> None:  # noqa: N802, RUF100
        for address in (LAMP, TOY):
            if address == LAMP or not self.connected:  # a connected toy does not advertise
                self.known.add(address)
                await self.added(self.path(address), self.device(address))

    async def on_Connect(self, path: str) -> None:  # noqa: N802, RUF100
        from dbus_fast import Variant

        self.connected = True
        await self.changed(path, "org.bluez.Device1", Connected=Variant("b", True))
        for place, interfaces in self.services().items():
            await self.added(place, interfaces)
        await self.changed(path, "org.bluez.Device1", ServicesResolved=Variant("b", True))
        report("connected")

    async def on_Disconnect(self, path: str) -> None:  # noqa: N802, RUF100
        from dbus_fast import Variant

        self.connected = False
        if self.notifying is not None:
            self.notifying.cancel()
        off = {name: Variant("b", False) for name in ("Connected", "ServicesResolved")}
        await self.changed(path, "org.bluez.Device1", **off)
        report("disconnected")
        await asyncio.sleep(0.02)  # as with a radio, the signal comes before the answer

    async def on_StartNotify(self, path: str) -> None:  # noqa: N802, RUF100
        if self.notifying is not None:
            self.notifying.cancel()
        self.notifying = asyncio.get_running_loop().create_task(self.send(path))
        report("notifying")

    async def send(self, path: str) -> None:
        from dbus_fast import Variant

        for device_ms in range(0, 10**9, 10):
            value = Variant("ay", FRAME.format(device_ms).encode())
            await self.changed(path, "org.bluez.GattCharacteristic1", Value=value)
            await asyncio.sleep(0.01)


async def _serve(address: str) -> None:
    from dbus_fast.aio import MessageBus

    bus = await MessageBus(bus_address=address).connect()
    service = _Service(bus)
    await bus.request_name("org.bluez")
    await service.added(_ADAPTER, service.adapter())
    report("ready")
    await bus.wait_for_disconnect()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(sys.argv[1]))
