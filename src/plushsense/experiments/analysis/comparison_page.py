"""The page of a comparison and its figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plushsense.experiments.analysis.results import PairedComparisonResult
from plushsense.experiments.analysis.tables import SCORED, model_table, pair_table, split_table
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import number
from plushsense.scoring.comparison import LEVEL
from plushsense.scoring.metrics import column_metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's blue and vermillion; hollow markers show the same difference without colour.
_HONEST, _LEAKY = "#0072b2", "#d55e00"
_GREY = "#999999"


def comparison_page(result: PairedComparisonResult) -> str:
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
