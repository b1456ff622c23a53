"""Reading a device without waiting, as for many toys in one thread."""

from __future__ import annotations

import socket
import time

import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import write_recording
from plushsense.devices.opening import open_device


@pytest.mark.parametrize("scheme", ["virtual", "replay", "tcp"])
def test_a_device_can_be_asked_without_waiting_and_tells_when_its_bytes_came(scheme, tmp_path, frames):
    path = tmp_path / "tap_1700000000000_400.csv"
    write_recording(path, frames(), load_layout("accel-3"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = {
            "virtual": "virtual://?layout=accel-3",
            "replay": f"replay://{path.as_posix()}?layout=accel-3",
            "tcp": f"tcp://127.0.0.1:{server.getsockname()[1]}?layout=accel-3",
        }[scheme]
        with open_device(place) as device:
            peer = server.accept()[0] if scheme == "tcp" else None
            assert device.arrived_s is None
            device.wait_s = 0.0
            before = time.perf_counter()
            asked, heard = 0, []
            while not heard and time.perf_counter() - before < 5:
                asked += 1
                if peer is not None and asked == 50:
                    peer.sendall(b"10 1 2 3\n20 1 2 4\n")
                heard = device.read() or []
            assert heard
            assert device.arrived_s is not None and device.arrived_s <= time.perf_counter()
            if peer is not None:
                assert asked >= 50 and device.arrived_s >= before
                peer.close()
