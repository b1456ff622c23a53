"""Settings that follow the layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from plushsense.core.layouts import load_layout
from plushsense.dataset.store import Dataset
from plushsense.models.arch import DEFAULT_FILTERS, DEFAULT_SYMBOL, VECTOR_FILTERS, VECTOR_SYMBOL, symbol_at_rate
from plushsense.training.spec import VECTOR_TRAINING
from plushsense.workflow.config import RunConfig, from_settings, from_stored, resolve
from plushsense.workflow.preparation import network_for, prepare, prepare_training


def test_the_default_network_follows_the_rate_of_the_layout() -> None:
    slow = replace(load_layout("accel-3"), rate_hz=25.0)
    assert network_for(RunConfig(), slow) == ("v4_9d1_19d1", VECTOR_FILTERS, "stream")
    assert network_for(RunConfig(), load_layout("accel-3"))[0] == VECTOR_SYMBOL
    assert network_for(from_settings(arch=VECTOR_SYMBOL), slow)[0] == VECTOR_SYMBOL
    paper = symbol_at_rate(DEFAULT_SYMBOL, slow.rate_hz)
    assert network_for(from_settings(preset="paper"), slow) == (paper, DEFAULT_FILTERS, "mirror")
    assert paper != DEFAULT_SYMBOL


def test_augmentations_that_are_given_stay_with_any_network(dataset: Dataset, tmp_path: Path) -> None:
    assert prepare(dataset, from_settings()).training.augment == VECTOR_TRAINING["augment"]
    for given in ({"augment": ["random-rotation:45"]}, {"turn_deg": 45}):
        run = prepare(dataset, from_settings(**given))
        assert run.model.arch == VECTOR_SYMBOL and run.training.augment[0].startswith("random-rotation:45"), given
    path = tmp_path / "run.toml"
    path.write_text('[training]\naugment = ["random-rotation:45"]\n')
    run = prepare(dataset, resolve(path))
    assert run.training.augment == ("random-rotation:45",)
    assert "given" not in run.to_json()


def test_a_network_with_a_vector_layer_has_a_batch_of_its_own_in_the_preset_people(dataset: Dataset) -> None:
    def batch(**settings: object) -> int:
        return prepare(dataset, from_settings(**settings)).training.batch

    assert (batch(), batch(augment=["random-tilt:8"]), batch(epochs=3)) == (32, 32, 32)
    assert (batch(batch=64), batch(preset="loso"), batch(arch="14d1_19d2_19d4", filters="8,12,16")) == (64, 64, 64)
    assert prepare(dataset, from_settings()).changes == ""
    assert prepare(dataset, from_settings(batch=64)).changes == "batch 64"


def test_the_preset_has_its_own_epochs_for_windows_anywhere_and_vectors(dataset: Dataset) -> None:
    for given in ({"context": "anywhere"}, {"train_context": "anywhere"}):
        run = prepare(dataset, from_settings(**given))
        assert (run.training.epochs, run.training.halve_every) == (30, 8), given
        assert not run.changes
        asked = prepare(dataset, from_settings(epochs=60, **given)).training
        assert (asked.epochs, asked.halve_every) == (60, 15), "epochs that are given stay"
        plain = prepare(dataset, from_settings(arch="14d1_19d2_19d4", **given)).training
        assert (plain.epochs, plain.halve_every) == (60, 15), "without a vector layer"
    assert prepare_training(dataset, from_settings(train_context="anywhere")).run.training.epochs == 60
    assert prepare(dataset, from_settings(context="anywhere", preset="loso")).training.epochs == 150


def test_settings_that_differ_from_the_preset_stay_without_being_named(dataset: Dataset) -> None:
    config = from_settings()
    training = replace(config.training, batch=16, epochs=5, augment=("random-gain:0.1",))
    made = prepare(dataset, replace(config, training=training)).training
    assert (made.batch, made.epochs, made.augment) == (16, 5, ("random-gain:0.1",))
    assert made.halve_every == config.training.halve_every


def test_a_stored_evaluation_keeps_its_stride(dataset: Dataset) -> None:
    for stride in (1, 2, 4):
        stored = prepare(dataset, from_settings(stride=stride)).to_json()
        assert from_stored(stored).training.stride == stride
    assert prepare(dataset, from_settings()).training.stride == 2, "a network with a vector layer"
    assert prepare(dataset, from_settings(context="anywhere")).training.stride == 4
    assert prepare(dataset, from_settings(arch="14d1_19d2_19d4")).training.stride == 4


def test_a_stored_evaluation_keeps_its_pooling(dataset: Dataset) -> None:
    run = prepare(dataset, from_settings())
    assert (run.network.pooling, run.changes) == ("mean+deviation", "")
    assert prepare(dataset, from_stored(run.to_json())).network == run.network
    mean = prepare(dataset, from_settings(pooling="mean"))
    assert (mean.network.pooling, mean.changes) == ("mean", "pooling mean") and mean.id != run.id
    # As earlier versions stored it.
    assert "pooling" not in mean.to_json()["model"]
    assert prepare(dataset, from_stored(mean.to_json())).network == mean.network
    few = prepare(dataset, from_settings(pool_s=0.45))
    assert (few.network.pooling, few.changes) == ("mean", "pool_s 0.45")
