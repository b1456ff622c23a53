"""Windows that MATLAB saved come back as recordings, from which the same windows can be cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import FileFormatError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.saved_windows import LabelledWindows, join_windows, read_windows
from plushsense.evaluation.crossval import fold_windows
from plushsense.scoring.splits import parse_split
from plushsense.windows.cut import WindowSpec, cut_windows
from support import paper_scripts as scripts
from support.matlab_files import write_mat

pytestmark = pytest.mark.slow

RECORDINGS = 3 * len(scripts.GESTURES) * 2


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("matlab") / "study"
    scripts.record(root)
    scripts.move_by_label(root)
    return root


@pytest.mark.parametrize("categorical", [True, False], ids=["categorical", "cellstr"])
def test_the_recordings_come_back_and_give_the_same_windows(study: Path, tmp_path: Path, categorical: bool) -> None:
    path, count = scripts.save_windows(study, categorical=categorical)
    done = import_recordings(path, tmp_path / "DS")
    assert (done.recordings, done.subjects, done.rejected) == (RECORDINGS, 0, ())
    assert done.dataset.layout.name == "plush-windows"
    assert {"train", "test"} < {r.session for r in done.dataset.recordings}
    assert sum("windows joined to 18 recordings" in w for w in done.messages) == 1
    whole = import_recordings(study / scripts.LABELLED, tmp_path / "whole", layout="plush-15").dataset
    rows = sorted((r.gesture, 50 * (r.rows // 50) if r.rows >= 250 else r.rows) for r in whole.recordings)
    assert sorted((r.gesture, r.rows) for r in done.dataset.recordings) == rows
    cut = cut_windows(done.dataset, WindowSpec(context="loop"))
    fold = fold_windows(cut, cut, parse_split("saved"))[0]
    sizes = [len(part) for part in (fold.train, fold.validation, fold.test)]
    assert sizes == [len(s.windows) for s in read_windows(path, path.name)], (
        "also of recordings on a border of two sets"
    )
    mine, _ = scripts.cut_windows(study)
    assert len(cut.y) == len(mine) == count
    # The magnitude is rounded to its fraction bits; sums do not depend on the order of the windows.
    same = np.sort([w[:, :10].sum() for w in mine])
    assert np.array_equal(np.sort(cut.x[:, :10].sum(axis=(1, 2))), same)
    magnitudes = np.sort([w[:, 10].mean() for w in mine])
    assert np.allclose(np.sort(cut.x[:, 10].mean(axis=1)), magnitudes, atol=1 / 32)


def test_the_same_file_again_adds_nothing(study: Path, tmp_path: Path) -> None:
    path, _ = scripts.save_windows(study)
    import_recordings(path, tmp_path / "DS")
    again = import_recordings(path, tmp_path / "DS", add_to=True)
    assert (again.recordings, again.added_recordings) == (RECORDINGS, 0)


def test_windows_are_joined_only_where_they_overlap() -> None:
    signal = np.arange(600.0).reshape(300, 2)
    windows = [signal[0:100], signal[50:150], signal[100:200], signal[220:300], np.tile(signal[:30], (4, 1))[:100]]
    sets = [LabelledWindows("a", windows[:2], ["x"] * 2), LabelledWindows("b", windows[2:], ["x", "x", "y"])]
    found = [(r.label, len(r.values), r.sets) for r in join_windows(sets)]
    assert found == [("x", 200, ("a", "a", "b")), ("x", 80, ("b",)), ("y", 30, ("b",))]
    still = np.zeros((100, 2))
    assert [len(r.values) for r in join_windows([LabelledWindows("", [still], ["x"])])] == [100]


def test_files_that_cannot_be_used_say_why(study: Path, tmp_path: Path) -> None:
    path, _ = scripts.save_windows(study)
    raw = path.read_bytes()
    bad = tmp_path / "bad.mat"
    for data, reason in (
        (b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(512), "another one such as 7.3.*-v7"),
        (b"", "does not have the MATLAB format"),
        (raw[:5000], "cannot be read as a MATLAB file|no windows|but no"),
        (b"a,b\n1,2\n" * 100, "or text: load it.*-v7"),
    ):
        bad.write_bytes(data)
        with pytest.raises(FileFormatError, match=reason) as refusal:
            import_recordings(bad, tmp_path / "DS")
        assert "\n" not in str(refusal.value)
    window = np.arange(550.0).reshape(50, 11)
    for windows, labels, reason in (
        ({"traindata": [window]}, {"trainlabels": ["a", "b"]}, "1 windows in 'traindata' but 2 labels"),
        ({"traindata": [window]}, {}, "has 'traindata' but no 'trainlabels'"),
        ({"traindata": [window, window[:, :9]]}, {"trainlabels": ["a", "b"]}, "windows of 9, 11 channels"),
        ({"traindata": [window[:, :9]]}, {"trainlabels": ["a"]}, "have 9 channels.*--layout FILE"),
        ({"other": [window]}, {}, "has no windows: expected are the variables traindata"),
    ):
        write_mat(bad, windows, labels, ["a", "b"], categorical=False)
        with pytest.raises(FileFormatError, match=reason):
            import_recordings(bad, tmp_path / "DS")
    write_mat(bad, {"traindata": [window]}, {"trainlabels": ["a"]}, ["a"], categorical=False)
    with pytest.raises(FileFormatError, match="have 11 channels, but layout 'accel-3' has 3"):
        import_recordings(bad, tmp_path / "DS", layout="accel-3")
    assert not (tmp_path / "DS").exists()
    write_mat(bad, {"sigdatapad": [window]}, {"labelspad": ["a"]}, ["a"])
    assert [s.labels for s in read_windows(bad, "bad.mat")] == [["a"]]
    write_mat(bad, {"traindata": [window]}, {"trainlabels": [""]}, ["a"])
    with pytest.raises(FileFormatError, match="no window with a label"):
        import_recordings(bad, tmp_path / "DS")
