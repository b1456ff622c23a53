"""Windows, sets and weights handed over to MATLAB come back the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.cli.main import main
from plushsense.core.errors import BadInput, ConfigError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_windows
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.scoring.splits import make_folds, parse_split
from plushsense.windows.cut import WindowSet, WindowSpec, cut_windows
from plushsense.workflow.export import save_windows

pytest.importorskip("scipy")
SETS = ("train", "validation", "test")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("matlab")
    gestures = ("Back stroke 1", "Tail pull", "Tail tap 2")
    simulate(root / "recordings", SimulationSpec(people=3, repetitions=2, at_rest=2, seed=3, gestures=gestures))
    return import_recordings(root / "recordings", root / "DS", layout="plush-15").dataset


def in_sets(windows: WindowSet, split: str) -> list[tuple[str, str, bytes]]:
    """Set, label and samples of each window, in an order that does not depend on that of the windows."""
    (fold,) = fold_windows(windows, windows, parse_split(split), 0)
    parts = [(name, at) for name in SETS for at in getattr(fold, name).tolist()]
    return sorted((name, windows.labels[windows.y[at]], windows.x[at].tobytes()) for name, at in parts)


@pytest.mark.parametrize("split", ["windows:file-order", "windows:holdout", "recordings:holdout"])
def test_the_same_windows_labels_and_sets_come_back(dataset: Dataset, tmp_path: Path, split: str) -> None:
    saved = save_windows(dataset, tmp_path / "w.mat", split=split, context="rows", classes="all", padding="mirror")
    again = import_recordings(tmp_path / "w.mat", tmp_path / "DS").dataset
    before, after = (cut_windows(of, WindowSpec(context="rows")) for of in (dataset, again))
    assert again.head.simulated, "virtual people stay marked"
    assert sum(saved.windows.values()) == len(before)
    assert in_sets(after, "saved") == in_sets(before, split)


def test_the_command_trains_nothing_and_its_file_is_evaluated_on_its_own_sets(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "w.mat")
    words = ["--split", "windows:file-order", "--context", "rows", "--padding", "mirror", "--classes", "all"]
    assert main(["evaluate", str(dataset.path), *words, "--save-windows", file, "--json"]) == 0
    sizes = json.loads(capsys.readouterr().out)["windows"]
    assert main(["import", file, str(tmp_path / "DS")]) == 0
    capsys.readouterr()
    assert (
        main(["evaluate", str(tmp_path / "DS"), "--split", "saved", "--save-windows", file, "--force", *words[2:]]) == 0
    )
    assert ", ".join(f"{n} {name}" for name, n in sizes.items()) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("split", "name", "error"),
    [
        ("by-subject:3", "w.mat", "has 3 folds, and a file of windows one"),
        ("windows:file-order", "w.csv", "one that ends in .mat"),
    ],
)
def test_what_cannot_be_saved(dataset: Dataset, tmp_path: Path, split: str, name: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        save_windows(dataset, tmp_path / name, split=split, context="rows")


def test_an_existing_file_is_kept_unless_forced(dataset: Dataset, tmp_path: Path) -> None:
    (path := tmp_path / "w.mat").write_text("of somebody else")
    with pytest.raises(ConfigError, match="exists already"):
        save_windows(dataset, path, split="windows:file-order", context="rows")
    assert path.read_text() == "of somebody else"
    assert save_windows(dataset, path, split="windows:file-order", context="rows", overwrite=True).bytes > 1000


def folded(*names: str) -> Any:
    n = len(names)
    return make_folds(parse_split("saved"), np.full(n, "unknown"), np.zeros(n, np.int64), names=np.array(names))


def test_windows_of_no_set_are_refused() -> None:
    (fold,) = folded("u/train 2 test 1/a", "u/train 2 test 1/a", "u/train 2 test 1/a", "u/validation/b")
    assert [fold.train.tolist(), fold.validation.tolist(), fold.test.tolist()] == [[0, 1], [3], [2]]
    for names, error in (
        (("u/1/a", "u/train/b"), "'u/1/a' is in none"),
        (("a",), "'a' is in none"),
        (("u/train 2 test/a",), "is in none"),
        (("u/train 2 test 1/a",), "has 1 windows, but 3 in the file"),
        (("u/train/a", "u/train/b"), "set 'test', needs at least 1 windows"),
    ):
        with pytest.raises(BadInput, match=error):
            folded(*names)
