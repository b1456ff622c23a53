"""All recordings of a gesture over each other, those that stand out in colour and by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from plushsense.apps.studio.review_plot import ReviewPlot
from plushsense.apps.studio.review_shown import Overlay
from plushsense.apps.studio.shell import LINES, tag

if TYPE_CHECKING:
    from plushsense.apps.studio.pages.review_desk import Desk

_NAMED = 30
_USUAL = "#8a9099"


class OverlayView:
    """One gesture; a click on a curve or a name opens the recording."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._overlay: Overlay | None = None
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
                self.said = tag(ui.label().props("role=status"), "overlay-said")
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
        """Draw the gesture; not where nothing of it changed and ``anew`` is off."""
        desk, words = self.desk, self.desk.words
        if anew and desk.filter.gesture and desk.filter.gesture != self._gesture:
            self._gesture = desk.filter.gesture
            self.choice.value = self._gesture
        made = desk.review.overlay(self._gesture)
        fitting = set(desk.order) if desk.filter.said() or desk.only is not None else None
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
        said = words("review.overlay_said", n=len(made.drawn), odd=len(odd), gesture=words.gesture(self._gesture))
        self.said.set_text(said if made.drawn else words("review.overlay_empty"))
        self.plot.show(
            f"overlay {self._gesture}",
            said,
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

    async def picked(self, said: dict[str, Any]) -> None:
        """A click opens the recording whose curve is nearest."""
        found = self._overlay.nearest(float(said["x"]), float(said["y"])) if self._overlay is not None else ""
        if found:
            await self.desk.open(found)
