"""The index notices every change of what it was made from, and finds recordings in streams of either clock."""

from __future__ import annotations

import json
import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import CsvFormat, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset import index, store
from plushsense.dataset.files import IndexStamp, change_head
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.publishing.package import missing_statements
from plushsense.dataset.store import Dataset, DatasetHead, RecordingInfo, read_index
from plushsense.recording.simulate import SimulationSpec, simulate

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
    monkeypatch.setattr(index, "build_index", refuse)
    assert len(open_dataset(folder).recordings) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="needs pipes and links")
@pytest.mark.parametrize("name", ["marks.jsonl", "index.json", "anything"])
def test_a_pipe_or_a_device_among_the_files_is_refused(folder: Path, name: str) -> None:
    (folder / name).unlink(missing_ok=True)
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(folder / name)
        with pytest.raises(DatasetError, match=f"{name}' is a link to another place, or neither"):
            open_dataset(folder)
        (folder / name).unlink()


def test_a_new_a_changed_and_a_removed_raw_file_are_noticed(folder: Path) -> None:
    write_recording(folder / "recordings" / "ana" / "Wave_3_60.csv", frames(3), ACCEL)
    assert len(open_dataset(folder).recordings) == 3
    path = folder / "recordings" / "ana" / "Wave_3_60.csv"
    path.write_text(path.read_text() + "1, 2, 3, 4, 5\n")
    for _ in range(2):
        with pytest.raises(DatasetError, match=r"1 raw file in '.*' changed since.*Wave_3_60.csv.*restore.*index.json"):
            open_dataset(folder)
    (folder / "index.json").unlink()
    assert next(r for r in open_dataset(folder).recordings if r.gesture == "Wave").rows == 61
    path.unlink()
    with pytest.raises(DatasetError, match=r"lacks 1 raw file that it had \('recordings/ana/Wave_3_60.csv'\)"):
        open_dataset(folder)
    (folder / "index.json").unlink()
    assert len(open_dataset(folder).recordings) == 2


def test_an_index_without_the_recorded_gestures_is_of_an_earlier_version(folder: Path) -> None:
    before = open_dataset(folder).recordings
    path = folder / "recordings.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].endswith(",recorded")
    path.write_text("\n".join(line.rpartition(",")[0] for line in lines) + "\n", encoding="utf-8")
    assert read_index(path, RecordingInfo) == before
    assert open_dataset(folder).recordings == before


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


def test_a_mark_reads_no_raw_file_again_and_comes_to_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = "ana/Shake_1_60", "ana/Shake_2_60"
    whole = open_dataset(folder)
    append_marks(folder, [Mark(first, "trim", "x", start=5, stop=50), Mark(second, "exclude", "x")])
    with monkeypatch.context() as patched:
        patched.setattr(index, "build_index", refuse)
        marked = open_dataset(folder)
    assert [(r.start, r.stop, r.excluded) for r in marked.recordings] == [(5, 50, False), (0, 60, True)]
    again = index.rebuild_index(folder).dataset
    assert [replace(r, rate_hz=0.0) for r in again.recordings] == [replace(r, rate_hz=0.0) for r in marked.recordings]
    assert again.hash == marked.hash
    with monkeypatch.context() as patched:
        patched.setattr(index, "build_index", refuse)
        (folder / "marks.jsonl").unlink()
        with pytest.raises(DatasetError, match=r"Marks that .* missing or changed.*delete index.json"):
            open_dataset(folder)
    (folder / "index.json").unlink()
    assert open_dataset(folder).recordings == whole.recordings, "without the marks, as it was"


def test_a_flipped_bit_of_a_raw_file_or_of_the_marks_is_never_read(folder: Path) -> None:
    """Also one that leaves the size, the time and the syntax as they were, as a failing disk does."""
    path, marks = folder / "recordings" / "ana" / "Shake_1_60.csv", folder / "marks.jsonl"
    append_marks(folder, [Mark("ana/Shake_1_60", "trim", "x", start=5, stop=50)])
    dataset = open_dataset(folder)
    before, rows = path.stat(), path.read_bytes()
    at = rows.rindex(b"1")
    path.write_bytes(rows[:at] + b"3" + rows[at + 1 :])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(FileFormatError, match=r"Shake_1_60.csv' is not the file that was imported.*restore"):
        dataset.read(dataset.recordings[0])
    assert len(dataset.read(dataset.recordings[1])) == 60
    path.write_bytes(rows)
    line = marks.read_bytes()
    marks.write_bytes(line.replace(b'"stop": 50', b'"stop": 10'))
    with pytest.raises(DatasetError, match="missing or changed"):
        open_dataset(folder)
    marks.write_bytes(line)
    append_marks(folder, [Mark("ana/Shake_2_60", "exclude", "x")])
    assert [(r.start, r.stop, r.excluded) for r in open_dataset(folder).recordings] == [(5, 50, False), (0, 60, True)]


def test_a_raw_file_that_became_unreadable_is_named(folder: Path) -> None:
    (folder / "recordings" / "ana" / "Shake_1_60.csv").write_text("")
    for _ in range(2):
        with pytest.raises(DatasetError, match="Shake_1_60.csv' can no longer be read.*restore it"):
            open_dataset(folder)
        assert list(index.rebuild_index(folder).unreadable) == ["recordings/ana/Shake_1_60.csv"]


def test_a_disk_that_cannot_be_written_still_opens(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "index.json").unlink()

    def read_only(*args: object) -> None:
        raise PermissionError(30, "Read-only file system")

    monkeypatch.setattr(index, "write_index", read_only)
    assert len(open_dataset(folder).recordings) == 2


@pytest.mark.slow
def test_recordings_of_delays_are_found_in_their_stream(tmp_path: Path) -> None:
    simulate(tmp_path / "old", SimulationSpec(people=1, repetitions=1, at_rest=0, layout="plush-14"))
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


def rows_of(seed: int, rows: int = 60) -> Frames:
    """Rows of the toy's clock alone, which begins at 0 whenever it is switched on."""
    clock = np.arange(rows, dtype=np.int64) * 10
    values = np.random.default_rng(seed).integers(0, 900, (rows, 3))
    values[0] = 7
    return Frames(values, clock, None)


def lay(folder: Path, streams: dict[str, Frames], recordings: dict[str, Frames]) -> Dataset:
    """A data set of one person's sessions, in a layout without the computer's clock."""
    layout = replace(ACCEL, csv=CsvFormat(("device_ms", "x", "y", "z"), ("t", "x", "y", "z"), ","))
    head = DatasetHead(name="two days", layout=layout, gestures=GestureSet.infer(["Shake"]))
    for session, frames in streams.items():
        path = folder / "streams" / "ana" / session / "fulldatastream.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(format_rows(frames, layout), encoding="utf-8")
    for session, frames in recordings.items():
        path = folder / "recordings" / "ana" / session / f"Shake_1760000000000_{len(frames)}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_recording(path, frames, layout)
    (folder / "dataset.toml").write_text(head.to_toml(), encoding="utf-8")
    return open_dataset(folder)


def test_a_recording_is_looked_for_in_its_own_session_first(tmp_path: Path) -> None:
    one, two = rows_of(1), rows_of(2)
    dataset = lay(tmp_path, {"s1": one, "s2": two}, {"s1": one.slice(0, 20), "s2": two.slice(0, 20)})
    assert [(r.session, r.stream) for r in dataset.recordings] == [
        ("s1", "ana/s1/fulldatastream"),
        ("s2", "ana/s2/fulldatastream"),
    ]


def test_another_days_stream_that_only_begins_alike_is_not_the_recordings(tmp_path: Path) -> None:
    dataset = lay(tmp_path, {"s1": rows_of(1)}, {"s2": rows_of(2).slice(0, 20)})
    (recording,) = dataset.recordings
    assert (recording.stream, recording.stream_row) == ("", -1)
    assert recording.flags[-1] == "not found in the session's stream"


def test_a_stream_that_holds_more_of_the_recording_is_taken(tmp_path: Path) -> None:
    cut, whole = rows_of(2).slice(0, 5), rows_of(2)
    dataset = lay(tmp_path, {"again-2": cut, ".": whole}, {".": whole.slice(0, 20)})
    (recording,) = dataset.recordings
    assert (recording.session, recording.stream, recording.flags) == ("1", "ana/fulldatastream", ())


def test_streams_with_labels_have_the_session_of_their_recordings(tmp_path: Path) -> None:
    rows = "".join(f"ana,{day},W,{1000 + 10 * i},1,2,{i},4,5,6\n" for day in ("a", "b") for i in range(9))
    head = "subject,session,label,time_ms,x_acc,y_acc,z_acc,x_gyro,y_gyro,z_gyro\n"
    (tmp_path / "table.csv").write_text(head + rows)
    (tmp_path / "plain" / "bo").mkdir(parents=True)
    (tmp_path / "plain" / "bo" / "bo_01.csv").write_text(
        "x_acc,y_acc,z_acc,x_gyro,y_gyro,z_gyro,timestamp,label\n"
        + "".join(f"1,2,{i},4,5,6,{i}0,W\n" for i in range(9))
    )
    import_recordings(tmp_path / "table.csv", tmp_path / "DS", layout="phone-6")
    dataset = import_recordings(tmp_path / "plain", tmp_path / "DS", add_to=True).dataset
    assert [s.session for s in dataset.streams] == ["a", "b", "bo_01"]
    assert {r.stream: r.session for r in dataset.recordings} == {s.id: s.session for s in dataset.streams}


def test_streams_are_read_once_as_far_as_they_fit(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    ids = [s.id for s in dataset.streams]
    first = [dataset.read_stream(one) for one in ids]
    assert all(dataset.read_stream(one) is frames for one, frames in zip(ids, first, strict=True))
    monkeypatch.setattr(store, "_CACHED_BYTES", first[0].values.nbytes)
    again = Dataset(dataset.path, dataset.head, dataset.recordings, dataset.streams)
    newest = [again.read_stream(one) for one in ids][-1]
    assert again.read_stream(ids[-1]) is newest, "one is always kept, as recordings are read stream by stream"
    assert again.read_stream(ids[0]) is not first[0] and len(again._cached) == 1
    assert pickle.loads(pickle.dumps(again))._cached == {}, "workers read for themselves"


def test_the_label_may_be_any_column(tmp_path: Path) -> None:
    columns = ("label", "device_ms", "x", "y", "z")
    layout = replace(ACCEL, csv=CsvFormat(columns, columns, ","))
    (tmp_path / "src" / "bo").mkdir(parents=True)
    rows = "".join(f"{'A' if i < 5 else 'B'},{i}0,{i},2,3\n" for i in range(12))
    (tmp_path / "src" / "bo" / "day.csv").write_text(",".join(columns) + "\n" + rows)
    import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout)
    dataset = open_dataset(tmp_path / "DS")
    assert [(r.gesture, dataset.read(r).values[0, 0]) for r in dataset.recordings] == [("A", 0), ("B", 5)]


def test_a_change_of_the_head_is_atomic_and_keeps_the_index(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def entitle(head: DatasetHead) -> DatasetHead:
        return replace(head, consent="all agreed", about=replace(head.about, title="Touch"))

    assert missing_statements(change_head(folder, entitle)) == ["description", "creators", "licence", "contact"]
    assert DatasetHead.read(folder).about.title == "Touch" and IndexStamp.read(folder) == IndexStamp.of(folder)
    before = (folder / "dataset.toml").read_bytes()

    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(DatasetError, match="No space left") as refused:
        change_head(folder, lambda head: replace(head, licence="MIT"))
    assert "cannot be written" in str(refused.value) and (folder / "dataset.toml").read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("recordings/ana/Shake_1_60.csv", "../secret.csv"),
        ("recordings/ana/Shake_1_60.csv", "/etc/hostname"),
        ("recordings/ana/Shake_1_60.csv", "recordings/ana/Shake_2_60.csv"),
        (",0,60,0,60,", ",0,60,0,1" + "0" * 5000 + ","),
        ("100.000", "\x00"),
        ("Shake", "\udcff"),
        ("\n", "\n,"),
    ],
)
@pytest.mark.slow
def test_a_damaged_index_with_a_right_stamp_is_made_anew(folder: Path, old: str, new: str) -> None:
    expected = open_dataset(folder).recordings
    path = folder / "recordings.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8", errors="surrogateescape")
    IndexStamp.of(folder).write(folder)
    assert open_dataset(folder).recordings == expected
    assert path.read_text() == text


@pytest.mark.parametrize("marks", [[], ["1"], [1], [True, "x"], None])
def test_a_damaged_stamp_is_made_anew(folder: Path, marks: object) -> None:
    expected = open_dataset(folder).recordings
    stamp = json.loads((folder / "index.json").read_text())
    (folder / "index.json").write_text(json.dumps(stamp | {"marks": marks}))
    assert open_dataset(folder).recordings == expected and IndexStamp.read(folder) == IndexStamp.of(folder)


def test_an_index_without_a_raw_file_is_made_anew(folder: Path) -> None:
    expected = open_dataset(folder).recordings
    path = folder / "recordings.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    IndexStamp.of(folder).write(folder)
    assert open_dataset(folder).recordings == expected
