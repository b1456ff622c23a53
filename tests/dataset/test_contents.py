import os
import sys
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.files import list_files, match_code, person_folders, raw_files


def test_every_file_has_a_kind_and_its_person(tmp_path: Path) -> None:
    kinds = {
        "dataset.toml": ("head", ""),
        "marks.jsonl": ("marks", ""),
        "marks.jsonl.lock": ("working", ""),
        "subjects.csv": ("people", ""),
        "recordings.csv": ("index", ""),
        "index.json": ("index", ""),
        "notes.txt": ("other", ""),
        "recordings/P1/a_1_2.CSV": ("raw", "P1"),
        "recordings/P1/1/a_1_2.json": ("words", "P1"),
        "recordings/P1/1/photo.png": ("other", "P1"),
        "streams/P2/1/session.jsonl": ("words", "P2"),
        "streams/P2/1/fulldatastream.csv": ("raw", "P2"),
        "sessions/P2/x.json": ("words", "P2"),
        "sessions/P3/x.json": ("words", ""),
        "cache/P1/x.npz": ("cache", ""),
        "evaluations/P1/evaluation.json": ("evaluation", ""),
    }
    for name in kinds:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    assert {str(c.path): (c.kind, c.person) for c in list_files(tmp_path)} == kinds
    assert person_folders(tmp_path) == ["P1", "P2"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs links")
def test_links_are_named_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "nowhere.csv").symlink_to(tmp_path / "gone")
    assert [(str(c.path), c.kind) for c in list_files(tmp_path)] == [("loop", "link"), ("nowhere.csv", "link")]


@pytest.mark.skipif(sys.platform == "win32", reason="needs links and pipes")
def test_raw_files_are_files_of_the_data_set(tmp_path: Path) -> None:
    folder, outside = tmp_path / "DS", tmp_path / "passwd.csv"
    person = folder / "recordings" / "P1"
    person.mkdir(parents=True)
    outside.write_text("x")
    (folder / "kept.csv").write_text("x")
    (person / "a_1_2.csv").symlink_to(folder / "kept.csv")
    assert raw_files(folder) == [("recordings", person / "a_1_2.csv")]
    for number, make in enumerate(
        (
            lambda path: path.symlink_to(outside),
            lambda path: path.symlink_to("/dev/zero"),
            lambda path: path.symlink_to(tmp_path / "nowhere"),
            lambda path: path.symlink_to(tmp_path, target_is_directory=True),
            os.mkfifo,
        )
    ):
        bad = person / f"b_{number}_2.csv"
        make(bad)
        with pytest.raises(DatasetError, match=f"b_{number}_2.csv' is a link to another place, or neither"):
            raw_files(folder)
        assert [c.kind for c in list_files(folder) if c.path.name == bad.name] == ["link"]
        bad.unlink()
    (folder / "streams").symlink_to(folder / "recordings", target_is_directory=True)
    with pytest.raises(DatasetError, match="streams' is a link to another place"):
        raw_files(folder)


def test_one_code_in_two_spellings() -> None:
    assert match_code("p 01", ["P02", "P_01"]) == "P_01"
    assert match_code("P01", ["P011"]) == ""
