"""Compare saved evaluations of the same people: paired tests, ranks, and what each split leaks."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import writing_around
from plushsense.evaluation.scores import Predictions, votes_by_person
from plushsense.experiments.analysis.comparison_page import comparison_page
from plushsense.experiments.analysis.results import ComparedModel, PairedComparisonResult, SavedEvaluation, Scores
from plushsense.jobs.journal import job_id
from plushsense.scoring.comparison import average_ranks, cliques, compare_pairs
from plushsense.scoring.metrics import calibration_error, column_metrics, summary
from plushsense.workflow.reporting import check_results

TABLE, PAGE = "comparison.json", "comparison.html"
# The context of an evaluation of which all windows lie in their recordings; it can be compared with any other.
_INSIDE = "inside"


def compare(
    evaluations: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> PairedComparisonResult:
    """Compare saved evaluations person by person, of several networks, of several splits, or of both.

    Args:
        evaluations: at least two folders that `evaluate` wrote, of the same data, context and gestures.
        out: a folder for ``comparison.json`` and ``comparison.html``; an error if it holds another comparison, unless
            ``overwrite``.

    Raises:
        BadInput: for folders without an evaluation or its predictions, or evaluations that cannot be compared.
    """
    if len(evaluations) < 2:
        raise BadInput("A comparison needs at least two evaluations: give two folders written by  plushsense evaluate")
    writing = writing_around(Path(evaluations[0]))
    found = [SavedEvaluation.read(folder) for folder in evaluations]
    _require_same(found)
    scored, scores = _scores_of_people(found)
    people = sorted(set.intersection(*(set(rows) for rows in scores)))
    if len(people) < 2:
        raise BadInput("The evaluations have fewer than two people in common, so nothing can be paired.")
    identity = job_id({"comparison": [evaluation.id for evaluation in found]})
    if out is not None:
        check_results(Path(out), "A comparison", TABLE, identity, replace=overwrite)
    names = [f"M{i}" for i in range(1, len(found) + 1)]
    values = {
        key: np.array([[rows[p][key] for rows in scores] for p in people], dtype=np.float64) for key in column_metrics()
    }
    models = _ranked(found, names, values)
    pairs = {key: tuple(compare_pairs(names, table)) for key, table in values.items()}
    ordered = {key: [m.name for m in sorted(models, key=lambda m: m.rank[key])] for key in values}
    result = PairedComparisonResult(
        models=tuple(models),
        pairs=pairs,
        cliques={key: cliques(ordered[key], pairs[key]) for key in values},
        people={
            p: {n: {key: float(table[i, j]) for key, table in values.items()} for j, n in enumerate(names)}
            for i, p in enumerate(people)
        },
        scored=scored,
        context=next((e.context for e in found if e.context != _INSIDE), _INSIDE),
        id=identity,
    )
    if out is not None:
        with writing():
            Path(out).mkdir(parents=True, exist_ok=True)
            write_file(Path(out) / PAGE, comparison_page(result))
            write_file(Path(out) / TABLE, json.dumps(result.to_json(), ensure_ascii=False, indent=1))
    return result


def _ranked(
    evaluations: Sequence[SavedEvaluation], names: Sequence[str], values: Mapping[str, NDArray[np.float64]]
) -> list[ComparedModel]:
    """Return the models of a comparison by their mean rank in the first metric; ``values`` are (people, models)."""
    ranks = {key: average_ranks(-table).mean(axis=0) for key, table in values.items()}
    models = []
    for i, (name, evaluation) in enumerate(zip(names, evaluations, strict=True)):
        people = evaluation.predictions.subject != NOBODY
        models.append(
            ComparedModel(
                name,
                evaluation,
                {key: summary(table[:, i]).to_json() for key, table in values.items()},
                {key: float(table[i]) for key, table in ranks.items()},
                calibration_error(evaluation.predictions.probabilities[people], evaluation.predictions.truth[people]),
            )
        )
    first = next(iter(values))
    return sorted(models, key=lambda model: model.rank[first])


def _scores_of_people(evaluations: Sequence[SavedEvaluation]) -> tuple[str, list[Scores]]:
    """Return what is compared of each person (`PairedComparisonResult.scored`), and the scores of each evaluation.

    Raises:
        BadInput: if evaluations of one split scored different recordings.
    """
    of_windows = [evaluation.people for evaluation in evaluations]
    if len({_scored_windows(evaluation.predictions) for evaluation in evaluations}) == 1:
        return "windows", of_windows
    first, recordings = evaluations[0], set(evaluations[0].predictions.recording.tolist())
    for other in evaluations[1:]:
        theirs = set(other.predictions.recording.tolist())
        if theirs == recordings:
            continue
        if len({evaluation.split for evaluation in evaluations}) > 1:
            return "own", of_windows
        raise BadInput(
            f"'{first.folder}' and '{other.folder}' scored different recordings ({len(recordings)} and {len(theirs)}): "
            "only evaluations of the same recordings can be compared."
        )
    return "recordings", [
        {person: vote.metrics for person, vote in votes_by_person(evaluation.predictions).items()}
        for evaluation in evaluations
    ]


def _scored_windows(predictions: Predictions) -> tuple[tuple[str, int], ...]:
    """Return recording and number of each scored window, sorted."""
    return tuple(sorted(zip(predictions.recording.tolist(), predictions.window.tolist(), strict=True)))


def _require_same(evaluations: Sequence[SavedEvaluation]) -> None:
    """Raise BadInput if the evaluations differ in what a comparison holds constant."""
    first = evaluations[0]
    context = next((e.context for e in evaluations if e.context != _INSIDE), _INSIDE)
    for other in evaluations:
        same = {
            "data": other.data == first.data,
            "context": other.context in (context, _INSIDE),
            "gestures": other.labels == first.labels,
        }
        for noun, equal in same.items():
            if not equal:
                raise BadInput(
                    f"'{first.folder}' and '{other.folder}' are evaluations of different {noun}: only evaluations of "
                    "the same data, context and gestures can be compared."
                )
