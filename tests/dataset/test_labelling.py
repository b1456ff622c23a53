"""Labels of what happens between the recordings of a stream."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.labelling import (
    TimedStretch,
    decide_labels,
    label_stretches,
    read_stretches,
    timed_stretches,
    write_stretches,
)
from plushsense.dataset.marks import MARKS, LabelledStretch, Mark, append_marks, read_marks
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.store import Dataset

pytestmark = pytest.mark.apart("real-recordings")

ACCEL = load_layout("accel-3")
P1, P2 = "P1/fulldatastream", "P2/fulldatastream"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Two people with a stream of 10 s and a wave from 3 to 5 s; the clock is set back at 8 s."""
    for person in ("P1", "P2"):
        folder = tmp_path / "src" / person
        folder.mkdir(parents=True)
        clock = 5_000 + 10 * np.arange(1000, dtype=np.int64)
        host = clock + 1_700_000_000_000
        clock[800:] -= 7_000
        values = np.random.default_rng(len(person)).integers(0, 900, (1000, 3))
        stream = Frames(values, clock, host)
        (folder / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
        name = recording_filename("Big_wave", int(host[499]), 200)
        write_recording(folder / name, stream.slice(300, 500), ACCEL)
    return import_recordings(tmp_path / "src", tmp_path / "DS", layout=ACCEL).dataset


def test_label_list_and_undo(dataset: Dataset) -> None:
    empty = dataset.hash
    wave = (P1, (1.0, 3.5), "Practice:big_WAVE")
    done = decide_labels(dataset.path, label=[wave], who="K", why="seen")
    assert (done.labelled, done.stretches) == (1, (TimedStretch(P1, 1.0, 3.0, "practice:Big_wave"),))
    (line,) = map(json.loads, (dataset.path / MARKS).read_text().splitlines())
    assert {k: line[k] for k in ("recording", "action", "start", "stop", "label", "who", "why")} == {
        "recording": P1,
        "action": "label",
        "start": 100,
        "stop": 350,
        "label": "practice:Big_wave",
        "who": "K",
        "why": "seen",
    }
    assert done.dataset.stretches == (LabelledStretch(P1, 100, 300, "practice:Big_wave"),), "the recording has its own"
    assert done.dataset.hash != empty
    again = decide_labels(dataset.path, label=[wave, (P2, (6.0, 9.99), "rest")])
    assert (again.labelled, [s.stream for s in again.stretches]) == (1, [P1, P2])
    assert decide_labels(dataset.path, unlabel=[(P1, (2.0, None))]).stretches[0].stop_s == 2.0
    assert decide_labels(dataset.path, unlabel=[("*", (None, None))]).undone == 2
    assert open_dataset(dataset.path).stretches == () and open_dataset(dataset.path).hash == empty


def test_a_trimmed_or_moved_recording_keeps_its_rows(dataset: Dataset) -> None:
    label_stretches(dataset, [LabelledStretch(P1, 0, 1000, "handling")], "K")
    assert [(s.start, s.stop) for s in open_dataset(dataset.path).stretches] == [(0, 300), (500, 1000)]
    recording = next(r.id for r in dataset.recordings if r.subject == "P1")
    append_marks(dataset.path, [Mark(recording, "trim", "K", start=50)])
    trimmed = open_dataset(dataset.path)
    assert [(s.start, s.stop) for s in trimmed.stretches] == [(0, 350), (500, 1000)]
    assert trimmed.without_stretches().stretches == ()


def test_labels_are_the_same_after_export_and_import(dataset: Dataset, tmp_path: Path) -> None:
    new = [LabelledStretch(P1, 3, 77, "rest"), LabelledStretch(P2, 500, 999, "handling")]
    label_stretches(dataset, new, "K")
    labelled = open_dataset(dataset.path)
    path = tmp_path / "labels.csv"
    write_stretches(path, timed_stretches(labelled, labelled.streams))
    assert path.read_text().splitlines()[:2] == ["stream,start_s,stop_s,label", f"{P1},0.030,0.770,rest"]
    assert read_stretches(labelled, path) == new
    assert decide_labels(dataset.path, file=path).labelled == 0
    decide_labels(dataset.path, unlabel=[("*", (None, None))])
    assert decide_labels(dataset.path, file=path, who="K").dataset.stretches == tuple(new)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("P9/x,0,1,rest", "line 3: There is no stream 'P9/x'"),
        (f"{P1},0,1,practise:Wave", "line 3: The label 'practise:Wave' is unknown: accepted are handling, rest"),
        (f"{P1},0,1,practice:Wive", "line 3: The label 'practice:Wive' is unknown"),
        (f"{P1},0,1.x,rest", "line 3: '1.x' is no time"),
        (f"{P1},3,11,rest", "line 3: 'P1/fulldatastream' has no 11 s: it runs from 0 to 9.990 s"),
        (f"{P1},3,3,rest", "line 3: 'P1/fulldatastream' has no row from 3 to 3 s"),
        ("P*,3,4,rest", r"line 3: 'P\*' names 2 streams"),
    ],
)
def test_a_wrong_line_marks_nothing(dataset: Dataset, tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "labels.csv").write_text(f"stream,start_s,stop_s,label\n{P1},0,1,rest\n{line}\n")
    with pytest.raises(DatasetError, match=said):
        decide_labels(dataset.path, file=tmp_path / "labels.csv")
    assert not (dataset.path / MARKS).exists()


@pytest.mark.parametrize(
    ("decision", "error"),
    [
        ({"label": [("*", (1.0, 2.0), "rest")]}, r"'\*' names 2 streams"),
        ({"label": [(P1, (0.0, 1.0), "rest"), (P1, (3.0, 11.0), "rest")]}, "has no 11 s"),
        ({"label": [(P1, (0.0, 1.0), "rest")], "relabel": [("P1/*", "Wive")]}, "no gesture 'Wive'"),
        ({"label": [(P1, (0.0, 1.0), "rest")], "unlabel": [("P9", (None, None))]}, "no stream 'P9'"),
        ({"label": [(P1, (0.0, 1.0), "rest")], "relabel": [("P9/*", "Big_wave")]}, "no recording 'P9"),
    ],
)
def test_a_wrong_decision_marks_nothing(dataset: Dataset, decision: dict[str, Any], error: str) -> None:
    with pytest.raises(DatasetError, match=error):
        decide_labels(dataset.path, **decision)
    assert not (dataset.path / MARKS).exists()


def test_files_and_rows_that_do_not_fit_are_refused(dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / "odd.csv").write_text("stream,label\n")
    with pytest.raises(DatasetError, match="lacks start_s, stop_s"):
        decide_labels(dataset.path, file=tmp_path / "odd.csv")
    with pytest.raises(DatasetError, match="There is no file"):
        decide_labels(dataset.path, file=tmp_path / "none.csv")
    with pytest.raises(DatasetError, match="rows 0 to 1000: 5 to 1001"):
        label_stretches(dataset, [LabelledStretch(P1, 5, 1001, "rest")])


def test_labels_of_a_removed_person_go(dataset: Dataset) -> None:
    both = [LabelledStretch(p, 0, 50, "practice:Big_wave") for p in (P1, P2)]
    label_stretches(dataset, [*both, LabelledStretch(P2, 20, 30, "rest")], "K")
    forget(dataset.path, "P1")
    assert set(read_marks(dataset.path)) == {P2}
    assert {s.stream for s in open_dataset(dataset.path).stretches} == {P2}


@pytest.mark.exhaustive
def test_the_labels_of_the_example_fit_the_data(real_data: Path, tmp_path: Path) -> None:
    made = import_recordings(real_data / "makeability-gestures", tmp_path / "DS", layout="accel-3").dataset
    file = Path(__file__).parents[2] / "examples" / "makeability-stretches.csv"
    done = decide_labels(made.path, file=file, who="a language model", why="seen in plots of the signals")
    assert len({s.stream for s in done.stretches}) == 11 and done.labelled == len(read_stretches(made, file))
    practised = [s for s in done.stretches if s.label.startswith("practice:")]
    assert len(practised) == 40, "none of them is in a recording"
    # What is labelled as rest moves less than the rest of the same stream.
    stream = next(s for s in made.streams if s.subject == "P07")
    values = made.read_stream(stream.id).values
    steps = np.abs(np.diff(values, axis=0)).max(axis=1)
    still = [steps[s.start : s.stop - 1] for s in done.dataset.stretches if s.stream == stream.id and s.label == "rest"]
    assert np.percentile(np.concatenate(still), 99) < np.percentile(steps, 90)
