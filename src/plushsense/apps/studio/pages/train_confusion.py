"""What a result opens to: what was taken for what, which recordings those are, and each person's score."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from nicegui import run, ui

from plushsense.apps.studio.pages.train_words import figure, marks, over, spread
from plushsense.apps.studio.result_rows import EVALUATION, HELD_BACK, TRAINING, Row
from plushsense.apps.studio.results import Confusion, Details, Misread, Results
from plushsense.apps.studio.reviews import Reviews
from plushsense.apps.studio.shell import AFFECT_SIGNS, Page, named, tag
from plushsense.apps.studio.words import Words
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT

_CLICKS = '(e) => { const b = e.target.closest("[data-cell]"); if (b) emit(b.dataset.cell); }'


class DetailsView:
    """The card below the table."""

    def __init__(self, page: Page, results: Results) -> None:
        self._page, self._results, self._words = page, results, page.words
        self._place = tag(ui.column().classes("w-full"), "details")
        self._found: Details | None = None
        self._by = "gesture"
        self._asked = 0

    async def open(self, row: Row) -> None:
        """Show a row."""
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
                ui.html(marks(w, row.leaky, row.simulated), sanitize=False)
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

    def _training(self, d: Details) -> None:
        w, facts = self._words, d.facts
        checked = sorted(set(facts.get("validation_subjects", [])) - {NOBODY, UNKNOWN_SUBJECT})
        said = w(
            "train.facts_training" if d.row.spread == HELD_BACK else "train.facts_same",
            trained=len(set(facts.get("subjects", [])) - {NOBODY, UNKNOWN_SUBJECT}),
            checked=len(checked),
            names=", ".join(checked) or "–",
            said=facts.get("scores", {}).get("said", ""),
        )
        ui.label(said)
        with ui.row():
            path = quote(str(d.row.path), safe="")
            ui.link(w("train.to_live"), f"/live?model={path}").classes("ps-link")
            ui.link(w("train.to_export"), f"/export?model={path}").classes("ps-link")

    # Confusions -----------------------------------------------------------------------------------------------

    def _confusions(self, d: Details) -> None:
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
            self._table = ui.html("", sanitize=False)
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
        shown = d.by_affect if by_affect and d.by_affect is not None else d.by_gesture
        self._table.set_content(as_table(self._words, shown, by_affect, d.clickable))

    async def _clicked(self, event: Any) -> None:
        d = self._found
        if d is None or d.by_gesture is None or not d.clickable:
            return
        shown = d.by_affect if self._by == "affect" and d.by_affect is not None else d.by_gesture
        i, j = (int(n) for n in str(event.args).split(","))
        if not (0 <= i < len(shown.labels) and 0 <= j < len(shown.labels)):
            return
        self._asked += 1
        mine = self._asked
        with self._page.refusing():
            truth, said = shown.labels[i], shown.labels[j]
            found = await run.io_bound(self._results.misread, d.row, self._gestures(truth), self._gestures(said))
            if found is None:
                return
            name = self._words.affect if self._by == "affect" else self._words.gesture
            windows = sum(one.windows for one in found)
            title = self._words("train.cell_title", truth=name(truth), said=name(said), n=len(found), windows=windows)
            link = await run.io_bound(self._link, d.row.dataset, [one.recording for one in found], title)
            # A later click, or another row, has the word.
            if link is not None and mine == self._asked and self._found is d:
                self._list(d, title, link, found)

    def _link(self, dataset: str, recordings: list[str], title: str) -> str:
        """Where Review shows them; "" for data that is not here."""
        if not dataset:
            return ""
        return self._page.house.part(Reviews).address(Path(dataset), recordings, title)

    def _gestures(self, label: str) -> list[str]:
        """The gestures that a label of the table stands for."""
        d = self._found
        if d is None or self._by == "gesture":
            return [label]
        return [gesture for gesture, affect in d.affects.items() if (affect or "none") == label]

    def _list(self, d: Details, title: str, link: str, found: Sequence[Misread]) -> None:
        w = self._words
        self._cell.clear()
        with self._cell:
            tag(ui.label(title).classes("text-weight-bold"), "cell-title").props('role="heading" aria-level="5"')
            if link:
                tag(ui.link(w("train.all_in_review"), link).classes("ps-link"), "cell-all")
            box = ui.element("div").classes("ps-sideways")
            with named(box.props('role="region" tabindex="0"'), title):
                tag(ui.html(_recordings(w, d.row.dataset, found), sanitize=False), "cell-list")

    # People ---------------------------------------------------------------------------------------------------

    def _people(self, d: Details) -> None:
        w, row = self._words, d.row
        ui.label(w("train.people")).classes("text-weight-bold").props('role="heading" aria-level="4"')
        scores = [one["macro_f1"] for one in d.people if one["macro_f1"] is not None]
        if row.kind == EVALUATION and scores:
            said = w(
                "train.spread",
                accuracy=spread(row.accuracy, row.accuracy_sd),
                macro_f1=spread(row.macro_f1, row.macro_f1_sd),
                over=over(w, row.spread, row.units),
                low=figure(min(scores)),
                high=figure(max(scores)),
            )
            tag(ui.label(said), "spread")
        head = "".join(
            f'<th scope="col"{"" if key == "person" else " class=n"}>{escape(w(f"train.{key}"))}</th>'
            for key in ("person", "recordings", "windows", "accuracy", "macro_f1", "by_recording")
        )
        body = "".join(
            f'<tr><th scope="row">{escape(one["subject"])}</th><td class="n">{escape(str(one["recordings"]))}</td>'
            f'<td class="n">{escape(str(one["windows"]))}</td><td class="n">{figure(one["accuracy"])}</td>'
            f'<td class="n">{figure(one["macro_f1"])}</td>'
            f'<td class="n">{figure(one["by_recording_accuracy"])}</td></tr>'
            for one in d.people
        )
        with (
            ui.element("div")
            .classes("ps-sideways")
            .props(f'role="region" tabindex="0" aria-label="{w("train.people")}"')
        ):
            table = f'<table class="ps-table"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
            tag(ui.html(table, sanitize=False), "people")


def as_table(w: Words, confusion: Confusion, by_affect: bool, clickable: bool) -> str:
    """A confusion as an HTML table: counts and shares of the row, the shade going with the share."""

    def name(label: str) -> str:
        return f"{AFFECT_SIGNS[label]} {w.affect(label)}" if by_affect else w.gesture(label)

    names = [name(label) for label in confusion.labels]
    head = "".join(f'<th scope="col" class="{"" if by_affect else "c"}">{escape(n)}</th>' for n in names)
    rows = []
    for i, counts in enumerate(confusion.counts):
        total = sum(counts)
        cells = []
        for j, n in enumerate(counts):
            share = n / total if total else 0.0
            kind = "same" if i == j else ""
            if not n:
                cells.append(f'<td class="{kind} zero">0</td>')
                continue
            percent = f"{100 * share:.0f}"
            text = f"{n}<small>{percent} %</small>"
            if clickable:
                said = escape(w("train.cell", truth=names[i], said=names[j]))
                text = f'<button data-cell="{i},{j}">{text}<span class="ps-unseen">{said}</span></button>'
            shade = f"background: rgba(0, 114, 178, {0.06 + 0.44 * share:.2f})"
            cells.append(f'<td class="{kind}" style="{shade}">{text}</td>')
        rows.append(f'<tr><th scope="row">{escape(names[i])}</th>{"".join(cells)}</tr>')
    corner = f"{escape(w('train.truth'))} ↓ / {escape(w('train.said'))} →"
    return (
        f'<table class="ps-table ps-confusion"><thead><tr><th scope="col">{corner}</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _recordings(w: Words, dataset: str, found: Sequence[Misread]) -> str:
    head = "".join(
        f'<th scope="col">{escape(w(f"train.{key}"))}</th>'
        for key in ("person", "gesture", "predicted", "of_windows", "person_of")
    )
    rows = []
    for one in found:
        link = escape(one.recording)
        if dataset:
            query = urlencode({"dataset": dataset, "recording": one.recording})
            where = escape(f"/review?{query}", quote=True)
            label = escape(f"{w('train.in_review')}: {one.recording}", quote=True)
            link = f'<a href="{where}" aria-label="{label}">{link}</a>'
        said = ", ".join(w.gesture(label) for label in one.predicted)
        rows.append(
            f'<tr data-recording="{escape(one.recording, quote=True)}"><td>{escape(one.subject)}</td>'
            f"<td>{escape(w.gesture(one.gesture))}</td><td>{escape(said)}</td><td>{one.windows} / {one.of}</td>"
            f"<td>{link}</td></tr>"
        )
    return f'<table class="ps-table"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
