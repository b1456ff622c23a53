"""Many toys in one thread: each gets what it would get alone."""

from __future__ import annotations

import time
from itertools import pairwise

import pytest

from plushsense.core.errors import ConfigError
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live, run_many
from plushsense.runtime.classifier import StreamClassifier


def url(n: int, more: str = "speed=0") -> str:
    return f"virtual://?person={n}&seed={n}&seconds={3 + n}&layout=accel-3&{more}"


def test_each_toy_gets_what_it_gets_alone(bundle):
    devices = [open_device(url(n)) for n in range(1, 5)]
    live = run_many([(device, StreamClassifier(bundle())) for device in devices])
    found = list(live)
    for n, device in enumerate(devices):
        with open_device(url(n + 1)) as again:
            alone = list(run_live(again, StreamClassifier(bundle())))
        assert [d for number, d in found if number == n] == alone
        assert device.counters == again.counters
    assert [number for number, _ in found][:1] == [0] and len({number for number, _ in found[:400]}) > 1, "in turn"
    summary = live.summary()
    assert summary.toys == 4 and summary.decisions == len(found) > 300
    assert summary.busy == pytest.approx(summary.cpu_s / summary.wall_s)
    assert list(summary.to_dict()["latency_ms"]) == ["p50", "p95", "p99", "max"]
    assert sum(one.summary().decisions for one in live.runs) == len(found)


def test_paced_toys_are_read_without_waiting_for_any(bundle):
    devices = [open_device(url(n, "speed=20")) for n in range(1, 5)]
    live = run_many([(device, StreamClassifier(bundle())) for device in devices])
    assert all(device.wait_s == 0.0 for device in devices)
    found = list(live)
    assert len(found) >= 20 * (4 + 5 + 6 + 7) - 8
    turns = [number for number, _ in found]
    assert sum(a != b for a, b in pairwise(turns)) > 3, "they speak by turns, not one after the other"


def test_seconds_are_each_toys_own(bundle):
    devices = [open_device(url(n)) for n in (1, 2)]
    found = list(run_many([(device, StreamClassifier(bundle())) for device in devices], seconds=2.0))
    for number in (0, 1):
        assert 1.9 < max(d.t_s for n, d in found if n == number) < 2.0


def test_two_toys_do_not_share_a_classifier(bundle):
    one = StreamClassifier(bundle())
    with open_device(url(1)) as a, open_device(url(2)) as b, pytest.raises(ConfigError, match="share a classifier"):
        run_many([(a, one), (b, one)])


@pytest.mark.parametrize("scheme", ["virtual", "replay", "tcp"])
def test_a_device_can_be_asked_without_waiting_and_tells_when_its_bytes_came(scheme, tmp_path, frames):
    import socket

    from plushsense.core.layouts import load_layout
    from plushsense.core.recorder_csv import write_recording

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
