"""The real-time protocol: who is said to have answered what, when, and what the systems receive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.devices.base import Frame
from plushsense.experiments.protocol.score import (
    FamilyConfusion,
    SystemOutput,
    confusions,
    group_of,
    score,
    score_sittings,
    summary,
    system_outputs,
    windows_of,
)
from plushsense.experiments.protocol.sittings import GestureTrial, Sitting, virtual_sittings
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import GestureEvent, StreamClassifier
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.windows.features import Scaler

SET = load_gestures("plush-18")
QUIET = Frames(np.zeros((6001, 13), dtype=np.int64), np.arange(6001, dtype=np.int64) * 10)  # a minute


def trial(label, start, stop, onset=None, repetition=1):
    return GestureTrial(label, repetition, start, start if onset is None else onset, stop)


def event(what, number, t_s, affect="positive", gesture=None, source="cnn"):
    return GestureEvent(what, number, affect, gesture, source, t_s, t_s)


def outcomes(trials, *events, answers=(), system="cnn"):
    return score(Sitting("P", QUIET, tuple(trials)), system, SystemOutput(events, answers), SET)


def test_a_trial_is_answered_by_the_first_event_of_its_affect_in_its_time():
    stroke = trial("Back stroke 1", 10.0, 13.0)
    (one,), _ = outcomes([stroke], event("begun", 1, 11.2), event("named", 1, 12.0, gesture="Back stroke 1"))
    assert (one.reaction_s, one.gesture_s, one.called, one.judged) == (1.2, 2.0, "Back stroke 1", "right")
    assert not one.negative
    assert not one.already
    for t, answered in ((9.69, False), (9.71, True), (14.99, True), (15.01, False)):
        (one,), stray = outcomes([stroke], event("begun", 1, t))
        assert (one.reaction_s is not None) == answered
        assert stray.positive == (0 if answered else 1)


def test_a_blow_is_answered_from_the_blow_on():
    blow = trial("Tail hit 1", 10.0, 11.0, onset=10.3)
    (one,), _ = outcomes([blow], event("begun", 1, 10.31, "negative", source="gate"))
    assert (one.reaction_s, one.source, one.judged, one.called) == (0.01, "gate", "unnamed", None)
    assert summary([one]).within_200_ms == 1
    (late,), _ = outcomes([blow], event("begun", 1, 10.51, "negative"))
    assert summary([late]).within_200_ms == 0


def test_what_is_said_first_counts_even_when_it_is_put_right_later():
    scratch = trial("Tail scratch 1", 10.0, 13.0)
    said = (
        event("begun", 1, 11.0, "negative", "Tail hit 1"),
        event("ended", 1, 11.5, "negative", "Tail hit 1"),
        event("begun", 2, 12.0, "positive", "Tail scratch 1"),
    )
    (one,), _ = outcomes([scratch], *said, answers=((11.1, SET.index("Tail hit 1"), 0.7), (12.5, 13, 0.9)))
    assert (one.reaction_s, one.gesture_s, one.called, one.judged) == (2.0, 2.0, "Tail hit 1", "wrong")
    assert one.negative
    assert one.likelihood == 0.7


@pytest.mark.parametrize(
    ("called", "judged"),
    [("Tail scratch 2", "family"), ("Tail tap 1", "affect"), ("Hold in hands", "wrong"), ("Tail scratch 1", "right")],
)
def test_how_far_off_a_name_is(called, judged):
    affect = SET.get(called).affect
    (one,), _ = outcomes([trial("Tail scratch 1", 10.0, 13.0)], event("begun", 1, 11.0, affect, called))
    assert one.judged == judged


def test_an_event_that_stood_before_is_no_answer_but_is_what_it_was_called():
    said = (event("begun", 1, 5.0, "neutral", "Hold in hands"), event("ended", 1, 20.0, "neutral", "Hold in hands"))
    (one,), stray = outcomes([trial("Back stroke 2", 10.0, 13.0)], *said)
    assert (one.reaction_s, one.called, one.judged, one.already) == (None, "Hold in hands", "wrong", False)
    assert (stray.neutral, stray.positive) == (1, 0)
    (held,), _ = outcomes([trial("Hold in hands", 10.0, 13.0)], *said)
    assert (held.reaction_s, held.already) == (None, True)


def test_a_gentle_gesture_is_called_negative_only_while_it_lasts():
    tap = trial("Tail tap 1", 10.0, 12.0)
    for t, called in ((9.5, False), (9.8, True), (12.2, True), (12.4, False)):
        (one,), _ = outcomes([tap], event("begun", 1, t, "negative"))
        assert one.negative == called
    (blow,), _ = outcomes([trial("Tail hit 1", 10.0, 11.0)], event("begun", 1, 10.1, "negative"))
    assert summary([blow]).called_negative == 0, "a blow is rightly called so"


def test_times_of_trials_do_not_overlap_and_rest_is_none():
    near = [trial("Back stroke 1", 10.0, 13.0), trial("Back stroke 1", 13.5, 16.0), trial("Tail tap 1", 16.0, 18.0)]
    windows = windows_of(near)
    assert windows == [pytest.approx(w) for w in ((9.7, 13.2), (13.2, 16.0), (16.0, 20.0))]
    rest = trial("At rest", 30.0, 50.0)
    found, stray = outcomes([*near, rest], event("begun", 1, 40.0))
    assert len(found) == 3
    assert stray.positive == 1
    assert stray.hours * 3600 == pytest.approx(60 - (20.0 - 9.7), abs=0.05)


def test_every_gesture_of_the_paper_has_its_group():
    found = {}
    for gesture in SET.gestures:
        found.setdefault(group_of(gesture), []).append(gesture.label)
    assert {key: len(labels) for key, labels in found.items()} == {
        "broad": 4, "fine": 6, "taps": 2, "hug": 1, "energetic": 3, "neutral": 1, "other": 1,
    }  # fmt: skip
    other = load_gestures("makeability-11")
    assert group_of(other.get("Shake")) == "fast"
    assert group_of(other.get("Midair Zorro _Z_")) == "other"


def test_a_summary_is_of_all_trials_and_its_times_of_those_that_were_answered():
    trials = [trial("Tail hit 1", 10.0 * n, 10.0 * n + 1.0, repetition=n) for n in (1, 2, 3, 4)]
    said = []
    for n, delay in ((1, 0.1), (2, 0.3), (3, 1.1)):
        said.append(event("begun", n, 10.0 * n + delay, "negative", "Tail hit 1"))
        said.append(event("ended", n, 10.0 * n + 3.0, "negative", "Tail hit 1"))
    found, _ = outcomes(trials, *said)
    row = summary(found)
    assert (row.trials, row.activated, row.activation) == (4, 3, 0.75)
    assert (row.within_200_ms, row.quick) == (1, 0.25)
    assert row.reaction_s == {"median": 0.3, "p90": pytest.approx(0.94)}
    assert row.called == {"right": 3, "family": 0, "affect": 0, "wrong": 0, "unnamed": 1}
    assert row.likelihood is None
    assert confusions(found) == [
        FamilyConfusion("cnn", "Tail hit", "Tail hit", 3, 0.75),
        FamilyConfusion("cnn", "Tail hit", None, 1, 0.25),
    ]


@pytest.fixture(scope="module")
def model():
    """A network with weights of no meaning that says much, and a gate."""
    layout = load_layout("plush-15")
    arch = Arch.parse("9d1_7d2", (6, 8), channels=layout.n_inputs, classes=18, padding="stream", window=60, step=5)
    jerk = Signal(JERK, (layout.inputs.index("acc_magnitude"),), lag=2, floor=400)
    gate = GateSettings((jerk,), (Rule((Term(0, 96, 1, 1),), 3, 255),))
    spec = DecideSpec(0.1, 0.1, 0.05, 0.4, 0.2, least_s=0.05, gate=gate)
    offset = np.array([1500, 740, 410, 490, 540, 540, 300, 430, 760, 800, 262_700], dtype=np.float64)
    spread = np.array([340, 155, 26, 21, 140, 395, 13, 180, 345, 340, 7_500], dtype=np.float64)
    scaler = Scaler(offset, 3.0 / spread)
    return Bundle(arch, random_weights(arch, 2), layout, scaler, SET, decision=spec.to_dict())


@pytest.fixture(scope="module")
def sitting(model):
    labels = ("Tail hit 1", "Back stroke 1")
    return virtual_sittings([1001], 2, 1, model.layout, gestures=labels)[0].play()


def test_each_system_hears_the_very_events_of_the_live_reader(model, sitting):
    outputs = system_outputs(sitting.frames, model, lambda frames: [event("begun", 1, len(frames) / 1e4)])
    assert list(outputs) == ["rules", "cnn", "hybrid"]
    spec = DecideSpec.from_dict(model.decision)
    for key, settings in (("cnn", replace(spec, gate=GateSettings())), ("hybrid", spec)):
        reader = StreamClassifier(model, settings)
        decisions = [
            d
            for ms, values in zip(sitting.frames.device_ms, sitting.frames.values, strict=True)
            for d in reader.push(Frame(0, int(ms), tuple(int(v) for v in values)))
        ]
        live = [e for d in decisions for e in d.events]
        replayed = [e for e in outputs[key].events if e.t_s <= reader.time_s]
        assert len(live) > 4
        assert replayed[: len(live)] == live
        assert all(e.kind == "ended" for e in replayed[len(live) :]), "only that the stream is over"
    assert any(e.source == "gate" for e in outputs["hybrid"].events)
    assert not any(e.source == "gate" for e in outputs["cnn"].events)


def test_a_model_without_a_gate_makes_no_hybrid(model, sitting):
    bare = replace(model, decision={**model.decision, "gate": {}})
    assert list(system_outputs(sitting.frames, bare)) == ["cnn"]


def test_a_run_adds_up_and_rules_are_whatever_is_plugged_in(model, sitting):
    blow = sitting.trials[0]

    def rules(frames):
        return [event("begun", 1, blow.onset_s + 0.15, "negative", source="gate")]

    told = []
    scored = score_sittings([sitting], model, rules, lambda at: told.append((at.done, at.total)))
    assert told == [(1, 1)]
    assert scored.systems == ("rules", "cnn", "hybrid")
    assert (scored.trials, scored.gestures, len(scored.outcomes)) == (2, 2, 6)
    rows = {(row.group, row.system): row.figures for row in scored.rows}
    assert rows["energetic", "rules"].reaction_s["median"] == pytest.approx(0.15, abs=1e-3)
    assert rows["broad", "rules"].activated == 0
    # A blow on a table is what the hand-made gate is for.
    assert rows["energetic", "hybrid"].within_200_ms == 1
    assert rows["all", "hybrid"].trials == 2
    for row in rows.values():
        assert sum(row.called.values()) == row.trials
