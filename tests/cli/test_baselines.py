"""``plushsense baselines`` as a user meets it, and our network in it as ``evaluate`` gives it."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.experiments.baselines.run_baselines import MODELS, SETS, chosen

Cli = Callable[..., Any]

pytestmark = [pytest.mark.usefixtures("scikit_learn"), pytest.mark.apart("scikit-learn")]

SPLITS = "by-subject:2,windows:3"
QUICK = ("--models", "knn,tree", "--features", "statistics", "--workers", 1)


def test_one_table_of_two_splits_and_what_is_left_behind(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = ("baselines", dataset.path, "--split", SPLITS, *QUICK, "--out", tmp_path / "OUT")
    found = cli(*words, "--json").json
    assert [(r["name"], r["pca"], r["split"], r["leaky"]) for r in found["models"]] == [
        (name, pca, split, split == "windows:3")
        for pca in (False, True)
        for name in ("knn", "tree")
        for split in SPLITS.split(",")
    ]
    for row in found["models"]:
        assert 0 <= row["accuracy"]["mean"] <= 1 and 0 <= row["macro_f1"]["mean"] <= 1
        assert row["features"] == "statistics" and row["size_bytes"] > 1000 and row["predict_ms"] > 0
        assert row["span_s"] == 2.47  # 247 samples, as the default network reads
    assert {g["name"] for g in found["gaps"]} == {"knn", "tree"} and len(found["gaps"]) == 4
    assert found["simulated"] is False and found["jobs"] == 4 * (2 + 3) and found["resumed"] == 0
    assert sorted(p.name for p in (tmp_path / "OUT").iterdir()) == [
        "baselines.csv", "baselines.html", "baselines.json", "baselines.png",
    ]  # fmt: skip
    rows = list(csv.DictReader(io.StringIO((tmp_path / "OUT" / "baselines.csv").read_text(encoding="utf-8"))))
    assert len(rows) == 8
    assert float(rows[0]["accuracy_mean"]) == pytest.approx(found["models"][0]["accuracy"]["mean"])
    page = (tmp_path / "OUT" / "baselines.html").read_text(encoding="utf-8")
    assert "Only the number by person counts" in page and "LEAKY" in page and "decision tree" in page
    assert "http" not in page.replace("http-equiv", "")
    ran = cli(*words)
    assert ran.status == 0 and "(leaky)" in ran.out and "Only the number by person counts" in ran.out
    assert "macro-F1 (leaky)" in ran.out and "span s" in ran.out
    assert "20 of 20 fits (20 from before)" in ran.err
    other = cli("baselines", dataset.path, "--split", "windows:3", *QUICK, "--out", tmp_path / "OUT")
    assert other.status == 2 and "holds a comparison of other settings" in other.err and other.out == ""
    forced = cli("baselines", dataset.path, "--split", "windows:3", *QUICK, "--out", tmp_path / "OUT", "--force")
    assert forced.status == 0 and "say little about a new person" in forced.out


def test_copies_between_people_are_counted_by_split(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    folder = dataset.path
    first, *_, last = sorted(dataset.used, key=lambda r: r.subject)
    same = (folder / first.file).read_bytes()
    (folder / last.file).unlink()
    (folder / last.file).with_name(Path(first.file).name).write_bytes(same)
    (folder / "index.json").unlink()
    words = ("--split", "leave-one-subject-out,windows:3", "--models", "knn", "--features", "statistics", "--pca", "no")
    ran = cli("baselines", folder, *words, "--workers", 1, "--out", tmp_path / "OUT")
    assert "so the scores are too high: exclude one of the two recordings" in ran.err
    splits = json.loads((tmp_path / "OUT" / "baselines.json").read_text(encoding="utf-8"))["splits"]
    by_people, by_windows = (s["leakage"] for s in splits)
    assert by_people["shared_rows"] > 0 == by_people["same_person"] and by_windows["same_person"] > 0
    page = (tmp_path / "OUT" / "baselines.html").read_text(encoding="utf-8")
    assert "Leakage audit of leave-one-subject-out" in page and "rows of its recording in another" in page


def test_our_network_is_the_one_that_evaluate_scores(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    settings = ("--filters", "4,4,4", "--epochs", 3, "--preset", "loso", "--workers", 1, "--json")
    scored = cli("evaluate", dataset.path, "--split", "by-subject:2", *settings, "--out", tmp_path / "E").json
    models = "network,lstm,lstm:units=8:dropout=0.5"
    asked = ("baselines", dataset.path, "--split", "by-subject:2", "--models", models, *settings)
    found = cli(*asked, "--out", tmp_path / "B").json
    network = next(r for r in found["models"] if r["name"] == "network")
    assert network["accuracy"]["mean"] == pytest.approx(scored["accuracy"]["mean"]) and network["features"] == "windows"
    assert network["pooled"]["macro_f1"] == pytest.approx(scored["pooled"]["macro_f1"])
    # The bundle of so small a network: weights, and the words around them.
    assert 1_500 < network["size_bytes"] < 20_000 and found["gaps"] == []
    titles = {r["name"]: (r["title"], r["size_bytes"]) for r in found["models"] if r["name"] != "network"}
    assert list(titles) == ["lstm", "lstm:units=8:dropout=0.5"] and titles["lstm"][0] == "LSTM (32)"
    assert titles["lstm:units=8:dropout=0.5"][0] == "LSTM (8, dropout 0.5)"
    assert titles["lstm:units=8:dropout=0.5"][1] < titles["lstm"][1] / 2
    assert len({r["span_s"] for r in found["models"]}) == 1
    assert "LSTM (8, dropout 0.5)" in (tmp_path / "B" / "baselines.html").read_text(encoding="utf-8")


def test_refusals_are_sentences(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    place = ("--out", tmp_path / "OUT")
    for words, said in (
        (("--models", "forests"), "Unknown model 'forests': accepted are quick,"),
        (("--features", "raw"), "Unknown features 'raw': accepted are statistics, paper-statistics, flattened."),
        (("--models", "lstm:128"), "accepted are :units=NUMBER"),
        (("--pca", "maybe"), "Unknown choice 'maybe' for PCA: accepted are both, no, yes, unscaled, all."),
        (("--split", "windows"), "needs a number of folds"),
        (("--split", "windows:3,windows:3"), "given twice"),
        (("--split", ",", "--models", "knn"), "No split is given"),
        (("--models", "boosting", "--features", "flattened", "--pca", "no"), "No program is left to compare"),
    ):
        ran = cli("baselines", dataset.path, *words, *place)
        assert ran.status == 2 and said in ran.err and ran.out == "" and "Traceback" not in ran.err, ran.err
        assert len([line for line in ran.err.splitlines() if line.startswith("plushsense:")]) == 1
    (tmp_path / "file").write_text("mine")
    ran = cli("baselines", dataset.path, *QUICK, "--out", tmp_path / "file")
    assert ran.status == 2 and "is a file; give a folder" in ran.err
    assert not (tmp_path / "OUT").exists()


def test_sets_and_names_join_in_the_order_of_the_table() -> None:
    assert chosen("network, quick,tree") == (*(m for m in MODELS if m in SETS["quick"]), "network")
    assert set(chosen("all")) == set(MODELS)
    assert chosen("network,bilstm:units=8,lstm:layers=2,lstm:units=32") == (
        "lstm", "lstm:layers=2", "bilstm:units=8", "network",
    )  # fmt: skip


def test_pca_without_scaling_has_rows_of_its_own(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = ("baselines", dataset.path, "--split", "windows:2", "--models", "tree", "--features", "statistics")
    found = cli(*words, "--pca", "all", "--workers", 1, "--out", tmp_path / "OUT", "--json").json
    assert [row["pca"] for row in found["models"]] == [False, True, "unscaled"]
    page = (tmp_path / "OUT" / "baselines.html").read_text(encoding="utf-8")
    assert ">statistics, PCA<" in page and ">statistics, PCA unscaled<" in page
    rows = list(csv.DictReader(io.StringIO((tmp_path / "OUT" / "baselines.csv").read_text(encoding="utf-8"))))
    assert [row["pca"] for row in rows] == ["False", "True", "unscaled"]
    ran = cli(*words, "--pca", "unscaled", "--workers", 1)
    assert "statistics, PCA unscaled" in ran.out and "2 of 2 fits (2 from before)" in ran.err


@pytest.mark.exhaustive
def test_on_real_recordings_a_leaky_split_flatters_trees(cli: Cli, real_data: Path, tmp_path: Path) -> None:
    dataset = import_recordings(real_data / "makeability-gestures", tmp_path / "DS", layout="accel-3").dataset
    found = cli(
        "baselines", dataset.path, "--split", "by-subject:3,windows:3", "--models", "tree,rbf-svm", "--pca", "no",
        "--features", "statistics", "--workers", 1, "--json",
    ).json  # fmt: skip
    assert found["subjects"] == 27 and len(found["labels"]) == 10
    for gap in found["gaps"]:
        assert gap["accuracy"] > 0.08, gap
    for row in found["models"]:
        assert (0.35 < row["accuracy"]["mean"] < 0.65) if not row["leaky"] else (0.6 < row["accuracy"]["mean"] < 0.85)
