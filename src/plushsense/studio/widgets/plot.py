"""A plot in the page, drawn by uPlot: fixed curves, or the last seconds of a live signal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nicegui.element import Element
from nicegui.events import GenericEventArguments

_VENDOR = Path(__file__).parent / "vendor" / "uplot"


class Plot(Element, component="plot.js"):
    """Curves over x, with vertical marks; one y-axis.

    Args:
        label: what a screen reader says of it.
        series: one dictionary a curve: ``label``, ``stroke`` (a colour), and optionally ``width``, ``dash``, ``points``
            (False), ``fill``, ``show``.
        x, y: axis titles with units.
        height: in pixels; the width is that of the place it stands in.
        window_s: show the last so many seconds of what `push` brings, which begins to fall off on the left.
        range_y: fixed limits of the y-axis; None: what the data need.
        values_y: whether the y-axis says its values; not where every curve has a lane of its own.
        legend: whether the curves are listed below, to be clicked on and off.
        on_pick: called with (x, "left" or "right", shift held) for every click into the plot.
    """

    def __init__(
        self,
        label: str,
        series: Sequence[dict[str, Any]],
        *,
        x: str = "",
        y: str = "",
        height: int = 240,
        window_s: float = 0.0,
        range_y: tuple[float, float] | None = None,
        values_y: bool = True,
        legend: bool = True,
        on_pick: Callable[[float, str, bool], Any] | None = None,
    ) -> None:
        super().__init__()
        self.add_resource(_VENDOR)
        self._props["label"] = label
        self._props["series"] = [dict(s) for s in series]
        self._props["xTitle"], self._props["yTitle"] = x, y
        self._props["height"] = height
        self._props["windowS"] = window_s
        self._props["rangeY"] = list(range_y) if range_y else None
        self._props["valuesY"] = values_y
        self._props["legend"] = legend
        self._props["pickable"] = on_pick is not None
        self._props["start"] = None
        self.classes("w-full")
        if on_pick is not None:

            def picked(event: GenericEventArguments) -> Any:
                return on_pick(float(event.args["x"]), str(event.args["button"]), bool(event.args["shift"]))

            self.on("pick", picked)

    def begin(
        self, x: Sequence[float], curves: Sequence[Sequence[float | None]], marks: Sequence[dict[str, Any]] = ()
    ) -> Plot:
        """Set what the plot shows when the page opens; call it while the page is being built."""
        self._props["start"] = {"data": [list(x), *map(list, curves)], "marks": list(marks)}
        return self

    def show(
        self,
        x: Sequence[float],
        curves: Sequence[Sequence[float | None]],
        marks: Sequence[dict[str, Any]] | None = None,
        series: Sequence[dict[str, Any]] | None = None,
    ) -> None:
        """Replace all curves; also the marks and the series where given. None in a curve is a hole."""
        self.run_method("show", [list(x), *map(list, curves)], marks, series)

    def push(self, x: Sequence[float], curves: Sequence[Sequence[float]]) -> None:
        """Append samples at the right end of a live plot."""
        self.run_method("push", list(x), [list(c) for c in curves])

    def lines(self, marks: Sequence[dict[str, Any]]) -> None:
        """Vertical lines: ``x``, ``label``, ``stroke``; optionally ``dash`` ([6, 4]), ``to``: shade up to there,
        and ``row``: how many lines down the label stands.
        """
        self.run_method("setMarks", list(marks))
