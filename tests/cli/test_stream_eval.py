"""``plushsense stream-eval`` as a user meets it: one bundle on whole streams, and every system on people left out."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.store import Dataset
from plushsense.experiments.recordings import opened
from plushsense.experiments.streams.systems import SYSTEMS
from plushsense.models.bundle import Bundle, trained_people

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]

KEYS = ("events", "hits", "deletions", "insertions", "fragmentations", "merges", "false_events_per_hour", "latency_s")
QUICK = ("--filters", "4,4,4", "--epochs", 4, "--workers", 1)


@pytest.fixture
def bundle(bundle: Path, tmp_path: Path) -> Path:
    """A bundle that has not met P4 and P5, by its own word."""
    told = Bundle.load(bundle)
    told.provenance.update(subjects=["P1", "P2"], validation_subjects=["P3"])
    return told.save(tmp_path / "partly.plush")


def test_one_bundle_on_whole_streams(cli: Cli, dataset: Dataset, bundle: Path) -> None:
    trained = trained_people(Bundle.load(bundle), dataset)
    assert trained == {"P1", "P2", "P3"}
    ran = cli("stream-eval", dataset.path, "--model", bundle, "--json")
    left = sorted(set(dataset.subjects) - trained)
    assert ran.status == 0 and "TRAINED ON them" in ran.err
    found = ran.json
    assert set(KEYS) <= set(found) and set(found["latency_s"]) == {"median", "p90"}
    assert list(found["people"]) == left and not any(p["trained_on"] for p in found["people"].values())
    assert found["truths"] == found["hits"] + found["deletions"] == 6 * len(left)
    assert found["events"] >= found["insertions"] and "upper bound" in found["note"]
    shown = cli("stream-eval", dataset.path, "--model", bundle)
    assert shown.status == 0 and "false/h" in shown.out and "upper bound" in shown.out


def test_labels_between_recordings_are_used_or_ignored(
    cli: Cli, dataset: Dataset, bundle: Path, tmp_path: Path
) -> None:
    before = cli("stream-eval", dataset.path, "--model", bundle, "--json").json
    labelled = tmp_path / "labelled"
    shutil.copytree(dataset.path, labelled)
    stream = next(s for s in dataset.streams if s.subject == "P4")
    done = cli("check", labelled, "--label", stream.id, f"0:{stream.seconds}", "rest", "--who", "K", "--json")
    assert done.json["labelled"] == 1 and done.json["seconds"]["rest"] > 0
    used = cli("stream-eval", labelled, "--model", bundle, "--json").json
    assert used["rest_hours"] > before["rest_hours"] and used["hits"] == before["hits"]
    assert used["labelled_stretches"] == len(done.json["stretches"]) and "labelled" in used["note"]
    shown = cli("stream-eval", labelled, "--model", bundle)
    assert "where a recording or a label says what happened" in shown.out
    assert cli("stream-eval", labelled, "--model", bundle, "--labels", "ignore", "--json").json == before
    assert "--label was given '3'" in cli("check", labelled, "--label", stream.id, 3, "rest").err
    text = cli("check", labelled, "--save-labels", tmp_path / "labels.csv").out
    assert "labelled stretches; rest" in text
    assert cli("check", labelled, "--unlabel", stream.id, ":", "--json").json["stretches"] == []
    again = cli("check", labelled, "--labels", tmp_path / "labels.csv", "--json").json
    assert again["labelled"] == len(done.json["stretches"]) and again["stretches"] == done.json["stretches"]


def test_somebody_it_was_trained_on_is_marked_loudly(cli: Cli, dataset: Dataset, bundle: Path) -> None:
    met = sorted(trained_people(Bundle.load(bundle), dataset))[0]
    ran = cli("stream-eval", dataset.path, "--model", bundle, "--subjects", met)
    assert ran.status == 0 and f"{met} TRAINED ON" in ran.out and "no result" in ran.out and "TRAINED ON" in ran.err
    assert cli("stream-eval", dataset.path, "--model", bundle, "--subjects", met, "--json").json["trained_on"] == [met]


def test_who_may_be_the_same_is_told(cli: Cli, dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    own = Bundle.load(bundle)
    own.personal.update(subject="P5")
    assert trained_people(own, dataset) == {"P1", "P2", "P3", "P5"}
    ran = cli("stream-eval", dataset.path, "--model", own.save(tmp_path / "own.plush"), "--json")
    assert list(ran.json["people"]) == ["P4"]
    told = Bundle.load(bundle)
    told.provenance.update(dataset="elsewhere", dataset_hash="other")
    ran = cli("stream-eval", dataset.path, "--model", told.save(tmp_path / "other.plush"), "--json")
    assert len(ran.json["people"]) == 5 and "same codes in 'elsewhere': if P1, P2, P3 are the same people" in ran.err
    told.provenance.update(subjects=2, validation_subjects=1)  # as an export has it
    ran = cli("stream-eval", dataset.path, "--model", told.save(tmp_path / "export.plush"), "--json")
    assert len(ran.json["people"]) == 5 and "does not say on whom it was trained" in ran.err


def test_nobody_left_is_refused(cli: Cli, dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    whole = Bundle.load(bundle)
    everybody = tmp_path / "all.plush"
    whole.provenance["subjects"] = dataset.subjects
    whole.save(everybody)
    ran = cli("stream-eval", dataset.path, "--model", everybody)
    assert ran.status == 2 and ran.out == "" and "would be too high" in ran.err


def test_a_folder_of_the_recorder_gives_what_its_data_set_gives(
    cli: Cli, dataset: Dataset, bundle: Path, recordings: Path, tmp_path: Path
) -> None:
    person = sorted(set(dataset.subjects) - trained_people(Bundle.load(bundle), dataset))[0]
    folder = tmp_path / "visit"
    shutil.copytree(recordings / person, folder / person)
    before = sorted(p.name for p in folder.rglob("*"))
    one = cli("stream-eval", folder, "--model", bundle, "--json").json
    other = cli("stream-eval", dataset.path, "--model", bundle, "--subjects", person, "--json").json
    assert {k: one[k] for k in KEYS} == {k: other[k] for k in KEYS}
    assert sorted(p.name for p in folder.rglob("*")) == before
    with opened(folder, Bundle.load(bundle).layout) as made:
        place = made.path
        assert made.subjects == [person]
    assert not place.exists()


def test_the_predictions_of_another_system(cli: Cli, dataset: Dataset, bundle: Path, tmp_path: Path) -> None:
    file = tmp_path / "events.csv"
    own = cli("stream-eval", dataset.path, "--model", bundle, "--events", file, "--json").json
    found = cli("stream-eval", dataset.path, "--predictions", file, "--json").json
    assert {k: found[k] for k in (*KEYS, "per_class", "hours")} == {k: own[k] for k in (*KEYS, "per_class", "hours")}
    assert list(found["people"]) == ["P4", "P5"] and found["curve"] == []
    decisions = tmp_path / "decisions.csv"
    rows = [f"{at / 5},{'Fast' if at % 30 < 10 else ''},{(at % 7) / 10}" for at in range(1, 100)]
    decisions.write_text("\n".join(["t,label,score", *rows]), encoding="utf-8")
    words = ("stream-eval", dataset.path, "--predictions", decisions, "--subjects", "P4", "--classes", "all")
    shown = cli(*words)
    assert shown.status == 0 and "threshold  recall" in shown.out and "upper bound" in shown.out
    curve = cli(*words, "--json").json["curve"]
    assert [p["threshold"] for p in curve] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    fewer = cli(*words, "--threshold", "0.5", "--json").json
    assert fewer["threshold"] == 0.5 and fewer["false_events_per_hour"] == curve[5]["false_events_per_hour"]
    refused = cli("stream-eval", dataset.path, "--predictions", decisions)
    assert refused.status == 2 and "no column 'stream'" in refused.err and refused.out == ""


def test_every_system_on_people_left_out(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "OUT"
    words = ("stream-eval", dataset.path, "--split", "by-subject:2", *QUICK)
    ran = cli(*words, "--out", out, "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert list(found["systems"]) == list(SYSTEMS) and found["subjects"] == dataset.subjects
    assert len(found["folds"]) == 2
    for fold in found["folds"]:
        assert not {*fold["train"], *fold["validation"]} & set(fold["test"])
        assert "plan" in fold["fitted"]
    for system in found["systems"].values():
        best = system["balanced"]
        assert set(KEYS) <= set(best) and best["truths"] == 30 and len(best["people"]) == 5
        assert all(0 <= p["recall"] <= 1 for p in system["curve"])
    assert [row["recall"] for row in found["at_recall"]] == [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9]
    assert sorted(p.name for p in out.iterdir()) == [
        "curves.png", "latencies.png", "streams.csv", "streams.html", "streams.json",
    ]  # fmt: skip
    assert json.loads((out / "streams.json").read_text(encoding="utf-8"))["systems"].keys() == SYSTEMS.keys()
    rows = list(csv.DictReader(io.StringIO((out / "streams.csv").read_text(encoding="utf-8"))))
    assert {r["point"] for r in rows} == {"curve", "plain", "balanced", "prompt", "quiet", "cheapest"}
    assert {r["simulated"] for r in rows} == {"no"}
    page = (out / "streams.html").read_text(encoding="utf-8")
    assert "upper bound" in page and "Ward" in page and "http" not in page.replace("http-equiv", "")
    refused = cli(*words, "--out", out)
    assert refused.status == 2 and "holds a benchmark already" in refused.err
    again = cli(*words, "--out", out, "--force")
    assert again.status == 0 and "2 of 2 folds (2 from before)" in again.err and "equal recall" in again.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "either --model BUNDLE"),
        (("--model", "m.plush", "--split", "by-subject:2"), "not allowed with argument --model"),
        (("--model", "m.plush", "--predictions", "p.csv"), "not allowed with argument --model"),
        (("--model", "m.plush", "--threshold", "0.5"), "--threshold belongs to --predictions"),
        (("--predictions", "p.csv", "--events", "e.csv"), "--events belongs to --model"),
        (("--predictions", "p.csv", "--out", "X"), "belong to --split"),
        (("--predictions", "p.csv", "--threshold", "2"), "accepted are 0 to 1"),
        (("--predictions", "p.csv", "--subjects", "P33"), "'P33' has no stream"),
        (("--predictions", "no.csv"), "no file 'no.csv'"),
        (("--split", "by-recording:2"), "does not keep people apart"),
        (("--split", "by-subject:2", "--systems", "hybird"), "Did you mean 'hybrid'?"),
        (("--split", "by-subject:2", "--subjects", "P1"), "--subjects belongs to --model"),
        (("--split", "by-subject:2", "--late", "-1"), "accepted are 0 to 10 seconds"),
        (("--split", "by-subject:2", "--padding", "mirror"), "cannot follow a stream"),
        (("--model", "m.plush", "--out", "X"), "belong to --split"),
    ],
)
def test_refusals(cli: Cli, dataset: Dataset, words: tuple[str, ...], said: str) -> None:
    ran = cli("stream-eval", dataset.path, *words)
    assert ran.status == 2 and said in ran.err and ran.out == "" and "Traceback" not in ran.err


def test_a_person_without_a_stream_is_refused_with_the_nearest(cli: Cli, dataset: Dataset, bundle: Path) -> None:
    ran = cli("stream-eval", dataset.path, "--model", bundle, "--subjects", "P33")
    assert ran.status == 2 and "'P33' has no stream" in ran.err and "P1, P2" in ran.err
