"""Settings that follow the layout."""

from __future__ import annotations

from dataclasses import replace

from plushsense.core.layouts import load_layout
from plushsense.models.arch import DEFAULT_SYMBOL, VECTOR_SYMBOL, symbol_at_rate
from plushsense.workflow.config import ModelSpec, RunConfig, from_settings


def test_the_default_network_follows_the_rate_of_the_layout() -> None:
    slow = replace(load_layout("accel-3"), rate_hz=25.0)
    assert RunConfig().for_layout(slow).model.arch == "v4_9d1_19d1"
    assert RunConfig().for_layout(load_layout("accel-3")).model.arch == VECTOR_SYMBOL
    given = from_settings(arch=VECTOR_SYMBOL)
    assert given.for_layout(slow).model.arch == VECTOR_SYMBOL
    paper = from_settings(preset="paper").for_layout(slow)
    assert paper.model.arch == symbol_at_rate(DEFAULT_SYMBOL, slow.rate_hz) != DEFAULT_SYMBOL
    assert ModelSpec().build(slow, 3, 2.5, "stream").receptive_field == 1 + 3 + 9 + 18
