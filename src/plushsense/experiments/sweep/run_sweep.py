"""Train and score the trials of a grid (a sweep), all or with halving, and continue after an interruption.

Memory: this process and each worker hold one set of windows for each span that the networks need (a single set with
padding mirror or causal), and each training a copy of its fold as float32. Results stay in memory until the end: 4
bytes for each tested window × class × scored epoch, 182 kB for each of the paper's 156 trainings.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ForgottenError, python_warning
from plushsense.core.sentences import Message
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.experiments.sweep.folder import SETTINGS, SUMMARY, SweepFolder
from plushsense.experiments.sweep.grid import GridSpec, load_grid
from plushsense.experiments.sweep.halving import QUARTER, Halving, HalvingCosts, Rung, Scores, halve
from plushsense.experiments.sweep.plan import GridProblems, Plan, Trial, plan
from plushsense.experiments.sweep.results import SweepResult, read_sweep
from plushsense.experiments.sweep.trainings import Task, TrainAndScore, processes
from plushsense.experiments.sweep.trials import PAPER_CHOICE, SweepHead, networks_to_keep
from plushsense.jobs.journal import JOURNAL, UNFINISHED, Result, job_id
from plushsense.jobs.pool import Job, JobCallbacks, JobsSpec, run_jobs
from plushsense.jobs.progress import BestScore, JobInfo, JobProgress, JobsReporter, JobStep
from plushsense.models.arch import slashed
from plushsense.workflow.estimate import seconds_a_mac
from plushsense.workflow.preparation import Warn
from plushsense.workflow.reporting import check_results, journal_of

# Number of failed trainings after which a sweep stops if none has succeeded.
_HOPELESS = 3


@dataclass(frozen=True)
class SweepProgress(JobProgress):
    """Progress of a sweep, with halving of the rung (from 1 to ``rungs``) in which ``networks`` are trained."""

    rung: int = 0
    rungs: int = 0
    networks: int = 0


@dataclass(frozen=True)
class SweepSpec:
    """Settings of `sweep`: the grid of networks and schedules, the folder of the results, and what trains them.

    Attributes:
        grid: "paper", "scripts", "people", the path of a TOML file, or a `GridSpec`.
        changes: new values of the grid's keys, such as ``{"split": "by-subject:5", "max_parameters": 8000}``; see
            `load_grid`. (The paper's "windows:holdout" is leaky.)
        out: output folder (default: ``evaluations/sweep-<name>`` in the data set; of a changed grid, with its split and
            a hash).
        overwrite: replace the results of another sweep there.
        workers: number of trainings at a time; 0: as many as the processor cores allow.
        cluster: address of a Ray cluster that trains instead of this machine's processes.
        keep_predictions: the networks whose predictions and confusions are kept; see `networks_to_keep`.
    """

    grid: GridSpec | str | os.PathLike[str] = "paper"
    changes: Mapping[str, Any] = field(default_factory=dict)
    out: str | os.PathLike[str] | None = None
    overwrite: bool = False
    workers: int = 0
    cluster: str | None = None
    keep_predictions: str = PAPER_CHOICE

    def place(self, dataset: Dataset, grid: GridSpec) -> Path:
        """Return the output folder of the sweep of ``grid``, which is the changed one."""
        if self.out is not None:
            return Path(self.out)
        name = f"sweep-{grid.name}"
        if load_grid(self.grid)[0] != grid:
            name += f"-{re.sub('[^A-Za-z0-9-]+', '-', grid.split)}-{job_id(grid.to_json())[:8]}"
        return dataset.path / "evaluations" / name


def sweep(
    dataset: Dataset | str | os.PathLike[str],
    spec: SweepSpec | None = None,
    *,
    progress: Callable[[SweepProgress], None] | None = None,
    display: bool = False,
    warn: Warn = python_warning,
) -> SweepResult:
    """Train and score the trials of a grid: all, or with halving those of the better networks.

    Finished trainings are kept in the data set's ``cache`` folder, so that a stopped or killed sweep can be continued.
    The tables in the output folder are updated during the run.

    Args:
        progress: called when a training reports an epoch or is done.
        display: show the trainings, the best score so far and the time left on standard error.

    Raises:
        ConfigError: with all problems of the grid at once, before anything is trained.
        TrainingError: with halving, when every training failed.
    """
    dataset, spec = as_dataset(dataset), spec or SweepSpec()
    grid, wrong = load_grid(spec.grid, spec.changes)
    planned = plan(dataset, grid, wrong, warn)
    costs = halving_costs(planned, warn) if grid.halving else None
    place = spec.place(dataset, grid)
    keep = networks_to_keep(planned, spec.keep_predictions)
    check_results(place, "A sweep", SUMMARY, planned.id, replace=spec.overwrite)
    folder = SweepFolder(planned, place, SweepHead.of(dataset, planned), dataset.generation.writing, keep)
    work = _Work(dataset, spec, folder, progress, display)
    try:
        if costs is None:
            work.train(planned.jobs)
        else:
            folder.halving = work.halve(costs)
    except BaseException:
        # Write the tables of finished trainings, unless none of them is new.
        if len(folder.trained) > len(folder.resumed):
            folder.write()
        raise
    folder.write(work.results)
    return read_sweep(place)


def candidates(planned: Plan) -> list[tuple[Trial, ...]]:
    """Return the trials of each network and batch, by ascending epochs."""
    rungs = len(planned.grid.epochs)
    return [planned.trials[i : i + rungs] for i in range(0, len(planned.trials), rungs)]


def halving_costs(planned: Plan, warn: Warn) -> HalvingCosts:
    """Return the costs of halving; raise ConfigError if the share of the grid does not suffice."""
    grid, jobs = planned.grid, {job.id: job for job in planned.jobs}
    epoch = [sum(planned.macs(jobs[run.job]) for run in last.runs) / last.epochs for *_, last in candidates(planned)]
    costs = HalvingCosts(np.array(epoch), grid.epochs, grid.share, grid.eta)
    costs.check()
    if grid.share is None and costs.share > QUARTER:
        warn(
            Message(
                "{n} networks are too few to find the best for a quarter of their cost: up to {share:.0%} may be spent",
                n=len(epoch),
                share=costs.share,
                percent=round(100 * costs.share),
            )
        )
    return costs


class _Work:
    """Trains the jobs of a plan and collects their results in a folder."""

    def __init__(
        self,
        dataset: Dataset,
        spec: SweepSpec,
        folder: SweepFolder,
        progress: Callable[[SweepProgress], None] | None,
        display: bool,
    ) -> None:
        self._dataset, self._plan, self._folder = dataset, folder.plan, folder
        self._workers, self._cluster = processes(spec.workers, folder.plan.grid.threads), spec.cluster
        self._progress, self._display = progress, display
        self._jobs = {job.id: job for job in folder.plan.jobs}
        self._best: BestScore | None = None
        self.results: dict[str, Result] = {}

    def train(
        self,
        jobs: Sequence[Job],
        spent: Mapping[str, float] | None = None,
        convert: Callable[[JobProgress], SweepProgress] = lambda at: SweepProgress(**vars(at)),
        title: str = "",
    ) -> None:
        """Train those jobs that the journal does not have yet.

        Args:
            spent: the part of each job's cost that an earlier training has paid.
            convert: adds the rung to the progress of these jobs.
        """
        progress, spent = self._progress, spent or {}
        reporter = JobsReporter(
            {job.id: JobInfo(_name(job.task), self._plan.macs(job) - spent.get(job.id, 0.0)) for job in jobs},
            title=f"sweep {self._plan.grid.name}{title}",
            unit="trainings",
            read=_read_step,
            score=self._best_score,
            score_name="accuracy",
            progress=None if progress is None else lambda at: progress(convert(at)),
        )
        reporter.state.best = self._best
        folder = self._folder
        unfinished = journal_of(self._dataset, UNFINISHED)

        def done(job: Job, result: Result, resumed: bool) -> None:
            unfinished.discard(job.id)
            folder.add(job.id, result, resumed)
            reporter.on_done(job, result, resumed)

        def failed(job: Job, error: Exception) -> None:
            if isinstance(error, ForgottenError):
                raise error
            folder.lose(job.id, str(error) or type(error).__name__)
            reporter.on_failed(job, error)
            # If all of the first trainings fail, the others will probably fail for the same reason.
            if len(folder.lost) >= _HOPELESS and len(folder.trained) == len(folder.resumed):
                raise error

        with reporter if self._display else nullcontext():
            self.results |= run_jobs(
                jobs,
                # Nodes of a cluster may not share a disk, so they do not save unfinished states.
                TrainAndScore(unfinished if self._cluster is None else None),
                shared=(self._plan.sets, self._plan.folds),
                spec=JobsSpec(
                    self._workers,
                    self._plan.grid.threads,
                    journal_of(self._dataset, JOURNAL),
                    self._cluster,
                    1.0 if self._cluster is not None and self._plan.grid.device == "cuda" else 0.0,
                ),
                callbacks=JobCallbacks(reporter.on_start, reporter.on_report, done, failed),
            )
        self._best = reporter.state.best

    def _best_score(self, job: Job, result: Result) -> BestScore | None:
        best = self._folder.best
        if best is None:
            return None
        marks = " (leaky)" * best.head.leaky + " (simulation)" * best.head.simulated
        return BestScore(best.mean("accuracy") or 0.0, f"{' '.join(best.trial.network)}{marks}", best.row())

    def halve(self, costs: HalvingCosts) -> Halving:
        """Train rung by rung; a training continues from its state at the end of the rung before.

        If the journal has no such state (a plain sweep saves none), the training starts from the beginning, with the
        same result.
        """
        networks = candidates(self._plan)
        paid = 0.0

        def train(rung: Rung) -> Scores:
            nonlocal paid
            self._train_rung(rung, networks, costs, paid)
            paid += rung.cost
            trials = (networks[n][rung.number] for n in rung.entered)
            return np.array([[self._score(run.job, trial.epochs) for run in trial.runs] for trial in trials])

        found = halve(costs, train)
        self._folder.dropped = {trial.id for trials in networks for trial in trials}
        results = tuple(tuple(map(self._folder.result_of, trials)) for trials in networks)
        command = ["plushsense", "train", str(self._dataset.path), "--config", str(self._folder.out / SETTINGS)]
        return Halving(costs, found, results, shlex.join(command))

    def _train_rung(self, rung: Rung, networks: Sequence[tuple[Trial, ...]], costs: HalvingCosts, paid: float) -> None:
        last = rung.number + 1 == len(costs.rungs)
        jobs, spent = list[Job](), dict[str, float]()
        for network in rung.entered:
            runs = networks[network][rung.number].runs
            before = networks[network][rung.number - 1].runs if rung.number else runs
            for run, earlier in zip(runs, before, strict=True):
                job = self._jobs[run.job]
                if rung.number:
                    spent[job.id] = self._plan.macs(self._jobs[earlier.job])
                jobs.append(replace(job, task=self._continued(job.task, earlier.job, stateful=not last)))

        def convert(at: JobProgress) -> SweepProgress:
            values = {**vars(at), "share": (paid + at.share * rung.cost) / costs.bound}
            return SweepProgress(**values, rung=rung.number + 1, rungs=len(costs.rungs), networks=len(rung.entered))

        self.train(jobs, spent, convert, f", rung {rung.number + 1} of {len(costs.rungs)}")

    def _continued(self, task: Task, earlier: str, stateful: bool) -> Task:
        """Return the task with the final state of the ``earlier`` job as its start, if that was kept."""
        task, result = replace(task, stateful=stateful), self.results.get(earlier, {})
        if "random" not in result:
            return task
        # Imported here, because PyTorch is needed for training only.
        from plushsense.training.engine import FitState

        return replace(task, start=FitState.from_arrays(result), spent_s=float(result["seconds"]))

    def _score(self, job: str, epochs: int) -> float:
        trained = self._folder.trained.get(job)
        scored = None if trained is None else trained.scored.get(epochs)
        value = None if scored is None else scored.figures["macro_f1"]
        return float("nan") if value is None else value


def _read_step(job: Job, message: tuple[int, int, float]) -> JobStep:
    return JobStep(*message, first=getattr(job.task.start, "epoch", 0))


def _name(task: Task) -> str:
    return f"{task.arch.title} batch {task.spec.batch} seed {task.spec.seed} fold {task.fold + 1}"


@dataclass(frozen=True)
class SweepPreview:
    """The trainings that a sweep would run, with their cost, or the problems of its grid; see `preview`.

    Attributes:
        grid: its settings; ``planned`` is None if it has ``problems``.
        held: number of trainings that the journal has.
        seconds: estimated time of the missing trainings on this machine; None if it was not measured.
        halving: costs of halving, or None.
    """

    grid: GridSpec
    problems: tuple[str, ...] = ()
    simulated: bool = False
    planned: Plan | None = None
    held: int = 0
    seconds: float | None = None
    halving: HalvingCosts | None = None

    def to_json(self) -> dict[str, object]:
        """Return plain values: counts, cost in multiply-accumulates, memory of each process, settings, problems.

        ``training_mb`` (a step of the largest training) is None where PyTorch's own layers decide.
        """
        grid, planned = self.grid, self.planned
        if planned is None:
            return {"name": grid.name, "trials": 0, "problems": list(self.problems), "grid": grid.to_json()}
        # Imported here, because PyTorch is needed for training only.
        from plushsense.training.engine import step_bytes

        cost: dict[str, float] = {}
        for job in planned.jobs:
            cost[job.task.arch.symbol] = cost.get(job.task.arch.symbol, 0.0) + planned.macs(job)
        macs = sum(cost.values())
        steps = [step_bytes(job.task.arch, job.task.spec) for job in planned.jobs]
        left_out = [
            {"arch": a.symbol, "filters": slashed(a.filters), "why": ", ".join(map(str, grid.exceeded(a)))}
            for a in planned.left_out
        ]
        return {
            "name": grid.name,
            "id": planned.id,
            "split": planned.split.text,
            "leaky": planned.split.leaky,
            "simulated": self.simulated,
            "trials": len(planned.trials),
            "trainings": len(planned.jobs),
            "folds": planned.n_folds,
            "seeds": len(grid.seeds),
            "held": self.held,
            "macs": macs,
            "windows_mb": sum(windows.integers.nbytes for windows in planned.sets.values()) / 1e6,
            "training_mb": None if None in steps else max(filter(None, steps), default=0) / 1e6,
            "cost": {arch: own / macs for arch, own in sorted(cost.items(), key=lambda item: -item[1])},
            "left_out": left_out,
            "problems": [],
            "grid": grid.to_json(),
            "training": {k: v for k, v in asdict(grid.training).items() if k not in ("epochs", "batch", "seed")},
            **({} if self.seconds is None else {"seconds": self.seconds}),
            **({} if self.halving is None else {"halving": self.halving.to_json()}),
        }


def preview(
    dataset: Dataset | str | os.PathLike[str],
    spec: SweepSpec | None = None,
    *,
    measure: bool = False,
    warn: Warn = python_warning,
) -> SweepPreview:
    """Return what `sweep` would train, its cost, and all problems of the grid, without training.

    With ``measure``, the time on this machine is estimated, too.
    """
    dataset, spec = as_dataset(dataset), spec or SweepSpec()
    grid, wrong = load_grid(spec.grid, spec.changes)
    try:
        planned = plan(dataset, grid, wrong, warn)
    except GridProblems as cause:
        return SweepPreview(grid, cause.problems)
    networks_to_keep(planned, spec.keep_predictions)
    costs = halving_costs(planned, warn) if grid.halving else None
    journal = journal_of(dataset, JOURNAL)
    left = [job for job in planned.jobs if not journal.has(job.id)]
    seconds = None
    if measure:
        seconds = _seconds(planned, sum(map(planned.macs, left)) if costs is None else costs.bound)
    held = len(planned.jobs) - len(left)
    return SweepPreview(grid, (), dataset.head.simulated, planned, held, seconds, costs)


def _seconds(planned: Plan, macs: float) -> float:
    """Estimate the seconds that ``macs`` multiply-accumulates of a plan take on this machine.

    The speed is measured with the training of median cost; that of other networks may differ.
    """
    task: Task = sorted(planned.jobs, key=planned.macs)[len(planned.jobs) // 2].task
    return macs * seconds_a_mac(planned.sets[task.span], task.arch, task.spec) / processes(0, planned.grid.threads)
