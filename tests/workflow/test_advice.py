"""Advice that is not used: what it brings is measured on the same folds, as if the user had followed it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from plushsense.core.errors import BadInput
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import format_header, format_rows, read_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.proposals import WINDOW
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import windows_fingerprint
from plushsense.evaluation.scores import votes_by_person
from plushsense.workflow import advice as advising
from plushsense.workflow.advice import LAYOUT, RECORDINGS, Advice, advice_gain, measure_advice, unused_advice
from plushsense.workflow.api import evaluate
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.datasets import DecisionSpec, decide
from plushsense.workflow.preparation import prepare
from support.small_dataset import ACCEL, Cli

SETTINGS = {"filters": "4,4,4", "epochs": 1, "batch": 8, "workers": 1, "window_s": 2.0}
SMALL = ("--filters", "4,4,4", "--epochs", "1", "--batch", "8", "--window-s", "2.0")


def reset_clocks(folder: Path, person: str, gesture: str) -> list[str]:
    """Let the device clock jump back in the recordings of a gesture, and return their ids."""
    paths = sorted((folder / "recordings" / person).glob(f"{gesture}_*.csv"))
    for path in paths:
        frames = read_recording(path, ACCEL).frames
        frames.device_ms[80:] -= 900
        path.write_text(format_header(ACCEL) + format_rows(frames, ACCEL), newline="\n")
    (folder / "index.json").unlink()
    return [f"{person}/{path.stem}" for path in paths]


@pytest.fixture
def marked(imported: Path, tmp_path: Path) -> Dataset:
    """A data set of which `check` marks two recordings."""
    folder = Path(shutil.copytree(imported, tmp_path / "marked"))
    reset_clocks(folder, "P2", "Slow")
    return open_dataset(folder)


@pytest.fixture
def slow_layout(recordings: Path, tmp_path: Path) -> Dataset:
    """A data set whose layout says half the rate of its recordings."""
    path = tmp_path / "half.toml"
    path.write_text(tomli_w.dumps(replace(load_layout("accel-3"), rate_hz=50.0).to_dict()))
    return import_recordings(recordings, tmp_path / "half", layout=str(path), adopt_proposals=False).dataset


def of_kind(found: list[Advice], kind: str) -> Advice:
    return next(each for each in found if each.kind == kind)


def fingerprint(dataset: Dataset, config: RunConfig) -> str:
    return windows_fingerprint(prepare(dataset, config).scored_windows())


def test_followed_in_memory_a_layout_reads_as_imported_with_it(slow_layout: Dataset, recordings: Path) -> None:
    config = from_settings(filters="4,4,4")
    found = of_kind(unused_advice(slow_layout, 2.5), LAYOUT)
    assert "rate_hz = 100" in found.text
    followed, same = found.follow(slow_layout, config)
    anew = import_recordings(
        recordings, slow_layout.path.with_name("anew"), layout=str(slow_layout.path.with_name("half.toml"))
    ).dataset
    assert same == config
    assert fingerprint(followed, config) == fingerprint(anew, config) != fingerprint(slow_layout, config)
    assert open_dataset(slow_layout.path).layout.rate_hz == 50.0  # the files stay as they are


def test_followed_in_memory_marked_recordings_are_left_out_as_by_check(marked: Dataset) -> None:
    config = from_settings(filters="4,4,4")
    found = of_kind(unused_advice(marked, 2.5), RECORDINGS)
    followed, _ = found.follow(marked, config)
    asked = fingerprint(followed, config)
    decide(marked, DecisionSpec(exclude=["clock-reset:"], why="it restarted"))
    excluded = open_dataset(marked.path)
    assert {r.id for r in excluded.recordings if r.excluded} == set(found.recordings)
    assert asked == fingerprint(excluded, config) != fingerprint(marked, config)


def test_a_window_is_advised_to_longer_ones_only(dataset: Dataset) -> None:
    window = of_kind(unused_advice(dataset, 2.5), WINDOW)
    shorter = dict(window.settings)[WINDOW]
    assert window.follow(dataset, from_settings(window_s=2.5))[1] == from_settings(window_s=shorter)
    assert all(each.kind != WINDOW for each in unused_advice(dataset, shorter))


def test_the_gain_is_that_of_an_evaluation_after_the_advice_was_followed(marked: Dataset) -> None:
    plain = evaluate(marked, split="by-subject:2", **SETTINGS)
    found = measure_advice(marked, from_settings(split="by-subject:2", **SETTINGS), plain)
    gain = of_kind(found, RECORDINGS).gain
    decide(marked, DecisionSpec(exclude=["clock-reset:"], why="it restarted"))
    after = evaluate(marked.path, split="by-subject:2", **SETTINGS)
    # Recordings that only one of the two scores do not count.
    left = plain.predictions.of_recordings(np.unique(after.predictions.recording))
    assert len(left) < len(plain.predictions)
    before, now = votes_by_person(left), votes_by_person(after.predictions)
    differences = [float(now[p].metrics["accuracy"] or 0) - float(before[p].metrics["accuracy"] or 0) for p in before]
    assert gain is not None and gain.accuracy == pytest.approx(np.mean(differences))
    assert (gain.people, gain.split, gain.epochs, gain.seed) == (5, "by-subject:2", 1, 0)
    assert gain.ci95[0] <= gain.accuracy <= gain.ci95[1]


def test_a_gain_is_positive_for_advice_that_helps_and_needs_two_people(dataset: Dataset) -> None:
    result = evaluate(dataset, split="by-subject:2", **SETTINGS)
    right = np.eye(len(result.predictions.labels), dtype=np.float32)[result.predictions.truth]
    perfect = replace(result, predictions=replace(result.predictions, probabilities=right))
    wrong = replace(result, predictions=replace(result.predictions, probabilities=np.roll(right, 1, axis=1)))
    assert advice_gain(wrong, perfect, 1).accuracy == 1.0
    assert advice_gain(perfect, wrong, 1).accuracy == -1.0
    one = result.predictions.of_recordings(result.predictions.recording[result.predictions.subject == "P1"])
    with pytest.raises(BadInput, match="at least 2 models on 2 people"):
        advice_gain(result, replace(result, predictions=one), 1)


def test_what_cannot_be_followed_is_said_and_not_measured(imported: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(imported, tmp_path / "DS"))
    for person in ("P1", "P2", "P3"):
        for gesture in ("Rest", "Slow", "Fast"):
            reset_clocks(folder, person, gesture)
            open_dataset(folder)
    marked, warned = open_dataset(folder), list[str]()
    plain = evaluate(marked, split="leave-one-subject-out", **SETTINGS)
    found = measure_advice(marked, from_settings(**SETTINGS), plain, warn=warned.append)
    assert of_kind(found, RECORDINGS).gain is None
    (warning,) = warned
    assert warning.startswith("not measured: check marks 18 recordings") and "there are 2 (P4, P5)" in warning


def test_the_command_says_what_advice_brings_until_it_is_followed(
    cli: Cli, marked: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def line(err: str) -> str:
        (found,) = (line for line in err.splitlines() if line.startswith("not used: "))
        return found

    evaluated = ("evaluate", marked.path, *SMALL, "--workers", "1", "--split", "by-subject:2")
    assert line(cli(*evaluated).err).endswith("evaluate --advice measures what it brings")
    ran = cli(*evaluated, "--advice", "--json")
    (advice,) = ran.json["advice"]
    gain = advice["gain"]
    measured = f"(accuracy by recording {gain['accuracy']:+.3f}, 95 % interval over 5 people {gain['ci95'][0]:+.3f} to "
    assert measured in line(ran.err) and "by-subject:2, epochs 1, seed 0)" in line(ran.err)
    with monkeypatch.context() as patch:
        patch.setattr(advising, "check", None)  # neither the files are read again nor is anything trained
        assert line(cli("train", marked.path, *SMALL, "--out", tmp_path / "m.plush").err) == line(ran.err)
    cli("check", marked.path, "--exclude", "clock-reset:", "--why", "it restarted")
    after = cli(*evaluated, "--advice", "--json", "--out", tmp_path / "after")
    assert after.json["advice"] == [] and "everything that is advised is used" in after.err


def test_advice_is_measured_on_people_left_out_only(cli: Cli, marked: Dataset) -> None:
    refused = cli("evaluate", marked.path, *SMALL, "--advice", "--split", "by-recording:2")
    assert refused.status == 2 and "--advice needs a split that leaves people out" in refused.err
