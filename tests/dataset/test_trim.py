"""Suggestions accepted, adjusted and undone: marks only, and never over a person's own."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS, Mark, append_marks
from plushsense.dataset.store import Dataset
from plushsense.dataset.trimming import (
    Trim,
    TrimDecisions,
    accept_suggestions,
    decide_trims,
    find_recordings,
    kept_rows,
    set_rows,
    suggest_trims,
)

ACCEL = load_layout("accel-3")
BEGIN_S, END_S = 0.5, 1.8


def _recording(seed: int, size: float) -> Frames:
    rng = np.random.default_rng(seed)
    t = np.arange(250) / 100
    moving = np.where((t >= BEGIN_S) & (t < END_S), size * np.sin(6 * np.pi * (t - BEGIN_S)), 0.0)
    values = moving[:, None] * [1.0, 0.5, -0.5] + 5000 + rng.normal(0, 50, (250, 3))
    clock = np.arange(250, dtype=np.int64) * 10 + 100_000 * (seed + 1)
    return Frames(np.rint(values).astype(np.int64), clock, clock + 1_700_000_000_000)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Two people, each with two waves and a recording in which nothing happens."""
    for person in (1, 2):
        folder = tmp_path / "raw" / f"P{person}"
        folder.mkdir(parents=True)
        for number, (label, size) in enumerate((("Wave", 6000), ("Wave", 5000), ("Rest", 0))):
            frames = _recording(10 * person + number, size)
            assert frames.host_ms is not None
            name = recording_filename(label, int(frames.host_ms[-1]), len(frames))
            write_recording(folder / name, frames, ACCEL)
    return import_recordings(tmp_path / "raw", tmp_path / "DS", layout="accel-3").dataset


def _states(dataset: Dataset) -> list[str]:
    return [t.state for t in suggest_trims(open_dataset(dataset.path))]


def _raw(dataset: Dataset) -> str:
    files = sorted((dataset.path / "recordings").rglob("*.csv"))
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def _lines(dataset: Dataset) -> int:
    path = dataset.path / MARKS
    return len(path.read_text().splitlines()) if path.exists() else 0


def _waves(found: list[Trim]) -> list[Trim]:
    return [t for t in found if t.recording.gesture == "Wave"]


def test_accepting_trims_the_start_and_changes_no_file(dataset: Dataset) -> None:
    raw, before = _raw(dataset), dataset.hash
    assert _states(dataset) == ["none", "suggested", "suggested"] * 2
    done = accept_suggestions(dataset, suggest_trims(dataset), "K", "as suggested", above=0.5)
    assert (len(done.marked), len(done.not_visible), done.kept_by_hand) == (4, 2, ())
    opened = open_dataset(dataset.path)
    assert _states(dataset) == ["none", "accepted", "accepted"] * 2
    for info in (r for r in opened.recordings if r.gesture == "Wave"):
        assert info.start == pytest.approx(100 * BEGIN_S, abs=8)
        assert info.stop == info.rows == 250
        assert len(opened.read(info)) == 250 - info.start
    assert opened.hash != before
    assert _raw(dataset) == raw
    again = accept_suggestions(opened, suggest_trims(opened), "K", above=0.5)
    assert (again.marked, len(again.already)) == ((), 4)
    assert _lines(dataset) == 4, "running twice adds nothing"


def test_the_end_goes_too_when_asked(dataset: Dataset) -> None:
    accept_suggestions(dataset, suggest_trims(dataset), "K", offset=True)
    info = next(r for r in open_dataset(dataset.path).recordings if r.gesture == "Wave")
    assert info.stop == pytest.approx(100 * END_S, abs=12)


def test_a_confidence_nobody_reaches_marks_nothing(dataset: Dataset) -> None:
    found = [replace(t, suggestion=replace(t.suggestion, onset_confidence=0.7)) for t in suggest_trims(dataset)]
    done = accept_suggestions(dataset, found, "K", above=0.71, offset=True)
    assert (done.marked, len(done.not_visible)) == ((), 6)
    assert _lines(dataset) == 0


def test_what_a_person_set_stays(dataset: Dataset) -> None:
    mine, old, whole, plain = _waves(suggest_trims(dataset))
    assert set_rows(dataset, mine, *kept_rows(mine, 0.8, 1.5), "K", "I saw it")
    assert set_rows(dataset, whole, *kept_rows(whole, None, None), "K", "nothing to trim")
    append_marks(dataset.path, [Mark(old.recording.id, "trim", "from an old version", start=7)])
    done = accept_suggestions(dataset, suggest_trims(open_dataset(dataset.path)), "bulk")
    assert done.marked == (plain.recording.id,)
    assert set(done.kept_by_hand) == {mine.recording.id, old.recording.id, whole.recording.id}
    by_id = {r.id: r for r in open_dataset(dataset.path).recordings}
    assert (by_id[mine.recording.id].start, by_id[mine.recording.id].stop) == (80, 150)
    assert (by_id[whole.recording.id].start, by_id[whole.recording.id].stop) == (0, 250)
    assert by_id[old.recording.id].start == 7


def test_setting_what_stands_adds_nothing_and_undo_brings_the_suggestion_back(dataset: Dataset) -> None:
    first = _waves(suggest_trims(dataset))[0]
    assert set_rows(dataset, first, *kept_rows(first, 0.8, None), "K")
    standing = next(t for t in suggest_trims(dataset) if t.recording.id == first.recording.id)
    assert not set_rows(dataset, standing, *kept_rows(standing, 0.8, None), "K")
    assert _lines(dataset) == 1
    undo = TrimDecisions(undo=["P1/*"], who="K")
    assert [decide_trims(dataset, undo).undone for _ in range(2)] == [(first.recording.id,), ()]
    assert _lines(dataset) == 2
    assert _states(dataset) == ["none", "suggested", "suggested"] * 2
    assert open_dataset(dataset.path).hash == dataset.hash


@pytest.mark.parametrize(
    ("start", "stop", "said"),
    [(-0.1, None, "runs from 0 to 2.5"), (0.0, 2.6, "runs from 0"), (1.0, 1.0, "no row"), (float("nan"), 1.0, "nan")],
)
@pytest.mark.slow
def test_times_that_cannot_be_are_refused(dataset: Dataset, start: float, stop: float | None, said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        kept_rows(_waves(suggest_trims(dataset))[0], start, stop)


def test_rows_are_set_as_they_are_given(dataset: Dataset) -> None:
    wave = _waves(suggest_trims(dataset))[0]
    assert set_rows(dataset, wave, 0, wave.recording.rows, "x"), "keeping all of it is a decision, too"
    wave = _waves(suggest_trims(dataset))[0]
    assert wave.state == "adjusted" and wave.current_rows() == (0, wave.recording.rows)
    assert not set_rows(dataset, wave, 0, wave.recording.rows, "x")
    for start, stop in ((-1, 5), (5, 5), (0, wave.recording.rows + 1)):
        with pytest.raises(DatasetError, match="cannot be kept"):
            set_rows(dataset, wave, start, stop, "x")


def test_seconds_are_of_the_device_clock(dataset: Dataset) -> None:
    first = _waves(suggest_trims(dataset))[0]
    assert kept_rows(first, 0.35, 2.1) == (35, 210)
    assert kept_rows(first, None, 2.5) == (0, 250)
    assert first.to_dict()["stop_s"] == 2.5


def test_names_and_patterns(dataset: Dataset) -> None:
    assert len(find_recordings(dataset, "P2/Wave*")) == 2
    (one,) = find_recordings(dataset, dataset.recordings[0].id)
    assert one == dataset.recordings[0]
    with pytest.raises(DatasetError, match="no recording 'P3/.'"):
        find_recordings(dataset, "P3/*")


def test_rest_that_nobody_makes_is_all_gesture(dataset: Dataset) -> None:
    named = GestureSet("g", (Gesture("Rest"), Gesture("Wave", nobody=True)))
    dataset = Dataset(dataset.path, replace(dataset.head, gestures=named), dataset.recordings, dataset.streams)
    assert {t.state for t in suggest_trims(dataset)} == {"none"}


def test_recordings_cut_from_labels_are_refused(dataset: Dataset) -> None:
    phone = Dataset(dataset.path, replace(dataset.head, layout=load_layout("phone-6")), [], [])
    with pytest.raises(DatasetError, match=r"label on the rows.*phone-6"):
        suggest_trims(phone)
