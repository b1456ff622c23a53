"""``live --engine int8`` is the toy: every answer is that of the C library, bit for bit, whatever the stream does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.deploy.golden import ANSWER, EVENT
from plushsense.deploy.quantize import calibrated, classifier_of, integer_model
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import BothEngines, EngineAgreement, IntegerClassifier, StreamClassifier
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import AFFECT_CODES, ANSWERS, NO_GESTURE
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import IntegerModel
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler, network_inputs
from support.c_toy import Seat, compiled
from support.troubles import SPECS, STREAMS, calibrate, knowing_bundle, make_bundle, toy_frames

pytestmark = pytest.mark.slow

TROUBLED = calibrate(make_bundle())


@pytest.fixture(scope="session")
def library(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return compiled(c_compiler, tmp_path_factory)


def of_the_c(library: Any, model: IntegerModel, frames: list[Frame], sensitivity: int) -> np.ndarray:
    """The C's answers and events; in the end nothing more is heard."""
    toy = Seat(library, model.to_bytes(), len(model.layout.channels), model.network.arch.classes)
    assert toy.status == 0
    library.seat_sensitivity(toy.toy, sensitivity)
    numbers = np.array([[f.device_ms, *f.values] for f in frames], dtype=np.int64)
    rows = toy.push(numbers, [len(frames) - 1]).astype(np.int64)
    rows[:, 2] %= 2**32  # the toy's clock is a uint32_t, and a garbled line may hold any time
    rows[rows[:, 0] == EVENT, 8] %= 2**32
    answers = np.delete(rows[rows[:, 0] == ANSWER], [3, 9], axis=1)[:, :10]
    events = rows[rows[:, 0] == EVENT][:, :10]
    return np.concatenate([answers, events])


def of_live(model: IntegerModel, frames: list[Frame], sensitivity: int = 0) -> np.ndarray:
    """The live engine's decisions and events in the C's terms, with every decimal that they have."""
    classifier = IntegerClassifier(model)
    classifier.sensitivity = sensitivity
    answers, events = [], []
    labels, period = model.gestures.labels, model.layout.period_us
    zero = frames[0].device_ms * 1000.0
    seen, left_out = frames[0].device_ms, False

    def ms(t_s: float, zero: float) -> int:
        at = t_s * 1e6 + zero
        assert abs(at - round(at)) < 0.01, "times are whole microseconds"
        return int(round(at) // 1000 % 2**32)

    for row, frame in enumerate([*frames, None]):
        before = zero
        if frame:
            left_out = not left_out and not 0 <= frame.device_ms - seen <= model.layout.gap_ms
        if frame and not left_out:
            # Over a clock reset a decision's time goes on where it was; the toy's own clock does not.
            if frame.device_ms < seen:
                zero += (frame.device_ms - seen) * 1000 - period
            seen = frame.device_ms
        for d in classifier.push(frame) if frame else [classifier.silence()]:
            row = min(row, len(frames) - 1)
            since = before if d.state == "no signal" else zero
            for e in d.events:
                gesture = 255 if e.gesture is None else labels.index(e.gesture)
                what = ("begun", "named", "ended").index(e.kind) + 1, gesture, AFFECT_CODES[e.affect]
                source = int(e.source == "gate")
                events.append([1, row, ms(e.t_s, since), e.number, *what, source, ms(e.since_s, since), 0])
            if d.source == "gate" or d.state in ("no signal", "sensor fault"):
                continue  # said between two steps
            known = d.state == "tracking"
            confidence = (d.confidence or 0.0) * 2**15
            assert confidence == int(confidence), "confidence comes in steps of 2^-15"
            best = labels.index(d.gesture) if d.gesture is not None else 0
            affect = AFFECT_CODES[d.affect] if d.affect is not None else 0
            kind = ANSWERS.index(d.answer) if d.answer is not None else 0
            counts = classifier.restarts, classifier.invalid
            answers.append([0, row, ms(d.t_s, zero), int(known), best, affect, int(confidence), kind, *counts])
    return np.array([*answers, *events]).reshape(-1, 10)


def equal(library: Any, model: IntegerModel, frames: list[Frame], sensitivity: int = 0) -> np.ndarray:
    """Assert that both say the same, answers and events; the live engine's answers: row, ms, whether it tracks,
    gesture, affect, confidence, restarts, invalid."""
    found, wanted = of_live(model, frames, sensitivity), of_the_c(library, model, frames, sensitivity)
    np.testing.assert_array_equal(found, wanted)
    return found[found[:, 0] == ANSWER][:, [1, 2, 3, 4, 5, 6, 8, 9]]


def virtual(query: str, layout: str = "plush-15") -> list[Frame]:
    """Everything that a virtual toy sends."""
    frames: list[Frame] = []
    with open_device(f"virtual://?{query}&speed=0", load_layout(layout)) as device:
        while not device.closed and (some := device.read()) is not None:
            frames.extend(some)
    return frames


def model_for(layout: str, symbol: str = "14d1_19d2_19d4", filters: tuple[int, ...] = (8, 12, 16)) -> Bundle:
    """A network of random weights, its numbers scaled and calibrated on a virtual person."""
    chosen, gestures = load_layout(layout), load_gestures("plush-18")
    arch = Arch.parse(symbol, filters, channels=chosen.n_inputs, classes=len(gestures))
    quiet = virtual("person=3&seed=5&seconds=40", layout)
    values = np.array([f.values for f in quiet], dtype=np.int64)
    times = np.array([f.device_ms for f in quiet], dtype=np.int64)
    longest = max(resample(Frames(values, times, times), chosen), key=len)
    x = network_inputs(longest.data, chosen).T
    windows = np.stack([x[:, at : at + arch.span] for at in range(0, x.shape[1] - arch.span, 60)]).astype(np.int32)
    return calibrated(Bundle(arch, random_weights(arch, 3), chosen, Scaler.fit(windows), gestures), windows)


@pytest.mark.parametrize("layout", ["plush-15", "accel-3"])
def test_decisions_are_the_c_librarys_with_lost_frames_garbage_and_restarts(library: Any, layout: str) -> None:
    frames = virtual("person=7&seed=2&lost=0.45&garbled=0.02&glitch=0.02&seconds=150", layout)
    back = len(frames) * 2 // 3
    reset = frames[back].device_ms - 3
    frames = frames[:back] + [Frame(f.host_ms, f.device_ms - reset, f.values) for f in frames[back:]]
    model = integer_model(model_for(layout))
    found = equal(library, model, frames)
    tracking = found[found[:, 2] == 1]
    assert found[-1, 6] >= 2, "there were restarts"
    assert len(tracking) > 500 and len(set(tracking[:, 3])) > 1 and len(set(tracking[:, 5])) > 100
    if layout == "plush-15":
        assert found[-1, 7] > 10, "there was garbage"


@pytest.mark.parametrize(("symbol", "filters"), [("9", (5,)), ("28d1_32d2", (4, 6)), ("3d1_3d2_3d4_3d8", (4, 6, 8, 8))])
def test_other_networks_too(library: Any, symbol: str, filters: tuple[int, ...]) -> None:
    model = integer_model(model_for("accel-3", symbol, filters), DecideSpec(0.0))
    assert len(equal(library, model, virtual("person=2&seed=4&lost=0.1&seconds=20", "accel-3"))) > 300


def test_a_real_session(library: Any, real_data: Path) -> None:
    stream = real_data / "makeability-gestures" / "P01" / "fulldatastream.csv"
    layout = load_layout("accel-3")
    frames: list[Frame] = []
    with open_device(f"replay://{stream}?speed=0", layout) as device:
        while not device.closed and len(frames) < 20_000 and (some := device.read()) is not None:
            frames.extend(some)
    found = equal(library, integer_model(model_for("accel-3")), frames)
    assert (found[:, 2] == 1).sum() > 1000


@settings(max_examples=20)
@given(STREAMS, SPECS)
def test_events_are_the_c_librarys_to_the_step(library: Any, frames: Frames, spec: DecideSpec) -> None:
    rows = zip(frames.device_ms.tolist(), frames.values.tolist(), strict=True)
    equal(library, integer_model(TROUBLED, spec), [Frame(0, ms, tuple(row)) for ms, row in rows])


def test_what_a_toy_that_knows_its_touches_tells(library: Any) -> None:
    """Not random: events of the network and of the gate, a fault and a recovery, told alike."""
    spec = DecideSpec(
        gate=GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=60),), (Rule((Term(0, 40),), 3, NO_GESTURE, deaf=50),)),
        health=HealthSettings((-3000,) * 3, (3000,) * 3, still_ms=200),
    )
    bundle, values = knowing_bundle(), toy_frames("hit rest stroke rest hit rest stroke")
    values[1050:1150] = values[1050]
    frames = [Frame(0, 1000 + 10 * i, tuple(row)) for i, row in enumerate(values.tolist())]
    model = integer_model(bundle, spec)
    equal(library, model, frames)
    events = of_live(model, frames)
    events = events[events[:, 0] == EVENT]
    assert {(what, source) for what, source in events[:, [4, 7]].tolist()} >= {(1, 0), (1, 1), (2, 1), (3, 0), (3, 1)}
    assert set(events[:, 6]) == {1, 3}


def test_sensitivity_is_that_of_the_c_for_every_engine(library: Any) -> None:
    bundle, values = knowing_bundle(), toy_frames("rest stroke hit rest")
    spec = DecideSpec(smoothing_s=0.3, enter=0.995, leave=0.99, enter_affect=0.999, leave_affect=0.99, sure=0.3)
    frames = [Frame(0, 10 * i, tuple(row)) for i, row in enumerate(values.tolist())]
    for sensitivity, begun in ((-40, set()), (0, {"hit"}), (40, {"stroke", "hit"})):
        equal(library, integer_model(bundle, spec), frames, sensitivity)
        for engine in ("float", "both"):
            reader = classifier_of(bundle, spec, engine)
            reader.sensitivity = sensitivity
            reader.reset()
            events = [e for frame in frames for d in reader.push(frame) for e in d.events]
            assert {e.gesture for e in events} == begun
            assert not isinstance(reader, BothEngines) or reader.original.in_event == reader.in_event
    with pytest.raises(ConfigError, match="accepted are -128 to 127"):
        reader.sensitivity = 128


def test_both_engines_are_counted_against_each_other() -> None:
    bundle = model_for("accel-3")
    both = BothEngines(integer_model(bundle), StreamClassifier(bundle))
    with open_device("virtual://?person=4&seed=3&lost=0.01&speed=0", bundle.layout) as device:
        live = run_live(device, both, seconds=60)
        decided = list(live)
    alone = IntegerClassifier(integer_model(bundle))
    with open_device("virtual://?person=4&seed=3&lost=0.01&speed=0", bundle.layout) as device:
        assert decided == list(run_live(device, alone, seconds=60)), "what is decided is the deployed model's"
    found = both.agreement()
    # The frame at which the time is up is read, but its decision is not given out.
    assert found.decisions - sum(d.state == "tracking" for d in decided) in (0, 1)
    assert found.decisions > 500
    assert 0.8 < found.gesture <= found.affect <= 1
    assert 0 < found.largest_difference < 0.8
    assert (live.summary().restarts, live.summary().invalid) == (alone.restarts, alone.invalid)
    both.reset()
    assert both.agreement() == EngineAgreement(0, None, None, None)


def test_a_decision_of_another_model_counts_as_one_that_differs() -> None:
    bundle = model_for("accel-3")
    stranger = Bundle(
        bundle.arch, random_weights(bundle.arch, 8), bundle.layout, bundle.scaler, bundle.gestures, decision={}
    )
    both = BothEngines(integer_model(bundle), StreamClassifier(stranger))
    with open_device("virtual://?person=4&seed=3&speed=0", bundle.layout) as device:
        list(run_live(device, both, seconds=30))
    share = both.agreement().gesture
    assert share is not None and share < 0.6
