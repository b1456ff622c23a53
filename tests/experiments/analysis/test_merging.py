"""Merges: the pair that most people confuse, within its affect; and the merged set in train, evaluate and export."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import GestureError
from plushsense.core.gestures import Gesture, GestureSet, load_gestures
from plushsense.dataset.store import Dataset
from plushsense.evaluation.scores import Predictions
from plushsense.experiments.analysis import merging
from plushsense.experiments.analysis.merging import merge_path
from plushsense.models.bundle import Bundle

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]
SET = GestureSet(
    "toy",
    (
        Gesture("Rest", "neutral", nobody=True, idle=True),
        Gesture("Hold", "neutral"),
        Gesture("Tap 1", "positive", "Tap"),
        Gesture("Tap 2", "positive", "Tap"),
        Gesture("Scratch", "positive"),
        Gesture("Hit", "negative", energetic=True),
    ),
)


def confused(*pairs: tuple[int, int, int]) -> np.ndarray:
    counts = np.diag([100] * 6)
    for truth, read, n in pairs:
        counts[truth, read] += n
        counts[truth, truth] -= n
    return counts


def test_the_pair_that_people_confuse_most_is_merged_first_and_only_within_an_affect() -> None:
    # Taps are confused by everybody; hits with taps and rest with hold, more often, but these may not be merged.
    people = np.stack([confused((2, 3, 30), (3, 2, 20), (4, 3, 10), (5, 3, 60), (0, 1, 70)) for _ in range(3)])
    path = merge_path(people, SET)
    assert [groups for groups, _, _ in path] == [
        ((0,), (1,), (2,), (3,), (4,), (5,)),
        ((0,), (1,), (2, 3), (4,), (5,)),
        ((0,), (1,), (2, 3, 4), (5,)),
    ]
    assert path[1][1] == pytest.approx(0.25) and path[1][2] == 3
    # One person's confusion counts once, however many windows there are.
    loud = np.stack([confused((2, 4, 90)) * 50, *(confused((2, 3, 40)) for _ in range(3))])
    assert merge_path(loud, SET)[1][0] == ((0,), (1,), (2, 3), (4,), (5,))


def test_a_merged_set_knows_the_labels_of_its_members() -> None:
    taps = SET.merged(((0,), (1,), (2, 3), (4,), (5,)))
    assert taps.labels == ("Rest", "Hold", "Tap", "Scratch", "Hit")
    assert taps.get("tap_2").label == "Tap" and taps.get("Tap 1").affect == "positive"
    assert taps.gestures[0] == SET.gestures[0]
    both = SET.merged(((0,), (1,), (2, 4), (3,), (5,)))
    assert both.get("Scratch").label == "Tap 1 + Scratch"
    again = GestureSet.from_dict(taps.to_dict())
    assert again == taps and "labels" not in taps.to_dict()["gestures"][0]
    with pytest.raises(GestureError, match="'Tap' twice"):
        GestureSet("x", (Gesture("Tap"), Gesture("Other", labels=("tap",))))


def test_the_largest_class_is_that_of_the_people_who_are_scored() -> None:
    truth = np.array([0] * 6 + [2, 2, 2, 3], dtype=np.int64)
    subject = np.array(["none"] * 6 + ["P1", "P1", "P2", "P2"])
    plain = dict.fromkeys(("recording", "context", "fold"), subject)
    read = np.eye(6, dtype=np.float32)[[0] * 6 + [3, 2, 2, 2]]
    predictions = Predictions(SET.labels, subject, window=truth, truth=truth, probabilities=read, **plain)
    people = np.array(["P1", "P2"])
    alone = merging._grouping(predictions, people, tuple((k,) for k in range(6)))
    assert (alone.classes, alone.largest, alone.merged) == (6, 0.75, ())
    assert alone.scores["accuracy"]["mean"] == 0.5
    taps = merging._grouping(predictions, people, SET.groups_of(SET.merged_by("family")))
    assert (taps.classes, taps.largest, taps.merged) == (5, 1.0, (("Tap 1", "Tap 2"),))
    assert taps.scores["accuracy"]["mean"] == 1.0
    assert list(merging._named(SET, None)) == ["family", "affect"], "plush-13 merges nothing of these"


@pytest.mark.exhaustive
def test_a_merged_set_is_trained_scored_and_exported(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = (dataset.path, "--filters", "4,4,4", "--workers", "1", "--epochs", "3")
    small = (*words, "--split", "by-subject:2")
    assert cli("evaluate", *small, "--out", tmp_path / "E").status == 0
    ran = cli("merge", dataset.path, tmp_path / "E", "--json")
    assert ran.status == 0, ran.err
    steps = ran.json["steps"]
    assert [step["classes"] for step in steps] == [3, 2] and len(steps[1]["merged"][0]) == 2
    assert steps[0]["scores"]["accuracy"] == steps[0]["crossfitted"]["accuracy"]
    assert steps[1]["scores"]["accuracy"]["mean"] >= steps[0]["scores"]["accuracy"]["mean"]

    file = tmp_path / "merged.toml"
    assert "cross-fitted" in cli("merge", dataset.path, tmp_path / "E", "--merges", "1", "--out", file).out
    merged = load_gestures(file)
    again = cli("evaluate", *small, "--classes", file, "--out", tmp_path / "M", "--json")
    assert again.status == 0, again.err
    assert tuple(again.json["confusion"]["labels"]) == merged.labels and len(merged) == 2
    bundle = tmp_path / "m.plush"
    train = (*words[:3], "--epochs", "3")
    assert cli("train", *train, "--classes", file, "--out", bundle).status == 0
    assert Bundle.load(bundle).gestures == merged
    streams = cli("stream-eval", dataset.path, "--model", bundle, "--subjects", "P1", "--json")
    assert streams.status == 0, streams.err
    assert cli("export", bundle, tmp_path / "C").status == 0

    # A merge named beforehand is scored beside those of the data; sweeps take it as classes, too.
    text = file.read_text(encoding="utf-8")
    named = cli("merge", dataset.path, tmp_path / "E", "--groups", file, "--out", tmp_path / "n.toml", "--json").json
    (scored,) = named["groupings"]
    step = next(step for step in steps if step["merges"] == 1)
    assert (scored["name"], scored["classes"], scored["scores"]) == (str(file), 2, step["scores"])
    assert (tmp_path / "n.toml").read_text(encoding="utf-8") == text
    network = ("architectures=9", "filters=2", "batches=4", f"classes={file}")
    options = [word for change in network for word in ("--set", change)]
    swept = cli("sweep", dataset.path, *options, "--epochs", "1", "--workers", "1", "--json")
    assert swept.status == 0 and tuple(swept.json["labels"]) == merged.labels, swept.err
    nothing = cli("merge", dataset.path, tmp_path / "E", "--groups", "plush-13", "--out", tmp_path / "no.toml")
    assert nothing.status == 2 and "'plush-13' merges none of the 3 gestures of the evaluation" in nothing.err
    assert "have no affect" in cli("train", dataset.path, "--classes", "affect", "--out", tmp_path / "x.plush").err

    wrong = cli("merge", dataset.path, tmp_path / "E", "--merges", "7", "--out", tmp_path / "no.toml")
    assert wrong.status == 2 and "merges is 7: accepted are 1 to 1" in wrong.err
    nowhere = cli("merge", dataset.path, tmp_path / "nowhere")
    assert nowhere.status == 2 and "no evaluation at" in nowhere.err
