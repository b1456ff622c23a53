"""Preview a training or an evaluation: windows, folds, cost and an estimate of the time on this machine.

The speed is measured by training the same network on a few of its windows for a few epochs, in this process. The
estimate does not include the time for reading and cutting the data and for fitting decisions.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
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
from plushsense.trials.plan import PASSES, Plan, Task
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

_BATCHES, _EPOCHS = 3, 3


def preview_training(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> dict[str, Any]:
    """Return what `api.train` would train on and its cost; see `preview_evaluation` for the keys."""
    made = prepare_training(as_dataset(dataset), config, warn)
    windows, division, config = made.windows, made.division, made.config
    rate = _seconds_a_mac(windows, made.network, config.training)
    head = {"split": division.kind, "leaky": division.split.leaky, "context": config.windows.context, "folds": 1}
    sizes = [len(division.train), *([len(windows)] if division.refit else [])]
    return head | _describe(made.dataset, made.network, config, windows, sizes, rate, 1)


def preview_evaluation(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> dict[str, Any]:
    """Return what `api.evaluate` would train on and its cost, without the training itself.

    Returns:
        ``split``, ``leaky``, ``context``, ``simulated``, ``dataset``, ``folds``, ``people``, ``classes``, ``windows``,
        ``epochs`` (at most), ``parameters``, ``macs`` of all trainings, ``seconds`` (estimated), and
        ``window_epoch_s``, the measured seconds to train on one window for one epoch.
    """
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
    rate = _seconds_a_mac(fit_on, network, config.training)
    side_by_side = min(config.evaluation.processes, len(folds))
    head = {"split": split.text, "leaky": split.leaky, "context": config.scored_on.context, "folds": len(folds)}
    return head | _describe(dataset, network, config, fit_on, [len(f.train) for f in folds], rate, side_by_side)


def plan_seconds(planned: Plan, macs: float, workers: int) -> float:
    """Estimate the seconds that ``macs`` multiply-accumulates of a plan take, ``workers`` trainings at a time.

    The speed is measured with the training of median cost; that of other networks may differ.
    """
    job = sorted(planned.jobs, key=planned.macs)[len(planned.jobs) // 2]
    task: Task = job.task
    return macs * _seconds_a_mac(planned.sets[task.span], task.arch, task.spec) / max(1, workers)


def _describe(
    dataset: Dataset,
    network: Arch,
    config: RunConfig,
    windows: WindowSet,
    sizes: list[int],
    rate: float,
    side_by_side: int,
) -> dict[str, Any]:
    macs = PASSES * network.macs_per_window * sum(sizes) * config.training.epochs
    return {
        "dataset": dataset.head.name,
        "simulated": dataset.head.simulated,
        "people": len(set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}),
        "classes": len(windows.labels),
        "windows": len(windows),
        "epochs": config.training.epochs,
        "parameters": network.parameters,
        "macs": macs,
        "window_epoch_s": rate * PASSES * network.macs_per_window,
        "seconds": macs * rate / max(1, side_by_side),
    }


def _seconds_a_mac(windows: WindowSet, network: Arch, spec: TrainSpec) -> float:
    """Measure the seconds of training per multiply-accumulate, in the fastest of a few short epochs."""
    from plushsense.training.fit import fit

    few = max(spec.batch, 64) * _BATCHES
    part = windows.take(np.arange(0, len(windows), max(1, len(windows) // few)))
    ends: list[float] = []
    quick = replace(spec, epochs=_EPOCHS, patience=None)
    fit(part, None, network, quick, lambda *_: ends.append(time.perf_counter()))
    shortest = min(after - before for before, after in pairwise(ends))
    return shortest / (PASSES * network.macs_per_window * len(part))
