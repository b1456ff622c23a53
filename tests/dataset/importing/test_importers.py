import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset, rebuild_index

ACCEL = load_layout("accel-3")
PLUSH = load_layout("plush-15")


def some(rows: int, seed: int = 0, layout: Layout = ACCEL) -> Frames:
    rng = np.random.default_rng(seed)
    clock = np.arange(rows, dtype=np.int64) * 10 + seed * 100_000
    return Frames(rng.integers(0, 900, (rows, layout.n_channels)), clock, clock + 10**12)


def put(folder: Path, label: str, seed: int, rows: int = 60, layout: Layout = ACCEL) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / recording_filename(label, 1000 + seed, rows)
    write_recording(path, some(rows, seed, layout), layout)
    return path


def test_every_file_is_accounted_for(tmp_path: Path) -> None:
    src = tmp_path / "src"
    good = put(src / "ana", "Shake", 1)
    put(src / "ben", "Shake", 2)
    (src / "ben" / "notes.txt").write_text("hello")
    (src / "ben" / "Wave_1_3.csv").write_text("not, a, recording\n")
    (src / "ben" / "Empty_1_3.csv").write_text("")
    (src / "readme.csv").write_text("a,b\n")
    (src / "ben" / "Shake_9_60.csv").symlink_to(good)
    before = good.read_bytes()
    done = import_recordings(src, tmp_path / "DS", layout="accel-3")
    assert (done.recordings, done.subjects, done.streams) == (2, 2, 0)
    refused = {r.file: r.reason for r in done.rejected}
    assert set(refused) == {
        "ben/notes.txt",
        "ben/Wave_1_3.csv",
        "ben/Empty_1_3.csv",
        "readme.csv",
        "ben/Shake_9_60.csv",
    }
    assert "symbolic link" in refused["ben/Shake_9_60.csv"]
    copied = tmp_path / "DS" / done.dataset.recordings[0].file
    assert copied.read_bytes() == before
    assert done.dataset.recordings[0].sha256 == hashlib.sha256(before).hexdigest()
    kept = {p.name for p in (tmp_path / "DS").rglob("*") if p.is_file()}
    assert kept == {good.name, "Shake_1002_60.csv", "dataset.toml", "recordings.csv", "streams.csv", "index.json"}


def test_the_index_is_rebuilt_from_the_raw_files(tmp_path: Path) -> None:
    put(tmp_path / "src" / "ana", "Shake", 1)
    made = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset
    (tmp_path / "DS" / "recordings.csv").unlink()
    again = open_dataset(tmp_path / "DS")
    assert again.recordings == made.recordings
    assert again.hash == made.hash
    (tmp_path / "DS" / "recordings.csv").write_text("id,subject\nx,y\n")
    assert open_dataset(tmp_path / "DS").recordings == made.recordings, "a damaged index is made anew"
    assert rebuild_index(tmp_path / "DS").dataset.recordings == made.recordings


def test_recordings_are_located_in_their_stream(tmp_path: Path) -> None:
    folder = tmp_path / "src" / "ana"
    folder.mkdir(parents=True)
    stream = some(500)
    assert stream.host_ms is not None
    # Two rows of one stamp: the start is the one whose values agree.
    host = stream.host_ms.copy()
    host[199] = host[200]
    stream = Frames(stream.values, stream.device_ms, host)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, ACCEL) + "100")
    write_recording(folder / "Shake_1_80.csv", stream.slice(200, 280), ACCEL)
    write_recording(folder / "Wave_2_60.csv", some(60, 7), ACCEL)
    cut_short = stream.slice(480, 500)
    longer = Frames(
        np.concatenate([cut_short.values, cut_short.values[:5]]),
        np.concatenate([cut_short.device_ms, cut_short.device_ms[-1] + 10 * np.arange(1, 6)]),
        np.concatenate([host[480:500], host[499] + 10 * np.arange(1, 6)]),
    )
    write_recording(folder / "Late_3_25.csv", longer, ACCEL)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    at = {r.gesture: (r.stream_row, r.flags) for r in done.dataset.recordings}
    assert at["Shake"] == (200, ())
    assert at["Wave"][0] == -1
    assert "not found in the session's stream" in at["Wave"][1]
    assert at["Late"][0] == 480
    assert any("only its first 20 rows" in f for f in at["Late"][1])
    assert any("cut off" in f for f in done.dataset.streams[0].flags)


def test_defects_come_as_warnings(tmp_path: Path) -> None:
    folder = tmp_path / "src" / "ana"
    for seed in range(5):
        put(folder, "Shake", seed)
    put(folder, "Shake", 9, rows=900)
    frames = some(60, 11)
    clock = frames.device_ms.copy()
    clock[30:] += 200
    clock[50:] -= 5000
    write_recording(folder / "Shake_77_61.csv", Frames(frames.values, clock, frames.host_ms), ACCEL)
    slow = Frames(frames.values, np.arange(60, dtype=np.int64) * 30, frames.host_ms)
    write_recording(folder / "Shake_78_60.csv", slow, ACCEL)
    (folder / "Shake_79_60.csv").write_bytes((folder / "Shake_78_60.csv").read_bytes())
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    text = "\n".join(done.warnings)
    for said in (
        "900 rows",
        "never stopped",
        "backwards",
        "gap",
        "its name states 61",
        "33.3 Hz",
        "same content",
    ):
        assert said in text, said
    assert not any(r.flags for r in done.dataset.recordings if r.id == "ana/Shake_1000_60")


def test_by_label_folders_need_a_mapping_and_say_so(tmp_path: Path) -> None:
    src = tmp_path / "src"
    for seed in (1, 2, 3):
        put(src / "Tail tap 1", "Tail tap 1", seed, layout=PLUSH)
    done = import_recordings(src, tmp_path / "DS", layout="plush-15")
    assert done.subjects == 0
    assert any("--subjects map.csv" in w for w in done.messages)
    mapping = tmp_path / "map.csv"
    mapping.write_text("file,subject\nTail tap 1_1001_60.csv,S01\nTail tap 1/Tail tap 1_1002_60.csv,S02\n")
    done = import_recordings(src, tmp_path / "DS2", layout="plush-15", subjects=mapping)
    assert done.dataset.subjects == ["S01", "S02"]
    assert done.rejected[0].reason.startswith("not named in the mapping file")
    mapping.write_text("name;person\n")
    with pytest.raises(DatasetError, match="file,subject"):
        import_recordings(src, tmp_path / "DS3", layout="plush-15", subjects=mapping)


def test_a_subject_code_cannot_leave_the_folder(tmp_path: Path) -> None:
    put(tmp_path / "src" / "x", "Shake", 1)
    mapping = tmp_path / "map.csv"
    mapping.write_text("file,subject\nShake_1001_60.csv,../../../evil\n")
    import_recordings(tmp_path / "src", tmp_path / "a" / "DS", layout="accel-3", subjects=mapping)
    outside = [p for p in tmp_path.rglob("Shake*") if "src" not in p.parts]
    assert all((tmp_path / "a" / "DS" / "recordings") in p.parents for p in outside)
    assert outside


def test_spellings_of_one_label_are_offered_as_one_gesture(tmp_path: Path) -> None:
    for person, label in (("P01", "Midair 'S'"), ("P02", "Midair _S_")):
        (tmp_path / "src" / person).mkdir(parents=True)
        for epoch in (1000, 2000):
            write_recording(tmp_path / "src" / person / f"{label}_{epoch}_60.csv", some(60, epoch + len(label)), ACCEL)
    notes = import_recordings(tmp_path / "src", tmp_path / "DS", layout=ACCEL).messages
    assert "'Midair 'S'' (2), 'Midair _S_' (2) look like spellings of one gesture" in notes[0]
    own = GestureSet("own", (Gesture("Midair 'S'", labels=("Midair _S_",)),))
    done = import_recordings(tmp_path / "src", tmp_path / "DS2", layout=ACCEL, gestures=own)
    assert done.gestures == ["Midair 'S'"] and not any("spellings" in note for note in done.messages)
    one = GestureSet("one", (Gesture("Midair 'S'"),))
    notes = import_recordings(tmp_path / "src", tmp_path / "DS3", layout=ACCEL, gestures=one).messages
    assert "'Midair 'S'' has  labels = [\"Midair _S_\"]" in notes[0] and "has no gesture 'Midair _S_' (2)" in notes[1]


def test_unknown_labels_are_kept_and_said(tmp_path: Path) -> None:
    put(tmp_path / "src" / "S1", "tail_tap 1", 1, layout=PLUSH)
    put(tmp_path / "src" / "S1", "Ear tickle", 2, layout=PLUSH)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="plush-15")
    assert done.gestures == ["Ear tickle", "Tail tap 1"]
    assert done.dataset.gestures.labels[-1] == "Ear tickle"
    assert any("Ear tickle" in w and "not in the gesture set" in w for w in done.warnings)


def test_nothing_is_overwritten_and_nothing_is_left_half_done(tmp_path: Path) -> None:
    put(tmp_path / "src" / "ana", "Shake", 1)
    (tmp_path / "DS").mkdir()
    (tmp_path / "DS" / "precious.txt").write_text("x")
    with pytest.raises(DatasetError, match="already holds something"):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="holds no recording"):
        import_recordings(tmp_path / "empty", tmp_path / "DS2", layout="accel-3")
    with pytest.raises(DatasetError, match="There is no "):
        import_recordings(tmp_path / "nowhere", tmp_path / "DS2", layout="accel-3")
    with pytest.raises(DatasetError, match=r"no recording that layout 'plush-15' can read.*has 5 columns"):
        import_recordings(tmp_path / "src", tmp_path / "DS2", layout="plush-15")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["DS", "empty", "src"]


def test_labelled_rows_become_recordings_of_a_stream(tmp_path: Path) -> None:
    layout = load_layout("phone-6")
    folder = tmp_path / "src" / "s01"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    labels = np.array(["SEATED"] * 50 + ["WALKING"] * 70 + ["SEATED"] * 30)
    clock = np.arange(150, dtype=np.int64) * 10
    frames = Frames(rng.integers(-9000, 9000, (150, 6)), clock, None, labels)
    write_recording(folder / "s01_01_sp.csv", frames, layout)
    (tmp_path / "src" / "subjects_info.csv").write_text("subject_id\ns01\n")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="phone-6")
    assert (done.recordings, done.subjects, done.streams) == (3, 1, 1)
    assert done.gestures == ["SEATED", "WALKING"]
    walk = next(r for r in done.dataset.recordings if r.gesture == "WALKING")
    assert (walk.stream_row, walk.rows) == (50, 70)
    assert np.array_equal(done.dataset.read(walk).values, frames.values[50:120])


def test_makeability_imports_whole(imported_study: Any) -> None:
    done = imported_study
    assert (done.recordings, done.subjects, done.streams) == (1485, 27, 24)
    assert [r.file for r in done.rejected] == ["LICENSE"]
    text = "\n".join(done.warnings)
    assert "18907 rows" in text
    in_recordings = [r for r in done.dataset.recordings if r.flags]
    assert any("backwards" in f for r in in_recordings for f in r.flags), "a clock reset inside a recording"
    assert sum(any("gap" in f for f in r.flags) for r in in_recordings) >= 10
    with_stream = [r for r in done.dataset.recordings if r.stream]
    assert len(with_stream) == 24 * 55
    assert all(r.stream_row >= 0 for r in with_stream)


@pytest.mark.exhaustive
def test_har_phone_imports_whole(real_data: Path, tmp_path: Path) -> None:
    done = import_recordings(real_data / "har-phone", tmp_path / "DS", layout="phone-6")
    assert done.subjects == 23
    assert done.gestures == ["SEATED", "SITTING_DOWN", "STANDING_UP", "TURNING", "WALKING"]
    assert sorted(r.file for r in done.rejected) == ["executions_info.csv", "subjects_info.csv"]
    assert sum(r.rows for r in done.dataset.recordings) == sum(s.rows for s in done.dataset.streams)


@pytest.mark.slow
def test_a_simulation_stays_marked(tmp_path: Path) -> None:
    from plushsense.recording.simulate import SimulationSpec, simulate

    simulate(tmp_path / "virtual", SimulationSpec(people=1, repetitions=1, gestures=("Tail pull",)))
    whole = import_recordings(tmp_path / "virtual", tmp_path / "DS", layout="plush-15")
    assert whole.dataset.head.simulated
    assert whole.rejected == ()
    assert "are a simulation" in whole.messages[0]
    assert import_recordings(tmp_path / "virtual" / "P01", tmp_path / "DS1", layout="plush-15").dataset.head.simulated
    assert open_dataset(tmp_path / "DS").head.simulated
