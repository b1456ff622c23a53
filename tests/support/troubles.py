"""Streams with the troubles of a real one, drawn at random; and what a live loop and a trace make of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.deploy.quantize import calibrated, integer_model
from plushsense.devices.base import Frame
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import Decision, IntegerClassifier, StreamClassifier, StreamReader
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ANSWERS, KINDS, NO_GESTURE, SOURCES
from plushsense.runtime.fixed import smoothing_weight
from plushsense.runtime.gate import JERK, LEVEL, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.trace import Replayed, replay, trace_of
from plushsense.windows.features import Scaler

GESTURES = GestureSet(
    "four",
    (Gesture("tap", "positive"), Gesture("hold", "neutral"), Gesture("hit", "negative"), Gesture("other")),
)


def make_bundle(padding: str = "stream", layout: str = "accel-3", **decision) -> Bundle:
    """A model with weights of no meaning; the step is not a divisor of the span."""
    chosen = load_layout(layout)
    arch = Arch.parse("5d1_4d3", (6, 5), channels=chosen.n_inputs, classes=4, padding=padding, window=48, step=5)
    scaler = Scaler(np.linspace(-50, 60, chosen.n_inputs), np.linspace(0.01, 0.02, chosen.n_inputs))
    return Bundle(arch, random_weights(arch, 3), chosen, scaler, GESTURES, decision=decision)


BAD = 40_000  # beyond the valid range of accel-3
STUCK = 3_000  # inside it, beyond what people reach
TROUBLES = ("gap", "back", "equal", "garbage", "stuck", "still", "slow", "blow", "stray")


def stream(seed: int, length: int, troubles: list[tuple[str, float, int]]) -> Frames:
    """``length`` frames of three channels; each trouble is (kind, where from 0 to 1, how many frames)."""
    draw = np.random.default_rng(seed)
    steps = draw.integers(7, 14, length)
    values = np.cumsum(draw.integers(-40, 41, (length, 3)), axis=0) % 900
    for kind, where, long in troubles:
        at = int(where * (length - 1)) + 1
        if kind == "slow":
            steps[at : at + long] = 34
        if kind == "equal":
            steps[at : at + long] = 0
        if kind == "blow":
            values[at : at + long] += draw.integers(-2000, 2000, (len(values[at : at + long]), 3))
        if kind == "garbage":
            values[at : at + long, long % 3] = BAD
        if kind == "stuck":
            values[at : at + long, long % 3] = STUCK
        if kind == "still":
            values[at : at + long] = values[at - 1]
    time = 5_000 + np.cumsum(steps)
    for kind, where, long in troubles:
        at = int(where * (length - 1)) + 1
        if kind == "gap":
            time[at:] += 50 + 5 * long
        if kind == "back" and at < length:
            time[at:] -= time[at] - long
        if kind == "stray":  # single frames with an impossible time, or a few in turn
            time[at : at + 1 + long // 40] = long % 2 * 10**9
    time -= min(0, int(time.min()))  # several steps back: no clock of a toy is below 0
    return Frames(values.astype(np.int64), time.astype(np.int64), None)


STREAMS = st.builds(
    stream,
    st.integers(0, 1000),
    st.integers(1, 500),
    st.lists(st.tuples(st.sampled_from(TROUBLES), st.floats(0, 1), st.integers(0, 90)), max_size=6),
)
_SHARE = st.floats(0, 1)
_SECONDS = st.sampled_from([0.0, 0.05, 0.1, 0.25, 0.6])
GATES = st.sampled_from(
    [
        GateSettings(),
        GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=60),), (Rule((Term(0, 24),), 3, NO_GESTURE, deaf=12),)),
        GateSettings(
            (Signal(LEVEL, (1,), floor=40), Signal(JERK, (0,), floor=30)),
            (Rule((Term(0, 40, 1), Term(1, 20, times=1)), 1, 2, deaf=30), Rule((Term(0, 60, -1, 3),), 0, 255, deaf=5)),
        ),
    ]
)
HEALTHS = st.builds(
    HealthSettings,
    st.just((-1500, -1500, -1500)),
    st.just((1500, 1500, 1500)),
    fault_ms=st.sampled_from([0, 150, 400]),
    still_ms=st.sampled_from([0, 200]),
    recover_ms=st.sampled_from([0, 100]),
)
SPECS = st.builds(
    DecideSpec,
    smoothing_s=st.sampled_from([0.0, 0.3]),
    enter=_SHARE,
    leave=_SHARE,
    enter_affect=_SHARE,
    leave_affect=_SHARE,
    sure=_SHARE,
    known_margin=st.one_of(st.none(), st.floats(0, 3)),
    least_s=_SECONDS,
    switch_s=_SECONDS,
    end_s=_SECONDS,
    hold_s=_SECONDS,
    rest_s=_SECONDS,
    wait_s=_SECONDS,
    gate=GATES,
    health=HEALTHS,
)


def calibrate(bundle: Bundle) -> Bundle:
    """The bundle with a calibration on such streams, so that it can be deployed."""
    values = stream(1, 3000, []).values
    windows = np.stack([values[at : at + bundle.arch.span].T for at in range(0, 2900, 40)])
    return calibrated(bundle, windows.astype(np.int32))


def reader_of(bundle: Bundle, spec: DecideSpec, engine: str) -> StreamReader:
    return StreamClassifier(bundle, spec) if engine == "float" else IntegerClassifier(integer_model(bundle, spec))


def lived(reader: StreamReader, frames: Frames) -> list[Decision]:
    """Every decision of the live loop, and in the end that nothing more is heard."""
    host = np.zeros(len(frames), dtype=np.int64) if frames.host_ms is None else frames.host_ms
    rows = zip(host.tolist(), frames.device_ms.tolist(), frames.values.tolist(), strict=True)
    return [d for now, ms, row in rows for d in reader.push(Frame(now, ms, tuple(row)))] + [reader.silence()]


def events_of(decisions: list[Decision]) -> list[tuple[Any, ...]]:
    return [
        (e.kind, e.number, e.affect, e.gesture, e.source, round(e.since_s * 1e6), round(e.t_s * 1e6))
        for d in decisions
        for e in d.events
    ]


def replayed(bundle: Bundle, spec: DecideSpec, engine: str, frames: Frames) -> tuple[Replayed, int]:
    """What a trace and its replay make of the same stream, and how many faults."""
    step_s = bundle.arch.step * bundle.layout.period_us / 1e6
    trace = trace_of(frames, bundle if engine == "float" else integer_model(bundle, spec), spec.health)
    weight = smoothing_weight(spec.smoothing_s, step_s)
    return replay(trace, spec.rules(step_s), weight), trace.faults


def same(bundle: Bundle, spec: DecideSpec, engine: str, frames: Frames) -> list[Decision]:
    """Assert that live and replay say the same, to the step and the microsecond; the live decisions."""
    reader = reader_of(bundle, spec, engine)
    decisions = lived(reader, frames)
    found, faults = replayed(bundle, spec, engine, frames)
    labels, affects = bundle.gestures.labels, ("none", "positive", "neutral", "negative")
    assert events_of(decisions) == [
        (
            KINDS[u.kind], u.number, affects[u.affect], None if u.gesture == NO_GESTURE else labels[u.gesture],
            SOURCES[u.source], u.since, u.now,
        )
        for u in found.updates
    ]  # fmt: skip
    assert reader.faults == faults
    steps = [d for d in decisions if d.answer is not None]
    assert [(round(d.t_s * 1e6), d.answer) for d in steps] == [(t, ANSWERS[a.kind]) for t, a in found.answers]
    if engine == "int8":
        assert [(d.gesture, d.confidence) for d in steps] == [
            (labels[a.best], a.share / (1 << 15)) for _, a in found.answers
        ]
    return decisions


TOUCH = GestureSet(
    "touch", (Gesture("rest", "neutral", idle=True), Gesture("stroke", "positive"), Gesture("hit", "negative"))
)


def knowing_bundle(**decision: Any) -> Bundle:
    """A network made by hand that knows three touches of `toy_frames` by how much x, y and z move."""
    layout = load_layout("accel-3")
    arch = Arch.parse("3", (2,), channels=3, classes=3, window=48, step=5)
    move = np.zeros((2, 3, 3), dtype=np.float32)
    move[0, :, 2], move[0, :, 0] = 1, -1
    move[1] = -move[0]
    # The mean movement m of a window: rest up to 20, stroke up to 230, hit above.
    weights = random_weights(arch, 0) | {
        "conv0.weight": move,
        "conv0.bias": np.zeros(2),
        "norm0.gain": np.ones(2),
        "norm0.shift": np.zeros(2),
        "norm0.mean": np.zeros(2),
        "norm0.var": np.ones(2),
        "dense.weight": np.array([[-0.1, -0.1], [0, 0], [0.03, 0.03]]),
        "dense.bias": np.array([2.0, 0, -7.0]),
    }
    weights = {name: np.asarray(values, dtype=np.float32) for name, values in weights.items()}
    bundle = Bundle(arch, weights, layout, Scaler(np.zeros(3), np.ones(3)), TOUCH, decision=decision)
    values = toy_frames("rest stroke hit rest")
    windows = np.stack([values[at : at + arch.span].T for at in range(0, len(values) - arch.span, 10)])
    return calibrated(bundle, windows.astype(np.int32))


def toy_frames(touches: str, seconds: float = 2.0, seed: int = 0) -> np.ndarray:
    """(T, 3) of these touches in turn, 100 frames a second."""
    draw = np.random.default_rng(seed)
    n = round(100 * seconds)
    made = []
    for touch in touches.split():
        t = np.arange(n) / 100
        size, hz = {"rest": (0, 1), "stroke": (150, 3), "hit": (1000, 14)}[touch]
        wave = size * np.sin(2 * np.pi * hz * t) * np.minimum(1, np.minimum(t, t[::-1]) / 0.2)
        made.append(np.stack([wave, 0.6 * wave, 250 + 0.3 * wave], axis=1))
    return np.rint(np.concatenate(made) + draw.normal(0, 1.5, (len(made) * n, 3))).astype(np.int64)
