"""Searches: their trainings are a sweep's, stopped and gone on with to the last bit, and each is done once."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plushsense.core.errors import ConfigError, DivergedError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.experiments.search.run import SearchProgress, search
from plushsense.experiments.sweep.run import sweep

if TYPE_CHECKING:
    import polars

SMALL: dict[str, Any] = {
    "architectures": ("5_5d2", "9", "3d1_9d2", "20"),
    "filters": ((2, 3, 3, 3),),
    "batches": (4,),
    "split": "by-subject:2",
    "workers": 1,
}
QUICK: dict[str, Any] = {"rungs": (1, 2, 4), "share": 0.6}
COMMAND = [sys.executable, "-m", "plushsense", "search"]


def frame(folder: Path, name: str) -> polars.DataFrame:
    import polars

    return polars.read_parquet(folder / f"{name}.parquet")


def grid_keys() -> dict[str, Any]:
    """What a search takes where nothing is said, for a sweep to compare with."""
    return {**SMALL, "preset": "people", "padding": "stream", "context": "stream", "classes": "shared"}


def test_its_scores_are_those_of_trainings_without_a_stop(dataset: Dataset, recordings: Path, tmp_path: Path) -> None:
    import polars
    from polars.testing import assert_frame_equal

    seen: list[SearchProgress] = []
    found = search(dataset, seeds=(0, 1), progress=seen.append, **QUICK, **SMALL)
    other = import_recordings(recordings, tmp_path / "other", layout="accel-3").dataset
    whole = sweep(other, epochs=(1, 2, 4), seeds=(0, 1), out=tmp_path / "o", **grid_keys())
    scores = {(row["arch"], row["epochs"]): row for row in whole.trials.iter_rows(named=True)}
    s = found.summary
    assert [rung["epochs"] for rung in s["rungs"]] == [1, 2, 4] and s["rungs"][0]["entered"] == 4
    assert s["rungs"][2]["entered"] < 4 and s["trainings_resumed"] == 0
    for rung in s["rungs"]:
        for row in rung["networks"]:
            assert row["macro_f1"] == pytest.approx(scores[row["arch"], rung["epochs"]]["macro_f1"], abs=1e-15)
    # The tables hold each network at the end of its way, as the sweep has it.
    trials = frame(found.out, "trials")
    finals = {row["arch"] for row in s["finalists"]}
    assert dict(trials.select("arch", "status").iter_rows()) == {
        arch: "done" if arch in finals else "partial" for arch in trials["arch"]
    }
    mine = trials.drop("seconds", "status", "trial")
    theirs = whole.trials.filter(
        polars.struct("arch", "epochs").is_in(
            [{"arch": a, "epochs": e} for a, e in mine.select("arch", "epochs").rows()]
        )
    )
    assert_frame_equal(mine.sort("arch"), theirs.select(mine.columns).sort("arch"), check_exact=True)
    curves, all_curves = frame(found.out, "curves"), frame(tmp_path / "o", "curves")
    keys = ["arch", "seed", "fold", "epoch"]
    both = curves.join(all_curves, on=keys, suffix="_whole")
    assert len(both) == len(curves) == 4 * sum(trials["epochs"])
    assert both["train_loss"].to_list() == both["train_loss_whole"].to_list()
    # The winner, its spread, and what it has cost.
    best = s["winner"]
    assert best["macro_f1"] == max(row["macro_f1"] for row in s["finalists"])
    assert (len(best["by_fold"]), len(best["by_seed"])) == (2, 2)
    assert sum(best["by_fold"]) / 2 == pytest.approx(best["macro_f1"]) == sum(best["by_seed"]) / 2
    assert s["cost"]["share"] <= 0.6 and s["cost"]["macs"] == pytest.approx(sum(r["macs"] for r in s["rungs"]))
    assert seen[-1].share == pytest.approx(s["cost"]["macs"] / s["cost"]["bound_macs"])
    assert (seen[-1].rung, seen[-1].done) == (3, seen[-1].total) and seen[-1].best is not None
    assert json.loads((found.out / "search.json").read_text()) == json.loads(json.dumps(s))
    assert best["arch"] in repr(found) and "leaky" not in repr(found)


def test_a_sweep_and_a_search_share_their_trainings(dataset: Dataset, tmp_path: Path, recordings: Path) -> None:
    first = search(dataset, **QUICK, **SMALL)
    swept = sweep(dataset, epochs=(4,), out=tmp_path / "o", **grid_keys())
    assert swept.summary["trainings_resumed"] == 2 * len(first.summary["finalists"])
    again = search(dataset, **QUICK, **SMALL)
    assert again.out == first.out
    assert again.summary["trainings_resumed"] == sum(2 * rung["entered"] for rung in first.summary["rungs"])
    seconds = {"seconds", "trainings_resumed"}
    assert {k: v for k, v in again.summary.items() if k not in seconds} == {
        k: v for k, v in first.summary.items() if k not in seconds
    }
    # A sweep's training holds no state: what goes on from it begins again, with the same outcome.
    other = import_recordings(recordings, tmp_path / "other", layout="accel-3").dataset
    sweep(other, epochs=(1,), out=tmp_path / "p", **grid_keys())
    after = search(other, **QUICK, **SMALL)
    assert after.summary["trainings_resumed"] == 8
    assert [rung["networks"] for rung in after.summary["rungs"]] == [
        rung["networks"] for rung in first.summary["rungs"]
    ]


def test_early_rungs_may_look_at_fewer_folds(dataset: Dataset, tmp_path: Path) -> None:
    found = search(dataset, folds=(1, 1), out=tmp_path, **QUICK, **SMALL)
    assert [rung["folds"] for rung in found.summary["rungs"]] == [1, 1, 2]
    assert found.summary["winner"]["folds"] == 2
    assert frame(tmp_path, "runs").group_by("arch").len()["len"].to_list().count(1) >= 1
    with pytest.raises(ConfigError, match="it has 2"):
        search(dataset, folds=(1, 3), **QUICK, **SMALL)


def test_limits_are_kept_before_anything_runs(cli: Any, dataset: Dataset) -> None:
    words = [
        "--architectures",
        "5_5d2,9,20",
        "--filters",
        "2,3",
        "--split",
        "by-subject:2",
        "--batches",
        "4",
        "--share",
        "1",
    ]
    dry = cli("search", dataset.path, *words, "--max-parameters", "120", "--dry-run", "--json")
    assert dry.status == 0, dry.err
    assert dry.json["candidates"] + len(dry.json["left_out"]) == 3 and dry.json["candidates"] == 2
    assert "over 120" in dry.json["left_out"][0]["why"]
    assert "1 of 3 networks are beyond the limits and left out: 20 with 2" in dry.err
    none = cli("search", dataset.path, *words, "--max-macs-per-step", "10")
    assert none.status == 2 and "None of the 3 networks" in none.err and "MAC a step" in none.err
    free = cli("search", dataset.path, *words[:-2], "--dry-run", "--json")
    assert free.json["bound_share"] > 0.25 and "3 networks are too few" in free.err
    small = cli("search", dataset.path, *words[:-1], "0.05")
    assert small.status == 2 and "too small" in small.err and "allow a share of" in small.err
    bad = cli("search", dataset.path, *words, "--rungs", "4,2", "--eta", "0.5", "--padding", "strem", "--json")
    assert bad.status == 2 and bad.out == "" and "The grid has 3 problems" in bad.err and "do not" not in bad.err
    with pytest.raises(ConfigError, match=r"stop early \(patience 10, preset loso\)"):
        search(dataset, preset="loso", **QUICK, **SMALL)
    assert not (dataset.path / "cache" / "sweeps").exists() and not (dataset.path / "evaluations").exists()


def test_from_the_command_line_to_the_next_command(cli: Any, recordings: Path, tmp_path: Path) -> None:
    dataset = import_recordings(recordings, tmp_path / "D S", layout="accel-3", simulated=True).dataset
    grid = tmp_path / "tiny.toml"
    grid.write_text(
        '[grid]\narchitectures = ["9", "5_5d2", "20"]\nfilters = [[2, 2]]\nbatches = [4]\nsplit = "by-subject:2"\n'
        "learning_rate = 0.01\n[search]\nrungs = [1, 3]\nshare = 0.75\n"
    )
    text = cli("search", dataset.path, "--grid", grid, "--workers", "1")
    assert text.status == 0, text.err
    assert text.out.startswith("SIMULATION") and "Train it on everybody" in text.out and "bound 75%" in text.out
    assert "rung 1 of 2, networks 3: 6 of 6 trainings" in text.err
    ran = cli("search", dataset.path, "--grid", grid, "--workers", "1", "--json")
    found = ran.json
    assert found["simulated"] and "(12 from before)" not in ran.err and found["trainings_resumed"] >= 8
    # What it says to do next can be done, with the settings that have no option in a file.
    words = shlex.split(found["command"])
    assert words[:3] == ["plushsense", "train", str(dataset.path)] and "--config" in words
    trained = cli(*words[1:], "--out", tmp_path / "m.plush", "--json")
    assert trained.status == 0, trained.err
    assert [row["learning_rate"] for row in trained.json["history"]] == [0.01] * 3
    other = cli("search", dataset.path, "--grid", grid, "--rungs", "1,4", "--out", found["out"])
    assert other.status == 2 and "--force" in other.err


def test_one_that_diverges_is_left_out(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from plushsense.training import fit as room

    real = room.fit

    def fit(train: Any, validation: Any, arch: Any, spec: Any, *rest: Any, **more: Any) -> Any:
        if arch.symbol == "9":
            raise DivergedError("the loss is no number")
        return real(train, validation, arch, spec, *rest, **more)

    monkeypatch.setattr(room, "fit", fit)
    found = search(dataset, out=tmp_path, **QUICK, **SMALL).summary
    went = {row["arch"]: (row["went"], row["macro_f1"]) for row in found["rungs"][0]["networks"]}
    assert went["9"] == ("its training failed", None)
    assert dict(frame(tmp_path, "trials").select("arch", "status").iter_rows())["9"] == "failed"
    sweep_json = json.loads((tmp_path / "sweep.json").read_text())
    assert {row["why"] for row in sweep_json["failed"]} == {"the loss is no number"}


def test_killed_in_every_rung_and_gone_on_with(four_people: Path, tmp_path: Path) -> None:
    """Real recordings, ``kill -9`` once in each rung: each training once, the outcome that of an undisturbed search."""
    from polars.testing import assert_frame_equal

    for name in ("DS", "whole"):
        shutil.copytree(four_people, tmp_path / name)
    options = {
        "architectures": "20d2_16d4_20d8,19d1_24d3_19d9,14d1_19d2_19d4,126d2",
        "filters": "2,2,2,2",
        "split": "by-subject:2",
        "batches": "32",
        "rungs": "1,2,4",
        "share": "0.8",
    }
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    journal = tmp_path / "DS" / "cache" / "sweeps"

    def finished() -> dict[str, bytes]:
        there = journal.iterdir() if journal.is_dir() else ()
        return {p.name: p.read_bytes() for p in there if p.suffix == ".npz"}

    before: dict[str, bytes] = {}
    for stop_after in (3, 9):
        process = subprocess.Popen(
            [*COMMAND, str(tmp_path / "DS"), *words, "--workers", "1"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + 300
        while len(finished()) < stop_after and time.monotonic() < deadline:
            assert process.poll() is None, "it was to be killed in the middle"
            time.sleep(0.01)
        process.kill()
        process.wait(10)
        now = finished()
        assert len(before) < len(now) and all(now[name] == content for name, content in before.items())
        before = now
    done = search(tmp_path / "DS", out=tmp_path / "out", workers=1, **options)  # type: ignore[arg-type]
    assert done.summary["trainings_resumed"] == len(before)
    after = finished()
    assert all(after[name] == content for name, content in before.items()), "not trained again"
    assert len(after) == sum(2 * rung["entered"] for rung in done.summary["rungs"])
    whole = search(tmp_path / "whole", out=tmp_path / "other", workers=1, **options)  # type: ignore[arg-type]
    assert whole.summary["rungs"] == done.summary["rungs"]
    assert whole.summary["winner"] | {"seconds": 0} == done.summary["winner"] | {"seconds": 0}
    for name in ("trials", "runs", "curves"):
        mine, theirs = (frame(folder, name) for folder in (tmp_path / "out", tmp_path / "other"))
        assert_frame_equal(mine.drop("seconds", strict=False), theirs.drop("seconds", strict=False), check_exact=True)
