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
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.evaluation.crossval import fold_windows, train_on_validation
from plushsense.models.arch import Arch
from plushsense.training.spec import TrainSpec
from plushsense.trials.plan import PASSES, Plan, Task
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import RunConfig
from plushsense.workflow.preparation import Run, Warn, prepare, prepare_training, refuse_hard_negatives, silent

_BATCHES, _EPOCHS = 3, 3


def preview_training(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> dict[str, Any]:
    """Return what `api.train` would train on and its cost; see `preview_evaluation` for the keys."""
    made = prepare_training(dataset, config, warn)
    run, windows, division = made.run, made.windows, made.division
    rate = _seconds_a_mac(windows, run.network, run.training)
    head = {"split": division.kind, "leaky": division.split.leaky, "context": run.windows.context, "folds": 1}
    sizes = [len(division.train), *([len(windows)] if division.refit else [])]
    return head | _describe(run, windows, sizes, rate, 1)


def preview_evaluation(
    dataset: Dataset | str | os.PathLike[str], config: RunConfig, *, warn: Warn = silent
) -> dict[str, Any]:
    """Return what `api.evaluate` would train on and its cost, without the training itself.

    Returns:
        ``split``, ``leaky``, ``context``, ``simulated``, ``dataset``, ``folds``, ``people``, ``classes``, ``windows``,
        ``epochs`` (at most), ``parameters``, ``macs`` of all trainings, ``seconds`` (estimated), and
        ``window_epoch_s``, the measured seconds to train on one window for one epoch.
    """
    run = prepare(dataset, config, warn)
    refuse_hard_negatives(run)
    score = fit_on = run.scored_windows(warn)
    if run.trained_on != run.scored_on:
        fit_on = run.training_windows()
    folds = fold_windows(fit_on, score, run.split, run.evaluation.seed)
    folds = folds if run.holds_back else train_on_validation(folds)
    rate = _seconds_a_mac(fit_on, run.network, run.training)
    side_by_side = min(run.evaluation.processes, len(folds))
    head = {"split": run.split.text, "leaky": run.split.leaky, "context": run.scored_on.context, "folds": len(folds)}
    return head | _describe(run, fit_on, [len(f.train) for f in folds], rate, side_by_side)


def plan_seconds(planned: Plan, macs: float, workers: int) -> float:
    """Estimate the seconds that ``macs`` multiply-accumulates of a plan take, ``workers`` trainings at a time.

    The speed is measured with the training of median cost; that of other networks may differ.
    """
    job = sorted(planned.jobs, key=planned.macs)[len(planned.jobs) // 2]
    task: Task = job.task
    return macs * _seconds_a_mac(planned.sets[task.span], task.arch, task.spec) / max(1, workers)


def _describe(
    run: Run,
    windows: WindowSet,
    sizes: list[int],
    rate: float,
    side_by_side: int,
) -> dict[str, Any]:
    macs = PASSES * run.network.macs_per_window * sum(sizes) * run.training.epochs
    return {
        "dataset": run.dataset.head.name,
        "simulated": run.dataset.head.simulated,
        "people": len(set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}),
        "classes": len(windows.labels),
        "windows": len(windows),
        "epochs": run.training.epochs,
        "parameters": run.network.parameters,
        "macs": macs,
        "window_epoch_s": rate * PASSES * run.network.macs_per_window,
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
