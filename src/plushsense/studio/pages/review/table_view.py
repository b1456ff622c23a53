"""The table of recordings and the list of findings about sessions, people and the data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from nicegui import ui
from nicegui.element import Element

from plushsense.dataset.quality.findings import Finding
from plushsense.studio.app.shell import AFFECT_SIGNS, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.review.review import ReviewedRecording

if TYPE_CHECKING:
    from plushsense.studio.pages.review.controller import ReviewController


class ReviewTable(Element, component="review_table.js"):
    """Browser component that displays rows of recordings.

    Args:
        columns: dictionaries with ``key``, ``label`` and ``sorts`` (whether a click sorts by it), from left to right.
        spark: text alternative of the small curves.
        on_sort: called with the key of a column.
        on_open: called with the id of a recording.
    """

    def __init__(
        self,
        caption: str,
        columns: Sequence[dict[str, Any]],
        *,
        spark: str,
        on_sort: Callable[[str], Any],
        on_open: Callable[[str], Any],
    ) -> None:
        super().__init__()
        self._props["caption"] = caption
        self._props["columns"] = list(columns)
        self._props["rows"] = []
        self._props["spark"] = spark
        self.classes("w-full")
        self.on("sort", lambda event: on_sort(str(event.args)))
        self.on("open", lambda event: on_open(str(event.args)))

    def show(self, rows: Sequence[dict[str, Any]], *, sort: str, down: bool, current: str, caption: str) -> None:
        """Display rows: ``id, person, gesture, seconds, findings [{severity, text}], state, said, points, kept``."""
        self._props["rows"] = list(rows)
        self._props["sort"], self._props["down"] = sort, down
        self._props["current"], self._props["caption"] = current, caption
        self.update()


SEVERITY_SIGNS = {"error": "✖", "warning": "▲", "info": "ℹ"}
_EXCLUDING = ("wrong", "nothing", "disturbed", "sensor", "twice", "broken_off")
_ACCEPTING = ("looked", "person", "known")


def finding_text(words: Words, finding: Finding) -> str:
    """Return a short text for a finding: sign, severity and check."""
    return f"{SEVERITY_SIGNS[finding.severity]} {words(f'review.severity_{finding.severity}')}: {finding.check}"


def ask_reason(desk: ReviewController, finding: Finding | None = None) -> None:
    """Open a dialog for a reason, then exclude the displayed recording or accept the finding."""
    words, visible = desk.words, desk.current
    title = (
        words("review.why_exclude", id=visible)
        if finding is None
        else words("review.why_accept", check=finding.check, about=finding.about or desk.review.dataset.head.name)
    )

    async def answer(why: str) -> None:
        if not why.strip():
            error.set_text(words("review.reason_needed"))
            field.run_method("focus")
            return
        dialog.close()
        review, visit = desk.review, desk.visit
        if finding is None:
            await desk.decide(visible, lambda: review.exclude(visit, visible, desk.name, why), move=True)
        else:
            await desk.decide(visible, lambda: review.accept_finding(visit, finding, desk.name, why))

    with desk.page_slot, ui.dialog() as dialog:
        # Close without a transition, because the next key belongs to the page again.
        dialog.props(f'aria-label="{words("review.reason")}" transition-duration=0')
        with tag(ui.card().classes("w-full"), "reason"):
            ui.label(title).classes("text-lg font-bold").style("overflow-wrap: anywhere")
            with ui.row().classes("gap-2"):
                for number, key in enumerate(_EXCLUDING if finding is None else _ACCEPTING):
                    reason = words(f"review.because_{key}")
                    button = ui.button(reason, on_click=lambda reason=reason: answer(reason)).props("no-caps outline")
                    if number == 0:
                        button.props("autofocus")
            field = ui.input(words("review.own_reason")).props("outlined").classes("w-full")
            tag(field, "own-reason").on("keydown.enter", lambda: answer(field.value or ""))
            error = tag(ui.label().props("role=alert").classes("ps-said-error"), "reason-error")
            with ui.row().classes("w-full justify-end"):
                ui.button(words("review.cancel"), on_click=dialog.close).props("no-caps flat")
                go = words("review.exclude_go") if finding is None else words("review.accept_finding")
                tag(ui.button(go, on_click=lambda: answer(field.value or "")).props("no-caps unelevated"), "reason-go")
    dialog.on("hide", dialog.delete)
    dialog.open()


PER_PAGE = 50
_SPARK = 40
_SORTED = ("recording", "person", "gesture", "seconds", "findings", "state")
SIGNS = {
    "looking": "…",
    "suggested": "⋯",
    "none": "○",
    "draft": "✎",
    "accepted": "✓",
    "adjusted": "✓✎",
    "excluded": "✕",
    "labelled": "▤",
}
"""Sign of each state; the word follows it."""
# The broad plus is missing in many fonts.
AFFECTS = {affect: sign.replace("＋", "+") for affect, sign in AFFECT_SIGNS.items()}


class RecordingTableView:
    """The paged table of recordings, filtered and sorted on the server."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self.first = 0
        words = desk.words
        with tag(ui.column().classes("w-full"), "list") as self.place:
            with ui.row().classes("w-full items-center gap-2"):
                self.range = tag(ui.label().classes("ps-number").props("role=status"), "range")
                self.before = ui.button(icon="chevron_left", on_click=lambda: self.turn(-1)).props("flat round")
                self.before.props(f'aria-label="{words("review.page_before")}"')
                self.after = ui.button(icon="chevron_right", on_click=lambda: self.turn(1)).props("flat round")
                self.after.props(f'aria-label="{words("review.page_after")}"')
                ui.space()
                start = ui.button(words("review.start"), on_click=self._start).props("no-caps unelevated color=primary")
                tag(start, "start")
                tag(ui.button(words("review.undo"), on_click=desk.undo).props("no-caps outline"), "undo-list")
                self.again = tag(ui.button(on_click=self._check).props("no-caps outline"), "check-again")
            columns = [{"key": k, "label": words(f"review.{k}"), "sorts": True} for k in _SORTED]
            columns.append({"key": "path", "label": words("review.path"), "sorts": False})
            self.table = ReviewTable(
                words("review.table"), columns, spark=words("review.spark"), on_sort=self._sort, on_open=desk.open
            )
            tag(self.table, "table")
            with tag(ui.expansion().classes("w-full"), "elsewhere") as self.elsewhere:
                self.others = ui.column().classes("w-full")

    def fill(self) -> None:
        """Display the current page of the table."""
        desk, words = self.desk, self.desk.words
        n = len(desk.order)
        self.first = max(0, min(self.first, (n - 1) // PER_PAGE * PER_PAGE))
        part = desk.order[self.first : self.first + PER_PAGE]
        rows = desk.review.rows
        visible = [self._cells(rows[i]) for i in part if i in rows]
        message = words("review.range", first=self.first + 1 if n else 0, last=self.first + len(part), n=n)
        self.range.set_text(message if n else words("review.none_fit"))
        self.before.set_enabled(self.first > 0)
        self.after.set_enabled(self.first + PER_PAGE < n)
        self.table.show(visible, sort=desk.by, down=desk.down, current=desk.current, caption=words("review.table"))
        unchecked = desk.review.unchecked
        self.again.set_visibility(unchecked > 0)
        self.again.set_text(words("review.check_again", n=unchecked))
        self._fill_others()

    def _cells(self, row: ReviewedRecording) -> dict[str, Any]:
        desk, words = self.desk, self.desk.words
        shape = desk.review.prepared.shapes.get(row.id)
        points, kept = "", None
        if shape is not None and len(shape.size) > 1:
            step = -(-len(shape.size) // _SPARK)
            heights = [max(shape.size[i : i + step]) for i in range(0, len(shape.size), step)]
            top = max(max(heights), 1)
            points = " ".join(
                f"{100 * i / max(1, len(heights) - 1):.0f},{23 - 22 * h / top:.0f}" for i, h in enumerate(heights)
            )
            standing, of = desk.review.standing(row.id), max(1, row.info.rows)
            if standing.trimmed and not standing.excluded:
                stop = of if standing.stop < 0 else min(standing.stop, of)
                kept = [round(100 * min(standing.start, stop) / of, 1), round(100 * stop / of, 1)]
        by_check = {f.check: f for f in reversed(row.findings) if not f.accepted}
        findings = [{"severity": f.severity, "text": finding_text(words, f)} for f in reversed(by_check.values())]
        if not findings and row.findings:
            findings = [{"severity": "", "text": words("review.all_accepted", n=len(row.findings))}]
        return {
            "id": row.id,
            "person": desk.person(row.info.subject),
            "gesture": f"{AFFECTS[row.affect]}\u00a0{words.gesture(row.info.gesture)}",
            "seconds": f"{desk.words.number(row.seconds, 2)} s",
            "findings": findings,
            "state": row.state,
            "said": f"{SIGNS[row.state]} {words(f'review.state_{row.state}')}",
            "points": points,
            "kept": kept,
        }

    def _fill_others(self) -> None:
        desk, words = self.desk, self.desk.words
        found = desk.review.findings_elsewhere()
        self.elsewhere.set_visibility(bool(found))
        key = [(f.about, f.check, f.accepted) for f in found]
        if key == getattr(self, "_others", None):
            return
        self._others = key
        self.elsewhere.set_text(words("review.elsewhere", n=len(found)))
        self.others.clear()
        with self.others:
            for f in found:
                with ui.row().classes("w-full items-center no-wrap"):
                    ui.label(finding_text(words, f)).style("min-width: 140px")
                    ui.label(f"{f.about or words('review.dataset')}: {f.message}").classes("flex-grow")
                    if f.accepted:
                        ui.button(
                            words("review.reopen"),
                            on_click=lambda f=f: desk.decide(
                                desk.current, lambda: desk.review.reopen_finding(desk.visit, f, desk.name)
                            ),
                        ).props("no-caps flat dense")
                    else:
                        ui.button(words("review.accept_finding"), on_click=lambda f=f: ask_reason(desk, f)).props(
                            "no-caps flat dense"
                        )

    def turn(self, by: int) -> None:
        """Move by some pages of the table."""
        self.first += by * PER_PAGE
        self.fill()

    def _sort(self, key: str) -> None:
        desk = self.desk
        desk.by, desk.down = key, not desk.down if desk.by == key else False
        desk.arrange()
        self.first = 0
        self.fill()

    async def _start(self) -> None:
        rows, order = self.desk.review.rows, self.desk.order
        first = next((i for i in order if not rows[i].done), order[0] if order else "")
        if first:
            await self.desk.open(first)

    def _check(self) -> None:
        self.desk.review.check()
        self.again.set_visibility(False)
