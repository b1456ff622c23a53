from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.quality.measurements import summarize
from plushsense.dataset.statistics import SummaryStatistics, duration_bands, duration_table
from plushsense.dataset.store import Dataset, PersonInfo, write_people

ACCEL = load_layout("accel-3")
ROWS = {("P1", "Wave"): [100, 200, 300], ("P2", "Wave"): [400], ("P2", "Tap"): [50]}


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    clock = 1_700_000_000_000
    for (person, label), lengths in ROWS.items():
        folder = tmp_path / "raw" / person
        folder.mkdir(parents=True, exist_ok=True)
        for n in lengths:
            clock += 60_000
            ms = np.arange(n, dtype=np.int64) * 10 + clock - 1_700_000_000_000
            values = np.stack([np.arange(n), np.full(n, 7), np.full(n, n)], axis=1)
            write_recording(
                folder / recording_filename(label, clock + 10 * n, n), Frames(values, ms, ms + 1_700_000_000_000), ACCEL
            )
    return import_recordings(tmp_path / "raw", tmp_path / "DS", layout="accel-3").dataset


def test_spread_is_the_sample_s() -> None:
    assert SummaryStatistics.of([1.0, 2.0, 6.0]) == SummaryStatistics(3.0, 2.0, 7.0, 1.0, 6.0)
    assert SummaryStatistics.of([4.0]).variance is None


def test_durations_by_gesture_before_and_after_trimming(dataset: Dataset) -> None:
    tap, wave = duration_table(dataset)
    assert (tap.gesture, tap.recordings, tap.people, wave.recordings, wave.people) == ("Tap", 1, 1, 4, 2)
    assert (wave.before_rows.mean, wave.before_rows.median, wave.before_rows.min) == (250.0, 250.0, 100.0)
    assert wave.before_rows.variance == pytest.approx(np.var([100, 200, 300, 400], ddof=1))
    assert wave.before_s.max == pytest.approx(4.0, rel=1e-3)
    assert wave.after_s == wave.before_s
    longest = next(r for r in dataset.recordings if r.rows == 400)
    append_marks(dataset.path, [Mark(longest.id, "trim", "K", start=100, stop=350)])
    wave = duration_table(open_dataset(dataset.path))[1]
    assert (wave.trimmed, wave.before_rows.max, wave.after_rows.max) == (1, 400.0, 300.0)
    append_marks(dataset.path, [Mark(longest.id, "exclude", "K")])
    assert duration_table(open_dataset(dataset.path))[1].recordings == 3


def test_durations_by_what_is_known_of_the_people(dataset: Dataset) -> None:
    with pytest.raises(DatasetError, match=r"no subjects.csv"):
        duration_table(dataset, "gender")
    write_people(dataset.path, [PersonInfo("P1", "child", "f", more={"hand": "left"}), PersonInfo("P9")])
    assert [(d.gesture, d.group, d.recordings) for d in duration_table(dataset, "age_group")] == [
        ("Tap", "not said", 1),
        ("Wave", "child", 3),
        ("Wave", "not said", 1),
    ]
    assert duration_table(dataset, "Hand")[1].group == "left"
    assert [d.group for d in duration_table(dataset, "subject")] == ["P2", "P1", "P2"]
    with pytest.raises(DatasetError, match=r"no column 'gendre'.*Did you mean 'gender'"):
        duration_table(dataset, "gendre")


def test_nobody_is_a_group_of_its_own(dataset: Dataset) -> None:
    resting = [replace(r, subject="none") if r.gesture == "Tap" else r for r in dataset.recordings]
    write_people(dataset.path, [PersonInfo("P1", gender="f")])
    tap = duration_table(Dataset(dataset.path, dataset.head, resting, []), "gender")[0]
    assert (tap.group, tap.people) == ("nobody", 0)


def test_the_band_of_the_paper_around_the_mean(dataset: Dataset) -> None:
    tap, wave = duration_bands(dataset)
    assert (tap.gesture, tap.outliers, wave.statistics.median) == ("Tap", [], pytest.approx(2.5, rel=0.01))
    assert (wave.low_s, wave.high_s) == (pytest.approx(0.6 * wave.mean_s), pytest.approx(1.4 * wave.mean_s))
    outside = [i for i, s in wave.seconds.items() if abs(s / wave.mean_s - 1) > 0.4]
    assert wave.outliers == outside and len(outside) == 2
    assert duration_bands(dataset, 0.7)[1].outliers == []


def test_check_and_stats_have_one_duration_of_a_recording(dataset: Dataset) -> None:
    longest = next(r for r in dataset.recordings if r.rows == 400)
    append_marks(dataset.path, [Mark(longest.id, "trim", "K", start=100, stop=350)])
    trimmed = open_dataset(dataset.path)
    seconds = {i: s for band in duration_bands(trimmed) for i, s in band.seconds.items()}
    assert sorted(round(s, 2) for s in seconds.values()) == [0.5, 1.0, 2.0, 2.5, 3.0], "rows × 10 ms"
    summaries = [summarize(r, trimmed.read(r), ACCEL) for r in trimmed.used]
    assert {s.info.id: s.seconds for s in summaries} == seconds
    assert {r.id: r.seconds for r in trimmed.used} == seconds
