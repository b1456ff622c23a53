"""Grids: the paper's count, what contains what, and every problem found before anything runs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plushsense.core.layouts import load_layout
from plushsense.models.arch import PAPER_ARCHITECTURES
from plushsense.trials.grid import FULL, GRIDS, GridSpec, problems, trainings

PLUSH = load_layout("plush-15")
PAPER = GRIDS["paper"]
SMALL = replace(PAPER, architectures=("14d1_39d2_41d4",), filters=((4, 6, 8, 8),), epochs=(2,), batches=(64,))


def test_the_papers_grid_is_468_trials_in_156_trainings() -> None:
    assert problems(PAPER, PLUSH, past=0, windows=3936) == []
    found = trainings(PAPER, PLUSH, 18)
    trials = [trial for training in found for trial in training.trials]
    assert (len(found), len(trials)) == (156, 468)
    assert len({(t.arch, t.epochs, t.batch) for t in trials}) == 468
    assert {training.epochs for training in found} == {(100, 250, 1000)}
    assert {t.arch.symbol for t in trials} == set(PAPER_ARCHITECTURES)
    assert {t.arch.padding for t in trials} == {"mirror"}
    chosen = next(t for t in trials if t.arch.symbol == "14d1_39d2_41d4" and t.filter_set == (8, 12, 16, 16))
    assert (chosen.arch.parameters, chosen.arch.table3) == (13262, "13.2k")
    spec = PAPER.training
    assert (spec.learning_rate, spec.halve_every, spec.patience) == (0.001, None, None)


def test_the_scripts_grid_trains_as_the_authors_do() -> None:
    grid = GRIDS["scripts"]
    assert problems(grid, PLUSH, past=0, windows=3936) == []
    assert len(trainings(grid, PLUSH, 18)) == 156
    spec = grid.training
    assert (spec.learning_rate, spec.halve_every, spec.patience) == (0.001, None, None)
    assert (spec.scaling, spec.weight_decay, grid.norm, grid.split) == ("none", 1e-4, "layer", "windows:file-order")


def test_only_where_validation_stops_are_trials_trained_apart() -> None:
    epochs = (2, 4)
    assert len(trainings(replace(SMALL, epochs=epochs, halve_every=1), PLUSH, 18)) == 1
    assert [t.epochs for t in trainings(replace(SMALL, epochs=epochs, patience=3), PLUSH, 18)] == [(2,), (4,)]
    assert [t.epochs for t in trainings(replace(SMALL, epochs=epochs, preset="loso"), PLUSH, 18)] == [(2,), (4,)]


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


def test_all_problems_come_at_once() -> None:
    bad = GridSpec(
        name="b", architectures=("14x", "100_300"), filters=((4,),), epochs=(5, 2), batches=(64, 999), split="by-me"
    )
    found = problems(bad, PLUSH, past=600, windows=300)
    assert len(found) == 6
    for words in ("14x", "receptive field", "only 1", "ascend", "999", "Unknown split"):
        assert sum(words in line for line in found) == 1, words


def test_a_receptive_field_that_only_rounds_beyond_the_window_is_the_papers() -> None:
    for symbol in PAPER_ARCHITECTURES:
        for padding in ("mirror", "causal", "stream"):
            assert problems(replace(SMALL, architectures=(symbol,), padding=padding), PLUSH) == []
    assert problems(replace(SMALL, architectures=("251",), filters=((4,),)), PLUSH) != []
    real = replace(SMALL, architectures=("100d4",), padding="stream", context="stream")
    assert problems(real, PLUSH, past=646) == []


def test_full_is_a_batch() -> None:
    assert problems(replace(SMALL, batches=(FULL,)), PLUSH, windows=10) == []
