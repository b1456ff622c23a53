"""The lens and comparisons as a user types them, and the traits of people whose difference is known."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.experiments.people.traits import measure_people, trait_correlations, unusual_traits

Cli = Callable[..., Any]
SMALL = ("--filters", "4,4,4", "--epochs", "2", "--workers", "1")
TURNED, QUICK = "P05", "P02"


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Seven people with two gestures; one holds the toy on its side, one is twice as quick and strong."""
    layout, folder = load_layout("accel-3"), tmp_path_factory.mktemp("known")
    rng = np.random.default_rng(0)
    for p in range(1, 8):
        name = f"P0{p}"
        (folder / name).mkdir()
        for g, gesture in enumerate(("Wave", "Shake")):
            for take in range(2):
                rows, force = (200, 1000.0) if name != QUICK else (100, 2000.0)
                wave = force * np.sin(2 * np.pi * (1 + g) * np.arange(rows) / 100)
                gravity = (0, 0, 8000) if name != TURNED else (8000, 0, 0)
                values = np.stack([wave, wave, wave], axis=1) + gravity + rng.normal(0, 50, (rows, 3))
                clock = np.arange(rows, dtype=np.int64) * 10 + 1000 * (take + 2 * g)
                frames = Frames(np.round(values).astype(np.int64), clock, clock + 1_700_000_000_000)
                write_recording(
                    folder / name / f"{gesture}_{1_700_000_000_000 + take + 2 * g}_{rows}.csv", frames, layout
                )
    return import_recordings(folder, folder.parent / "KNOWN", layout="accel-3").dataset


def test_traits_find_who_is_different(known: Dataset) -> None:
    measured = measure_people(known, ("Wave", "Shake"))
    assert set(measured) == set(known.subjects)
    assert measured[QUICK]["tempo"] == pytest.approx(0.5, rel=0.05)
    assert measured[QUICK]["strength"] == pytest.approx(2.0, rel=0.1)
    assert measured[TURNED]["orientation_deg"] == pytest.approx(90, abs=15)
    assert measured["P01"]["rate_hz"] == pytest.approx(100, rel=0.02)
    notes = unusual_traits(measured)
    assert any("times as long" in note for note in notes[QUICK]) and any("°" in note for note in notes[TURNED])
    # Whoever holds the toy further from the others is read worse.
    scores = {person: 1 - (row["orientation_deg"] or 0) / 180 for person, row in measured.items()}
    rows = {row["trait"]: row for row in trait_correlations(measured, scores)}
    assert rows["orientation_deg"]["rho"] == pytest.approx(-1) and rows["orientation_deg"]["people"] == 7


def test_the_lens_shows_the_splits_side_by_side(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = ("lens", dataset.path, *SMALL, "--splits", "windows:2,by-subject:2", "--out", tmp_path / "L")
    ran = cli(*words, "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    leaky, apart = found["splits"]
    assert leaky["leaky"] and leaky["leakage"]["same_recording"] > 0
    assert not apart["leaky"] and apart["leakage"]["same_person"] == 0 == apart["leakage"]["near_duplicates"]
    assert leaky["people"] == apart["people"] == 5 and leaky["accuracy"]["ci95"]
    assert found["by_person"] == "by-subject:2" and found["calibration"]["after"]["bins"]
    accuracies = [person["accuracy"] for person in found["people"]]
    assert accuracies == sorted(accuracies) and len(accuracies) == 5
    assert {row["gesture"] for row in found["people"][0]["gestures"]} == {"Rest", "Slow", "Fast"}
    page = Path(found["report"]).read_text(encoding="utf-8")
    assert "LEAKY" in page and page.count("data:image/png") + page.count("data:image/svg") == 2
    assert json.loads((tmp_path / "L" / "lens.json").read_text())["id"] == found["id"]
    text = cli(*words)
    assert text.status == 0 and "windows:2 LEAKY" in text.out and "Spearman" in text.out
    other = cli(*words, "--seed", "1")
    assert other.status == 2 and "of other settings" in other.err
    wrong = cli("lens", dataset.path, "--splits", "")
    assert wrong.status == 2 and "at least one split" in wrong.err


def test_evaluations_are_compared_person_by_person(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = ("evaluate", dataset.path, "--filters", "4,4,4", "--split", "by-subject:2", "--workers", "1")
    for name, epochs in (("A", 1), ("B", 8), ("C", 2)):
        assert cli(*words, "--epochs", epochs, "--out", tmp_path / name).status == 0
    ran = cli("compare", *(tmp_path / n for n in "ABC"), "--out", tmp_path / "cmp", "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert {m["name"] for m in found["models"]} == {"M1", "M2", "M3"} and len(found["pairs"]["accuracy"]) == 3
    assert all(0 < row["p"] <= row["p_holm"] <= 1 for row in found["pairs"]["macro_f1"])
    assert len(found["people"]) == 5 and sum(m["rank"]["accuracy"] for m in found["models"]) == pytest.approx(6)
    assert "Critical-difference" in (tmp_path / "cmp" / "comparison.html").read_text(encoding="utf-8")
    assert found["scored"] == "windows"
    text = cli("compare", tmp_path / "A", tmp_path / "B").out
    assert "Holm" in text and "95 % interval" in text and f"M1: {tmp_path / 'A'}" in text
    titles = {m["title"].rpartition("seed 0")[2] for m in found["models"]}
    assert titles == {", epochs 1", ", epochs 8", ", epochs 2"}
    (tmp_path / "short.toml").write_text("[windows]\nwindow_s = 1.5\n")
    assert cli(*words, "--epochs", 1, "--config", tmp_path / "short.toml", "--out", tmp_path / "E").status == 0
    ran = cli("compare", tmp_path / "A", tmp_path / "E", "--json")
    assert ran.status == 0, ran.err
    shorter = ran.json
    votes = json.loads((tmp_path / "A" / "evaluation.json").read_text())["subjects"]
    assert shorter["scored"] == "recordings"
    assert [p["M1"]["accuracy"] for p in shorter["people"]] == [s["by_recording_accuracy"] for s in votes]
    for name, context in (("A", "stream"), ("C", "loop")):
        table = json.loads((tmp_path / name / "evaluation.json").read_text())
        (tmp_path / name / "evaluation.json").write_text(json.dumps({**table, "context": context}))
    table = json.loads((tmp_path / "E" / "evaluation.json").read_text())
    assert table["context"] == "inside"
    for order in ("EAC", "ACE", "CEA"):
        mixed = cli("compare", *(tmp_path / n for n in order))
        assert mixed.status == 2 and "different context" in mixed.err
    assert cli("compare", tmp_path / "E", tmp_path / "A", "--json").json["context"] == "stream"
    assert "recordings are compared" in cli("compare", tmp_path / "A", tmp_path / "E").out

    alone = cli("compare", tmp_path / "A")
    assert alone.status == 2 and "at least two evaluations" in alone.err
    missing = cli("compare", tmp_path / "A", tmp_path / "nowhere")
    assert missing.status == 2 and "no evaluation at" in missing.err
    assert (
        cli(*words[:-4], "--split", "by-subject:3", "--workers", "1", "--epochs", "1", "--out", tmp_path / "D").status
        == 0
    )
    other = cli("compare", tmp_path / "A", tmp_path / "D")
    assert other.status == 2 and "different split" in other.err
    shutil.copytree(tmp_path / "B", tmp_path / "old")
    table = json.loads((tmp_path / "old" / "evaluation.json").read_text())
    del table["dataset"]
    (tmp_path / "old" / "evaluation.json").write_text(json.dumps(table))
    old = cli("compare", tmp_path / "A", tmp_path / "old")
    assert old.status == 2 and "evaluate again" in old.err
