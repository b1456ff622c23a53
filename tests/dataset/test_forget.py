"""A person leaves a data set: all of theirs, and nothing of anybody else's."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.recfile import Frames, format_rows, write_recording
from plushsense.core.signal import load_layout
from plushsense.dataset import forget as room
from plushsense.dataset.forget import FORGOTTEN, UNDER_WAY, Tombstone, forget, forgotten, leaving
from plushsense.dataset.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS, Mark, append_marks, read_marks
from plushsense.dataset.people import read_people

ACCEL = load_layout("accel-3")
INDEX = {"recordings.csv", "streams.csv", "index.json"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for person in ("P1", "P2", "P11"):
        place = tmp_path / "src" / person
        place.mkdir(parents=True)
        clock = np.arange(200, dtype=np.int64) * 10
        stream = Frames(rng.integers(0, 900, (200, 3)), clock, clock + 10**12)
        (place / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
        for n in range(2):
            write_recording(place / f"Wave_{10**12 + n}_50.csv", stream.slice(50 * n, 50 * n + 50), ACCEL)
    ds = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset
    (ds.path / "recordings" / "P1" / "session.jsonl").write_text('{"what": "note", "at_ms": 1}\n')
    (ds.path / "recordings" / "P1" / "Wave_1000000000000_50.json").write_text("{}")
    (ds.path / "recordings" / "P2" / "session.jsonl").write_text('{"what": "note", "at_ms": 1, "text": "with P1"}\n')
    (ds.path / "subjects.csv").write_text("subject,age_group,hand\nP1,child,left\nP2,adult,right\n")
    append_marks(ds.path, [Mark(r.id, "exclude", "me", f"ç {r.id}") for r in ds.recordings if r.id.endswith("0000_50")])
    append_marks(ds.path, [Mark("", "accept", "me", "P1 was late", check="rate")])
    with (ds.path / MARKS).open("ab") as file:
        file.write(b'{"recording": "P1/Wa\n{"recor\n')
    for name, people in (("with", ["P1", "P2"]), ("without", ["P2"]), ("unsaid", [])):
        (ds.path / "evaluations" / name).mkdir(parents=True)
        table = {"subjects": [{"subject": p} for p in people]}
        (ds.path / "evaluations" / name / "evaluation.json").write_text(json.dumps(table))
    (ds.path / "cache" / "folds").mkdir(parents=True)
    (ds.path / "cache" / "folds" / "x.npz").write_text("x")
    open_dataset(ds.path)
    return ds.path


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("at", ["forgetting.json.7.part", "marks.jsonl.7.part", "recordings.csv.7.part"])
def test_what_a_killed_program_never_renamed_goes_too(folder: Path, at: str) -> None:
    (folder / at).write_text('{"recording": "P1/Wave"}')
    forget(folder, "P1")
    assert not list(folder.glob("*.part"))


def test_stopped_between_the_last_line_and_the_end_it_is_buried_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forget(folder, "P11")
    whole = Path.unlink

    def killed(path: Path, missing_ok: bool = False) -> None:
        if path.name == UNDER_WAY:
            raise KeyboardInterrupt
        whole(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", killed)
    with pytest.raises(KeyboardInterrupt):
        forget(folder, "P1")
    monkeypatch.undo()
    forget(folder, "P1")
    assert [stone.files for stone in forgotten(folder)] == [3, 3]
    assert not (folder / UNDER_WAY).exists()


def test_who_comes_into_a_set_that_people_were_taken_out_of_is_named(folder: Path, tmp_path: Path) -> None:
    def told() -> list[str]:
        done = import_recordings(tmp_path / "src", folder, add_to=True)
        return [w for w in done.to_dict()["warnings"] if "forgotten" in w]

    (folder / "cache").mkdir(exist_ok=True)
    assert told() == []
    forget(folder, "P1")
    (said,) = told()
    assert "P1 just came in" in said
    assert "plushsense forget" in said
    assert told() == [], "only who is new"


def test_a_look_changes_nothing(folder: Path) -> None:
    before = files(folder)
    plan = leaving(folder, "P1")
    assert files(folder) == before
    assert (len(plan.files), plan.raw, plan.marks, plan.listed) == (5, 3, 2, True)
    assert plan.caches == ("cache",)
    assert plan.evaluations == ("evaluations/unsaid", "evaluations/with")
    assert plan.mentions == ("marks.jsonl", "recordings/P2/session.jsonl")


def test_all_of_one_person_goes_and_nothing_of_another(folder: Path) -> None:
    before = files(folder)
    assert forget(folder, "P1") == leaving_before(before, folder)
    after = files(folder)
    gone = {f for f in before if f not in after}
    assert gone == {f for f in before if "/P1/" in f} | {
        "cache/folds/x.npz",
        "evaluations/with/evaluation.json",
        "evaluations/unsaid/evaluation.json",
    }
    assert not (folder / "recordings" / "P1").exists()
    same = {f for f in after if f in before and after[f] == before[f]}
    assert set(after) - same == INDEX | {MARKS, "subjects.csv", FORGOTTEN}
    assert after[MARKS] == b"".join(line for line in before[MARKS].splitlines(keepends=True) if b'"P1/' not in line), (
        "other people's lines byte for byte"
    )
    assert b"P11/" in after[MARKS]
    assert list(read_people(folder)) == ["P2"]
    assert read_people(folder)["P2"].more == {"hand": "right"}
    ds = open_dataset(folder)
    assert (ds.subjects, len(ds.recordings), len(ds.streams)) == (["P11", "P2"], 4, 2)
    assert set(read_marks(folder)) == {"", "P11/Wave_1000000000000_50", "P2/Wave_1000000000000_50"}
    stone = json.loads((folder / FORGOTTEN).read_text())
    assert set(stone) == {"day", "files"}
    assert forgotten(folder) == [Tombstone(stone["day"], 3)]
    with pytest.raises(DatasetError, match="knows no person 'P1': it knows P11, P2"):
        forget(folder, "P1")


def leaving_before(before: dict[str, bytes], folder: Path) -> room.Leaving:
    """The plan for what was there, looked up in a copy."""
    copy = folder.with_name("copy")
    for name, data in before.items():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_bytes(data)
    return leaving(copy, "P1")


@pytest.mark.parametrize("step", ["_remove", "_remove_empty", "_rewrite_marks", "write_people", "_bury", "unlink"])
def test_stopped_anywhere_the_same_call_finishes(folder: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if step == "unlink":
            real = Path.unlink

            def third(path: Path, missing_ok: bool = False) -> None:
                if path.name.startswith("Wave_1000000000001"):
                    raise KeyboardInterrupt
                real(path, missing_ok)

            patch.setattr(Path, "unlink", third)
        else:
            patch.setattr(room, step, stop)
        with pytest.raises(KeyboardInterrupt):
            forget(folder, "P1")
    # What is left opens, and its index claims no file that is gone.
    for r in open_dataset(folder).recordings:
        assert (folder / r.file).is_file()
    with pytest.raises(DatasetError, match="finish it first"):
        forget(folder, "P2")
    forget(folder, "P1")
    assert open_dataset(folder).subjects == ["P11", "P2"]
    assert not (folder / UNDER_WAY).exists()
    assert [stone.files for stone in forgotten(folder)] == [3]
    assert b'"P1/' not in (folder / MARKS).read_bytes()


@pytest.mark.parametrize("word", ["", " ", "none", "unknown", "..", "../DS", "P", "p1", "P1/", "*"])
def test_who_is_no_person_is_refused(folder: Path, word: str) -> None:
    before = files(folder)
    with pytest.raises(DatasetError):
        forget(folder, word)
    assert files(folder) == before


def test_files_of_others_that_are_gone_are_not_hushed_up(folder: Path) -> None:
    next((folder / "recordings" / "P2").glob("*.csv")).unlink()
    with pytest.raises(DatasetError, match="of other people"):
        forget(folder, "P1")
    assert (folder / "recordings" / "P1").is_dir()


def test_the_last_person_can_go(folder: Path) -> None:
    for person in ("P1", "P2", "P11"):
        forget(folder, person)
    assert open_dataset(folder).recordings == []
    assert len(forgotten(folder)) == 3


def test_somebody_who_stands_only_in_the_table_can_go(folder: Path) -> None:
    shutil.rmtree(folder / "recordings" / "P2")
    shutil.rmtree(folder / "streams" / "P2")
    assert forget(folder, "P2").listed
    assert list(read_people(folder)) == ["P1"]
