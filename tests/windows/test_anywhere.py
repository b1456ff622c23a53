"""Windows anywhere in a made-up stream, whose x is the row's number: what each position is called, and why."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_windows
from plushsense.scoring.splits import parse_split
from plushsense.windows.anywhere import AnywhereSpec, add_idle_gesture, cut_anywhere
from plushsense.windows.cut import WindowSet, WindowSpec, cut_windows

ACCEL = load_layout("accel-3")
EVERY = AnywhereSpec(every_s=0.01, onset_s=0.3, after_s=0.2, settle_s=1.0, idle_share=0.99, busy_share=0.0)
SPEC = WindowSpec(window_s=1.0, context="anywhere", longest_factor=0.0)


def ramp(start: int, rows: int) -> Frames:
    """Frames at 100 Hz whose x is the row's number."""
    row = np.arange(start, start + rows, dtype=np.int64)
    return Frames(np.stack([row, row * 0 + 1, row * 0 - 1], axis=1), row * 10, 1_000_000 + row * 10)


def person(
    folder: Path, recordings: dict[tuple[int, int], str], rows: int = 2000, stream: Frames | None = None
) -> None:
    """A person's folder: the stream, and (first row, rows) of it as recordings."""
    folder.mkdir(parents=True)
    stream = stream or ramp(0, rows)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    for (first, length), label in recordings.items():
        part = stream.slice(first, first + length)
        assert part.host_ms is not None
        write_recording(folder / recording_filename(label, int(part.host_ms[-1]), length), part, ACCEL)


def made(tmp_path: Path, *labels: Gesture) -> Dataset:
    gestures = GestureSet("made up", labels or (Gesture("Wave"), Gesture("Shake"), Gesture("Still", idle=True)))
    return import_recordings(tmp_path / "src", tmp_path / "DS", layout=ACCEL, gestures=gestures).dataset


def newest(windows: WindowSet, label: str) -> list[int]:
    """The newest rows of the windows of a class, ascending."""
    return sorted(windows.integers[windows.y == windows.labels.index(label), 0, -1].tolist())


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave", (1000, 100): "Shake", (1500, 150): "Still"})
    return made(tmp_path)


def test_each_position_is_called_what_its_newest_sample_lies_in(dataset: Dataset) -> None:
    w = cut_anywhere(dataset, SPEC, dataset.gestures, EVERY)
    assert newest(w, "Wave") == list(range(529, 720)), "30 samples heard, to 20 after the last one, 699"
    assert newest(w, "Shake") == list(range(1029, 1120))
    idle = newest(w, "Still")
    resting = range(1529, 1670)
    assert [row for row in idle if row in resting] == list(resting)
    outside = [row for row in idle if row not in resting]
    assert outside == [*range(99, 500), *range(800, 1000), *range(1200, 1500), *range(1750, 2000)]
    assert set(w.context) == {"anywhere"}
    assert np.all(np.diff(w.integers[:, 0], axis=1) == 1), "what really came before"
    assert np.all(w.window_rows[:, 1] - 1 == w.integers[:, 0, -1])
    assert np.all(w.window_rows[:, 0] == w.integers[:, 0, 0])


def test_trimmed_excluded_and_foreign_recordings(dataset: Dataset) -> None:
    wave, shake = (next(r for r in dataset.recordings if r.gesture == g) for g in ("Wave", "Shake"))
    append_marks(
        dataset.path, [Mark(wave.id, "trim", "test", "late", 50, 150), Mark(shake.id, "exclude", "test", "noise")]
    )
    again = open_dataset(dataset.path)
    w = cut_anywhere(again, SPEC, again.gestures, EVERY)
    assert newest(w, "Wave") == list(range(579, 670))
    idle = newest(w, "Still")
    assert set(range(500, 550)) <= set(idle), "before its onset nothing happens yet"
    assert not set(idle) & set(range(550, 750))
    assert not set(idle) & set(range(1000, 1200)), "an excluded recording is not idleness"
    assert newest(w, "Shake") == []
    others = cut_anywhere(dataset, SPEC, dataset.gestures.subset(["Shake", "Still"]), EVERY)
    assert not set(newest(others, "Still")) & set(range(500, 800)), "nor is a gesture that is no class"


def test_where_two_recordings_claim_a_position_it_is_nobodys(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave", (650, 200): "Shake"})
    data = made(tmp_path)
    w = cut_anywhere(data, SPEC, data.gestures, EVERY)
    assert newest(w, "Wave") == list(range(529, 650))
    assert newest(w, "Shake") == list(range(700, 870)), "30 samples are heard at 679, but Wave ends at 699"


def test_idle_share_and_even_distances(dataset: Dataset) -> None:
    for share in (0.0, 0.2, 0.5):
        w = cut_anywhere(dataset, SPEC, dataset.gestures, replace(EVERY, every_s=0.05, idle_share=share))
        assert np.mean(w.y == 2) == pytest.approx(share, abs=0.01 if share else 0.0)
    outside = [row for row in newest(w, "Still") if not 1529 <= row < 1670]
    assert min(outside) < 150 and max(outside) > 1800, "from all over the stream"


def test_the_liveliest_unmarked_stretches_are_left_out(tmp_path: Path) -> None:
    still = ramp(0, 3000)
    values = still.values.copy()
    values[1500:1800, 1] = 1 + 500 * (np.arange(300) // 7 % 2)  # somebody practises
    person(tmp_path / "src" / "ana", {(500, 200): "Wave"}, stream=Frames(values, still.device_ms, still.host_ms))
    data = made(tmp_path)
    kept = newest(cut_anywhere(data, SPEC, data.gestures, replace(EVERY, busy_share=0.2)), "Still")
    everything = newest(cut_anywhere(data, SPEC, data.gestures, EVERY), "Still")
    assert set(range(1510, 1890)) <= set(everything)
    assert not set(range(1510, 1890)) & set(kept)
    assert len(kept) == pytest.approx(0.8 * len(everything), abs=1)


def test_labels_say_what_is_idle_and_what_is_practice(tmp_path: Path) -> None:
    still = ramp(0, 3000)
    values = still.values.copy()
    values[1500:1800, 1] = 1 + 500 * (np.arange(300) // 7 % 2)  # the toy is picked up
    person(tmp_path / "src" / "ana", {(500, 200): "Wave"}, stream=Frames(values, still.device_ms, still.host_ms))
    data = made(tmp_path)
    stream = data.streams[0].id
    marks = [
        Mark(stream, "label", "x", start=1500, stop=1900, label="handling"),
        Mark(stream, "label", "x", start=2200, stop=2500, label="practice:Wave"),
        Mark(stream, "label", "x", start=2550, stop=2700, label="rest"),
        Mark(stream, "label", "x", start=450, stop=500, label="practice:Wave"),
    ]
    append_marks(data.path, marks)
    labelled = open_dataset(data.path)
    w = cut_anywhere(labelled, SPEC, labelled.gestures, EVERY)
    assert newest(w, "Wave") == list(range(529, 720)), "practice just before a recording takes nothing away from it"
    idle = newest(w, "Still")
    assert idle == [*range(99, 450), *range(800, 2200), *range(2600, 3000)], "practice settles, too"
    # The share that is left out concerns only what has no label.
    kept = newest(cut_anywhere(labelled, SPEC, labelled.gestures, replace(EVERY, busy_share=1.0)), "Still")
    assert kept == [*range(1500, 1900), *range(2600, 2700)]
    plain = data.without_stretches()
    assert set(range(2200, 2600)) <= set(newest(cut_anywhere(plain, SPEC, plain.gestures, EVERY), "Still"))


def test_no_window_reaches_over_a_break_of_the_clock(tmp_path: Path) -> None:
    stream = ramp(0, 2000)
    clock = stream.device_ms + np.where(np.arange(2000) >= 1200, 500, 0)
    person(tmp_path / "src" / "ana", {(500, 200): "Wave"}, stream=Frames(stream.values, clock, stream.host_ms))
    data = made(tmp_path)
    w = cut_anywhere(data, SPEC, data.gestures, EVERY)
    assert np.all(np.diff(w.integers[:, 0], axis=1) == 1)
    assert not set(newest(w, "Still")) & set(range(1200, 1299))


def test_without_a_stream_recordings_are_cut_as_ever_and_marked(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave", (10, 60): "Shake"})
    ben = tmp_path / "src" / "ben"
    ben.mkdir()
    write_recording(ben / recording_filename("Wave", 5, 80), ramp(0, 80), ACCEL)
    data = made(tmp_path)
    w = cut_anywhere(data, SPEC, data.gestures, EVERY)
    assert set(w.context[w.subject == "ben"]) == {"rest"}
    assert w.context[w.y == 1].tolist() == ["loop"], "row 10 has no second of past"


def test_a_session_with_a_recording_nobody_located_gives_no_idleness(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave"})
    odd = replace_clock(ramp(70_000, 90))
    write_recording(tmp_path / "src" / "ana" / recording_filename("Shake", 9, 90), odd, ACCEL)
    data = made(tmp_path)
    assert sorted(r.stream_row for r in data.recordings) == [-1, 500]
    assert newest(cut_anywhere(data, SPEC, data.gestures, EVERY), "Still") == []


def test_a_stream_of_which_every_recording_is_left_out_is_left_out(tmp_path: Path) -> None:
    for name in ("ana", "bob"):
        person(tmp_path / "src" / name, {(500, 200): "Wave"})
    data = made(tmp_path)
    assert set(cut_anywhere(data, SPEC, data.gestures, EVERY).subject) == {"ana", "bob"}
    append_marks(data.path, [Mark(next(r.id for r in data.recordings if r.subject == "bob"), "exclude", "test", "no")])
    again = open_dataset(data.path)
    assert set(cut_anywhere(again, SPEC, again.gestures, EVERY).subject) == {"ana"}


def test_a_recording_with_which_the_stream_begins_has_its_place(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(0, 200): "Wave"}, rows=500)
    data = made(tmp_path)
    assert [r.stream_row for r in data.recordings] == [0]
    assert newest(cut_anywhere(data, SPEC, data.gestures, EVERY), "Still") == list(range(300, 500))


def replace_clock(frames: Frames) -> Frames:
    """The same at another time."""
    return Frames(frames.values, frames.device_ms + 5_000_000, frames.host_ms)


def test_a_class_for_idleness_is_added_where_there_is_none(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave", (1000, 100): "Shake"})
    plain = made(tmp_path, Gesture("Wave"), Gesture("Shake"))
    assert add_idle_gesture(plain.gestures, plain).gestures[2] == Gesture(
        "Idle", "none", nobody=True, idle=True, description="Nothing happens to the toy"
    )
    w = cut_anywhere(plain, SPEC, add_idle_gesture(plain.gestures, plain), EVERY)
    assert len(newest(w, "Idle")) > 500
    assert set(w.subject) == {"ana"}
    unmarked = w.recording == w.recording_ids.index("ana/fulldatastream (unmarked)")
    assert unmarked.sum() > 500 and np.all(w.recording_rows[unmarked] == 0), "no rows, so that it overlaps no other"
    assert set(cut_anywhere(plain, SPEC, plain.gestures, EVERY).y) == {0, 1}, "no class, no idleness"


def test_the_data_sets_own_idle_gesture_is_taken(dataset: Dataset) -> None:
    wanted = add_idle_gesture(dataset.gestures.subset(["Wave", "Shake"]), dataset)
    assert wanted.labels == ("Wave", "Shake", "Still")
    assert add_idle_gesture(wanted, dataset) == wanted


def test_a_gesture_called_idle_that_is_not_is_refused(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave", (1000, 100): "Idle"})
    data = made(tmp_path, Gesture("Wave"), Gesture("Idle"))
    with pytest.raises(DatasetError, match="not marked as idle"):
        add_idle_gesture(data.gestures, data)


@pytest.mark.slow
def test_no_split_lets_a_training_window_touch_what_is_tested(tmp_path: Path) -> None:
    for who in ("ana", "ben", "cleo", "dora"):
        person(tmp_path / "src" / who, {(500, 200): "Wave", (900, 100): "Shake", (1300, 100): "Wave"})
    data = made(tmp_path)
    train = cut_anywhere(data, SPEC, data.gestures, replace(EVERY, every_s=0.1))
    score = cut_windows(data, replace(SPEC, context="stream"), data.gestures)
    for fold in fold_windows(train, score, parse_split("leave-one-subject-out")):
        learnt = np.union1d(fold.train, fold.validation)
        assert not set(train.subject[learnt]) & set(score.subject[fold.test])
        assert set(train.y[fold.train]) == {0, 1, 2}
    for fold in fold_windows(train, score, parse_split("by-recording:3")):
        learnt = np.union1d(fold.train, fold.validation)
        for one in fold.test:
            first, last = score.recording_rows[one]
            rows = train.window_rows[learnt][train.stream[learnt] == score.stream[one]]
            assert np.all((rows[:, 1] <= first) | (rows[:, 0] >= last))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"idle_share": 1.0}, "not including, 1"),
        ({"busy_share": 1.2}, "busy_share is 1.2"),
        ({"every_s": 0.0}, "every_s is 0.0"),
        ({"onset_s": -0.1}, "onset_s is -0.1"),
        ({"after_s": 2.0}, "must not be below after_s"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        AnywhereSpec(**settings)


def test_cut_windows_says_who_cuts_these(dataset: Dataset) -> None:
    with pytest.raises(ConfigError, match="cut_anywhere"):
        cut_windows(dataset, SPEC)


def test_settings_at_the_ends_of_their_range() -> None:
    ends = {"every_s": (0.01, 60.0), "onset_s": (0.0, 60.0), "after_s": (0.0, 1.0), "settle_s": (0.2, 60.0)}
    shares = {"idle_share": (0.0, 0.99), "busy_share": (0.0, 1.0)}
    for name, (low, high) in (ends | shares).items():
        for value in (low, high):
            assert getattr(AnywhereSpec(**{name: value}), name) == value
        wrong = (-0.01, 1.01 if name.endswith("_share") else 60.01)
        for value in wrong:
            with pytest.raises(ConfigError, match=f"{name} is .*accepted is 0 to (1|60)[.]"):
                AnywhereSpec(**{name: value})
    with pytest.raises(ConfigError, match="every_s is 0"):
        AnywhereSpec(every_s=0.0)
    with pytest.raises(ConfigError, match="idle_share is 1: accepted is 0 up to, not including, 1"):
        AnywhereSpec(idle_share=1.0)
    assert AnywhereSpec(after_s=0.5, settle_s=0.5).settle_s == 0.5
    with pytest.raises(ConfigError, match="settle_s must not be below after_s"):
        AnywhereSpec(after_s=0.5, settle_s=0.4)


def test_what_gives_no_window_is_named_and_streams_are_counted(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(500, 200): "Wave"})
    ben = tmp_path / "src" / "ben"
    ben.mkdir()
    bad = ramp(0, 80)
    write_recording(ben / "Shake_5_80.csv", replace(bad, values=bad.values + 40_000), ACCEL)
    data = made(tmp_path)
    seen: list[tuple[int, int]] = []
    w = cut_anywhere(data, SPEC, data.gestures, EVERY, lambda *done: seen.append(done))
    assert seen == [(1, 1)] and w.left_out == ("ben/Shake_5_80: no valid sample",)
    with pytest.raises(DatasetError, match="gives no window: 1 recording of 1 gesture."):
        cut_anywhere(data, SPEC, data.gestures.subset(["Shake"]), EVERY)
    alone = made_alone(tmp_path / "alone")
    assert add_idle_gesture(alone.gestures, alone) == alone.gestures, "without a stream nothing is known to be idle"


def made_alone(folder: Path) -> Dataset:
    """One recording, and no stream."""
    (folder / "src" / "ben").mkdir(parents=True)
    write_recording(folder / "src" / "ben" / "Wave_5_80.csv", ramp(0, 80), ACCEL)
    return made(folder, Gesture("Wave"))


def test_a_stream_of_just_one_window_gives_it(tmp_path: Path) -> None:
    person(tmp_path / "src" / "ana", {(20, 80): "Wave"}, rows=100)
    data = made(tmp_path)
    w = cut_anywhere(data, SPEC, data.gestures, EVERY)
    assert w.context.tolist() == ["anywhere"] and w.integers[0, 0].tolist() == [*range(100)]
