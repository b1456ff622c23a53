"""What work would take, before it is begun."""

from __future__ import annotations

from dataclasses import replace

import pytest

import plushsense as ps
from plushsense.dataset.store import Dataset
from plushsense.experiments.sweep.run_sweep import SweepSpec, preview
from plushsense.workflow.config import from_settings
from plushsense.workflow.estimate import PASSES, preview_evaluation, preview_training
from plushsense.workflow.preparation import prepare

pytestmark = pytest.mark.apart("trainings")

CONFIG = from_settings(filters=(4, 4, 4), context="loop", epochs=2)


def test_a_training_is_told_as_it_then_is(dataset: Dataset) -> None:
    config = replace(CONFIG, training=replace(CONFIG.training, epochs=3))
    told = preview_training(dataset, config)
    done = ps.train(dataset, config, fit_decisions=False)
    arch = done.bundle.arch
    assert told.parameters == arch.parameters
    assert told.classes == len(done.bundle.gestures)
    assert (told.split, told.leaky, told.epochs) == (done.scores.split, False, 3)
    # Without the people held back, then a third of the epochs on everybody.
    trained = 3 * (told.windows - done.scores.windows) + told.windows
    assert told.macs == PASSES * arch.macs_per_window * trained
    assert told.seconds > 0
    longer = preview_training(dataset, replace(config, training=replace(config.training, epochs=300)))
    assert longer.macs == 100 * told.macs


def test_an_evaluation_is_told_as_it_then_is(dataset: Dataset) -> None:
    config = replace(CONFIG, evaluation=replace(CONFIG.evaluation, split="windows:3", workers=1))
    told = preview_evaluation(dataset, config)
    done = ps.evaluate(dataset, config)
    sizes = [fold.record.windows[0] for fold in done.scores.folds]
    assert (told.split, told.leaky, told.folds) == ("windows:3", True, len(sizes))
    arch = prepare(dataset, config).network
    assert told.macs == PASSES * arch.macs_per_window * sum(sizes) * 2


def test_grids_are_measured_where_it_is_asked_for(dataset: Dataset) -> None:
    small = {"filters": "4,4", "epochs": "1,2", "batches": "full", "split": "by-subject:2"}
    one = SweepSpec(changes={**small, "architectures": "14d1_5d1"})
    assert preview(dataset, one).seconds is None
    whole = preview(dataset, one, measure=True)
    assert whole.problems == () and whole.seconds and whole.seconds > 0
    halving = {**small, "halving": True, "architectures": "14d1_5d1,9d1_5d1,5d1_5d1"}
    halved = preview(dataset, SweepSpec(changes=halving), measure=True)
    assert halved.halving and halved.seconds and halved.seconds > 0
