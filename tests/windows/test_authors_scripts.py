"""Windows, splits and statistics of made-up recordings, compared with the outputs of the authors' own scripts."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.statistics import duration_table
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_windows
from plushsense.scoring.splits import parse_split
from plushsense.windows.cut import WindowSet, WindowSpec


@pytest.fixture(scope="module")
def labelled(authors_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Their folder of labelled recordings, some with broken clocks, as a data set."""
    return import_recordings(
        authors_run / "labelled", tmp_path_factory.mktemp("authors") / "DS", layout="plush-15"
    ).dataset


@pytest.fixture(scope="module")
def rows(labelled: Dataset) -> WindowSet:
    return ps.cut_windows(labelled, WindowSpec(context="rows"))


def test_every_sample_of_every_window_is_theirs(authors_run: Path, rows: WindowSet) -> None:
    theirs = np.load(authors_run / "outputs.npz")
    files = [name.rpartition("/")[2].removesuffix(".csv") for name in theirs["files"].tolist()]
    mine = [identity.rpartition("/")[2] for identity in rows.recording_ids]
    assert sorted(files) == sorted(mine) and len(rows) == len(theirs["windows"])
    for k, name in enumerate(files):
        expected = theirs["windows"][theirs["source"] == k]
        cut = rows.x[rows.recording == mine.index(name)].transpose(0, 2, 1)
        assert np.array_equal(cut[:, :, :10], expected[:, :, :10])
        # The magnitude is a whole number of sixteenths, rounded down, on the chip and here.
        apart = expected[:, :, 10] - cut[:, :, 10]
        assert apart.min() >= -1e-3 and apart.max() < 1 / 16 + 1e-3  # theirs are 32-bit floats


def test_every_window_is_in_their_part_of_the_split(authors_run: Path, rows: WindowSet) -> None:
    theirs = np.load(authors_run / "outputs.npz")
    fold = fold_windows(rows, rows, parse_split("windows:file-order"))[0]
    files = [name.rpartition("/")[2].removesuffix(".csv") for name in theirs["files"].tolist()]
    mine = [identity.rpartition("/")[2] for identity in rows.recording_ids]
    place = {name: np.flatnonzero(rows.recording == mine.index(name)).tolist() for name in files}
    index = [place[files[source]].pop(0) for source in theirs["source"].tolist()]
    for part in ("train", "validation", "test"):
        assert sorted(index[i] for i in theirs[part].tolist()) == getattr(fold, part).tolist()


def test_the_statistics_of_rows_are_theirs_to_the_printed_digits(authors_run: Path, labelled: Dataset) -> None:
    theirs = json.loads((authors_run / "statistics.json").read_text(encoding="utf-8"))
    mine = {row.gesture: row for row in duration_table(labelled)}
    assert set(theirs) == set(mine)
    for gesture, printed in theirs.items():
        found = mine[gesture].before_rows
        assert mine[gesture].recordings == printed["samples"]
        for key in ("mean", "median", "min", "max"):
            assert printed[key] == pytest.approx(getattr(found, key), abs=0.00501)
        assert printed["var"] == pytest.approx(found.variance, abs=0.00501)
        assert printed["std"] == pytest.approx(math.sqrt(found.variance), abs=0.00501)


def test_rows_are_samples_whatever_their_times(tmp_path: Path) -> None:
    layout = load_layout("accel-3")
    values = np.arange(900, dtype=np.int64).reshape(300, 3)
    clock = np.arange(300, dtype=np.int64) * 12
    clock[150:] += 1000  # a pause
    clock[200] = 0
    (tmp_path / "src" / "P1").mkdir(parents=True)
    for number, frames in enumerate((Frames(values, clock, clock), Frames(values[:100], clock[:100], clock[:100]))):
        write_recording(tmp_path / "src" / "P1" / f"Shake_{1000 + number}_{len(frames.values)}.csv", frames, layout)
    dataset = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset
    windows = ps.cut_windows(dataset, WindowSpec(context="rows"))
    assert set(windows.context) == {"rows"} and windows.x.shape[0] == 2 + 1
    assert np.array_equal(windows.x[1].T, values[50:300])
    assert np.array_equal(windows.x[2].T, np.tile(values[:100], (3, 1))[:250])


def test_rows_of_a_sensor_that_calibrates_itself_are_refused(labelled: Dataset) -> None:
    layout = replace(labelled.layout, self_calibration=("acc_x", "acc_y", "acc_z"))
    changed = labelled.with_inputs(layout)
    with pytest.raises(ConfigError, match="calibrates its sensors"):
        ps.cut_windows(changed, WindowSpec(context="rows"))


def test_their_option_1_is_the_first_window_of_each_recording(authors_run: Path, labelled: Dataset) -> None:
    theirs = np.load(authors_run / "outputs.npz")
    first = np.unique(theirs["source"], return_index=True)[1]
    cut = ps.cut_windows(labelled, WindowSpec(context="rows", step_s=60))
    names = [name.rpartition("/")[2].removesuffix(".csv") for name in theirs["files"].tolist()]
    mine = [cut.recording_ids[at].rpartition("/")[2] for at in cut.recording]
    assert sorted(mine) == sorted(names), "one window of each"
    order = [mine.index(name) for name in names]
    assert np.array_equal(cut.x[order].transpose(0, 2, 1)[:, :, :10], theirs["windows"][first][:, :, :10])
    (fold,) = fold_windows(cut, cut, parse_split("recordings:holdout"))
    for part in ("train", "validation", "test"):
        assert sorted(order[k] for k in theirs[f"recordings_{part}"].tolist()) == getattr(fold, part).tolist()
