"""Sweeps: nested trainings are the same trainings, tables say what was done, nothing finished is done twice."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DivergedError, TrainingError
from plushsense.dataset.store import Dataset
from plushsense.evaluation.scores import read_predictions
from plushsense.experiments.sweep.grid import CHOSEN, SECOND
from plushsense.experiments.sweep.trainings import RunScores
from plushsense.experiments.sweep.trials import (
    TRIAL_COLUMNS,
    TrialColumn,
    TrialResult,
    best_on_validation,
    networks_to_keep,
    ranked,
)
from plushsense.jobs.journal import JOURNAL, UNFINISHED
from plushsense.jobs.progress import JobProgress
from plushsense.scoring.metrics import confusion
from support.sweeping import keys, sweep

pytestmark = pytest.mark.apart("cluster")

if TYPE_CHECKING:
    import polars

SMALL: dict[str, Any] = {
    "architectures": ("5_5d2", "9"),
    "filters": ((2, 3, 3, 3),),
    "batches": (4, "full"),
    "classes": "shared",
    "workers": 1,
}
COMMAND = [sys.executable, "-m", "plushsense", "sweep"]


def frame(folder: Path, name: str) -> polars.DataFrame:
    import polars

    return polars.read_parquet(folder / f"{name}.parquet")


@pytest.mark.parametrize("changes", [{}, {"preset": "people", "halve_every": 1}])
def test_nested_epochs_score_as_trainings_of_their_own(
    dataset: Dataset, tmp_path: Path, changes: dict[str, Any]
) -> None:
    import polars
    from polars.testing import assert_frame_equal

    together = sweep(dataset, epochs=(1, 2, 5), split="by-subject:2", out=tmp_path / "all", **SMALL, **changes)
    assert (together.head["trials"], together.head["trainings"]) == (12, 8)
    for epochs in (1, 2, 5):
        alone = sweep(dataset, epochs=(epochs,), split="by-subject:2", out=tmp_path / str(epochs), **SMALL, **changes)
        assert alone.head["trainings_resumed"] == 0
        mine = together.trials.filter(polars.col("epochs") == epochs)
        assert_frame_equal(mine.drop("seconds"), alone.trials.drop("seconds"), check_exact=True)
    assert together.trials["train_loss"].n_unique() == 12, "they are different trainings"


def test_where_validation_stops_each_is_trained_apart(dataset: Dataset, tmp_path: Path) -> None:
    found = sweep(dataset, epochs=(2, 12), patience=1, out=tmp_path / "o", **SMALL)
    assert found.head["trainings"] == found.head["trials"] == 8
    curves = frame(tmp_path / "o", "curves")
    lengths = dict(curves.group_by("run").len().iter_rows())
    assert min(lengths.values()) <= 2 and max(lengths.values()) > 2


def test_the_folder_holds_what_it_promises(dataset: Dataset, tmp_path: Path) -> None:
    import polars
    from polars.testing import assert_frame_equal

    seen: list[JobProgress] = []
    out = tmp_path / "o"
    found = sweep(dataset, epochs=(1, 3), seeds=(0, 1), split="by-subject:2", out=out, progress=seen.append, **SMALL)
    assert sorted(p.name for p in out.iterdir()) == [
        "curves.parquet", "predictions.parquet", "runs.parquet", "sweep.json", "trials.csv", "trials.parquet",
    ]  # fmt: skip
    trials, runs, curves = (frame(out, name) for name in ("trials", "runs", "curves"))
    assert (len(trials), len(runs), len(curves)) == (8, 8 * 4, 16 * 3)
    assert trials["trial"].n_unique() == 8 and runs["run"].n_unique() == 16
    assert set(trials["status"]) == {"done"} and set(trials["filters"]) == {"2/3", "2"}
    assert set(trials["filter_set"]) == {"2/3/3/3"} and set(trials["batch_asked"]) == {"4", "full"}
    assert trials.filter(polars.col("batch_asked") == "full")["batch"].min() > 4  # type: ignore[operator]
    assert_frame_equal(
        polars.read_csv(out / "trials.csv", schema_overrides={"batch_asked": polars.String}), trials, check_exact=False
    )
    means = runs.group_by("trial").agg(polars.col("accuracy").mean(), polars.col("macro_f1").std())
    both = trials.join(means, on="trial", suffix="_of_runs")
    assert both["accuracy"].to_list() == pytest.approx(both["accuracy_of_runs"].to_list())
    assert both["macro_f1_sd"].to_list() == pytest.approx(both["macro_f1_of_runs"].to_list())
    # One training, its shorter trial and its longer one, is paid for once.
    summary = json.loads((out / "sweep.json").read_text())
    assert trials["seconds"].sum() == pytest.approx(summary["training_seconds"], abs=0.06)
    assert (summary["trials"], summary["done"], summary["resumed"]) == (8, 8, 0)
    assert summary["best"][0]["accuracy"] == trials["accuracy"].max()
    assert not summary["leaky"] and not summary["simulated"]
    tested = sum(len(fold) for fold in _tested(dataset))
    for counts in summary["confusions"].values():
        assert sum(map(sum, counts)) == 2 * tested, "two seeds, each window once a seed"
    for rows in summary["per_class"].values():
        assert [row["label"] for row in rows] == summary["labels"]
    assert (seen[-1].done, seen[-1].total) == (16, 16) and seen[-1].share == pytest.approx(1.0)
    assert "8 of 8 trials" in repr(found) and "<table>" in found._repr_html_()
    assert_frame_equal(found.trials, trials)


def test_predictions_are_kept_of_the_networks_that_were_asked_for(cli: Any, dataset: Dataset, tmp_path: Path) -> None:
    words = (*keys(architectures="9,5_5d2", filters="2/2,3/3"), "--epochs", "1,2", *keys(batches="4"))
    words = (
        "sweep",
        dataset.path,
        *words,
        "--set",
        "classes=shared",
        "--workers",
        "1",
        "--out",
        tmp_path / "o",
        "--json",
    )

    def files() -> set[str]:
        return {path.name for path in (tmp_path / "o").glob("predictions*")}

    kept = cli(*words, "--keep-predictions", "all").json
    best = {"predictions.parquet"}
    assert len(files()) == 4 == len(kept["predictions"]) and set(kept["predictions"].values()) == files() > best
    assert kept["predictions"][kept["best"][0]["trial"]] == "predictions.parquet"
    assert set(kept["predictions"]) <= set(kept["confusions"])
    for trial, name in kept["predictions"].items():
        stored = read_predictions(tmp_path / "o" / name)
        counts = confusion(stored.truth, stored.predicted, len(stored.labels))
        assert counts.tolist() == kept["confusions"][trial], "the file is of this trial"
    # Nothing is trained again, and what is not kept any more is removed.
    again = cli(*words).json
    assert again["trainings_resumed"] == again["trainings"] and files() == best, "the paper's are not in this grid"


def test_the_papers_two_networks_are_kept() -> None:
    networks = (CHOSEN, ("14d1_39d2_41d4", "4/6/8"), SECOND, ("9", "4"))
    grid: Any = SimpleNamespace(trials=[SimpleNamespace(network=network) for network in networks])
    assert networks_to_keep(grid, "chosen") == {CHOSEN, SECOND}
    assert (networks_to_keep(grid, "best"), networks_to_keep(grid, "all")) == (set(), set(networks))
    with pytest.raises(ConfigError, match="'every': accepted are best, chosen, all"):
        networks_to_keep(grid, "every")


def _tested(dataset: Dataset) -> list[Any]:
    from plushsense.experiments.sweep.grid import load_grid
    from plushsense.experiments.sweep.plan import plan

    keys = {key: value for key, value in SMALL.items() if key != "workers"}
    grid, _ = load_grid("paper", {**keys, "split": "by-subject:2"})
    return [fold.test for fold in next(iter(plan(dataset, grid).folds.values()))]


def test_it_goes_on_and_is_made_again_from_the_journal(dataset: Dataset, tmp_path: Path) -> None:
    from polars.testing import assert_frame_equal

    first = sweep(dataset, epochs=(1, 2), **SMALL)
    assert first.out.parent == dataset.path / "evaluations" and first.out.name.startswith(
        "sweep-paper-windows-holdout-"
    )
    assert first.head["leaky"] and "leaky" in repr(first)
    shutil.rmtree(first.out)
    again = sweep(dataset.path, epochs=(1, 2), **SMALL)
    assert again.head["resumed"] == again.head["trials"] == 8
    assert_frame_equal(again.trials, first.trials, check_exact=True)
    journal = sorted((dataset.path / "cache" / "sweeps").iterdir())
    assert len(journal) == 4
    journal[0].unlink()
    journal[1].write_bytes(journal[1].read_bytes()[:100])
    healed = sweep(dataset, epochs=(1, 2), **SMALL)
    assert healed.head["trainings_resumed"] == 2 and healed.head["resumed"] == 4
    assert_frame_equal(healed.trials.drop("seconds"), first.trials.drop("seconds"), check_exact=True)
    # Threads sum in another order: they are other trainings.
    assert sweep(dataset, epochs=(1, 2), threads=2, **SMALL).head["resumed"] == 0
    with pytest.raises(ConfigError, match=r"holds a sweep of other settings or other data.*--force"):
        sweep(dataset, epochs=(1,), out=first.out, **SMALL)
    assert sweep(dataset, epochs=(1,), out=first.out, overwrite=True, **SMALL).head["trials"] == 4


def test_a_network_gets_the_past_that_it_needs(dataset: Dataset, tmp_path: Path) -> None:
    changes = SMALL | {"architectures": ("9", "70d4"), "batches": (4,)}
    settings = {"padding": "stream", "context": "stream", "split": "by-subject:2"}
    found = sweep(dataset, epochs=(1,), out=tmp_path, **settings, **changes)
    assert dict(found.trials.select("arch", "span").iter_rows()) == {"9": 248, "70d4": 526}
    assert found.head["done"] == 2


def test_one_that_diverges_is_told_and_the_others_go_on(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import polars

    from plushsense.training import fit as room

    real = room.fit

    def fit(train: Any, validation: Any, arch: Any, spec: Any, *rest: Any, **more: Any) -> Any:
        if arch.symbol == "9" and spec.epochs > 2:
            raise DivergedError("the loss is no number")
        return real(train, validation, arch, spec, *rest, **more)

    monkeypatch.setattr(room, "fit", fit)
    found = sweep(dataset, epochs=(1, 2, 3), out=tmp_path, **SMALL)
    said = {(f["arch"], f["epochs"], f["why"]) for f in found.head["failed"]}
    assert said == {("9", 3, "the loss is no number")}, "once for each batch"
    status = {(row["arch"], row["epochs"]): row["status"] for row in found.trials.iter_rows(named=True)}
    assert status == {("5d1_5d2", e): "done" for e in (1, 2, 3)} | {
        ("9", 1): "done",
        ("9", 2): "done",
        ("9", 3): "failed",
    }
    assert found.trials.filter(polars.col("status") == "failed")["accuracy"].null_count() == 2
    assert found.head["done"] == 10
    # Nothing of it went well: there is no curve either.
    alone = sweep(dataset, epochs=(3,), out=tmp_path, overwrite=True, **SMALL)
    assert (alone.head["done"], len(alone.head["failed"]), len(frame(tmp_path, "curves"))) == (2, 2, 2 * 3)


def test_a_long_training_goes_on_where_it_was_stopped(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from polars.testing import assert_frame_equal

    from plushsense.training import fit as room

    whole = sweep(dataset, epochs=(2, 6), out=tmp_path / "whole", **SMALL)
    shutil.rmtree(dataset.path / "cache" / JOURNAL)
    real, begun = room.fit, []

    def fit(*given: Any) -> Any:
        *most, store = given
        begun.append(0 if store.start is None else store.start.epoch)

        def stop(state: Any) -> None:
            store.save(state)
            if state.epoch == 4 and len(begun) == 1:
                raise KeyboardInterrupt

        return real(*most, replace(store, save=stop, save_every_s=0.0))

    monkeypatch.setattr(room, "fit", fit)
    with pytest.raises(KeyboardInterrupt):
        sweep(dataset, epochs=(2, 6), out=tmp_path / "again", **SMALL)
    unfinished = dataset.path / "cache" / UNFINISHED
    assert len(list(unfinished.iterdir())) == 1
    again = sweep(dataset, epochs=(2, 6), out=tmp_path / "again", **SMALL)
    assert begun[:2] == [0, 4] and not any(begun[2:])
    assert not list(unfinished.iterdir())
    assert_frame_equal(again.trials.drop("seconds"), whole.trials.drop("seconds"), check_exact=True)


def test_a_state_that_cannot_be_kept_stops_no_training(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from plushsense.training import fit as room

    monkeypatch.setattr(room, "StoreSpec", partial(room.StoreSpec, save_every_s=0.0))
    (dataset.path / "cache").mkdir(parents=True)
    (dataset.path / "cache" / UNFINISHED).write_text("a file where the folder would be")
    assert sweep(dataset, epochs=(1, 2), out=tmp_path, **SMALL).head["done"] == 8


def test_a_grid_in_another_order_is_the_same_sweep(dataset: Dataset, tmp_path: Path) -> None:
    from polars.testing import assert_frame_equal

    first = sweep(dataset, epochs=(1,), seeds=(0, 1), out=tmp_path, **SMALL)
    turned = SMALL | {"architectures": ("9", "5_5d2"), "batches": ("full", 4)}
    again = sweep(dataset, epochs=(1,), seeds=(1, 0), out=tmp_path, **turned)
    assert again.head["id"] == first.head["id"] and again.head["resumed"] == 4
    assert_frame_equal(again.trials.sort("trial"), first.trials.sort("trial"))


def test_of_equals_on_validation_the_test_part_does_not_choose() -> None:
    def made(parameters: int) -> TrialResult:
        trial: Any = SimpleNamespace(arch=SimpleNamespace(parameters=parameters))
        head: Any = None
        figures = {"validation_macro_f1": 0.5, "accuracy": parameters / 1e6}
        return TrialResult(trial, (RunScores(figures, np.zeros((2, 2), np.int64), 1, 0.0),), "done", head)

    results = [made(size) for size in (300, 100, 200)]
    assert [result.trial.arch.parameters for result in ranked(results)] == [300, 200, 100]
    assert best_on_validation(results) is results[1] and best_on_validation([]) is None


def test_what_keeps_the_first_trainings_from_being_done_ends_the_sweep(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from plushsense.training import fit as room

    def broken(*given: Any, **more: Any) -> Any:
        raise TrainingError("no way to train here")

    monkeypatch.setattr(room, "fit", broken)
    with pytest.raises(TrainingError, match="no way to train here"):
        sweep(dataset, epochs=(1,), out=tmp_path, **SMALL)


def test_one_lost_training_is_told_and_its_trials_wait(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from plushsense.training import fit as room

    real = room.fit

    def fit(train: Any, validation: Any, arch: Any, *rest: Any, **more: Any) -> Any:
        if arch.symbol == "9":
            raise MemoryError("no memory for it")
        return real(train, validation, arch, *rest, **more)

    monkeypatch.setattr(room, "fit", fit)
    found = sweep(dataset, epochs=(1,), out=tmp_path, **SMALL)
    assert found.head["trainings_lost"] == 2 == len(found.head["failed"])
    assert set(found.trials["status"]) == {"done", "waiting"}
    monkeypatch.setattr(room, "fit", real)
    assert sweep(dataset, epochs=(1,), out=tmp_path, **SMALL).head["failed"] == []


def test_a_grid_file_from_the_command_line(cli: Any, dataset: Dataset, tmp_path: Path) -> None:
    grid = tmp_path / "tiny.toml"
    grid.write_text('[grid]\narchitectures = ["9", "5_5d2"]\nfilters = [[2, 2]]\nepochs = [1]\nbatches = [4]\n')
    dry = cli("sweep", dataset.path, "--grid", grid, *keys(classes="shared"), "--dry-run", "--json")
    assert dry.status == 0 and (dry.json["trials"], dry.json["held"], dry.json["problems"]) == (2, 0, [])
    assert sum(dry.json["cost"].values()) == pytest.approx(1.0) and dry.json["macs"] > 0
    assert 0.01 < dry.json["training_mb"] < 5.0
    plain = cli("sweep", dataset.path, "--grid", grid, *keys(padding="causal"), "--dry-run")
    assert "as PyTorch takes it" in plain.out
    told = cli("sweep", dataset.path, "--grid", grid, *keys(classes="shared"), "--dry-run").out
    assert "LEAKY" in told and ("SIMULATION" in told) == dry.json["simulated"]
    assert "2 trials in 2 trainings (1 fold, 1 seed)" in told
    assert not (dataset.path / "evaluations").exists() and not (dataset.path / "cache" / "sweeps").exists()
    ran = cli("sweep", dataset.path, "--grid", grid, "--workers", "1", "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert found["out"] == str(dataset.path / "evaluations" / "sweep-tiny")
    assert (found["trials"], found["done"], found["resumed"], found["leaky"]) == (2, 2, 0, True)
    assert len(found["best"]) == 2 and found["seconds"] >= 0
    text = cli("sweep", dataset.path, "--grid", grid).out
    assert text.startswith("LEAKY") and "accuracy (leaky)" in text and "2 of 2 trials done (2 from before)" in text
    people = cli(
        "sweep", dataset.path, "--grid", grid, "--split", "by-subject:2", *keys(classes="shared"), "--seeds", "2"
    )
    assert people.status == 0 and "leaky" not in people.out.lower()
    assert "8 of 8 trainings" in people.err


def test_a_new_column_is_a_function_and_a_line(
    cli: Any, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    depth = TrialColumn(int, lambda trial: len(trial.trial.arch.filters), "convolutions", "count")
    monkeypatch.setitem(TRIAL_COLUMNS, "depth", depth)
    words = (
        "--set",
        "architectures=9,5_5d2",
        "--set",
        "filters=2,2",
        "--epochs",
        "1",
        "--set",
        "batches=4",
        "--set",
        "classes=shared",
    )
    ran = cli("sweep", dataset.path, *words, "--out", tmp_path / "out")
    assert "convolutions" in ran.out
    saved = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert {row["depth"] for row in saved["best"]} == {1, 2}
    assert {(row["arch"], row["receptive_field_s"]) for row in saved["best"]} == {("9", 0.09), ("5d1_5d2", 0.13)}
    assert "reads (s)" in ran.out
    assert "depth" in (tmp_path / "out" / "trials.csv").read_text().splitlines()[0]
    assert cli("report", tmp_path / "out").status == 0
    assert "Convolutions" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_bad_grid_is_refused_with_all_its_problems(cli: Any, dataset: Dataset, tmp_path: Path) -> None:
    grid = tmp_path / "bad.toml"
    grid.write_text(
        '[grid]\narchitectures = ["14d1_39d2_41d4", "100_300", "9x"]\nfilters = [[4, 6]]\nepoch = [1]\n'
        'epochs = [5, 2]\nbatches = [2, 4000]\npadding = "mirorr"\nsplit = "by-subject:50"\n'
    )
    ran = cli("sweep", dataset.path, "--grid", grid, "--json")
    assert (ran.status, ran.out) == (2, "")
    for words in (
        "The grid has 8 problems", "Unknown key 'epoch'", "Did you mean 'epochs'?", "'9x'", "4/6 are only 2",
        "receptive field of 399", "Unknown padding", "A batch of 4000", "do not ascend",
        "by-subject:50 needs at least 50 people",
    ):  # fmt: skip
        assert words in ran.err, words
    assert not (dataset.path / "cache").exists() and not (dataset.path / "evaluations").exists()
    small = cli(
        "sweep",
        dataset.path,
        "--set",
        "batches=4000",
        "--epochs",
        "2",
        "--set",
        "architectures=9x",
        "--dry-run",
        "--json",
    )
    assert small.status == 1 and len(small.json["problems"]) == 2
    assert any("A batch of 4000 is larger than the" in line for line in small.json["problems"])
    small = cli(
        "sweep", dataset.path, *keys(batches="4000"), "--epochs", "2", "--split", "by-me", "--dry-run", "--json"
    )
    assert ["A batch of 4000" in line or "Unknown split" in line for line in small.json["problems"]] == [True, True]
    assert "Unknown grid 'papr'" in cli("sweep", dataset.path, "--grid", "papr").err
    assert "no seeds" in cli("sweep", dataset.path, "--seeds", "0").err
    (tmp_path / "file").write_text("")
    taken = cli(
        "sweep",
        dataset.path,
        "--set",
        "architectures=9",
        "--set",
        "classes=shared",
        "--set",
        "batches=4",
        "--out",
        grid,
    )
    assert taken.status == 2 and "is a file" in taken.err


@pytest.mark.parametrize("halving", [False, True])
@pytest.mark.exhaustive_for("False", "True")
def test_killed_and_gone_on_with(cli: Any, four_people: Path, tmp_path: Path, halving: bool) -> None:
    """Real recordings, ``kill -9`` at random moments: each training once, tables as of an undisturbed run."""
    from polars.testing import assert_frame_equal

    for name in ("DS", "whole"):
        shutil.copytree(four_people, tmp_path / name)
    options: dict[str, Any] = {
        "architectures": "20d2_16d4_20d8,19d1_24d3_19d9,1d1_27d3_20d9,14d1_19d2_19d4,126d2",
        "filters": "2,2,2,2",
        "epochs": "1,2",
        "batches": "64,full",
    }
    if halving:
        options |= {"split": "by-subject:2", "batches": "32", "epochs": "1,2,4", "share": "0.8"}
    words = keys(**options)
    words += ["--halving"] * halving + ["--out", str(tmp_path / "out"), "--json"]
    journal = tmp_path / "DS" / "cache" / "sweeps"

    def finished() -> dict[str, bytes]:
        there = journal.iterdir() if journal.is_dir() else ()
        return {p.name: p.read_bytes() for p in there if p.suffix == ".npz"}

    chance = random.Random(4)
    before: dict[str, bytes] = {}
    # With halving, once in each rung: 10 trainings in the first, 6 in the second.
    for workers, enough in (("1", 3), ("1", 12)) if halving else (("1", 1), ("2", 2), ("1", 3)):
        process = subprocess.Popen(
            [*COMMAND, str(tmp_path / "DS"), *words, "--workers", workers],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + 300
        while len(finished()) < max(enough, len(before) + 1) and time.monotonic() < deadline:
            assert process.poll() is None, "it was to be killed in the middle"
            time.sleep(0.01)
        time.sleep(0.0 if halving else chance.uniform(0.0, 0.5))
        process.kill()
        process.wait(10)
        # Workers whose starter is gone end at their next word.
        time.sleep(1.0 if workers == "2" else 0.0)
        now = finished()
        assert len(before) < len(now), "some were done"
        assert all(now[name] == content for name, content in before.items()), "not trained again"
        before = now
    done = cli("sweep", tmp_path / "DS", *words, "--workers", "1")
    assert done.status == 0, done.err
    found = done.json
    after = finished()
    assert found["trainings_resumed"] == len(before) < len(after) == found["trainings_done"]
    assert all(after[name] == content for name, content in before.items())
    whole = sweep(tmp_path / "whole", out=tmp_path / "other", workers=1, halving=halving, **options)
    stored = whole.head
    assert (found["trials"], found["done"]) == (stored["trials"], stored["done"])
    if halving:
        assert found["halving"]["rungs"] == stored["halving"]["rungs"]
    for name in ("trials", "runs", "curves"):
        mine, theirs = (frame(folder, name) for folder in (tmp_path / "out", tmp_path / "other"))
        assert_frame_equal(mine.drop("seconds", strict=False), theirs.drop("seconds", strict=False), check_exact=True)
