"""Draw the figures of a sweep in the paper's order, each with a line below that describes the data and the split."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense.core.errors import need
from plushsense.experiments.sweep.grid import CHOSEN, SECOND
from plushsense.experiments.sweep.results import SweepResult, name_of
from plushsense.experiments.sweep.tables import (
    COSTS,
    ArchitectureScores,
    architectures,
    pareto_points,
    table4,
    top_rows,
)
from plushsense.reports import figures
from plushsense.reports.table import Row
from plushsense.reports.wording import describe_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours; shapes repeat the information of colours, and light and dark tones can be told apart in grey.
MAX, MEAN, SIZE = "#0072b2", "#a6cfe8", "#d55e00"
CLASSES = (
    ("o", "#56b4e9"),
    ("s", "#e69f00"),
    ("^", "#009e73"),
    ("D", "#cc79a7"),
    ("v", "#0072b2"),
    ("P", "#d55e00"),
    ("X", "#f0e442"),
    ("h", "#7f7f7f"),
)
BARS = 30
"""Largest number of architectures in a bar chart; of more only the best are drawn, so that it stays legible."""
_BAR_WITH_VALUE = 10.0
_LETTERS_AN_INCH = 13
_NARROWEST_IN = 5.2
_RANKED = 15
LIKE = "As the paper's Figure {}"
PAPER_CONFUSIONS = {CHOSEN: 10, SECOND: 11}
"""The figures of the paper that show the confusions of these networks (symbol, filters)."""
NAMED = 14
"""Largest number of points of a Pareto front that are labelled."""


def about(sweep: SweepResult) -> str:
    """Return the line below a figure: data set, split, number of runs, and whether it is leaky or simulated."""
    parts = [
        f"data: {sweep.head.get('dataset') or '?'}",
        f"split {sweep.head.get('split') or '?'}" + (" (LEAKY)" if sweep.leaky else ""),
        describe_runs(sweep.rows),
    ]
    if len(sweep.done) < sweep.total:
        parts.append(f"{len(sweep.done)} of {sweep.total} trials done")
    if sweep.simulated:
        parts.insert(0, "SIMULATION, says nothing about a real toy")
    return " · ".join(parts)


def _figure(sweep: SweepResult, width: float, height: float, title: str) -> Figure:
    figure = figures.new_figure(width, height)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left").set_parse_math(False)
    _describe_below(figure, sweep)
    return figure


def _describe_below(figure: Figure, sweep: SweepResult) -> None:
    warned = sweep.leaky or sweep.simulated
    colour, weight = ("#b3261e", "bold") if warned else ("#57606a", "normal")
    lines = textwrap.fill(about(sweep), round(_LETTERS_AN_INCH * figure.get_figwidth()), break_on_hyphens=False)
    text = figure.supxlabel(lines, fontsize=7.5, color=colour, fontweight=weight)
    text.set_parse_math(False)


def score_label(sweep: SweepResult, measure: str) -> str:
    marks = ["leaky"] * sweep.leaky + ["simulation"] * sweep.simulated
    return f"{measure}{', ' + ', '.join(marks) if marks else ''}"


def by_architecture(sweep: SweepResult) -> Figure:
    """Draw the paper's Figure 7: highest and mean accuracy of each architecture, and its size with the most filters."""
    rows = _best(architectures(sweep))
    title = f"{LIKE.format(7)}: accuracy of each architecture, and its size"
    figure = _figure(sweep, 9.2, 1.9 + 0.42 * len(rows), title)
    axes = figure.add_subplot()
    _accuracy_bars(axes, rows, "epochs, batch and filters")
    axes.set_xlabel(score_label(sweep, "Accuracy (% of test windows)"), fontsize=9)
    top = axes.twiny()
    sizes = [row.parameters / 1000 for row in rows]
    top.plot(sizes, np.arange(len(rows)) - 0.2, "D", color=SIZE, markeredgecolor="black", markersize=5.5)
    top.set_xlim(0, max(sizes) * 1.08)
    largest = sweep.filter_sets[-1].replace("/", " ")
    top.set_xlabel(f"◆ learnable parameters with the largest filters, [{largest}] (thousands)", fontsize=9, color=SIZE)
    top.tick_params(labelsize=8, colors=SIZE)
    top.spines[["right", "bottom"]].set_visible(False)
    _legend(figure, axes)
    return figure


def by_filters(sweep: SweepResult) -> Figure:
    """Draw the paper's Figure 8: the bars of Figure 7 in one panel for each filter set, the largest set first."""
    sets = sweep.filter_sets[::-1]
    names = [row.arch for row in _best(architectures(sweep))]
    rows_of_panels = -(-len(sets) // 2)
    title = f"{LIKE.format(8)}: accuracy of each architecture by filter set"
    figure = _figure(sweep, 9.6, 1.2 + rows_of_panels * (1.0 + 0.33 * len(names)), title)
    panels = figure.subplots(rows_of_panels, 2, sharex=True, squeeze=False).flatten()
    for i, (axes, filter_set) in enumerate(zip(panels, sets, strict=False)):
        by_name = {row.arch: row for row in architectures(sweep, filter_set)}
        rows = [by_name.get(arch) or ArchitectureScores(arch, filter_set, None, None, None, 0, 0) for arch in names]
        _accuracy_bars(axes, rows, "epochs and batch")
        axes.set_title(f"({chr(97 + i % 26)})  [{filter_set.replace('/', ' ')}]", fontsize=9.5, loc="left")
        axes.set_xlabel(score_label(sweep, "Accuracy (% of test windows)"), fontsize=8.5)
        axes.tick_params(labelbottom=True)
        if i % 2:
            axes.set_yticklabels([])
    for axes in panels[len(sets) :]:
        axes.set_visible(False)
    _legend(figure, panels[0])
    return figure


def _best(rows: Sequence[ArchitectureScores]) -> list[ArchitectureScores]:
    """Return the `BARS` rows with the highest accuracy, in their original order."""
    best = sorted(rows, key=lambda r: -(r.highest or 0.0))[:BARS]
    return [row for row in rows if row in best]


def _accuracy_bars(axes: Axes, rows: Sequence[ArchitectureScores], over: str) -> None:
    at = np.arange(len(rows))
    values = [(r.highest, r.mean, r.sd) for r in rows]
    high, mean, sd = 100 * np.array(values, dtype=np.float64).reshape(-1, 3).T
    axes.barh(at - 0.2, high, 0.38, color=MAX, label="highest")
    axes.barh(at + 0.2, mean, 0.38, color=MEAN, edgecolor=MAX, linewidth=0.6, label=f"mean over {over} ± sd")
    some = sd > 0
    if some.any():
        rows_at = at[some] + 0.2
        axes.errorbar(mean[some], rows_at, xerr=sd[some], fmt="none", ecolor="#333333", elinewidth=0.9, capsize=1.8)
    for y, value in enumerate(high):
        if np.isfinite(value):
            # Write the value inside a bar that is long enough.
            at_x, ink = (1.2, "white") if value > _BAR_WITH_VALUE else (value + 1.2, "black")
            axes.text(at_x, y - 0.19, f"{value:.1f}", va="center", fontsize=7.5, color=ink)
        else:
            axes.text(1.2, y, "no trial done", va="center", fontsize=7.5, color="#57606a")
    axes.set_yticks(at, [r.arch for r in rows], parse_math=False)
    axes.tick_params(labelsize=8)
    axes.set_xlim(0, 100)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.xaxis.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8, frameon=False)


def size_and_accuracy(sweep: SweepResult) -> Figure:
    """Draw the paper's Figure 9: accuracy against the number of parameters, for the networks of Table 4."""
    rows = top_rows(table4(sweep))
    figure = _figure(sweep, 9.2, 5.2, f"{LIKE.format(9)}: accuracy and size of the best of each size class")
    axes = figure.add_subplot()
    points = []
    for filter_set, (marker, colour) in _by_class(sweep):
        mine = [r for r in rows if r["filter_set"] == filter_set]
        x, y = [r["parameters"] for r in mine], [100 * r["accuracy"] for r in mine]
        if mine:
            axes.plot(x, y, marker, color=colour, markeredgecolor="black", markersize=8, label=_bracket(filter_set))
        points += [figures.LabelledPoint(a, b, str(r["arch"])) for a, b, r in zip(x, y, mine, strict=True)]
    _log_x(axes, [p.x for p in points], "Learnable parameters")
    _room(axes, [p.y for p in points])
    axes.set_ylabel(score_label(sweep, "Highest accuracy (% of test windows)"), fontsize=9)
    _class_legend(axes)
    figures.place_labels(figure, axes, points)
    return figure


def pareto(sweep: SweepResult, cost: str) -> Figure:
    """Draw the best macro-F1 of each network against a cost, with the Pareto front as a line with labelled points."""
    points = pareto_points(sweep, cost)
    label = COSTS[cost]
    figure = _figure(sweep, 9.2, 5.2, f"Macro-F1 against {label[0].lower()}{label[1:]}")
    axes = figure.add_subplot()
    edge = [p for p in points if p.front]
    steps = sorted({(p.value, p.macro_f1) for p in edge})
    _log_x(axes, [p.value for p in points], f"{label}, log scale")
    _room(axes, [p.macro_f1 for p in points])
    right = axes.get_xlim()[1]
    corners = [*steps, (right, steps[-1][1])]
    front: dict[str, Any] = {
        "color": "#333333",
        "linewidth": 1.2,
        "drawstyle": "steps-post",
        "zorder": 1,
        "label": "front",
    }
    axes.plot([x for x, _ in corners], [y for _, y in corners], **front)
    styles: dict[bool, dict[str, Any]] = {
        False: {"alpha": 0.55, "markeredgecolor": "#777777", "markeredgewidth": 0.5, "markersize": 5.5, "zorder": 2},
        True: {"alpha": 1.0, "markeredgecolor": "black", "markeredgewidth": 1.3, "markersize": 9, "zorder": 3},
    }
    for filter_set, (marker, colour) in _by_class(sweep):
        for on, style in styles.items():
            mine = [p for p in points if p.filter_set == filter_set and p.front is on]
            axes.plot([p.value for p in mine], [p.macro_f1 for p in mine], marker, color=colour, **style)
        axes.plot([], [], marker, color=colour, markeredgecolor="black", markersize=7, label=_bracket(filter_set))
    axes.set_ylabel(score_label(sweep, "Best macro-F1 (0 to 1)"), fontsize=9)
    _class_legend(axes)
    named = sorted(edge, key=lambda p: -p.macro_f1)[:NAMED]
    labels = [figures.LabelledPoint(p.value, p.macro_f1, f"{p.arch}\n{p.filters}") for p in named]
    labels += [figures.LabelledPoint(p.value, p.macro_f1, "") for p in points if p not in named]
    flat = [(x, y, after, y) for (x, y), (after, _) in pairwise(corners)]
    upright = [(after, y, after, high) for (_, y), (after, high) in pairwise(corners)]
    figures.place_labels(figure, axes, labels, avoid=flat + upright)
    return figure


def _class_legend(axes: Axes) -> None:
    place: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False}
    axes.legend(title="filters", fontsize=8, title_fontsize=8, **place)


def curves(sweep: SweepResult, trial: Row) -> Figure | None:
    """Draw the learning curves of a trial in training and validation; None if none were stored."""
    histories = sweep.histories(trial)
    if not histories:
        return None
    figure = figures.training_curves(histories, title=f"Learning curves of {name_of(trial)}", of="runs")
    _describe_below(figure, sweep)
    return figure


def confusion(sweep: SweepResult, trial: Row) -> Figure | None:
    """Draw a confusion matrix as in the paper's Figures 10 and 11, with classes sorted and framed by affect."""
    counts = sweep.confusion(str(trial["trial"]))
    if counts is None:
        return None
    order = affect_order(sweep.affects)
    labels, affects = [sweep.labels[i] for i in order], [sweep.affects[i] for i in order]
    table = np.asarray(counts)[np.ix_(order, order)]
    number = PAPER_CONFUSIONS.get((trial["arch"], trial["filters"]))
    title = f"{LIKE.format(number)}: confusions of" if number else "Confusions of"
    figure = figures.confusion(labels, table, title=f"{title}\n{name_of(trial)}")
    figure.set_figwidth(max(figure.get_figwidth(), _NARROWEST_IN))
    axes = figure.axes[0]
    rectangle = need("matplotlib.patches", "reports").Rectangle
    for affect in dict.fromkeys(affects):
        first, size = affects.index(affect), affects.count(affect)
        if size == len(affects):
            break
        frame = rectangle((first - 0.5, first - 0.5), size, size, fill=False, edgecolor=SIZE, linewidth=2.4, zorder=5)
        frame.set_clip_on(False)
        axes.add_patch(frame)
        at = first + (size - 1) / 2
        label = axes.text(
            len(labels) - 0.35, at, affect, rotation=270, va="center", ha="left", fontsize=9, color="#9c4400"
        )
        label.set_parse_math(False)
    axes.set_xlabel("Read as   (windows; shade: share of the row)")
    _describe_below(figure, sweep)
    return figure


def affect_order(affects: Sequence[str]) -> list[int]:
    """Return class indices sorted by affect: positive, neutral, negative, then others."""
    ranks = {affect: i for i, affect in enumerate(dict.fromkeys(("positive", "neutral", "negative", *affects)))}
    return sorted(range(len(affects)), key=lambda i: (ranks[affects[i]], i))


def _by_class(sweep: SweepResult) -> list[tuple[str, tuple[str, str]]]:
    """Return each filter set with its marker and colour."""
    return [(s, CLASSES[i % len(CLASSES)]) for i, s in enumerate(sweep.filter_sets)]


def _bracket(filter_set: str) -> str:
    return f"[{filter_set.replace('/', ' ')}]"


def _log_x(axes: Axes, values: Sequence[float], label: str) -> None:
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 1.6, max(values) * 1.9)
    ticker = need("matplotlib.ticker", "reports")
    few = max(values) / min(values) < 30
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0, 3.0)))
    axes.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: short(value)))
    axes.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes.set_xlabel(label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def short(value: float) -> str:
    """Format a number with a unit: ``13k`` for 13 000, ``3.2M`` for 3 200 000."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def _room(axes: Axes, values: Sequence[float]) -> None:
    low, high = min(values), max(values)
    more = 0.12 * (high - low) or 0.05 * (abs(high) or 1.0)
    axes.set_ylim(max(0.0, low - more), high + 1.6 * more)
