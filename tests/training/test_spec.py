"""The schedules: the paper's numbers, and settings that are refused."""

from __future__ import annotations

import json

import pytest

from plushsense.core.errors import ConfigError
from plushsense.training.spec import PADDING, PRESETS, TrainSpec, preset


def test_the_papers_schedules() -> None:
    search = PRESETS["search"]
    assert (search.learning_rate, search.halve_every, search.patience, search.epochs) == (0.001, None, None, 250)
    for name in ("loso", "paper"):
        spec = PRESETS[name]
        assert (spec.learning_rate, spec.halve_every, spec.patience, spec.epochs) == (0.003, 30, 10, 150)
        assert spec.stop_on == "loss"
    assert PADDING == {"search": "stream", "loso": "stream", "people": "stream", "paper": "mirror"}
    assert PADDING.keys() == PRESETS.keys()


def test_the_rate_is_halved_every_30_epochs() -> None:
    spec = PRESETS["loso"]
    assert [spec.learning_rate_at(e) for e in (1, 30, 31, 60, 61)] == [0.003, 0.003, 0.0015, 0.0015, 0.00075]
    assert PRESETS["search"].learning_rate_at(250) == 0.001


def test_a_preset_takes_changes() -> None:
    assert preset("loso", epochs=7, seed=3) == TrainSpec(epochs=7, seed=3)
    assert preset("search", epochs=None) == PRESETS["search"]
    json.dumps(preset("people").to_dict())


def test_only_our_preset_leaves_out_positions_and_ids_of_the_others_stay() -> None:
    assert {name for name, spec in PRESETS.items() if spec.stride > 1} == {"people"}
    assert preset("people").to_dict()["stride"] == 4
    assert "stride" not in preset("paper").to_dict() and "stride" not in preset("people", stride=1).to_dict()


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("people", {"stride": 0}, "stride is 0: accepted are whole numbers from 1"),
        ("los", {}, "Did you mean 'loso'"),
        ("loso", {"epoch": 3}, "Did you mean 'epochs'"),
        ("loso", {"epochs": 0}, "epochs is 0: accepted are whole numbers from 1"),
        ("loso", {"batch": 1}, "from 2"),
        ("loso", {"patience": -1}, "patience is -1"),
        ("loso", {"learning_rate": float("nan")}, "learning_rate is nan"),
        ("loso", {"device": "gpu"}, "auto, cpu, cuda"),
        ("loso", {"stop_on": "los"}, "Did you mean 'loss'"),
    ],
)
def test_settings_that_are_refused(name: str, changes: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        preset(name, **changes)
    assert says in str(refusal.value)
