"""Define the view of one recording."""

from __future__ import annotations

import contextlib
from typing import Any

from nicegui import ui

from plushsense.studio.app.shell import AFFECT_COLOURS, AFFECT_SIGNS, button, icon_button, named, tag
from plushsense.studio.app.words import CHANNEL_KINDS, Texts, in_context
from plushsense.studio.pages.review.controller import ReviewController
from plushsense.studio.pages.review.plot import DrawingSpec, ReviewPlot, curve_styles
from plushsense.studio.pages.review.review import STATE_TEXTS
from plushsense.studio.pages.review.signals import ACTIVITY, ALL
from plushsense.studio.pages.review.table_view import (
    SIGNS,
    ask_gesture,
    ask_reason,
    finding_button,
    finding_text,
    recorded_as,
)

_MARKS: Texts = {
    "start": "start {at} s",
    "stop": "end {at} s",
}

_SUGGESTED: Texts = {
    "start": "suggested start {at} s",
    "stop": "suggested end {at} s",
}

_KEYS: Texts = {
    "Enter": "accept and go to the next one",
    "Backspace": "back to the one before",
    "↓ ↑": "next, previous, without a decision",
    "← →": "move the start by a row (or click)",
    "Shift + ← →": "move the end (or Shift-click, right click)",
    ", .": "move by ten rows, with Shift the end",
    "Home, End": "start at the first row, end at the last",
    "s, Esc": "reset the start and the end",
    "x": "exclude, or include again",
    "g": "set another gesture",
    "u": "undo the last decision, one by one",
    "+ − 0": "zoom in, zoom out, whole recording",
}

START, STOP = "start", "stop"
# Keys that trim.
_TRIMMING = ("← →", "Shift + ← →", ", .", "Home, End", "s, Esc")
_SET, _DRAFT = "--ps-set", "--ps-draft"
_STEPS = {"ArrowLeft": -1, "ArrowRight": 1, ",": -10, "<": -10, ";": -10, ".": 10, ">": 10, ":": 10}
# Of the window's height.
_PLOT_HEIGHT = 0.52


class RecordingView:
    """View of one recording: its signals, marks, findings and actions."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self.group = ALL
        self.side = START
        self.enlarged = False
        self._drawn: Any = None
        words, trims = desk.words, not desk.review.is_labelled
        with tag(ui.element("div").classes("ps-one w-full"), "one") as self.place:
            with ui.column().classes("w-full ps-small-gap no-wrap"):
                with ui.row().classes("w-full items-center ps-small-gap"):
                    self.heading = tag(ui.label().classes("text-lg text-bold").props("role=status"), "recording")
                    self.heading.style("overflow-wrap: anywhere")
                    self.affect = ui.label().classes("q-px-sm rounded-borders").style("font-weight: 600; color: #fff")
                    self.state = tag(ui.label().classes("ps-chip").props("role=status"), "state")
                self.about = tag(ui.label().classes("ps-dim"), "about")
                self._actions(trims)
                self.plot = ReviewPlot(
                    words("Signals of the recording"),
                    height=_PLOT_HEIGHT,
                    on_pick=self.picked,
                    on_key=self.key,
                    on_zoom=self.zoomed,
                )
                tag(self.plot, "plot")
                if trims:
                    self._marks()
                self._views()
            with ui.column().classes("w-full ps-small-gap"):
                ui.label(words("Findings")).classes("text-bold")
                self.findings = tag(ui.column().classes("w-full"), "findings")
                ui.label(words("Keys")).classes("text-bold q-mt-md")
                with tag(ui.element("dl").classes("ps-keys q-ma-none"), "keys"):
                    for key, does in _KEYS.items():
                        if trims or key not in _TRIMMING:
                            with ui.element("dt"):
                                ui.label(key).classes("ps-key").style("display: inline-block")
                            with ui.element("dd"):
                                ui.label(words("next recording") if key == "Enter" and not trims else words(does))

    def _button(self, text: str, action: Any, name: str, look: str = "outline") -> ui.button:
        return button(name, self.desk.words(text), action, look).classes("ps-act")

    def _actions(self, trims: bool) -> None:
        desk = self.desk
        with ui.row().classes("w-full items-center ps-small-gap"):
            self._button(
                "Accept, next" if trims else "Next", lambda: self.accept(), "accept", "unelevated color=primary"
            )
            self._button("Back", desk.back, "back")
            self.exclude = self._button("Exclude …", self._exclude, "exclude")
            self._button("Another gesture …", self._relabel, "relabel")
            self._button("Undo", desk.undo, "undo")

    def _marks(self) -> None:
        """Build the buttons that set start and stop, as an alternative to the plot and the keyboard."""
        words = self.desk.words
        with ui.row().classes("w-full items-center ps-small-gap"):
            side = ui.toggle({START: words(in_context("edge", "Start")), STOP: words("End")}, value=START)
            side.props(f'no-caps dense unelevated aria-label="{words("What a click in the plot sets")}"').classes(
                "ps-toggle"
            )
            tag(side, "side").on_value_change(lambda e: setattr(self, "side", str(e.value)))
            for sign, by in (("−10", -10), ("−1", -1), ("+1", 1), ("+10", 10)):
                step = button(f"step{by}", sign, lambda by=by: self.step(by, self.side == STOP), "outline dense")
                named(step.classes("ps-act"), words("Move by {by} rows", by=sign))
            self._button("Reset", self._drop, "drop", "outline dense")
            self.untrim = self._button("Remove the trim", self._untrim, "untrim", "outline dense")
            ends = ui.switch(
                words("Use the suggested end, too"), value=self.desk.ends, on_change=lambda e: self._ends(bool(e.value))
            )
            tag(ends, "ends")

    def _views(self) -> None:
        words = self.desk.words
        kinds = list(dict.fromkeys(c.kind for c in self.desk.review.dataset.layout.channels))
        groups = [ALL, *(kinds if len(kinds) > 1 else []), ACTIVITY]
        with ui.row().classes("w-full items-center ps-small-gap"):
            toggle = ui.toggle({g: self._kind(g) for g in groups}, value=ALL)
            toggle.props(f'no-caps dense unelevated aria-label="{words("Channels shown")}"').classes("ps-toggle")
            tag(toggle, "group").on_value_change(lambda e: self._grouped(str(e.value)))
            enlarge = ui.switch(words("Enlarge small changes"), on_change=lambda e: self._enlarge(bool(e.value)))
            tag(enlarge, "enlarge")
            for name, icon, text, factor in (
                ("zoom_in", "zoom_in", words("Zoom in"), 0.5),
                ("zoom_out", "zoom_out", words("Zoom out"), 2.0),
                ("zoom_all", "fit_screen", words("The whole recording"), 0.0),
            ):
                tag(icon_button(icon, text, lambda factor=factor: self.plot.zoom(factor)).classes("ps-act"), name)

    def _kind(self, kind: str) -> str:
        return self.desk.words(CHANNEL_KINDS.get(kind, kind))

    # Drawing ------------------------------------------------------------------------------------------------------

    def draw(self, *, keep: bool = False, low: float | None = None, high: float | None = None) -> None:
        """Plot the current recording, with all rows from ``low`` to ``high`` seconds if these are given."""
        desk, words = self.desk, self.desk.words
        identity = desk.current
        self._drawn = None
        if not identity or identity not in desk.review.infos:
            self.heading.set_text(words("No recording fits the filter."))
            return
        plotted = desk.review.signals(identity).curves(self.group, low, high, self.enlarged)
        series = curve_styles([self._kind(n) if n == ACTIVITY else words.channel(n) for n in plotted.names])
        y_title = words("Value ({unit})", unit=words.unit(plotted.unit)) if plotted.unit else ""
        lanes = [(at, self._kind(kind)) for at, kind in plotted.lanes]
        drawing = DrawingSpec(
            identity,
            self._label(),
            [plotted.x, *plotted.curves],
            series,
            x_title=words("Seconds (grey: outside the recording)"),
            y_title=words("Deviation from rest (1 = usual)") if self.group == ACTIVITY else y_title,
            lanes=lanes,
            limits=plotted.limits,
            marks=self._lines(),
            cut=self._cut(),
            thinned=plotted.thinned or low is not None,
            keep=keep,
        )
        self.plot.show(drawing)
        self.refresh()

    def refresh(self) -> None:
        """Update the marks, state and findings of the current recording, but not its curves."""
        desk, words, review = self.desk, self.desk.words, self.desk.review
        row = review.rows.get(desk.current)
        if row is None or not review.is_read(row.id):
            return
        marks, draft = review.standing(row.id), review.draft(row.id)
        now = (row.id, row.state, marks, draft, row.findings, desk.ends, row.confidence)
        if now == self._drawn:
            return
        if self._drawn is not None:
            self.plot.remark(row.id, self._lines(), self._cut(), self._label())
        self._drawn = now
        self.heading.set_text(row.id)
        recorded = recorded_as(words, row)
        gesture = words.gesture(row.info.gesture) + (f" ({recorded})" if recorded else "")
        self.affect.set_text(f"{AFFECT_SIGNS[row.affect]} {gesture}, {words.affect(row.affect)}")
        self.affect.style(f"background: {AFFECT_COLOURS.get(row.affect, '#767676')}")
        self.state.set_text(f"{SIGNS[row.state]} {words(STATE_TEXTS[row.state])}")
        self.state.props(f'data-state="{row.state}"')
        self.about.set_text(self._about())
        excluded = row.state == "excluded"
        self.exclude.set_text(words("Include again" if excluded else "Exclude …"))
        if not review.is_labelled:
            self.untrim.set_visibility(marks.trimmed)
        self._fill_findings()

    def _about(self) -> str:
        desk, words = self.desk, self.desk.words
        row, at = desk.review.rows[desk.current], desk.review.signals(desk.current).seconds
        place = desk.order.index(row.id) + 1 if row.id in desk.order else 0
        person, seconds = desk.person(row.info.subject), words.number(at[-1], 2)
        facts = [words("{person} · {seconds} s · rows: {rows}", person=person, seconds=seconds, rows=row.info.rows)]
        if place:
            facts.append(words("{at} of {of}", at=place, of=len(desk.order)))
        if not desk.review.is_labelled:
            start, stop = desk.review.kept_rows(row.id, desk.ends)
            facts.append(
                words("keeps {start} s to {stop} s", start=words.number(at[start], 2), stop=words.number(at[stop], 2))
            )
            if row.state == "suggested":
                facts.append(words("suggestion {percent} % sure", percent=f"{100 * row.confidence:.0f}"))
        return " · ".join(facts)

    def _label(self) -> str:
        desk, words = self.desk, self.desk.words
        row = desk.review.rows[desk.current]
        return f"{row.id}, {words.gesture(row.info.gesture)}, {words(STATE_TEXTS[row.state])}. {self._about()}"

    def _lines(self) -> list[dict[str, Any]]:
        """Return the vertical lines to plot: dotted for suggestions, solid for drafts and marks."""
        desk, words, review = self.desk, self.desk.words, self.desk.review
        if review.is_labelled:
            return []
        trim, draft = review.trim(desk.current), review.draft(desk.current)
        at, rows, s = trim.seconds, trim.recording.rows, trim.suggestion
        lines: list[dict[str, Any]] = []
        if draft or trim.mark_state.trimmed:
            start, stop = draft or trim.current_rows()
            colour = _DRAFT if draft else _SET
            for key, row, edge in ((START, start, 0), (STOP, stop, rows)):
                if row != edge or (key == START and draft):
                    label = words(_MARKS[key], at=words.number(at[row], 2))
                    lines.append({"x": float(at[row]), "label": label, "stroke": colour, "edge": key})
        taken = {line["x"] for line in lines}
        for key, row, visible in ((START, s.start, s.onset_visible), (STOP, s.stop, s.offset_visible)):
            if visible and float(at[row]) not in taken:
                used = key == START or desk.ends
                label = words(_SUGGESTED[key], at=words.number(at[row], 2)) if used else ""
                lines.append({"x": float(at[row]), "label": label, "dash": [2, 4] if used else [1, 7], "edge": key})
        return lines

    def _cut(self) -> list[tuple[float, float]]:
        review, identity = self.desk.review, self.desk.current
        if review.is_labelled:
            return []
        trim = review.trim(identity)
        if not (review.draft(identity) or trim.mark_state.trimmed):
            return []
        start, stop = review.kept_rows(identity)
        at = trim.seconds
        return [(a, b) for a, b in ((0.0, float(at[start])), (float(at[stop]), float(at[-1]))) if b > a]

    def _fill_findings(self) -> None:
        desk, words = self.desk, self.desk.words
        row = desk.review.rows[desk.current]
        self.findings.clear()
        with self.findings:
            if not row.findings:
                none = "The checks found nothing." if desk.review.prepared.checked else "Not checked yet."
                ui.label(words(none)).classes("ps-dim")
            for f in row.findings:
                with ui.column().classes("w-full ps-no-gap").props(f'data-check="{f.check}"'):
                    ui.label(finding_text(words, f)).classes("text-bold")
                    ui.label(words.sentence(f.message))
                    with ui.row().classes("items-center") if f.accepted else contextlib.nullcontext():
                        what = f"✓ {words('accepted as harmless')}" if f.accepted else f"→ {words(f.action)}"
                        ui.label(what).classes("ps-dim")
                        finding_button(desk, f, row.id).classes("ps-act")

    # Commands -----------------------------------------------------------------------------------------------------

    async def key(self, event: dict[str, Any]) -> None:
        """Handle a key that was pressed while ``event["recording"]`` was displayed."""
        desk, key, shift = self.desk, str(event["key"]), bool(event["shift"])
        trims = not desk.review.is_labelled
        if key == "Backspace":
            await desk.back()
        elif key == "ArrowDown":
            await desk.next()
        elif key == "ArrowUp":
            await desk.previous()
        elif key == "u":
            await desk.undo()
        elif event["recording"] != desk.current:
            # Another recording is displayed now, for which the key was not meant.
            return
        elif key == "Enter":
            await self.accept(str(event["recording"]))
        elif key == "x":
            await self._exclude()
        elif key == "g":
            self._relabel()
        elif trims and key in ("s", "Escape"):
            self._drop()
        elif trims and key == "Home":
            self._set(start=0)
        elif trims and key == "End":
            self._set(stop=desk.review.info(desk.current).rows)
        elif trims and key in _STEPS:
            self.step(_STEPS[key], shift)

    def picked(self, event: dict[str, Any]) -> None:
        """Set the start or the stop to the row nearest to the click in the plot."""
        desk = self.desk
        if event["recording"] != desk.current or desk.review.is_labelled:
            return
        with desk.page.show_errors():
            row = desk.review.signals(desk.current).row_at(float(event["x"]))
            stop = bool(event["shift"]) or event["button"] == "right" or self.side == STOP
            self._set(**{STOP if stop else START: row})

    def step(self, by: int, stop: bool) -> None:
        """Move the start, or with ``stop`` the stop, by ``by`` rows."""
        with self.desk.page.show_errors():
            start, end = self.desk.review.kept_rows(self.desk.current, self.desk.ends)
            self._set(**{STOP: end + by} if stop else {START: start + by})

    def _set(self, **rows: int) -> None:
        desk = self.desk
        with desk.page.show_errors():
            desk.review.set(desk.current, ends=desk.ends, **rows)
            desk.page.say("")
        self.refresh()

    async def accept(self, recording: str = "") -> None:
        """Accept the displayed start and stop, and go to the next recording."""
        desk = self.desk
        identity = recording or desk.current
        if desk.review.is_labelled:
            await desk.next()
        else:
            await desk.decide(
                identity, lambda: desk.review.accept(desk.visit, identity, desk.name, desk.ends), move=True
            )

    async def _exclude(self) -> None:
        desk, identity = self.desk, self.desk.current
        if not identity:
            return
        if desk.review.standing(identity).excluded:
            await desk.decide(identity, lambda: desk.review.include(desk.visit, [identity], desk.name))
        else:
            ask_reason(desk)

    def _relabel(self) -> None:
        desk, identity = self.desk, self.desk.current

        async def answer(gesture: str, why: str) -> None:
            await desk.decide(identity, lambda: desk.review.relabel(desk.visit, [identity], gesture, desk.name, why))

        if identity in desk.review.rows:
            ask_gesture(desk, [identity], answer)

    def _drop(self) -> None:
        self.desk.review.drop(self.desk.current)
        self.refresh()

    async def _untrim(self) -> None:
        desk, identity = self.desk, self.desk.current
        desk.review.drop(identity)
        await desk.decide(identity, lambda: desk.review.untrim(desk.visit, identity, desk.name))

    def _ends(self, taken: bool) -> None:
        self.desk.ends = taken
        self.refresh()

    def _grouped(self, group: str) -> None:
        self.group = group
        self.draw(keep=True)

    def _enlarge(self, enlarged: bool) -> None:
        self.enlarged = enlarged
        self.draw(keep=True)

    def zoomed(self, event: dict[str, Any]) -> None:
        """Plot a thinned recording again, with all rows of the visible range."""
        if event["recording"] == self.desk.current:
            self.draw(keep=True, low=float(event["low"]), high=float(event["high"]))
