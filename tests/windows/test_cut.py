from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import context_of
from plushsense.windows.clock import resample
from plushsense.windows.cut import (
    WindowSpec,
    constant_windows,
    cut_windows,
    from_recording,
    recordings_in_time,
    shared_gestures,
    whole_gestures,
)

ACCEL = load_layout("accel-3")


def ramp(start: int, rows: int, epoch: int = 1_000_000) -> Frames:
    """Frames at 100 Hz whose x is the row's number, so that a window says where it came from."""
    row = np.arange(start, start + rows, dtype=np.int64)
    return Frames(np.stack([row, row * 0 + 1, row * 0 - 1], axis=1), row * 10, epoch + row * 10)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Ana has a stream of 2000 rows; Ben has none. One clock gap in Ana's stream at row 1500."""
    ana, ben = tmp_path / "src" / "ana", tmp_path / "src" / "ben"
    ana.mkdir(parents=True)
    ben.mkdir()
    stream = ramp(0, 2000)
    clock = stream.device_ms + np.where(np.arange(2000) >= 1500, 500, 0)
    stream = Frames(stream.values, clock, stream.host_ms)
    (ana / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    for label, first, rows in (
        ("Wave", 400, 120),
        ("Wave", 700, 410),
        ("Shake", 100, 120),
        ("Shake", 1550, 120),
    ):
        part = stream.slice(first, first + rows)
        name = recording_filename(label, int(part.host_ms[-1]) if part.host_ms is not None else 0, rows)
        write_recording(ana / name, part, ACCEL)
    write_recording(ben / recording_filename("Wave", 5, 100), ramp(0, 100), ACCEL)
    write_recording(ben / recording_filename("Custom", 6, 300), ramp(0, 300), ACCEL)
    return import_recordings(tmp_path / "src", tmp_path / "DS", layout=ACCEL).dataset


def test_loops_repeat_from_the_start_and_are_never_padded(dataset: Dataset) -> None:
    w = cut_windows(dataset, WindowSpec(context="loop"), dataset.gestures.subset(["Wave"]))
    short = w.integers[(w.subject == "ben")][0, 0]
    assert np.array_equal(short, np.tile(np.arange(100), 3)[:250])
    assert w.context[w.subject == "ben"].tolist() == ["loop"]
    long = w.integers[np.array([i for i in range(len(w)) if w.context[i] == "inside"])]
    assert long[:, 0, 0].tolist() == [700, 750, 800, 850], "full windows only, every 50 samples"
    assert np.all(w.integers[:, 1] == 1)
    assert set(w.stream[w.subject == "ana"]) == {"ana/fulldatastream"}, "where it lies is known all the same"
    assert np.all(w.window_rows == -1)
    assert set(w.stream[w.subject == "ben"]) == {""}
    ben = next(r for r in dataset.used if r.subject == "ben" and r.gesture == "Wave")
    (looped,) = from_recording(resample(dataset.read(ben), ACCEL), dataset, 250, 50)
    assert (looped.context, looped.begin) == ("loop", 0)


def test_rest_holds_the_first_reading_before_a_short_recording(dataset: Dataset) -> None:
    spec, gestures = WindowSpec(context="rest"), dataset.gestures.subset(["Wave"])
    w, looped = cut_windows(dataset, spec, gestures), cut_windows(dataset, replace(spec, context="loop"), gestures)
    short = w.integers[w.subject == "ben"][0]
    assert short[0].tolist() == [0] * 150 + list(range(100)) and np.all(short[1] == 1)
    turned = cut_windows(dataset.with_inputs(ACCEL.for_vectors()), spec, gestures)
    assert np.all(turned.integers[turned.subject == "ben"][0, 4] == 16), "gravity is that of the whole past"
    assert w.context.tolist() == ["rest" if c == "loop" else c for c in looped.context]
    assert np.all(w.window_rows == -1) and context_of(w) == "rest"
    assert whole_gestures({"context": "rest"}).context == "rest"


def test_stream_context_is_what_came_before(dataset: Dataset) -> None:
    w = cut_windows(dataset, WindowSpec(context="stream"), dataset.gestures.subset(["Wave", "Shake"]))
    assert sorted(w.integers[w.context == "stream", 0, -1].tolist()) == [519], "the one with a past of its own"
    ana = w.take(np.flatnonzero(np.isin(w.context, ["stream", "inside"]) & (w.window_rows[:, 0] >= 0)))
    assert sorted(ana.integers[:, 0, -1].tolist()) == [519, 949, 999, 1049, 1099]
    assert np.all(np.diff(ana.integers[:, 0], axis=1) == 1)
    assert np.all(ana.window_rows[:, 1] - ana.window_rows[:, 0] == 250)
    at = ana.window_rows[np.argmin(ana.integers[:, 0, -1])]
    assert at.tolist() == [270, 520], "the raw rows of the stream that the window touches"
    assert ana.recording_rows[np.argmin(ana.integers[:, 0, -1])].tolist() == [400, 520]


def test_too_little_past_or_a_gap_falls_back_to_a_marked_loop(dataset: Dataset) -> None:
    w = cut_windows(dataset, WindowSpec(context="stream"), dataset.gestures.subset(["Shake"]))
    assert sorted(w.context.tolist()) == ["loop", "loop"], "row 100 has no past of 250; row 1550 has a gap in it"
    assert sorted(w.integers[:, 0, 0].tolist()) == [100, 1550]


def test_without_a_stream_the_default_is_rest(dataset: Dataset) -> None:
    w, held = (
        cut_windows(dataset, WindowSpec(context=context), dataset.gestures.subset(["Wave"]))
        for context in ("stream", "rest")
    )
    assert w.context[w.subject == "ben"].tolist() == ["rest"]
    assert np.array_equal(w.integers[w.subject == "ben"], held.integers[held.subject == "ben"])


def test_a_longer_span_reaches_further_back(dataset: Dataset) -> None:
    w = cut_windows(dataset, WindowSpec(context="stream", span_s=4.99), dataset.gestures.subset(["Wave"]))
    real = w.take(np.flatnonzero(w.context == "stream"))
    assert w.integers.shape[2] == 499
    assert "inside" not in w.context, "410 rows do not fill 499"
    assert real.integers[:, 0, -1].tolist() == [519, 949, 999, 1049, 1099]
    assert real.integers[0, 0, 0] == 519 - 498


def test_trimmed_and_excluded_recordings(dataset: Dataset) -> None:
    wave = next(r for r in dataset.recordings if r.gesture == "Wave" and r.rows == 120)
    long = next(r for r in dataset.recordings if r.rows == 410)
    append_marks(
        dataset.path,
        [Mark(wave.id, "trim", "test", "late", 20, 100), Mark(long.id, "exclude", "test", "noise")],
    )
    w = cut_windows(open_dataset(dataset.path), WindowSpec(), dataset.gestures.subset(["Wave"]))
    assert w.integers[w.context == "stream", 0, -1].tolist() == [499]
    assert open_dataset(dataset.path).hash != dataset.hash


def test_shared_gestures_and_why_not_the_others(dataset: Dataset) -> None:
    kept, left_out = shared_gestures(dataset)
    assert kept.labels == ("Wave",)
    assert left_out == {
        "Custom": "free choice: everybody did something else",
        "Shake": "made by 1 of 2 people",
    }
    assert shared_gestures(dataset, share=0.5)[0].labels == ("Shake", "Wave")
    maker = next(r.subject for r in dataset.recordings if r.gesture == "Shake")
    others = [r.id for r in dataset.recordings if r.subject != maker]
    append_marks(dataset.path, [Mark(recording, "exclude", "test", "not of this study") for recording in others])
    kept, left_out = shared_gestures(open_dataset(dataset.path))
    assert kept.labels == ("Shake", "Wave"), "who is excluded does not count"
    waves = [r.id for r in dataset.recordings if r.gesture == "Wave"]
    append_marks(dataset.path, [Mark(recording, "exclude", "test", "not of this study") for recording in waves])
    kept, left_out = shared_gestures(open_dataset(dataset.path))
    assert kept.labels == ("Shake",) and left_out["Wave"] == "no recording"


def test_bad_settings_are_refused(dataset: Dataset) -> None:
    with pytest.raises(ConfigError, match=r"Unknown context 'streem'.*Did you mean 'stream'"):
        WindowSpec(context="streem")
    with pytest.raises(ConfigError, match="out of range"):
        WindowSpec(window_s=0)
    with pytest.raises(DatasetError, match="no window"):
        cut_windows(dataset, WindowSpec(), GestureSet.infer(["Other"]))


def test_a_recording_nobody_stopped_is_left_out_and_named(dataset: Dataset, tmp_path: Path) -> None:
    for n in range(3):
        write_recording(tmp_path / "src" / "ben" / f"Wave_9{n}_110.csv", ramp(10 * n, 110), ACCEL)
    write_recording(tmp_path / "src" / "ben" / "Wave_99_3000.csv", ramp(5000, 3000), ACCEL)
    longer = import_recordings(tmp_path / "src", tmp_path / "DS2", layout=ACCEL).dataset
    waves = longer.gestures.subset(["Wave"])
    w = cut_windows(longer, WindowSpec(context="loop"), waves)
    assert w.left_out == ("ben/Wave_99_3000: 3000 rows where Wave usually has 110",)
    assert w.integers[:, 0].max() < 5000
    everything = cut_windows(longer, WindowSpec(context="loop", longest_factor=0), waves)
    assert everything.left_out == ()
    assert len(everything) == len(w) + 56


def test_vectors_are_found_among_the_inputs(dataset: Dataset) -> None:
    everything = cut_windows(dataset)
    assert everything.vectors == ((0, 1, 2),)
    assert "Custom" in dataset.gestures.labels
    assert everything.labels == ("Shake", "Wave"), "free choice is left out, as by train and evaluate"
    assert everything.left_out[0].startswith("Custom: free choice")


def test_a_recording_with_a_gap_keeps_the_full_windows_before_it(dataset: Dataset, tmp_path: Path) -> None:
    from plushsense.core.recorder_csv import read_stream

    stream = read_stream(dataset.path / dataset.streams[0].file, ACCEL).frames
    part = stream.slice(1150, 1801)  # row 1500, the first after the gap, is left out
    write_recording(tmp_path / "src" / "ana" / "Shake_77_651.csv", part, ACCEL)
    again = import_recordings(tmp_path / "src", tmp_path / "DS2", layout=ACCEL).dataset
    w = cut_windows(again, WindowSpec(longest_factor=0), again.gestures.subset(["Shake"]))
    mine = w.take(np.flatnonzero(w.recording == w.recording_ids.index("ana/Shake_77_651")))
    assert mine.integers[:, 0, 0].tolist() == [1150, 1200, 1250, 1501, 1551]
    assert set(mine.context) == {"inside"}


def test_settings_of_whole_recordings_come_from_a_bundle() -> None:
    assert WindowSpec(longest_factor=1.0, window_s=60.0, step_s=60.0).longest_factor == 1.0
    for wrong in ({"longest_factor": 0.5}, {"window_s": 60.1}, {"step_s": 0.0}, {"step_s": 61.0}):
        with pytest.raises(ConfigError, match="accepted are 0|out of range"):
            WindowSpec(**wrong)
    bundled = {"window_s": 1.5, "step_s": 0.25, "context": "anywhere", "every_s": 0.1}
    assert whole_gestures(bundled) == WindowSpec(1.5, 0.25, "stream")
    assert whole_gestures({"context": "loop", "span_s": 3.0}) == WindowSpec(context="loop", span_s=3.0)


def test_sets_of_windows_are_cut_down_to_some_inputs(dataset: Dataset) -> None:
    waves = cut_windows(dataset, WindowSpec(context="loop"), dataset.gestures.subset(["Wave", "Shake"]))
    n = len(waves)
    turned = waves.only(["z", "x", "y"])
    assert turned.inputs == ("z", "x", "y") and turned.vectors == ((1, 2, 0),)
    assert np.array_equal(turned.integers, waves.integers[:, [2, 0, 1]])
    assert waves.only(["y"]).vectors == () and waves.only(["y"]).integers.shape == (n, 1, 250)
    assert repr(waves) == (
        f"WindowSet({n} windows of 3 channels × 250 samples at 100 Hz, 5 recordings, 2 classes; 4 inside, 4 loop)"
    )
    with pytest.raises(ConfigError, match="cut_anywhere"):
        cut_windows(dataset, WindowSpec(context="anywhere"))


def test_progress_counts_the_recordings_and_one_without_a_valid_sample_is_named(
    dataset: Dataset, tmp_path: Path
) -> None:
    bad = ramp(0, 100)
    write_recording(tmp_path / "src" / "ben" / "Wave_77_100.csv", replace(bad, values=bad.values + 40_000), ACCEL)
    again = import_recordings(tmp_path / "src", tmp_path / "DS2", layout=ACCEL).dataset
    seen: list[tuple[int, int]] = []
    w = cut_windows(again, WindowSpec(), again.gestures.subset(["Wave"]), lambda *done: seen.append(done))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert w.left_out == ("ben/Wave_77_100: no valid sample",)


def test_how_long_a_recording_is_counts_after_trimming(dataset: Dataset, tmp_path: Path) -> None:
    for n in range(3):
        write_recording(tmp_path / "src" / "ben" / f"Wave_9{n}_110.csv", ramp(10 * n, 110), ACCEL)
    write_recording(tmp_path / "src" / "ben" / "Wave_99_3000.csv", ramp(5000, 3000), ACCEL)
    longer = import_recordings(tmp_path / "src", tmp_path / "DS2", layout=ACCEL).dataset
    append_marks(longer.path, [Mark("ben/Wave_99_3000", "trim", "test", "late", 2800, 2910)])
    longer = open_dataset(longer.path)
    assert len(recordings_in_time(list(longer.used))) == len(longer.used)
    w = cut_windows(longer, WindowSpec(context="loop"), longer.gestures.subset(["Wave"]))
    assert w.left_out == () and 7800 in w.integers[:, 0, 0]


def test_windows_that_are_constant_in_time_are_named(dataset: Dataset, tmp_path: Path) -> None:
    assert constant_windows(cut_windows(dataset)) is None
    (tmp_path / "src" / "cat").mkdir()
    still = Frames(np.tile([5, 6, 7], (120, 1)), np.arange(120) * 10)
    write_recording(tmp_path / "src" / "cat" / recording_filename("Wave", 7, 120), still, ACCEL)
    windows = cut_windows(import_recordings(tmp_path / "src", tmp_path / "DS", layout=ACCEL, add_to=True).dataset)
    note = constant_windows(windows)
    assert note is not None and note.startswith(
        f"1 of {len(windows)} windows are constant in time, for instance of cat/"
    )
