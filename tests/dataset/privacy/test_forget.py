"""A person leaves a data set: all of theirs, and nothing of anybody else's."""

import gzip
import io
import json
import lzma
import shutil
import tempfile
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from filelock import FileLock, Timeout

from plushsense.core.errors import DatasetError, ForgottenError
from plushsense.core.files import temporary_folder, work_folder
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset import files as dataset_files
from plushsense.dataset import index
from plushsense.dataset.importing import build, importers
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import LOCK, MARKS, Mark, adding_locked, append_marks, read_marks
from plushsense.dataset.privacy import forget as room
from plushsense.dataset.privacy.forget import FORGOTTEN, UNDER_WAY, RemovalRecord, forget, plan_removal, read_removals
from plushsense.dataset.store import read_people, writing_around

pytestmark = pytest.mark.slow

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


@pytest.mark.parametrize("at", ["forgetting.json.7.part", ".marks.jsonl.7.part", "recordings.csv.7.part"])
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
    assert [stone.files for stone in read_removals(folder)] == [3, 3]
    assert not (folder / UNDER_WAY).exists()


def test_who_comes_into_a_set_that_people_were_taken_out_of_is_named(folder: Path, tmp_path: Path) -> None:
    def told() -> list[str]:
        done = import_recordings(tmp_path / "src", folder, add_to=True)
        return [w for w in done.messages if "were removed" in w]

    (folder / "cache").mkdir(exist_ok=True)
    assert told() == []
    forget(folder, "P1")
    (said,) = told()
    assert "P1 were added now" in said
    assert "plushsense forget" in said
    assert told() == [], "only who is new"


def test_a_look_changes_nothing(folder: Path) -> None:
    before = files(folder)
    plan = plan_removal(folder, "P1")
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
    assert set(after) - same == INDEX | {MARKS, "subjects.csv", FORGOTTEN, "adding.lock"}
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
    assert read_removals(folder) == [RemovalRecord(stone["day"], 3)]
    with pytest.raises(DatasetError, match="knows no person 'p 11': it knows P11, P2"):
        forget(folder, "p 11")


def leaving_before(before: dict[str, bytes], folder: Path) -> room.RemovalPlan:
    """The plan for what was there, looked up in a copy."""
    copy = folder.with_name("copy")
    for name, data in before.items():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_bytes(data)
    return plan_removal(copy, "P1")


@pytest.mark.parametrize("step", ["_remove", "_remove_empty", "_rewrite_marks", "write_people", "_finish", "unlink"])
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
    assert [stone.files for stone in read_removals(folder)] == [3]
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


def test_empty_folders_of_an_interrupted_removal_go(folder: Path) -> None:
    for file in [*(folder / "recordings" / "P2").rglob("*.csv"), *(folder / "streams" / "P2").rglob("*.csv")]:
        file.unlink()
    forget(folder, "P2")
    assert not [path for path in folder.rglob("*") if "P2" in path.parts]


def test_the_last_person_can_go(folder: Path) -> None:
    for person in ("P1", "P2", "P11"):
        forget(folder, person)
    assert open_dataset(folder).recordings == []
    assert len(read_removals(folder)) == 3


def test_somebody_who_stands_only_in_the_table_can_go(folder: Path) -> None:
    shutil.rmtree(folder / "recordings" / "P2")
    shutil.rmtree(folder / "streams" / "P2")
    assert forget(folder, "P2").listed
    assert list(read_people(folder)) == ["P1"]


def test_a_second_time_sweeps_what_is_derived(folder: Path) -> None:
    first = forget(folder, "P1")
    assert not first.absent
    once = files(folder)
    again = forget(folder, "P1")
    assert again.absent and (again.files, again.marks, again.caches, again.evaluations) == ((), 0, (), ())
    assert files(folder) == once, "nothing more to remove, and nothing more told"
    # As a program of before, which was not stopped, or one that was killed leaves it.
    for place in (
        "cache/folds",
        "evaluations/late",
        "exports/.tables-unfinished-x1",
        f"../.{folder.name}-unfinished-x2",
    ):
        (folder / place).mkdir(parents=True)
        (folder / place / "rows.csv").write_text("subject\nP1\n")
    (folder / "evaluations" / "without" / "predictions.parquet.part").write_text("P1")
    (folder.parent / ".other-unfinished-x3").mkdir()
    plan = plan_removal(folder, "P1")
    assert plan.leftovers == (
        f"../.{folder.name}-unfinished-x2",
        "evaluations/without/predictions.parquet.part",
        "exports/.tables-unfinished-x1",
    )
    assert (plan.caches, plan.evaluations) == (("cache",), ("evaluations/late",))
    assert plan.mentions == first.mentions
    assert forget(folder, "P1") == plan
    assert files(folder) == once
    assert [p.name for p in sorted(folder.parent.glob(".*"))] == [".other-unfinished-x3"]


def test_the_first_time_also_sweeps_leftovers(folder: Path) -> None:
    left = folder.parent / f".{folder.name}-unfinished-x2" / folder.name
    left.mkdir(parents=True)
    (left / "recordings.csv").write_text("P1")
    assert forget(folder, "P1").leftovers == (f"../.{folder.name}-unfinished-x2",)
    assert not left.parent.exists()


def test_what_is_written_while_forget_waits_goes_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = FileLock.acquire

    def late(lock: FileLock, *args: Any, **more: Any) -> object:
        if not begun:
            begun.append(True)
            (folder / "evaluations" / "late").mkdir()
            (folder / "evaluations" / "late" / "sweep.json").write_text("P1")
        return real(lock, *args, **more)

    begun = list[bool]()
    monkeypatch.setattr(FileLock, "acquire", late)
    assert "evaluations/late" in forget(folder, "P1").evaluations
    assert not (folder / "evaluations" / "late").exists()


def test_an_index_that_still_names_the_person_is_made_anew(folder: Path) -> None:
    kept = {name: (folder / name).read_bytes() for name in INDEX}
    forget(folder, "P1")
    for name, data in kept.items():
        (folder / name).write_bytes(data)
    forget(folder, "P1")
    assert not any("P1/" in (folder / name).read_text() for name in INDEX)
    assert open_dataset(folder).subjects == ["P11", "P2"]


@pytest.mark.parametrize(("module", "slow"), [(index, "build_index"), (dataset_files, "_index_hashes")])
def test_who_opens_meanwhile_sees_and_writes_the_data_set_of_afterwards(
    folder: Path, monkeypatch: pytest.MonkeyPatch, module: ModuleType, slow: str
) -> None:
    (folder / "index.json").unlink()
    real, begun = getattr(module, slow), list[bool]()

    def meanwhile(*args: Any) -> Any:
        found = real(*args)
        if not begun:
            begun.append(True)
            forget(folder, "P1")
        return found

    monkeypatch.setattr(module, slow, meanwhile)
    assert open_dataset(folder).subjects == ["P11", "P2"]
    assert not any("P1/" in (folder / name).read_text() for name in INDEX)


def test_nothing_is_written_while_a_removal_is_not_finished(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = open_dataset(folder).generation
    with monkeypatch.context() as patch:
        patch.setattr(room, "_rewrite_marks", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            forget(folder, "P1")
    for generation in (before, open_dataset(folder).generation):
        with pytest.raises(ForgottenError, match="not finished"), generation.writing():
            raise AssertionError
    assert not (folder / "index.json").exists()
    forget(folder, "P1")
    with pytest.raises(ForgottenError, match="run it again"):
        before.check()
    with open_dataset(folder).generation.writing():
        pass


def test_no_mark_about_a_removed_person_is_written(folder: Path) -> None:
    before = open_dataset(folder)
    forget(folder, "P1")
    with pytest.raises(ForgottenError):
        before.append_marks([Mark("P1/Wave_1000000000000_50", "exclude", "me", "tardy")])
    assert "tardy" not in (folder / MARKS).read_text()
    open_dataset(folder).append_marks([Mark("P2/Wave_1000000000000_50", "include", "me", "tardy")])
    assert "tardy" in (folder / MARKS).read_text()


def test_an_import_holds_the_lock_while_it_writes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = list[str]()

    def spy(real: Any, name: str) -> Any:
        def write(*args: Any) -> Any:
            with pytest.raises(Timeout), FileLock(folder / LOCK, timeout=0):
                raise AssertionError(name)
            held.append(name)
            return real(*args)

        return write

    for name in ("write_people", "write_marks"):
        monkeypatch.setattr(build, name, spy(getattr(build, name), name))
    source = folder.parent / "more" / "P3"
    source.mkdir(parents=True)
    lines = (folder.parent / "src" / "P1" / f"Wave_{10**12}_50.csv").read_text().splitlines()
    (source / f"Wave_{10**12}_49.csv").write_text("\n".join(lines[:-1]))
    people = folder.parent / "people.csv"
    people.write_text("subject,age_group\nP3,child\n")
    import_recordings(source.parent, folder, add_to=True, people=people)
    assert held == ["write_marks", "write_people"] and "P3" in read_people(folder)


def test_what_is_derived_from_results_is_not_written_after_a_removal(folder: Path) -> None:
    inside, outside = (writing_around(place) for place in (folder / "evaluations" / "with", folder.parent))
    forget(folder, "P1")
    with pytest.raises(ForgottenError), inside():
        raise AssertionError
    with outside():
        pass
    assert not (folder.parent / LOCK).exists()


def test_leftovers_of_any_program_are_named_but_nothing_of_a_live_one(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path_factory.mktemp("scratch")
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    with work_folder(folder.parent / "restored") as live, work_folder(folder) as own, temporary_folder() as temporary:
        for place, name in ((live, ".restored-unfinished-killed"), (temporary, ".plushsense-unfinished-killed")):
            (place / "raw.csv").write_text("P1")
            shutil.copytree(place, place.parent / name)
        (own / "raw.csv").write_text("P1")
        kept = {place.name for place in (live, own)}
        plan = forget(folder, "P1")
        assert plan.leftovers == ("../.restored-unfinished-killed", f"{scratch}/.plushsense-unfinished-killed")
        assert {p.name for p in folder.parent.glob(".*-unfinished-*")} == kept
        assert [p.name for p in scratch.iterdir()] == [temporary.name]


def zipped(*names: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, "with P1\n" * 100)
    return out.getvalue()


def array(values: list[str], pack: Any = np.save) -> bytes:
    out = io.BytesIO()
    pack(out, np.array(values))
    return out.getvalue()


KINDS = {
    "plot.svg": b"<svg><text>P1</text></svg>",
    "run.log": b"12:00 evaluating P1\n",
    "settings.yaml": b"people: [P1, P2]\n",
    "no-suffix": b"P1",
    "utf16.txt": "with P1".encode("utf-16"),
    "table.bin": b"\x00\x01\xff\x80 P1.\x00\x02",
    "late.log": b"x" * (1 << 20) + b" and P1 at the end",
    "edge.log": b"x" * ((1 << 20) - 10) + b"    and P1 across the edge",
    "more.log.gz": gzip.compress(b"evaluating P1"),
    "more.log.xz": lzma.compress(b"evaluating P1"),
    "copy.zip": zipped("notes.txt"),
    "people.npy": array(["P2", "P1"]),
    "people.npz": array(["P2", "P1"], np.savez_compressed),
    "sealed.7z": b"7z\xbc\xaf\x27\x1c" + bytes(20),
    "torn.gz": gzip.compress(bytes(range(256)))[:-20],
}
OTHERS = {
    "other.log": b"evaluating P11 and P2, 1P1, P1a\n",
    "numbers.npy": array([1, 2]),  # type: ignore[list-item]
    "blank": b"",
}


def test_files_of_any_kind_that_hold_the_code_are_named(folder: Path) -> None:
    place = folder / "results"
    place.mkdir()
    for name, content in (KINDS | OTHERS).items():
        (place / name).write_bytes(content)
    (folder / "evaluations" / "without" / "note.yaml").write_text("not P1")
    before = {"evaluations/without/note.yaml", *(f"results/{name}" for name in KINDS)}
    mentions = set(plan_removal(folder, "P1").mentions)
    assert {m for m in mentions if m.startswith(("results/", "evaluations/"))} == before


def test_the_predictions_of_an_evaluation_elsewhere_in_the_data_set_are_named(folder: Path) -> None:
    polars = pytest.importorskip("polars")
    polars.DataFrame({"subject": ["P2", "P1"], "y": [1, 2]}).write_parquet(folder / "predictions.parquet")
    polars.DataFrame({"subject": ["P2", "P11"], "y": [1, 2]}).write_parquet(folder / "others.parquet")
    mentions = plan_removal(folder, "P1").mentions
    assert "predictions.parquet" in mentions and "others.parquet" not in mentions


def test_a_code_in_any_writing_is_found(folder: Path) -> None:
    code, place, journal = "Jānis", folder / "results", io.BytesIO()
    place.mkdir()
    np.savez(journal, np.frombuffer(json.dumps({"subject": code}).encode(), dtype=np.uint8))
    for name, content in {
        "escaped.json": json.dumps({"subject": code}).encode(),
        "address.log": b"GET /recordings/J%C4%81nis/a.csv",
        "page.html": b"<td>J&#257;nis</td>",
        "table.bin": b"\0\1" + code.encode() + b"\0\xff\xfe\xfd" * 9,
        "wide.bin": b"\0\1" + code.encode("utf-16-be") + b"\0\xff\xfe\xfd" * 9,
        "journal.npz": array(
            list(json.dumps({"subject": code}).encode()), lambda out, v: np.savez(out, v.astype("u1"))
        ),  # type: ignore[arg-type]
        "row.db": b"\0\3" + f"{code}child".encode() + b"\0\xff\xfe\xfd" * 9,
    }.items():
        (place / name).write_bytes(content)
    (place / "link").symlink_to(f"/somewhere/{code}/x")
    (folder / "subjects.csv").write_text(f"subject,age_group,note\nP1,child,\nP2,adult,brother of {code}\n")
    (folder / "recordings" / code).mkdir()
    (folder / "recordings" / code / "session.json").write_text("{}")
    assert {m for m in plan_removal(folder, code).mentions if m.startswith("results/")} == {
        f"results/{p.name}" for p in place.iterdir()
    }
    assert "subjects.csv" in plan_removal(folder, code).mentions


@pytest.mark.parametrize("text", ["person: 7\n", '{"subject": "7"}', "id,subject\n1,7\n", "<td>7</td>", "/DS/7/a.csv"])
def test_a_code_that_is_a_number_is_found_where_it_may_be_one(folder: Path, text: str) -> None:
    (folder / "recordings" / "7").mkdir()
    (folder / "recordings" / "7" / "session.json").write_text("{}")
    (folder / "with").write_text(text)
    (folder / "without").write_text("at 7 s, 7.5 s and 17, [1, 7, 3]")
    assert [m for m in plan_removal(folder, "7").mentions if m.startswith("with")] == ["with"]


def test_results_of_somebody_whose_files_were_deleted_by_hand_go(folder: Path) -> None:
    shutil.rmtree(folder / "recordings" / "P2")
    shutil.rmtree(folder / "streams" / "P2")
    for name in (*INDEX, "subjects.csv", MARKS):
        (folder / name).unlink()
    assert "evaluations/with" in forget(folder, "P2").evaluations
    with pytest.raises(DatasetError, match="knows no person 'P3'"):
        forget(folder, "P3")


def test_an_import_that_runs_is_waited_for_and_a_program_beside_is_named(folder: Path) -> None:
    with adding_locked(folder), pytest.raises(DatasetError, match="An import is adding"):
        forget(folder, "P1")
    assert open_dataset(folder).subjects == ["P1", "P11", "P2"]
    with work_folder(folder.parent / "copy") as work:
        (work / "raw.csv").write_text("P1")
        assert forget(folder, "P1").running == (f"../{work.name}",)


def test_an_import_that_began_before_a_removal_brings_nobody_back(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importers.scan_source

    def slow(*args: Any) -> Any:
        found = real(*args)
        forget(folder, "P1")
        return found

    monkeypatch.setattr(importers, "scan_source", slow)
    with pytest.raises(ForgottenError):
        import_recordings(folder.parent / "src", folder, add_to=True)
    assert not any("P1/" in name or name.startswith("cache/adding") for name in files(folder))


def test_nothing_is_written_where_the_data_set_was(folder: Path) -> None:
    generation = open_dataset(folder).generation
    folder.rename(folder.with_name("moved"))
    with pytest.raises(ForgottenError, match="moved or deleted"), generation.writing():
        raise AssertionError
    assert not folder.exists()
