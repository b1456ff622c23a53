"""Measure a learning curve: how the accuracy for people left out grows with the number of people to train on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from plushsense.core.errors import ConfigError
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.evaluation.crossval import EvaluationResult, fold_windows, train_on_validation
from plushsense.jobs.progress import JobProgress
from plushsense.scoring.metrics import summary
from plushsense.workflow.api import FoldsSpec, evaluate_run
from plushsense.workflow.preparation import Run, require_people_left_out, silent
from plushsense.workflow.reporting import LEARNING

MORE_PEOPLE = 3
_FEWEST_TESTED = 3


@dataclass(frozen=True)
class LearningPoint:
    """Mean accuracy over the people left out, and its 95 % interval, after training on a number of ``people``."""

    people: int
    accuracy: float
    ci95: tuple[float, float] | None


@dataclass(frozen=True)
class LearningCurve:
    """Accuracy for people left out by the number of people to train on, and what further people would add.

    Attributes:
        points: by the number of people, ascending.
        more: number of further people.
        gain: what they would add to the accuracy, with its 95 % interval ``ci95``.
    """

    points: tuple[LearningPoint, ...]
    more: int
    gain: float
    ci95: tuple[float, float]

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        points = [{**asdict(point), "ci95": point.ci95 and list(point.ci95)} for point in self.points]
        return asdict(self) | {"points": points, "ci95": list(self.ci95)}


def learning_curve(points: Mapping[int, Mapping[str, float | None]], more: int = MORE_PEOPLE) -> LearningCurve | None:
    """Estimate from a learning curve what ``more`` people to train on would add to the accuracy.

    For each person, a line is fitted to the accuracy over the logarithm of the number of training people. The gain is
    the mean slope, times the step of the logarithm; its 95 % interval is a bootstrap over the people.

    Args:
        points: accuracy of each person, by the number of people that were trained on.

    Returns:
        the curve; None with fewer than two sizes or three people, from which no uncertainty follows.
    """
    sizes = sorted(points)
    people = [p for p in points[sizes[-1]] if all(points[m].get(p) is not None for m in sizes)] if sizes else []
    if len(sizes) < 2 or len(people) < _FEWEST_TESTED:
        return None
    x = np.log(np.array(sizes, dtype=np.float64))
    table = np.array([[points[m][p] for m in sizes] for p in people], dtype=np.float64)
    slopes = (table - table.mean(axis=1, keepdims=True)) @ (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    gain = summary(slopes * math.log((sizes[-1] + more) / sizes[-1]))
    means = tuple(LearningPoint(m, float(table[:, k].mean()), summary(table[:, k]).ci95) for k, m in enumerate(sizes))
    if gain.mean is None or gain.ci95 is None:
        return None
    return LearningCurve(means, more, gain.mean, gain.ci95)


def save_curve(curve: LearningCurve, run: Run, out: Path) -> None:
    """Write a curve beside the evaluation of ``run`` in the folder ``out``, with the id by which it belongs to it."""
    with run.dataset.generation.writing():
        write_file(out / LEARNING, json.dumps(curve.to_json() | {"id": run.id}))


def accuracies(result: EvaluationResult) -> dict[str, float | None]:
    """Return the accuracy of each person."""
    return {row.subject: row.metrics["accuracy"] for row in result.scores.subjects}


def trained_people(run: Run) -> int:
    """Return the number of people that a fold of an evaluation is trained on; the smallest of all folds."""
    windows = run.training_windows()
    folds = fold_windows(windows, run.scored_windows(silent), run.split, run.evaluation.seed)
    folds = folds if run.holds_back else train_on_validation(folds)
    return min(len(set(windows.subject[fold.train].tolist()) - {NOBODY, UNKNOWN_SUBJECT}) for fold in folds)


def check_sizes(run: Run, sizes: Sequence[int]) -> int:
    """Return `trained_people`.

    Raises:
        ConfigError: for a split that does not leave people out, or ``sizes`` that its folds do not have.
    """
    require_people_left_out(run, "--people")
    most = trained_people(run)
    if not 1 <= min(sizes) < most or max(sizes) > most:
        raise ConfigError(
            "A learning curve over {sizes} people cannot be measured: a fold of '{split}' is trained on {most}; give "
            "numbers below that.",
            sizes=", ".join(map(str, sizes)),
            split=run.split.text,
            most=most,
        )
    return most


def measure_curve(
    run: Run,
    whole: EvaluationResult,
    most: int,
    sizes: Sequence[int],
    cluster: str | None = None,
    progress: Callable[[JobProgress], None] | None = None,
) -> LearningCurve | None:
    """Train the folds of an evaluation on fewer people; return the `learning_curve`.

    Args:
        whole: the evaluation itself, whose folds are trained on ``most`` people.
        sizes: numbers of people, drawn anew for each fold; a larger number includes a smaller.
    """
    points = {most: accuracies(whole)}
    for size in sorted({*sizes} - {most}):
        fewer = FoldsSpec(cluster=cluster, people=size)
        points[size] = accuracies(evaluate_run(run, fewer, progress=progress, warn=silent))
    return learning_curve(points)
