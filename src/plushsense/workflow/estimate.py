"""Preview a training or an evaluation: windows, folds, cost and an estimate of the time on this machine.

The speed is measured by training the same network on a few of its windows for a few epochs, in this process. The
estimate does not include the time for reading and cutting the data and for fitting decisions.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.evaluation.crossval import fold_windows, train_on_validation
from plushsense.models.arch import Arch
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import RunConfig
from plushsense.workflow.preparation import (
    Warn,
    classes_for,
    network_inputs_of,
    prepare_training,
    refuse_hard_negatives,
    silent,
    windows_for,
)

# Passes of a training step: forward, and backward to the weights and to the previous layer.
PASSES = 3
_BATCHES, _EPOCHS = 3, 3


@dataclass(frozen=True)
class CostEstimate:
    """What a training or an evaluation would train, and its cost.

    Attributes:
        epochs: number of epochs of each training, at most.
        macs: multiply-accumulates of all trainings.
        window_epoch_s: measured seconds to train on one window for one epoch.
        seconds: estimated time of all trainings.
    """

    split: str
    leaky: bool
    context: str
    folds: int
    dataset: str
    simulated: bool
    people: int
    classes: int
    windows: int
    epochs: int
    parameters: int
    macs: int
    window_epoch_s: float
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def preview_training(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> CostEstimate:
    """Return what `api.train` would train on and its cost."""
    made = prepare_training(as_dataset(dataset), config, warn)
    windows, division, config = made.windows, made.division, made.config
    trained = len(division.train) + (len(windows) if division.refit else 0)
    head: dict[str, Any] = {
        "split": division.kind,
        "leaky": division.split.leaky,
        "context": config.windows.context,
        "folds": 1,
    }
    return _estimate(made.dataset, made.network, config, windows, trained, **head)


def preview_evaluation(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> CostEstimate:
    """Return what `api.evaluate` would train on and its cost, without the training itself."""
    refuse_hard_negatives(config)
    dataset, config = network_inputs_of(as_dataset(dataset), config)
    gestures = classes_for(dataset, config.evaluation.classes, config.trained_on.context, warn)
    network = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    score = fit_on = windows_for(dataset, network, config.scored_on, gestures, warn)
    if config.trained_on != config.scored_on:
        fit_on = windows_for(dataset, network, config.trained_on, gestures, anywhere=config.anywhere)
    split = parse_split(config.evaluation.split)
    folds = fold_windows(fit_on, score, split, config.evaluation.seed)
    folds = folds if config.holds_back else train_on_validation(folds)
    head: dict[str, Any] = {
        "split": split.text,
        "leaky": split.leaky,
        "context": config.scored_on.context,
        "folds": len(folds),
    }
    side_by_side = min(config.evaluation.processes, len(folds))
    trained = sum(len(fold.train) for fold in folds)
    return _estimate(dataset, network, config, fit_on, trained, side_by_side, **head)


def _estimate(
    dataset: Dataset,
    network: Arch,
    config: RunConfig,
    windows: WindowSet,
    trained: int,
    side_by_side: int = 1,
    **head: Any,
) -> CostEstimate:
    """Estimate the cost of trainings on ``trained`` of the windows in all; ``head`` describes the split."""
    rate = seconds_a_mac(windows, network, config.training)
    macs = PASSES * network.macs_per_window * trained * config.training.epochs
    return CostEstimate(
        **head,
        dataset=dataset.head.name,
        simulated=dataset.head.simulated,
        people=len(set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}),
        classes=len(windows.labels),
        windows=len(windows),
        epochs=config.training.epochs,
        parameters=network.parameters,
        macs=macs,
        window_epoch_s=rate * PASSES * network.macs_per_window,
        seconds=macs * rate / max(1, side_by_side),
    )


def seconds_a_mac(windows: WindowSet, network: Arch, spec: TrainSpec) -> float:
    """Measure the seconds of training per multiply-accumulate, in the fastest of a few short epochs."""
    from plushsense.training.fit import fit

    few = max(spec.batch, 64) * _BATCHES
    part = windows.take(np.arange(0, len(windows), max(1, len(windows) // few)))
    ends: list[float] = []
    quick = replace(spec, epochs=_EPOCHS, patience=None)
    fit(part, None, network, quick, lambda *_: ends.append(time.perf_counter()))
    shortest = min(after - before for before, after in pairwise(ends))
    return shortest / (PASSES * network.macs_per_window * len(part))
