"""Define the view of one stream, in which a session leader labels what happens between the recordings."""

from __future__ import annotations

from typing import Any

from nicegui import background_tasks, run, ui

from plushsense.dataset.marks import HANDLING, PRACTICE, REST
from plushsense.studio.app.shell import button, icon_button, tag
from plushsense.studio.app.words import CHANNEL_KINDS, Texts
from plushsense.studio.pages.review.controller import ReviewController
from plushsense.studio.pages.review.plot import DrawingSpec, ReviewPlot, curve_styles
from plushsense.studio.pages.review.signals import ALL, RecordingSignals

_LABELS: Texts = {
    "handling": "Handling",
    "rest": "Rest",
    "remove": "Remove labels",
    "practice": "Practised gesture",
}

REMOVE = "remove"
_RECORDED = "rgba(255,193,7,0.30)"
_COLOURS = {PRACTICE: "rgba(0,128,92,0.30)", HANDLING: "rgba(213,94,0,0.20)", REST: "rgba(128,128,128,0.28)"}
_SELECTED = "rgba(10,90,148,0.30)"
_KEYS = {"p": PRACTICE, "h": HANDLING, "r": REST, "d": REMOVE}
_MOVES = {"ArrowLeft": -0.5, "ArrowRight": 0.5}
_MAX_LISTED = 100


class StreamView:
    """View of one stream: its signals, with recordings and labelled stretches shaded, and buttons that label.

    Dragging over the plot selects a stretch; so do a click (its beginning) and a Shift-click or right click (its end).
    """

    def __init__(self, desk: ReviewController) -> None:
        self.desk = desk
        self._selection: tuple[float, float] | None = None
        self._drawn: Any = None
        words, gestures = desk.words, list(desk.review.dataset.gestures.labels)
        with tag(ui.element("div").classes("ps-one w-full"), "stream") as self.place:
            with ui.column().classes("w-full ps-small-gap no-wrap"):
                with ui.row().classes("w-full items-center ps-small-gap"):
                    choice = ui.select(desk.streams, value=desk.stream or None, label=words("Stream"))
                    choice.props("outlined dense options-dense").style("min-width: 240px")
                    tag(choice, "stream-choice").on_value_change(lambda e: self._choose(str(e.value)))
                    self.about = tag(ui.label().classes("ps-dim ps-number").props("role=status"), "stream-about")
                self.plot = ReviewPlot(
                    words("Signals of the stream"),
                    height=330,
                    on_pick=self.picked,
                    on_key=self.key,
                    on_zoom=self.zoomed,
                    on_select=self.selected,
                )
                tag(self.plot, "stream-plot")
                with ui.row().classes("w-full items-center ps-small-gap"):
                    self.gesture = ui.select(
                        {g: words.gesture(g) for g in gestures},
                        value=gestures[0] if gestures else None,
                        label=words("Gesture"),
                    )
                    tag(self.gesture.props("outlined dense options-dense").style("min-width: 180px"), "practised")
                    for key, label in _KEYS.items():
                        name = label.rstrip(":")
                        text = f"{words(_LABELS[name])} ({key})"
                        button(f"label-{name}", text, lambda label=label: self.label(label)).classes("ps-act")
                    button("stream-undo", words("Undo"), desk.undo).classes("ps-act")
                    for icon, text, factor in (("zoom_in", "Zoom in", 0.5), ("zoom_out", "Zoom out", 2.0)):
                        icon_button(icon, words(text), lambda f=factor: self.plot.zoom(f)).classes("ps-act")
                    for icon, text, share in (("chevron_left", "Earlier", -0.5), ("chevron_right", "Later", 0.5)):
                        icon_button(icon, words(text), lambda s=share: self.plot.pan(s)).classes("ps-act")
                about = words(
                    "Drag over a stretch between the recordings, or click its beginning and Shift-click its end; then "
                    "press a button or its key. Keys: + − 0 zoom, ← → move, u undoes, Esc clears the selection."
                )
                ui.label(about).classes("ps-dim")
            with ui.column().classes("w-full ps-small-gap"):
                ui.label(words("Labelled stretches")).classes("text-bold")
                self.names = tag(ui.column().classes("w-full ps-no-gap"), "stretches")

    # Drawing ------------------------------------------------------------------------------------------------------

    def draw(self) -> None:
        """Plot the stream of the controller, reading it in the background."""
        self._drawn = None
        background_tasks.create(self._show(), name="review: stream")

    async def _show(self, low: float | None = None, high: float | None = None) -> None:
        desk, words, stream = self.desk, self.desk.words, self.desk.stream
        with desk.page.show_errors():
            signals = await run.io_bound(desk.review.stream_signals, stream)
            if signals is None or stream != desk.stream:
                return
            plotted = signals.curves(ALL, low, high)
            lanes = [(at, words(CHANNEL_KINDS.get(kind, kind))) for at, kind in plotted.lanes]
            drawing = DrawingSpec(
                stream,
                self._about(signals),
                [plotted.x, *plotted.curves],
                curve_styles([words.channel(n) for n in plotted.names]),
                x_title=words("Seconds of the stream"),
                y_title=words("Value ({unit})", unit=words.unit(plotted.unit)) if plotted.unit else "",
                lanes=lanes,
                limits=plotted.limits,
                cut=self._shaded(signals),
                thinned=plotted.thinned or low is not None,
                keep=low is not None,
            )
            self.plot.show(drawing)
            self._drawn = None
            self._update(signals)

    def refresh(self) -> None:
        """Update the shaded stretches and their list after labels or recordings have changed."""
        signals = self.desk.review.stream_if_read(self.desk.stream)
        if signals is not None:
            self._update(signals)

    def _update(self, signals: RecordingSignals) -> None:
        shaded = self._shaded(signals)
        if shaded == self._drawn:
            return
        self._drawn = shaded
        self.about.set_text(self._about(signals))
        self.plot.remark(signals.info.id, (), shaded, self._about(signals))
        desk, at = self.desk, signals.seconds
        stretches = desk.review.stretches(signals.info.id)
        self.names.clear()
        with self.names:
            if not stretches:
                ui.label(desk.words("Nothing is labelled yet.")).classes("ps-dim")
            for s in stretches[:_MAX_LISTED]:
                first, last = float(at[s.start]), float(at[s.stop])
                text = f"{desk.words.number(first, 2)} – {desk.words.number(last, 2)} s: {self._name(s.label)}"
                look = button("", text, lambda a=first, b=last: self.plot.look(a - 3, b + 3), "flat dense align=left")
                look.style("text-align: left")
            if len(stretches) > _MAX_LISTED:
                ui.label(desk.words("and {n} more", n=len(stretches) - _MAX_LISTED)).classes("ps-dim")

    def _name(self, label: str) -> str:
        words = self.desk.words
        if label.startswith(PRACTICE):
            return f"{words(_LABELS['practice'])}: {words.gesture(label.removeprefix(PRACTICE))}"
        return words(_LABELS[label])

    def _about(self, signals: RecordingSignals) -> str:
        words, review = self.desk.words, self.desk.review
        n = len(review.stretches(signals.info.id))
        text = words("{seconds} s · labelled stretches: {n}", seconds=words.number(signals.seconds[-1], 0), n=n)
        if self._selection is None:
            return text
        low, high = (words.number(each, 2) for each in self._selection)
        return f"{text} · {words('selected {start} to {stop} s', start=low, stop=high)}"

    def _shaded(self, signals: RecordingSignals) -> list[tuple[float, float, str, str]]:
        """Return the ranges to shade: recordings, labelled stretches and the selection."""
        review, words, at = self.desk.review, self.desk.words, signals.seconds
        out = []
        for r in review.recordings_in(signals.info.id):
            first, last = r.stream_row + r.start, min(r.stream_row + r.stop, len(at) - 1)
            out.append((float(at[first]), float(at[last]), _RECORDED, words.gesture(r.gesture)))
        for s in review.stretches(signals.info.id):
            colour = _COLOURS[PRACTICE if s.gesture else s.label]
            name = f"({words.gesture(s.gesture)})" if s.gesture else self._name(s.label)
            out.append((float(at[s.start]), float(at[s.stop]), colour, name))
        if self._selection is not None:
            out.append((*self._selection, _SELECTED, ""))
        return out

    # Commands -----------------------------------------------------------------------------------------------------

    async def _choose(self, stream: str) -> None:
        self.desk.stream, self._selection = stream, None
        self.draw()
        self.desk.update_address()

    async def key(self, event: dict[str, Any]) -> None:
        """Handle a key that was pressed while the stream ``event["recording"]`` was displayed."""
        key = str(event["key"])
        if key == "u":
            await self.desk.undo()
        elif key in _MOVES:
            self.plot.pan(_MOVES[key])
        elif event["recording"] != self.desk.stream:
            return
        elif key == "Escape":
            self._select(None)
        elif key in _KEYS:
            await self.label(_KEYS[key])

    def selected(self, event: dict[str, Any]) -> None:
        """Select the range that was dragged over."""
        if event["recording"] == self.desk.stream:
            self._select((float(event["low"]), float(event["high"])))

    def picked(self, event: dict[str, Any]) -> None:
        """Set the beginning of the selection to a click, or its end to a Shift-click or right click."""
        if event["recording"] != self.desk.stream:
            return
        at, ends = float(event["x"]), bool(event["shift"]) or event["button"] == "right"
        first, last = self._selection or (at, at)
        self._select((min(first, at), at) if ends else (at, max(last, at)))

    def _select(self, selection: tuple[float, float] | None) -> None:
        self._selection = selection
        self.refresh()

    async def label(self, label: str) -> None:
        """Label the selected stretch, or remove its labels, and clear the selection."""
        desk, stream = self.desk, self.desk.stream
        signals = desk.review.stream_if_read(stream)
        if signals is None:
            return
        start, stop = (signals.row_at(each) for each in self._selection or (0.0, 0.0))
        if start == stop:
            desk.page.say(desk.words("Select a stretch first: drag over the plot."), "warning")
            return
        kind = f"{PRACTICE}{self.gesture.value}" if label == PRACTICE else "" if label == REMOVE else label
        if await desk.mark(lambda: desk.review.label(desk.visit, stream, (start, stop), kind, desk.name)):
            self._select(None)

    async def zoomed(self, event: dict[str, Any]) -> None:
        """Plot a thinned stream again, with all rows of the visible range."""
        if event["recording"] == self.desk.stream:
            await self._show(float(event["low"]), float(event["high"]))
