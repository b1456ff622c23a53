"""Recordings as one stream for a toy: gaps and resets kept, some of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.dataset.index import open_dataset
from plushsense.deploy.proof.vectors import recorded_frames
from plushsense.windows.clock import SampleClock


def test_recorded_frames_recordings(recorded: Path) -> None:
    dataset, layout = open_dataset(recorded), load_layout("accel-3")
    frames = recorded_frames(dataset, layout, rows=10_000)
    assert len(frames) == 600 + 120 + 60 and frames[:, 0].min() >= 0 and frames[:, 0].max() < 1 << 32
    clock = SampleClock(layout)
    restarts = []
    for at, (ms, *values) in enumerate(frames.tolist()):
        clock.push(ms, values)
        if clock.restarted:
            restarts.append(at)
    assert restarts in ([300, 600, 720], [300, 600, 660]), "the stream's own, and before each recording"
    share = recorded_frames(dataset, layout, rows=240)
    assert len(share) == 240 and (np.diff(share[:, 0]) > 100).sum() == 2, "some of each"
    assert len(recorded_frames(dataset, layout, subjects=["B"], rows=10_000)) == 180
    with pytest.raises(ConfigError, match="has nobody 'C': accepted are A, B"):
        recorded_frames(dataset, layout, subjects=["C"], rows=1)
    with pytest.raises(ConfigError, match="holds layout 'accel-3'"):
        recorded_frames(dataset, load_layout("plush-15"), rows=1)
