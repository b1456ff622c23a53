"""Folders as the paper's published scripts leave them: how many recordings each gives, and one warning for a kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.recorder_csv import parse_name
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.results import ImportResult, group_flags
from plushsense.dataset.importing.truncation import CHOICES
from plushsense.dataset.index import open_dataset
from plushsense.dataset.labelling import relabel_recordings
from plushsense.dataset.marks import BY_HAND, read_marks
from plushsense.dataset.quality.checking import check
from support import paper_scripts as scripts
from support.real_times import as_if_real

pytestmark = pytest.mark.slow

RECORDINGS = 3 * len(scripts.GESTURES) * 2


def imported(source: Path, dest: Path, integers: int = 15, **more: object) -> ImportResult:
    return import_recordings(source, dest, layout=f"plush-{integers}", **more)  # type: ignore[arg-type]


def kinds(done: ImportResult) -> list[str]:
    """Warnings without those that the virtual people and the missing person codes cause."""
    known = ("these recordings are a simulation", "the folders are gestures")
    return [w for w in done.messages if not w.startswith(known)]


@pytest.fixture
def labelled(tmp_path: Path) -> Path:
    """A study after the first script; two recordings had the same name, so that one has " (1)" behind it."""
    root = tmp_path / "study"
    scripts.record(root)
    mine = min((root / scripts.SESSIONS / "P01").glob("Tail pull*"))
    other = min((root / scripts.SESSIONS / "P02").glob("Tail pull*"))
    other.rename(other.with_name(mine.name))
    scripts.move_by_label(root)
    return root


@pytest.mark.parametrize("integers", [15, 14])
def test_a_folder_for_each_person(tmp_path: Path, integers: int) -> None:
    scripts.record(tmp_path / "study", integers=integers)
    done = imported(tmp_path / "study", tmp_path / "DS", integers)
    assert (done.recordings, done.subjects, done.streams) == (RECORDINGS, 3, 3)
    assert len(kinds(done)) == (integers == 14), kinds(done)
    assert all(r.stream and not r.excluded for r in done.dataset.recordings)
    assert all("delays" in w and w.startswith("21 recordings or streams") for w in kinds(done))


def test_names_that_exist_twice(labelled: Path, tmp_path: Path) -> None:
    odd = [p for p in (labelled / scripts.LABELLED).rglob("*.csv") if p.stem.endswith(" (1)")]
    assert len(odd) == 1
    done = imported(labelled, tmp_path / "DS")
    assert done.recordings == RECORDINGS
    assert [r.id for r in done.dataset.recordings if r.id.endswith(" (1)")] == [f"unknown/{odd[0].stem}"]
    # The script gives this file the name of another recording, so that the rows in the name are not its own.
    assert ["its name states" in w for w in kinds(done)] == [True]
    name = parse_name("Tail pull_1760094338537_252 (12).csv")
    assert name is not None
    assert (name.label, name.epoch_ms, name.rows) == ("Tail pull", 1760094338537, 252)
    assert parse_name("Tail pull_1760094338537_252 (copy).csv") is None


def test_choices_before_the_truncation_are_marks(labelled: Path, tmp_path: Path) -> None:
    chosen = scripts.choose(labelled)
    for number, source in enumerate((labelled, labelled / scripts.LABELLED)):
        done = imported(source, tmp_path / f"DS{number}")
        assert (done.recordings, done.trimmed, len(kinds(done))) == (RECORDINGS, RECORDINGS - 1, 2)
        states = read_marks(done.dataset.path)
        for r in done.dataset.recordings:
            name = Path(r.file).name
            rows, cut = chosen.get(name, (r.rows, 0))
            assert (r.start, r.stop, r.rows) == (cut, rows, rows), name
            assert (name in chosen) == (r.id in states and states[r.id].how == BY_HAND)


def test_cut_recordings_and_their_backup(labelled: Path, tmp_path: Path) -> None:
    chosen = scripts.choose(labelled)
    backup = scripts.truncate(labelled, chosen)
    done = imported(labelled, tmp_path / "CUT")
    assert (done.recordings, done.trimmed) == (RECORDINGS, RECORDINGS - 1)
    assert {r.start for r in done.dataset.recordings} == {0}, "the cut was made before"
    assert any("were carried out before the import" in w for w in kinds(done))
    originals = [e for e in done.left_out if e.file.startswith(scripts.BACKUP)]
    assert len(originals) == RECORDINGS and all("import that folder alone" in e.reason for e in originals)
    whole = imported(backup, tmp_path / "WHOLE")
    assert (whole.recordings, whole.trimmed) == (RECORDINGS, RECORDINGS - 1)
    assert sum(r.start for r in whole.dataset.recordings) == 40 * sum(n > 0 for _, n in chosen.values())


def test_a_choice_that_would_leave_nothing_is_no_trim(labelled: Path, tmp_path: Path) -> None:
    chosen = scripts.choose(labelled)
    name = next(iter(chosen))
    text = (labelled / CHOICES).read_text()
    (line,) = (line for line in text.splitlines() if line.startswith(f"{name},"))
    (labelled / CHOICES).write_text(text.replace(line, line.rpartition(",")[0] + f",{chosen[name][0]}"))
    done = imported(labelled, tmp_path / "DS")
    (found,) = (r for r in done.dataset.recordings if Path(r.file).name == name)
    assert (found.rows, found.start) == (chosen[name][0], 0)
    (note,) = (w for w in kinds(done) if "cuts of the truncation script" in w)
    assert "1 would leave nothing, so that recordings stay whole" in note


def test_a_recording_moved_to_another_label_has_the_label_of_its_folder(labelled: Path, tmp_path: Path) -> None:
    """The authors correct a label by moving the file, whose name then still says the old one."""
    folder = labelled / scripts.LABELLED
    moved = min(p for p in (folder / "Tail pull").glob("*.csv") if "(" not in p.name)
    moved.rename(folder / "Tail tap 2" / moved.name)
    done = imported(labelled, tmp_path / "DS")
    assert {r.subject for r in done.dataset.recordings} == {"unknown"}
    (found,) = (r for r in done.dataset.recordings if Path(r.file).name == moved.name)
    assert (found.gesture, found.recorded) == ("Tail tap 2", "Tail pull")
    assert sum(r.gesture == "Tail tap 2" for r in done.dataset.recordings) == 7
    assert (
        f"1 recording in the folder of another gesture than the name says (the first: '{moved.name}' in 'Tail tap 2'): "
        "the folder's label is taken by a mark, as the authors' scripts read the label from the folder"
    ) in done.notes
    assert preview_import(labelled, layout="plush-15").gestures["Tail tap 2"] == 7
    # A mapping names people, not labels.
    names = [p.name for p in folder.rglob("*.csv")]
    (tmp_path / "map.csv").write_text("file,subject\n" + "".join(f"{name},P07\n" for name in names))
    mapped = imported(labelled, tmp_path / "MAPPED", subjects=tmp_path / "map.csv")
    assert [r.gesture for r in mapped.dataset.recordings if Path(r.file).name == moved.name] == ["Tail tap 2"]
    assert mapped.dataset.subjects == ["P07"]


def test_a_correction_after_the_import_reaches_the_data_set(labelled: Path, tmp_path: Path) -> None:
    folder = labelled / scripts.LABELLED
    assert imported(labelled, tmp_path / "DS").recordings == RECORDINGS
    first, other = sorted((folder / "Tail pull").glob("*.csv"))[:2]
    for path in (first, other):
        path.rename(folder / "Tail tap 2" / path.name)
    relabel_recordings(open_dataset(tmp_path / "DS"), [f"unknown/{other.stem}"], "Back stroke 1", "K")
    done = import_recordings(labelled, tmp_path / "DS", add_to=True)
    labels = {Path(r.file).name: r.gesture for r in done.dataset.recordings}
    assert (labels[first.name], labels[other.name]) == ("Tail tap 2", "Back stroke 1"), "a person's mark stays"


def test_later_moves_reach_the_data_set_until_a_person_decides(labelled: Path, tmp_path: Path) -> None:
    folder = labelled / scripts.LABELLED
    name = min((folder / "Tail pull").glob("*.csv")).name
    imported(labelled, tmp_path / "DS")

    def label() -> str:
        done = import_recordings(labelled, tmp_path / "DS", add_to=True)
        return next(r.gesture for r in done.dataset.recordings if Path(r.file).name == name)

    before = "Tail pull"
    for after in ("Tail tap 2", "Back stroke 1", "Tail pull", "Tail tap 2"):
        (folder / before / name).rename(folder / after / name)
        assert label() == after
        before = after
    relabel_recordings(open_dataset(tmp_path / "DS"), [f"unknown/{name.removesuffix('.csv')}"], "", "K")
    assert label() == "Tail pull", "a person's undo stays"


def test_at_rest_is_nobodys_where_its_folder_says_so(labelled: Path, tmp_path: Path) -> None:
    folder = labelled / scripts.LABELLED
    moved = min((folder / "Tail tap 2").glob("*.csv"))
    (folder / "At rest").mkdir()
    moved.rename(folder / "At rest" / moved.name)
    done = imported(labelled, tmp_path / "DS")
    (found,) = (r for r in done.dataset.recordings if Path(r.file).name == moved.name)
    assert (found.gesture, found.subject) == ("At rest", "none")
    # Labels of which no gesture set is known are those of the other files.
    for label, name in (("Shake", "Shake_1000_3"), ("Shake", "Nod_1001_3"), ("Nod", "Nod_1002_3")):
        (tmp_path / "other" / label).mkdir(parents=True, exist_ok=True)
        rows = "".join(f"{10 * i},{10 * i},{i},2,{int(name[-6:-2])}\n" for i in range(60))
        (tmp_path / "other" / label / f"{name}.csv").write_text(rows)
    done = import_recordings(tmp_path / "other", tmp_path / "OTHER", layout="accel-3")
    assert [(r.id, r.gesture) for r in done.dataset.recordings] == [
        ("unknown/Nod_1001_3", "Shake"),
        ("unknown/Nod_1002_3", "Nod"),
        ("unknown/Shake_1000_3", "Shake"),
    ]


def test_choices_that_come_later_are_added_but_decide_nothing_twice(labelled: Path, tmp_path: Path) -> None:
    assert imported(labelled, tmp_path / "DS").trimmed == 0
    scripts.choose(labelled)
    done = import_recordings(labelled, tmp_path / "DS", add_to=True)
    assert (done.added_recordings, done.trimmed) == (0, RECORDINGS - 1)
    assert import_recordings(labelled, tmp_path / "DS", add_to=True).trimmed == 0


def test_choices_that_cannot_be_used(labelled: Path, tmp_path: Path) -> None:
    path = labelled / CHOICES
    for number, (text, reason) in enumerate(
        [
            ("file,subject\na,b\n", "has no column filename, fullpath, length, truncaten"),
            ("FileName,FullPath,Length,TruncateN\na.csv,C:\\x\\a.csv,12,lots\n", "line 2 has Length '12'"),
            ("FileName,FullPath,Length,TruncateN\na.csv,C:\\x\\a.csv,12,-1\n", "whole numbers from 0 on"),
            ("FileName,FullPath,Length,TruncateN\na.csv,C:\\x\\a.csv,1e999,0\n", "whole numbers from 0 on"),
        ]
    ):
        path.write_text(text)
        done = imported(labelled, tmp_path / f"in{number}")
        assert [reason in e.reason for e in done.rejected if e.file == CHOICES] == [True], text
        done = imported(labelled / scripts.LABELLED, tmp_path / f"beside{number}")
        assert sum(reason in w for w in done.messages) == 1
        assert done.trimmed == 0
    name = next(p.name for p in (labelled / scripts.LABELLED).rglob("*.csv"))
    path.write_text(f'\ufeff"File Name","Full Path",Length,TruncateN\n{name},/x/{name},9999,5\n')
    done = imported(labelled, tmp_path / "other")
    assert done.trimmed == 0
    assert any("1 do not fit" in w for w in kinds(done))


def test_flags_of_one_kind_are_one_warning() -> None:
    flags = [
        ("a", "3 gaps over 50 ms, the longest 120 ms (after row 7)"),
        ("b", "1 gap over 50 ms, the longest 80 ms (after row 12)"),
        ("c", "1 value outside the valid range (ears; first in row 3)"),
        ("d", "the same content as a/x_1_2"),
        ("e", "the same content as a/y_1_2"),
    ]
    assert group_flags(flags) == [
        "2 recordings or streams, for instance a: 3 gaps over 50 ms, the longest 120 ms (after row 7)",
        "c: 1 value outside the valid range (ears; first in row 3)",
        "2 recordings or streams, for instance d: the same content as a/x_1_2",
    ]


def test_zeros_of_the_accelerometer_that_stand_for_low_values_are_found(tmp_path: Path) -> None:
    scripts.record(tmp_path / "study")
    done = imported(tmp_path / "study", tmp_path / "DS")
    checked = check(done.dataset)
    (found,) = checked.findings_of("zeroed")
    assert (found.severity, found.about) == ("warning", "")
    assert found.message.startswith("2 channels (acc_x, acc_y) read exactly 0 in ")
    assert "never less than -2000" in found.message
    # They are neither faults of the sensor nor a centre of the sphere of gravity.
    assert not [f for f in checked.findings_of("flat", "stuck", "saturated") if set(f.channels) & {10, 11}]
    assert not [p for p in done.proposals if p.key == "offset"]


def test_recordings_at_rest_that_the_script_leaves_do_not_make_gestures_people(tmp_path: Path) -> None:
    """The script moves 17 gestures and no stream; "At rest" stays in its folder."""
    root = tmp_path / "study"
    scripts.record(root, at_rest=2)
    rest = root / scripts.SESSIONS / "none"
    rest.rename(tmp_path / "rest")
    scripts.move_by_label(root)
    (tmp_path / "rest").rename(rest)
    done = imported(root, tmp_path / "DS")
    assert (done.recordings, done.subjects, done.streams) == (RECORDINGS + 2, 0, 0)
    assert {r.subject for r in done.dataset.recordings} == {"unknown", "none"}
    assert {e.reason for e in done.rejected} == {"a session stream whose person is not known"}


@pytest.mark.parametrize("integers", [15, 14])
@pytest.mark.parametrize("truncated", [False, True])
def test_a_simulation_is_known_after_the_scripts(tmp_path: Path, integers: int, truncated: bool) -> None:
    """Nothing is left beside the files: the mark is in the times of the rows."""
    root = tmp_path / "study"
    scripts.record(root, people=1, repetitions=1, integers=integers)
    moved = tmp_path / "elsewhere"
    scripts.move_by_label(root)
    if truncated:
        scripts.truncate(root, {p.name: (0, 40) for p in (root / scripts.LABELLED).rglob("*.csv")})
    (root / scripts.LABELLED).rename(moved)
    done = imported(moved, tmp_path / "DS", integers)
    assert done.dataset.head.simulated and open_dataset(tmp_path / "DS").head.simulated
    assert "3 of 3 recordings are of a virtual toy, as the times of their rows tell" in done.notes
    assert sum(note.startswith("these recordings are a simulation") for note in done.notes) == 1


def test_real_recordings_have_no_such_times(tmp_path: Path) -> None:
    root = tmp_path / "study"
    scripts.record(root, people=1, repetitions=2)
    scripts.move_by_label(root)
    moved = tmp_path / "elsewhere"
    (root / scripts.LABELLED).rename(moved)
    virtual = min((moved / "Tail pull").glob("*.csv"))
    virtual.rename(tmp_path / virtual.name)
    as_if_real(moved)
    real = imported(moved, tmp_path / "REAL")
    assert not real.dataset.head.simulated
    (tmp_path / virtual.name).rename(virtual)
    done = imported(moved, tmp_path / "MIXED")
    assert done.dataset.head.simulated
    assert "1 of 6 recordings are of a virtual toy, as the times of their rows tell" in done.notes
    with pytest.raises(DatasetError, match="holds recordings of a real toy, the source those of a virtual one"):
        import_recordings(moved, tmp_path / "REAL", add_to=True)
    assert len(open_dataset(tmp_path / "REAL").recordings) == 5
    assert import_recordings(moved, tmp_path / "MIXED", add_to=True).added_recordings == 0
