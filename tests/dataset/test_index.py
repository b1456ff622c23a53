"""The index notices every change of what it was made from, and finds recordings in streams of either clock."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.recfile import Frames, format_rows, write_recording
from plushsense.core.signal import load_layout
from plushsense.dataset import index
from plushsense.dataset.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.recording.simulate import simulate

ACCEL = load_layout("accel-3")


def frames(seed: int, rows: int = 60) -> Frames:
    clock = np.arange(rows, dtype=np.int64) * 10 + seed * 100_000
    return Frames(np.random.default_rng(seed).integers(0, 900, (rows, 3)), clock, clock + 10**12)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "src" / "ana").mkdir(parents=True)
    for seed in (1, 2):
        write_recording(tmp_path / "src" / "ana" / f"Shake_{seed}_60.csv", frames(seed), ACCEL)
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    return tmp_path / "DS"


def refuse(*args: object) -> None:
    raise AssertionError("read again although nothing changed")


def test_nothing_is_read_again_when_nothing_changed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "build", refuse)
    assert len(open_dataset(folder).recordings) == 2


def test_a_new_a_changed_and_a_removed_raw_file_are_noticed(folder: Path) -> None:
    write_recording(folder / "recordings" / "ana" / "Wave_3_60.csv", frames(3), ACCEL)
    assert len(open_dataset(folder).recordings) == 3
    path = folder / "recordings" / "ana" / "Wave_3_60.csv"
    path.write_text(path.read_text() + "1, 2, 3, 4, 5\n")
    assert next(r for r in open_dataset(folder).recordings if r.gesture == "Wave").rows == 61
    path.unlink()
    with pytest.raises(DatasetError, match=r"lacks 1 raw file that it had \('recordings/ana/Wave_3_60.csv'\)"):
        open_dataset(folder)
    (folder / "index.json").unlink()
    assert len(open_dataset(folder).recordings) == 2


def test_an_emptied_index_is_made_anew(folder: Path) -> None:
    header = (folder / "recordings.csv").read_text().splitlines()[0]
    for text in ("", header + "\n"):
        (folder / "recordings.csv").write_text(text)
        assert len(open_dataset(folder).recordings) == 2


def test_a_mark_within_the_same_clock_tick_counts(folder: Path) -> None:
    append_marks(folder, [Mark("ana/Shake_1_60", "exclude", "x")])
    now = (folder / "recordings.csv").stat()
    os.utime(folder / "marks.jsonl", ns=(now.st_mtime_ns, now.st_mtime_ns))
    assert len(open_dataset(folder).used) == 1


def test_a_raw_file_that_became_unreadable_is_named(folder: Path) -> None:
    (folder / "recordings" / "ana" / "Shake_1_60.csv").write_text("")
    for _ in range(2):
        with pytest.raises(DatasetError, match="Shake_1_60.csv' can no longer be read.*bring it back"):
            open_dataset(folder)
        assert list(index.rebuild(folder).unreadable) == ["recordings/ana/Shake_1_60.csv"]


def test_a_disk_that_cannot_be_written_still_opens(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "index.json").unlink()

    def read_only(*args: object) -> None:
        raise PermissionError(30, "Read-only file system")

    monkeypatch.setattr(index, "write_index", read_only)
    assert len(open_dataset(folder).recordings) == 2


def test_recordings_of_delays_are_found_in_their_stream(tmp_path: Path) -> None:
    simulate(tmp_path / "old", people=1, repetitions=1, at_rest=0, layout="plush-14")
    done = import_recordings(tmp_path / "old", tmp_path / "DS", layout="plush-14")
    assert done.recordings == 17
    rows = [r.stream_row for r in done.dataset.recordings]
    assert min(rows) > 0
    assert len(set(rows)) == 17
    assert not any("stream" in f for r in done.dataset.recordings for f in r.flags)


def test_delays_are_compared_not_only_values(tmp_path: Path) -> None:
    layout = load_layout("plush-14")
    delays = np.tile([9, 11, 10, 10, 12, 8], 50).astype(np.int64)
    values = np.tile(np.arange(13), (300, 1)).astype(np.int64)
    stream = Frames(values, delays, np.full(300, 10**12) + np.cumsum(delays) // 40 * 40)
    (tmp_path / "src" / "ana").mkdir(parents=True)
    (tmp_path / "src" / "ana" / "fulldatastream.csv").write_text(format_rows(stream, layout))
    write_recording(tmp_path / "src" / "ana" / "Shake_1_60.csv", stream.slice(123, 183), layout)
    (recording,) = import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout).dataset.recordings
    assert recording.stream_row == 123
    assert not any("stream" in f for f in recording.flags)
