"""Evaluation: the figures by hand, the resuming, and what a leak looks like."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, TrainingError
from plushsense.evaluation.crossval import CrossvalSpec, evaluate
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.progress import JobProgress
from plushsense.scoring.splits import parse_split

HERE = Path(__file__).parents[1]

from support.fakes import AFFECTS, LABELS, Memory, Oracle, misshapen, refuses, study

KEYS = {
    "split", "context", "train_context", "leaky", "seeds", "accuracy", "macro_f1", "macro_recall",
    "macro_f1_all_classes", "with_rest", "over", "by_recording", "pooled", "per_class", "confusion", "confusion_affect",
    "by_context", "nobody", "folds", "subjects", "histories", "predictions", "leakage", "confidence",
}  # fmt: skip


def trainings(folder: Path) -> dict[str, int]:
    return {path.name.removeprefix("trained-"): len(path.read_text()) for path in folder.glob("trained-*")}


def test_every_figure_of_a_subject_wise_evaluation(tmp_path: Path) -> None:
    windows, loops = study(), study(context="loop")
    found = evaluate(
        loops, windows, parse_split("leave-one-subject-out"), Oracle(str(tmp_path), ("P01",)), CrossvalSpec(3)
    )
    table = found.to_json()
    assert table.keys() == KEYS
    json.dumps(table, allow_nan=False)
    assert (table["split"], table["context"], table["train_context"]) == ("leave-one-subject-out", "stream", "loop")
    assert table["leaky"] is False and table["seeds"] == [3] and table["over"] == "subjects"
    # Five people are read right; P01's strokes are read as hits, their hits as rest.
    assert table["accuracy"]["mean"] == pytest.approx(5 / 6)
    assert table["accuracy"]["sd"] == pytest.approx(np.std([1, 1, 1, 1, 1, 0], ddof=1))
    assert table["macro_f1"]["mean"] == pytest.approx(5 / 6)
    # Over all classes nobody's rest counts in its fold: P01's has F1 0.5 there (two windows, six read as rest).
    assert table["macro_f1_all_classes"]["mean"] == pytest.approx((5 + (0.5 + 0 + 0) / 3) / 6)
    # As the paper: over the folds, with the two windows of rest in each, and over all classes.
    assert table["with_rest"]["accuracy"]["mean"] == pytest.approx((5 + 2 / 10) / 6)
    assert table["with_rest"]["macro_recall"]["mean"] == pytest.approx((5 + (1 + 0 + 0) / 3) / 6)
    assert table["with_rest"]["macro_f1"] == table["macro_f1_all_classes"]
    assert table["pooled"]["accuracy"] == pytest.approx((20 * 2 + 12) / (24 * 2 + 12))
    assert table["confusion"] == {"labels": list(LABELS), "counts": [[12, 0, 0], [0, 20, 4], [4, 0, 20]]}
    assert table["confusion_affect"]["labels"] == list(AFFECTS)
    assert table["by_context"] == {"stream": {"windows": 48, "recordings": 24, "accuracy": pytest.approx(5 / 6)}}
    assert table["nobody"] == {"windows": 12, "recordings": 6, "accuracy": 1.0}
    assert table["by_recording"]["accuracy"] == pytest.approx(5 / 6)
    assert [f["fold"] for f in table["folds"]] == [f"P{p:02d}" for p in range(6)]
    second = table["folds"][1]
    assert (second["subject"], second["subjects"], second["accuracy"]) == ("P01", ["P01"], 0.0)
    assert (second["test_windows"], second["epochs"], second["seconds"]) == (10, 3, 0.25)
    assert [s["accuracy"] for s in table["subjects"]] == [1, 0, 1, 1, 1, 1]
    assert table["subjects"][0]["windows"] == 8 and table["subjects"][0]["recordings"] == 4
    assert table["per_class"][1] == {
        "label": "Back stroke", "affect": "positive", "precision": 1.0, "recall": pytest.approx(20 / 24),
        "f1": pytest.approx(40 / 44), "support": 24,
    }  # fmt: skip
    assert len(table["histories"]) == 6 and len(table["histories"][0]) == 3
    assert "accuracy 0.833" in repr(found)


def test_a_leak_shows_and_is_marked() -> None:
    windows = study(repetitions=4, windows=4)
    by_window = evaluate(windows, windows, parse_split("windows:4"), Memory()).to_json()
    assert by_window["leaky"] is True and by_window["accuracy"]["mean"] > 0.9
    assert by_window["over"] == "folds" and len(by_window["folds"]) == 4
    for text in ("by-recording:4", "by-subject:3"):
        assert evaluate(windows, windows, parse_split(text), Memory()).to_json()["accuracy"]["mean"] == 0.0


def test_a_holdout_scores_what_it_tested_only() -> None:
    windows = study(repetitions=5, windows=4)
    found = evaluate(windows, windows, parse_split("windows:holdout"), Memory())
    table = found.to_json()
    assert len(found.predictions) == table["folds"][0]["test_windows"] == round(0.15 * len(windows))
    assert table["accuracy"]["sd"] is None and table["accuracy"]["ci95"] is None
    json.dumps(table, allow_nan=False)


@pytest.mark.parametrize("workers", [1, 2])
def test_progress_and_the_same_result_from_several_processes(tmp_path: Path, workers: int) -> None:
    said: list[JobProgress] = []
    windows = study()
    split, spec = parse_split("by-subject:3"), CrossvalSpec(jobs=JobsSpec(workers))
    found = evaluate(windows, windows, split, Oracle(str(tmp_path)), spec, progress=said.append)
    assert [s.done for s in said if s.epoch == 0] == [1, 2, 3]
    assert sorted((s.name, s.epoch) for s in said if s.epoch) == [
        (f"fold {f}", e) for f in (1, 2, 3) for e in (1, 2, 3)
    ]
    assert all(s.total == 3 and s.epochs in (0, 3) for s in said)
    assert found.to_json()["accuracy"]["mean"] == 1.0
    assert sum(trainings(tmp_path).values()) == 3


def test_finished_folds_are_not_trained_again_and_changed_ones_are(tmp_path: Path) -> None:
    windows, journal, oracle = study(), Journal(tmp_path / "journal"), Oracle(str(tmp_path))
    ask = CrossvalSpec(jobs=JobsSpec(journal=journal), key={"arch": "a", "seed": 1})
    first = evaluate(windows, windows, parse_split("by-subject:3"), oracle, ask)
    said: list[JobProgress] = []
    again = evaluate(windows, windows, parse_split("by-subject:3"), oracle, ask, progress=said.append)
    assert sum(trainings(tmp_path).values()) == 3 and said[-1].resumed == 3
    assert again.to_json() == first.to_json()
    next(journal.folder.iterdir()).write_bytes(b"damaged")
    evaluate(windows, windows, parse_split("by-subject:3"), oracle, ask)
    assert sum(trainings(tmp_path).values()) == 4
    changed = replace(windows, integers=windows.integers + 1)
    for other, spec in (
        (windows, replace(ask, key={"arch": "b"})), (changed, ask), (windows, replace(ask, seed=5))
    ):  # fmt: skip
        before = sum(trainings(tmp_path).values())
        evaluate(other, other, parse_split("by-subject:3"), oracle, spec)
        assert sum(trainings(tmp_path).values()) > before


def test_the_figures_come_from_the_kept_predictions(tmp_path: Path) -> None:
    polars = pytest.importorskip("polars", reason="polars is not installed (extra train)")
    windows = study()
    found = evaluate(windows, windows, parse_split("by-subject:3"), Oracle(str(tmp_path), ("P02",)))
    path = found.write_predictions(tmp_path / "deep" / "predictions.parquet")
    assert found.to_json()["predictions"] == str(path)
    table = polars.read_parquet(path)
    assert table.columns == [
        "subject", "recording", "window", "context", "fold", "truth", "predicted", *(f"p_{k}" for k in LABELS),
    ]  # fmt: skip
    assert len(table) == len(windows) and table.select("recording", "window").is_duplicated().sum() == 0
    assert set(table["window"]) == {0, 1}
    wrong = table.filter(polars.col("truth") != polars.col("predicted"))
    assert set(wrong["subject"]) == {"P02"} and len(wrong) == 8
    assert list(path.parent.iterdir()) == [path]


def test_what_goes_wrong_is_said() -> None:
    windows = study()
    with pytest.raises(TrainingError, match="no longer a number"):
        evaluate(windows, windows, parse_split("by-subject:3"), refuses)
    with pytest.raises(ConfigError, match=r"shape \(1, 3\).*\(20, 3\)"):
        evaluate(windows, windows, parse_split("by-subject:3"), misshapen)
    with pytest.raises(ConfigError, match="journal needs a key"):
        evaluate(
            windows,
            windows,
            parse_split("by-subject:3"),
            refuses,
            CrossvalSpec(jobs=JobsSpec(journal=Journal("nowhere"))),
        )


SCRIPT = """
import sys
sys.path.insert(0, {here!r})
from support.fakes import Oracle, study
from plushsense.evaluation.crossval import CrossvalSpec, evaluate
from plushsense.scoring.splits import parse_split
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import JobsSpec

if __name__ == "__main__":
    windows = study()
    spec = CrossvalSpec(jobs=JobsSpec({workers}, journal=Journal({folder!r} + "/journal")), key={{"arch": "a"}})
    evaluate(windows, windows, parse_split("leave-one-subject-out"), Oracle({folder!r}, pause=0.05), spec)
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_an_evaluation_that_is_killed_goes_on(tmp_path: Path, workers: int) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(here=str(HERE), folder=str(tmp_path), workers=workers))
    journal = tmp_path / "journal"
    run = subprocess.Popen([sys.executable, str(script)])
    until = time.monotonic() + 30
    while not list(journal.glob("*.npz")):
        assert time.monotonic() < until and run.poll() is None
        time.sleep(0.01)
    run.kill()
    run.wait()
    time.sleep(0.3)
    finished = len(list(journal.glob("*.npz")))
    before = trainings(tmp_path)
    assert 1 <= finished < 6
    assert subprocess.run([sys.executable, str(script)], timeout=60).returncode == 0
    after = trainings(tmp_path)
    again = [person for person, times in before.items() if after[person] > times]
    assert len(after) == 6 and len(again) == len(before) - finished
