"""Details of a result: confusion matrix, recordings of a cell, and scores of each person."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from markupsafe import Markup
from nicegui import run, ui

from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.studio.app.shell import AFFECT_SIGNS, Page, html, named, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.review.selection import Reviews
from plushsense.studio.pages.train.results import (
    EVALUATION,
    HELD_BACK,
    TRAINING,
    Confusion,
    MisreadRecording,
    ResultDetails,
    ResultRow,
    StoredResults,
    averaged_over,
    figure,
    score_labels,
    score_text,
)

_TABLE = Markup('<table class="ps-table"><thead><tr>{}</tr></thead><tbody>{}</tbody></table>')
_CLICKS = '(e) => { const b = e.target.closest("[data-cell]"); if (b) emit(b.dataset.cell); }'


class ResultDetailsView:
    """The card with the details of one result."""

    def __init__(self, page: Page, results: StoredResults) -> None:
        self._page, self._results, self._words = page, results, page.words
        self._place = tag(ui.column().classes("w-full"), "details")
        self._found: ResultDetails | None = None
        self._by = "gesture"
        self._asked = 0

    async def open(self, row: ResultRow) -> None:
        """Display the details of a result."""
        self._found = await run.io_bound(self._results.details, row)
        self._draw()
        ui.run_javascript("setTimeout(() => document.querySelector('[data-test=details]')?.scrollIntoView(), 60)")

    def _close(self) -> None:
        self._found = None
        self._place.clear()

    def _draw(self) -> None:
        self._place.clear()
        d, w = self._found, self._words
        if d is None:
            return
        row = d.row
        with self._place, ui.element("section").classes("ps-card w-full column no-wrap ps-tight") as card:
            card.props(f'aria-label="{w("train.details")}"')
            with ui.row().classes("w-full items-center"):
                title = f"{row.data} · {row.network} · {row.split} · {row.context}"
                ui.label(title).classes("text-weight-bold").props('role="heading" aria-level="3"')
                html(score_labels(w, row.leaky, row.simulated))
                ui.space()
                close = ui.button(icon="close", on_click=self._close, color=None).props("flat round dense")
                close.props(f'aria-label="{w("train.close")}"')
            if row.leaky:
                ui.label(w("train.leaky_told"))
            if row.kind == TRAINING:
                self._training(d)
            if d.by_gesture is None:
                ui.label(w("train.confusion_none")).classes("ps-dim")
            else:
                self._confusions(d)
            if d.people:
                self._people(d)

    def _training(self, d: ResultDetails) -> None:
        w, facts = self._words, d.facts
        checked = sorted(set(facts.get("validation_subjects", [])) - {NOBODY, UNKNOWN_SUBJECT})
        message = w(
            "train.facts_training" if d.row.spread == HELD_BACK else "train.facts_same",
            trained=len(set(facts.get("subjects", [])) - {NOBODY, UNKNOWN_SUBJECT}),
            checked=len(checked),
            names=", ".join(checked) or "–",
            message=facts.get("scores", {}).get("said", ""),
        )
        ui.label(message)
        with ui.row():
            path = quote(str(d.row.path), safe="")
            ui.link(w("train.to_live"), f"/live?model={path}").classes("ps-link")
            ui.link(w("train.to_export"), f"/export?model={path}").classes("ps-link")

    # Confusions -----------------------------------------------------------------------------------------------

    def _confusions(self, d: ResultDetails) -> None:
        w = self._words
        ui.label(w("train.confusion")).classes("text-weight-bold").props('role="heading" aria-level="4"')
        ui.label(w("train.confusion_told" if d.clickable else "train.confusion_kept")).classes("ps-dim")
        choices = {"gesture": w("train.by_gesture"), "affect": w("train.by_affect")}
        radio = ui.radio(choices, value=self._by, on_change=self._turned).props("inline")
        tag(radio, "by").props(f'aria-label="{w("train.confusion")}"')
        box = (
            ui.element("div")
            .classes("ps-sideways")
            .props(f'role="region" tabindex="0" aria-label="{w("train.confusion")}"')
        )
        tag(box, "confusion").on("click", self._clicked, js_handler=_CLICKS)
        with box:
            self._table = html()
        self._cell = tag(ui.column().classes("w-full").props('aria-live="polite"'), "cell")
        self._tabulate()

    def _turned(self, event: Any) -> None:
        self._by = str(event.value)
        self._cell.clear()
        self._tabulate()

    def _tabulate(self) -> None:
        d = self._found
        if d is None or d.by_gesture is None:
            return
        by_affect = self._by == "affect"
        visible = d.by_affect if by_affect and d.by_affect is not None else d.by_gesture
        self._table.set_content(confusion_table(self._words, visible, by_affect, d.clickable))

    async def _clicked(self, event: Any) -> None:
        d = self._found
        if d is None or d.by_gesture is None or not d.clickable:
            return
        visible = d.by_affect if self._by == "affect" and d.by_affect is not None else d.by_gesture
        i, j = (int(n) for n in str(event.args).split(","))
        if not (0 <= i < len(visible.labels) and 0 <= j < len(visible.labels)):
            return
        self._asked += 1
        mine = self._asked
        with self._page.show_errors():
            truth, message = visible.labels[i], visible.labels[j]
            found = await run.io_bound(self._results.misread, d.row, self._gestures(truth), self._gestures(message))
            if found is None:
                return
            name = self._words.affect if self._by == "affect" else self._words.gesture
            windows = sum(one.windows for one in found)
            title = self._words(
                "train.cell_title", truth=name(truth), predicted=name(message), n=len(found), windows=windows
            )
            link = await run.io_bound(self._link, d.row.dataset, [one.recording for one in found], title)
            # Ignore the answer after a later click or another result.
            if link is not None and mine == self._asked and self._found is d:
                self._list(d, title, link, found)

    def _link(self, dataset: str, recordings: list[str], title: str) -> str:
        """Return the address of the recordings in Review, or "" if the data set is not in this studio."""
        if not dataset:
            return ""
        return self._page.workspace.part(Reviews).address(Path(dataset), recordings, title)

    def _gestures(self, label: str) -> list[str]:
        """Return the gestures that a label of the matrix stands for."""
        d = self._found
        if d is None or self._by == "gesture":
            return [label]
        return [gesture for gesture, affect in d.affects.items() if (affect or "none") == label]

    def _list(self, d: ResultDetails, title: str, link: str, found: Sequence[MisreadRecording]) -> None:
        w = self._words
        self._cell.clear()
        with self._cell:
            tag(ui.label(title).classes("text-weight-bold"), "cell-title").props('role="heading" aria-level="5"')
            if link:
                tag(ui.link(w("train.all_in_review"), link).classes("ps-link"), "cell-all")
            box = ui.element("div").classes("ps-sideways")
            with named(box.props('role="region" tabindex="0"'), title):
                tag(html(_recordings(w, d.row.dataset, found)), "cell-list")

    # People ---------------------------------------------------------------------------------------------------

    def _people(self, d: ResultDetails) -> None:
        w, row = self._words, d.row
        ui.label(w("train.people")).classes("text-weight-bold").props('role="heading" aria-level="4"')
        scores = [one["macro_f1"] for one in d.people if one["macro_f1"] is not None]
        if row.kind == EVALUATION and scores:
            message = w(
                "train.spread",
                accuracy=score_text(row.accuracy, row.accuracy_sd),
                macro_f1=score_text(row.macro_f1, row.macro_f1_sd),
                over=averaged_over(w, row.spread, row.units),
                low=figure(min(scores)),
                high=figure(max(scores)),
            )
            tag(ui.label(message), "spread")
        head = Markup("").join(
            Markup('<th scope="col" class="{}">{}</th>').format("" if key == "person" else "n", w(f"train.{key}"))
            for key in ("person", "recordings", "windows", "accuracy", "macro_f1", "by_recording")
        )
        line = Markup('<tr><th scope="row">{}</th>' + 5 * '<td class="n">{}</td>' + "</tr>")
        body = Markup("").join(
            line.format(
                one["subject"],
                one["recordings"],
                one["windows"],
                figure(one["accuracy"]),
                figure(one["macro_f1"]),
                figure(one["by_recording_accuracy"]),
            )
            for one in d.people
        )
        with (
            ui.element("div")
            .classes("ps-sideways")
            .props(f'role="region" tabindex="0" aria-label="{w("train.people")}"')
        ):
            tag(html(_TABLE.format(head, body)), "people")


def confusion_table(w: Words, confusion: Confusion, by_affect: bool, clickable: bool) -> Markup:
    """Render a confusion matrix as a table with counts and shares of each row."""

    def name(label: str) -> str:
        return f"{AFFECT_SIGNS[label]} {w.affect(label)}" if by_affect else w.gesture(label)

    names = [name(label) for label in confusion.labels]
    column = Markup('<th scope="col" class="{}">{}</th>')
    head = Markup("").join(column.format("" if by_affect else "c", n) for n in names)
    rows = []
    for i, counts in enumerate(confusion.counts):
        total = sum(counts)
        cells = []
        for j, n in enumerate(counts):
            share = n / total if total else 0.0
            kind = "same" if i == j else ""
            if not n:
                cells.append(Markup('<td class="{} zero">0</td>').format(kind))
                continue
            text = Markup("{}<small>{:.0f} %</small>").format(n, 100 * share)
            if clickable:
                button = Markup('<button data-cell="{},{}">{}<span class="ps-unseen">{}</span></button>')
                text = button.format(i, j, text, w("train.cell", truth=names[i], predicted=names[j]))
            shade = f"background: rgba(0, 114, 178, {0.06 + 0.44 * share:.2f})"
            cells.append(Markup('<td class="{}" style="{}">{}</td>').format(kind, shade, text))
        rows.append(Markup('<tr><th scope="row">{}</th>{}</tr>').format(names[i], Markup("").join(cells)))
    corner = f"{w('train.truth')} ↓ / {w('train.said')} →"
    return Markup(
        '<table class="ps-table ps-confusion"><thead><tr><th scope="col">{}</th>{}</tr></thead>'
        "<tbody>{}</tbody></table>"
    ).format(corner, head, Markup("").join(rows))


def _recordings(w: Words, dataset: str, found: Sequence[MisreadRecording]) -> Markup:
    head = Markup("").join(
        Markup('<th scope="col">{}</th>').format(w(f"train.{key}"))
        for key in ("person", "gesture", "predicted", "of_windows", "person_of")
    )
    rows = []
    for one in found:
        link = one.recording
        if dataset:
            query = urlencode({"dataset": dataset, "recording": one.recording})
            label = f"{w('train.in_review')}: {one.recording}"
            link = Markup('<a href="/review?{}" aria-label="{}">{}</a>').format(query, label, one.recording)
        message = ", ".join(w.gesture(label) for label in one.predicted)
        cells = (one.subject, w.gesture(one.gesture), message, f"{one.windows} / {one.of}", link)
        rows.append(
            Markup('<tr data-recording="{}">{}</tr>').format(
                one.recording, Markup("").join(Markup("<td>{}</td>").format(cell) for cell in cells)
            )
        )
    return _TABLE.format(head, Markup("").join(rows))
