"""Build the table of recordings and the list of findings about sessions, people and the data set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui
from nicegui.element import Element

from plushsense.dataset.quality.findings import Finding
from plushsense.studio.app.shell import AFFECT_SIGNS, button, icon_button, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.review.controller import SORTS, ReviewController
from plushsense.studio.pages.review.review import ReviewedRecording


class ReviewTable(Element, component="review_table.js"):
    """Browser component that displays a table of recordings.

    Args:
        words: the texts of the page.
        on_sort: called with the key of a column to sort by.
        on_open: called with the id of a recording to open.
    """

    def __init__(self, words: Words, on_sort: Callable[[str], Any], on_open: Callable[[str], Any]) -> None:
        super().__init__()
        columns = [{"key": k, "label": words(f"review.{k}"), "sorts": k in SORTS} for k in (*SORTS, "path")]
        self._props.update(caption=words("review.table"), columns=columns, rows=[], spark=words("review.spark"))
        self.classes("w-full")
        self.on("sort", lambda event: on_sort(str(event.args)))
        self.on("open", lambda event: on_open(str(event.args)))

    def show(self, rows: list[dict[str, Any]], sort: str, down: bool, current: str) -> None:
        """Display rows, each made by `RecordingTableView._cells`."""
        self._props.update({"rows": rows, "sort": sort, "down": down, "current": current})
        self.update()


SEVERITY_SIGNS = {"error": "✖", "warning": "▲", "info": "ℹ"}
_EXCLUDING = ("wrong", "nothing", "disturbed", "sensor", "twice", "broken_off")
_ACCEPTING = ("looked", "person", "known")


def finding_text(words: Words, finding: Finding) -> str:
    """Return a short text for a finding: its sign, severity and check."""
    return f"{SEVERITY_SIGNS[finding.severity]} {words(f'review.severity_{finding.severity}')}: {finding.check}"


def finding_button(desk: ReviewController, finding: Finding, recording: str = "") -> ui.button:
    """Add a button that accepts or reopens a finding; with ``recording``, it works only while that is displayed."""

    async def reopen() -> None:
        await desk.decide(recording or desk.current, lambda: desk.review.reopen_finding(desk.visit, finding, desk.name))

    key, action = ("reopen", reopen) if finding.accepted else ("accept_finding", lambda: ask_reason(desk, finding))
    return button("", desk.words(f"review.{key}"), action, "flat dense")


def ask_reason(desk: ReviewController, finding: Finding | None = None) -> None:
    """Ask for a reason in a dialog; then accept ``finding``, or exclude the displayed recording if it is None."""
    words, recording = desk.words, desk.current
    if finding is None:
        title = words("review.why_exclude", id=recording)
    else:
        about = finding.about or desk.review.dataset.head.name
        title = words("review.why_accept", check=finding.check, about=about)

    async def answer(why: str) -> None:
        if not why.strip():
            error.set_text(words("review.reason_needed"))
            field.run_method("focus")
            return
        dialog.close()
        review, visit = desk.review, desk.visit
        if finding is None:
            await desk.decide(recording, lambda: review.exclude(visit, recording, desk.name, why), move=True)
        else:
            await desk.decide(recording, lambda: review.accept_finding(visit, finding, desk.name, why))

    with desk.page_slot, ui.dialog() as dialog:
        # Close without a transition, because the next key press is a command of the page again.
        dialog.props(f'aria-label="{words("review.reason")}" transition-duration=0')
        with tag(ui.card().classes("w-full"), "reason"):
            ui.label(title).classes("text-lg text-bold").style("overflow-wrap: anywhere")
            with ui.row().classes("ps-small-gap"):
                for number, key in enumerate(_EXCLUDING if finding is None else _ACCEPTING):
                    reason = words(f"review.because_{key}")
                    look = "outline autofocus" if number == 0 else "outline"
                    button("", reason, lambda reason=reason: answer(reason), look)
            field = ui.input(words("review.own_reason")).classes("w-full")
            tag(field, "own-reason").on("keydown.enter", lambda: answer(field.value or ""))
            error = tag(ui.label().props("role=alert").classes("ps-message-error"), "reason-error")
            with ui.row().classes("w-full justify-end"):
                button("", words("review.cancel"), dialog.close, "flat")
                go = words("review.exclude_go") if finding is None else words("review.accept_finding")
                button("reason-go", go, lambda: answer(field.value or ""), "unelevated")
    dialog.on("hide", dialog.delete)
    dialog.open()


PER_PAGE = 50
_SPARK = 40
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
"""Sign of each state, displayed before its name."""


class RecordingTableView:
    """The paged table of recordings, filtered and sorted on the server."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        words = desk.words
        with tag(ui.column().classes("w-full"), "list") as self.place:
            with ui.row().classes("w-full items-center ps-small-gap"):
                self.range = tag(ui.label().classes("ps-number").props("role=status"), "range")
                before, after = words("review.page_before"), words("review.page_after")
                self.before = icon_button("chevron_left", before, lambda: self.turn(-1), "flat round")
                self.after = icon_button("chevron_right", after, lambda: self.turn(1), "flat round")
                ui.space()
                button("start", words("review.start"), self._start, "unelevated color=primary")
                button("undo-list", words("review.undo"), desk.undo)
                self.again = button("check-again", "", self._check)
            self.table = tag(ReviewTable(words, self._sort, desk.open), "table")
            with tag(ui.expansion().classes("w-full"), "elsewhere") as self.elsewhere:
                self.others = ui.column().classes("w-full")
        self._others_content: object = None

    def draw(self) -> None:
        """Display the current page of the table."""
        desk, words = self.desk, self.desk.words
        n = len(desk.order)
        first = desk.first_row = max(0, min(desk.first_row, (n - 1) // PER_PAGE * PER_PAGE))
        ids = desk.order[first : first + PER_PAGE]
        rows = desk.review.rows
        text = words("review.range", first=first + 1, last=first + len(ids), n=n) if n else words("review.none_fit")
        self.range.set_text(text)
        self.before.set_enabled(first > 0)
        self.after.set_enabled(first + PER_PAGE < n)
        self.table.show([self._cells(rows[i]) for i in ids if i in rows], desk.by, desk.down, desk.current)
        unchecked = desk.review.unchecked
        self.again.set_visibility(unchecked > 0)
        self.again.set_text(words("review.check_again", n=unchecked))
        self._fill_others()

    refresh = draw

    def _cells(self, row: ReviewedRecording) -> dict[str, Any]:
        desk, words = self.desk, self.desk.words
        shape = desk.review.prepared.shapes.get(row.id)
        points, kept_range = "", None
        if shape is not None and len(shape.size) > 1:
            step = -(-len(shape.size) // _SPARK)
            heights = [max(shape.size[i : i + step]) for i in range(0, len(shape.size), step)]
            top = max(max(heights), 1)
            points = " ".join(
                f"{100 * i / max(1, len(heights) - 1):.0f},{23 - 22 * h / top:.0f}" for i, h in enumerate(heights)
            )
            marks, total = desk.review.standing(row.id), max(1, row.info.rows)
            if marks.trimmed and not marks.excluded:
                stop = total if marks.stop < 0 else min(marks.stop, total)
                kept_range = [round(100 * min(marks.start, stop) / total, 1), round(100 * stop / total, 1)]
        by_check = {f.check: f for f in reversed(row.findings) if not f.accepted}
        findings = [{"severity": f.severity, "text": finding_text(words, f)} for f in reversed(by_check.values())]
        if not findings and row.findings:
            findings = [{"severity": "", "text": words("review.all_accepted", n=len(row.findings))}]
        return {
            "id": row.id,
            "person": desk.person(row.info.subject),
            "gesture": f"{AFFECT_SIGNS[row.affect]}\u00a0{words.gesture(row.info.gesture)}",
            "seconds": f"{desk.words.number(row.seconds, 2)} s",
            "findings": findings,
            "state": row.state,
            "state_text": f"{SIGNS[row.state]} {words(f'review.state_{row.state}')}",
            "points": points,
            "kept": kept_range,
        }

    def _fill_others(self) -> None:
        desk, words = self.desk, self.desk.words
        findings = desk.review.findings_elsewhere()
        self.elsewhere.set_visibility(bool(findings))
        content = [(f.about, f.check, f.accepted) for f in findings]
        if content == self._others_content:
            return
        self._others_content = content
        self.elsewhere.set_text(words("review.elsewhere", n=len(findings)))
        self.others.clear()
        with self.others:
            for f in findings:
                with ui.row().classes("w-full items-center no-wrap"):
                    ui.label(finding_text(words, f)).style("min-width: 140px")
                    ui.label(f"{f.about or words('review.dataset')}: {f.message}").classes("flex-grow")
                    finding_button(desk, f)

    def turn(self, by: int) -> None:
        """Move by ``by`` pages of the table."""
        self.desk.first_row += by * PER_PAGE
        self.draw()

    def _sort(self, key: str) -> None:
        desk = self.desk
        desk.by, desk.down = key, not desk.down if desk.by == key else False
        desk.arrange()
        desk.first_row = 0
        self.draw()

    async def _start(self) -> None:
        rows, order = self.desk.review.rows, self.desk.order
        first = next((i for i in order if not rows[i].done), order[0] if order else "")
        if first:
            await self.desk.open(first)

    def _check(self) -> None:
        self.desk.review.check()
        self.again.set_visibility(False)
