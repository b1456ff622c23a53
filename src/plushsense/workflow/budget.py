"""Train a network for live use and evaluate it on people left out, in about a given time.

The speed of the computer is measured first; from it follow the number of epochs, the number of groups in which people
are left out, and whether a learning curve is measured: how the score grows with the number of people to train on. What
does not fit into the time is cut, and the result names it. The network is saved before it is evaluated, and finished
folds are stored, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import PlushSenseError, python_warning
from plushsense.core.files import free_path
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.jobs.journal import job_id
from plushsense.jobs.progress import JobProgress
from plushsense.models.bundle import Bundle
from plushsense.training.spec import EpochRow
from plushsense.windows.cut import ANYWHERE
from plushsense.workflow.api import FoldsSpec, evaluate_run, train, unfinished
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.estimate import preview_evaluation
from plushsense.workflow.learning import LearningCurve, accuracies, learning_curve, save_curve
from plushsense.workflow.networks import REFIT
from plushsense.workflow.preparation import (
    Run,
    Warn,
    count_people,
    network_for,
    prepare,
    refit_epochs,
    silent,
    with_preset,
)
from plushsense.workflow.reporting import PAGE, check_folder, journal_of, write_report

TRAINING, DECIDING, EVALUATING, LEARNING_CURVE = "training", "deciding", "evaluating", "learning"
_KNOWN_PEOPLE = "by-recording:5"
_FEWEST_FOLDS, _FOLDS = 3, (10, 5)
_FEWEST_EPOCHS = 10
# One to test, one to validate, one to train on.
_PEOPLE_FOR_SPLIT = 3
_PEOPLE_FOR_CURVE = 4
_CURVE_SHARES = (1 / 3, 2 / 3)
# Time below which processes of their own for the folds cost more than they save.
_START_S = 15.0
# Share of the time that a plan may use, because the computer may be busier later.
_USED = 0.85


@dataclass(frozen=True)
class TrainingCost:
    """Measured cost of trainings on this computer.

    Attributes:
        window_epoch_s: seconds to train on one window for one epoch.
        windows: number of windows of all people.
        side_by_side: number of folds that are trained at the same time.
        networks: number of trainings that the final network takes: more than 1 if people are first held out for its
            decision settings.
    """

    window_epoch_s: float
    windows: int
    side_by_side: int = 1
    networks: float = 1.0

    def training_s(self, epochs: int) -> float:
        """Return the seconds to train the final network."""
        return self.window_epoch_s * self.windows * epochs * self.networks

    def evaluation_s(self, epochs: int, folds: int, share: float = 1.0) -> float:
        """Return the seconds to train on a ``share`` of the people in each of ``folds``."""
        part = self.windows * (1 - 1 / folds) * share
        return self.window_epoch_s * part * epochs * math.ceil(folds / min(self.side_by_side, folds))


@dataclass(frozen=True)
class BudgetPlan:
    """Plan of a run: ``epochs`` of ``usual_epochs``, the ``split`` into ``folds``, and the sizes of the learning curve.

    ``sizes`` are numbers of people to train on, without that of the evaluation itself; none if nothing is measured.
    ``workers`` is as in `EvaluationSpec`.
    """

    epochs: int
    usual_epochs: int
    split: str
    folds: int
    people: int
    sizes: tuple[int, ...] = ()
    workers: int = 0

    @property
    def trained_people(self) -> int:
        """Number of people that a fold of the evaluation is trained on; the smallest of all folds."""
        return self.people - math.ceil(self.people / self.folds)


def choose_plan(cost: TrainingCost, people: int, usual_epochs: int, seconds: float) -> BudgetPlan:
    """Choose the most informative plan that takes at most ``seconds``.

    Preferred are more folds, each person alone first, but a learning curve comes before more than 5 folds. If not even
    3 folds fit, the trainings are shortened to 10 epochs or more, which may still take longer than ``seconds``.
    """
    if people < _PEOPLE_FOR_SPLIT:
        return _shortened(cost, BudgetPlan(usual_epochs, usual_epochs, _KNOWN_PEOPLE, 5, people), seconds)
    folds = [people, *(k for k in _FOLDS if k < people)]
    plans = [_of_folds(usual_epochs, people, k) for k in folds]
    plans = [replace(p, sizes=curve_sizes(p.trained_people)) for p in plans]
    least = _of_folds(usual_epochs, people, min(_FEWEST_FOLDS, people))
    for plan in (*plans, replace(plans[-1], sizes=()), least):
        if plan_s(cost, plan) <= seconds:
            return plan
    return _shortened(cost, least, seconds)


def _of_folds(epochs: int, people: int, folds: int) -> BudgetPlan:
    split = "leave-one-subject-out" if folds == people else f"by-subject:{folds}"
    return BudgetPlan(epochs, epochs, split, folds, people)


def _shortened(cost: TrainingCost, plan: BudgetPlan, seconds: float) -> BudgetPlan:
    epochs = int(plan.usual_epochs * seconds / plan_s(cost, plan))
    return replace(plan, epochs=min(plan.usual_epochs, max(_FEWEST_EPOCHS, epochs)))


def curve_sizes(people: int) -> tuple[int, ...]:
    """Return the numbers of training people at which the learning curve of a fold with ``people`` is measured."""
    if people < _PEOPLE_FOR_CURVE - 1:
        return ()
    return tuple(sorted({max(1, round(share * people)) for share in _CURVE_SHARES} - {people}))


def plan_s(cost: TrainingCost, plan: BudgetPlan) -> float:
    """Estimate the seconds that a plan takes."""
    shares = [1.0, *(size / plan.trained_people for size in plan.sizes)]
    return cost.training_s(plan.epochs) + sum(cost.evaluation_s(plan.epochs, plan.folds, s) for s in shares)


@dataclass(frozen=True)
class BudgetProgress:
    """Progress of `make_network`.

    Attributes:
        stage: `TRAINING`, `DECIDING` (fitting decisions), `EVALUATING` or `LEARNING_CURVE`.
        share: share of the planned work that is done.
        row: epoch, epochs and figures of the epoch while training; done and folds in an evaluation.
        bundle: path of the saved network; "" before it is saved.
    """

    stage: str
    share: float
    row: dict[str, Any]
    bundle: str = ""


Reporter = Callable[[BudgetProgress], None]


@dataclass(frozen=True)
class BudgetResult:
    """A network that was made within a budget of time.

    Attributes:
        bundle: path of the network.
        evaluation: folder of its evaluation.
        report: page of the evaluation.
        learning: None if it was not measured.
        cut: what did not fit into the budget, as dictionaries with a ``kind`` (``epochs``, ``folds``, ``learning``,
            ``longer``).
    """

    bundle: Path
    evaluation: Path
    report: Path
    plan: BudgetPlan
    learning: LearningCurve | None
    cut: tuple[Mapping[str, Any], ...]
    seconds: float

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        paths = {name: str(getattr(self, name)) for name in ("bundle", "evaluation", "report")}
        learning = None if self.learning is None else self.learning.to_json()
        seconds = round(self.seconds, 1)
        return paths | {"plan": asdict(self.plan), "learning": learning, "cut": list(self.cut), "seconds": seconds}


def make_network(
    dataset: Dataset | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    budget_s: float,
    config: RunConfig | None = None,
    progress: Reporter = lambda at: None,
    warn: Warn = python_warning,
) -> BudgetResult:
    """Train a network, save it as the bundle ``out``, and evaluate it on people left out, in about ``budget_s``.

    If there is another file ``out``, the bundle gets a number.

    By default it is trained for live use (context "anywhere") if the data set has sessions, and with the defaults of
    the preset "people" otherwise. With fewer than three people, recordings are left out instead.
    """
    dataset, out = as_dataset(dataset), Path(out)
    check_folder(out.parent, "A bundle")
    if config is None:
        streams = any(recording.stream_row >= 0 for recording in dataset.used)
        config = from_settings(context=ANYWHERE) if streams else from_settings()
    return _Making(dataset, out, budget_s, config, progress, warn).run()


class _Making:
    """A run of `make_network`."""

    def __init__(
        self, dataset: Dataset, out: Path, budget_s: float, config: RunConfig, progress: Reporter, warn: Warn
    ) -> None:
        self._began = time.monotonic()
        self._dataset, self._out = dataset, out
        self._config = with_preset(config, network_for(config, dataset.layout)[0])
        self._budget_s, self._progress, self._warn = budget_s, progress, warn
        self._again = refit_epochs(self._config, count_people(dataset)) / self._config.training.epochs
        # A resumed run must not choose other folds because the computer is faster or slower than before.
        self._journal = journal_of(dataset, "budgets")
        self._key = job_id({"evaluation": prepare(dataset, config).id, "out": out.name, "seconds": budget_s})

    @property
    def _seconds(self) -> float:
        return time.monotonic() - self._began

    def run(self) -> BudgetResult:
        stored = self._journal.find(self._key)
        if stored is None:
            plan, bundle = self._begin()
        else:
            plan = BudgetPlan(**{**stored["plan"], "sizes": tuple(stored["plan"]["sizes"])})
            bundle = _saved_bundle(self._out.parent / stored["bundle"]) or self._train(plan)[0]
            self._store(plan, bundle.name)
        run = prepare(self._dataset, _planned(self._config, plan), self._warn)
        folder = self._dataset.path / "evaluations" / run.name
        learning = self._evaluate(plan, run, folder, bundle, resumed=stored is not None)
        if learning is not None:
            save_curve(learning, run, folder)
        report = write_report(folder / PAGE, self._dataset, [folder])
        self._journal.discard(self._key)
        cut = _cut(plan, learning, self._seconds, self._budget_s)
        return BudgetResult(bundle, folder, report, plan, learning, cut, self._seconds)

    def _begin(self) -> tuple[BudgetPlan, Path]:
        """Plan and train; return the plan, which the measured time may have changed, and the path of the network."""
        seconds = _USED * self._budget_s
        cost = _measured(self._dataset, self._config, 1 + self._again)
        plan = choose_plan(cost, count_people(self._dataset), self._config.training.epochs, seconds)
        if cost.side_by_side * cost.evaluation_s(plan.epochs, plan.folds) < _START_S:
            plan = replace(plan, workers=1)
        self._store(plan, "")
        bundle, training_s = self._train(plan)
        plan = _adjusted(plan, cost, training_s, seconds - self._seconds)
        self._store(plan, bundle.name)
        return plan, bundle

    def _store(self, plan: BudgetPlan, bundle: str) -> None:
        self._journal.save(self._key, {"plan": asdict(plan), "bundle": bundle})

    def _whole(self, plan: BudgetPlan) -> float:
        """Return the whole work, in trainings on all people."""
        evaluations = 1.0 + sum(size / plan.trained_people for size in plan.sizes)
        return 1.0 + self._again + (plan.folds - 1) * evaluations

    def _train(self, plan: BudgetPlan) -> tuple[Path, float]:
        """Train the network and save it; return its path, and the seconds that one training on everybody took."""
        whole, again, progress = self._whole(plan), self._again, self._progress

        def epoch_done(epoch: int, epochs: int, row: EpochRow) -> None:
            second = str(row.get("what", "")).startswith(REFIT)
            done = 1.0 + again * epoch / epochs if second else epoch / epochs
            share = done / whole
            progress(BudgetProgress(TRAINING, share, {**row, "epoch": epoch, "epochs": epochs}))
            if epoch == epochs and second == (again > 0):
                progress(BudgetProgress(DECIDING, share, {}))

        config, dataset = _planned(self._config, plan), self._dataset
        done = train(dataset, config, journal=unfinished(dataset), progress=epoch_done, warn=self._warn)
        return done.save(free_path(self._out, done.bundle.to_bytes())), done.seconds / (1 + again)

    def _evaluate(self, plan: BudgetPlan, run: Run, out: Path, bundle: Path, resumed: bool) -> LearningCurve | None:
        """Evaluate on all people, then on fewer while the time allows."""
        before, whole = 1.0 + self._again, self._whole(plan)

        def evaluated(stage: str, share: float, spec: FoldsSpec) -> dict[str, float | None]:
            base = before

            def fold_done(at: JobProgress) -> None:
                done = base + at.share * (plan.folds - 1) * share
                row = {"done": at.done, "folds": at.total}
                self._progress(BudgetProgress(stage, done / whole, row, str(bundle)))

            scores = evaluate_run(run, spec, progress=fold_done, warn=self._warn if spec.people is None else silent)
            return accuracies(scores)

        started = time.monotonic()
        points = {plan.trained_people: evaluated(EVALUATING, 1.0, FoldsSpec(out))}
        evaluation_s = time.monotonic() - started
        before += plan.folds - 1
        for size in plan.sizes:
            share = size / plan.trained_people
            if not resumed and share * evaluation_s > self._budget_s - self._seconds:
                break
            points[size] = evaluated(LEARNING_CURVE, share, FoldsSpec(people=size))
            before += (plan.folds - 1) * share
        return learning_curve(points)


def _measured(dataset: Dataset, config: RunConfig, networks: float) -> TrainingCost:
    split = "leave-one-subject-out" if count_people(dataset) >= _PEOPLE_FOR_SPLIT else _KNOWN_PEOPLE
    seen = preview_evaluation(dataset, replace(config, evaluation=replace(config.evaluation, split=split)))
    return TrainingCost(seen.window_epoch_s, seen.windows, config.evaluation.processes, networks)


def _planned(config: RunConfig, plan: BudgetPlan) -> RunConfig:
    """Return the settings with the split and the epochs of the plan; the learning rate falls in the same proportion."""
    training = config.training
    if plan.epochs < plan.usual_epochs:
        training = training.with_epochs(plan.epochs)
    workers = plan.workers or config.evaluation.workers
    evaluation = replace(config.evaluation, split=plan.split, workers=workers)
    return replace(config, training=training, evaluation=evaluation, given=config.given | {"epochs"})


def _adjusted(plan: BudgetPlan, cost: TrainingCost, training_s: float, left_s: float) -> BudgetPlan:
    """Return the plan with fewer folds if one training took longer than estimated, and ``left_s`` is not enough."""
    cost = replace(cost, window_epoch_s=max(cost.window_epoch_s, training_s / (cost.windows * plan.epochs)))
    trained_s = cost.training_s(plan.epochs)
    if plan_s(cost, plan) - trained_s <= left_s:
        return plan
    other = choose_plan(cost, plan.people, plan.epochs, left_s + trained_s)
    return replace(other, epochs=plan.epochs, usual_epochs=plan.usual_epochs, workers=plan.workers)


def _saved_bundle(path: Path) -> Path | None:
    """Return the path of the network that an interrupted run has saved; None if there is none."""
    with suppress(PlushSenseError):
        Bundle.load(path)
        return path
    return None


def _cut(plan: BudgetPlan, learning: object, seconds: float, budget_s: float) -> tuple[Mapping[str, Any], ...]:
    """Return what did not fit into the budget, as in `BudgetResult`."""
    cut: list[Mapping[str, Any]] = []
    if plan.epochs < plan.usual_epochs:
        cut.append({"kind": "epochs", "epochs": plan.epochs, "usual": plan.usual_epochs})
    if plan.people != plan.folds and plan.people >= _PEOPLE_FOR_SPLIT:
        cut.append({"kind": "folds", "folds": plan.folds, "people": plan.people})
    if learning is None and plan.people >= _PEOPLE_FOR_CURVE:
        cut.append({"kind": "learning"})
    if seconds > budget_s:
        cut.append({"kind": "longer", "minutes": round(seconds / 60, 1), "budget": round(budget_s / 60)})
    return tuple(cut)
