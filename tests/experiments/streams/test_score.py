"""Whole streams: quick replays are the real ones, truth lies where it was recorded, nobody tunes on those scored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.replay import (
    StreamScore,
    StreamTrace,
    StreamTruth,
    count_events,
    model_events,
    people_scores,
    people_with_streams,
    rate,
    read_streams,
    score,
    truth_of,
)
from plushsense.experiments.streams.score import (
    Fitted,
    PeopleFold,
    Settings,
    crossvalidated_streams,
    people_folds,
    pooled_scores,
    summed,
)
from plushsense.experiments.streams.systems import (
    SYSTEMS,
    TunedPoint,
    balanced,
    best_of,
    cheapest,
    fewest,
    gated,
    prompt,
    quiet,
    searched,
    tried,
)
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import JobsSpec
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.gate import GateSettings
from plushsense.runtime.replay import TraceReplayer
from plushsense.runtime.trace import trace_of
from plushsense.scoring.events import ErrorCosts, Interval
from plushsense.windows.clock import row_times_us
from plushsense.windows.features import Scaler
from support.made_traces import ARCH, GATE, GESTURES, HIT, HUG, REST, SQUEEZE, STEP_S, made_trace

ACCEL = load_layout("accel-3")


def troubled() -> Frames:
    """A gap and a clock that is set back."""
    draw = np.random.default_rng(5)
    time = 7_000 + np.cumsum(draw.integers(8, 13, 900))
    time[300:] += 400
    time[600:] -= time[600] - 20
    values = np.cumsum(draw.integers(-300, 301, (900, 3)), axis=0)
    return Frames(values.astype(np.int64), time.astype(np.int64), time.astype(np.int64))


def bundle(seed: int = 3, people: tuple[str, ...] = ()) -> Bundle:
    weights = {k: 4 * v for k, v in random_weights(ARCH, seed).items()}
    return Bundle(ARCH, weights, ACCEL, Scaler(np.zeros(3), np.full(3, 0.002)), GESTURES, {}, {}, {"subjects": people})


def test_rows_have_the_time_of_the_trace() -> None:
    frames = troubled()
    times = row_times_us(frames, ACCEL) / 1e6
    trace = trace_of(frames, bundle())
    assert [p.start_us / 1e6 for p in trace.parts] == pytest.approx([times[0], times[300], times[600]], abs=0.011)
    assert [p.ends_us / 1e6 for p in trace.parts] == pytest.approx([times[299], times[599], times[-1]])


# --- counts by hand -------------------------------------------------------------------------------------------------


def steps(*pieces: tuple[int, int]) -> np.ndarray:
    """Logits that leave no doubt: (class, for how many steps)."""
    return np.concatenate([np.tile(np.where(np.arange(4) == k, 4000, -4000), (n, 1)) for k, n in pieces])


def stream_trace(truth: StreamTruth, *pieces: tuple[int, int]) -> StreamTrace:
    trace = made_trace([steps(*pieces)])
    hours = trace.seconds / 3600
    truth = replace(truth, hours=hours, free_hours=hours / 2, rest_hours=2.0 / 3600)
    return StreamTrace(truth, TraceReplayer(trace))


def truth_with(
    truths: tuple[Interval, ...],
    rest: tuple[tuple[float, float], ...] = (),
    other: tuple[tuple[float, float], ...] = (),
    doubtful: tuple[tuple[float, float], ...] = (),
    hours: float = 1.0,
) -> StreamTruth:
    return StreamTruth("P1/s", "P1", False, truths, rest, other, doubtful, 3600 * hours, hours, 0.8 * hours, 0.0, 0.0)


def when(step: int) -> float:
    """Seconds of a step's answer."""
    return (ARCH.span - 1) / 100 + step * STEP_S


def test_every_count_of_one_stream_by_hand() -> None:
    truth = truth_with(
        (
            Interval(when(10), when(30), "Hug"),
            Interval(when(60), when(80), "Hit"),
            Interval(when(200), when(210), "Hug"),
        ),
        rest=((when(100), when(140)),),
        other=((when(150), when(170)),),
        doubtful=((when(270), when(400)),),
    )
    h = stream_trace(
        truth, (REST, 16), (HUG, 20), (REST, 30), (SQUEEZE, 4), (REST, 40), (HIT, 5), (REST, 40), (HUG, 5),
        (REST, 70), (HIT, 3), (REST, 40), (HIT, 20), (REST, 10),
    )  # fmt: skip
    found = score(h, argmax_spec())
    gesture = found.total()
    assert (gesture.truths, gesture.hits, gesture.deletions) == (3, 1, 2)
    # The last hit begins in the doubtful stretch and is not counted.
    assert (gesture.events, gesture.matched, gesture.insertions, gesture.confused) == (5, 1, 4, 1)
    assert found.places == {"rest": 1, "handling": 0, "other": 1, "unmarked": 1}
    assert gesture.latencies == pytest.approx([6 * STEP_S])
    # A squeeze where a blow was is another affect; nothing was said of the second hug.
    assert found.cost == 5.0 + 3 * 3.0 + 2.0
    assert found.total("affect").hits == 1 and found.total("anything").hits == 2
    assert found.levels["family"]["Hold"].truths == 2
    shown = found.to_dict()
    assert shown["false_events_per_hour"] == pytest.approx(4 / h.truth.hours)
    assert shown["outside_per_uncovered_hour"] == pytest.approx(3 / h.truth.free_hours)
    assert shown["at_rest_per_hour"] == pytest.approx(1 / h.truth.rest_hours)
    assert StreamScore.from_journal(found.to_journal()).to_dict() == shown
    n = count_events([h], argmax_spec())
    assert (n.hits, n.truths, n.insertions) == (1, 3, 4) and n.f1 == pytest.approx(gesture.f1)


def test_practice_is_right_but_no_hit() -> None:
    truth = truth_with((Interval(when(10), when(30), "Hug"),))
    practice = (Interval(when(58), when(95), "Hug"), Interval(when(300), when(320), "Hit"))
    labelled = replace(truth, practice=practice, handling=((when(150), when(170)),))
    pieces = ((REST, 16), (HUG, 10), (REST, 34), (HUG, 10), (REST, 10), (HUG, 10), (REST, 60), (HIT, 10), (REST, 200))
    for spec in (argmax_spec(), argmax_spec(0.15)):
        alone, found = (score(stream_trace(t, *pieces), spec) for t in (truth, labelled))
        counts = found.total()
        assert (counts.truths, counts.hits, counts.deletions, counts.events) == (1, 1, 0, 4)
        assert (counts.matched, counts.practised, counts.insertions, counts.outside) == (3, 2, 1, 1)
        assert found.places == {"rest": 0, "handling": 1, "other": 0, "unmarked": 0}
        assert alone.total().insertions == 3 and alone.total().recall == counts.recall
        # Neither a practice that is named nor one that is missed costs anything.
        assert (alone.cost, found.cost) == (3 * ErrorCosts().outside, ErrorCosts().outside)
    wrong = score(stream_trace(replace(truth, practice=(replace(practice[0], label="Hit"),)), *pieces), argmax_spec())
    assert wrong.total().confused == 2 and wrong.places["unmarked"] == 1
    assert wrong.total("anything").practised == 2 and wrong.total("affect").practised == 0


def test_a_gate_is_heard_at_once_and_named_by_the_network() -> None:
    truth = truth_with((Interval(0.30, 1.5, "Hit"),))
    inputs = np.zeros((400, 3), dtype=np.int64)
    inputs[::2] = 1
    inputs[32:60] = 4000 * np.tile([[1], [1], [-1], [-1]], (7, 1))
    trace = made_trace([steps((REST, 20), (HIT, 10), (REST, 30))], inputs)
    settings = replace(GATE, rules=(replace(GATE.rules[0], gesture=255),))
    spec = replace(argmax_spec(), enter=0.9, end_s=0.2, wait_s=2.0, gate=settings)
    found = score(StreamTrace(truth, TraceReplayer(trace)), spec)
    affect, gesture = found.total("affect"), found.total()
    assert found.gate_events == 1 and affect.hits == gesture.hits == 1
    assert affect.latencies[0] < 0.1
    assert gesture.latencies[0] == pytest.approx(when(20) - 0.30)
    without = score(StreamTrace(truth, TraceReplayer(trace)), replace(spec, gate=GateSettings()))
    assert without.total("affect").latencies[0] == pytest.approx(when(20) - 0.30)


@pytest.mark.parametrize("seed", range(8))
def test_the_quick_counts_are_those_of_the_whole_score(seed: int) -> None:
    draw = np.random.default_rng(seed)
    trace = made_trace([np.cumsum(draw.normal(0, 200, (400, 4)), axis=0)])
    starts = np.sort(draw.uniform(0, 20, 8))
    labels = draw.choice(["Hug", "Squeeze", "Hit"], 8)
    truths = tuple(Interval(float(s), float(s + 1), str(k)) for s, k in zip(starts, labels, strict=True))
    practice = tuple(Interval(t.start_s + 1.2, t.stop_s + 0.9, t.label) for t in truths[::2])
    truth = replace(truth_with(truths, doubtful=((3.0, 4.0),), hours=0.5), practice=practice)
    h = StreamTrace(truth, TraceReplayer(trace))
    for spec in (argmax_spec(), argmax_spec(0.3), DecideSpec(enter=0.5), DecideSpec(gate=GATE)):
        n, whole = count_events([h], spec), score(h, spec).total()
        assert (n.hits, n.truths, n.matched, n.insertions) == (
            whole.hits, whole.truths, whole.matched, whole.insertions,
        )  # fmt: skip
        assert sorted(n.latencies) == pytest.approx(sorted(whole.latencies), abs=1e-4)


def test_settings_are_chosen_on_those_who_tune() -> None:
    truths = tuple(Interval(when(20 + 60 * n), when(40 + 60 * n), "Hug") for n in range(3))
    # Each hug is preceded by a short false blow, which a least duration would swallow.
    pieces = [p for _ in range(3) for p in ((REST, 8), (HIT, 2), (REST, 12), (HUG, 18), (REST, 20))]
    tuning = [stream_trace(truth_with(truths), *pieces)]
    points = searched(tuning, SYSTEMS["hysteresis"])
    best = fewest(points, 1.0)
    assert (best.recall, best.false_per_hour) == (1.0, 0.0)
    assert balanced(points).f1 == 1.0 and cheapest(tuning, points).false_per_hour == 0.0
    # Without a rule there is no gate, and nothing to choose anew; with one, every choice without it is still there.
    assert gated(tuning, points, GateSettings()) == points
    with_gate = [replace(p.spec, gate=GateSettings(), wait_s=1.0) for p in gated(tuning, points, GATE)]
    assert all(replace(p.spec, wait_s=1.0) in with_gate for p in best_of(points))
    plain = tried(tuning, [argmax_spec()])[0]
    assert plain.recall == 1.0 and plain.false_per_hour == pytest.approx(rate(3, tuning[0].truth.hours))
    several = [TunedPoint(argmax_spec(), r, f, 0.0) for r, f in ((0.5, 4.0), (0.8, 9.0), (0.8, 8.0), (0.6, 10.0))]
    assert best_of(several) == [several[0], several[2]]
    assert fewest(several, 0.55) == several[2] and fewest(several, 0.9) == several[2]
    quick = [TunedPoint(argmax_spec(), 0.5, 4.0, f1, s) for f1, s in ((0.6, 1.5), (0.56, 1.0), (0.5, 0.2), (0.58, 1.0))]
    assert prompt(quick) == quick[3]
    calm = [TunedPoint(argmax_spec(), 0.5, f, f1) for f, f1 in ((50.0, 0.5), (60.0, 0.6), (61.0, 0.7), (90.0, 0.9))]
    assert quiet(calm) == calm[1] and quiet(calm[2:]) == calm[2]


# --- a data set -----------------------------------------------------------------------------------------------------

RESETS_AT = 500


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("streams")
    for person in range(6):
        draw = np.random.default_rng(person)
        place = folder / f"P{person + 1}"
        place.mkdir()
        clock = 1_000 + 10 * np.arange(1600, dtype=np.int64)
        clock[RESETS_AT:] -= 3_000
        values = draw.integers(-2000, 2001, (1600, 3)).astype(np.int64)
        stream = Frames(values, clock, 1_700_000_000_000 + 10 * np.arange(1600, dtype=np.int64) + 60_000 * person)
        (place / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
        for label, first, rows in (("Hug", 100, 150), ("Rest", 300, 100), ("Hit", 700, 60), ("Wave", 900, 100)):
            assert stream.host_ms is not None
            name = f"{label}_{int(stream.host_ms[first + rows - 1])}_{rows}.csv"
            write_recording(place / name, stream.slice(first, first + rows), ACCEL)
    return folder


@pytest.fixture()
def dataset(recordings: Path, tmp_path: Path) -> Dataset:
    return import_recordings(recordings, tmp_path / "DS", layout=ACCEL, gestures=GESTURES).dataset


def test_truth_lies_where_it_was_recorded(dataset: Dataset) -> None:
    stream = next(s for s in dataset.streams if s.subject == "P1")
    recording = next(r for r in dataset.recordings if r.subject == "P1" and r.gesture == "Hug")
    frames = dataset.read_stream(stream.id)
    found = truth_of(dataset, stream, frames, GESTURES)
    assert [(t.label, t.start_s, t.stop_s) for t in found.truths] == [
        ("Hug", pytest.approx(1.0), pytest.approx(2.49)),
        ("Hit", pytest.approx(6.99), pytest.approx(7.58)),  # the clock was set back before it, and a row left out
    ]
    assert found.rest == (pytest.approx((3.0, 3.99)),)
    assert found.other == (pytest.approx((8.99, 9.98)),)
    append_marks(dataset.path, [Mark(recording.id, "trim", "K", "", start=30, stop=150)])
    trimmed = open_dataset(dataset.path)
    again = truth_of(trimmed, stream, frames, GESTURES)
    assert again.truths[0].start_s == pytest.approx(1.3) and again.truths[0].stop_s == pytest.approx(2.49)
    append_marks(dataset.path, [Mark(recording.id, "exclude", "K", "")])
    excluded = open_dataset(dataset.path)
    left = truth_of(excluded, stream, frames, GESTURES)
    assert [t.label for t in left.truths] == ["Hit"] and left.doubtful == (pytest.approx((1.3, 2.49)),)


def test_labels_between_recordings_are_truth(dataset: Dataset) -> None:
    stream = next(s for s in dataset.streams if s.subject == "P1")
    frames = dataset.read_stream(stream.id)
    before = truth_of(dataset, stream, frames, GESTURES)
    marks = [
        Mark(stream.id, "label", "K", start=10, stop=130, label="practice:Hug"),  # its end is in a recording
        Mark(stream.id, "label", "K", start=260, stop=290, label="practice:Wave"),  # no class
        Mark(stream.id, "label", "K", start=410, stop=440, label="rest"),
        Mark(stream.id, "label", "K", start=450, stop=480, label="handling"),
        Mark("P1/nothing", "label", "K", start=450, stop=480, label="handling"),
    ]
    append_marks(dataset.path, marks)
    labelled = open_dataset(dataset.path)
    found = truth_of(labelled, stream, frames, GESTURES)
    assert found.practice == (Interval(pytest.approx(0.1), pytest.approx(0.99), "Hug"),)
    assert found.handling == (pytest.approx((4.5, 4.79)),)
    assert found.rest == (*before.rest, pytest.approx((4.1, 4.39)))
    assert found.other == (*before.other, pytest.approx((2.6, 2.89)))
    assert found.truths == before.truths and found.doubtful == ()
    assert labelled.hash != dataset.hash
    ignored = labelled.without_stretches().with_inputs(labelled.layout)
    assert truth_of(ignored, stream, frames, GESTURES) == before and ignored.hash == dataset.hash
    (h,) = read_streams(labelled, bundle(), ["P1"])
    assert 3600 * h.truth.free_hours == pytest.approx(16.0 - 1.49 - 0.59 - 0.89, abs=0.1)
    assert 3600 * h.truth.known_hours == pytest.approx(1.49 + 0.59 + 0.99 * 2 + 0.89 + 3 * 0.29, abs=0.1)


def test_time_that_was_heard_and_time_without_truth(dataset: Dataset) -> None:
    (h,) = read_streams(dataset, bundle(), ["P1"])
    truth = h.truth
    # They are those that the model reads, but need no model.
    parts = h.replayer.trace.parts
    assert 3600e6 * truth.hours == pytest.approx(sum(p.ends_us - p.start_us for p in parts)) and len(parts) == 2
    assert 3600 * truth.hours == pytest.approx(16.0, abs=0.1)
    assert 3600 * truth.free_hours == pytest.approx(16.0 - 1.49 - 0.59, abs=0.1)
    assert 3600 * truth.rest_hours == pytest.approx(0.99, abs=0.05)
    assert truth.stop_s == pytest.approx(16.0, abs=0.02)


@dataclass(frozen=True)
class Remembering:
    """Notes whom it was given; the network is the same for everybody."""

    notes: Path

    def __call__(self, data: Dataset, fold: PeopleFold, progress: Callable[..., Any], /) -> Fitted:
        progress(1, 1, {})
        with self.notes.open("a") as file:
            file.write(f"{fold.name} {','.join(fold.train)} {','.join(fold.validation)} {','.join(fold.test)}\n")
        return Fitted({"windows": bundle()}, GATE, {"gate": "made up"})


def test_folds_keep_people_apart_and_are_resumed(dataset: Dataset, tmp_path: Path) -> None:
    fit = Remembering(tmp_path / "notes")
    settings = Settings(("argmax", "hybrid", "full"), targets=(0.3, 0.9))
    spec = JobsSpec(journal=Journal(tmp_path / "journal"))
    seen: list[tuple[int, int]] = []
    folds = crossvalidated_streams(
        dataset, "by-subject:3", fit, settings=settings, spec=spec, key={"fit": 1},
        progress=lambda at: seen.append((at.done, at.resumed)),
    )  # fmt: skip
    notes = fit.notes.read_text().splitlines()
    assert len(notes) == len(folds) == 3
    tested: list[str] = []
    for line in notes:
        train, validation, test = (set(part.split(",")) for part in line.split(" ")[-3:])
        assert not train & validation and not test & (train | validation) and len(train | validation | test) == 6
        tested += test
    assert sorted(tested) == people_with_streams(dataset)
    # No network was trained anywhere in the stream, so that the system that needs one is left out.
    assert [list(fold["systems"]) for fold in folds] == [["argmax", "hybrid"]] * 3
    again = crossvalidated_streams(
        dataset, "by-subject:3", fit, settings=settings, spec=spec, key={"fit": 1},
        progress=lambda at: seen.append((at.done, at.resumed)),
    )  # fmt: skip
    assert again == folds and len(fit.notes.read_text().splitlines()) == 3 and seen[-1] == (3, 3)
    crossvalidated_streams(dataset, "by-subject:3", fit, settings=settings, spec=spec, key={"fit": 2})
    assert len(fit.notes.read_text().splitlines()) == 6

    table = summed(folds)
    plain = table.systems["argmax"]["plain"]
    assert plain["truths"] == 12 and plain["hits"] + plain["deletions"] == 12
    assert [p["subject"] for p in plain["people"]] == sorted(tested)
    assert sum(p["truths"] for p in plain["people"]) == 12
    scores = people_scores(model_events(dataset, bundle(), tested, argmax_spec(0.0)), GESTURES)
    alone = pooled_scores(scores.values()).to_dict()
    for name in ("events", "hits", "insertions", "fragmentations", "merges", "latency_s", "cost_per_truth"):
        assert alone[name] == plain[name], name
    assert table.reference is None and table.at_recall == []


def test_a_reference_beside_itself_is_one(dataset: Dataset, tmp_path: Path) -> None:
    settings = Settings(("argmax", "smoothed"), targets=(0.2, 0.5, 0.8))
    folds = crossvalidated_streams(dataset, "by-subject:2", Remembering(tmp_path / "notes"), settings=settings)
    rows = summed(folds).at_recall
    ratios = [row["systems"]["smoothed"]["ratio"] for row in rows]
    assert {r for r in ratios if r is not None} <= {1.0} and any(r is not None for r in ratios)


def test_what_cannot_be_split_is_refused(dataset: Dataset) -> None:
    with pytest.raises(ConfigError, match="does not keep people apart"):
        people_folds(dataset, "by-recording:5")
    for path in (dataset.path / "streams").rglob("*.csv"):
        path.unlink()
    (dataset.path / "index.json").unlink()
    with pytest.raises(BadInput, match="no stream in which a recording is located"):
        people_folds(open_dataset(dataset.path), "by-subject:3")
