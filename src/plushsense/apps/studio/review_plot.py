"""The plot of the review page, drawn by uPlot: a recording with its marks, or a gesture's recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nicegui.element import Element
from nicegui.events import GenericEventArguments

_VENDOR = Path(__file__).parent / "vendor" / "uplot"


class ReviewPlot(Element, component="review_plot.js"):
    """Curves over seconds with marks; tells clicks and, where it is ``keyed``, the keys of the page.

    Args:
        label: what a screen reader says of it while nothing is shown.
        on_pick: called with {x, y, button ("left", "right"), shift, shown (the id of what was on screen)}.
        on_key: called with {key, shift, shown}; keys typed into a field or a dialog are not told.
        on_zoom: called with {low, high, shown} where what was drawn had been thinned.
    """

    def __init__(
        self,
        label: str,
        *,
        height: int = 330,
        legend: bool = True,
        on_pick: Callable[[dict[str, Any]], Any],
        on_key: Callable[[dict[str, Any]], Any] | None = None,
        on_zoom: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__()
        self.add_resource(_VENDOR)
        self._props["label"] = label
        self._props["height"] = height
        self._props["legend"] = legend
        self._props["keyed"] = on_key is not None
        self.classes("w-full")
        for event, told in (("pick", on_pick), ("key", on_key), ("zoomed", on_zoom)):
            if told is not None:
                self.on(event, _with_args(told))

    def show(
        self,
        identity: str,
        label: str,
        x: Sequence[float],
        curves: Sequence[Sequence[float | None]],
        series: Sequence[dict[str, Any]],
        *,
        x_title: str,
        y_title: str = "",
        lanes: Sequence[tuple[float, str]] = (),
        limits: tuple[float, float] | None = None,
        marks: Sequence[dict[str, Any]] = (),
        cut: Sequence[tuple[float, float]] = (),
        thinned: bool = False,
        keep: bool = False,
    ) -> None:
        """Draw something else.

        Args:
            identity: comes back with every click and key. ``label``: for screen readers.
            lanes: (position, name) instead of numbers on the y-axis. ``limits``: of the y-axis.
            marks: vertical lines: ``x``, ``label``, ``stroke``, ``dash``. ``cut``: (from, to), shaded.
            keep: whether the zoom stays, where it is the same recording.
        """
        payload = {
            "id": identity,
            "label": label,
            "data": [x, *curves],
            "series": list(series),
            "xTitle": x_title,
            "y": y_title,
            "lanes": [list(lane) for lane in lanes],
            "range": list(limits) if limits else None,
            "marks": list(marks),
            "cut": [list(c) for c in cut],
            "from": x[0] if x else 0.0,
            "thinned": thinned,
            "keep": keep,
        }
        self.run_method("show", payload)

    def remark(
        self, identity: str, marks: Sequence[dict[str, Any]], cut: Sequence[tuple[float, float]], label: str
    ) -> None:
        """Move the marks of what is shown."""
        self.run_method("remark", identity, list(marks), [list(c) for c in cut], label)

    def zoom(self, factor: float) -> None:
        """0.5: show half of it, around the first mark; 0: the whole."""
        self.run_method("zoom", factor)


def _with_args(told: Callable[[dict[str, Any]], Any]) -> Callable[[GenericEventArguments], Any]:
    return lambda event: told(dict(event.args))
