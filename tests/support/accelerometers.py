"""Recordings of an analogue accelerometer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording

ACCEL = load_layout("accel-3")


def analogue(
    folder: Path, zero: float, one_g: float, period_ms: int = 10, turned: bool = True, people: range = range(3)
) -> Path:
    """Recordings of an accelerometer of 10 bits, held in many directions for a while and moved in between."""
    rng = np.random.default_rng(people.start)
    for p in people:
        (folder / f"P{p}").mkdir(parents=True)
        for take in range(6):
            up = rng.normal(size=3) if turned else np.array([0.0, 0.0, 1.0])
            up /= np.linalg.norm(up)
            rows = 3000 // period_ms
            moves = np.where(np.arange(rows) > rows // 2, 0.8, 0.0) * np.sin(np.arange(rows) * period_ms / 70)
            values = zero + one_g * (up + moves[:, None] * [0.3, 0.5, 0.2]) + rng.normal(0, 0.6, (rows, 3))
            clock = np.arange(rows, dtype=np.int64) * period_ms
            frames = Frames(np.round(values).astype(np.int64), clock, clock + 1_700_000_000_000)
            write_recording(folder / f"P{p}" / f"Wave_{1_700_000_000_000 + take}_{rows}.csv", frames, ACCEL)
    return folder
