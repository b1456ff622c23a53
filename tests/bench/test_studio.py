"""The bench of the live page: its figures; its browser is that of tests/studio."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import studio as bench


def test_growth_is_that_of_the_last_two_thirds() -> None:
    steady = [(float(t), 50e6 + 1e6 * (t % 2)) for t in range(60)]
    found = bench.growth(steady)
    assert found["first_mb"] == pytest.approx(found["last_mb"], abs=0.1)
    assert abs(found["kb_per_minute"]) < 200.0
    leaking = [(float(t), 50e6 + 1e5 * t) for t in range(60)]
    assert bench.growth(leaking)["kb_per_minute"] == pytest.approx(6000.0)
    # What is built up at the start does not count.
    warm = [(float(t), 50e6 - 4e7 * (t < 15)) for t in range(60)]
    assert abs(bench.growth(warm)["kb_per_minute"]) < 1.0


def test_quantiles_and_a_process() -> None:
    assert bench.quantiles([float(v) for v in range(101)]) == {"p50": 50.0, "p95": 95.0, "p99": 99.0}
    assert bench.quantiles([]) == {}
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc here")
    assert bench.resident_bytes(os.getpid()) > 1e7
    assert bench.processor_s(os.getpid()) > 0.0
