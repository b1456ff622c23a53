"""Sensor limits from people's touch: nobody's own is a fault, and what no touch does is."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.runtime.health import Health, HealthSettings
from plushsense.tuning.decisions import _longest_still, fit_health

ACCEL = load_layout("accel-3")


def stream(values):
    clock = np.arange(len(values), dtype=np.int64) * 10 + 1000
    return Frames(np.asarray(values, dtype=np.int64), clock, clock + 1_700_000_000_000)


def touched(seed=0, rows=4000):
    return np.random.default_rng(seed).normal(0, 1000, (rows, 3)).round()


@pytest.fixture
def made(tmp_path):
    """A data set of streams, one a person."""

    def make(*streams):
        for i, values in enumerate(streams):
            folder = tmp_path / "src" / f"P{i + 1}"
            folder.mkdir(parents=True)
            frames = stream(values)
            (folder / "fulldatastream.csv").write_text(format_rows(frames, ACCEL))
            write_recording(folder / f"tap_{int(frames.host_ms[249])}_200.csv", frames.slice(50, 250), ACCEL)
        return import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3", adopt_proposals=False).dataset

    return make


def faults(settings, values):
    health, frames = Health(settings, ACCEL), stream(values)
    for ms, row in zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        health.push(ms, row)
    return health.faults


def test_limits_are_a_tenth_beyond_what_those_people_only_showed(made):
    mine, other = touched(0), touched(1) * 5
    fit = fit_health(made(mine, other), ["P1"])
    low, high = mine.min(axis=0), mine.max(axis=0)
    margin = np.ceil(0.1 * (high - low)).astype(int)
    assert fit.settings.low == tuple(low - margin)
    assert fit.settings.high == tuple(high + margin)
    assert fit.widened == ()
    assert fit.frames == 4000
    assert fit.seconds == pytest.approx(39.99)


def test_a_sensor_stuck_beyond_them_is_a_fault_and_peoples_own_end_stop_is_none(made):
    plain = touched(0)
    hung = touched(2, 500)
    hung[100:200, 1] = 30_000
    assert faults(fit_health(made(plain), ["P1"]).settings, hung) == 1
    assert faults(HealthSettings(), hung) == 0


def test_where_people_touch_the_end_stop_only_staying_there_is_wrong(made):
    reaching = touched(0)
    reaching[1000, 1] = 32_767
    fit = fit_health(made(reaching), ["P1"])
    assert fit.settings.high[1] == 32_766
    assert fit.widened == ()
    assert faults(fit.settings, reaching) == 0
    hung = touched(2, 500)
    hung[100:200, 1] = 32_767
    assert faults(fit.settings, hung) == 1


@pytest.mark.slow
def test_an_end_stop_that_people_reach_is_believed(made):
    reaching = touched(0, 40_000)
    reaching[5000:5030, 1] = 30_000  # 0.3 s, more than half of what makes a fault; too rare for the quantile
    fit = fit_health(made(reaching), ["P1"])
    assert fit.widened == (ACCEL.names[1],)
    assert fit.settings.high[1] == 30_000
    hung = touched(2, 500)
    hung[100:200, 1] = 30_000
    assert faults(fit.settings, hung) == 0
    assert faults(fit.settings, reaching) == 0


@pytest.mark.parametrize(("rows", "still_ms"), [(10, 500), (40, 1600), (50, 0)])
def test_stillness_is_four_times_what_was_seen_at_least_half_a_second_and_off_for_quiet_sensors(made, rows, still_ms):
    held = touched(0)
    held[1000 : 1000 + rows + 1] = held[1000]
    fit = fit_health(made(held), ["P1"])
    assert fit.still_ms == rows * 10
    assert fit.settings.still_ms == still_ms
    assert faults(fit.settings, held) == 0


@pytest.mark.parametrize(("people", "rows", "still_ms"), [(1, 100, 4000), (2, 100, 0), (1, 300, 0)])
def test_a_sensor_that_hung_with_one_of_many_people_is_not_quiet(made, people, rows, still_ms):
    streams = [touched(seed, 400) for seed in range(10)]
    for held in streams[:people]:
        held[50 : 50 + rows + 1] = held[50]
    assert fit_health(made(*streams), [f"P{n + 1}" for n in range(10)]).settings.still_ms == still_ms


def test_repeats_over_a_gap_are_no_stillness():
    values = touched(0, 300)
    values[100:200] = values[100]
    frames = stream(values)
    frames.device_ms[150:] += 5000
    assert _longest_still(frames, ACCEL.gap_ms) == 490


def test_nobody_leaves_the_plan_as_it_is(made):
    fit = fit_health(made(touched(0)), [], HealthSettings(fault_ms=700))
    assert fit.settings == HealthSettings(fault_ms=700)
    assert fit.frames == 0
