"""Small models and streams with every trouble that a real one has."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.recfile import Frames
from plushsense.core.signal import load_layout
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
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


def make_frames(layout: str = "accel-3", seed: int = 0) -> Frames:
    """A jittery stream: a bridged gap (100 ms), a restart (101 ms), 30 Hz, a clock reset; some garbage."""
    chosen = load_layout(layout)
    draw = np.random.default_rng(seed)
    steps = draw.integers(7, 14, 400)
    steps[120], steps[240] = 100, 101
    steps[300:] = 33
    time = 5_000 + np.cumsum(steps)
    time[330:] -= time[330] - 7
    values = np.cumsum(draw.integers(-40, 41, (400, chosen.n_channels)), axis=0)
    values[::37, 1] = 40_000
    values[241:244, 0] = -40_000
    return Frames(values.astype(np.int64), time.astype(np.int64), time.astype(np.int64) + 1_700_000_000_000)


@pytest.fixture()
def bundle():
    """``make_bundle`` for a test."""
    return make_bundle


@pytest.fixture()
def frames():
    """``make_frames`` for a test."""
    return make_frames
