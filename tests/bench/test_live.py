"""The bench of the live step: its own parts on a small network."""

from __future__ import annotations

import live as bench
from plushsense.core.layouts import load_layout
from plushsense.runtime.classifier import StreamClassifier


def test_a_step_is_timed_from_bytes_to_event() -> None:
    bundle = bench.made_up(load_layout("accel-3"), "5d1_4d3")
    lines = bench.lines_of(bundle.layout, bundle.arch.span + 200 * bundle.arch.step)
    found = bench.bytes_to_event(StreamClassifier(bundle), lines)
    assert found["steps"] >= 195
    assert 0 < found["processor_ms"]["p50"] <= found["processor_ms"]["p99"] <= found["processor_ms"]["longest"]


def test_a_few_toys() -> None:
    found = bench.many(bench.made_up(load_layout("accel-3"), "5d1"), 3, 0.5)
    assert found["toys"] == 3 and 3 * 8 <= found["decisions"] <= 3 * 12 and found["cpu_s"] > 0
