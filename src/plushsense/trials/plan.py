"""Plan a sweep (windows, folds, trials and trainings with their ids), run its trainings, and score them.

A *trial* is a network with a number of epochs and a batch. A *training* covers all trials that differ only in their
epochs, with one seed on one fold; it is a `Job` of the journal with a `Task`. A *run* is the part of a trial in one
training.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, DivergedError
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.sentences import Sentence
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.jobs.journal import JOURNAL, UNFINISHED, Journal, Result, job_id, keep_if_possible
from plushsense.jobs.pool import Job, JobCallbacks, JobsSpec, Report, run_jobs
from plushsense.models.arch import VECTOR, Arch
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Counts
from plushsense.scoring.splits import Fold, Split, parse_split
from plushsense.training.spec import TrainSpec
from plushsense.trials.grid import FULL, GridSpec, Trial, first_line, problems, trainings
from plushsense.windows.cut import WindowSet, shared_gestures
from plushsense.workflow.config import ALL
from plushsense.workflow.preparation import Warn, choose_classes, named_classes, silent, windows_for
from plushsense.workflow.reporting import journal_of

# Part of every id: increase it when the meaning of a stored training changes.
_VERSION = 1
# Passes of a training step: forward, and backward to the weights and to the previous layer.
PASSES = 3


class GridProblems(ConfigError):
    """An error that lists all problems of a grid; ``problems`` has a sentence for each."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        listed = "\n  - ".join([f"The grid has {len(problems)} problems:", *problems])
        super().__init__(problems[0] if len(problems) == 1 else listed)


@dataclass(frozen=True)
class Task:
    """One training on one fold, scored after each of ``epochs``; ``span`` selects the windows, ``id`` is the job's.

    The training continues from ``start`` (a `FitState`), if given, which took ``spent_s`` seconds; the weights do not
    depend on it. If ``stateful``, the result includes the final state, from which another training can continue.
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
        """Whether the weights after an epoch equal the final weights of a training of that many epochs."""
        return self.spec.patience is None


@dataclass(frozen=True)
class PlannedRun:
    """One trial with one seed on one fold, and the job that trains it; ``batch`` in windows."""

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
    runs: tuple[PlannedRun, ...]


@dataclass(frozen=True)
class Plan:
    """The trials and trainings of a sweep, with the windows for each span that its networks need."""

    grid: GridSpec
    split: Split
    gestures: GestureSet
    sets: dict[int, WindowSet]
    folds: dict[int, list[Fold]]
    trials: tuple[PlannedTrial, ...]
    jobs: tuple[Job, ...]

    @property
    def id(self) -> str:
        """Identifier, equal for equal data and settings in any order."""
        return job_id({"trials": sorted(t.id for t in self.trials), "runs": sorted(job.id for job in self.jobs)})

    def macs(self, job: Job, nested: bool = True) -> int:
        """Estimate the multiply-accumulates of a training; with ``nested`` False, of a separate one for each trial."""
        task: Task = job.task
        epochs = task.epochs[-1] if nested else sum(task.epochs)
        return PASSES * task.arch.macs_per_window * len(self.folds[task.span][task.fold].train) * epochs


def plan(dataset: Dataset, grid: GridSpec, unreadable: Sequence[str] = (), warn: Warn = silent) -> Plan:
    """Plan a sweep.

    Args:
        unreadable: problems that `load_grid` found, to be reported together with the others.

    Raises:
        GridProblems: with all problems of the grid on this data set.
    """
    return _planned(dataset, grid, _cut(dataset, grid, unreadable, warn))


def plans_by_epochs(
    dataset: Dataset,
    grid: GridSpec,
    unreadable: Sequence[str] = (),
    warn: Warn = silent,
    fits: Callable[[Arch], bool] = lambda arch: True,
) -> list[Plan]:
    """Return a plan for each number of epochs of a grid, all on the same windows; see `plan`.

    ``fits`` returns whether to include a network; all plans hold the same networks in the same order.
    """
    cut = _cut(dataset, grid, unreadable, warn)
    return [_planned(dataset, replace(grid, epochs=(epochs,)), cut, fits) for epochs in grid.epochs]


def _cut(dataset: Dataset, grid: GridSpec, unreadable: Sequence[str], warn: Warn) -> _Cut:
    rate = dataset.layout.rate_hz
    # Number of samples up to the end of each recording, counted from the start of its stream if it lies in one.
    reaches = [
        (max(r.stream_row, 0) + r.stop - r.start) * (rate / r.rate_hz if r.rate_hz > 0 else 1.0) for r in dataset.used
    ]
    past = int(median(reaches)) if reaches else 0
    cut, fewest, failures = None, None, list[str]()
    try:
        if any(symbol.startswith(VECTOR) for symbol in grid.architectures):
            dataset = dataset.with_inputs(dataset.layout.for_vectors())
        cut = _Cut.of(dataset, grid, warn)
        fewest = len(cut.windows)
        fewest = min(len(fold.train) for fold in cut.folds())
    except BadInput as cause:
        failures.append(first_line(cause))
    # Remove duplicates: a failure to cut windows may have the same message as a problem of the grid.
    wrong = list(dict.fromkeys([*unreadable, *problems(grid, dataset.layout, past, fewest), *failures]))
    if wrong or cut is None:
        raise GridProblems(wrong)
    _warn_of_rare(dataset, cut, warn)
    return cut


def _warn_of_rare(dataset: Dataset, cut: _Cut, warn: Warn) -> None:
    if cut.split.separates_people and cut.grid.classes == ALL:
        rare = set(cut.gestures.labels) - set(shared_gestures(dataset)[0].labels)
        if rare:
            sentence = (
                f"{len(rare)} of the {len(cut.gestures)} classes are gestures that fewer than 90 % of the people made "
                f"({', '.join(sorted(rare))}): the tested person may be the only one with a class; leave these classes "
                "out with --classes shared"
            )
            warn(Sentence(sentence, "rare_gestures", gestures=sorted(rare)))


@dataclass
class _Cut:
    """The windows and folds of a plan, cut once for each span that its networks need."""

    dataset: Dataset
    grid: GridSpec
    gestures: GestureSet
    sets: dict[int, WindowSet]
    by_span: dict[int, list[Fold]]
    window: Arch

    @classmethod
    def of(cls, dataset: Dataset, grid: GridSpec, warn: Warn) -> _Cut:
        """Cut windows of ``window_s`` without earlier samples; other spans give as many windows."""
        dataset, classes = named_classes(dataset, grid.classes)
        gestures = choose_classes(dataset, classes, warn)
        window = Arch.parse(
            "1", "1", channels=dataset.layout.n_inputs, padding="mirror", window=dataset.layout.samples(grid.window_s)
        )
        cut = cls(dataset, grid, gestures, {}, {}, window)
        cut.sets[window.span] = windows_for(dataset, window, grid.windows, gestures, warn)
        return cut

    @property
    def split(self) -> Split:
        """The split of the windows; raises ConfigError for an unknown one."""
        return parse_split(self.grid.split)

    @property
    def windows(self) -> WindowSet:
        """The windows of ``window_s`` without earlier samples."""
        return self.sets[self.window.span]

    def folds(self) -> list[Fold]:
        """Return the folds of `windows`."""
        return self.at(self.window)[1]

    def at(self, arch: Arch) -> tuple[WindowSet, list[Fold]]:
        """Return the windows that a network needs, and their folds."""
        # A network whose span is shorter than a window reads the end of the window.
        span = max(arch.span, arch.window)
        if span not in self.sets:
            self.sets[span] = windows_for(self.dataset, arch, self.grid.windows, self.gestures)
        if span not in self.by_span:
            windows = self.sets[span]
            self.by_span[span] = fold_windows(windows, windows, self.split, self.grid.split_seed)
        return self.sets[span], self.by_span[span]


def _planned(dataset: Dataset, grid: GridSpec, cut: _Cut, fits: Callable[[Arch], bool] = lambda arch: True) -> Plan:
    from plushsense.training.fit import resolve_device

    # Resolve the device here, because it is part of the id and must be the same in every worker.
    spec = resolve_device(grid.training)
    prints: dict[int, tuple[str, list[str]]] = {}
    trials: list[PlannedTrial] = []
    jobs: dict[str, Job] = {}
    used: set[int] = set()
    for training in trainings(grid, cut.dataset.layout, len(cut.gestures)):
        arch = training.trials[0].arch
        if not fits(arch):
            continue
        windows, folds = cut.at(arch)
        span = windows.integers.shape[2]
        used.add(span)
        if span not in prints:
            prints[span] = windows_fingerprint(windows), [fold_fingerprint(fold) for fold in folds]
        data, of_folds = prints[span]
        base = {"version": _VERSION, "arch": arch.to_dict(), "windows": data, "vectors": windows.vectors}
        runs = []
        for seed in grid.seeds:
            for i, fold in enumerate(folds):
                batch = training.trials[0].batch
                size = len(fold.train) if batch == FULL else int(batch)
                task = Task(arch, replace(spec, epochs=training.epochs[-1], batch=size, seed=seed), training.epochs,
                            span, i)  # fmt: skip
                known = job_id({**base, "training": task.spec.key(), "epochs": list(task.epochs), "fold": of_folds[i]})
                jobs[known] = Job(known, replace(task, id=known))
                runs.append(PlannedRun(known, seed, fold.name, span, i, size))
        settings = {k: v for k, v in spec.key().items() if k not in ("seed", "batch", "epochs")}
        for trial in training.trials:
            own = {"training": settings, "epochs": trial.epochs, "batch": trial.batch, "folds": of_folds}
            trials.append(PlannedTrial(job_id({**base, **own}), trial, tuple(runs)))
    sets = {span: windows for span, windows in cut.sets.items() if span in used}
    made = Plan(grid, cut.split, cut.gestures, sets, {s: cut.by_span[s] for s in sets}, tuple(trials), ())
    # Start with the longest trainings, so that all workers finish at about the same time.
    ordered = sorted(jobs.values(), key=made.macs, reverse=True)
    return replace(made, jobs=tuple(ordered))


def processes(workers: int, threads: int) -> int:
    """Return the number of trainings at a time: ``workers``, or for 0 as many as the processor cores allow."""
    if workers < 0:
        raise ConfigError(f"workers is {workers}: accepted are whole numbers from 0 up.")
    return workers or max(1, (os.cpu_count() or 1) // threads)


# The columns of a training's curve, which has a row for each epoch.
CURVE = ("train_loss", "train_accuracy", "validation_loss", "validation_accuracy", "learning_rate")


def train_all(
    dataset: Dataset,
    planned: Plan,
    jobs: Sequence[Job],
    *,
    workers: int,
    cluster: str | None,
    on_done: Callable[[Job, Result, bool], None],
    on_start: Callable[[Job], None] | None = None,
    on_report: Callable[[Job, Any], None] | None = None,
    on_failed: Callable[[Job, Exception], None] | None = None,
) -> dict[str, Result]:
    """Run those ``jobs`` of a plan that are not in the data set's journal yet; see `run_jobs` for the arguments."""
    unfinished = journal_of(dataset, UNFINISHED)

    def done(job: Job, result: Result, resumed: bool) -> None:
        unfinished.discard(job.id)
        on_done(job, result, resumed)

    return run_jobs(
        jobs,
        # Nodes of a cluster may not share a disk, so they do not save unfinished states.
        TrainAndScore(unfinished if cluster is None else None),
        shared=(planned.sets, planned.folds),
        spec=JobsSpec(
            workers,
            planned.grid.threads,
            journal_of(dataset, JOURNAL),
            cluster,
            1.0 if cluster is not None and planned.grid.device == "cuda" else 0.0,
        ),
        callbacks=JobCallbacks(on_start, on_report, done, on_failed),
    )


@dataclass(frozen=True)
class TrainAndScore:
    """The work of one job: train a network and predict the test windows after each number of epochs to score.

    The result has ``probabilities`` (E, N, K) float32 after each of the E numbers of ``epochs``, the ``validation``
    scores (E, 2) and the ``curve``, with the columns of `CURVE`. ``at`` are the epochs whose weights were used.

    If a training diverges, it is repeated with the next smaller number of epochs; ``failed`` has the reason for each
    number that failed. A long training saves its state in ``unfinished`` once a minute, and continues from there after
    an interruption.
    """

    unfinished: Journal | None = None

    def __call__(self, shared: Any, task: Task, report: Report, /) -> Result:
        from plushsense.training.engine import FitState
        from plushsense.training.fit import fit, predict

        sets, folds = shared
        windows, fold = sets[task.span], folds[task.span][task.fold]
        train, validation, test = (windows.take(index) for index in (fold.train, fold.validation, fold.test))
        epochs_left, failed, fitted = task.epochs, dict[str, str](), None
        before = None if self.unfinished is None else self.unfinished.find(task.id)
        start = task.start if before is None else FitState.from_arrays(before)

        def save(state: FitState) -> None:
            if self.unfinished is not None:
                keep_if_possible(self.unfinished, task.id, state.to_arrays())

        while epochs_left and fitted is None:
            spec = replace(task.spec, epochs=epochs_left[-1])
            keep = epochs_left if task.nested else ()
            try:
                fitted = fit(
                    train, validation, task.arch, spec, lambda at, of, row: report((at, of, row["train_loss"])), keep,
                    start=start, save=save if task.nested else None,
                )  # fmt: skip
            except DivergedError as cause:
                failed[str(epochs_left[-1])] = str(cause)
                epochs_left, start = epochs_left[:-1], None
        # If every training diverged, ``fitted`` is None and ``epochs_left`` is empty.
        tested, watched = [], []
        for epochs in epochs_left:
            assert fitted is not None
            weights = fitted.kept[epochs] if task.nested else fitted.weights
            tested.append(predict(task.arch, weights, fitted.scaler, test, task.spec.device))
            read = predict(task.arch, weights, fitted.scaler, validation, task.spec.device).argmax(axis=1)
            counts = metrics.confusion(validation.y, read.astype(np.int64), len(validation.labels))
            watched.append((metrics.accuracy(counts), metrics.macro_f1(counts)))
        history = [] if fitted is None else fitted.history
        result: Result = {
            "epochs": list(epochs_left),
            "at": list(epochs_left) if task.nested or fitted is None else [fitted.best_epoch],
            "probabilities": np.array(tested, dtype=np.float32).reshape(
                len(epochs_left), len(test), len(windows.labels)
            ),
            "validation": np.array(watched, dtype=np.float64).reshape(-1, 2),
            "curve": np.array([[row[name] for name in CURVE] for row in history], np.float64).reshape(-1, len(CURVE)),
            "seconds": 0 if fitted is None else task.spent_s + fitted.seconds,
            "failed": failed,
        }
        state = fitted.state if fitted is not None and task.stateful and not failed else None
        # Another training does not need the intermediate weights in ``kept``.
        return result if state is None else {**result, **replace(state, kept={}).to_arrays()}


@dataclass(frozen=True)
class Scored:
    """The scores of one run, and the confusion matrix of all its test windows; ``windows`` is the number scored."""

    figures: dict[str, float | None]
    counts: Counts
    windows: int
    seconds: float


@dataclass(frozen=True)
class TrainingOutcome:
    """Outcome of one training: scores by number of epochs, the learning curve, and the reason of each failure."""

    scored: dict[int, Scored]
    curve: NDArray[np.float64]
    failed: dict[int, str]
    seconds: float


def outcome(plan: Plan, run: PlannedRun, result: Mapping[str, Any]) -> TrainingOutcome:
    """Score the probabilities of a training; in splits by person, recordings of `NOBODY` are not scored."""
    windows, fold = plan.sets[run.span], plan.folds[run.span][run.fold_index]
    truth, classes = windows.y[fold.test], len(windows.labels)
    counted = (
        windows.subject[fold.test] != NOBODY if plan.split.separates_people else np.ones(len(truth), dtype=np.bool_)
    )
    scored, before, seconds = dict[int, Scored](), 0, float(result["seconds"])
    for i, epochs in enumerate(result["epochs"]):
        read = np.argmax(result["probabilities"][i], axis=1).astype(np.int64)
        counts = metrics.confusion(truth[counted], read[counted], classes)
        accuracy, f1 = result["validation"][i]
        figures = {
            **{key: metric.function(counts) for key, metric in metrics.column_metrics().items()},
            "validation_accuracy": float(accuracy),
            "validation_macro_f1": float(f1),
            "train_loss": float(result["curve"][result["at"][i] - 1, 0]),
        }
        # Divide the time of a training among its trials, so that their times add up to it.
        share = seconds * (epochs - before) / result["epochs"][-1]
        before = epochs
        scored[epochs] = Scored(
            {name: value if math.isfinite(value) else None for name, value in figures.items()},
            metrics.confusion(truth, read, classes),
            int(counted.sum()),
            share,
        )
    return TrainingOutcome(scored, result["curve"], {int(e): why for e, why in result["failed"].items()}, seconds)
