"""bleak's own client for Linux on a pretend BlueZ: what the simulated radio of `test_ble` cannot do otherwise."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DeviceError
from plushsense.devices import ble
from plushsense.devices.base import Device, ReconnectingDevice
from plushsense.devices.opening import open_device
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from support.bluez import BATTERY, TOY, TX, Bluez, has_dbus, private_bluez
from support.requirements import missing

pytestmark = pytest.mark.slow
URL = f"ble://{TOY}?find_s=20"


@pytest.fixture(scope="module")
def bluez() -> Iterator[Bluez]:
    pytest.importorskip("bleak")
    if not has_dbus():
        missing("dbus", "there is no dbus-daemon")
    # The path of a socket may have 107 characters.
    with (
        tempfile.TemporaryDirectory() as folder,
        private_bluez(Path(folder)) as bluez,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("DBUS_SYSTEM_BUS_ADDRESS", bluez.address)
        patch.setattr(ble, "_loops", [])  # bleak keeps a connection to the bus for each loop
        yield bluez


def take(device: Device, frames: int) -> None:
    before, end = device.counters.frames, time.monotonic() + 60
    while device.counters.frames < before + frames:
        assert time.monotonic() < end
        device.read()


def test_a_refusal_keeps_its_reason(bluez: Bluez) -> None:
    for _ in range(4):
        with pytest.raises(DeviceError, match=f"the characteristics that notify are {BATTERY}, {TX}"):
            open_device(f"{URL}&tx=1234")
        bluez.expect("disconnected")


def test_a_toy_is_found_read_and_left(bluez: Bluez) -> None:
    with open_device(URL) as device:
        take(device, 20)
    bluez.expect("disconnected")
    with pytest.raises(DeviceError, match=r"there are Lamp .*, Plush Bear .*; is it switched on"):
        open_device("ble://name:Teddy?find_s=0.2")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from plushsense.core.gestures import load_gestures
    from plushsense.core.layouts import load_layout
    from plushsense.windows.features import Scaler

    arch = Arch.parse("14d1_19d2_19d4", (8, 12, 16))
    bundle = Bundle(
        arch, random_weights(arch, 3), load_layout("plush-15"), Scaler(np.zeros(11), np.full(11, 1e-3)),
        load_gestures("plush-18"),
    )  # fmt: skip
    return bundle.save(tmp_path_factory.mktemp("plush") / "m.plush")


PROGRAM = """
import sys
from plushsense.devices.opening import open_device
from plushsense.devices.base import ReconnectingDevice
device = open_device(sys.argv[1])
while device.counters.frames < 20:
    device.read()
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_command_that_is_asked_to_end_disconnects_the_toy(bluez: Bluez, model: Path, name: str) -> None:
    words = ["live", "--device", URL, "--model", str(model)]
    command = [sys.executable, "-m", "plushsense", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_unheeded
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert json.loads(process.stdout.readline())["state"] == "warming"
        process.send_signal(getattr(signal, name))
        bluez.expect("disconnected")
        assert json.loads(process.stderr.read().splitlines()[-1])["counters"]["frames"] > 0
    assert process.returncode == 0


def _unheeded() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup, around the tests, would have ignored


def test_a_program_that_does_not_close_the_toy_disconnects_it_at_its_end(bluez: Bluez) -> None:
    subprocess.run([sys.executable, "-c", PROGRAM, URL], check=True, timeout=60)
    bluez.expect("disconnected")


def test_a_toy_that_a_killed_program_left_connected_is_found(bluez: Bluez) -> None:
    endless = PROGRAM.replace("< 20", ">= 0")
    with subprocess.Popen([sys.executable, "-c", endless, URL]) as process:
        bluez.expect("notifying")
        process.kill()
    with pytest.raises(DeviceError, match=r"still connected to this computer: Plush Bear \(C0:FF:EE:00:00:01\)"):
        open_device("ble://name:Teddy?find_s=0.2")
    with open_device(f"ble://{TOY}?find_s=0.2") as device:
        take(device, 20)


def test_a_service_that_crashes_ends_the_connection_and_its_successor_has_another(bluez: Bluez) -> None:
    with open_device(f"{URL}&silence_s=0.5", reconnect=True) as device:
        assert isinstance(device, ReconnectingDevice)
        take(device, 20)
        bluez.kill()
        while not device.gaps:
            device.read()
        bluez.start()
        take(device, 20)
        assert device.counters.reconnects == 1
        assert "has stopped sending for 0.5 s" in device.gaps[0].reason
