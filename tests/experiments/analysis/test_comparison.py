"""Comparisons of evaluations as a user types them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.store import Dataset

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]


@pytest.fixture
def evaluated(cli: Cli, dataset: Dataset, tmp_path: Path) -> Callable[..., Path]:
    """Evaluate a small network into a folder of a name."""

    def run(name: str, *words: object, split: str = "by-subject:2") -> Path:
        out = tmp_path / name
        small = ("--filters", "4,4,4", "--workers", "1", *(() if "--epochs" in words else ("--epochs", 1)))
        ran = cli("evaluate", dataset.path, *small, "--split", split, *words, "--out", out)
        assert ran.status == 0, ran.err
        return out

    return run


def change(folder: Path, **values: Any) -> None:
    """Replace keys of a saved evaluation; None removes a key."""
    path = folder / "evaluation.json"
    table = json.loads(path.read_text()) | values
    path.write_text(json.dumps({key: value for key, value in table.items() if value is not None}))


def test_networks_are_compared_person_by_person(cli: Cli, evaluated: Callable[..., Path], tmp_path: Path) -> None:
    folders = [evaluated(name, "--epochs", epochs) for name, epochs in (("A", 1), ("B", 8), ("C", 2))]
    ran = cli("compare", *folders, "--out", tmp_path / "cmp", "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert {m["name"] for m in found["models"]} == {"M1", "M2", "M3"} and len(found["pairs"]["accuracy"]) == 3
    assert all(0 < row["p"] <= row["p_holm"] <= 1 for row in found["pairs"]["macro_f1"])
    assert len(found["people"]) == 5 and sum(m["rank"]["accuracy"] for m in found["models"]) == pytest.approx(6)
    assert all(0 <= m["calibration_error"] <= 1 for m in found["models"])
    titles = {m["title"].rpartition("seed 0")[2] for m in found["models"]}
    assert titles == {", epochs 1", ", epochs 8", ", epochs 2"}
    assert (found["scored"], found["split"], found["leaky"]) == ("windows", "by-subject:2", False)
    page = (tmp_path / "cmp" / "comparison.html").read_text(encoding="utf-8")
    assert "Critical-difference" in page and "LEAKY" not in page and page.count('src="data:image/') == 4
    assert json.loads((tmp_path / "cmp" / "comparison.json").read_text())["id"] == found["id"]
    other = cli("compare", *folders[:2], "--out", tmp_path / "cmp")
    assert other.status == 2 and "holds a comparison of other settings" in other.err
    text = cli("compare", *folders[:2]).out
    assert "Holm" in text and "95 % interval" in text and f"M1: {folders[0]}" in text


def test_splits_stand_side_by_side_with_what_they_leak(
    cli: Cli, evaluated: Callable[..., Path], tmp_path: Path
) -> None:
    folders = (evaluated("W", split="windows:2"), evaluated("S"), evaluated("H", split="windows:holdout"))
    ran = cli("compare", *folders[:2], "--out", tmp_path / "cmp", "--json")
    assert ran.status == 0, ran.err
    models = {m["split"]: m for m in ran.json["models"]}
    leaky, apart = models["windows:2"], models["by-subject:2"]
    assert leaky["leaky"] and leaky["leakage"]["same_recording"] > 0 and leaky["accuracy"]["ci95"]
    assert not apart["leaky"] and apart["leakage"]["same_person"] == 0 == apart["leakage"]["near_duplicates"]
    assert ran.json["leaky"] and ran.json["split"].count(",") == 1 and ran.json["scored"] == "windows"
    assert len(ran.json["people"]) == 5 and len(ran.json["pairs"]["accuracy"]) == 1
    assert "LEAKY" in (tmp_path / "cmp" / "comparison.html").read_text(encoding="utf-8")
    three = cli("compare", *folders)
    assert three.status == 0, three.err
    assert "windows:2 LEAKY" in three.out and "each person's score is over those of the split" in three.out


def test_with_other_windows_the_votes_of_recordings_are_compared(
    cli: Cli, evaluated: Callable[..., Path], tmp_path: Path
) -> None:
    (tmp_path / "short.toml").write_text("[windows]\nwindow_s = 1.5\n")
    whole, short = evaluated("A"), evaluated("E", "--config", tmp_path / "short.toml")
    ran = cli("compare", whole, short, "--json")
    assert ran.status == 0, ran.err
    votes = json.loads((whole / "evaluation.json").read_text())["subjects"]
    assert ran.json["scored"] == "recordings"
    assert [p["M1"]["accuracy"] for p in ran.json["people"]] == [s["by_recording_accuracy"] for s in votes]
    assert "recordings are compared" in cli("compare", whole, short).out


def test_what_cannot_be_compared_is_refused(cli: Cli, evaluated: Callable[..., Path], tmp_path: Path) -> None:
    first = evaluated("A")
    alone = cli("compare", first)
    assert alone.status == 2 and "at least two evaluations" in alone.err
    missing = cli("compare", first, tmp_path / "nowhere")
    assert missing.status == 2 and "no evaluation at" in missing.err
    change(first, context="stream")
    for name, context in (("loop", "loop"), ("inside", "inside")):
        shutil.copytree(first, tmp_path / name)
        change(tmp_path / name, context=context)
    for order in (("inside", "A", "loop"), ("A", "loop", "inside"), ("loop", "inside", "A")):
        mixed = cli("compare", *(tmp_path / name for name in order))
        assert mixed.status == 2 and "different context" in mixed.err
    assert cli("compare", tmp_path / "inside", first, "--json").json["context"] == "stream"
    shutil.copytree(first, tmp_path / "old")
    change(tmp_path / "old", dataset=None)
    old = cli("compare", first, tmp_path / "old")
    assert old.status == 2 and "evaluate again" in old.err
    gestures = cli("compare", first, evaluated("two", "--classes", "Slow,Fast"))
    assert gestures.status == 2 and "different gestures" in gestures.err
