"""A sweep before it runs: the windows, the folds, every trial and every training with its id.

A *trial* is a network with a number of epochs and a batch: a row of the grid. A *training* is what is trained in one
go, the trials that differ in their epochs only, with one seed on one fold: a `Job` of the journal, whose `Task` says
what to do. A *run* is a trial's part of one training.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from plushsense.apps.config import ALL
from plushsense.apps.preparation import Warn, choose_classes, silent, windows_for
from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_print, windows_print
from plushsense.evaluation.folds import WindowFold, fold_windows
from plushsense.models.arch import Arch
from plushsense.runs.journal import job_id
from plushsense.runs.pool import Job
from plushsense.scoring.splits import Split, parse_split
from plushsense.training.grid import FULL, GridSpec, Trial, first_line, problems, trainings
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet, shared_gestures

# Part of every id: raise it when the meaning of a stored training changes.
_VERSION = 1
# Forward, and backward to the weights and to the layer before.
PASSES = 3


class GridProblems(ConfigError):
    """All problems of a grid at once: ``found``, one sentence each."""

    def __init__(self, found: Sequence[str]) -> None:
        self.found = tuple(found)
        several = "\n  - ".join([f"The grid has {len(found)} problems:", *found])
        super().__init__(found[0] if len(found) == 1 else several)


@dataclass(frozen=True)
class Task:
    """One training of one fold: ``epochs`` are those after which it is scored; ``span`` picks the windows; ``id`` the
    job's.

    ``start`` (a `FitState`) and the ``spent_s`` seconds of training before it change nothing in what comes out;
    ``stateful``: the result holds its state as well, so that another training can go on from there.
    """

    arch: Arch
    spec: TrainSpec
    epochs: tuple[int, ...]
    span: int
    fold: int
    id: str = ""
    start: Any = None
    spent_s: float = 0.0
    stateful: bool = False

    @property
    def nested(self) -> bool:
        """Whether the weights after an epoch are what a training of that many epochs ends with."""
        return self.spec.patience is None


@dataclass(frozen=True)
class Run:
    """One trial with one seed on one fold: which job holds it. ``batch`` in windows."""

    job: str
    seed: int
    fold: str
    span: int
    fold_index: int
    batch: int


@dataclass(frozen=True)
class PlannedTrial:
    """A trial with its id and its runs."""

    id: str
    trial: Trial
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Plan:
    """Everything that a sweep will do. Windows are held once for each span that its networks need."""

    grid: GridSpec
    split: Split
    gestures: GestureSet
    sets: dict[int, WindowSet]
    folds: dict[int, list[WindowFold]]
    trials: tuple[PlannedTrial, ...]
    jobs: tuple[Job, ...]

    @property
    def id(self) -> str:
        """The same for the same data and settings, in whatever order a grid lists them."""
        return job_id({"trials": sorted(t.id for t in self.trials), "runs": sorted(job.id for job in self.jobs)})

    def macs(self, job: Job, nested: bool = True) -> int:
        """Multiply-accumulates of a training, about; ``nested`` False: of its trials one by one."""
        task: Task = job.task
        epochs = task.epochs[-1] if nested else sum(task.epochs)
        return PASSES * task.arch.macs_per_window * len(self.folds[task.span][task.fold].train) * epochs


def plan(dataset: Dataset, grid: GridSpec, told: Sequence[str] = (), warn: Warn = silent) -> Plan:
    """The plan of a sweep.

    Args:
        told: what was wrong with the grid before (see `load_grid`): said together with the rest.

    Raises:
        GridProblems: with all problems of the grid on this data set at once, one a line.
    """
    return _planned(dataset, grid, _cut(dataset, grid, told, warn))


def plans_by_epochs(
    dataset: Dataset,
    grid: GridSpec,
    told: Sequence[str] = (),
    warn: Warn = silent,
    fits: Callable[[Arch], bool] = lambda arch: True,
) -> list[Plan]:
    """A plan for each number of epochs of a grid, as if it had no other, on the same windows; as `plan` else.

    ``fits``: which networks to plan for; all plans hold the same ones in the same order.
    """
    cut = _cut(dataset, grid, told, warn)
    return [_planned(dataset, replace(grid, epochs=(epochs,)), cut, fits) for epochs in grid.epochs]


def _cut(dataset: Dataset, grid: GridSpec, told: Sequence[str], warn: Warn) -> _Cut:
    past, found = _past(dataset), list[str]()
    cut, fewest = None, None
    try:
        cut = _Cut.of(dataset, grid, warn)
        fewest = len(cut.windows)
        fewest = min(len(fold.train) for fold in cut.folds())
    except BadInput as cause:
        found.append(first_line(cause))
    # What is wrong with the grid may also keep windows from being cut, in the same words.
    found = list(dict.fromkeys([*told, *problems(grid, dataset.layout, past, fewest), *found]))
    if found or cut is None:
        raise GridProblems(found)
    _warn_of_rare(dataset, cut, warn)
    return cut


def _past(dataset: Dataset) -> int:
    """Samples that half of the recordings have up to their end, in their stream where they lie in one."""
    rate = dataset.layout.rate_hz
    reaches = [
        (max(r.stream_row, 0) + r.stop - r.start) * (rate / r.rate_hz if r.rate_hz > 0 else 1.0) for r in dataset.used
    ]
    return int(median(reaches)) if reaches else 0


def _warn_of_rare(dataset: Dataset, cut: _Cut, warn: Warn) -> None:
    if cut.split.apart and cut.grid.classes == ALL:
        rare = set(cut.gestures.labels) - set(shared_gestures(dataset)[0].labels)
        if rare:
            warn(
                f"{len(rare)} of the {len(cut.gestures)} classes are no gesture that 90 % of the people share "
                f"({', '.join(sorted(rare))}): who is tested may be the only one who made them; "
                "leave them out with --classes shared"
            )


@dataclass
class _Cut:
    """Windows and folds, cut once for each span."""

    dataset: Dataset
    grid: GridSpec
    gestures: GestureSet
    sets: dict[int, WindowSet]
    by_span: dict[int, list[WindowFold]]
    window: Arch

    @classmethod
    def of(cls, dataset: Dataset, grid: GridSpec, warn: Warn) -> _Cut:
        """Cut for a window without more past, which tells of every grid how many windows there are."""
        gestures = choose_classes(dataset, grid.classes, warn)
        window = Arch.parse(
            "1", "1", channels=dataset.layout.n_inputs, padding="mirror", window=dataset.layout.samples(grid.window_s)
        )
        cut = cls(dataset, grid, gestures, {}, {}, window)
        cut.sets[window.span] = windows_for(dataset, window, grid.windows, gestures, warn)
        return cut

    @property
    def split(self) -> Split:
        """How the windows are divided; ConfigError for an unknown split."""
        return parse_split(self.grid.split)

    @property
    def windows(self) -> WindowSet:
        """Windows without more past."""
        return self.sets[self.window.span]

    def folds(self) -> list[WindowFold]:
        """Their folds."""
        return self.at(self.window)[1]

    def at(self, arch: Arch) -> tuple[WindowSet, list[WindowFold]]:
        """The windows that a network needs, and their folds."""
        # A network that reads no more than a window reads the end of that window.
        span = max(arch.span, arch.window)
        if span not in self.sets:
            self.sets[span] = windows_for(self.dataset, arch, self.grid.windows, self.gestures)
        if span not in self.by_span:
            windows = self.sets[span]
            self.by_span[span] = fold_windows(windows, windows, self.split, self.grid.split_seed)
        return self.sets[span], self.by_span[span]


def _planned(dataset: Dataset, grid: GridSpec, cut: _Cut, fits: Callable[[Arch], bool] = lambda arch: True) -> Plan:
    from plushsense.training.fit import placed

    # Where it is trained, settled once: it belongs to the id, and every worker must mean the same.
    spec = placed(grid.training)
    prints: dict[int, tuple[str, list[str]]] = {}
    trials: list[PlannedTrial] = []
    jobs: dict[str, Job] = {}
    used: set[int] = set()
    for training in trainings(grid, dataset.layout, len(cut.gestures)):
        arch = training.trials[0].arch
        if not fits(arch):
            continue
        windows, folds = cut.at(arch)
        span = windows.x.shape[2]
        used.add(span)
        if span not in prints:
            prints[span] = windows_print(windows), [fold_print(fold) for fold in folds]
        data, of_folds = prints[span]
        base = {"version": _VERSION, "arch": arch.to_dict(), "windows": data, "vectors": windows.vectors}
        runs = []
        for seed in grid.seeds:
            for i, fold in enumerate(folds):
                batch = training.trials[0].batch
                size = len(fold.train) if batch == FULL else int(batch)
                task = Task(arch, replace(spec, epochs=training.epochs[-1], batch=size, seed=seed), training.epochs,
                            span, i)  # fmt: skip
                known = job_id({**base, **_settings(task), "fold": of_folds[i]})
                jobs[known] = Job(known, replace(task, id=known))
                runs.append(Run(known, seed, fold.name, span, i, size))
        trials += [
            PlannedTrial(_trial_id(base, trial, spec, of_folds), trial, tuple(runs)) for trial in training.trials
        ]
    sets = {span: windows for span, windows in cut.sets.items() if span in used}
    made = Plan(grid, cut.split, cut.gestures, sets, {s: cut.by_span[s] for s in sets}, tuple(trials), ())
    # The longest first: at the end only short ones are left, and all workers finish at about the same time.
    ordered = sorted(jobs.values(), key=made.macs, reverse=True)
    return replace(made, jobs=tuple(ordered))


def _settings(task: Task) -> dict[str, Any]:
    """What a training depends on beside its data and network."""
    return {"training": task.spec.key(), "epochs": list(task.epochs)}


def _trial_id(base: dict[str, Any], trial: Trial, spec: TrainSpec, folds: list[str]) -> str:
    settings = {k: v for k, v in spec.key().items() if k not in ("seed", "batch", "epochs")}
    return job_id({**base, "training": settings, "epochs": trial.epochs, "batch": trial.batch, "folds": folds})


def processes(workers: int, threads: int) -> int:
    """How many trainings run at a time: 0 asks for as many as the processors hold."""
    if workers < 0:
        raise ConfigError(f"workers is {workers}: accepted are whole numbers from 0 up.")
    return workers or max(1, (os.cpu_count() or 1) // threads)
