"""The views of one recording and of the overlay of a gesture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from plushsense.studio.app.shell import AFFECT_COLOURS, LINES, tag
from plushsense.studio.pages.review.plots import ACTIVITY, ALL, GestureOverlay, ReviewPlot
from plushsense.studio.pages.review.table_view import AFFECTS, SIGNS, ask_reason, finding_text

if TYPE_CHECKING:
    from plushsense.studio.pages.review.controller import ReviewController


_NAMED = 30
_USUAL = "#8a9099"


class GestureOverlayView:
    """The overlay of one gesture; a click on a curve or a name opens the recording."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self._overlay: GestureOverlay | None = None
        self._drawn: Any = None
        words = desk.words
        present = {r.info.gesture for r in desk.review.rows.values()}
        labels = [g.label for g in desk.review.dataset.gestures.gestures if g.label in present]
        labels += sorted(present - set(labels))
        self._gesture = desk.filter.gesture or (labels[0] if labels else "")
        with tag(ui.element("div").classes("ps-two w-full"), "overlay") as self.place:
            with ui.column().classes("w-full gap-2 no-wrap"):
                self.choice = ui.select(
                    {g: words.gesture(g) for g in labels},
                    value=self._gesture if self._gesture in labels else None,
                    label=words("review.gesture"),
                    on_change=lambda e: self._choose(str(e.value)),
                )
                tag(self.choice.props("outlined dense options-dense").style("min-width: 260px"), "overlay-gesture")
                self.message = tag(ui.label().props("role=status"), "overlay-said")
                self.plot = ReviewPlot(words("review.overlay_plot"), height=420, legend=False, on_pick=self.picked)
                tag(self.plot, "overlay-plot")
                ui.label(words("review.overlay_help")).classes("ps-dim")
            with ui.column().classes("w-full gap-2"):
                ui.label(words("review.odd")).classes("font-bold")
                self.names = tag(ui.column().classes("w-full gap-0"), "odd")

    async def _choose(self, gesture: str) -> None:
        self._gesture = gesture
        self.fill()

    def fill(self, anew: bool = True) -> None:
        """Plot the gesture; skip this if nothing changed and ``anew`` is false."""
        desk, words = self.desk, self.desk.words
        if anew and desk.filter.gesture and desk.filter.gesture != self._gesture:
            self._gesture = desk.filter.gesture
            self.choice.value = self._gesture
        made = desk.review.overlay(self._gesture)
        fitting = set(desk.order) if desk.filter.query() or desk.only is not None else None
        now = (self._gesture, [(c.recording, c.seconds, c.why) for c in made.drawn], fitting)
        if now == self._drawn and not anew:
            return
        self._drawn, self._overlay = now, made
        odd = [c for c in made.drawn if c.why]
        colours = {c.recording: LINES[i % len(LINES)] for i, c in enumerate(odd)}
        series, curves = [], []
        for c, heights in zip(made.drawn, made.curves, strict=True):
            if c.why:
                look = {"label": c.recording, "stroke": colours[c.recording], "width": 2}
            else:
                faint = len(made.drawn) > 40 or (fitting is not None and c.recording not in fitting)
                look = {"label": c.recording, "stroke": f"{_USUAL}{'66' if faint else 'cc'}", "width": 1}
            series.append(look)
            curves.append([None if np.isnan(v) else round(float(v), 3) for v in heights])
        message = words("review.overlay_said", n=len(made.drawn), odd=len(odd), gesture=words.gesture(self._gesture))
        self.message.set_text(message if made.drawn else words("review.overlay_empty"))
        self.plot.show(
            f"overlay {self._gesture}",
            message,
            np.round(made.x, 4).tolist(),
            curves,
            series,
            x_title=words("review.x_axis"),
            y_title=words("review.activity_axis"),
            limits=(0.0, made.top),
        )
        self.names.clear()
        with self.names:
            if not odd:
                ui.label(words("review.no_odd")).classes("ps-dim")
            for c in odd[:_NAMED]:
                with ui.row().classes("items-center no-wrap w-full"):
                    dash = ui.element("span").style("width: 22px; height: 4px; flex: none")
                    dash.style(f"background: {colours[c.recording]}")
                    button = ui.button(f"{c.recording}: {c.why}", on_click=lambda c=c: desk.open(c.recording))
                    button.props("no-caps flat dense align=left").style("overflow-wrap: anywhere; text-align: left")
                    button.classes("flex-grow")
            if len(odd) > _NAMED:
                ui.label(words("review.more_odd", n=len(odd) - _NAMED)).classes("ps-dim")

    async def picked(self, message: dict[str, Any]) -> None:
        """Open the recording whose curve is nearest to a click."""
        found = self._overlay.nearest(float(message["x"]), float(message["y"])) if self._overlay is not None else ""
        if found:
            await self.desk.open(found)


START, STOP = "start", "stop"
KEYS = (
    ("Enter", "accept"),
    ("Backspace", "back"),
    ("↓ ↑", "pass"),
    ("← →", "start"),
    ("Shift + ← →", "stop"),
    (", .", "ten"),
    ("Home, End", "edges"),
    ("s, Esc", "drop"),
    ("x", "exclude"),
    ("u", "undo"),
    ("+ − 0", "zoom"),
)
"""The keys as they are written, and the word that says what each does; only what works without trimming otherwise."""
_PLAIN = ("accept", "back", "pass", "exclude", "undo", "zoom")
_SET, _DRAFT = "--ps-set", "--ps-draft"
_STEPS = {"ArrowLeft": -1, "ArrowRight": 1, ",": -10, "<": -10, ";": -10, ".": 10, ">": 10, ":": 10}
_ZOOMS = {"zoom_in": ("zoom_in", 0.5), "zoom_out": ("zoom_out", 2.0), "zoom_all": ("fit_screen", 0.0)}
_DASHES: tuple[list[int], ...] = ([], [7, 4], [2, 3])


class RecordingView:
    """The view of one recording: signals, marks, findings and actions."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self.group = ALL
        self.side = START
        self._drawn: Any = None
        words, trims = desk.words, not desk.review.is_labelled
        with tag(ui.element("div").classes("ps-one w-full"), "one") as self.place:
            with ui.column().classes("w-full gap-2 no-wrap"):
                with ui.row().classes("w-full items-center gap-2"):
                    self.heading = tag(ui.label().classes("text-lg font-bold").props("role=status"), "recording")
                    self.heading.style("overflow-wrap: anywhere")
                    self.affect = ui.label().classes("q-px-sm rounded-borders").style("font-weight: 600; color: #fff")
                    self.state = tag(ui.label().classes("ps-chip").props("role=status"), "state")
                self.about = tag(ui.label().classes("ps-dim ps-number"), "about")
                self._actions(trims)
                self.plot = ReviewPlot(
                    words("review.plot"), height=310, on_pick=self.picked, on_key=self.key, on_zoom=self.zoomed
                )
                tag(self.plot, "plot")
                if trims:
                    self._marks()
                self._views()
            with ui.column().classes("w-full gap-2"):
                ui.label(words("review.findings")).classes("font-bold")
                self.findings = tag(ui.column().classes("w-full"), "findings")
                ui.label(words("review.keys")).classes("font-bold q-mt-md")
                with tag(ui.element("dl").classes("ps-keys q-ma-none"), "keys"):
                    for key, does in KEYS:
                        if trims or does in _PLAIN:
                            with ui.element("dt"):
                                ui.label(key).classes("ps-key").style("display: inline-block")
                            with ui.element("dd"):
                                ui.label(words(f"review.key_{'next' if does == 'accept' and not trims else does}"))

    def _button(self, key: str, does: Any, name: str, look: str = "outline") -> ui.button:
        button = ui.button(self.desk.words(f"review.{key}"), on_click=does).props(f"no-caps {look}")
        return tag(button.classes("ps-act"), name)

    def _actions(self, trims: bool) -> None:
        desk = self.desk
        with ui.row().classes("w-full items-center gap-2"):
            self._button("accept" if trims else "next", self.accept, "accept", "unelevated color=primary")
            self._button("back", desk.back, "back")
            self.exclude = self._button("exclude", self._exclude, "exclude")
            self._button("undo", desk.undo, "undo")

    def _marks(self) -> None:
        """Build the controls that set marks without the plot or the keyboard."""
        words = self.desk.words
        with ui.row().classes("w-full items-center gap-2"):
            side = ui.toggle({START: words("review.sets_start"), STOP: words("review.sets_stop")}, value=START)
            side.props(f'no-caps dense unelevated aria-label="{words("review.sets")}"').classes("ps-toggle")
            tag(side, "side").on_value_change(lambda e: setattr(self, "side", str(e.value)))
            for sign, by in (("−10", -10), ("−1", -1), ("+1", 1), ("+10", 10)):
                button = ui.button(sign, on_click=lambda by=by: self.step(by, self.side == STOP))
                button.props(f'no-caps outline dense aria-label="{words("review.step", by=sign)}"').classes("ps-act")
                tag(button, f"step{by}")
            self._button("drop", self._drop, "drop", "outline dense")
            self.untrim = self._button("untrim", self._untrim, "untrim", "outline dense")
            ends = ui.switch(words("review.ends"), value=self.desk.ends, on_change=lambda e: self._ends(bool(e.value)))
            tag(ends, "ends")

    def _views(self) -> None:
        words = self.desk.words
        kinds = list(dict.fromkeys(c.kind for c in self.desk.review.dataset.layout.channels))
        groups = [ALL, *(kinds if len(kinds) > 1 else []), ACTIVITY]
        with ui.row().classes("w-full items-center gap-2"):
            visible = ui.toggle({g: self._kind(g) for g in groups}, value=ALL)
            visible.props(f'no-caps dense unelevated aria-label="{words("review.group")}"').classes("ps-toggle")
            tag(visible, "group").on_value_change(lambda e: self._grouped(str(e.value)))
            for key, (icon, factor) in _ZOOMS.items():
                button = ui.button(icon=icon, on_click=lambda factor=factor: self.plot.zoom(factor))
                tag(button.props(f'flat round dense aria-label="{words(f"review.{key}")}"').classes("ps-act"), key)

    def _kind(self, kind: str) -> str:
        key = f"review.kind_{kind}"
        return self.desk.words(key) if self.desk.words.has(key) else kind

    # Showing ------------------------------------------------------------------------------------------------------

    def draw(self, *, keep: bool = False, low: float | None = None, high: float | None = None) -> None:
        """Plot the current recording."""
        desk, words = self.desk, self.desk.words
        identity = desk.current
        self._drawn = None
        if not identity or identity not in desk.review.infos:
            self.heading.set_text(words("review.none_fit"))
            return
        read = desk.review.signals(identity)
        visible = read.curves(self.group, low, high)
        names = [self._kind(n) if n == ACTIVITY else n for n in visible["names"]]
        series = [
            {"label": n, "stroke": LINES[i % len(LINES)], "dash": _DASHES[i // len(LINES) % len(_DASHES)]}
            for i, n in enumerate(names)
        ]
        y_title = words("review.y_axis", unit=words.unit(visible["unit"])) if visible["unit"] else ""
        self.plot.show(
            identity,
            self._label(),
            visible["x"],
            visible["curves"],
            series,
            x_title=words("review.x_axis"),
            y_title=words("review.activity_axis") if self.group == ACTIVITY else y_title,
            lanes=[(at, self._kind(kind)) for at, kind in visible["lanes"]],
            limits=(-1.08 - 2.1 * (len(visible["lanes"]) - 1), 1.08) if visible["lanes"] else None,
            marks=self._lines(),
            cut=self._cut(),
            thinned=visible["thinned"] or low is not None,
            keep=keep,
        )
        self.refresh(moved=False)

    def refresh(self, *, moved: bool = True) -> None:
        """Update marks, state and findings of the current recording; its curves stay."""
        desk, words, review = self.desk, self.desk.words, self.desk.review
        row = review.rows.get(desk.current)
        if row is None or not review.is_read(row.id):
            return
        standing, draft = review.standing(row.id), review.draft(row.id)
        now = (row.id, row.state, standing, draft, row.findings, desk.ends, row.confidence)
        if now == self._drawn:
            return
        self._drawn = now
        if moved:
            self.plot.remark(row.id, self._lines(), self._cut(), self._label())
        self.heading.set_text(row.id)
        self.affect.set_text(f"{AFFECTS[row.affect]} {words.gesture(row.info.gesture)}")
        self.affect.style(f"background: {AFFECT_COLOURS.get(row.affect, '#767676')}")
        self.state.set_text(f"{SIGNS[row.state]} {words(f'review.state_{row.state}')}")
        self.state.props(f'data-state="{row.state}"')
        self.about.set_text(self._about())
        excluded = row.state == "excluded"
        self.exclude.set_text(words("review.include" if excluded else "review.exclude"))
        if not review.is_labelled:
            self.untrim.set_visibility(standing.trimmed)
        self._fill_findings()

    def _about(self) -> str:
        desk, words = self.desk, self.desk.words
        row, at = desk.review.rows[desk.current], desk.review.signals(desk.current).seconds
        place = desk.order.index(row.id) + 1 if row.id in desk.order else 0
        message = words(
            "review.about", person=desk.person(row.info.subject), seconds=words.number(at[-1], 2), rows=row.info.rows
        )
        message += f" · {words('review.place', at=place, of=len(desk.order))}" if place else ""
        if desk.review.is_labelled:
            return message
        start, stop = desk.review.kept_rows(row.id, desk.ends)
        message += " · " + words("review.kept", start=words.number(at[start], 2), stop=words.number(at[stop], 2))
        if row.state == "suggested":
            message += " · " + words("review.confidence", percent=f"{100 * row.confidence:.0f}")
        return message

    def _label(self) -> str:
        desk, words = self.desk, self.desk.words
        row = desk.review.rows[desk.current]
        return f"{row.id}, {words.gesture(row.info.gesture)}, {words(f'review.state_{row.state}')}. {self._about()}"

    def _lines(self) -> list[dict[str, Any]]:
        """Return the vertical lines: the suggestion dotted, drafts and set marks solid."""
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
                    message = words(f"review.mark_{key}", at=words.number(at[row], 2))
                    lines.append({"x": float(at[row]), "label": message, "stroke": colour, "edge": key})
        taken = {line["x"] for line in lines}
        for key, row, visible in ((START, s.start, s.onset_visible), (STOP, s.stop, s.offset_visible)):
            if visible and float(at[row]) not in taken:
                sure = key == START or desk.ends
                message = words(f"review.suggested_{key}", at=words.number(at[row], 2)) if sure else ""
                lines.append({"x": float(at[row]), "label": message, "dash": [2, 4] if sure else [1, 7], "edge": key})
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
        review, visit, visible = desk.review, desk.visit, desk.current
        row = review.rows[visible]
        self.findings.clear()
        with self.findings:
            if not row.findings:
                key = "no_findings" if review.prepared.checked else "not_checked"
                ui.label(words(f"review.{key}")).classes("ps-dim")
            for f in row.findings:
                with ui.column().classes("w-full gap-0").props(f'data-check="{f.check}"'):
                    ui.label(finding_text(words, f)).classes("font-bold")
                    ui.label(f.message)
                    if f.accepted:
                        with ui.row().classes("items-center"):
                            ui.label(f"✓ {words('review.accepted_finding')}").classes("ps-dim")
                            ui.button(
                                words("review.reopen"),
                                on_click=lambda f=f: desk.decide(
                                    visible, lambda: review.reopen_finding(visit, f, desk.name)
                                ),
                            ).props("no-caps flat dense").classes("ps-act")
                    else:
                        ui.label(f"→ {f.action}").classes("ps-dim")
                        ui.button(words("review.accept_finding"), on_click=lambda f=f: ask_reason(desk, f)).props(
                            "no-caps flat dense"
                        ).classes("ps-act")

    # Doing --------------------------------------------------------------------------------------------------------

    async def key(self, message: dict[str, Any]) -> None:
        """Handle a key that was pressed while recording ``shown`` was displayed."""
        desk, key, shift = self.desk, str(message["key"]), bool(message["shift"])
        trims = not desk.review.is_labelled
        if key == "Backspace":
            await desk.back()
        elif key == "ArrowDown":
            await desk.next()
        elif key == "ArrowUp":
            await desk.previous()
        elif key == "u":
            await desk.undo()
        elif message["shown"] != desk.current:
            # The next one has come since: nothing is decided about what nobody saw.
            return
        elif key == "Enter":
            await self.accept(str(message["shown"]))
        elif key == "x":
            await self._exclude()
        elif trims and key in ("s", "Escape"):
            self._drop()
        elif trims and key == "Home":
            self._set(start=0)
        elif trims and key == "End":
            self._set(stop=desk.review.info(desk.current).rows)
        elif trims and key in _STEPS:
            self.step(_STEPS[key], shift)

    def picked(self, message: dict[str, Any]) -> None:
        """Set the start or the stop at a click in the plot."""
        desk = self.desk
        if message["shown"] != desk.current or desk.review.is_labelled:
            return
        with desk.page.show_errors():
            row = desk.review.signals(desk.current).row_at(float(message["x"]))
            stop = bool(message["shift"]) or message["button"] == "right" or self.side == STOP
            self._set(**({"stop": row} if stop else {"start": row}))

    def step(self, by: int, stop: bool) -> None:
        """Move the start or the stop by some rows."""
        with self.desk.page.show_errors():
            start, end = self.desk.review.kept_rows(self.desk.current, self.desk.ends)
            self._set(**({"stop": end + by} if stop else {"start": start + by}))

    def _set(self, **rows: int) -> None:
        desk = self.desk
        with desk.page.show_errors():
            desk.review.set(desk.current, ends=desk.ends, **rows)
            desk.page.say("")
        self.refresh()

    async def accept(self, visible: Any = None) -> None:
        """Mark the displayed trim as accepted and go to the next recording."""
        desk = self.desk
        identity = visible if isinstance(visible, str) else desk.current
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
            await desk.decide(identity, lambda: desk.review.include(desk.visit, identity, desk.name))
        else:
            ask_reason(desk)

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

    def zoomed(self, message: dict[str, Any]) -> None:
        """Plot a long recording again with all rows of the visible range."""
        if message["shown"] == self.desk.current:
            self.draw(keep=True, low=float(message["low"]), high=float(message["high"]))
