"""Another gesture than the recorded one, stated by a mark: the raw file stays, and everything else follows the mark."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.cli.main import main
from plushsense.core.errors import DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.dataset.files import change_head
from plushsense.dataset.index import open_dataset, rebuild_index
from plushsense.dataset.labelling import relabel_recordings
from plushsense.dataset.publishing.package import complete_head, publish
from plushsense.dataset.quality.checking import check
from plushsense.dataset.store import Dataset
from plushsense.windows.cut import cut_windows
from support.reviewed import made, marks, raw_hash

STATEMENTS = ("CC0-1.0", "A <a@example.org>", "all agreed")


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Two people with waves and a rest, which is of nobody."""
    place = made(tmp_path / "DS", people=2, waves=3).path
    gestures = GestureSet("two", (Gesture("Rest", "neutral", nobody=True), Gesture("Wave", "positive")))
    change_head(place, lambda head: replace(head, gestures=gestures))
    return open_dataset(place)


def test_the_mark_is_what_counts(dataset: Dataset) -> None:
    raw, before = raw_hash(dataset.path), dataset.hash
    wave = next(r for r in dataset.recordings if r.gesture == "Wave")
    rest = next(r for r in dataset.recordings if r.gesture == "Rest")
    assert rest.subject == "none"
    assert relabel_recordings(dataset, [wave.id, rest.id], "rest", "K", "seen on video") == (wave.id,)
    # Of the index that only the marks changed, and of one that is built again.
    for now in (open_dataset(dataset.path), rebuild_index(dataset.path).dataset):
        found = next(r for r in now.recordings if r.id == wave.id)
        assert (found.gesture, found.recorded, found.subject) == ("Rest", "Wave", "none")
        assert now.hash != before and now.gestures.find("Rest") is not None
    windows = cut_windows(open_dataset(dataset.path))
    assert sum(windows.labels[windows.y[windows.recording == i][0]] == "Rest" for i in set(windows.recording)) == 3
    assert {f.gesture for f in check(open_dataset(dataset.path)).findings if f.recording == wave.id} <= {"Rest"}
    assert relabel_recordings(open_dataset(dataset.path), [rest.id], "Wave", "K") == (rest.id,)
    again = next(r for r in open_dataset(dataset.path).recordings if r.id == rest.id)
    assert (again.gesture, again.subject) == ("Wave", rest.id.split("/")[0])
    assert relabel_recordings(dataset, [wave.id, rest.id], "", "K") == (wave.id, rest.id)
    assert open_dataset(dataset.path).hash == before and raw_hash(dataset.path) == raw
    assert [(m["action"], m.get("gesture", "")) for m in marks(dataset.path)] == [
        ("relabel", "Rest"),
        ("relabel", "Wave"),
        ("relabel", ""),
        ("relabel", ""),
    ]


def test_what_cannot_be_is_refused_and_nothing_written(dataset: Dataset) -> None:
    wave = next(r for r in dataset.recordings if r.gesture == "Wave")
    with pytest.raises(DatasetError, match="has no gesture 'Wive'.*Did you mean 'Wave'") as refused:
        relabel_recordings(dataset, [wave.id], "Wive", "K")
    assert "has no gesture" in str(refused.value) and marks(dataset.path) == []
    with pytest.raises(DatasetError, match="no recording"):
        relabel_recordings(dataset, [wave.id, "P9/none"], "Rest", "K")
    assert marks(dataset.path) == []


def test_an_index_of_an_older_version_is_built_again(dataset: Dataset) -> None:
    place = dataset.path / "recordings.csv"
    with place.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    with place.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [key for key in rows[0] if key != "recorded"], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    stamp = json.loads((dataset.path / "index.json").read_text(encoding="utf-8"))
    (dataset.path / "index.json").write_text(json.dumps(stamp | {"format": 2}), encoding="utf-8")
    assert [r.recorded for r in open_dataset(dataset.path).recordings] == [r.gesture for r in dataset.recordings]


def test_packages_have_the_new_gesture(
    dataset: Dataset, tmp_path: Path, publish_tools: None, capsys: pytest.CaptureFixture[str]
) -> None:
    wave = next(r for r in dataset.recordings if r.gesture == "Wave")
    assert main(["check", str(dataset.path), "--relabel", wave.id, "Rest", "--who", "K", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["relabelled"] == [wave.id]
    dataset = open_dataset(dataset.path)
    done = publish(dataset, tmp_path / "out", complete_head(dataset.head, dataset.path, *STATEMENTS))
    assert done.checked.problems == [] and any("Relabelled: 1 recording;" in note for note in done.description.notes)
    with (tmp_path / "out" / "recordings.csv").open(encoding="utf-8", newline="") as file:
        assert sum(row["gesture"] == "Rest" for row in csv.DictReader(file)) == 3
    assert main(["check", str(dataset.path), "--relabel", wave.id, "", "--who", "K"]) == 0
    assert next(r for r in open_dataset(dataset.path).recordings if r.id == wave.id).gesture == "Wave"
