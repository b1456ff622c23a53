"""Whose the files of a source folder are, and what keeps an import from merging people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.recording.simulate import SimulationSpec, simulate

ACCEL = load_layout("accel-3")
PLUSH = load_layout("plush-15")
PHONE = load_layout("phone-6")


def put(folder: Path, label: str, seed: int, layout: Layout = ACCEL) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    clock = np.arange(60, dtype=np.int64) * 10 + seed * 100_000
    labels = np.array(["WALK"] * 60) if layout is PHONE else None
    path = folder / recording_filename(label, 1000 + seed, 60)
    write_recording(path, Frames(rng.integers(0, 900, (60, layout.n_channels)), clock, clock + 10**12, labels), layout)
    return path


@pytest.mark.parametrize("layout", [ACCEL, PHONE], ids=lambda x: x.name)
def test_the_nearest_folder_is_the_person(tmp_path: Path, layout: Layout) -> None:
    for seed, person in enumerate(("P01", "P02", "P03")):
        put(tmp_path / "top" / "study" / person, "Shake", seed, layout)
    for source in ("top/study", "top"):
        done = import_recordings(tmp_path / source, tmp_path / f"out {source}".replace("/", " "), layout=layout)
        assert done.dataset.subjects == ["P01", "P02", "P03"], source


@pytest.mark.parametrize("layout", [ACCEL, PHONE], ids=lambda x: x.name)
def test_people_of_one_name_in_two_places_are_not_merged(tmp_path: Path, layout: Layout) -> None:
    put(tmp_path / "src" / "P01" / "session1", "Shake", 1, layout)
    put(tmp_path / "src" / "P02" / "session1", "Shake", 2, layout)
    with pytest.raises(DatasetError, match="'P01/session1' and 'P02/session1'.*--subjects map.csv") as refusal:
        import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "DS").exists()
    mapping = tmp_path / "map.csv"
    mapping.write_text("file,subject\nShake_1001_60.csv,P01\nShake_1002_60.csv,P02\n")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout, subjects=mapping)
    assert done.dataset.subjects == ["P01", "P02"]


def test_a_folder_of_recordings_in_another_is_unclear(tmp_path: Path) -> None:
    put(tmp_path / "src" / "P01", "Shake", 1)
    put(tmp_path / "src" / "P01" / "old", "Shake", 2)
    with pytest.raises(DatasetError, match="not clear.*old"):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")


def test_codes_that_would_share_a_folder_are_refused(tmp_path: Path) -> None:
    put(tmp_path / "src" / "x", "Shake", 1)
    put(tmp_path / "src" / "y", "Shake", 2)
    mapping = tmp_path / "map.csv"
    mapping.write_text("file,subject\nShake_1001_60.csv,a/b\nShake_1002_60.csv,a:b\n")
    with pytest.raises(DatasetError, match="'a/b' and 'a:b' would share"):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3", subjects=mapping)


def test_a_data_set_is_no_source(tmp_path: Path) -> None:
    both = tmp_path / "both"
    put(both / "src" / "ana", "Shake", 1)
    put(both / "src" / "ben", "Shake", 2)
    import_recordings(both / "src", both / "DS", layout="accel-3")
    with pytest.raises(DatasetError, match="is a data set already: open it as it is"):
        import_recordings(both / "DS", tmp_path / "DS2", layout="accel-3")
    with pytest.raises(DatasetError, match="DS' in .* is a data set already"):
        import_recordings(both, tmp_path / "DS2", layout="accel-3")
    assert not (tmp_path / "DS2").exists()
    done = import_recordings(both / "DS" / "recordings", tmp_path / "DS2", layout="accel-3")
    assert done.dataset.subjects == ["ana", "ben"]


@pytest.mark.slow
def test_a_simulation_is_known_from_above_below_and_its_head(tmp_path: Path) -> None:
    simulate(tmp_path / "a" / "virtual", SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail pull",)))
    deep = tmp_path / "a" / "virtual" / "x" / "y"
    deep.parent.mkdir()
    (tmp_path / "a" / "virtual" / "P01").rename(deep)
    first = import_recordings(tmp_path / "a", tmp_path / "DS", layout="plush-15")
    for number, source in enumerate((tmp_path / "a", deep, tmp_path / "DS" / "recordings")):
        done = import_recordings(source, tmp_path / f"again{number}", layout="plush-15")
        assert done.dataset.head.simulated, source
        assert done.rejected == ()
    assert first.dataset.head.simulated


def test_nobody_is_not_a_person(tmp_path: Path) -> None:
    src = tmp_path / "src"
    put(src / "P01", "Tail pull", 1, PLUSH)
    put(src / "P02", "Tail pull", 2, PLUSH)
    put(src / "At rest", "At rest", 3, PLUSH)
    done = import_recordings(src, tmp_path / "DS", layout="plush-15")
    assert done.dataset.subjects == ["P01", "P02"]
    assert [r.subject for r in done.dataset.recordings if r.gesture == "At rest"] == ["none"]
    assert open_dataset(tmp_path / "DS").recordings == done.dataset.recordings


def test_rest_in_a_persons_folder_is_nobodys_and_still_in_that_stream(tmp_path: Path) -> None:
    folder = tmp_path / "src" / "P01"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    clock = np.arange(300, dtype=np.int64) * 10
    stream = Frames(rng.integers(0, 900, (300, 13)), clock, clock + 10**12)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, PLUSH))
    write_recording(folder / "At rest_1_60.csv", stream.slice(20, 80), PLUSH)
    write_recording(folder / "Tail pull_2_60.csv", stream.slice(100, 160), PLUSH)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="plush-15")
    assert [(r.gesture, r.subject, r.stream, r.stream_row) for r in done.dataset.recordings] == [
        ("At rest", "none", "P01/fulldatastream", 20),
        ("Tail pull", "P01", "P01/fulldatastream", 100),
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,subject\nShake_1001_60.csv\n", "line 2 has no subject"),
        ("file,subject\nShake_1001_60.csv,\n", "line 2 has no subject"),
        ("file,subject\n,ana\n", "line 2 has no file"),
        ("file,subject\na.csv,ana\na.csv,ben\n", "gives 'a.csv' to 'ana' and 'ben'"),
    ],
)
def test_a_wrong_mapping_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    put(tmp_path / "src" / "x", "Shake", 1)
    (tmp_path / "map.csv").write_text(text)
    with pytest.raises(DatasetError, match=said):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3", subjects=tmp_path / "map.csv")


def test_a_mapping_of_files_that_are_not_there_is_said(tmp_path: Path) -> None:
    put(tmp_path / "src" / "x", "Shake", 1)
    (tmp_path / "map.csv").write_text("file,subject\nShake_1001_60.csv,ana\nShake_9_9.csv,ana\n")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3", subjects=tmp_path / "map.csv")
    assert done.messages[0] == "files that the mapping names do not exist (1): 'Shake_9_9.csv'"


def test_upper_case_suffixes_and_odd_files_are_accounted_for(tmp_path: Path) -> None:
    src = tmp_path / "src"
    path = put(src / "ana", "Shake", 1)
    path.rename(path.with_suffix(".CSV"))
    put(src / "ana", "shake", 1)
    put(src / "ana", "Shake", 2)
    (src / "linked").symlink_to(src / "ana")
    done = import_recordings(src, tmp_path / "DS", layout="accel-3")
    assert sorted(r.file for r in done.rejected) == ["ana/shake_1001_60.csv", "linked"]
    assert done.recordings == 2
    assert open_dataset(tmp_path / "DS").recordings == done.dataset.recordings


def test_labels_that_differ_in_case_are_one_gesture(tmp_path: Path) -> None:
    put(tmp_path / "src" / "ana", "Tail Tap", 1)
    put(tmp_path / "src" / "ben", "tail_tap", 2)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    assert done.gestures == ["Tail Tap"]
    (tmp_path / "rows" / "s1").mkdir(parents=True)
    labels = np.array(["Walk"] * 20 + ["Sit"] * 20 + ["WALK"] * 20)
    frames = Frames(np.zeros((60, 6), np.int64), np.arange(60, dtype=np.int64) * 10, None, labels)
    write_recording(tmp_path / "rows" / "s1" / "a.csv", frames, PHONE)
    done = import_recordings(tmp_path / "rows", tmp_path / "DS2", layout="phone-6")
    assert done.gestures == ["Sit", "Walk"]
    (tmp_path / "DS2" / "index.json").unlink()
    assert open_dataset(tmp_path / "DS2").recordings == done.dataset.recordings


def test_destinations_that_are_odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(tmp_path / "src" / "ana", "Shake", 1)
    mine = tmp_path / "DS.importing"
    mine.mkdir()
    (mine / "thesis.txt").write_text("x")
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    assert (mine / "thesis.txt").is_file()
    (tmp_path / "afile").write_text("x")
    with pytest.raises(DatasetError, match="cannot be (made|created)"):
        import_recordings(tmp_path / "src", tmp_path / "afile" / "x", layout="accel-3")
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    import_recordings(tmp_path / "src", tmp_path / "link", layout="accel-3")
    assert len(open_dataset(tmp_path / "empty").recordings) == 1
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert import_recordings(tmp_path / "src", ".", layout="accel-3").recordings == 1
    assert len(open_dataset(".").recordings) == 1
    assert {p.name for p in tmp_path.iterdir()} == {"src", "DS", "DS.importing", "afile", "empty", "link", "here"}
