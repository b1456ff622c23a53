"""backup and forget as a user types them; models that were trained on somebody who leaves."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import plushsense as ps
from plushsense.dataset.store import Dataset
from plushsense.workflow.forgetting import forget

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]


def test_backup_check_and_restore(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "b.zip"
    saved = cli("backup", dataset.path, file, "--json").json
    assert (saved["recordings"], saved["subjects"], saved["hash"]) == (30, 5, dataset.hash)
    assert cli("backup", "--check", file, "--json").json["valid"] is True
    assert cli("backup", "--restore", file, tmp_path / "R", "--json").json["hash"] == dataset.hash
    file.write_bytes(file.read_bytes()[:-40])
    ran = cli("backup", "--check", file, "--json")
    assert (ran.status, ran.json["valid"]) == (1, False)
    assert cli("backup", "--restore", file, tmp_path / "R2").status == 2
    assert cli("backup", dataset.path).status == cli("backup", dataset.path, "x", "--check", file).status == 2
    assert cli("backup").status == cli("backup", "--restore", file).status == 2


def test_forget_asks_first_and_names_the_models(cli: Cli, dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    models = tmp_path / "models"
    models.mkdir()
    shutil.copy(bundle, models / "m.plush")
    ps.load(bundle).without_people().save(models / "given.plush")
    (models / "torn.plush").write_bytes(bundle.read_bytes()[:100])
    before = {p: p.read_bytes() for p in dataset.path.rglob("*") if p.is_file()}
    ran = cli("forget", dataset.path, "P1", "--bundles", models, "--json")
    assert (ran.status, ran.json["done"], ran.json["raw"]) == (1, False, 7)
    assert {p: p.read_bytes() for p in dataset.path.rglob("*") if p.is_file()} == before
    assert "does not name people" in {Path(b["bundle"]).name: b for b in ran.json["bundles"]}["given.plush"]["message"]
    named = {Path(b["bundle"]).name: b for b in ran.json["bundles"]}
    assert named["m.plush"]["certain"]
    assert "train it again" in named["m.plush"]["message"]
    assert "people are unknown" in named["torn.plush"]["message"]
    ran = cli("forget", dataset.path, "P1", "--yes", "--bundles", models)
    assert ran.status == 0
    assert "Out of reach: backups" in ran.out
    assert ps.open_dataset(dataset.path).subjects == ["P2", "P3", "P4", "P5"]
    assert (models / "m.plush").is_file(), "models are named, not removed"
    ran = cli("forget", dataset.path, "P1", "--yes")
    assert (ran.status, "'P1' is not in the data set" in ran.out) == (0, True)
    assert cli("forget", dataset.path, "P2", "--bundles", tmp_path / "nowhere").status == 2


def test_an_exported_model_of_the_data_set_is_a_question_too(dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    """It does not say of whom it is."""
    ours = replace(ps.load(bundle), provenance={"dataset": dataset.head.name, "subjects": 3, "validation_subjects": 1})
    ours.save(tmp_path / "ours.plush")
    replace(ours, provenance=ours.provenance | {"dataset": "another"}).save(tmp_path / "other.plush")
    found = forget(dataset.path, "P1", bundles=[tmp_path]).bundles
    assert [(Path(b.bundle).name, b.certain) for b in found] == [("ours.plush", False)]
    assert "does not name people" in found[0].message


def test_a_bundle_of_another_data_set_is_only_a_question(dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    head = dataset.path / "dataset.toml"
    text = head.read_text()
    head.write_text(text.replace(f'name = "{dataset.head.name}"', 'name = "another"'))
    shutil.rmtree(dataset.path / "recordings" / "P5")
    shutil.rmtree(dataset.path / "streams" / "P5")
    (dataset.path / "index.json").unlink()
    found = forget(dataset.path, "P1", bundles=[bundle])
    assert [b.certain for b in found.bundles] == [False]
    assert "check whether" in found.bundles[0].message
    assert not found.done
    head.write_text(text)
    again = forget(dataset.path, "P1", bundles=[bundle]).bundles
    assert not again[0].certain, "another content"
    assert "earlier state" in again[0].message or ps.load(bundle).provenance["dataset"] != dataset.head.name


def test_forget_takes_the_evaluations_that_hold_the_person(cli: Cli, dataset: Dataset) -> None:
    made = cli(
        "evaluate",
        dataset.path,
        "--split",
        "by-subject:2",
        "--filters",
        "4,4,4",
        "--epochs",
        "1",
        "--workers",
        "1",
        "--json",
    ).json
    assert Path(made["out"]).is_dir()
    done = cli("forget", dataset.path, "P3", "--yes", "--json").json
    assert [Path(e).name for e in done["evaluations"]] == [Path(made["out"]).name]
    assert not Path(made["out"]).exists()
    assert not (dataset.path / "cache").exists()
    left = "".join(p.read_text(errors="replace") for p in dataset.path.rglob("*") if p.suffix in (".json", ".toml"))
    assert "P3" not in left
    assert json.loads((dataset.path / "forgotten.jsonl").read_text())["files"] == 7
