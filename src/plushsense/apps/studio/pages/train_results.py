"""The train page's results: a table to sort, a plot of score against size, and what a row opens to."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from nicegui import run, ui

from plushsense.apps.studio.pages.train_confusion import DetailsView
from plushsense.apps.studio.pages.train_words import marks, over, spread
from plushsense.apps.studio.pareto import Point, drawing
from plushsense.apps.studio.result_rows import EVALUATION, TRAINING, TRIAL, Row, front
from plushsense.apps.studio.results import Results
from plushsense.apps.studio.shell import Page, tag

_SHOWN = 60
_NONE = float("-inf")

# Column to what it is sorted by.
_SORTS: dict[str, Callable[[Row], Any]] = {
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
# The largest first, when they are clicked for the first time.
_DOWN = ("accuracy", "macro_f1", "when", "over")


class ResultsView:
    """The section of results."""

    def __init__(self, page: Page, results: Results, rows: list[Row]) -> None:
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
                self._html = ui.html("", sanitize=False)
            self._pareto = ui.column().classes("w-full")
            self._details = DetailsView(page, results)
        self._group = ""
        self._fill()

    async def reload(self) -> None:
        """Read again what is there."""
        rows = await run.io_bound(self._results.rows)
        if rows is not None and rows != self._rows:
            self._rows = rows
            self._fill()

    async def open(self, identity: str) -> None:
        """Show what a row holds."""
        await self.reload()
        row = next((r for r in self._rows if r.id == identity), None)
        with self._page.refusing():
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

    def _none(self) -> str:
        return f'<p class="ps-dim">{escape(self._words("train.no_results"))}</p>'

    def _as_table(self, rows: list[Row]) -> str:
        w = self._words
        head = [f'<th scope="col">{escape(w("train.columns.open"))}</th>']
        for key in _SORTS:
            on = key == self._sort
            state = f' aria-sort="{"descending" if self._down else "ascending"}"' if on else ""
            arrow = (" ▼" if self._down else " ▲") if on else ""
            kind = ' class="n"' if key in _NUMBERS else ""
            name = escape(w(f"train.columns.{key}"))
            head.append(f'<th scope="col"{kind}{state}><button data-do="sort:{key}">{name}{arrow}</button></th>')
        shown = rows if self._all else rows[:_SHOWN]
        body = "".join(self._as_row(row) for row in shown)
        more = ""
        if len(rows) > len(shown):
            more = f'<p><button data-do="all">{escape(w("train.all_rows", n=len(rows)))}</button></p>'
        caption = escape(w("train.table"))
        return (
            f'<table class="ps-table"><caption>{caption}</caption><thead><tr>{"".join(head)}</tr></thead>'
            f"<tbody>{body}</tbody></table>{more}"
        )

    def _as_row(self, row: Row) -> str:
        w = self._words
        cells = {
            "data": escape(row.data) + (f" {marks(w, False, True)}" if row.simulated else ""),
            "kind": escape(w(f"train.rows.{row.kind}")),
            "network": escape(row.network),
            "schedule": escape(row.schedule),
            "split": escape(row.split) + (f" {marks(w, True, False)}" if row.leaky else ""),
            "context": escape(row.context),
            "seeds": escape(row.seeds),
            "over": escape(over(w, row.spread, row.units)),
            "accuracy": spread(row.accuracy, row.accuracy_sd),
            "macro_f1": spread(row.macro_f1, row.macro_f1_sd),
            "parameters": f"{row.parameters:,}",
            "macs": f"{row.macs:,}",
            "when": time.strftime('<span class="ps-nowrap">%Y-%m-%d</span> %H:%M', time.localtime(row.when_s)),
        }
        name = row.path.stem if row.kind == TRAINING else row.network
        label = escape(w("train.open_row", network=f"{name}, {row.split}"), quote=True)
        columns = "".join(
            f'<td{" class=n" if key in _NUMBERS else ""} data-column="{key}">{text}</td>' for key, text in cells.items()
        )
        link = escape(f"open:{row.id}", quote=True)
        chosen = ' aria-selected="true"' if row.id == self._open else ""
        what = escape(w("train.columns.open"))
        return (
            f'<tr{chosen} data-row="{escape(row.id, quote=True)}">'
            f'<td><button data-do="{link}" aria-label="{label}">{what}</button></td>{columns}</tr>'
        )

    # Score against size ---------------------------------------------------------------------------------------

    def _draw_pareto(self, rows: list[Row]) -> None:
        """Only what can be compared stands in one drawing."""
        w = self._words
        groups = comparable(rows, lambda kind: w(f"train.rows.{kind}"))
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
                several = groups[self._group]
                said = tag(ui.html(marks(w, several[0].leaky, several[0].simulated), sanitize=False), "pareto-marks")
            place = tag(ui.html("", sanitize=False).classes("w-full"), "pareto")
            ui.label(w("train.pareto_told")).classes("ps-dim")

        def chosen(event: Any) -> None:
            self._group = str(event.value)
            mine = groups[self._group]
            said.set_content(marks(w, mine[0].leaky, mine[0].simulated))
            place.set_content(self._drawing(mine))

        box.on_value_change(chosen)
        place.set_content(self._drawing(several))

    def _drawing(self, rows: list[Row]) -> str:
        w = self._words
        best = {row.id for row in front(rows)}
        points = [
            Point(
                row.parameters,
                row.macro_f1 or 0.0,
                row.macro_f1_sd,
                f"{row.network.rpartition(' ')[0]}, {row.schedule.partition(', ')[2]}",
                row.id in best,
                row.leaky,
            )
            for row in rows
        ]
        return drawing(
            points,
            title=w("train.pareto_drawn", n=len(points)),
            x=w("train.pareto_x"),
            y=w("train.pareto_y"),
            leaky=w("train.leaky"),
        )


def comparable(rows: Sequence[Row], kind: Callable[[str], str]) -> dict[str, list[Row]]:
    """Rows of the same data, kind of score, split, context and classes, on the same people; of two and more.

    Groups that would read alike are numbered: the same data set before and after it was changed, say.
    """
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row.macro_f1 is not None:
            found.setdefault((row.data, row.kind, row.split, row.context, *row.apart), []).append(row)
    groups: dict[str, list[Row]] = {}
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
    """Give the focus back to a button whose table was drawn anew."""
    ui.run_javascript(
        f"setTimeout(() => [...document.querySelectorAll('[data-do]')]"
        f".find((b) => b.dataset.do === {json.dumps(what)})?.focus(), 60)"
    )
