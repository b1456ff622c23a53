"""The bench of the live step: its own parts on a small network; continual-inference only where it is installed."""

from __future__ import annotations

import importlib.util

import live as bench
from plushsense.core.layouts import load_layout
from plushsense.runtime.classifier import StreamClassifier


def test_its_parts_run_and_the_networks_agree() -> None:
    bundle = bench.made_up(load_layout("accel-3"), "5d1_4d3")
    lines = bench.lines_of(bundle.layout, bundle.arch.span + (bench.STEPS + 12) * bundle.arch.step)
    found = bench.bytes_to_event(StreamClassifier(bundle), lines)
    assert found["steps"] >= bench.STEPS
    assert 0 < found["processor_ms"]["p50"] <= found["processor_ms"]["p99"] <= found["processor_ms"]["longest"]
    beside = bench.beside(bundle, lines, 1)
    here = importlib.util.find_spec("continual") is not None
    assert len(beside["rows"]) == (4 if here else 2)
    assert beside["rows"][0]["times_slower"] == [1.0, 1.0, 1.0]
    assert beside["logits_apart"] is None if not here else beside["logits_apart"] < 1e-3


def test_a_few_toys() -> None:
    found = bench.many(bench.made_up(load_layout("accel-3"), "5d1"), 3, 0.5)
    assert found["toys"] == 3 and 3 * 8 <= found["decisions"] <= 3 * 12 and found["cpu_s"] > 0
