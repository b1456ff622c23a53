"""The table of recordings, and what was found about sessions, people and the data set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nicegui import ui

from plushsense.apps.studio.pages.review_reason import ask, finding_text
from plushsense.apps.studio.review_row import Row
from plushsense.apps.studio.review_table import ReviewTable
from plushsense.apps.studio.shell import AFFECT_SIGNS, tag

if TYPE_CHECKING:
    from plushsense.apps.studio.pages.review_desk import Desk

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
"""A state is told by sign and word."""
# The broad plus is missing in many fonts.
AFFECTS = {affect: sign.replace("＋", "+") for affect, sign in AFFECT_SIGNS.items()}


class ListView:
    """The table, a page of it at a time; filters and sorting are done here, not in the browser."""

    def __init__(self, desk: Desk) -> None:
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
        """Draw the page of the table."""
        desk, words = self.desk, self.desk.words
        n = len(desk.order)
        self.first = max(0, min(self.first, (n - 1) // PER_PAGE * PER_PAGE))
        part = desk.order[self.first : self.first + PER_PAGE]
        rows = desk.review.rows
        shown = [self._shown(rows[i]) for i in part if i in rows]
        said = words("review.range", first=self.first + 1 if n else 0, last=self.first + len(part), n=n)
        self.range.set_text(said if n else words("review.none_fit"))
        self.before.set_enabled(self.first > 0)
        self.after.set_enabled(self.first + PER_PAGE < n)
        self.table.show(shown, sort=desk.by, down=desk.down, current=desk.current, caption=words("review.table"))
        unchecked = desk.review.unchecked
        self.again.set_visibility(unchecked > 0)
        self.again.set_text(words("review.check_again", n=unchecked))
        self._fill_others()

    def _shown(self, row: Row) -> dict[str, Any]:
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
                        ui.button(words("review.accept_finding"), on_click=lambda f=f: ask(desk, f)).props(
                            "no-caps flat dense"
                        )

    def turn(self, by: int) -> None:
        """Another page of the table."""
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
