"""Small models and streams with every trouble that a real one has."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from support.troubles import make_bundle


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
