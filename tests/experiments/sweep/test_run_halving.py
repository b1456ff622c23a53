"""Sweeps with halving: their trainings are a sweep's, stopped and continued to the last bit, and each is done once."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plushsense.core.errors import ConfigError, DivergedError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.experiments.sweep.run_sweep import SweepProgress
from support.sweeping import keys, sweep

pytestmark = pytest.mark.apart("cluster")

if TYPE_CHECKING:
    import polars

SMALL: dict[str, Any] = {
    "architectures": ("5_5d2", "9", "3d1_9d2", "20"),
    "filters": ((2, 3, 3, 3),),
    "batches": (4,),
    "split": "by-subject:2",
    "workers": 1,
}
HALVING: dict[str, Any] = {"grid": "people", "halving": True, "epochs": (1, 2, 4), "share": 0.6, **SMALL}


def frame(folder: Path, name: str) -> polars.DataFrame:
    import polars

    return polars.read_parquet(folder / f"{name}.parquet")


def test_its_scores_are_those_of_trainings_without_a_stop(dataset: Dataset, recordings: Path, tmp_path: Path) -> None:
    import polars
    from polars.testing import assert_frame_equal

    seen: list[SweepProgress] = []
    found = sweep(dataset, seeds=(0, 1), progress=seen.append, **HALVING)
    other = import_recordings(recordings, tmp_path / "other", layout="accel-3").dataset
    whole = sweep(other, "people", epochs=(1, 2, 4), seeds=(0, 1), out=tmp_path / "o", **SMALL)
    scores = {(row["arch"], row["epochs"]): row for row in whole.trials.iter_rows(named=True)}
    halving = json.loads((found.out / "sweep.json").read_text())["halving"]
    assert [rung["epochs"] for rung in halving["rungs"]] == [1, 2, 4] and halving["rungs"][0]["entered"] == 4
    assert halving["rungs"][2]["entered"] < 4 and not found.head["trainings_resumed"]
    for rung in halving["rungs"]:
        for row in rung["networks"]:
            assert row["macro_f1"] == pytest.approx(scores[row["arch"], rung["epochs"]]["macro_f1"], abs=1e-15)
    # The table has every trial of the grid; those of dropped networks have no scores.
    done = polars.col("status") == "done"
    trained = {(rung["epochs"], row["arch"]) for rung in halving["rungs"] for row in rung["networks"]}
    assert set(found.trials.filter(done).select("epochs", "arch").iter_rows()) == trained
    assert set(found.trials.filter(~done)["status"]) == {"dropped"} and len(found.trials) == 12
    mine = found.trials.filter(done).drop("seconds")
    assert_frame_equal(mine, whole.trials.filter(polars.col("trial").is_in(mine["trial"].to_list())).drop("seconds"))
    curves, all_curves = frame(found.out, "curves"), frame(tmp_path / "o", "curves")
    both = curves.join(all_curves, on=["arch", "seed", "fold", "epoch"], suffix="_whole")
    assert len(both) == len(curves) and both["train_loss"].to_list() == both["train_loss_whole"].to_list()
    # The winner, and what it has cost.
    last = [row["macro_f1"] for row in halving["rungs"][2]["networks"]]
    assert halving["winner"]["macro_f1"] == max(last)
    cost = halving["cost"]
    assert cost["share"] <= 0.6 and cost["macs"] == pytest.approx(sum(rung["macs"] for rung in halving["rungs"]))
    assert seen[-1].share == pytest.approx(cost["macs"] / cost["bound_macs"])
    assert (seen[-1].rung, seen[-1].done) == (3, seen[-1].total) and seen[-1].best is not None
    # A page is made of it as of any sweep.
    from plushsense.experiments.sweep.sweep_page import write_sweep_report

    assert write_sweep_report(found.out).done == len(mine)


def test_with_and_without_halving_trainings_are_shared(dataset: Dataset, tmp_path: Path, recordings: Path) -> None:
    first = sweep(dataset, **HALVING)
    swept = sweep(dataset, "people", epochs=(4,), out=tmp_path / "o", **SMALL)
    rungs = first.head["halving"]["rungs"]
    assert swept.head["trainings_resumed"] == 2 * rungs[-1]["entered"]
    again = sweep(dataset, **HALVING)
    assert again.out == first.out and again.head["trainings_resumed"] == sum(2 * rung["entered"] for rung in rungs)
    assert again.head["halving"] == first.head["halving"]
    # A sweep's training holds no state: what continues from it begins again, with the same outcome.
    other = import_recordings(recordings, tmp_path / "other", layout="accel-3").dataset
    sweep(other, "people", epochs=(1,), out=tmp_path / "p", **SMALL)
    after = sweep(other, **HALVING)
    assert after.head["trainings_resumed"] == 8
    assert after.head["halving"]["rungs"] == rungs


def test_limits_and_budget_are_checked_before_anything_runs(cli: Any, dataset: Dataset) -> None:
    words = (
        "sweep",
        dataset.path,
        "--grid",
        "people",
        "--set",
        "filters=2,3",
        "--split",
        "by-subject:2",
        "--set",
        "batches=4",
    )
    words = (*words, *keys(architectures="5_5d2,9,20"))
    small = cli(*words, "--max-parameters", "120", "--dry-run", "--json")
    assert small.status == 0 and small.json["trials"] == 6 and "halving" not in small.json, "limits without halving"
    assert "over 120" in small.json["left_out"][0]["why"] and small.json["grid"]["max_parameters"] == 120
    assert "1 of 3 networks are beyond the limits and left out: 20 with 2" in small.err
    none = cli(*words, "--max-macs-per-step", "10")
    assert none.status == 2 and "None of the 3 networks" in none.err and "MAC a step" in none.err
    free = cli(*words, "--halving", "--dry-run", "--json")
    assert free.json["halving"]["bound_share"] > 0.25 and "3 networks are too few" in free.err
    text = cli(*words, "--halving", "--share", "1", "--dry-run").out
    assert "halving: 3 networks after 4, 15, 60 epochs, at most" in text
    for setting in ("halve_every    15", "augment        random-rotation:45", "padding        stream"):
        assert setting in text, "the settings are those that the trainings have"
    tight = cli(*words, "--halving", "--share", "0.05")
    assert tight.status == 2 and "too small" in tight.err and "allow a share of" in tight.err
    bad = cli(*words, "--halving", "--epochs", "4,2", "--eta", "0.5", *keys(padding="strem"), "--json")
    assert bad.status == 2 and bad.out == "" and "The grid has 3 problems" in bad.err
    assert not (dataset.path / "cache" / "sweeps").exists() and not (dataset.path / "evaluations").exists()


def test_from_the_command_line_to_the_next_command(cli: Any, recordings: Path, tmp_path: Path) -> None:
    dataset = import_recordings(recordings, tmp_path / "D S", layout="accel-3", simulated=True).dataset
    grid = tmp_path / "tiny.toml"
    grid.write_text(
        '[grid]\narchitectures = ["9", "5_5d2", "20"]\nfilters = [[2, 2]]\nbatches = [4]\nsplit = "by-subject:2"\n'
        'preset = "people"\npadding = "stream"\nlearning_rate = 0.01\nturn_deg = 30\nclasses = "shared"\n'
        "epochs = [1, 3]\nhalving = true\nshare = 0.75\n"
    )
    words = ("sweep", dataset.path, "--grid", grid, "--workers", "1")
    text = cli(*words)
    assert text.status == 0, text.err
    assert text.out.startswith("SIMULATION") and "Train it on everybody" in text.out and "bound 75%" in text.out
    assert "sweep tiny, rung 1 of 2: 6 of 6 trainings" in text.err
    found = cli(*words, "--json").json
    assert found["simulated"] and found["trainings_resumed"] == found["trainings_done"] >= 8
    # What it recommends to do next can be done, with the same settings.
    command = shlex.split(found["halving"]["command"])
    assert command[:3] == ["plushsense", "train", str(dataset.path)]
    trained = cli(*command[1:], "--out", tmp_path / "m.plush", "--json")
    assert trained.status == 0, trained.err
    assert [row["learning_rate"] for row in trained.json["history"]] == [0.01] * 3
    other = cli(*words, "--epochs", "1,4", "--out", found["out"])
    assert other.status == 2 and "--force" in other.err


def test_one_that_diverges_is_left_out(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from plushsense.training import fit as room

    real = room.fit

    def fit(train: Any, validation: Any, arch: Any, spec: Any, *rest: Any, **more: Any) -> Any:
        if arch.symbol == "9":
            raise DivergedError("the loss is no number")
        if arch.symbol == "20":
            raise MemoryError("no memory for it")
        return real(train, validation, arch, spec, *rest, **more)

    monkeypatch.setattr(room, "fit", fit)
    found = sweep(dataset, out=tmp_path, **HALVING).head
    went = {row["arch"]: (row["went"], row["macro_f1"]) for row in found["halving"]["rungs"][0]["networks"]}
    assert went["9"] == went["20"] == ("its training failed", None)
    status = dict(frame(tmp_path, "trials").sort("epochs", descending=True).select("arch", "status").iter_rows())
    assert (status["9"], status["20"]) == ("failed", "dropped")
    assert {(row["arch"], row["why"]) for row in found["failed"]} == {
        ("9", "the loss is no number"),
        ("20", "no memory for it"),
    }
    assert found["trainings_lost"] == 2
    with pytest.raises(ConfigError, match=r"stop early \(patience 10, preset loso\)"):
        sweep(dataset, **{**HALVING, "preset": "loso"})
