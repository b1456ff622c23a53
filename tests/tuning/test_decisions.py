"""Decision settings from held-back people: thresholds by hand, and a whole fit on streams and on recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.devices.base import Frame
from plushsense.runtime.classifier import StreamClassifier
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ONE
from plushsense.tuning import decisions
from plushsense.tuning.decisions import (
    LabelledSteps,
    coverage_of,
    fit_decisions,
    known_threshold,
    labelled_steps,
    left_out_coverage,
    marked_streams,
    sure_threshold,
    weights_of,
)
from plushsense.tuning.events import OTHER
from plushsense.windows.clock import row_times_us

pytestmark = pytest.mark.slow

ACCEL = load_layout("accel-3")
TWO = GestureSet("two", (Gesture("a"), Gesture("b", idle=True)))


def labelled(shares, person, recording):
    """Steps of class 0 with these shares."""
    mine = np.array(shares, dtype=np.int64)
    return LabelledSteps(
        np.stack([mine, ONE - mine], axis=1),
        mine * 2,
        np.zeros(len(mine), dtype=np.int64),
        np.array(person),
        np.array(recording),
    )


def test_people_count_alike_and_so_do_the_recordings_of_one():
    steps = labelled([1] * 7, ["a"] * 5 + ["b"] * 2, [1, 1, 1, 2, 2, 3, 3])
    assert weights_of(steps) == pytest.approx([1 / 12] * 3 + [1 / 8] * 2 + [1 / 4] * 2)


@pytest.mark.parametrize(
    ("n", "coverage", "rank"),
    [(19, 0.9, 2), (9, 0.9, 1), (8, 0.9, 1), (99, 0.9, 10), (100, 0.9, 10), (19, 0.5, 10)],
)
def test_the_threshold_is_the_corrected_quantile_of_split_conformal_prediction(n, coverage, rank):
    # The floor(alpha (n + 1))-th smallest share; with too few recordings the smallest there is.
    shares = np.random.default_rng(n).permutation(np.arange(1, n + 1)) * 100
    steps = labelled(shares, ["a"] * n, range(n))
    assert sure_threshold(steps, coverage) * ONE == 100 * rank
    assert known_threshold(steps, TWO, coverage) == 200 * rank / 256
    assert coverage_of(steps, sure_threshold(steps, coverage)) == pytest.approx((n - rank + 1) / n)


def test_coverage_of_the_left_out_uses_the_others_threshold():
    a, b = [100] * 10, [50] * 4 + [200] * 6
    steps = labelled(a + b, ["a"] * 10 + ["b"] * 10, range(20))
    # b's smallest is 50: it covers all of a. a's is 100, which covers 6 of 10 of b.
    assert left_out_coverage(steps, 0.9) == pytest.approx([1.0, 0.6])
    assert left_out_coverage(steps.take(steps.person == "a"), 0.9) == []
    assert known_threshold(steps.take(steps.person == "c"), TWO, 0.9) is None


def test_split_conformal_covers_what_it_states_on_new_people():
    rng = np.random.default_rng(1)
    reached = []
    for _ in range(300):
        draws = (rng.beta(4, 2, (2, 40)) * ONE).astype(int)
        calibration, new = (labelled(row, ["a"] * 40, range(40)) for row in draws)
        reached.append(coverage_of(new, sure_threshold(calibration, 0.9)))
    assert np.mean(reached) == pytest.approx(1 - 4 / 41, abs=0.012)  # rank floor(0.1 * 41) = 4 of 40


def recorded(folder, seed, stream=True):
    """Taps (a wave on one axis) and holds (on another) between stretches of noise; every third is a wag."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    x = rng.normal(0, 60, (6000, 3))
    clock = 1000 + 10 * np.arange(6000)
    clock[3000:] -= 20_000  # the device began anew
    cuts = []
    for i in range(18):
        at, rows, label = 150 + 320 * i, 120 + int(rng.integers(40)), ("tap", "hold", "wag")[i % 3]
        x[at : at + rows, i % 3] += 2500 * np.sin(np.arange(rows) / 4)
        cuts.append((label, at, rows))
    frames = Frames(x.round().astype(np.int64), clock, np.arange(6000) * 10 + 1_700_000_000_000)
    if stream:
        (folder / "fulldatastream.csv").write_text(format_rows(frames, ACCEL))
    for label, at, rows in cuts:
        name = f"{label}_{int(frames.host_ms[at + rows - 1])}_{rows}.csv"
        write_recording(folder / name, frames.slice(at, at + rows), ACCEL)


@pytest.fixture
def made(tmp_path):
    def make(stream=True, people=4):
        for i in range(people):
            recorded(tmp_path / "src" / f"P{i + 1}", i, stream)
        return import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset

    return make


def test_a_fit_on_streams_says_on_what_and_comes_back_from_a_bundle(made, bundle, monkeypatch):
    monkeypatch.setattr(decisions, "COVERAGE", 0.8)  # so few people cannot promise more
    dataset, model = made(), bundle()
    spec = fit_decisions(model, dataset, ["P1", "P2"], training=["P3"])
    fitted = spec.fitted
    assert (fitted["people"], fitted["streams"]) == (2, 2)
    assert fitted["hours"] == pytest.approx(2 * 60 / 3600, abs=0.001)
    assert fitted["gestures"] == 2 * 12  # the network knows no wag
    assert fitted["events"]["cost"] <= fitted["events"]["cost_before"]
    assert fitted["answers"]["coverage"] == 0.8
    assert fitted["health"]["people"] == 3
    heard = marked_streams(model, dataset, ["P1", "P2"], spec)
    steps = labelled_steps(model, heard, spec)
    assert coverage_of(steps, spec.sure) >= 0.8
    assert float((weights_of(steps) * (steps.known >= spec.known_margin * 256)).sum()) >= 0.95
    back = DecideSpec.from_dict(replace(model, decision=spec.to_dict()).decision)
    assert back == spec
    # The same people, the same settings; other people, other ones.
    assert fit_decisions(model, dataset, ["P2", "P1"], training=["P3"]) == spec
    assert fit_decisions(model, dataset, ["P4"], training=["P3"]).sure != spec.sure


def test_settings_that_were_given_stay(made, bundle):
    given = DecideSpec(smoothing_s=0.11, enter=0.77, known_margin=3.0)
    spec = fit_decisions(
        bundle(), made(), ["P1"], spec=given, keep=("smoothing_s", "enter", "known_margin", "health", "gate")
    )
    assert (spec.smoothing_s, spec.enter, spec.known_margin) == (0.11, 0.77, 3.0)
    assert spec.health == given.health
    assert spec.sure != given.sure


def test_without_streams_the_events_keep_their_defaults_and_recordings_set_the_rest(made, bundle):
    plain = DecideSpec()
    spec = fit_decisions(bundle(), made(stream=False), ["P1", "P2"])
    assert spec.fitted["streams"] == 0
    assert "nothing" in spec.fitted["events"]["on"]
    assert (spec.enter, spec.least_s, spec.rest_s) == (plain.enter, plain.least_s, plain.rest_s)
    assert "windows" in spec.fitted["answers"]["on"]
    assert spec.sure != plain.sure and spec.known_margin is not None and spec.health.low


def test_truths_stand_where_the_live_loop_hears_them(made, bundle):
    dataset, model = made(people=1), bundle()
    stream = dataset.streams[0]
    frames = dataset.read_stream(stream.id)
    reader, times = StreamClassifier(model), []
    for ms, values in zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        reader.push(Frame(0, ms, tuple(values)))
        times.append(round(reader.time_s * 1e6))
    times[3000] = times[3001]  # left out, as the clock was reset
    assert row_times_us(frames, ACCEL).tolist() == times
    (heard,) = marked_streams(model, dataset, ["P1"], DecideSpec())
    assert [t.start_us for t in heard.truths] == [times[150 + 320 * i] for i in range(18)]
    labels = ["tap", "hold", "wag"] * 6
    known = {"tap": 0, "hold": 1, "wag": OTHER}
    assert [t.gesture for t in heard.truths] == [known[label] for label in labels]
    steps = labelled_steps(model, [heard], DecideSpec())
    assert set(steps.truth.tolist()) == {0, 1}
    assert len(np.unique(steps.recording)) <= 12


def test_nobody_is_refused(made, bundle):
    with pytest.raises(DatasetError, match="held back"):
        fit_decisions(bundle(), made(people=1), [])
