import errno
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import read_recording, read_stream
from plushsense.devices.base import Frame
from plushsense.devices.wire import LineParser
from plushsense.recording.writer import (
    FLUSH_S,
    AppendedFile,
    BackgroundWriter,
    LogFile,
    SessionEvent,
    StreamFile,
    read_events,
    save_take,
    to_frames,
)

ACCEL = load_layout("accel-3")


def frames(n: int, first_ms: int = 1000) -> list[Frame]:
    return [Frame(5_000_000 + 10 * i, first_ms + 10 * i, (i, -i, 7)) for i in range(n)]


def test_a_stream_grows_by_whole_pieces(tmp_path: Path) -> None:
    for piece in (frames(5), frames(3, 2000)):
        stream = StreamFile(tmp_path / "s.csv", ACCEL)
        stream.write(piece[:2])
        stream.write([])
        stream.write(piece[2:])
        stream.close()
    read = read_stream(tmp_path / "s.csv", ACCEL).frames
    assert read.device_ms.tolist() == [1000, 1010, 1020, 1030, 1040, 2000, 2010, 2020]
    assert read.values[4].tolist() == [4, -4, 7]


def test_delays_join_without_a_seam(tmp_path: Path) -> None:
    table = ACCEL.to_dict()
    table["csv"] = {"columns": ["host_ms", "delay_ms", "x", "y", "z"], "separator": ", "}
    layout = Layout.from_dict(table)
    whole = frames(9)
    stream = StreamFile(tmp_path / "s.csv", layout)
    for start in range(0, 9, 3):
        stream.write(whole[start : start + 3])
    stream.close()
    delays = [int(line.split(", ")[1]) for line in (tmp_path / "s.csv").read_text().splitlines()]
    assert delays == [0] + 8 * [10]


def test_the_delays_of_old_firmware_are_added_up_once(tmp_path: Path) -> None:
    """plush-14 sends delays; the parser adds them up, the files hold a clock, and reading must not add up again."""
    layout = load_layout("plush-14")
    parser = LineParser(layout)
    lines = [" ".join(map(str, [*range(13), 9 + i % 3])) for i in range(300)]
    came = [
        Frame(9_000_000 + 10 * i, p.device_ms, p.values)
        for i, p in enumerate(parser.feed("\n".join(lines).encode() + b"\n"))
    ]
    clock = [f.device_ms for f in came]
    assert clock[-1] == pytest.approx(2990, abs=20)
    stream = StreamFile(tmp_path / "s.csv", layout)
    stream.write(came)
    stream.close()
    path = save_take(tmp_path, to_frames(came[50:120], 13), layout, "Tail pull", 77, {})
    for read, wanted in (
        (read_stream(tmp_path / "s.csv", layout), clock),
        (read_recording(path, layout), clock[50:120]),
    ):
        assert read.frames.device_ms.tolist() == wanted
        assert (read.integrated, read.warnings) == (False, [])


def test_a_recording_has_its_sidecar_and_replaces_nothing(tmp_path: Path) -> None:
    first = save_take(tmp_path, to_frames(frames(4), 3), ACCEL, "Wave (big)", 9, {"gesture": "Wave (big)"})
    again = save_take(tmp_path, to_frames(frames(4), 3), ACCEL, "Wave (big)", 9, {})
    assert [first.name, again.name] == ["Wave _big__9_4.csv", "Wave _big__10_4.csv"]
    assert json.loads(first.with_suffix(".json").read_text()) == {"file": first.name, "gesture": "Wave (big)"}
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".csv", ".csv", ".json", ".json"]
    assert np.array_equal(read_recording(first, ACCEL).frames.values, to_frames(frames(4), 3).values)


def test_a_refused_recording_leaves_nothing_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.replace

    def refuse(source: Path, target: Path) -> None:
        if str(target).endswith(".csv"):
            raise OSError(28, "No space left on device")
        real(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="No space"):
        save_take(tmp_path, to_frames(frames(4), 3), ACCEL, "Wave", 9, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="Windows needs no descriptor for a folder")
def test_nothing_is_opened_once_a_recording_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails can be done again: a recording that lies there already would be there twice."""
    real = os.open

    def exhausted(path: Any, *given: Any, **more: Any) -> int:
        if list(tmp_path.glob("*.csv")):
            raise OSError(errno.EMFILE, "Too many open files")
        return real(path, *given, **more)

    monkeypatch.setattr(os, "open", exhausted)
    save_take(tmp_path, to_frames(frames(4), 3), ACCEL, "Wave", 9, {})


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_is_an_oserror() -> None:
    file = AppendedFile(Path("/dev/full"))
    with pytest.raises(OSError, match="No space left"):
        file.append(b"x\n")
    file.close()


def test_events_are_appended(tmp_path: Path) -> None:
    for n in range(2):
        log = LogFile(tmp_path)
        log.write([SessionEvent("note", n, {"text": "ä"}), SessionEvent("pause", n)])
        log.write([])
        log.close()
    assert [(e.kind, e.at_ms) for e in read_events(tmp_path)] == [("note", 0), ("pause", 0), ("note", 1), ("pause", 1)]


def test_rows_of_a_fast_toy_are_waited_for_by_the_half_second_of_the_toy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a simulated toy that runs faster than real time, a crash loses no more than the last second of the toy."""
    stream, log = StreamFile(tmp_path / "s.csv", ACCEL), LogFile(tmp_path)
    write, failed = stream.write, list[Exception]()

    def slowly(rows: Sequence[Frame]) -> None:
        time.sleep(0.05)
        write(rows)

    monkeypatch.setattr(stream, "write", slowly)
    writer = BackgroundWriter(stream, log, synchronous=True, on_fail=failed.append)
    rows = frames(300)
    for at in range(0, 300, 10):
        writer.add_frames(rows[at : at + 10], 10.0 * (at + 10))
        writer.wait_written()
        on_disk = (tmp_path / "s.csv").read_bytes().count(b"\n")
        assert at + 10 - on_disk <= 100.0 * FLUSH_S
    writer.close()
    log.close()
    assert (tmp_path / "s.csv").read_bytes().count(b"\n") == 300
    assert failed == []
