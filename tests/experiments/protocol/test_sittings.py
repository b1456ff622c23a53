"""What the protocol is run on: virtual strangers and recorded sessions, each trial where it really was."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, Frames
from plushsense.dataset.importing.importers import import_recordings
from plushsense.experiments.protocol.sittings import (
    recorded_people,
    recorded_sittings,
    virtual_numbers,
    virtual_sittings,
)
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.machine import FrameReader
from plushsense.windows.clock import row_times_us

PLUSH = load_layout("plush-15")
SET = load_gestures("plush-18")
LABELS = ("Back stroke 2", "Tail hit 1", "Tail hit 2", "Tail pull")


def sitting(**options):
    return virtual_sittings([1001], 3, 3, PLUSH, gestures=LABELS, **options)[0].play()


def test_a_virtual_sitting_is_the_same_each_time_and_another_for_each_person_and_seed():
    one, same = sitting(), sitting()
    assert np.array_equal(one.frames.values, same.frames.values)
    assert one.trials == same.trials
    other = virtual_sittings([1002], 3, 3, PLUSH, gestures=LABELS)[0].play()
    seeded = virtual_sittings([1001], 4, 3, PLUSH, gestures=LABELS)[0].play()
    assert len({len(s.frames) for s in (one, other, seeded)}) == 3
    assert [(t.label, t.repetition) for t in one.trials] == [(label, n) for label in LABELS for n in (1, 2, 3)]
    assert sum(np.diff(one.frames.device_ms) > 15), "lines are lost as over the air"


def test_a_blow_is_there_to_feel_at_its_onset_and_not_before():
    """On the quiet table: in its first 0.1 s the accelerometer moves far more than in all the waiting before."""
    one = sitting()
    times = row_times_us(one.frames, PLUSH) / 1e6
    acc = one.frames.values[:, [PLUSH.index(n) for n in ("acc_x", "acc_y", "acc_z")]]
    jerk = np.concatenate(([0], np.abs(np.diff(acc, axis=0)).sum(axis=1)))
    for trial in one.trials:
        assert trial.start_s <= trial.onset_s < trial.stop_s
        assert (trial.onset_s > trial.start_s + 0.1) == (not trial.label.startswith("Back"))
        if trial.label == "Tail hit 1":
            before = jerk[(times > trial.start_s - 2.0) & (times < trial.onset_s - 0.02)].max()
            blow = jerk[(times >= trial.onset_s) & (times < trial.onset_s + 0.1)].max()
            assert blow > 3 * before


@pytest.mark.parametrize(
    ("people", "first", "said"),
    [
        (5, 1, "Virtual person 1 is one of the 3 .* --first 13"),
        (3, 10, "Virtual person 12 "),
        (0, 1001, "people is 0"),
        (5, 0, "first is 0"),
    ],
)
def test_people_whom_the_network_met_are_refused(people, first, said):
    made = {"simulated": True, "subjects": ["P01", "P02", "none"], "validation_subjects": ["P12"]}
    with pytest.raises(ConfigError, match=said):
        virtual_numbers(people, first, made)


def test_strangers_are_not_and_real_people_have_no_virtual_numbers():
    made = {"simulated": True, "subjects": ["P01", "P02", "none"], "validation_subjects": ["P12"]}
    assert virtual_numbers(2, 3, made) == [3, 4]
    assert virtual_numbers(2, 1001, made) == [1001, 1002]
    assert virtual_numbers(2, 1, {"simulated": False, "subjects": ["P01"]}) == [1, 2]
    assert virtual_numbers(1, 1, {}) == [1]


def test_rows_have_the_times_that_a_live_reader_counts_over_gaps_and_clock_resets():
    layout = load_layout("accel-3")
    draw = np.random.default_rng(0)
    steps = draw.integers(7, 14, 200)
    steps[50], steps[90] = 100, 3000
    ms = 5_000 + np.cumsum(steps)
    ms[150:] -= ms[150] - 7
    frames = Frames(draw.integers(-50, 50, (200, 3)).astype(np.int64), ms.astype(np.int64))
    reader = FrameReader(layout, HealthSettings(fault_ms=0))
    live = []
    for now, values in zip(frames.device_ms, frames.values, strict=True):
        list(reader.push(int(now), values.tolist()))
        live.append(reader.time_us / 1e6)
    live[90], live[150] = live[91], live[151]  # left out
    np.testing.assert_allclose(row_times_us(frames, layout) / 1e6, live, atol=1e-9)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three virtual people as files; the second has no session stream, the third another one's."""
    work = tmp_path_factory.mktemp("recorded")
    raw = work / "raw"
    simulate(raw, SimulationSpec(people=3, seed=5, repetitions=2, at_rest=2, gestures=("Back stroke 1", "Tail hit 1")))
    (raw / "P02" / STREAM_NAME).unlink()
    shutil.copy(raw / "P01" / STREAM_NAME, raw / "P03" / STREAM_NAME)
    return import_recordings(raw, work / "ds", layout="plush-15", name="sessions").dataset


def test_recorded_trials_lie_where_the_recordings_are_in_the_stream(recorded):
    sittings, left = recorded_sittings(recorded, ["P01", "P02", "P03"], SET)
    assert [s.who for s in sittings] == ["P01"]
    assert [(e.who, e.why.partition(",")[0]) for e in left] == [
        ("P02", "has no session stream"),
        ("P03", "has a session stream"),
    ]
    one = sittings[0]
    assert [(t.label, t.repetition) for t in one.trials] == [
        ("Back stroke 1", 1), ("Back stroke 1", 2), ("Tail hit 1", 1), ("Tail hit 1", 2),
    ]  # fmt: skip
    times = row_times_us(one.frames, PLUSH) / 1e6
    for trial, info in zip(
        one.trials, sorted((r for r in recorded.used if r.subject == "P01"), key=lambda r: r.start_ms), strict=True
    ):
        rows = recorded.read(info)
        at = int(np.searchsorted(times, trial.start_s - 1e-6))
        assert one.frames.device_ms[at] == rows.device_ms[0]
        assert trial.onset_s == trial.start_s
        assert trial.stop_s - trial.start_s == pytest.approx((rows.device_ms[-1] - rows.device_ms[0]) / 1000)


def test_nobody_with_a_stream_is_refused_with_the_reason(recorded):
    with pytest.raises(DatasetError, match="'P02' has no session stream"):
        recorded_sittings(recorded, ["P02"], SET)


def test_only_people_whom_the_network_never_met(recorded):
    met = {"dataset": "sessions", "subjects": ["P01", "none"], "validation_subjects": ["P02"]}
    assert recorded_people(recorded, None, met) == ["P03"]
    with pytest.raises(ConfigError, match="'P01' is among the people"):
        recorded_people(recorded, ["P03", "P01"], met)
    with pytest.raises(ConfigError, match="There is no 'P4'"):
        recorded_people(recorded, ["P4"], met)
    with pytest.raises(ConfigError, match="everybody"):
        recorded_people(recorded, None, met | {"subjects": ["P01", "P03"]})
    # The same codes in another data set are other people.
    assert recorded_people(recorded, ["P01"], met | {"dataset": "elsewhere"}) == ["P01"]
