"""Made-up windows that a small network can tell apart: each class its own rhythm, each person their own force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from plushsense.windows.cut import WindowSet
from support.fakes import plain_units

SAMPLES = 60


def make(windows: int, seed: int = 0, channels: int = 2, classes: int = 3, person: str = "P01") -> WindowSet:
    rng = np.random.default_rng(seed)
    y = np.arange(windows) % classes
    time = np.arange(SAMPLES) + rng.integers(0, 30, (windows, 1))
    wave = np.sin(time * 2 * np.pi / (8 + 8 * y[:, None])) * rng.uniform(300, 900, (windows, 1))
    x = wave[:, None, :] + rng.normal(0, 40, (windows, channels, SAMPLES)) + 5000
    nothing = np.full((windows, 2), -1, dtype=np.int64)
    return WindowSet(
        integers=x.astype(np.int32),
        units=plain_units(channels),
        y=y.astype(np.int64),
        labels=tuple(f"gesture {k}" for k in range(classes)),
        affects=("none",) * classes,
        families=tuple(f"gesture {k}" for k in range(classes)),
        recording=np.arange(windows, dtype=np.int64),
        recording_ids=tuple(f"{person}/{n:04d}" for n in range(windows)),
        subject=np.full(windows, person),
        context=np.full(windows, "loop"),
        stream=np.full(windows, ""),
        window_rows=nothing,
        recording_rows=nothing,
        rate_hz=100.0,
        inputs=tuple(f"c{c}" for c in range(channels)),
    )


@pytest.fixture
def made() -> Callable[..., WindowSet]:
    return make
