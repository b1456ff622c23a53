"""Build the results of the train page: a sortable table, a plot of score against size, and details."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.scoring.metrics import pareto_front
from plushsense.studio.app.shell import Page, heading, html, named, scroll_region, section, tag
from plushsense.studio.app.stored_results import (
    EVALUATION,
    TRAINING,
    TRIAL,
    ResultRow,
    StoredResults,
    averaged_over,
    context_text,
    score_labels,
    score_text,
    split_text,
)
from plushsense.studio.app.words import Texts, Words, in_context
from plushsense.studio.pages.train.result_details import ResultDetailsView
from plushsense.studio.widgets.elements import table_html

_COLUMNS: Texts = {
    "data": "Data",
    "kind": "Kind",
    "network": "Network",
    "schedule": "Schedule, epochs (batch)",
    "split": "Split",
    "context": "Context",
    "seeds": "Seeds",
    "over": "Over",
    "accuracy": "Accuracy",
    "macro_f1": "Macro-F1",
    "parameters": "Parameters",
    "when": "Date",
}

_KINDS: Texts = {
    "evaluation": "evaluation",
    "trial": "sweep",
    "training": in_context("result", "training"),
}

_MAX_ROWS = 60
_NONE = float("-inf")

# Sort keys of the columns, of others the value itself.
_SORTS: dict[str, Callable[[ResultRow], Any]] = {
    "split": lambda r: (r.leaky, r.split),
    "over": lambda r: (r.spread, r.units),
    "accuracy": lambda r: _NONE if r.accuracy is None else r.accuracy,
    "macro_f1": lambda r: _NONE if r.macro_f1 is None else r.macro_f1,
    "when": lambda r: r.when_s,
}
_NUMBERS = ("over", "accuracy", "macro_f1", "parameters")
# Columns that the first click sorts in descending order.
_DOWN = ("accuracy", "macro_f1", "when", "over")


class ResultsSection:
    """Section with all results."""

    def __init__(self, page: Page, results: StoredResults, rows: list[ResultRow]) -> None:
        self._page, self._results, self._words = page, results, page.words
        self._rows = rows
        self._sort, self._down = "when", True
        self._data, self._kind = "", ""
        self._all = False
        self._open = ""
        w = self._words
        with section(w("Results"), classes=""):
            about = w(
                "Compare scores only if data, split and context are the same. A training has one seed and was checked "
                "on a few people: do not report its score."
            )
            ui.label(about).classes("ps-dim")
            with ui.row().classes("items-center"):
                self._by_data = ui.select({"": w("all data sets")}, value="", label=w("Data set"))
                tag(self._by_data.classes("w-64"), "filter-data").on_value_change(self._filtered)
                kinds = {"": w("everything")}
                kinds |= {kind: w(_KINDS[kind]) for kind in (EVALUATION, TRIAL, TRAINING)}
                self._by_kind = ui.select(kinds, value="", label=w("Kind"))
                tag(self._by_kind.classes("w-64"), "filter-kind").on_value_change(self._filtered)
            table = tag(scroll_region(w("Results")), "results")
            with table.on("click", self._clicked, js_handler=_CLICKS):
                self._html = html()
            self._pareto = ui.column().classes("w-full")
            self._details = ResultDetailsView(page, results)
        self._group = ""
        self._fill()

    async def reload(self) -> None:
        """Read the results again and display them if they have changed."""
        rows = await run.io_bound(self._results.rows)
        if rows is not None and rows != self._rows:
            self._rows = rows
            self._fill()

    async def open(self, identity: str) -> None:
        """Display the details of the result with this id."""
        await self.reload()
        row = next((r for r in self._rows if r.id == identity), None)
        with self._page.show_errors():
            if row is None:
                row = await run.io_bound(self._results.row, identity)
            if row is not None:
                self._open = identity
                self._draw()
                await self._details.open(row)

    def _filtered(self) -> None:
        self._data, self._kind = str(self._by_data.value or ""), str(self._by_kind.value or "")
        self._draw()

    async def _clicked(self, event: Any) -> None:
        action, _, which = str(event.args).partition(":")
        if action == "sort" and which in _COLUMNS:
            self._down = not self._down if which == self._sort else which in _DOWN
            self._sort = which
            self._draw()
            _refocus(f"sort:{which}")
        elif action == "open":
            await self.open(which)
            _refocus(str(event.args))
        elif action == "all":
            self._all = True
            self._draw()

    def _fill(self) -> None:
        names = {row.data: row.data for row in self._rows}
        self._by_data.set_options({"": self._words("all data sets"), **names}, value=self._data)
        self._draw()

    # The table ------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        chosen = [r for r in self._rows if self._data in ("", r.data) and self._kind in ("", r.kind)]
        chosen.sort(key=_SORTS.get(self._sort) or attrgetter(self._sort), reverse=self._down)
        empty = Markup('<p class="ps-dim">{}</p>').format(
            self._words("There are no results yet. Train or evaluate a network above.")
        )
        self._html.set_content(self._as_table(chosen) if chosen else empty)
        self._draw_pareto(chosen)

    def _as_table(self, rows: list[ResultRow]) -> Markup:
        w = self._words
        head = [Markup('<th scope="col">{}</th>').format(w("Open"))]
        for key, title in _COLUMNS.items():
            sorts = key == self._sort
            state = f' aria-sort="{"descending" if self._down else "ascending"}"' if sorts else ""
            arrow = (" ▼" if self._down else " ▲") if sorts else ""
            kind = ' class="ps-number"' if key in _NUMBERS else ""
            cell = Markup(f'<th scope="col"{kind}{state}><button data-do="sort:{key}">{{}}{arrow}</button></th>')
            head.append(cell.format(w(title)))
        body = Markup("").join(self._as_row(row) for row in (rows if self._all else rows[:_MAX_ROWS]))
        more = Markup("")
        if len(rows) > _MAX_ROWS and not self._all:
            more = Markup('<p><button data-do="all">{}</button></p>').format(w("Show all {n} rows", n=len(rows)))
        return Markup(
            '<table class="ps-table ps-stacked"><caption>{}</caption><thead><tr>{}</tr></thead>'
            "<tbody>{}</tbody></table>{}"
        ).format(w("Results, one per row; click a heading to sort"), Markup("").join(head), body, more)

    def _as_row(self, row: ResultRow) -> Markup:
        w = self._words
        cells = {
            "data": Markup("{} {}").format(row.data, score_labels(w, False, row.simulated)),
            "kind": w(_KINDS[row.kind]),
            "network": row.network,
            "schedule": row.schedule,
            "split": Markup("{} {}").format(split_text(w, row.split), score_labels(w, row.leaky, False)),
            "context": context_text(w, row.context),
            "seeds": row.seeds,
            "over": averaged_over(w, row.spread, row.units),
            "accuracy": score_text(w, row.accuracy, row.accuracy_sd),
            "macro_f1": score_text(w, row.macro_f1, row.macro_f1_sd),
            "parameters": w.count(row.parameters),
            "when": Markup(time.strftime('<span class="ps-nowrap">%Y-%m-%d</span> %H:%M', time.localtime(row.when_s))),
        }
        name = row.path.stem if row.kind == TRAINING else row.network
        columns = Markup("").join(
            Markup('<td class="{}" data-column="{}" data-label="{}">{}</td>').format(
                "ps-number" if key in _NUMBERS else "", key, w(_COLUMNS[key]), text
            )
            for key, text in cells.items()
        )
        chosen = ' aria-selected="true"' if row.id == self._open else ""
        return Markup(
            f'<tr{chosen} data-row="{{id}}"><td><button data-do="open:{{id}}" aria-label="{{label}}">{{open}}</button>'
            "</td>{columns}</tr>"
        ).format(
            id=row.id,
            label=w("Open {network}", network=f"{name}, {split_text(w, row.split)}"),
            open=w("Open"),
            columns=columns,
        )

    # Score against size ---------------------------------------------------------------------------------------

    def _draw_pareto(self, rows: list[ResultRow]) -> None:
        """Plot one group of comparable results, with a field to choose the group."""
        w = self._words
        groups = comparable_groups(w, rows)
        self._pareto.clear()
        if not groups:
            return
        if self._group not in groups:
            self._group = max(groups, key=lambda name: len(groups[name]))
        with self._pareto:
            heading(w("Score and size"), 3)
            with ui.row().classes("items-center"):
                box = ui.select(list(groups), value=self._group, label=w("Compare within"))
                tag(box.classes("w-96"), "pareto-group")
                labels = tag(html(), "pareto-marks")
            plot = ui.echart({}, renderer="svg").classes("ps-pareto")
            tag(plot, "pareto").props('role="img"')
            about = w(
                "Only results on the same people and gestures of the same data. Bars: standard deviation. Bold: no "
                "other network is both as good and smaller."
            )
            ui.label(about).classes("ps-dim")
            data = ui.expansion(w("The data of the plot as a table"), icon="table_rows").classes("w-full")
            with tag(data, "pareto-data"):
                table = tag(html().classes("ps-scroll-x"), "pareto-table")

        def draw() -> None:
            group = groups[self._group]
            labels.set_content(score_labels(w, group[0].leaky, group[0].simulated))
            label = w(
                "Macro-F1 against the number of parameters, {n} networks; the front is joined by a line", n=len(group)
            )
            named(plot, label)
            plot.options.clear()
            plot.options.update(pareto_options(w, group))
            plot.update()
            table.set_content(pareto_table(w, group))

        def choose(event: Any) -> None:
            self._group = str(event.value)
            draw()

        box.on_value_change(choose)
        draw()


def comparable_groups(w: Words, rows: Sequence[ResultRow]) -> dict[str, list[ResultRow]]:
    """Group the results that can be compared; leave out groups with one member.

    Members have the same data, kind, split, context, classes and held-back people. Groups with the same name, such as
    those of a data set before and after a change, are numbered.
    """
    comparable: dict[tuple[Any, ...], list[ResultRow]] = {}
    for row in rows:
        if row.macro_f1 is not None:
            comparable.setdefault((row.data, row.kind, row.split, row.context, *row.apart), []).append(row)
    groups: dict[str, list[ResultRow]] = {}
    for key, group in sorted(comparable.items(), key=lambda item: -max(row.when_s for row in item[1])):
        if len(group) < 2:
            continue
        data, which, split, context = key[:4]
        name = " · ".join((data, w(_KINDS[which]), split_text(w, split), context_text(w, context)))
        numbered = (f"{name} ({number})" for number in itertools.count(2))
        groups[next(n for n in itertools.chain((name,), numbered) if n not in groups)] = group
    return groups


_CLICKS = '(e) => { const b = e.target.closest("[data-do]"); if (b) emit(b.dataset.do); }'


def _refocus(action: str) -> None:
    """Move the keyboard focus back to a button after its table was rebuilt."""
    ui.run_javascript(
        f"setTimeout(() => [...document.querySelectorAll('[data-do]')]"
        f".find((b) => b.dataset.do === {json.dumps(action)})?.focus(), 60)"
    )


# CSS variables, so that the plot adapts to a change of the colour scheme.
_INK, _DIM, _LINE, _BACKGROUND = "var(--ps-ink)", "var(--ps-dim)", "var(--ps-line)", "var(--train-page)"
_FRONT, _POINT = "#D55E00", "#0072B2"
_TICKS = (1, 2, 5)


def pareto_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Return the Pareto front of macro-F1 and number of parameters, smallest network first."""
    scored = [row for row in rows if row.macro_f1 is not None]
    on_front = pareto_front([(float(row.macro_f1 or 0.0), float(row.parameters)) for row in scored])
    return sorted((row for row, best in zip(scored, on_front, strict=True) if best), key=lambda row: row.parameters)


def pareto_options(w: Words, rows: Sequence[ResultRow]) -> dict[str, object]:
    """Return the options of an ECharts plot of macro-F1 against parameters, for the SVG renderer.

    Leaky results are drawn as hollow diamonds and have the word in their labels.

    Args:
        rows: results that have a macro-F1.
    """
    front = pareto_rows(rows)
    ids = {row.id for row in front}
    low_x, high_x = _log_range([row.parameters for row in rows])
    bars: list[list[float | None]] = []
    for row in rows:
        if row.macro_f1_sd is not None:
            score = row.macro_f1 or 0.0
            low, high = max(0.0, score - row.macro_f1_sd), min(1.0, score + row.macro_f1_sd)
            bars += [[row.parameters, low], [row.parameters, high], [None, None]]
    points = [_point(w, row, row.id in ids, math.sqrt(low_x * high_x)) for row in rows]
    line = {"type": "line", "showSymbol": False, "silent": True, "emphasis": {"disabled": True}}
    return {
        "animation": False,
        "grid": {"left": 70, "right": 24, "top": 20, "bottom": 56},
        # Rich text is not parsed as HTML, so that names are safe.
        "tooltip": {"renderMode": "richText", "confine": True},
        "xAxis": {
            "type": "log",
            "min": low_x,
            "max": high_x,
            "axisLabel": {"customValues": _ticks(low_x, high_x), ":formatter": _SHORT, "color": _INK},
            "axisTick": {"customValues": _ticks(low_x, high_x)},
            **_axis(w("Parameters (logarithmic)"), 32),
        },
        "yAxis": {
            "type": "value",
            "scale": True,
            # Above 0.9, an axis that is chosen by the values can end beyond 1.
            **({"max": 1} if max(row.macro_f1 or 0.0 for row in rows) > 0.9 else {}),
            "axisLabel": {":formatter": _SCORE % w.decimal_point, "color": _INK},
            **_axis(w("Macro-F1 (0 to 1)"), 48),
        },
        "series": [
            {**line, "data": bars, "lineStyle": {"color": _DIM, "width": 1.5}},
            {**line, "data": [[r.parameters, r.macro_f1] for r in front], "lineStyle": {"color": _FRONT, "width": 2}},
            {
                "type": "scatter",
                "data": points,
                "emphasis": {"disabled": True},
                "labelLayout": {"hideOverlap": True},
            },
        ],
    }


def pareto_table(w: Words, rows: Sequence[ResultRow]) -> Markup:
    """Render the data of the plot as a table, smallest network first."""
    ids = {row.id for row in pareto_rows(rows)}
    head = [w(_COLUMNS[key]) for key in ("network", "schedule", "parameters", "macro_f1")]
    cells = [
        (
            row.network,
            f"{row.schedule} ({w('leaky')})" if row.leaky else row.schedule,
            w.count(row.parameters),
            score_text(w, row.macro_f1, row.macro_f1_sd),
            "✓" if row.id in ids else "–",
        )
        for row in sorted(rows, key=lambda row: row.parameters)
    ]
    return table_html([*head, w("On the front")], cells, numbers=(2, 3))


_SCORE = "(v) => v.toFixed(3).replace('.', '%s')"
_SHORT = "(v) => v >= 1000 ? `${v / 1000}k` : `${v}`"


def _point(w: Words, row: ResultRow, front: bool, middle: float) -> dict[str, Any]:
    name = f"{row.network.rpartition(' ')[0]}, {row.schedule.partition(', ')[2]}"
    if row.leaky:
        name = f"{name} ({w('leaky')})"
    text = f"{name}: {w.count(row.parameters)}, {score_text(w, row.macro_f1, row.macro_f1_sd)}"
    hollow = {"color": _BACKGROUND, "borderColor": _FRONT, "borderWidth": 2.5}
    return {
        "name": name,
        "value": [row.parameters, row.macro_f1],
        "symbol": "diamond" if row.leaky else "circle",
        # If labels overlap, ECharts keeps the label of the larger symbol.
        "symbolSize": 13 if front else 10,
        "itemStyle": {"opacity": 1, **(hollow if row.leaky else {"color": _POINT, "borderColor": _BACKGROUND})},
        "label": {
            "show": True,
            "formatter": "{b}",
            "position": "right" if row.parameters < middle else "left",
            "minMargin": 4,
            "color": _INK,
            "fontWeight": "bold" if front else "normal",
        },
        "tooltip": {"formatter": text},
    }


def _axis(name: str, gap: int) -> dict[str, Any]:
    return {
        "name": name,
        "nameLocation": "middle",
        "nameGap": gap,
        "nameTextStyle": {"color": _INK},
        "axisLine": {"lineStyle": {"color": _DIM}},
        "splitLine": {"lineStyle": {"color": _LINE}},
    }


def _log_range(values: Sequence[int]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis, with a margin around the values."""
    low, high = math.log10(min(values)), math.log10(max(values))
    margin = max(0.15, 0.08 * (high - low))
    return 10 ** (low - margin), 10 ** (high + margin)


def _ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [m * 10.0**e for e in decades for m in _TICKS if low <= m * 10.0**e <= high]
