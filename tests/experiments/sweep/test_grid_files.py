"""Grids as they are written: what is read, and that nothing unreadable is passed over."""

from __future__ import annotations

from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError
from plushsense.experiments.sweep.grid import FULL, GRIDS, GridSpec, load_grid

FILE = """
[grid]
architectures = ["14d1_19d2_19d4", "100_151"]
filters = [[4, 6, 8, 8], [8, 12, 16, 16]]
epochs = [20]
batches = [64, "full"]
seeds = [0, 1]
split = "by-subject:5"
classes = ["Shake", "Jump"]
"""


def test_a_file_is_read_and_the_rest_is_as_in_the_paper(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    grid, found = load_grid(path)
    assert found == []
    assert grid == GridSpec(
        name="mine",
        architectures=("14d1_19d2_19d4", "100_151"),
        filters=((4, 6, 8, 8), (8, 12, 16, 16)),
        epochs=(20,),
        batches=(64, FULL),
        seeds=(0, 1),
        split="by-subject:5",
        classes="Shake,Jump",
    )
    assert grid.padding == GRIDS["paper"].padding == "mirror"


def test_options_go_over_it_as_text() -> None:
    grid, found = load_grid(
        "paper",
        {"architectures": "14d1, 250", "filters": "4/6/8/8,8/12/16/16", "epochs": "10,20", "batches": "64,full"}
        | {"split": None, "seeds": (0, 1)},
    )
    assert found == []
    assert (grid.architectures, grid.filters) == (("14d1", "250"), ((4, 6, 8, 8), (8, 12, 16, 16)))
    assert (grid.epochs, grid.batches, grid.seeds) == ((10, 20), (64, FULL), (0, 1))
    assert grid.split == "windows:holdout"
    assert load_grid(grid, {"filters": "4,6,8,8"})[0].filters == ((4, 6, 8, 8),)


def test_what_cannot_be_read_is_said_all_at_once_and_the_rest_is_read(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text('[grid]\nepoch = [1]\nbatches = ["some"]\nseeds = 3\npadding = true\nsplit = "windows:5"\n[more]\n')
    grid, found = load_grid(path, {"filters": "4,x"})
    assert len(found) == 6
    assert any("Unknown key 'more'" in line for line in found)
    assert any("Unknown key 'epoch'" in line and "Did you mean 'epochs'?" in line for line in found)
    for key in ("batches", "seeds", "padding"):
        assert any(line.startswith(f"In [grid] in '{path}', {key}") for line in found), key
    assert any("filters" in line and "'4,x'" in line for line in found)
    assert grid == GridSpec(name="g", split="windows:5")


def test_a_list_with_one_unreadable_item_keeps_the_others_for_the_other_problems(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text('[grid]\nepochs = [3, "x"]\nbatches = [64, "half", 90000]\nfilters = [[4, 6], "a"]\n')
    grid, found = load_grid(path)
    assert len(found) == 3
    assert (grid.epochs, grid.batches, grid.filters) == ((3,), (64, 90000), ((4, 6),))


def test_unknown_grids_and_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Did you mean 'paper'"):
        load_grid("papr")
    with pytest.raises(ConfigError, match="There is no grid file"):
        load_grid(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[grid\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_grid(tmp_path / "bad.toml")
    (tmp_path / "empty.toml").write_text("grid = 3\n")
    assert "no table [grid]" in load_grid(tmp_path / "empty.toml")[1][0]
