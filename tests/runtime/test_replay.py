"""The vectorised replay gives exactly the events of the machine, whatever the stream, the settings and the gate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from plushsense.core.gestures import GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.runtime.decisions import DecideSpec, Rules, argmax_spec
from plushsense.runtime.events import ONE, EventSettings
from plushsense.runtime.fixed import smoothing_weight
from plushsense.runtime.gate import Gate, GateSettings
from plushsense.runtime.replay import TraceReplayer, firings
from plushsense.runtime.trace import Trace, replay, reported_events, trace_of
from support.made_traces import GATE, STEP_S, made_trace
from support.troubles import SPECS, STREAMS, make_bundle

pytestmark = pytest.mark.slow


def equal(replayer: TraceReplayer, rules: Rules, weight: int) -> bool:
    """Whether there are updates, which are those of the machine."""
    updates = replayer.replay(rules, weight)
    assert updates == list(replay(replayer.trace, rules, weight).updates)
    for part, fired in zip(replayer.trace.parts, replayer.hits(rules.gate), strict=True):
        gate = Gate(rules.gate)
        samples = zip(part.inputs.tolist(), part.suspect.tolist(), strict=True)
        found = [(at, rule) for at, (row, doubt) in enumerate(samples) if (rule := gate.push(row, doubt)) >= 0]
        assert fired == found == firings(rules.gate, [part.inputs], [part.suspect])[0]
    return bool(updates)


def random_trace(draw: np.random.Generator) -> Trace:
    # Slow swings, so that something lasts; a noisy part; and one that is too short for any answer.
    parts = [np.cumsum(draw.normal(0, swing, (n, 4)), axis=0) for swing, n in ((120, 300), (400, 80), (0, 0), (60, 40))]
    inputs = np.cumsum(draw.integers(-9, 10, (1600, 3)), axis=0) + 400 * (draw.random((1600, 1)) > 0.99)
    return made_trace(parts, inputs, tuple(draw.integers(0, 900, 40).tolist()))


def random_settings(draw: np.random.Generator) -> EventSettings:
    counts = {name: int(draw.integers(low, 9)) for low, name in ((1, "least"), (1, "switch"), (1, "end"), (0, "hold"))}
    return EventSettings(
        enter=int(draw.integers(0, ONE)),
        leave=int(draw.integers(0, ONE)),
        enter_affect=int(draw.integers(ONE // 3, ONE + 2)),
        leave_affect=int(draw.integers(0, ONE)),
        known=int(draw.integers(-2000, 2000)),
        rest=int(draw.integers(0, 20)),
        wait=int(draw.integers(0, 20)),
        **counts,
    )


@settings(max_examples=25)
@given(st.integers(0, 2**32))
def test_random_answers_and_settings(seed: int) -> None:
    draw = np.random.default_rng(seed)
    replayer = TraceReplayer(random_trace(draw))
    # What the first settings left in the cache does not matter.
    for gate, smoothing_s in ((GateSettings(), 0.2 * (seed % 2)), (GATE, 0.2)):
        equal(replayer, Rules(random_settings(draw), gate), smoothing_weight(smoothing_s, STEP_S))


@settings(max_examples=20, suppress_health_check=[HealthCheck.too_slow])
@given(STREAMS, SPECS)
def test_a_network_on_troubled_streams(frames: Frames, spec: DecideSpec) -> None:
    bundle = make_bundle()
    own = bundle.gestures.gestures
    bundle = replace(bundle, gestures=GestureSet("four", (own[0], replace(own[1], idle=True), *own[2:])))
    replayer = TraceReplayer(trace_of(frames, bundle, spec.health))
    equal(replayer, spec.rules(replayer.step_s), replayer.weight(spec.smoothing_s))


def test_much_happens_in_random_traces() -> None:
    """That the tests above are worth something."""
    draw = np.random.default_rng(0)
    replayer = TraceReplayer(random_trace(draw))
    gate = replace(GATE, signals=(replace(GATE.signals[0], floor=4),))
    spec = replace(argmax_spec(0.2), gate=gate, rest_s=0.0)
    assert equal(replayer, spec.rules(replayer.step_s), replayer.weight(0.2))
    events = replayer.events(spec)
    assert events == reported_events(replayer.updates(spec)) and len(events) > 10
    assert {event.source for event in events} == {0, 1} and all(e.start_s <= e.named_s <= e.stop_s for e in events)
