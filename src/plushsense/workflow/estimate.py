"""Preview a training or an evaluation: windows, folds, cost and an estimate of the time on this machine.

The speed is measured by training the same network on a few of its windows for a few epochs, in this process. The
estimate does not include the time for reading and cutting the data and for fitting decisions.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.evaluation.crossval import fold_windows, train_on_validation
from plushsense.models.arch import Arch
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import RunConfig
from plushsense.workflow.preparation import Run, Warn, prepare, prepare_training, silent

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

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def preview_training(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> CostEstimate:
    """Return what `api.train` would train on and its cost."""
    made = prepare_training(dataset, config, warn)
    again = made.run.training.continued().epochs / made.run.training.epochs if made.refit else 0.0
    trained = len(made.train) + round(again * len(made.windows))
    return _estimate(made.run, made.windows, trained, (made.kind, made.split.leaky, made.run.windows.context, 1))


def preview_evaluation(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> CostEstimate:
    """Return what `api.evaluate` would train on and its cost, without the training itself."""
    run = prepare(dataset, config, warn)
    score = fit_on = run.scored_windows(warn)
    if run.trained_on != run.scored_on:
        fit_on = run.training_windows()
    folds = fold_windows(fit_on, score, run.split, run.evaluation.seed)
    folds = folds if run.holds_back else train_on_validation(folds)
    trained = sum(len(fold.train) for fold in folds)
    split = (run.split.text, run.split.leaky, run.scored_on.context, len(folds))
    return _estimate(run, fit_on, trained, split, min(run.evaluation.processes, len(folds)))


def _estimate(
    run: Run, windows: WindowSet, trained: int, split: tuple[str, bool, str, int], side_by_side: int = 1
) -> CostEstimate:
    """Estimate the cost of trainings on ``trained`` windows in all; ``split``: name, leaky, context, folds."""
    rate = seconds_a_mac(windows, run.network, run.training)
    macs = PASSES * run.network.macs_per_window * trained * run.training.epochs
    return CostEstimate(
        *split,
        dataset=run.dataset.head.name,
        simulated=run.dataset.head.simulated,
        people=len(set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}),
        classes=len(windows.labels),
        windows=len(windows),
        epochs=run.training.epochs,
        parameters=run.network.parameters,
        macs=macs,
        window_epoch_s=rate * PASSES * run.network.macs_per_window,
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
