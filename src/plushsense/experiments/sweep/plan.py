"""Plan a sweep: its windows and folds, and its trials and trainings with their ids.

A *trial* is a network with a number of epochs and a batch. A *training* covers all trials that differ only in their
epochs, with one seed on one fold; it is a `Job` of the journal with a `Task`. A *run* is the part of a trial in one
training. With early stopping or halving, each number of epochs has its own training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.sentences import Message
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.experiments.sweep.grid import FULL, GridSpec, first_line, networks, problems
from plushsense.experiments.sweep.trainings import Task
from plushsense.jobs.journal import job_id
from plushsense.jobs.pool import Job
from plushsense.models.arch import VECTOR, Arch, slashed
from plushsense.scoring.splits import Fold, Split, parse_split
from plushsense.windows.cut import WindowSet, shared_gestures
from plushsense.workflow.config import ALL
from plushsense.workflow.estimate import PASSES
from plushsense.workflow.preparation import Warn, choose_classes, named_classes, silent, windows_for

# Part of every id: increase it when the meaning of a stored training changes.
_VERSION = 1


class GridProblems(ConfigError):
    """An error that lists all problems of a grid; ``problems`` has a sentence for each."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        listed = "\n  - ".join([f"The grid has {len(problems)} problems:", *problems])
        super().__init__(problems[0] if len(problems) == 1 else listed)


@dataclass(frozen=True)
class TrialRun:
    """One of the trainings of a trial: that with ``seed`` on ``fold``, which the job with the id ``job`` does.

    ``span`` is the number of samples of its windows, ``batch`` the size of a batch in windows.
    """

    job: str
    seed: int
    fold: str
    span: int
    fold_index: int
    batch: int


@dataclass(frozen=True)
class Trial:
    """One row of a sweep: a network and its schedule, trained with each seed on each fold (``runs``).

    It is trained for ``epochs`` in batches of ``batch`` windows ("full": all windows in one batch).
    """

    id: str
    arch: Arch
    filter_set: tuple[int, ...]
    epochs: int
    batch: int | str
    runs: tuple[TrialRun, ...]

    @property
    def network(self) -> tuple[str, str]:
        """Symbol and filters of the network, as in the table of trials."""
        return self.arch.symbol, slashed(self.arch.filters)


@dataclass(frozen=True)
class Plan:
    """The trials and trainings of a sweep, with the windows for each span that its networks need.

    ``left_out`` are the networks beyond the limits of the grid.
    """

    grid: GridSpec
    split: Split
    gestures: GestureSet
    sets: dict[int, WindowSet]
    folds: dict[int, list[Fold]]
    trials: tuple[Trial, ...]
    jobs: tuple[Job, ...]
    left_out: tuple[Arch, ...] = ()

    @property
    def id(self) -> str:
        """Identifier, equal for equal data and settings in any order."""
        parts: dict[str, object] = {
            "trials": sorted(trial.id for trial in self.trials),
            "runs": sorted(job.id for job in self.jobs),
        }
        return job_id(parts | ({"halving": [self.grid.share, self.grid.eta]} if self.grid.halving else {}))

    @property
    def n_folds(self) -> int:
        """Number of folds."""
        return len(next(iter(self.folds.values())))

    def macs(self, job: Job) -> int:
        """Estimate the multiply-accumulates of a training."""
        task: Task = job.task
        return PASSES * task.arch.macs_per_window * len(self.folds[task.span][task.fold].train) * task.epochs[-1]


def plan(dataset: Dataset, grid: GridSpec, unreadable: Sequence[str] = (), warn: Warn = silent) -> Plan:
    """Plan a sweep.

    Args:
        unreadable: problems that `load_grid` found, to be reported together with the others.

    Raises:
        GridProblems: with all problems of the grid on this data set.
        ConfigError: when no network is within the limits of the grid.
    """
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
    return _planned(grid, cut, warn)


def _warn_of_rare(dataset: Dataset, cut: _Cut, warn: Warn) -> None:
    if cut.split.separates_people and cut.grid.classes == ALL:
        rare = set(cut.gestures.labels) - set(shared_gestures(dataset)[0].labels)
        if rare:
            warn(
                Message(
                    "{n} of the {of} classes are gestures that fewer than 90 % of the people made ({gestures}): the "
                    "tested person may be the only one with a class; leave these classes out with --set classes=shared",
                    n=len(rare),
                    of=len(cut.gestures),
                    gestures=sorted(rare),
                )
            )


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


def _planned(grid: GridSpec, cut: _Cut, warn: Warn) -> Plan:
    from plushsense.training.fit import resolve_device

    # Resolve the device here, because it is part of the id and must be the same in every worker.
    spec = resolve_device(grid.training)
    settings = {key: value for key, value in spec.key().items() if key not in ("seed", "batch", "epochs")}
    prints: dict[int, tuple[str, list[str]]] = {}
    trials: list[Trial] = []
    jobs: dict[str, Job] = {}
    within, left_out = _within_limits(grid, cut, warn)
    for arch, filter_set in within:
        windows, folds = cut.at(arch)
        span = windows.integers.shape[2]
        if span not in prints:
            prints[span] = windows_fingerprint(windows), [fold_fingerprint(fold) for fold in folds]
        data, of_folds = prints[span]
        base = {"version": _VERSION, "arch": arch.to_dict(), "windows": data, "vectors": windows.vectors}
        for batch in grid.batches:
            for schedule in grid.schedules:
                runs = []
                for seed in grid.seeds:
                    for i, fold in enumerate(folds):
                        size = len(fold.train) if batch == FULL else int(batch)
                        training = replace(spec, epochs=schedule[-1], batch=size, seed=seed)
                        own: dict[str, object] = {
                            "training": training.key(),
                            "epochs": list(schedule),
                            "fold": of_folds[i],
                        }
                        job = job_id({**base, **own})
                        jobs[job] = Job(job, Task(arch, training, schedule, span, i, job))
                        runs.append(TrialRun(job, seed, fold.name, span, i, size))
                for epochs in schedule:
                    own = {"training": settings, "epochs": epochs, "batch": batch, "folds": of_folds}
                    trials.append(Trial(job_id({**base, **own}), arch, filter_set, epochs, batch, tuple(runs)))
    sets = {span: windows for span, windows in cut.sets.items() if span in prints}
    folds_of = {span: cut.by_span[span] for span in sets}
    made = Plan(grid, cut.split, cut.gestures, sets, folds_of, tuple(trials), (), left_out)
    # Start with the longest trainings, so that all workers finish at about the same time.
    return replace(made, jobs=tuple(sorted(jobs.values(), key=made.macs, reverse=True)))


def _within_limits(
    grid: GridSpec, cut: _Cut, warn: Warn
) -> tuple[list[tuple[Arch, tuple[int, ...]]], tuple[Arch, ...]]:
    """Return the networks within the limits of the grid, with their filter sets, and the others, of which it warns.

    Raises:
        ConfigError: when there is none; the message says by how much the nearest exceeds the limits.
    """
    found = networks(grid, cut.dataset.layout, len(cut.gestures))
    within = [network for network in found if not grid.exceeded(network[0])]
    beyond = tuple(arch for arch, _ in found if grid.exceeded(arch))
    if not within:
        near = min(beyond, key=lambda arch: max(one.value / one.limit for one in grid.exceeded(arch)))
        raise ConfigError(
            f"None of the {len(found)} networks is within the limits; the nearest, {near.symbol} with "
            f"{slashed(near.filters)}, has {', '.join(map(str, grid.exceeded(near)))}: allow more, or give smaller "
            "networks."
        )
    if beyond:
        named = "; ".join(f"{arch.symbol} with {slashed(arch.filters)}" for arch in beyond)
        warn(
            Message(
                "{n} of {of} networks are beyond the limits and left out: {names}",
                n=len(beyond),
                of=len(found),
                names=named,
            )
        )
    return within, beyond
