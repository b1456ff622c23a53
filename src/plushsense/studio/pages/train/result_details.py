"""Display the details of a result: confusion matrix, recordings of a cell, and scores of each person."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.models.bundle import known_people
from plushsense.reports.table import Table
from plushsense.studio.app.jobs import Jobs
from plushsense.studio.app.selections import Selections
from plushsense.studio.app.shell import (
    AFFECT_SIGNS,
    Page,
    address,
    button,
    heading,
    html,
    icon_button,
    reveal,
    scroll_region,
    tag,
)
from plushsense.studio.app.stored_results import (
    HELD_BACK,
    TRAINING,
    TRIAL,
    Confusion,
    MisreadRecording,
    ResultDetails,
    ResultRow,
    StoredResults,
    context_text,
    counted,
    figure,
    leaky_warning,
    score_labels,
    split_text,
)
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.app.workspace import plain_name
from plushsense.studio.pages.train.job_requests import export_request
from plushsense.studio.widgets.elements import table_html
from plushsense.studio.widgets.verdict import comparison, network_links, show_result

_CLICKS = '(e) => { const b = e.target.closest("[data-cell]"); if (b) emit(b.dataset.cell); }'


class ResultDetailsView:
    """Card with the details of one result."""

    def __init__(self, page: Page, results: StoredResults) -> None:
        self._page, self._results, self._words = page, results, page.words
        self._place = tag(ui.column().classes("w-full"), "details")
        self._details: ResultDetails | None = None
        self._others: list[ResultRow] = []
        self._by = "gesture"
        self._clicks = 0

    async def open(self, row: ResultRow) -> None:
        """Display the details of a result."""
        self._details = await run.io_bound(self._results.details, row)
        self._others = await run.io_bound(self._results.comparable, row) or []
        self._draw()
        reveal(self._place)

    def _close(self) -> None:
        self._details = None
        self._place.clear()

    def _draw(self) -> None:
        self._place.clear()
        d, w = self._details, self._words
        if d is None:
            return
        row = d.row
        with self._place, ui.element("section").classes("ps-card w-full column no-wrap ps-small-gap") as card:
            card.props(f'aria-label="{w("Details")}"')
            with ui.row().classes("w-full items-center"):
                title = " · ".join((row.data, row.network, split_text(w, row.split), context_text(w, row.context)))
                heading(title, 3).classes("text-bold", remove="text-lg")
                html(score_labels(w, row.leaky, row.simulated))
                ui.space()
                icon_button("close", w("Close"), self._close, color=None)
            if row.leaky:
                ui.label(leaky_warning(w))
            show_result(w, row, "text-bold")
            sizes = {"parameters": w.count(row.parameters), "macs": w.count(row.macs)}
            ui.label(w("{parameters} parameters, {macs} multiply-accumulates in 50 ms.", **sizes)).classes("ps-dim")
            if row.kind == TRAINING:
                self._training(d)
            self._tools(d)
            if d.by_gesture is not None:
                self._confusions(d)
            elif d.later:
                show = w("Show the confusions of the validation people")
                button("show-confusions", show, self._compute, icon="grid_on")
            else:
                none = w("No confusions are stored for this result. Evaluate the network to see them.")
                ui.label(none).classes("ps-dim")
            if d.people:
                self._people(d)

    async def _compute(self) -> None:
        """Compute the confusions of a training from the recordings of its validation people."""
        d = self._details
        if d is None:
            return
        self._page.say(self._words("Reading the recordings of the validation people …"))
        with self._page.show_errors():
            found = await run.io_bound(self._results.with_predictions, d)
            self._page.say("")
            if found is not None and self._details is d:
                self._details = found
                self._draw()

    def _training(self, d: ResultDetails) -> None:
        w, facts = self._words, d.facts
        checked = sorted(known_people(facts, ["validation_subjects"]))
        if d.row.proof is not None:
            trained = counted(w, "with_people", len(known_people(facts, ["subjects"])))
            ui.label(w("Trained on {trained}. The score is that of the evaluation of these settings.", trained=trained))
            return
        held_back = (
            "Checked on {checked} ({names}) before it was trained again on all {trained}."
            if facts.get("refit")
            else "Trained on {trained}, checked on {checked}: {names}."
        )
        text = w(
            held_back
            if d.row.spread == HELD_BACK
            else "Trained on {trained}, and checked on recordings of the same people.",
            trained=counted(w, "with_people", len(known_people(facts, ["subjects"]))),
            checked=counted(w, "with_people", len(checked)),
            names=", ".join(checked) or "–",
        )
        ui.label(text)

    # What to take away ----------------------------------------------------------------------------------------

    def _tools(self, d: ResultDetails) -> None:
        """Add downloads, links to the pages that use the network or the button to make one, and a comparison."""
        w, row = self._words, d.row
        kinds: Texts = {
            **({"html": "Save the report (HTML)"} if d.report else {}),
            **({"csv": "Save the confusions (CSV)", "png": "Save the confusions (PNG)"} if d.by_gesture else {}),
            **({"plush": "Save the network (.plush)"} if row.bundle else {}),
        }
        with ui.row().classes("items-center ps-small-gap"):
            if row.bundle is not None:
                network_links(w, row.bundle)
            elif row.usable or (row.kind == TRIAL and not row.leaky and (row.accuracy or 0.0) > row.chance):
                make = w("Train on everybody and export")
                button("make-export", make, self._make_export, "unelevated", icon="memory")
            for kind, text in kinds.items():
                button(f"save-{kind}", w(text), partial(self._save, kind), icon="download")
        if self._others:
            with ui.row().classes("items-center w-full"):
                others = {
                    r.id: " · ".join((r.network, r.schedule, split_text(w, r.split), figure(w, r.accuracy)))
                    for r in self._others
                }
                label = w("Compare person by person with")
                box = ui.select(others, label=label, on_change=lambda event: self._compare(d, event.value))
                tag(box.classes("w-full"), "compare-with")
                self._comparison = tag(ui.label().props('role="status"'), "comparison")

    async def _save(self, kind: str) -> None:
        """Let the browser save the report, the displayed confusions or the network."""
        d, confusion = self._details, self._confusion()
        assert d is not None
        title = ", ".join((d.row.data, split_text(self._words, d.row.split)))
        if d.row.simulated:
            title += f" ({self._words('simulation')})"

        def content() -> bytes:
            if kind in ("html", "plush"):
                path = d.report if kind == "html" else d.row.bundle
                assert path is not None
                return path.read_bytes()
            assert confusion is not None
            if kind == "png":
                from plushsense.reports.figures import confusion as draw_confusion
                from plushsense.reports.figures import png

                return png(draw_confusion(confusion.labels, confusion.counts, title=title), 200)
            rows = [
                {"true": label, **dict(zip(confusion.labels, counts, strict=True))}
                for label, counts in zip(confusion.labels, confusion.counts, strict=True)
            ]
            return Table.from_rows("confusion", "", rows).csv().encode()

        with self._page.show_errors():
            name = plain_name(f"{d.row.data} {d.row.network}", "result")
            found = await run.io_bound(content)
            if found is not None:
                ui.download.content(found, f"{name}.{kind}")

    def _make_export(self) -> None:
        """Start to train a network with the settings of the evaluation on everybody, and to export it."""
        d, workspace = self._details, self._page.workspace
        assert d is not None
        with self._page.show_errors():
            jobs = workspace.part(Jobs)
            request = export_request(workspace, jobs, d.row)
            jobs.start(request.task, request.spec, request.title)
            self._page.show_work()

    async def _compare(self, d: ResultDetails, identity: str) -> None:
        from plushsense.experiments.analysis.comparison import compare

        other = next(r for r in self._others if r.id == identity)
        with self._page.show_errors():
            found = await run.io_bound(compare, [str(d.row.proof), str(other.proof)])
            if found is not None:
                self._comparison.set_text(comparison(self._words, found.pairs["accuracy"][0], len(found.people)))

    # Confusions -----------------------------------------------------------------------------------------------

    def _confusions(self, d: ResultDetails) -> None:
        w = self._words
        heading(w("Confusions"), 4)
        about = w(
            "Rows: the true gesture. Columns: the answer of the network. Each cell has the number of windows and their "
            "share of the row. Click a number to see the recordings."
            if d.clickable
            else "For this network only the counts are stored. Evaluate it to see the recordings behind them."
        )
        ui.label(about).classes("ps-dim")
        if d.pooled is not None and d.row.rest is not None:
            text = w(
                "Pooled over all windows at once, with recordings at rest, the accuracy is {pooled}. The matrix counts "
                "in this way.",
                pooled=figure(w, d.pooled),
            )
            tag(ui.label(text).classes("ps-dim"), "pooled")
        choices = {"gesture": w("By gesture"), "affect": w("By affect")}
        radio = ui.radio(choices, value=self._by, on_change=self._group).props("inline")
        tag(radio, "by").props(f'aria-label="{w("Confusions")}"')
        self._worst = html().on("click", self._clicked, js_handler=_CLICKS)
        tag(self._worst, "worst")
        box = tag(scroll_region(w("Confusions")).classes("ps-desk"), "confusion")
        with box.on("click", self._clicked, js_handler=_CLICKS):
            self._table = html()
        self._cell = tag(ui.column().classes("w-full").props('aria-live="polite"'), "cell")
        self._tabulate()

    def _group(self, event: Any) -> None:
        self._by = str(event.value)
        self._cell.clear()
        self._tabulate()

    def _confusion(self) -> Confusion | None:
        """Return the displayed matrix."""
        d = self._details
        if d is None:
            return None
        return d.by_affect if self._by == "affect" and d.by_affect is not None else d.by_gesture

    def _tabulate(self) -> None:
        d, confusion = self._details, self._confusion()
        if d is not None and confusion is not None:
            affect = self._by == "affect"
            self._table.set_content(confusion_table(self._words, confusion, affect, d.clickable))
            self._worst.set_content(worst_table(self._words, confusion, affect, d.clickable))

    async def _clicked(self, event: Any) -> None:
        d, confusion = self._details, self._confusion()
        if d is None or confusion is None or not d.clickable:
            return
        i, j = (int(n) for n in str(event.args).split(","))
        if not (0 <= i < len(confusion.labels) and 0 <= j < len(confusion.labels)):
            return
        self._clicks += 1
        click = self._clicks
        with self._page.show_errors():
            truth, predicted = confusion.labels[i], confusion.labels[j]
            rows = await run.io_bound(self._results.misread, d.row, self._gestures(truth), self._gestures(predicted))
            if rows is None:
                return
            name = self._words.affect if self._by == "affect" else self._words.gesture
            windows = sum(row.windows for row in rows)
            title = self._words(
                "{truth} read as {predicted} (recordings: {n}, windows: {windows})",
                truth=name(truth),
                predicted=name(predicted),
                n=len(rows),
                windows=windows,
            )
            # Without a data set, as one that is not in this studio, there is nothing to review.
            dataset, ids = d.row.dataset, [row.recording for row in rows]
            selections = self._page.workspace.part(Selections)
            link = await run.io_bound(selections.address, Path(dataset), ids, title) if dataset else ""
            # Ignore this answer if another cell was clicked or another result opened in the meantime.
            if link is not None and click == self._clicks and self._details is d:
                self._list(d, title, link, rows)

    def _gestures(self, label: str) -> list[str]:
        """Return the gestures that a label of the displayed matrix includes: one gesture, or all with this affect."""
        d = self._details
        if d is None or self._by == "gesture":
            return [label]
        return [gesture for gesture, affect in d.affects.items() if (affect or "none") == label]

    def _list(self, d: ResultDetails, title: str, link: str, rows: Sequence[MisreadRecording]) -> None:
        w = self._words
        self._cell.clear()
        with self._cell:
            tag(heading(title, 5), "cell-title")
            if link:
                tag(ui.link(w("All of them in Review"), link).classes("ps-link"), "cell-all")
            with scroll_region(title):
                tag(html(_recordings(w, d.row.dataset, rows)), "cell-list")

    # People ---------------------------------------------------------------------------------------------------

    def _people(self, d: ResultDetails) -> None:
        w = self._words
        heading(w("Scores of each person"), 4)
        head = w.each("Person", "Recordings", "Windows", "Accuracy", "Macro-F1", "Accuracy by recording")
        keys = ("accuracy", "macro_f1", "by_recording_accuracy")
        cells = [(p["subject"], p["recordings"], p["windows"], *(figure(w, p[key]) for key in keys)) for p in d.people]
        with scroll_region(w("Scores of each person")):
            table = html(table_html(head, cells, numbers=range(1, 6), row_heads=True)).classes("ps-people")
            tag(table, "people")


def confusion_table(w: Words, confusion: Confusion, by_affect: bool, clickable: bool) -> Markup:
    """Render a confusion matrix as a table of counts and of percentages of each row."""
    names = _names(w, confusion, by_affect)
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
                button = Markup('<button data-cell="{},{}">{}<span class="ps-visually-hidden">{}</span></button>')
                hint = w("{truth} read as {predicted}. Show the recordings", truth=names[i], predicted=names[j])
                text = button.format(i, j, text, hint)
            shade = f"background: rgba(0, 114, 178, {0.06 + 0.44 * share:.2f})"
            cells.append(Markup('<td class="{}" style="{}">{}</td>').format(kind, shade, text))
        rows.append(Markup('<tr><th scope="row">{}</th>{}</tr>').format(names[i], Markup("").join(cells)))
    corner = f"{w('True gesture')} ↓ / {w('Answer')} →"
    return Markup(
        '<table class="ps-table ps-confusion"><thead><tr><th scope="col">{}</th>{}</tr></thead>'
        "<tbody>{}</tbody></table>"
    ).format(corner, head, Markup("").join(rows))


# Number of confusions that are listed before the matrix, which a phone does not show.
_WORST = 6


def worst_table(w: Words, confusion: Confusion, by_affect: bool, clickable: bool) -> Markup:
    """Render the most frequent confusions, those with the largest share of their gesture first."""
    names = _names(w, confusion, by_affect)
    found = []
    for i, counts in enumerate(confusion.counts):
        found += [(n / sum(counts), n, i, j) for j, n in enumerate(counts) if n and i != j]
    rows = []
    for share, n, i, j in sorted(found, key=lambda one: (-one[0], one[2:]))[:_WORST]:
        text = w("{truth} read as {predicted}", truth=names[i], predicted=names[j])
        if clickable:
            button = Markup('<button data-cell="{},{}">{}</button>')
            text = button.format(i, j, text)
        rows.append((text, f"{n}", f"{100 * share:.0f} %"))
    head = w.each("Most frequent confusions", "Windows", "Of this gesture")
    return table_html(head, rows, numbers=(1, 2)) if rows else Markup("")


def _names(w: Words, confusion: Confusion, by_affect: bool) -> list[str]:
    """Return the texts of the labels of a confusion matrix."""
    if by_affect:
        return [f"{AFFECT_SIGNS[label]} {w.affect(label)}" for label in confusion.labels]
    return [w.gesture(label) for label in confusion.labels]


def _recordings(w: Words, dataset: str, rows: Sequence[MisreadRecording]) -> Markup:
    cells = []
    for row in rows:
        link = Markup('<span data-recording="{0}">{0}</span>').format(row.recording)
        if dataset:
            link = Markup('<a data-recording="{0}" href="{1}" aria-label="{2}: {0}">{0}</a>').format(
                row.recording, address("review", dataset=dataset, recording=row.recording), w("Review")
            )
        predicted = ", ".join(w.gesture(label) for label in row.predicted)
        cells.append((row.subject, w.gesture(row.gesture), predicted, f"{row.windows} / {row.of}", link))
    return table_html(w.each("Person", "Gesture", "Read as", "Windows with this answer", "Recording"), cells)
