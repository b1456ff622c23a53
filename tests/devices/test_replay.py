"""Replaying files: the same frames, at the device's pace or without waiting."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DeviceError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.devices.opening import open_device

PLUSH = load_layout("plush-15")


def _frames(n: int) -> Frames:
    rng = np.random.default_rng(3)
    device_ms = 5000 + 10 * np.arange(n)
    return Frames(rng.integers(0, 4000, (n, 13)), device_ms, 1_700_000_000_000 + device_ms)


@pytest.fixture
def stream(tmp_path: Path) -> tuple[Path, Frames]:
    frames = _frames(300)
    path = tmp_path / "fulldatastream.csv"
    path.write_text(format_rows(frames, PLUSH), encoding="utf-8")
    return path, frames


def test_all_frames_come_back(stream: tuple[Path, Frames]) -> None:
    path, frames = stream
    with open_device(f"replay://{path}?speed=0") as device:
        got = list(device)
    assert np.array_equal([f.values for f in got], frames.values)
    assert [f.device_ms for f in got] == frames.device_ms.tolist()
    assert frames.host_ms is not None and [f.host_ms for f in got] == frames.host_ms.tolist()
    assert device.counters.frames == 300


def test_a_bare_path_a_folder_and_a_recording(stream: tuple[Path, Frames], tmp_path: Path) -> None:
    path, frames = stream
    name = recording_filename("Tail hit 1", 1_700_000_000_123, 300)
    write_recording(tmp_path / name, frames, PLUSH)
    for url in (f"{path}?speed=0", f"replay://{tmp_path}?speed=0", f"replay://{tmp_path / name}?speed=0",
                f"replay://{str(tmp_path / name).replace(' ', '%20')}?speed=0"):  # fmt: skip
        with open_device(url) as device:
            assert len(list(device)) == 300, url


def test_relative_path(stream: tuple[Path, Frames], monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = stream
    monkeypatch.chdir(path.parent.parent)
    with open_device(f"replay://{path.parent.name}/{path.name}?speed=0") as device:
        assert len(list(device)) == 300


def test_pace(stream: tuple[Path, Frames]) -> None:
    path, _ = stream
    start = time.monotonic()
    with open_device(f"replay://{path}?speed=10") as device:
        assert len(list(device)) == 300
    assert 0.28 <= time.monotonic() - start < 1.5


def test_lost_and_garbage_are_counted(tmp_path: Path) -> None:
    frames = _frames(200)
    frames.values[50, 2] = -2500
    kept = np.delete(np.arange(200), [100, 101])
    assert frames.host_ms is not None
    path = tmp_path / "fulldatastream.csv"
    holed = Frames(frames.values[kept], frames.device_ms[kept], frames.host_ms[kept])
    path.write_text(format_rows(holed, PLUSH) + "not a row\n", encoding="utf-8")
    with open_device(f"replay://{path}?speed=0") as device:
        assert len(list(device)) == 198
    assert (device.counters.lost, device.counters.garbage, device.counters.malformed) == (2, 1, 1)


def test_closing_ends_the_iteration(stream: tuple[Path, Frames]) -> None:
    path, _ = stream
    device = open_device(f"replay://{path}?speed=1")
    for count, _frame in enumerate(device, 1):
        if count == 3:
            device.close()
            device.close()
    assert count < 300


def test_not_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "notes.csv"
    path.write_text("a shopping list\n", encoding="utf-8")
    with pytest.raises(DeviceError, match=r"notes\.csv"):
        open_device(str(path))


def test_a_real_stream_plays(real_data: Path) -> None:
    with open_device(f"replay://{real_data}/makeability-gestures/P01?speed=0&layout=accel-3") as device:
        count = sum(1 for _ in device)
    assert count == device.counters.frames > 47_000
