"""Predictions of any system: rows become events, a bundle's events score as the bundle, bad rows are refused."""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError, DatasetError, FileFormatError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.benchmark import score_predictions, stream_eval
from plushsense.experiments.streams.predictions import StreamPredictions, read_predictions
from plushsense.experiments.streams.replay import read_streams, scored_streams, truth_of
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.windows.features import Scaler

pytestmark = pytest.mark.apart("models")

DOCS = Path(__file__).parents[3] / "docs"
REST, SLOW, FAST = GESTURES = (
    Gesture("Rest", "neutral", idle=True),
    Gesture("Slow", "positive", "Wave"),
    Gesture("Fast", "negative", "Wave"),
)
SET = GestureSet("waves", GESTURES)
P1 = "P1/fulldatastream"


@pytest.fixture(scope="module")
def dataset(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Four people; the sensors of P1 hang for 2 s before the first gesture."""
    folder = tmp_path_factory.mktemp("predictions")
    for person in ("P1", "P2", "P3", "P4"):
        shutil.copytree(recordings / person, folder / "raw" / person)
    stream = folder / "raw" / "P1" / "fulldatastream.csv"
    lines = stream.read_text().splitlines()
    lines[50:250] = [", ".join([*line.split(", ")[:2], "5", "5", "5"]) for line in lines[50:250]]
    stream.write_text("\n".join(lines) + "\n")
    return import_recordings(folder / "raw", folder / "DS", layout="accel-3", gestures=SET).dataset


def written(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def read(path: Path, dataset: Dataset) -> StreamPredictions:
    return read_predictions(path, SET, SET, scored_streams(dataset, dataset.subjects))


def events_in(
    predictions: StreamPredictions, stream: str = P1, threshold: float = 0.0
) -> list[tuple[str, float, float]]:
    events = predictions.events(stream, threshold)
    return [(SET.labels[e.gesture], e.start_s, e.stop_s) for e in events]


DECISIONS = (
    "t,label,score,stream",
    f"0.5,,,{P1}",
    f"1.0,Slow,0.4,{P1}",
    f"1.5,slow,0.8,{P1}",
    f"1.0,Fast,0.9,{P1.replace('P1', 'P2')}",
    f"2.0,Slow,0.7,{P1}",
    f"2.5,Fast,0.6,{P1}",
    f"3.0,Rest,0.9,{P1}",
    f"3.5,Fast,0.5,{P1}",
)


def test_successive_decisions_with_one_label_are_an_event(dataset: Dataset, tmp_path: Path) -> None:
    found = read(written(tmp_path / "p.csv", *DECISIONS), dataset)
    assert events_in(found) == [("Slow", 1.0, 2.0), ("Fast", 2.5, 2.5), ("Fast", 3.5, 3.5)]
    assert events_in(found, threshold=0.6) == [("Slow", 1.5, 2.0), ("Fast", 2.5, 2.5)]
    assert events_in(found, P1.replace("P1", "P2")) == [("Fast", 1.0, 1.0)]
    assert not found.are_events and found.scored
    assert found.thresholds() == [0.4, 0.5, 0.6, 0.7, 0.8, 0.9]


def test_rows_with_an_end_are_events(dataset: Dataset, tmp_path: Path) -> None:
    rows = ("t;stop;label;score;subject", "3;4;Fast;0.3;P1", "1;2;Slow;0.9;P1", "0;5;;;P2", "0;1;Rest;1;P1")
    found = read(written(tmp_path / "p.csv", *rows), dataset)
    assert events_in(found) == [("Fast", 3.0, 4.0), ("Slow", 1.0, 2.0)]
    assert events_in(found, threshold=0.5) == [("Slow", 1.0, 2.0)]
    assert set(found.rows) == {P1, P1.replace("P1", "P2")} and found.are_events
    unscored = read(written(tmp_path / "q.csv", "t,stop,label,subject", "1,2,Slow,P1"), dataset)
    assert unscored.thresholds() == [] and events_in(unscored, threshold=1.0) == [("Slow", 1.0, 2.0)]


def made_bundle() -> Bundle:
    """A network that knows nothing, and reports affects before gestures, with a gate."""
    arch = Arch.parse("5d1_4d3", (6, 5), channels=3, classes=3, padding="stream", window=48, step=5)
    gate = GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=40),), (Rule((Term(0, 40),), 3, 255, deaf=200),))
    spec = DecideSpec(smoothing_s=0.05, enter=0.99, leave=0.4, enter_affect=0.5, wait_s=0.2, gate=gate)
    spec = replace(spec, health=replace(spec.health, still_ms=500))
    return Bundle(
        arch,
        {k: 3 * v for k, v in random_weights(arch, 3).items()},
        load_layout("accel-3"),
        Scaler(np.array([0.0, 0.0, 8000.0]), np.full(3, 0.001)),
        SET,
        {},
        spec.to_dict(),
        {"subjects": [], "validation_subjects": []},
    )


def test_the_events_of_a_bundle_have_the_scores_of_the_bundle(dataset: Dataset, tmp_path: Path) -> None:
    bundle, file = made_bundle(), tmp_path / "events.csv"
    own = stream_eval(dataset.path, bundle, events=file).to_json()
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    # There is everything that a bundle reports: events with affect and gesture at once, one after the other, and alone.
    assert {(bool(r["label"]), r["named"] != r["t"]) for r in rows if r["affect"]} >= {
        (True, False),
        (True, True),
        (False, False),
    }
    assert own["gate_events"] > 0 and own["hits"] > 0 and own["insertions"] > 0
    found = score_predictions(dataset.path, file, classes="all").to_json()
    assert_same(own, found)
    assert list(found["people"]) == ["P1", "P2", "P3", "P4"]
    for person, row in own["people"].items():
        assert_same(row, found["people"][person])
    # Time in which the bundle detects a fault of the sensors is time in which another system may report events.
    (trace,) = read_streams(dataset, bundle, ["P1"])
    assert trace.replayer.trace.faults == 1
    assert trace.truth.hours > sum(p.ends_us - p.start_us for p in trace.replayer.trace.parts) / 3.6e9 + 1 / 3600


MODEL_ONLY = {"trained_on", "gate_events", "gate_rules", "settings", "note", "people"}


def assert_same(own: dict[str, Any], found: dict[str, Any]) -> None:
    assert {k: v for k, v in own.items() if k not in MODEL_ONLY} == {k: found[k] for k in own if k not in MODEL_ONLY}


def test_a_stream_without_events_stays_in_the_file(dataset: Dataset, tmp_path: Path) -> None:
    silent = replace(made_bundle(), decision=DecideSpec(enter_affect=2.0, least_s=60.0).to_dict())
    file = tmp_path / "events.csv"
    own = stream_eval(dataset.path, silent, events=file).to_json()
    found = score_predictions(dataset.path, file, classes="all").to_json()
    assert own["events"] == 0 and own["truths"] == found["deletions"] == 16
    assert_same(own, found)


def test_true_gestures_as_predictions_are_all_hits(dataset: Dataset, tmp_path: Path) -> None:
    rows = ["stream,t,stop,label,score"]
    for stream in scored_streams(dataset, dataset.subjects):
        truth = truth_of(dataset, stream, dataset.read_stream(stream.id), SET)
        rows += [
            f"{stream.id},{t.start_s},{t.stop_s},{t.label},{0.2 if t.label == 'Slow' else 0.7}" for t in truth.truths
        ]
    file = written(tmp_path / "p.csv", *rows)
    found = score_predictions(dataset.path, file, classes="all").to_json()
    assert (found["f1"], found["insertions"], found["latency_s"]["median"]) == (1.0, 0, 0.0)
    assert found["form"] == "events" and found["streams"] == [s.id for s in dataset.streams]
    assert "on whom their system was trained" in found["note"]
    assert found["curve"] == [
        {"threshold": 0.2, "recall": 1.0, "f1": 1.0, "false_events_per_hour": 0.0},
        {"threshold": 0.7, "recall": 0.5, "f1": pytest.approx(2 / 3), "false_events_per_hour": 0.0},
    ]
    above = score_predictions(dataset.path, file, classes="all", threshold=0.5).to_json()
    assert above["recall"] == 0.5 and above["curve"] == found["curve"]
    # Without the gesture of lower scores among the classes, its recordings are no longer true gestures.
    slow = [row for row in rows if not row.count(",Slow,")]
    fewer = score_predictions(dataset.path, written(tmp_path / "q.csv", *slow), classes=["Rest", "Fast"]).to_json()
    assert fewer["truths"] == 8 and fewer["f1"] == 1.0 and fewer["classes"] == ["Rest", "Fast"]


def test_only_streams_in_the_file_or_of_people_asked_for_are_scored(dataset: Dataset, tmp_path: Path) -> None:
    said: list[str] = []
    file = written(tmp_path / "p.csv", "t,label,subject", "1.0,,P1", "2.0,Slow,P2")
    found = score_predictions(dataset.path, file, warn=said.append).to_json()
    assert list(found["people"]) == ["P1", "P2"] and found["people"]["P1"]["deletions"] == 4
    assert found["curve"] == [] and found["form"] == "decisions"
    assert any("not scored" in s and "P3/fulldatastream, P4/fulldatastream" in s for s in said)
    asked = score_predictions(dataset.path, file, subjects=["P2", "P3"]).to_json()
    assert list(asked["people"]) == ["P2", "P3"] and asked["people"]["P3"]["deletions"] == 4
    # A column for the stream is not needed if there is only one.
    alone = score_predictions(
        dataset.path, written(tmp_path / "q.csv", "t,label", "2.0,Slow"), subjects=["P2"]
    ).to_json()
    assert alone["events"] == 1 and alone["streams"] == ["P2/fulldatastream"]


def test_a_folder_of_the_recorder_can_be_scored(dataset: Dataset, recordings: Path, tmp_path: Path) -> None:
    shutil.copytree(recordings / "P2", tmp_path / "visit" / "P2")
    file = written(tmp_path / "p.csv", "t,stop,label", "4.0,5.0,Fast")
    found = score_predictions(tmp_path / "visit", file).to_json()
    # Gestures are inferred from the labels, so that rest is a gesture, too.
    assert found["events"] == 1 and found["truths"] == 6


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ((), "has no column 't' (it is empty): give a header with t and label"),
        (("t,label,stream",), "no rows below its header"),
        (("time,label", "1,Slow"), "has no column 't' (it has time, label)"),
        (("t,gesture", "1,Slow"), "has no column 'label'"),
        (
            ("t,label,stopp", "1,Slow,2"),
            "unknown column 'stopp': accepted are t, label, score, stream, subject, and",
        ),
        (("t,label,stopp", "1,Slow,2"), "Did you mean 'stop'?"),
        (("t,stop,label,scores", "1,2,Slow,1"), "Did you mean 'score'?"),
        (("t,label", "1,Slow"), "no column 'stream', but several streams are scored"),
        (
            ("t,label,stream", f"1,Slow,{P1}", "1,Slow,P1/fulldatastrem"),
            "line 3: there is no stream 'P1/fulldatastrem'",
        ),
        (("t,label,stream", "1,Slow,P1/fulldatastrem"), f"Did you mean '{P1}'?"),
        (("t,label,subject", "1,Slow,P9"), "line 2: there is no person 'P9'; accepted are P1, P2, P3, P4"),
        (("t,label,subject", "1,Slow,P1", "2,Slwo,P1"), "line 3: there is no scored gesture 'Slwo'"),
        (("t,label,subject", "2,Slwo,P1"), "Did you mean 'Slow'?"),
        (("t,label,subject", "soon,Slow,P1"), "line 2: t is 'soon': accepted are seconds since the first frame"),
        (("t,label,subject", "-1,Slow,P1"), "line 2: t is '-1'"),
        (("t,label,subject", "nan,Slow,P1"), "line 2: t is 'nan'"),
        (("t,label,subject", "1700000000,Slow,P1"), "line 2: t is 1.7e+09, but stream 'P1/fulldatastream' ends after"),
        (("t,stop,label,subject", "1,999,Slow,P1"), "line 2: stop is 999, but stream"),
        (("t,stop,label,subject", "2,1,Slow,P1"), "line 2: stop is '1': accepted are seconds, at least t"),
        (("t,label,score,subject", "1,Slow,70,P1"), "line 2: score is '70': accepted are 0 to 1"),
        (("t,label,score,subject", "1,Slow,,P1"), "line 2: score is ''"),
        (("t,label,subject", "1,Slow,P1", "1,Fast,P1"), "line 3: t is 1, which is not after line 2 of stream"),
        (
            ("t,stop,label,affect,subject", "1,2,,positiv,P1"),
            "no affect 'positiv'; accepted are none, positive",
        ),
        (("t,stop,label,named,subject", "1,2,Slow,3,P1"), "named is '3': accepted are seconds from t to stop"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(
    dataset: Dataset, tmp_path: Path, rows: tuple[str, ...], said: str
) -> None:
    file = written(tmp_path / "p.csv", *rows)
    with pytest.raises(FileFormatError) as refused:
        score_predictions(dataset.path, file, classes="all")
    message = str(refused.value)
    assert said in message and str(file) in message


def test_other_refusals(dataset: Dataset, tmp_path: Path) -> None:
    file = written(tmp_path / "p.csv", "t,label,subject", "1,Slow,P1")
    with pytest.raises(FileFormatError, match="no scored gesture 'Slow'; accepted are Rest, Fast, or nothing"):
        score_predictions(dataset.path, file, classes="Rest,Fast")
    with pytest.raises(FileFormatError, match="no column 'score': add one, or give no threshold"):
        score_predictions(dataset.path, file, threshold=0.5)
    with pytest.raises(ConfigError, match="accepted are 0 to 1"):
        score_predictions(dataset.path, file, threshold=50)
    with pytest.raises(BadInput, match="'P9' has no stream"):
        score_predictions(dataset.path, file, subjects=["P9"])
    with pytest.raises(FileFormatError, match="There is no file"):
        score_predictions(dataset.path, tmp_path / "none.csv")
    (tmp_path / "latin.csv").write_bytes("t,label\n1,Büste\n".encode("latin-1"))
    with pytest.raises(DatasetError, match="give a CSV file in UTF-8"):
        score_predictions(dataset.path, tmp_path / "latin.csv")
    with pytest.raises(BadInput, match="cannot be written"):
        stream_eval(dataset.path, made_bundle(), subjects=["P2"], events=tmp_path / "none" / "events.csv")


def test_the_example_of_the_documentation(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sklearn")
    page = (DOCS / "streams.md").read_text(encoding="utf-8")
    forest, measures = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    shutil.copytree(dataset.path, tmp_path / "DS")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(forest.replace("[-5:]", "[-2:]").replace("Classifier(100", "Classifier(10"), names)
    assert names["result"]["truths"] == 8 and list(names["result"]["people"]) == ["P3", "P4"]
    exec(measures, names)
    assert names["counts"]["Hug"].hits == 1
