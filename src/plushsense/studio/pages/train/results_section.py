"""The results of the train page: a sortable table, a plot of score against size, and details."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.studio.app.shell import Page, html, named, tag
from plushsense.studio.pages.train.pareto_plot import pareto_options, pareto_table
from plushsense.studio.pages.train.result_details import ResultDetailsView
from plushsense.studio.pages.train.results import (
    EVALUATION,
    TRAINING,
    TRIAL,
    ResultRow,
    StoredResults,
    averaged_over,
    score_labels,
    score_text,
)

_SHOWN = 60
_NONE = float("-inf")

# Sort key of each column.
_SORTS: dict[str, Callable[[ResultRow], Any]] = {
    "data": lambda r: r.data,
    "kind": lambda r: r.kind,
    "network": lambda r: r.network,
    "schedule": lambda r: r.schedule,
    "split": lambda r: (r.leaky, r.split),
    "context": lambda r: r.context,
    "seeds": lambda r: r.seeds,
    "over": lambda r: (r.spread, r.units),
    "accuracy": lambda r: _NONE if r.accuracy is None else r.accuracy,
    "macro_f1": lambda r: _NONE if r.macro_f1 is None else r.macro_f1,
    "parameters": lambda r: r.parameters,
    "macs": lambda r: r.macs,
    "when": lambda r: r.when_s,
}
_NUMBERS = ("over", "accuracy", "macro_f1", "parameters", "macs")
# Columns that are first sorted downwards.
_DOWN = ("accuracy", "macro_f1", "when", "over")


class ResultsSection:
    """The section with all results."""

    def __init__(self, page: Page, results: StoredResults, rows: list[ResultRow]) -> None:
        self._page, self._results, self._words = page, results, page.words
        self._rows = rows
        self._sort, self._down = "when", True
        self._data, self._kind = "", ""
        self._all = False
        self._open = ""
        w = self._words
        with (
            ui.element("section").classes("w-full column no-wrap ps-tight").props(f'aria-label="{w("train.results")}"')
        ):
            ui.label(w("train.results")).classes("text-lg").props('role="heading" aria-level="2"')
            ui.label(w("train.results_told")).classes("ps-dim")
            with ui.row().classes("items-center"):
                self._by_data = ui.select({"": w("train.all_data")}, value="", label=w("train.data"))
                tag(self._by_data.classes("w-64"), "filter-data").on_value_change(self._filtered)
                kinds = {"": w("train.all_kinds")}
                kinds |= {kind: w(f"train.rows.{kind}") for kind in (EVALUATION, TRIAL, TRAINING)}
                self._by_kind = ui.select(kinds, value="", label=w("train.filter_kind"))
                tag(self._by_kind.classes("w-64"), "filter-kind").on_value_change(self._filtered)
            self._table = (
                ui.element("div")
                .classes("ps-sideways")
                .props(f'role="region" tabindex="0" aria-label="{w("train.results")}"')
            )
            tag(self._table, "results")
            self._table.on("click", self._clicked, js_handler=CLICKS)
            with self._table:
                self._html = html()
            self._pareto = ui.column().classes("w-full")
            self._details = ResultDetailsView(page, results)
        self._group = ""
        self._fill()

    async def reload(self) -> None:
        """Read the results again."""
        rows = await run.io_bound(self._results.rows)
        if rows is not None and rows != self._rows:
            self._rows = rows
            self._fill()

    async def open(self, identity: str) -> None:
        """Open the details of a result."""
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
        what, _, which = str(event.args).partition(":")
        if what == "sort" and which in _SORTS:
            self._down = not self._down if which == self._sort else which in _DOWN
            self._sort = which
            self._draw()
            refocus(f"sort:{which}")
        elif what == "open":
            await self.open(which)
            refocus(str(event.args))
        elif what == "all":
            self._all = True
            self._draw()

    def _fill(self) -> None:
        names = {row.data: row.data for row in self._rows}
        self._by_data.set_options({"": self._words("train.all_data"), **names}, value=self._data)
        self._draw()

    # The table ------------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        chosen = [r for r in self._rows if self._data in ("", r.data) and self._kind in ("", r.kind)]
        chosen.sort(key=_SORTS[self._sort], reverse=self._down)
        self._html.set_content(self._as_table(chosen) if chosen else self._none())
        self._draw_pareto(chosen)

    def _none(self) -> Markup:
        return Markup('<p class="ps-dim">{}</p>').format(self._words("train.no_results"))

    def _as_table(self, rows: list[ResultRow]) -> Markup:
        w = self._words
        head = [Markup('<th scope="col">{}</th>').format(w("train.columns.open"))]
        for key in _SORTS:
            on = key == self._sort
            state = f' aria-sort="{"descending" if self._down else "ascending"}"' if on else ""
            arrow = (" ▼" if self._down else " ▲") if on else ""
            kind = ' class="n"' if key in _NUMBERS else ""
            cell = Markup(f'<th scope="col"{kind}{state}><button data-do="sort:{key}">{{}}{arrow}</button></th>')
            head.append(cell.format(w(f"train.columns.{key}")))
        visible = rows if self._all else rows[:_SHOWN]
        body = Markup("").join(self._as_row(row) for row in visible)
        more = Markup("")
        if len(rows) > len(visible):
            more = Markup('<p><button data-do="all">{}</button></p>').format(w("train.all_rows", n=len(rows)))
        return Markup(
            '<table class="ps-table"><caption>{}</caption><thead><tr>{}</tr></thead><tbody>{}</tbody></table>{}'
        ).format(w("train.table"), Markup("").join(head), body, more)

    def _as_row(self, row: ResultRow) -> Markup:
        w = self._words
        cells = {
            "data": Markup("{} {}").format(row.data, score_labels(w, False, row.simulated)),
            "kind": w(f"train.rows.{row.kind}"),
            "network": row.network,
            "schedule": row.schedule,
            "split": Markup("{} {}").format(row.split, score_labels(w, row.leaky, False)),
            "context": row.context,
            "seeds": row.seeds,
            "over": averaged_over(w, row.spread, row.units),
            "accuracy": score_text(row.accuracy, row.accuracy_sd),
            "macro_f1": score_text(row.macro_f1, row.macro_f1_sd),
            "parameters": f"{row.parameters:,}",
            "macs": f"{row.macs:,}",
            "when": Markup(time.strftime('<span class="ps-nowrap">%Y-%m-%d</span> %H:%M', time.localtime(row.when_s))),
        }
        name = row.path.stem if row.kind == TRAINING else row.network
        columns = Markup("").join(
            Markup('<td class="{}" data-column="{}">{}</td>').format("n" if key in _NUMBERS else "", key, text)
            for key, text in cells.items()
        )
        chosen = ' aria-selected="true"' if row.id == self._open else ""
        return Markup(
            f'<tr{chosen} data-row="{{id}}"><td><button data-do="open:{{id}}" aria-label="{{label}}">{{open}}</button>'
            "</td>{columns}</tr>"
        ).format(
            id=row.id,
            label=w("train.open_row", network=f"{name}, {row.split}"),
            open=w("train.columns.open"),
            columns=columns,
        )

    # Score against size ---------------------------------------------------------------------------------------

    def _draw_pareto(self, rows: list[ResultRow]) -> None:
        """Plot one group of comparable results."""
        w = self._words
        groups = comparable_groups(rows, lambda kind: w(f"train.rows.{kind}"))
        self._pareto.clear()
        if not groups:
            return
        if self._group not in groups:
            self._group = max(groups, key=lambda name: len(groups[name]))
        with self._pareto:
            ui.label(w("train.pareto")).classes("text-lg").props('role="heading" aria-level="3"')
            with ui.row().classes("items-center"):
                box = ui.select(list(groups), value=self._group, label=w("train.pareto_group"))
                tag(box.classes("w-96"), "pareto-group")
                labels = tag(html(), "pareto-marks")
            plot = ui.echart({}, renderer="svg").classes("ps-pareto")
            tag(plot, "pareto").props('role="img"')
            ui.label(w("train.pareto_told")).classes("ps-dim")
            with ui.expansion(w("train.pareto_table"), icon="table_rows").classes("w-full") as more:
                table = tag(html().classes("ps-sideways"), "pareto-table")
            tag(more, "pareto-data")

        def draw() -> None:
            group = groups[self._group]
            labels.set_content(score_labels(w, group[0].leaky, group[0].simulated))
            named(plot, w("train.pareto_drawn", n=len(group)))
            plot.options.clear()
            plot.options.update(
                pareto_options(group, x=w("train.pareto_x"), y=w("train.pareto_y"), leaky=w("train.leaky"))
            )
            plot.update()
            table.set_content(pareto_table(w, group))

        def choose(event: Any) -> None:
            self._group = str(event.value)
            draw()

        box.on_value_change(choose)
        draw()


def comparable_groups(rows: Sequence[ResultRow], kind: Callable[[str], str]) -> dict[str, list[ResultRow]]:
    """Group results that can be compared; leave out groups with one member.

    A group has the same data, kind, split, context, classes and held-back people. Groups of one name are numbered, such
    as those of a data set before and after a change.
    """
    found: dict[tuple[Any, ...], list[ResultRow]] = {}
    for row in rows:
        if row.macro_f1 is not None:
            found.setdefault((row.data, row.kind, row.split, row.context, *row.apart), []).append(row)
    groups: dict[str, list[ResultRow]] = {}
    for key, several in sorted(found.items(), key=lambda item: -max(row.when_s for row in item[1])):
        if len(several) < 2:
            continue
        data, which, split, context = key[:4]
        name = plain = " · ".join((data, kind(which), split, context))
        number = 1
        while name in groups:
            number += 1
            name = f"{plain} ({number})"
        groups[name] = several
    return groups


CLICKS = '(e) => { const b = e.target.closest("[data-do]"); if (b) emit(b.dataset.do); }'


def refocus(what: str) -> None:
    """Set the focus to a button again after its table was rebuilt."""
    ui.run_javascript(
        f"setTimeout(() => [...document.querySelectorAll('[data-do]')]"
        f".find((b) => b.dataset.do === {json.dumps(what)})?.focus(), 60)"
    )
