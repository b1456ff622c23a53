"""The rule baseline: what it answers, and that it fails as the paper reports of its rules."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.devices.base import Frame
from plushsense.devices.virtual.session import GestureMark, VirtualSession
from plushsense.devices.virtual.stream import channel_columns
from plushsense.devices.virtual.world import draw_person
from plushsense.runtime.classifier import GestureEvent
from plushsense.tuning.rule_baseline import (
    RuleBaselineReader,
    RuleBaselineSettings,
    fit_rule_baseline,
    rule_baseline_events,
    sensors_of,
)
from plushsense.workflow.api import simulate

pytestmark = pytest.mark.slow

PLUSH = load_layout("plush-15")
SETTINGS = RuleBaselineSettings(shock=40_000, touch_shock=4_000, swing=300)


def frames_of(touch: np.ndarray, z: np.ndarray | None = None, electrode: str = "back") -> Frames:
    """One electrode moves, and gravity; everything else trembles."""
    n = len(touch)
    values = 500 + np.random.default_rng(0).integers(-3, 4, (n, PLUSH.n_channels))
    values[:, PLUSH.index(electrode)] += touch.astype(np.int64)
    values[:, PLUSH.index("acc_z")] = 16_384 if z is None else z.astype(np.int64)
    return Frames(values.astype(np.int64), 1_000 + 10 * np.arange(n))


def begun(events: list[GestureEvent]) -> list[tuple[str, float]]:
    """(affect, seconds) of every beginning, rounded to a sample."""
    return [(e.affect, round(e.t_s, 2)) for e in events if e.kind == "begun"]


def test_a_blow_is_answered_within_50_ms_and_is_over_after_a_second() -> None:
    z = np.full(600, 16_384)
    z[300:303] = (32_000, 3_000, 30_000)
    events = rule_baseline_events(frames_of(np.zeros(600), z), PLUSH, SETTINGS)
    assert begun(events) == [("negative", 3.0)]
    assert [e.kind for e in events] == ["begun", "ended"]
    assert 4.0 <= events[1].t_s <= 4.2
    assert events[0].gesture is None and events[0].source == "gate"


def test_broad_strokes_are_answered_when_they_have_gone_to_and_fro() -> None:
    t = np.arange(900) / 100
    strokes = 1_600 * np.sin(np.pi * np.clip(t - 2, 0, 5) / 1.3) ** 2
    assert [a for a, _ in begun(rule_baseline_events(frames_of(strokes), PLUSH, SETTINGS))] == ["positive"]
    at = begun(rule_baseline_events(frames_of(strokes), PLUSH, SETTINGS))[0][1]
    assert 3.0 <= at <= 5.0


@pytest.mark.parametrize("size", [1_600, 4_000])
def test_a_hand_that_rests_is_no_caress(size: int) -> None:
    held = size * np.clip((np.arange(900) - 200) / 60, 0, 1)
    assert rule_baseline_events(frames_of(held), PLUSH, SETTINGS) == []


def test_the_sum_of_all_electrodes_and_a_near_hand_are_no_touch() -> None:
    touch, shock = sensors_of(PLUSH)
    names = [PLUSH.inputs[i] for i in touch]
    assert "cap_all" not in names and "proximity" not in names and "back" in names
    assert [PLUSH.inputs[i] for i in shock] == ["acc_magnitude"]


def test_after_a_gap_it_begins_anew() -> None:
    frames = frames_of(np.r_[np.zeros(200), np.full(200, 9_000)])
    late = Frames(frames.values, frames.device_ms + 500 * (np.arange(400) >= 200))
    assert begun(rule_baseline_events(frames, PLUSH, SETTINGS)) == [("negative", 2.0)]
    assert rule_baseline_events(late, PLUSH, SETTINGS) == []


def test_what_goes_on_when_nothing_is_heard_ends() -> None:
    reader = RuleBaselineReader(PLUSH, SETTINGS)
    frames = frames_of(np.r_[np.zeros(50), np.full(10, 9_000)])
    events: list[GestureEvent] = []
    for ms, values in zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        events += reader.push(Frame(0, ms, tuple(values)))
    assert [e.kind for e in events] == ["begun"]
    assert [e.kind for e in reader.silence()] == ["ended"]
    assert reader.silence() == []


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("old")
    simulate(folder / "raw", people=6, repetitions=2, dataset=folder / "DS")
    return open_dataset(folder / "DS")


@pytest.mark.exhaustive
def test_tuned_by_hand_they_do_what_the_paper_saw(virtual: Dataset) -> None:
    """A simulation: blows at once, most broad strokes, hardly any fine scratch, nothing to holding."""
    settings = fit_rule_baseline(virtual, virtual.gestures, virtual.subjects)
    answered: dict[str, list[bool]] = {"stroke": [], "scratch": [], "blow": [], "hold": []}
    kinds = {
        "Back stroke 1": "stroke",
        "Head stroke 1": "stroke",
        "Ear scratch 1": "scratch",
        "Neck scratch 1": "scratch",
        "Tail hit 1": "blow",
        "Hold in hands": "hold",
    }
    for number in range(101, 106):
        sitting = VirtualSession(draw_person(number, 1), 1, 78)
        episodes = [sitting.perform(label, 2) for label in kinds]
        values = np.concatenate([e.values for e in episodes])[:, channel_columns(PLUSH)]
        ms = np.concatenate([e.device_ms for e in episodes])
        events = rule_baseline_events(Frames(values, ms), PLUSH, settings)
        for mark in [m for e in episodes for m in e.marks]:
            answered[kinds[mark.label]].append(_answered(mark, events, ms))
    shares = {kind: float(np.mean(each)) for kind, each in answered.items()}
    assert shares["blow"] >= 0.9
    assert shares["stroke"] >= 0.6
    assert shares["scratch"] <= 0.3
    assert shares["hold"] <= 0.1


def _answered(mark: GestureMark, events: list[GestureEvent], ms: np.ndarray) -> bool:
    """Blows as blows within 0.2 s, everything else as a caress."""
    first, last = ((int(ms[at]) - int(ms[0])) / 1000 for at in (mark.start, mark.stop - 1))
    if mark.struck is not None:
        at = (int(ms[mark.struck]) - int(ms[0])) / 1000
        return any(a == "negative" and at - 0.02 <= t <= at + 0.2 for a, t in begun(events))
    return any(a == "positive" and first <= t <= last for a, t in begun(events))


def test_without_affects_there_is_nothing_to_tune(virtual: Dataset) -> None:
    with pytest.raises(ConfigError, match="'makeability-11' has no affects"):
        fit_rule_baseline(virtual, load_gestures("makeability-11"), virtual.subjects)
    with pytest.raises(ConfigError, match="include other people"):
        fit_rule_baseline(virtual, virtual.gestures, [])


def test_a_toy_without_electrodes_has_blows_only() -> None:
    layout = load_layout("accel-3")
    values = np.random.default_rng(1).integers(-50, 51, (400, 3)) + np.array([0, 0, 16_384])
    values[200:204] += 20_000 * np.array([[1], [-1], [1], [-1]])
    frames = Frames(values.clip(-32_768, 32_767).astype(np.int64), 10 * np.arange(400))
    assert [a for a, _ in begun(rule_baseline_events(frames, layout, RuleBaselineSettings(shock=5_000)))] == [
        "negative"
    ]
