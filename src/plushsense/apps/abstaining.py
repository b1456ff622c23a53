"""Abstaining on people left out: folds of people, each also with a gesture withheld, as jobs that are kept."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.apps.config import RunConfig, from_settings
from plushsense.apps.preparation import Warn, choose_classes, opened, outside_streams, silent, windows_for
from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.evaluation.abstaining import Abstaining, Told, fold_answers, summarise
from plushsense.evaluation.crossval import fold_print, windows_print
from plushsense.evaluation.folds import WindowFold, fold_windows
from plushsense.live.fitting import COVERAGE, KNOWN_SHARE
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runs.jobs import Job, Report
from plushsense.runs.journal import Journal, Result, job_id
from plushsense.runs.pool import run_jobs
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

# Raise it when the meaning of what is kept changes, that of the default smoothing included.
_VERSION = 1
FIGURE, TABLE = "risk-coverage.png", "abstaining.json"


@dataclass(frozen=True)
class _AnswerWork:
    """Trains without ``withheld`` (a task is a fold and that label, or ""), and hears the people left out."""

    dataset: str
    arch: Arch
    spec: TrainSpec
    gestures: GestureSet
    coverage: float
    known_share: float

    def __call__(self, shared: WindowSet, task: tuple[WindowFold, str], report: Report, /) -> Result:
        from plushsense.training.fit import fit

        fold, withheld = task
        dataset = _opened(self.dataset)
        gestures = self.gestures.subset([g for g in self.gestures.labels if g != withheld])
        train, validation = (_without(shared.take(at), withheld) for at in (fold.train, fold.validation))
        arch = replace(self.arch, classes=len(gestures))
        fitted = fit(train, validation, arch, self.spec, lambda epoch, epochs, _: report((epoch, epochs)))
        bundle = Bundle(arch, fitted.weights, dataset.layout, fitted.scaler, gestures)
        validation_people, test_people = (
            sorted(set(shared.subject[at].tolist()) - {NOBODY, UNKNOWN_SUBJECT}) for at in (fold.validation, fold.test)
        )
        return fold_answers(
            bundle, dataset, validation_people, test_people, coverage=self.coverage, known_share=self.known_share
        )


@lru_cache(maxsize=1)
def _opened(path: str) -> Dataset:
    return open_dataset(Path(path))


def _heard_apart(fold: WindowFold, windows: WindowSet, dataset: Dataset) -> WindowFold:
    """The fold without training windows from the streams of those who are heard."""
    heard = set(windows.subject[np.concatenate([fold.validation, fold.test])].tolist()) - {NOBODY}
    return replace(fold, train=fold.train[outside_streams(windows, dataset, heard)[fold.train]])


def _without(windows: WindowSet, label: str) -> WindowSet:
    """The windows of all other gestures, with their own class indices."""
    if not label:
        return windows
    at = windows.labels.index(label)
    mine = windows.take(np.flatnonzero(windows.y != at))

    def rest(names: tuple[str, ...]) -> tuple[str, ...]:
        return names[:at] + names[at + 1 :]

    return replace(
        mine,
        y=mine.y - (mine.y > at),
        labels=rest(mine.labels),
        affects=rest(mine.affects),
        families=rest(mine.families),
    )


def abstaining(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str = "by-subject:5",
    withhold: bool = False,
    coverage: float = COVERAGE,
    known_share: float = KNOWN_SHARE,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int, int], None] | None = None,
    warn: Warn = silent,
    **settings: Any,
) -> Abstaining:
    """Whether a network knows when it does not know: risk against coverage, stated coverage, known against unknown.

    Networks are trained by folds of people; thresholds come from those who validate, and every figure from the streams
    of those left out. Finished trainings are kept in the data set's ``cache`` folder.

    Args:
        split: whole people only: "by-subject:5", "leave-one-subject-out".
        withhold: also train without each gesture in turn, and ask whether it is taken for unknown: as many
            trainings again for each gesture.
        coverage: at which the conformal sets are fitted; known_share: of known gestures that pass as known.
        out: a folder for ``abstaining.json`` and the figure.
        progress: called with (trainings done, of all, from before).

    Raises:
        ConfigError: for a split of windows or recordings; DatasetError: without streams.
    """
    dataset = opened(dataset)
    config = config or from_settings(**settings)
    asked = parse_split(split)
    if not asked.apart:
        raise ConfigError(
            f"The split '{split}' does not keep people apart: accepted are by-subject:K and leave-one-subject-out."
        )
    if not any(r.stream_row >= 0 for r in dataset.used):
        raise DatasetError(
            f"No recording of '{dataset.head.name}' lies in a stream: what is sure is asked there, as a toy hears it."
        )
    gestures = choose_classes(dataset, config.evaluation.classes, warn)
    arch = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    windows = windows_for(dataset, arch, config.windows, gestures, warn)
    folds = [
        _heard_apart(fold, windows, dataset) for fold in fold_windows(windows, windows, asked, config.evaluation.seed)
    ]
    from plushsense.training.fit import placed

    key = {
        "version": _VERSION,
        "dataset": dataset.hash,
        "windows": windows_print(windows),
        "arch": arch.to_dict(),
        "training": placed(config.training).key(),
        "shares": [coverage, known_share],
    }
    # Fold by fold, so that a run that is stopped has heard of every gesture.
    without = [(fold, label) for fold in folds for label in gestures.labels if withhold and len(gestures) > 2]
    jobs = [
        Job(job_id({**key, "fold": fold_print(fold), "withheld": label}), (fold, label))
        for fold, label in [*((fold, "") for fold in folds), *without]
    ]
    done = resumed = 0

    def told(_: Job, __: Result, kept: bool) -> None:
        nonlocal done, resumed
        done, resumed = done + 1, resumed + kept
        if progress is not None:
            progress(done, len(jobs), resumed)

    results = run_jobs(
        jobs,
        _AnswerWork(str(dataset.path), arch, config.training, gestures, coverage, known_share),
        shared=windows,
        workers=config.evaluation.processes,
        journal=Journal(dataset.path / "cache" / "abstaining"),
        on_done=told,
    )
    answers = [
        Told(job.task[0].name, job.task[1], tuple(g for g in gestures.labels if g != job.task[1]), results[job.id])
        for job in jobs
    ]
    if not any(len(t.result["label"]) for t in answers if not t.withheld):
        raise BadInput(
            "Nobody who was left out has a stream with recordings in it, or nobody to set thresholds on has."
        )
    found = summarise(answers, coverage, known_share)
    found.table.update(split=asked.text, simulated=dataset.head.simulated, dataset=dataset.head.name)
    if out is not None:
        save(found, Path(out))
    return found


def save(found: Abstaining, out: Path) -> None:
    """Write the figures as JSON and the curves as a picture."""
    from plushsense.reports.abstaining import curves
    from plushsense.reports.figures import png

    out.mkdir(parents=True, exist_ok=True)
    (out / TABLE).write_text(json.dumps(found.table, indent=1, ensure_ascii=False), encoding="utf-8", newline="\n")
    title = f"{found.table['dataset']}, {found.table['people']} people left out ({found.table['split']})"
    title += "  [SIMULATION]" if found.table["simulated"] else ""
    (out / FIGURE).write_bytes(png(curves(found.curves, title=title), dpi=110))
