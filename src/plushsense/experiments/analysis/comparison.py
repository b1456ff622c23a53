"""Compare saved evaluations of the same people: paired tests, ranks, and what each split leaks."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import writing_around
from plushsense.evaluation.scores import Predictions, votes_by_person
from plushsense.experiments.analysis.results import ComparedModel, PairedComparisonResult, SavedEvaluation, Scores
from plushsense.experiments.analysis.tables import SCORED, model_table, pair_table, split_table
from plushsense.jobs.journal import job_id
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import number
from plushsense.scoring.comparison import LEVEL, average_ranks, cliques, compare_pairs
from plushsense.scoring.metrics import calibration_error, column_metrics, summary
from plushsense.workflow.reporting import check_results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
            write_file(Path(out) / PAGE, _page(result))
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


# Okabe and Ito's blue and vermillion; hollow markers show the same difference without colour.
_HONEST, _LEAKY = "#0072b2", "#d55e00"
_GREY = "#999999"


def _page(result: PairedComparisonResult) -> str:
    """Return the page of a comparison as HTML."""
    ranked = [(metric.title, data_uri(rank_figure(result, key))) for key, metric in column_metrics().items()]
    copies = [(m.name, m.evaluation.leakage.pairs) for m in result.models if m.evaluation.leakage.pairs]
    return render_page(
        "comparison.html.j2",
        title=f"{len(result.models)} evaluations of {result.dataset}, person by person",
        simulated=result.simulated,
        leaky=result.leaky,
        splits=result.splits,
        context=result.context,
        scored=SCORED[result.scored],
        n=len(result.people),
        models=model_table(result),
        scores=data_uri(score_figure(result)),
        audit=split_table(result),
        copies=copies,
        pairs=[pair_table(result, key) for key in column_metrics()],
        ranks=ranked if len(result.models) > 2 else [],
        people=data_uri(people_figure(result)),
        level=LEVEL,
    )


def score_figure(result: PairedComparisonResult) -> Figure:
    """Draw the mean of each metric of each model with its 95 % interval over people."""
    models = sorted(result.models, key=lambda model: model.name)
    figure = new_figure(7.6, 1.4 + 0.5 * len(models))
    axes = figure.add_subplot()
    for place, (key, metric) in enumerate(column_metrics().items()):
        for y, model in enumerate(models):
            score, leaky = model.scores[key], model.evaluation.leaky
            if score["mean"] is None:
                continue
            at, colour = y + 0.14 * (2 * place - 1), _LEAKY if leaky else _HONEST
            low, high = score["ci95"] or (score["mean"],) * 2
            axes.plot([low, high], [at, at], color=colour, linewidth=1.6)
            axes.plot(
                score["mean"],
                at,
                marker="os"[place % 2],
                color=colour,
                markerfacecolor="#ffffff" if leaky else colour,
                linestyle="none",
                label=metric.name if y == 0 else None,
            )
    names = [f"{m.name}, {m.evaluation.split}" + " (leaky)" * m.evaluation.leaky for m in models]
    axes.set_yticks(range(len(models)), names, parse_math=False)
    axes.set(xlim=(0, 1), ylim=(len(models) - 0.5, -0.5), xlabel="Mean over people, with its 95 % interval")
    _plain(axes)
    figure.legend(fontsize=8, frameon=False, loc="outside upper right", ncols=len(column_metrics()))
    return figure


def rank_figure(result: PairedComparisonResult, key: str) -> Figure:
    """Draw the mean ranks of the models, with bars below those that do not differ significantly."""
    models = sorted(result.models, key=lambda model: model.rank[key])
    runs = result.cliques[key]
    figure = new_figure(7.6, 1.2 + 0.25 * (len(models) + len(runs)))
    axes = figure.add_subplot()
    at = {model.name: model.rank[key] for model in models}
    for i, model in enumerate(models):
        rank, y = model.rank[key], -1 - i
        axes.plot([rank, rank], [0, y], color=_GREY, linewidth=0.8)
        axes.plot(rank, 0, "o", color=_HONEST, markersize=5)
        axes.text(rank + 0.03, y, f"{model.name}  {number(rank, 2)}", va="center", fontsize=8)
    for i, run in enumerate(runs):
        ranks = [at[name] for name in run]
        axes.plot([min(ranks) - 0.03, max(ranks) + 0.03], [0.5 + 0.5 * i] * 2, color="#000000", linewidth=3)
    axes.set(xlim=(0.8, len(models) + 0.6), ylim=(-len(models) - 0.7, 0.8 + 0.5 * len(runs)))
    axes.set_xlabel(f"Mean rank over people by {column_metrics()[key].name} (1 is best)")
    axes.set_yticks([])
    axes.spines[["top", "right", "left"]].set_visible(False)
    return figure


def people_figure(result: PairedComparisonResult) -> Figure:
    """Draw the accuracy of each person under each model."""
    names = [model.name for model in result.models]
    people = sorted(result.people, key=lambda person: result.people[person][names[0]]["accuracy"])
    figure = new_figure(max(5.0, 1.2 + 0.3 * len(people)), 3.4)
    axes = figure.add_subplot()
    for i, name in enumerate(names):
        values = [result.people[person][name]["accuracy"] for person in people]
        axes.plot(range(len(people)), values, marker="osD^v<>P"[i % 8], linestyle="none", label=name, markersize=5)
    axes.set_xticks(range(len(people)), people, rotation=90, fontsize=8, parse_math=False)
    axes.set(ylim=(0, 1.02), ylabel="Accuracy", xlabel="Person")
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    _plain(axes)
    return figure


def _plain(axes: Axes) -> None:
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
