"""Define the views of all recordings of a gesture: their overlay, and their durations."""

from __future__ import annotations

from typing import Any

import numpy as np
from nicegui import ui

from plushsense.dataset.statistics import DurationBand, duration_bands
from plushsense.studio.app.shell import LINES, address, button, tag
from plushsense.studio.app.words import in_context
from plushsense.studio.pages.review.controller import DURATIONS, ReviewController
from plushsense.studio.pages.review.plot import DrawingSpec, ReviewPlot
from plushsense.studio.pages.review.signals import GestureOverlay
from plushsense.studio.widgets.elements import link, table

_MAX_OUTLIERS = 30
_GREY = "#8a9099"


class GestureOverlayView:
    """View that overlays the recordings of one gesture; a click on a curve or a name opens the recording."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self._overlay: GestureOverlay | None = None
        self._drawn: Any = None
        words, labels = desk.words, desk.review.gestures()
        self._gesture = desk.filter.gesture or (labels[0] if labels else "")
        with tag(ui.element("div").classes("ps-two w-full"), "overlay") as self.place:
            with ui.column().classes("w-full ps-small-gap no-wrap"):
                self.choice = ui.select(
                    {g: words.gesture(g) for g in labels},
                    value=self._gesture if self._gesture in labels else None,
                    label=words("Gesture"),
                    on_change=lambda e: self._choose(str(e.value)),
                )
                tag(self.choice.props("options-dense").style("min-width: 260px"), "overlay-gesture")
                self.summary = tag(ui.label().props("role=status"), "overlay-summary")
                self.plot = ReviewPlot(
                    words("Overlay of the recordings of one gesture"), height=420, legend=False, on_pick=self.picked
                )
                tag(self.plot, "overlay-plot")
                about = words(
                    "Click a curve or a name to open the recording. Excluded recordings are left out, and trims are "
                    "applied."
                )
                ui.label(about).classes("ps-dim")
            with ui.column().classes("w-full ps-small-gap"):
                ui.label(words("Outliers")).classes("text-bold")
                self.names = tag(ui.column().classes("w-full ps-no-gap"), "outliers")

    async def _choose(self, gesture: str) -> None:
        self._gesture = gesture
        self.draw()

    def draw(self) -> None:
        """Plot the gesture; if the filter specifies a gesture, switch to that one."""
        desk = self.desk
        if desk.filter.gesture and desk.filter.gesture != self._gesture:
            self._gesture = desk.filter.gesture
            self.choice.value = self._gesture
        self._drawn = None
        self.refresh()

    def refresh(self) -> None:
        """Plot the gesture again if its recordings or the filter have changed."""
        desk, words = self.desk, self.desk.words
        overlay = desk.review.overlay(self._gesture)
        fitting = set(desk.order) if desk.filter.query() or desk.only is not None else None
        now = (self._gesture, [(c.recording, c.seconds, c.why) for c in overlay.drawn], fitting)
        if now == self._drawn:
            return
        self._drawn, self._overlay = now, overlay
        outliers = [c for c in overlay.drawn if c.why]
        colours = {c.recording: LINES[i % len(LINES)] for i, c in enumerate(outliers)}
        series, curves = [], []
        for c, heights in zip(overlay.drawn, overlay.curves, strict=True):
            if c.why:
                look = {"label": c.recording, "stroke": colours[c.recording], "width": 2}
            else:
                faint = len(overlay.drawn) > 40 or (fitting is not None and c.recording not in fitting)
                look = {"label": c.recording, "stroke": f"{_GREY}{'66' if faint else 'cc'}", "width": 1}
            series.append(look)
            curves.append([None if np.isnan(v) else round(float(v), 3) for v in heights])
        gesture = words.gesture(self._gesture)
        summary = words(
            "{gesture}: recordings {n}, outliers {odd}.", n=len(overlay.drawn), odd=len(outliers), gesture=gesture
        )
        self.summary.set_text(summary if overlay.drawn else words("There is nothing to draw yet."))
        drawing = DrawingSpec(
            f"overlay {self._gesture}",
            summary,
            [np.round(overlay.x, 4).tolist(), *curves],
            series,
            x_title=words("Seconds (grey: outside the recording)"),
            y_title=words("Deviation from rest (1 = usual)"),
            limits=(0.0, overlay.top),
        )
        self.plot.show(drawing)
        self.names.clear()
        with self.names:
            if not outliers:
                ui.label(words("There are no outliers.")).classes("ps-dim")
            for c in outliers[:_MAX_OUTLIERS]:
                with ui.row().classes("items-center no-wrap w-full"):
                    dash = ui.element("span").classes("ps-dash").style("width: 22px; height: 4px; flex: none")
                    dash.style(f"background: {colours[c.recording]}")
                    text = f"{c.recording}: {', '.join(words.check(check) for check in c.why.split(', '))}"
                    name = button("", text, lambda c=c: desk.open(c.recording), "flat dense align=left")
                    name.style("overflow-wrap: anywhere; text-align: left").classes("flex-grow")
            if len(outliers) > _MAX_OUTLIERS:
                ui.label(words("and {n} more: filter by the check", n=len(outliers) - _MAX_OUTLIERS)).classes("ps-dim")

    async def picked(self, event: dict[str, Any]) -> None:
        """Open the recording whose curve is nearest to the click."""
        if self._overlay is not None and (nearest := self._overlay.nearest(float(event["x"]), float(event["y"]))):
            await self.desk.open(nearest)


_INSIDE, _OUTSIDE = "#0072B2", "#D55E00"
_PAPER_PERCENT = 40


class DurationsView:
    """View of how long the recordings of a gesture last, with the band around their mean, as in Fig. 3 of the paper."""

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self._gesture = desk.filter.gesture
        self._percent = _PAPER_PERCENT
        self._band: DurationBand | None = None
        self._drawn: Any = None
        words = desk.words
        with tag(ui.element("div").classes("ps-two w-full"), "durations") as self.place:
            with ui.column().classes("w-full ps-small-gap no-wrap"):
                with ui.row().classes("w-full items-center ps-small-gap"):
                    self.choice = ui.select([], label=words("Gesture"), on_change=lambda e: self._choose(e.value))
                    tag(self.choice.props("options-dense").style("min-width: 220px"), "durations-gesture")
                    share = ui.number(
                        words("Band around the mean: ±"), value=_PAPER_PERCENT, min=5, max=200, step=5, format="%.0f"
                    )
                    share.props('suffix="%"').style("width: 210px").on_value_change(lambda e: self._resize(e.value))
                    tag(share, "band")
                self.summary = tag(ui.label().props("role=status"), "durations-summary")
                plot = ReviewPlot(
                    words("Durations of the recordings of one gesture"), height=380, legend=False, on_pick=self.picked
                )
                self.plot = tag(plot, "durations-plot")
                about = words(
                    "The line is the mean, the shaded band the durations that differ from it by no more than the "
                    "percentage. Click a point or a name to open the recording."
                )
                ui.label(about).classes("ps-dim")
            with ui.column().classes("w-full ps-small-gap"):
                ui.label(words("Outliers")).classes("text-bold")
                select = button("select-outliers", "", self._select, "outline")
                self.select = select.classes("ps-act")
                self.names = tag(ui.column().classes("w-full ps-no-gap"), "duration-outliers")
        self.all = ui.column().classes("w-full")
        self.all.move(self.place)

    def draw(self) -> None:
        """Plot the gesture; if the filter specifies a gesture, switch to that one."""
        if self.desk.filter.gesture:
            self._gesture = self.desk.filter.gesture
        self._drawn = None
        self.refresh()

    def refresh(self) -> None:
        """Plot the durations again if the recordings have changed."""
        desk = self.desk
        now = (desk.review.version, self._gesture, self._percent)
        if now == self._drawn:
            return
        self._drawn = now
        bands = {b.gesture: b for b in duration_bands(desk.review.as_marked(), self._percent / 100)}
        if self._gesture not in bands:
            self._gesture = next(iter(bands), "")
        self.choice.set_options({g: desk.words.gesture(g) for g in bands}, value=self._gesture or None)
        self._band = bands.get(self._gesture)
        self._plot()
        self._list()
        self._fill_table(bands)

    def _choose(self, gesture: str | None) -> None:
        if gesture and gesture != self._gesture:
            self._gesture = gesture
            self.refresh()

    def _resize(self, percent: float | None) -> None:
        if percent is not None and percent > 0:
            self._percent = int(percent)
            self.refresh()

    def _plot(self) -> None:
        words, band = self.desk.words, self._band
        if band is None:
            self.summary.set_text(words("There is nothing to draw yet."))
            return
        n, outliers = len(band.seconds), set(band.outliers)
        summary = words(
            "Recordings: {n}. Mean {mean} s, median {median} s, standard deviation {sd} s, from {least} s to {most} "
            "s. Outside the band: {odd}.",
            n=n,
            odd=len(outliers),
            **_numbers(self.desk, band),
        )
        self.summary.set_text(summary)
        seconds = [(s, i in outliers) for i, s in band.seconds.items()]
        points = [[s if odd is out else None for s, odd in seconds] for out in (False, True)]
        lines = [[value] * n for value in (band.mean_s, band.low_s, band.high_s)]
        drawing = DrawingSpec(
            f"durations {band.gesture}",
            summary,
            [list(range(1, n + 1)), *points, *lines],
            [
                {"label": "", "stroke": _INSIDE, "dots": True},
                {"label": "", "stroke": _OUTSIDE, "dots": True},
                {"label": "", "stroke": _GREY, "width": 2},
                *({"label": "", "stroke": _GREY, "width": 1, "dash": [6, 4]} for _ in range(2)),
            ],
            x_title=words("Recordings, in the order of recording"),
            y_title=words("Duration (s)"),
            limits=(0.0, 1.08 * max(band.high_s, band.statistics.max)),
            bands=[{"series": [5, 4], "fill": "rgba(0,114,178,0.14)"}],
        )
        self.plot.show(drawing)

    def _list(self) -> None:
        words, band = self.desk.words, self._band
        outliers = band.outliers if band is not None else []
        self.select.set_visibility(bool(outliers))
        self.select.set_text(words("Select all outliers ({n})", n=len(outliers)))
        self.names.clear()
        with self.names:
            if not outliers:
                ui.label(words("There are no outliers.")).classes("ps-dim")
            for i in outliers[:_MAX_OUTLIERS]:
                text = f"{i}: {words.number(band.seconds[i], 2) if band else ''} s"
                name = button("", text, lambda i=i: self.desk.open(i), "flat dense align=left")
                name.style("overflow-wrap: anywhere; text-align: left").classes("w-full")
            if len(outliers) > _MAX_OUTLIERS:
                ui.label(words("and {n} more", n=len(outliers) - _MAX_OUTLIERS)).classes("ps-dim")

    def _fill_table(self, bands: dict[str, DurationBand]) -> None:
        desk, words = self.desk, self.desk.words
        rows = []
        for gesture, band in bands.items():
            to = address("review", dataset=desk.review.path, view=DURATIONS, gesture=gesture)
            numbers = _numbers(desk, band)
            gesture_link, count = link(words.gesture(gesture), to), str(len(band.seconds))
            rows.append((gesture_link, count, *numbers.values(), str(len(band.outliers))))
        head = words.each("Gesture", "Number", "Mean", "Median", "Standard deviation", "Shortest", "Longest")
        head.append(words(in_context("column", "Outliers")))
        self.all.clear()
        with self.all:
            caption = words("Durations of all gestures, in seconds")
            tag(table(caption, head, rows, range(1, len(head))), "durations-table")

    async def picked(self, event: dict[str, Any]) -> None:
        """Open the recording whose point is nearest to the click."""
        if self._band is not None:
            ids = list(self._band.seconds)
            await self.desk.open(ids[min(max(round(float(event["x"])) - 1, 0), len(ids) - 1)])

    async def _select(self) -> None:
        if self._band is not None:
            await self.desk.select(self._band.outliers)


def _numbers(desk: ReviewController, band: DurationBand) -> dict[str, str]:
    """Return the statistics of a gesture as texts in seconds."""
    all_of_it, number = band.statistics, desk.words.number
    return {
        "mean": number(band.mean_s, 2),
        "median": number(all_of_it.median, 2),
        "sd": number((all_of_it.variance or 0.0) ** 0.5, 2),
        "least": number(all_of_it.min, 2),
        "most": number(all_of_it.max, 2),
    }
