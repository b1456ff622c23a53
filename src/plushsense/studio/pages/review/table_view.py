"""Build the table of recordings and the list of findings about sessions, people and the data set."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui
from nicegui.element import Element

from plushsense.dataset.quality.findings import Finding
from plushsense.studio.app.shell import AFFECT_SIGNS, button, icon_button, scroll_region, tag
from plushsense.studio.app.words import Texts, Words, in_context
from plushsense.studio.pages.review.controller import SORTS, ReviewController
from plushsense.studio.pages.review.review import STATE_TEXTS, ReviewedRecording
from plushsense.studio.widgets.elements import on_enter, open_dialog

_HEADS: Texts = {
    "recording": "Recording",
    "person": "Person",
    "gesture": "Gesture",
    "seconds": "Duration",
    "findings": "Findings",
    "state": "State",
    "path": "Signal",
}

_SEVERITIES: Texts = {
    "error": "to decide",
    "warning": "to look at",
    "info": "good to know",
}


class ReviewTable(Element, component="review_table.js"):
    """Browser component that displays a table of recordings.

    Args:
        words: the texts of the page.
        on_sort: called with the key of a column to sort by.
        on_open: called with the id of a recording to open.
        on_pick: called with the id of a recording whose check box was clicked, and whether Shift was held.
        on_page: called when the check box of all displayed rows was clicked.
    """

    def __init__(
        self,
        words: Words,
        on_sort: Callable[[str], Any],
        on_open: Callable[[str], Any],
        on_pick: Callable[[str, bool], Any],
        on_page: Callable[[], Any],
    ) -> None:
        super().__init__()
        columns = [{"key": k, "label": words(_HEADS[k]), "sorts": k in SORTS} for k in (*SORTS, "path")]
        signs = ", ".join(f"{sign} {words.affect(affect)}" for affect, sign in AFFECT_SIGNS.items())
        self._props.update(
            caption=f"{words('Recordings')} ({signs})",
            columns=columns,
            rows=[],
            spark=words("Deviation of the signals from rest over the recording; the part that is kept is shaded"),
        )
        self._props["pick"] = words("Select")
        self.classes("w-full")
        self.on("sort", lambda event: on_sort(str(event.args)))
        self.on("open", lambda event: on_open(str(event.args)))
        self.on("pick", lambda event: on_pick(str(event.args["id"]), bool(event.args["shift"])))
        self.on("page", lambda _: on_page())

    def show(self, rows: list[dict[str, Any]], sort: str, down: bool, current: str) -> None:
        """Display rows, each made by `RecordingTableView._cells`."""
        self._props.update({"rows": rows, "sort": sort, "down": down, "current": current})
        self.update()


SEVERITY_SIGNS = {"error": "✖", "warning": "▲", "info": "ℹ"}


def finding_text(words: Words, finding: Finding) -> str:
    """Return a short text for a finding: its sign, severity and check."""
    severity = words(_SEVERITIES[finding.severity])
    return f"{SEVERITY_SIGNS[finding.severity]} {severity}: {words.check(finding.check)}"


def finding_button(desk: ReviewController, finding: Finding, recording: str = "") -> ui.button:
    """Add a button that accepts or reopens a finding; with ``recording``, it works only while that is displayed."""

    async def reopen() -> None:
        await desk.decide(recording or desk.current, lambda: desk.review.reopen_finding(desk.visit, finding, desk.name))

    if finding.accepted:
        return button("", desk.words("Reopen"), reopen, "flat dense")
    return button("", desk.words("Harmless …"), lambda: ask_reason(desk, finding), "flat dense")


def ask_reason(
    desk: ReviewController, finding: Finding | None = None, excluded: Callable[[str], Awaitable[None]] | None = None
) -> None:
    """Ask for a reason in a dialog; then accept ``finding``, or exclude the displayed recording if it is None.

    Args:
        excluded: called with the reason instead, to exclude the selected recordings.
    """
    words, recording = desk.words, desk.current
    reasons = words.each(
        "wrong gesture",
        "gesture not performed",
        "disturbed from outside",
        "sensor fault",
        "recorded twice",
        "broken off",
    )
    if finding is not None:
        reasons = words.each(
            "looked at: it is fine",
            "this person's way of doing it",
            "known fault of the device that does not affect the gesture",
        )
    if excluded is not None:
        title = words("Why are the selected recordings ({n}) excluded?", n=len(desk.selected))
    elif finding is None:
        title = words("Why is {id} excluded?", id=recording)
    else:
        about = finding.about or desk.review.dataset.head.name
        title = words("Why is “{check}” harmless in {about}?", check=words.check(finding.check), about=about)

    async def answer(why: str) -> None:
        if not why.strip():
            field.error = words("A reason is missing. Give it in a few words.")
            field.run_method("focus")
            return
        dialog.close()
        review, visit = desk.review, desk.visit
        if excluded is not None:
            await excluded(why)
        elif finding is None:
            await desk.decide(recording, lambda: review.exclude(visit, [recording], desk.name, why), move=True)
        else:
            await desk.decide(recording, lambda: review.accept_finding(visit, finding, desk.name, why))

    with open_dialog(words("Reason"), "reason", "w-full") as dialog:
        ui.label(title).classes("text-lg text-bold ps-break")
        with ui.row().classes("ps-small-gap"):
            for number, reason in enumerate(reasons):
                look = "outline autofocus" if number == 0 else "outline"
                button("", reason, lambda reason=reason: answer(reason), look)
        field = ui.input(words("Another reason")).classes("w-full")
        on_enter(tag(field, "own-reason"), lambda: answer(field.value or ""))
        with ui.row().classes("w-full justify-end"):
            button("", words("Cancel"), dialog.close, "flat")
            go = words("Exclude") if finding is None else words("Harmless …")
            button("reason-go", go, lambda: answer(field.value or ""), "unelevated")


def recorded_as(words: Words, row: ReviewedRecording) -> str:
    """Return a text that names the recorded gesture if marks state another one, else ""."""
    if row.info.gesture == row.info.recorded:
        return ""
    return words("recorded as {gesture}", gesture=words.gesture(row.info.recorded))


def ask_gesture(
    desk: ReviewController, identities: Sequence[str], answer: Callable[[str, str], Awaitable[None]]
) -> None:
    """Ask in a dialog which gesture was made; call ``answer`` with it ("" for the recorded one) and the reason."""
    words = desk.words
    rows = [desk.review.rows[i] for i in identities]
    now = rows[0].info.gesture if len({r.info.gesture for r in rows}) == 1 else None
    title = (
        words("Which gesture was made in the selected recordings ({n})?", n=len(rows))
        if len(rows) > 1
        else words("Which gesture was made in {id}?", id=rows[0].id)
    )
    options = {g: words.gesture(g) for g in desk.review.dataset.gestures.labels}

    async def done(gesture: str | None) -> None:
        if gesture is None:
            choice.error = words("Choose the gesture that was made.")
            return
        dialog.close()
        await answer(gesture, (why.value or "").strip())

    with open_dialog(words("Another gesture"), "relabelling", "w-full") as dialog:
        ui.label(title).classes("text-lg text-bold ps-break")
        choice = ui.select(options, value=now if now in options else None, label=words("Gesture"))
        tag(choice.props("options-dense").classes("w-full"), "new-gesture")
        why = tag(ui.input(words("Reason (optional)")).classes("w-full"), "relabel-why")
        about = words(
            "The recording itself is not changed: the name of its file still says what was asked for. Checks, training "
            "and publishing use the new gesture."
        )
        ui.label(about).classes("ps-dim")
        with ui.row().classes("w-full justify-end"):
            button("", words("Cancel"), dialog.close, "flat")
            if any(r.info.gesture != r.info.recorded for r in rows):
                button("relabel-restore", words("As recorded"), lambda: done(""), "flat")
            button("relabel-go", words("Set the gesture"), lambda: done(choice.value), "unelevated")


PER_PAGE = 50
_SURE_PERCENT = 90
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
                button("start", words("Review one by one"), self._start, "unelevated color=primary")
                self.range = tag(ui.label().classes("ps-number").props("role=status"), "range")
                before, after = words("Previous page"), words(in_context("table", "Next page"))
                self.before = icon_button("chevron_left", before, lambda: self.turn(-1), "flat round")
                self.after = icon_button("chevron_right", after, lambda: self.turn(1), "flat round")
                ui.space()
                if not desk.review.is_labelled:
                    self._sure()
                button("undo-list", words("Undo"), desk.undo)
                self.again = button("check-again", "", self._check)
            with ui.row().classes("w-full items-center ps-small-gap"):
                self.chosen = tag(ui.label().props("role=status"), "chosen")
                self.all = button("select-all", "", self._select_all, "flat dense")
                with ui.row().classes("items-center ps-small-gap") as self.acts:
                    if not desk.review.is_labelled:
                        accept = words("Accept suggestions")
                        button("accept-selected", accept, lambda: self._accept(list(desk.selected)))
                    button("exclude-selected", words("Exclude …"), lambda: ask_reason(desk, None, self._exclude))
                    button("include-selected", words("Include again"), self._include)
                    button("relabel-selected", words("Another gesture …"), self._relabel)
                    button("select-none", words("Clear the selection"), self._select_none, "flat")
            with scroll_region(words("Recordings")):
                self.table = tag(ReviewTable(words, self._sort, desk.open, self._pick, self._pick_page), "table")
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
        text = (
            words("{first}–{last} of {n}", first=first + 1, last=first + len(ids), n=n)
            if n
            else words("No recording fits the filter.")
        )
        self.range.set_text(text)
        self.before.set_enabled(first > 0)
        self.after.set_enabled(first + PER_PAGE < n)
        self._show_selection()
        self.table.show([self._cells(rows[i]) for i in ids if i in rows], desk.by, desk.down, desk.current)
        unchecked = desk.review.unchecked
        self.again.set_visibility(unchecked > 0)
        self.again.set_text(words("Check again (changed: {n})", n=unchecked))
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
            findings = [{"severity": "", "text": words("✓ {n} accepted", n=len(row.findings))}]
        return {
            "id": row.id,
            "person": desk.person(row.info.subject),
            "selected": row.id in desk.selected,
            "recorded": recorded_as(words, row),
            "gesture": f"{AFFECT_SIGNS[row.affect]}\u00a0{words.gesture(row.info.gesture)}",
            "seconds": f"{desk.words.number(row.seconds, 2)} s",
            "findings": findings,
            "state": row.state,
            "state_text": f"{SIGNS[row.state]} {words(STATE_TEXTS[row.state])}",
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
        self.elsewhere.set_text(words("Findings about sessions, people and the whole data set: {n}", n=len(findings)))
        self.others.clear()
        with self.others:
            for f in findings:
                with ui.row().classes("w-full items-center ps-small-gap ps-row"):
                    ui.label(finding_text(words, f)).classes("text-bold")
                    ui.label(f"{f.about or words('Data set')}: {words.sentence(f.message)}").classes(
                        "flex-grow ps-break"
                    )
                    finding_button(desk, f)

    # Selection ----------------------------------------------------------------------------------------------------

    def _sure(self) -> None:
        """Add the field for a confidence, and the button that accepts all suggestions that are surer."""
        words = self.desk.words
        self.percent = ui.number(words("Surer than"), value=_SURE_PERCENT, min=0, max=100, step=5, format="%.0f")
        self.percent.props('suffix="%"').style("width: 130px").on_value_change(self._show_selection)
        tag(self.percent, "sure")
        self.accept_sure = button("accept-sure", "", self._accept_sure)

    def _surer(self) -> list[str]:
        """Return the recordings of the list whose suggestion is surer than the field says."""
        return self.desk.review.surer_than((self.percent.value or 0) / 100, self.desk.order)

    async def _accept_sure(self) -> None:
        await self._accept(self._surer(), (self.percent.value or 0) / 100)

    def _show_selection(self) -> None:
        desk, words = self.desk, self.desk.words
        for gone in [i for i in desk.selected if i not in desk.review.infos]:
            del desk.selected[gone]
        n, fitting = len(desk.selected), len(desk.order)
        self.chosen.set_text(words("Selected: {n}", n=n) if n else words("Nothing selected"))
        self.all.set_text(words("Select all in the list ({n})", n=fitting))
        self.all.set_visibility(fitting > 0 and any(i not in desk.selected for i in desk.order))
        self.acts.set_visibility(n > 0)
        if not desk.review.is_labelled:
            surer = len(self._surer())
            self.accept_sure.set_text(words("Accept suggestions: {n}", n=surer))
            self.accept_sure.set_enabled(surer > 0)

    def _pick(self, identity: str, through: bool) -> None:
        self.desk.toggle_selected(identity, through)
        self.draw()

    def _pick_page(self) -> None:
        desk = self.desk
        shown = desk.order[desk.first_row : desk.first_row + PER_PAGE]
        if all(i in desk.selected for i in shown):
            for i in shown:
                del desk.selected[i]
        else:
            desk.selected |= dict.fromkeys(shown)
        self.draw()

    def _select_all(self) -> None:
        self.desk.selected |= dict.fromkeys(self.desk.order)
        self.draw()

    def _select_none(self) -> None:
        self.desk.selected.clear()
        self.draw()

    async def _accept(self, chosen: list[str], above: float = 0.0) -> None:
        desk = self.desk
        review, ends = desk.review, desk.ends
        await desk.decide_all(lambda: review.accept_above(desk.visit, chosen, desk.name, above, ends), "trim")

    async def _exclude(self, why: str) -> None:
        desk, chosen = self.desk, list(self.desk.selected)
        await desk.decide_all(lambda: desk.review.exclude(desk.visit, chosen, desk.name, why), "exclude")

    async def _include(self) -> None:
        desk, chosen = self.desk, list(self.desk.selected)
        await desk.decide_all(lambda: desk.review.include(desk.visit, chosen, desk.name), "include")

    def _relabel(self) -> None:
        desk, chosen = self.desk, list(self.desk.selected)

        async def answer(gesture: str, why: str) -> None:
            await desk.decide_all(lambda: desk.review.relabel(desk.visit, chosen, gesture, desk.name, why), "relabel")

        ask_gesture(desk, chosen, answer)

    # Paging and sorting -------------------------------------------------------------------------------------------

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
