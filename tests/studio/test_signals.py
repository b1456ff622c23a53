"""The buffer keeps the newest samples, and a tapped toy reads as the toy itself."""

from __future__ import annotations

import threading

import numpy as np

from plushsense.core.layouts import load_layout
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.studio.app.toys import SampleBuffer, TappedDevice

ACCEL = load_layout("accel-3")


def frames(*device_ms: int) -> list[Frame]:
    return [Frame(0, ms, (ms, -ms, 0)) for ms in device_ms]


def test_pieces_join_without_a_hole_and_without_twice() -> None:
    buffer = SampleBuffer(ACCEL, 100)
    assert len(buffer.since(0).seconds) == 0
    buffer.add(frames(1000, 1010, 1020))
    first = buffer.since(0)
    assert first.seconds.tolist() == [0.0, 0.01, 0.02]
    assert first.values.tolist() == [[ms, -ms, 0] for ms in (1000, 1010, 1020)]
    buffer.add(frames(1030))
    second = buffer.since(first.end)
    assert second.values[:, 0].tolist() == [1030]
    assert len(buffer.since(second.end).seconds) == 0


def test_a_slow_reader_gets_the_newest_in_order() -> None:
    buffer = SampleBuffer(ACCEL, 10)
    buffer.add(frames(*range(0, 250, 10)))
    piece = buffer.since(0)
    assert piece.values[:, 0].tolist() == list(range(150, 250, 10))
    assert piece.end == buffer.count == 25
    assert buffer.since(0, most=3).values[:, 0].tolist() == [220, 230, 240]


def test_time_goes_on_over_a_reset_of_the_clock() -> None:
    buffer = SampleBuffer(ACCEL, 100)
    buffer.add(frames(5000, 5010))
    buffer.add(frames(0, 10))
    seconds = buffer.since(0).seconds
    assert np.all(np.diff(seconds) >= 0)
    assert seconds.tolist() == [0.0, 0.01, 0.01, 0.01]


def test_a_single_impossible_time_moves_nothing() -> None:
    buffer = SampleBuffer(ACCEL, 100)
    buffer.add(frames(40_000, 40_010, 0, 40_030, 90_000, 40_050))
    assert buffer.since(0).seconds.tolist() == [0.0, 0.01, 0.01, 0.03, 0.03, 0.05]


def test_readers_beside_the_writer_see_whole_samples() -> None:
    buffer = SampleBuffer(ACCEL, 64)
    done = threading.Event()
    torn: list[object] = []

    def read() -> None:
        place = 0
        while not done.is_set():
            piece = buffer.since(place)
            place = piece.end
            if not np.array_equal(piece.values[:, 0], -piece.values[:, 1]):
                torn.append(piece)

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for start in range(0, 20_000, 20):
        buffer.add(frames(start, start + 10))
    done.set()
    for reader in readers:
        reader.join()
    assert torn == []
    assert buffer.count == 2000


def test_a_tapped_toy_reads_as_the_toy_and_fills_the_ring() -> None:
    url = "virtual://?person=2&speed=0&seconds=3"
    with open_device(url) as plain:
        expected = [f.values for f in plain]
    with TappedDevice(open_device(url)) as tapped:
        got = [f.values for f in tapped]
        assert got == expected
        assert tapped.buffer.count == len(expected) == tapped.counters.frames
        assert tapped.buffer.since(0).values.tolist() == [list(v) for v in expected]
        assert tapped.inner is tapped.device
    assert tapped.device.closed
