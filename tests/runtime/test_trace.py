"""A replay over a trace gives the very events and answers of the live loop, whatever the stream and the settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, read_stream
from plushsense.deploy.quantize import integer_model
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.events import BEGUN, CNN, ENDED, GATE, NAMED, NO_GESTURE, Update
from plushsense.runtime.fixed import integer_logits
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.replay import TraceReplayer
from plushsense.runtime.trace import ReportedEvent, replay, reported_events, trace_of
from support.troubles import SPECS, STREAMS, TROUBLES, calibrate, events_of, lived, make_bundle, reader_of, same, stream

pytestmark = pytest.mark.slow

ENGINES = ("float", "int8")
BUNDLE = calibrate(make_bundle())
GATES = GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=60),), (Rule((Term(0, 24),), 3, 255, deaf=12),))
SPEC = DecideSpec(
    0.2, 0.4, 0.2, 0.5, 0.3, least_s=0.1, switch_s=0.1, end_s=0.1, hold_s=0.0, rest_s=0.1, wait_s=0.3, gate=GATES,
    health=HealthSettings((-1500,) * 3, (1500,) * 3, fault_ms=150, still_ms=300, recover_ms=100),
)  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
@settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow])
@given(STREAMS, SPECS)
def test_replay_is_live(engine: str, frames: Frames, spec: DecideSpec) -> None:
    same(BUNDLE, spec, engine, frames)


@pytest.mark.parametrize("engine", ENGINES)
def test_with_every_trouble_and_events_of_both_kinds(engine: str) -> None:
    """That the test above is worth something: all of it happens, in one stream."""
    troubles = [(kind, (n + 1) / 10, 40) for n, kind in enumerate(TROUBLES)]
    frames = stream(3, 4000, [*troubles, ("back", 0.385, 30), ("garbage", 0.38, 60)])
    decisions = same(BUNDLE, SPEC, engine, frames)
    events = events_of(decisions)
    assert {e[0] for e in events} >= {"begun", "ended"} and {e[4] for e in events} == {"cnn", "gate"}
    assert {d.state for d in decisions} == {"warming", "tracking", "no signal", "sensor fault"}
    assert sum(d.state == "sensor fault" for d in decisions) >= 3
    times = [d.t_s for d in decisions]
    assert times == sorted(times)


def test_an_event_that_a_fault_ends_ends_with_the_fault() -> None:
    frames = stream(5, 900, [("garbage", 0.6, 90)])
    spec = argmax_spec()
    spec = DecideSpec(**{**spec.__dict__, "health": HealthSettings(fault_ms=150, recover_ms=100)})
    decisions = same(BUNDLE, spec, "int8", frames)
    fault = next(d for d in decisions if d.state == "sensor fault")
    assert [(e.kind, e.t_s) for e in fault.events] == [("ended", fault.t_s)]


@pytest.mark.parametrize("padding", ["causal", "mirror"])
def test_networks_that_recompute_their_window_too(padding: str) -> None:
    same(make_bundle(padding), SPEC, "float", stream(7, 700, [("gap", 0.5, 40), ("stuck", 0.7, 40)]))


def test_time_over_a_clock_reset_goes_by_a_period_that_is_no_whole_number_of_milliseconds() -> None:
    table = load_layout("accel-3").to_dict()
    table["rate_hz"] = 60.0
    layout = Layout.from_dict(table)
    assert layout.period_us % 1000
    bundle = make_bundle()
    bundle = type(bundle)(bundle.arch, bundle.weights, layout, bundle.scaler, bundle.gestures)
    same(bundle, argmax_spec(), "float", stream(2, 900, [("back", 0.3, 5), ("back", 0.6, 5)]))


@pytest.mark.parametrize("engine", ENGINES)
def test_the_steps_of_a_trace_are_the_batch_answers_of_whole_windows(engine: str) -> None:
    """live == trace (above), and trace == batch: so live == batch, to the step."""
    frames = stream(11, 1500, [("gap", 0.4, 40), ("back", 0.7, 3), ("slow", 0.8, 50)])
    model = integer_model(BUNDLE, SPEC)
    trace = trace_of(frames, BUNDLE if engine == "float" else model, HealthSettings(fault_ms=0))
    span, step = BUNDLE.arch.span, BUNDLE.arch.step
    seen = 0
    for part in trace.parts:
        assert len(part.logits) == max(0, (len(part.inputs) - span) // step + 1)
        for n, logits in enumerate(part.logits):
            window = part.inputs[n * step : n * step + span].T[None]
            if engine == "int8":
                wanted = model.network.forward(window)[0]
                np.testing.assert_array_equal(logits, wanted)
            else:
                wanted = integer_logits(BUNDLE.network().forward(BUNDLE.scaler.apply(window))[0])
                assert np.abs(logits - wanted).max() <= 1, "float rounding only"
            seen += 1
        of_samples = part.start_us + trace.period_us * np.arange(len(part.inputs))
        assert trace.step_times_us(part).tolist() == of_samples[span - 1 :: step].tolist(), "when a window is complete"
    assert len(trace.parts) == 3 and seen > 200
    assert trace.seconds == pytest.approx(sum(len(p.inputs) for p in trace.parts) / 100)


def test_nothing_at_all() -> None:
    empty = Frames(np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64), None)
    trace = trace_of(empty, BUNDLE)
    assert (trace.parts, trace.faults, trace.seconds, trace.first_ms) == ((), 0, 0.0, 0)
    assert replay(trace, SPEC.rules(0.05), 9000).updates == ()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_real_stream(engine: str, real_data: Path) -> None:
    path = real_data / "makeability-gestures" / "P01" / "fulldatastream.csv"
    frames = read_stream(path, load_layout("accel-3")).frames
    # Around both resets of this session's clock.
    resets = np.flatnonzero(np.diff(frames.device_ms) < 0)
    assert len(resets) == 2
    for at in resets.tolist():
        decisions = same(BUNDLE, SPEC, engine, frames.slice(max(0, at - 1500), at + 1500))
        assert any(e[0] == "begun" for e in events_of(decisions))


@pytest.mark.parametrize("engine", ENGINES)
def test_self_calibration_over_a_glitch_and_a_reboot_with_another_sensor(engine: str) -> None:
    bundle, at = replace(BUNDLE, layout=replace(BUNDLE.layout, self_calibration=("x", "y", "z"))), 1500
    spec = replace(SPEC, health=HealthSettings(fault_ms=150, recover_ms=100))
    frames = stream(3, 3000, [("back", 0.2, 40), ("garbage", 0.3, 60), ("stray", 0.4, 80), ("garbage", 0.49, 60)])
    frames.values[:at] = frames.values[:at] * 3 + 4000
    frames.device_ms[at:] -= frames.device_ms[at]
    frames = replace(frames, host_ms=np.arange(len(frames)) * 10 + np.where(np.arange(len(frames)) < at, 0, 10**8))
    decisions = same(bundle, spec, engine, frames)
    assert sum(d.state == "no signal" for d in decisions) >= 3 and any(d.state == "sensor fault" for d in decisions)
    fresh = lived(reader_of(bundle, spec, engine), frames.slice(at + 1, len(frames)))
    shares = [d.probabilities for d in fresh if d.probabilities is not None]
    assert [d.probabilities for d in decisions if d.probabilities is not None][-len(shares) :] == shares


def test_silence_in_the_middle_ends_the_event_and_the_stream_goes_on() -> None:
    frames = stream(5, 900, [])
    reader = reader_of(BUNDLE, argmax_spec(), "float")
    first = lived(reader, frames.slice(0, 500))
    assert first[-1].state == "no signal" and [e.kind for e in first[-1].events] == ["ended"]
    after = lived(reader, frames.slice(500, 900))
    assert after[0].state == "tracking", "the gap was none on the toy's clock"
    assert next(e.number for d in after for e in d.events) == first[-1].events[0].number + 1


def test_updates_become_whole_events() -> None:
    updates = [
        Update(BEGUN, 1, 3, NO_GESTURE, GATE, 900_000, 1_000_000),
        Update(NAMED, 1, 3, 2, GATE, 900_000, 1_500_000),
        Update(ENDED, 1, 3, 2, GATE, 1_700_000, 2_000_000),
        Update(BEGUN, 2, 0, NO_GESTURE, CNN, 2_000_000, 3_000_000),
        Update(NAMED, 2, 1, 0, CNN, 2_000_000, 3_250_000),
        Update(BEGUN, 3, 2, 1, CNN, 4_000_000, 4_500_000),
    ]
    ended, named, last = reported_events(updates)
    assert ended == ReportedEvent(1.0, 2.0, 2, 1.5, 3, GATE)
    assert named == ReportedEvent(3.0, 4.5, 0, 3.25, 1, CNN), "it has not ended, and got its affect with its name"
    assert last == ReportedEvent(4.5, 4.5, 1, 4.5, 2, CNN)
    assert reported_events([]) == []


@pytest.mark.parametrize("engine", ENGINES)
def test_an_event_of_the_gate_without_affect_and_gesture(engine: str) -> None:
    rule = Rule((Term(0, 24),), 0, NO_GESTURE, deaf=12)
    spec = replace(SPEC, gate=replace(GATES, rules=(rule,)), enter=1.0, enter_affect=2.0, wait_s=0.5)
    found = events_of(same(BUNDLE, spec, engine, stream(3, 900, [("blow", 0.3, 40), ("blow", 0.6, 3)])))
    assert {(e[2], e[3]) for e in found} == {("none", None)} and len(found) >= 4


def test_a_replayer_gives_the_events_of_settings_with_or_without_its_cache() -> None:
    replayer = TraceReplayer(trace_of(stream(5, 900, []), BUNDLE))
    spec = argmax_spec()
    events = replayer.events(spec)
    assert events and events == reported_events(replayer.replay(spec.rules(replayer.step_s), replayer.weight(0.0)))
    assert replayer.weight(0.0) == 1 << 15 and 0 < replayer.weight(0.3) < 1 << 14
    one = replayer.smoothed(9000)
    assert np.array_equal(one[0].shares, replayer.smoothed(9000)[0].shares)
    replayer.clear_cache()
    assert replayer.events(spec) == events
    assert np.array_equal(one[0].shares, replayer.smoothed(9000)[0].shares)
