"""Grids: the paper's count, what is read from files and options, and every problem found before anything runs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.experiments.sweep.grid import FULL, GRIDS, GridSpec, load_grid, networks, problems
from plushsense.models.arch import PAPER_ARCHITECTURES, Arch
from plushsense.training.spec import VECTOR_TRAINING

PLUSH = load_layout("plush-15")
PAPER = GRIDS["paper"]
SMALL = replace(PAPER, architectures=("14d1_39d2_41d4",), filters=((4, 6, 8, 8),), epochs=(2,), batches=(64,))


def test_the_papers_grid_is_468_trials_in_156_trainings() -> None:
    assert problems(PAPER, PLUSH, past=0, windows=3936) == []
    found = networks(PAPER, PLUSH, 18)
    assert len({arch for arch, _ in found}) == len(found) == 52 and {arch.padding for arch, _ in found} == {"mirror"}
    assert {arch.symbol for arch, _ in found} == set(PAPER_ARCHITECTURES)
    assert PAPER.schedules == [(100, 250, 1000)]
    assert len(found) * len(PAPER.batches) * len(PAPER.schedules) == 156
    assert len(found) * len(PAPER.batches) * len(PAPER.epochs) == 468
    (chosen,) = (arch for arch, filters in found if (arch.symbol, filters) == ("14d1_39d2_41d4", (8, 12, 16, 16)))
    assert (chosen.parameters, chosen.table3) == (13262, "13.2k")
    spec = PAPER.training
    assert (spec.learning_rate, spec.halve_every, spec.patience) == (0.001, None, None)


def test_the_scripts_grid_trains_as_the_authors_do() -> None:
    grid = GRIDS["scripts"]
    assert problems(grid, PLUSH, past=0, windows=3936) == [] == problems(GRIDS["people"], PLUSH, windows=3936)
    assert (grid.schedules, len(networks(grid, PLUSH, 18))) == (PAPER.schedules, 52)
    spec = grid.training
    assert (spec.learning_rate, spec.halve_every, spec.patience) == (0.001, None, None)
    assert (spec.scaling, spec.weight_decay, grid.norm, grid.split) == ("none", 1e-4, "layer", "windows:file-order")


def test_networks_with_a_vector_layer_train_as_evaluate_trains_them() -> None:
    grid = replace(GRIDS["people"], architectures=("v14_17d2_19d4",))
    assert grid.training.augment == VECTOR_TRAINING["augment"] != GRIDS["people"].training.augment
    assert replace(grid, augment=("random-gain:0.2",)).training.augment == ("random-gain:0.2",)
    assert replace(grid, preset="search").training.augment == ()


@pytest.mark.parametrize(
    ("changes", "apart"),
    [({"halve_every": 1}, False), ({"patience": 3}, True), ({"preset": "loso"}, True), ({"halving": True}, True)],
)
def test_only_where_a_training_may_stop_are_trials_trained_apart(changes: dict[str, Any], apart: bool) -> None:
    assert replace(SMALL, epochs=(2, 4), **changes).schedules == ([(2,), (4,)] if apart else [(2, 4)])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"architectures": ("14x",)}, "Architecture '14x', place 3"),
        ({"architectures": ()}, "no architectures"),
        ({"filters": ((4, 6),)}, "14d1_39d2_41d4 has 3 layers, but the filters 4/6 are only 2"),
        ({"filters": ((4, 0, 8),)}, "filters 4/0/8 cannot be used"),
        ({"filters": ((4, 6, 8, 8), (4, 6, 8, 9))}, "is the same network as 14d1_39d2_41d4 with 4/6/8/8"),
        ({"architectures": ("14", "14d1")}, "14d1 with 4/6/8/8 is the same network as 14 with"),
        ({"epochs": (20, 10)}, "The epochs 20, 10 do not ascend: give 10, 20"),
        ({"epochs": (0, 10)}, "Epochs 0"),
        ({"epochs": (10, 10)}, "10 among its epochs 2 times"),
        ({"batches": (1,)}, "A batch of 1"),
        ({"batches": (64, 500)}, "A batch of 500 is larger than the 300 windows"),
        ({"seeds": (-1,)}, "Seed -1"),
        ({"seeds": ()}, "no seeds"),
        ({"split": "by-person:5"}, "Unknown split 'by-person:5'"),
        ({"preset": "serch"}, "Did you mean 'search'?"),
        ({"padding": "miror"}, "Did you mean 'mirror'?"),
        ({"norm": "batches"}, "Unknown norm"),
        ({"context": "stre"}, "Did you mean 'stream'?"),
        ({"device": "gpu"}, "Unknown device"),
        ({"learning_rate": 3.0}, "learning_rate is 3.0"),
        ({"threads": 0}, "threads is 0"),
        ({"name": "../up"}, "cannot be a folder's"),
        ({"window_s": -1.0}, "out of range"),
        ({"max_parameters": 0}, "max_parameters is 0"),
        ({"halving": True, "share": 1.1}, "The share 1.1"),
        ({"halving": True, "eta": math.nan}, "eta is nan: accepted is above 1"),
        ({"halving": True, "preset": "loso"}, "stop early (patience 10, preset loso)"),
        ({"architectures": ("100_300",)}, "receptive field of 399 samples (4 s), longer than the window of 250"),
        ({"architectures": ("100_300",), "padding": "stream"}, "receptive field of 399"),
        ({"architectures": ("100d4",), "padding": "stream", "context": "stream"}, "sees 646 samples"),
    ],
)
def test_each_problem_is_one_sentence(changes: dict[str, object], said: str) -> None:
    found = problems(replace(SMALL, **changes), PLUSH, past=600, windows=300)  # type: ignore[arg-type]
    assert len(found) == 1, found
    assert said in found[0] and "\n" not in found[0]
    assert problems(SMALL, PLUSH, past=600, windows=300) == []


def test_at_another_rate_kernels_that_fit_the_window_are_named() -> None:
    grid = GridSpec(name="g", architectures=("14d1_39d2_41d4",), filters=((4, 4, 4),), batches=(64,))
    (found,) = problems(grid, replace(PLUSH, rate_hz=20.0), past=600, windows=300)
    assert "250 samples (12 s)" in found and "longer than the window of 50" in found
    symbol = found.partition("such as ")[2].partition(",")[0]
    assert problems(replace(grid, architectures=(symbol,)), replace(PLUSH, rate_hz=20.0), windows=300) == []


def test_a_receptive_field_that_only_rounds_beyond_the_window_is_the_papers() -> None:
    for symbol in PAPER_ARCHITECTURES:
        for padding in ("mirror", "causal", "stream"):
            assert problems(replace(SMALL, architectures=(symbol,), padding=padding), PLUSH) == []
    assert problems(replace(SMALL, architectures=("251",), filters=((4,),)), PLUSH) != []
    real = replace(SMALL, architectures=("100d4",), padding="stream", context="stream")
    assert problems(real, PLUSH, past=646) == []


def test_limits_name_what_exceeds_them() -> None:
    grid = GridSpec(max_parameters=4000, max_state_bytes=2150, max_macs_per_step=16_000, padding="stream")
    found = [(arch, grid.exceeded(arch)) for arch, _ in networks(grid, PLUSH, 10)]
    for arch, over in found:
        assert len(over) == sum([arch.parameters > 4000, arch.state_bytes_int8 > 2150, arch.macs_per_step > 16_000]), (
            arch.symbol
        )
    assert 0 < sum(not over for _, over in found) < len(found)
    big = Arch.parse("70_90_91", (8, 12, 16), channels=4, classes=10)
    assert ", ".join(map(str, grid.exceeded(big))).startswith("28,630 parameters, 24,630 over 4,000, 3,692 bytes of")


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
    assert load_grid("people", {"share": "0.5"})[1] == [
        "share and eta are for halving only: give --halving (in a file: halving = true), too."
    ]
    assert load_grid("people", {"share": "0.5", "halving": True})[0].share == 0.5
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
