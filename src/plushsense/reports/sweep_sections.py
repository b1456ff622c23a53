"""What the report of a sweep shows, part by part in the paper's order, or why a part makes no sense here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plushsense.reports import sweep_compared as compared
from plushsense.reports import sweep_figures as draw
from plushsense.reports import sweep_tables as tables
from plushsense.reports import words
from plushsense.reports.sweep_paper import SECOND
from plushsense.reports.sweep_results import Row, Sweep
from plushsense.reports.sweep_rows import Table, name_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name, and what it shows in words for who cannot see it."""

    name: str
    figure: Figure
    alt: str


@dataclass(frozen=True)
class Section:
    """A part of the page: tables, figures, and sentences; ``dropped`` says what makes no sense here, and why."""

    key: str
    title: str
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    dropped: tuple[str, ...] = ()
    scores: bool = True


def sections_of(sweep: Sweep) -> Iterator[Section]:
    """All parts of the report, in the paper's order; a part without any score is a sentence."""
    if not sweep.done:
        yield Section("best", "The best trials", dropped=("No trial is done yet: there is no score to show.",))
        yield Section("table-3", "Table 3: parameters", (tables.table3(sweep),), scores=False)
        return
    best = sweep.best
    assert best is not None
    yield Section("best", "The best trials", (tables.best_trials(sweep),))
    yield _overview(sweep)
    yield Section("table-3", "Table 3: parameters", (tables.table3(sweep),), scores=False)
    yield _by_filters(sweep)
    yield _top(sweep)
    yield Section("acr", "ACR ranking", (compared.acr_ranking(sweep),), (_acr(sweep),))
    yield _effect(sweep)
    shown = _looked_at(sweep, best)
    yield _confusions(sweep, shown)
    yield _curves(sweep, shown)
    yield _fronts(sweep)


def _overview(sweep: Sweep) -> Section:
    rows = sorted(compared.architectures(sweep), key=lambda r: -(r["highest"] or 0.0))
    alt = (
        f"Bars: highest and mean accuracy of {len(rows)} architectures. The first: {_bar_words(rows[:3])}. "
        "Diamonds: parameters."
    )
    dropped = _only_best(len(rows))
    return Section(
        "figure-7",
        "Figure 7: accuracy of each architecture",
        (compared.architecture_table(sweep),),
        (Drawing("figure-7-architectures", draw.by_architecture(sweep), alt),),
        dropped,
    )


def _by_filters(sweep: Sweep) -> Section:
    title = "Figure 8: accuracy by filter set"
    if len(sweep.filter_sets) < 2:
        return Section("figure-8", title, dropped=("There is one filter set only: it would be Figure 7 again.",))
    said = []
    for filter_set in sweep.filter_sets[::-1]:
        rows = sorted(compared.architectures(sweep, filter_set), key=lambda r: -(r["highest"] or 0.0))
        said.append(f"{filter_set}: {_bar_words(rows[:1])}")
    alt = f"A panel of bars a filter set: highest and mean accuracy of each architecture. The best: {'; '.join(said)}."
    drawing = Drawing("figure-8-filter-sets", draw.by_filters(sweep), alt)
    return Section("figure-8", title, drawings=(drawing,), dropped=_only_best(len(sweep.archs)))


def _only_best(architectures: int) -> tuple[str, ...]:
    if architectures <= draw.BARS:
        return ()
    return (f"Drawn are the best {draw.BARS} of {architectures} architectures; the CSV has all.",)


def _bar_words(rows: Sequence[Row]) -> str:
    return ", ".join(
        f"{r['arch']} {100 * r['highest']:.1f} % (mean {100 * r['mean']:.1f} %)"
        if r["highest"] is not None
        else f"{r['arch']} not done"
        for r in rows
    )


def _top(sweep: Sweep) -> Section:
    table = tables.table4(sweep)
    title = "Table 4 and Figure 9: the best of each size class"
    if len(table.rows) < 2:
        return Section(
            "table-4", title, (table,), dropped=("One network only is scored: Figure 9 would be one point.",)
        )
    said = ", ".join(
        f"{r['arch']} {r['filters']} {100 * r['accuracy']:.1f} % at {words.count(r['parameters'])}"
        for r in table.rows[:3]
    )
    alt = f"Points: accuracy against parameters of {len(table.rows)} networks. The most accurate: {said} parameters."
    return Section("table-4", title, (table,), (Drawing("figure-9-size", draw.size_and_accuracy(sweep), alt),))


def _acr(sweep: Sweep) -> Drawing:
    first = compared.acr_ranking(sweep).rows[0]
    name = f"{first['arch']} {first['filters']}"
    alt = f"Bars: the networks with the highest ACR. The first: {name}, {100 * (first['acr'] or 0):.1f} %."
    return Drawing("acr", draw.acr_bars(sweep), alt)


def _effect(sweep: Sweep) -> Section:
    title = "Effect of epochs and batch"
    if len(compared.epochs(sweep)) * len(compared.batches(sweep)) < 2:
        return Section(
            "effect", title, dropped=("All trials have the same epochs and batch: there is nothing to compare.",)
        )
    table = compared.effect(sweep)
    if len(table.rows) < 2:
        return Section(
            "effect", title, (table,), dropped=("One schedule only is scored yet: there is nothing to compare.",)
        )
    means = ", ".join(
        f"{r['epochs']} epochs, batch {r['batch_asked']}: {100 * r['accuracy']:.1f} %" for r in table.rows
    )
    alt = f"Lines: mean accuracy and macro-F1 over the networks. {means}."
    return Section("effect", title, (table,), (Drawing("effect", draw.schedules(sweep), alt),))


def _looked_at(sweep: Sweep, best: Row) -> list[Row]:
    """The trials that are looked at closely: the paper's two networks where they are in the grid, and the best."""
    found = [sweep.chosen, sweep.best_of(*SECOND), best]
    return list({t["trial"]: t for t in found if t}.values())


def _confusions(sweep: Sweep, shown: Sequence[Row]) -> Section:
    title = "Figures 10 and 11: confusions"
    if len(sweep.labels) < 2:
        return Section("confusion", title, dropped=("The sweep names no classes: there is nothing to confuse.",))
    drawings, kept, dropped = [], [], []
    for trial in shown:
        figure = draw.confusion(sweep, trial)
        if figure is None:
            dropped.append(f"The confusions of {name_of(trial)} were not kept.")
            continue
        drawings.append(Drawing(f"confusion-{_file_name(trial)}", figure, confusion_words(sweep, trial)))
        kept += [table for table in (tables.per_class(sweep, trial),) if table]
    if kept and set(sweep.affects) == {"none"}:
        dropped.append("The gestures of this data set have no affect: there are no blocks.")
    return Section("confusion", title, tuple(kept), tuple(drawings), tuple(dropped))


def confusion_words(sweep: Sweep, trial: Row) -> str:
    """A confusion matrix in words: right, mistaken for one of the same affect, mistaken for one of another."""
    counts = sweep.confusion(str(trial["trial"])) or []
    total = sum(map(sum, counts))
    right = sum(row[i] for i, row in enumerate(counts))
    affects = sweep.affects
    across = sum(n for i, row in enumerate(counts) for j, n in enumerate(row) if affects[i] != affects[j])
    share = 100 * right / max(total, 1)
    said = f"Confusion matrix of {name_of(trial)}: {right} of {words.count(total)} windows right ({share:.1f} %)"
    if len(set(affects)) > 1:
        inside = total - right - across
        said += (
            f"; {100 * inside / max(total, 1):.1f} % read as another gesture of the same affect, "
            f"{100 * across / max(total, 1):.1f} % as one of another affect"
        )
    pairs = [(n, i, j) for i, row in enumerate(counts) for j, n in enumerate(row) if i != j and n]
    if pairs:
        n, i, j = max(pairs, key=lambda p: p[0])
        said += f". Most often mistaken: {sweep.labels[i]} for {sweep.labels[j]} ({n} windows)"
    return said + "."


def _curves(sweep: Sweep, shown: Sequence[Row]) -> Section:
    drawings, dropped = [], []
    for trial in shown:
        figure = draw.curves(sweep, trial)
        if figure is None:
            dropped.append(f"No learning curves of {name_of(trial)} were kept.")
            continue
        alt = f"Learning curves of {name_of(trial)}: loss and accuracy by epoch, training and validation."
        drawings.append(Drawing(f"curves-{_file_name(trial)}", figure, alt))
    return Section("curves", "Learning curves", drawings=tuple(drawings), dropped=tuple(dropped))


def _fronts(sweep: Sweep) -> Section:
    drawings, dropped = [], []
    for cost, label in compared.COSTS.items():
        points = compared.pareto_points(sweep, cost)
        values = {p["value"] for p in points}
        if len(values) < 2:
            same = f": {words.count(next(iter(values)))} for all" if values else ""
            dropped.append(f"No front of macro-F1 against “{label.lower()}”, which does not differ{same}.")
            continue
        edge = [p for p in points if p["front"]]
        said = "; ".join(f"{p['arch']} {p['filters']} ({words.count(p['value'])}, {p['macro_f1']:.3f})" for p in edge)
        alt = f"Points: macro-F1 against {label.lower()} of {len(points)} networks, log scale. On the front: {said}."
        drawings.append(Drawing(f"pareto-{cost.replace('_', '-')}", draw.pareto(sweep, cost), alt))
    return Section("pareto", "Pareto fronts", (compared.pareto(sweep),), tuple(drawings), tuple(dropped))


def _file_name(trial: Row) -> str:
    return f"{trial['arch']}-{str(trial['filters']).replace('/', '-')}-{trial['trial']}"
