"""Sessions of our own recorder come in whole: who, when, what was made again, and every file beside them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import PersonInfo, read_people
from plushsense.recording.writer import SessionHead

Writer = Callable[..., Path]


def test_a_session_comes_in_without_a_warning_or_a_layout(tmp_path: Path, session_writer: Writer) -> None:
    session_writer(tmp_path / "out", "P01", "s1", age_group="child", gender="f", consent="C-1")
    session_writer(tmp_path / "out", "P01", "s2", seed=1)
    session_writer(tmp_path / "out", "P02", "s1", seed=2, age_group="adult", redo=[0])
    done = import_recordings(tmp_path / "out", tmp_path / "DS")
    assert (done.recordings, done.subjects, done.streams) == (6, 2, 3)
    assert done.messages == ()
    assert done.rejected == done.left_out == ()
    assert done.companions == 3 * 4
    assert {(r.subject, r.session) for r in done.dataset.recordings} == {("P01", "s1"), ("P01", "s2"), ("P02", "s1")}
    assert all(r.stream == f"{r.subject}/{r.session}/fulldatastream" for r in done.dataset.recordings)
    assert read_people(tmp_path / "DS") == {
        "P01": PersonInfo("P01", "child", "f", "C-1"),
        "P02": PersonInfo("P02", "adult"),
    }
    (aside,) = [r for r in done.dataset.recordings if r.excluded]
    assert (aside.subject, aside.gesture, done.excluded) == ("P02", "Tail pull", 1)
    mark = json.loads((tmp_path / "DS" / "marks.jsonl").read_text())
    assert (mark["who"], mark["why"], mark["recording"]) == ("recorder", "sneezed", aside.id)
    assert open_dataset(tmp_path / "DS").recordings == done.dataset.recordings
    session = tmp_path / "DS" / "streams" / "P01" / "s1"
    assert sorted(p.name for p in session.iterdir()) == ["fulldatastream.csv", "session.json", "session.jsonl"]
    beside = tmp_path / "DS" / "recordings" / "P01" / "s1"
    assert {p.stem for p in beside.glob("*.json")} == {p.stem for p in beside.glob("*.csv")}


def test_the_head_says_who_whatever_the_folders_are_called(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out", "P07", "morning", simulated=True)
    folder.parent.rename(tmp_path / "out" / "old name")
    done = import_recordings(tmp_path / "out" / "old name" / "morning", tmp_path / "DS")
    assert done.dataset.subjects == ["P07"]
    assert {r.session for r in done.dataset.recordings} == {"morning"}
    assert done.dataset.head.simulated
    assert done.dataset.layout == load_layout("plush-15")


def test_what_a_crash_left_is_named_and_no_fault(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out")
    (folder / "Tail pull_5_9.csv.part").write_text("1; 2")
    (folder / "session.lock").write_text("")
    (folder / "Tail pull_6_9.csv.new").write_text("1; 2")
    (folder / "Tail pull_7_9.csv.torn").write_text("1; 2")
    (folder / "Neck scratch 1_5_9.json").write_text("{")
    (folder / "holiday.png").write_bytes(b"x")
    done = import_recordings(tmp_path / "out", tmp_path / "DS")
    assert {e.file.rsplit("/", 1)[-1]: e.reason.split()[0] for e in done.left_out} == {
        "Tail pull_5_9.csv.part": "not",
        "Tail pull_6_9.csv.new": "not",
        "Tail pull_7_9.csv.torn": "damaged",
        "session.lock": "a",
        "Neck scratch 1_5_9.json": "the",
    }
    assert [e.file for e in done.rejected] == ["P01/s1/holiday.png"]
    assert done.warnings == ()


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"{", "session.json cannot be used"),
        (b'{"format": 1, "subject": ["x"]}', "subject is"),
        (b"[" * 100_000, "session.json cannot be used"),
        (b'{"format": 1, "subject": " ", "session": "1", "started_ms": 1, "layout": {}, "protocol": {}}', "no subject"),
    ],
)
@pytest.mark.slow
def test_a_damaged_head_rejects_its_session_alone(
    tmp_path: Path, session_writer: Writer, head: bytes, said: str
) -> None:
    session_writer(tmp_path / "out", "P01")
    bad = session_writer(tmp_path / "out", "P02", seed=1)
    (bad / "session.json").write_bytes(head)
    done = import_recordings(tmp_path / "out", tmp_path / "DS")
    assert done.dataset.subjects == ["P01"]
    assert len(done.rejected) == 7
    assert all(said in e.reason for e in done.rejected)


def test_a_recording_that_cannot_be_read_takes_its_sidecar_with_it(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out")
    bad = next(folder.glob("Hold*.csv"))
    bad.write_text("")
    done = import_recordings(tmp_path / "out", tmp_path / "DS")
    assert [e.file for e in done.rejected] == [
        f"P01/s1/{bad.name}",
        f"P01/s1/{bad.with_suffix('.json').name}",
    ]
    assert not list((tmp_path / "DS").rglob("Hold*"))


def test_layouts_must_agree(tmp_path: Path, session_writer: Writer) -> None:
    session_writer(tmp_path / "out", "P01")
    with pytest.raises(DatasetError, match="was recorded with the layout 'plush-15', but the given layout"):
        import_recordings(tmp_path / "out", tmp_path / "DS", layout="accel-3")
    assert import_recordings(tmp_path / "out", tmp_path / "DS1", layout="plush-15").recordings == 2
    session_writer(tmp_path / "out", "P02", layout=load_layout("accel-3"))
    with pytest.raises(DatasetError, match="'accel-3', but session 's1' is 'plush-15'.*import them apart"):
        import_recordings(tmp_path / "out", tmp_path / "DS")
    (tmp_path / "plain" / "P01").mkdir(parents=True)
    with pytest.raises(ConfigError, match="--layout is needed"):
        import_recordings(tmp_path / "plain", tmp_path / "DS")


def test_sessions_and_the_authors_folders_mix(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out", "P01")
    (tmp_path / "out" / "P02").mkdir()
    recording = next(folder.glob("Tail*.csv"))
    (tmp_path / "out" / "P02" / recording.name).write_bytes(recording.read_bytes())
    done = import_recordings(tmp_path / "out", tmp_path / "DS")
    assert done.dataset.subjects == ["P01", "P02"]
    assert {r.session for r in done.dataset.recordings if r.subject == "P02"} == {"1"}


def test_people_who_changed_and_a_file_of_people(tmp_path: Path, session_writer: Writer) -> None:
    session_writer(tmp_path / "out", "P01", "s1", age_group="child", consent="C-1")
    session_writer(tmp_path / "out", "P01", "s2", seed=1, age_group="teen")
    (tmp_path / "people.csv").write_text("subject;gender;handedness\nP01;f;left\nP99;m;right\n")
    done = import_recordings(tmp_path / "out", tmp_path / "DS", people=tmp_path / "people.csv")
    assert read_people(tmp_path / "DS") == {"P01": PersonInfo("P01", "teen", "f", "C-1", {"handedness": "left"})}
    assert any("differ in age group ('child', 'teen')" in n for n in done.notes)
    assert any("'P99'" in n for n in done.notes)
    with pytest.raises(DatasetError, match="no people's file"):
        import_recordings(tmp_path / "out", tmp_path / "DS2", people=tmp_path / "nowhere.csv")


def test_codes_that_leave_the_folder_and_texts_that_no_file_holds(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out", "P01")
    head = SessionHead.read(folder)
    assert head is not None
    replace(head, subject="../../evil", session="again-2", age_group="a\nb\x00").write(folder)
    text = (folder / "session.json").read_text().replace('"gender": ""', '"gender": "\\ud800"')
    (folder / "session.json").write_text(text)
    done = import_recordings(tmp_path / "out", tmp_path / "in" / "DS")
    assert {p.name for p in tmp_path.iterdir()} == {"out", "in"}
    assert {p.name for p in (tmp_path / "in").iterdir()} == {"DS"}
    assert {r.session for r in done.dataset.recordings} == {"session-again-2"}
    (person,) = read_people(tmp_path / "in" / "DS").values()
    assert person.gender == "\ufffd"
    assert "\n" not in person.age_group
