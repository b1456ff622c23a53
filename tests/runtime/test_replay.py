"""A quick replay is the real one, whatever the settings, with suspect samples and a gate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.gestures import GestureSet
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.events import NO_GESTURE
from plushsense.runtime.fixed import smoothing_weight
from plushsense.runtime.gate import JERK, LEVEL, GateSettings, Rule, Signal, Term
from plushsense.runtime.trace import TraceReplayer, replay, trace_of

GATE = GateSettings(
    (Signal(JERK, (0, 1, 2), lag=2, floor=40), Signal(LEVEL, (2,), floor=60)),
    (Rule((Term(0, 40),), 3, 2, deaf=20), Rule((Term(1, 50, 1),), 0, NO_GESTURE, deaf=30)),
)
SPECS = [
    DecideSpec(),
    argmax_spec(),
    argmax_spec(0.3),
    DecideSpec(0.1, 0.4, 0.2, 0.5, 0.3, known_margin=0.2, least_s=0.1, switch_s=0.1, end_s=0.1, hold_s=0.1, rest_s=0.1),
    DecideSpec(
        0.1, 0.9, 0.2, 0.5, 0.6, known_margin=1.0, least_s=0.05, switch_s=0.05, end_s=0.2, rest_s=0.0, wait_s=0.3
    ),
]


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("gate", [GateSettings(), GATE])
def test_every_setting_gives_the_very_events_of_a_replay(bundle, frames, spec, gate):
    model = bundle()
    # One class is idle, and sensors are suspect at times.
    own = model.gestures.gestures
    gestures = GestureSet("four", (own[0], replace(own[1], idle=True), *own[2:]))
    model = replace(model, gestures=gestures)
    spec = replace(spec, gate=gate)
    happened = 0
    for seed in range(4):
        trace = trace_of(frames(seed=seed), model)
        rng = np.random.default_rng(seed)
        parts = tuple(replace(p, suspect=rng.random(len(p.inputs)) < 0.05) for p in trace.parts)
        trace = replace(trace, parts=parts)
        listener = TraceReplayer(trace)
        step_s = trace.arch.step * trace.period_us / 1e6
        weight = smoothing_weight(spec.smoothing_s, step_s)
        expected = list(replay(trace, spec.rules(step_s), weight).updates)
        listener.updates(replace(DecideSpec(), gate=gate))  # an earlier try leaves nothing behind
        assert listener.updates(spec) == expected
        happened += len(expected)
    assert happened or spec == DecideSpec()
