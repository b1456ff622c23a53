"""Settings that follow the layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from plushsense.core.layouts import load_layout
from plushsense.models.arch import DEFAULT_SYMBOL, VECTOR_SYMBOL, symbol_at_rate
from plushsense.training.spec import VECTOR_AUGMENT
from plushsense.workflow.config import ModelSpec, RunConfig, from_settings, resolve


def test_the_default_network_follows_the_rate_of_the_layout() -> None:
    slow = replace(load_layout("accel-3"), rate_hz=25.0)
    assert RunConfig().for_layout(slow).model.arch == "v4_9d1_19d1"
    assert RunConfig().for_layout(load_layout("accel-3")).model.arch == VECTOR_SYMBOL
    given = from_settings(arch=VECTOR_SYMBOL)
    assert given.for_layout(slow).model.arch == VECTOR_SYMBOL
    paper = from_settings(preset="paper").for_layout(slow)
    assert paper.model.arch == symbol_at_rate(DEFAULT_SYMBOL, slow.rate_hz) != DEFAULT_SYMBOL
    assert ModelSpec().build(slow, 3, 2.5, "stream").receptive_field == 1 + 3 + 9 + 18


def test_augmentations_that_are_given_stay_with_any_network(tmp_path: Path) -> None:
    layout = load_layout("accel-3")
    assert from_settings().for_layout(layout).training.augment == VECTOR_AUGMENT
    for given in ({"augment": ["random-rotation:45"]}, {"turn_deg": 45}):
        config = from_settings(**given).for_layout(layout)
        assert config.model.arch == VECTOR_SYMBOL and config.training.augment[0].startswith("random-rotation:45"), given
    path = tmp_path / "run.toml"
    path.write_text('[training]\naugment = ["random-rotation:45"]\n')
    assert resolve(path).for_layout(layout).training.augment == ("random-rotation:45",)
    assert "augment_given" not in resolve(path).to_dict()
