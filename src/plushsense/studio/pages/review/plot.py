"""Define the plot of the review page, which is drawn in the browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nicegui.element import Element

from plushsense.studio.app.shell import LINES

_VENDOR = Path(__file__).parents[2] / "widgets" / "vendor" / "uplot"


@dataclass(frozen=True)
class DrawingSpec:
    """Curves to plot.

    Attributes:
        id: id that is sent back with every click and key.
        label: text alternative.
        data: times in seconds, and the values of each curve.
        series: a dictionary for each curve with label, stroke and options of uPlot; ``dots`` draws points only.
        x_title, y_title: titles of the axes.
        lanes: pairs (position, name) that replace the numbers of the y-axis.
        limits: range of the y-axis.
        marks: vertical lines with ``x``, ``label``, ``stroke`` and ``dash``.
        cut: ranges (from, to) to shade because they are trimmed off, or (from, to, CSS colour, name).
        bands: areas to fill, with ``series`` (the numbers of the upper and lower curve) and ``fill``.
        keep: whether to keep the zoom if the recording is the same.
    """

    id: str
    label: str
    data: Sequence[Sequence[float | None]]
    series: Sequence[dict[str, Any]]
    x_title: str
    y_title: str = ""
    lanes: Sequence[tuple[float, str]] = ()
    limits: tuple[float, float] | None = None
    marks: Sequence[dict[str, Any]] = ()
    cut: Sequence[tuple[Any, ...]] = ()
    bands: Sequence[dict[str, Any]] = ()
    thinned: bool = False
    keep: bool = False


class ReviewPlot(Element, component="review_plot.js"):
    """Browser component that plots curves over time (in seconds) with marks, and reports clicks and keys.

    Args:
        label: text alternative while nothing is plotted.
        height: in pixels, or up to 1 as a share of the window's height.
        on_pick: called on a click with {x, y, button ("left" or "right"), shift, recording (id of the plotted one)}.
        on_key: called with {key, shift, recording}, except for keys typed into a field or a dialog.
        on_zoom: called with {low, high, recording} after zooming into thinned curves.
        on_select: called with {low, high, recording} after dragging over a range; without it, nothing can be selected.
    """

    def __init__(
        self,
        label: str,
        *,
        height: float = 330,
        legend: bool = True,
        on_pick: Callable[[dict[str, Any]], Any],
        on_key: Callable[[dict[str, Any]], Any] | None = None,
        on_zoom: Callable[[dict[str, Any]], Any] | None = None,
        on_select: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        super().__init__()
        self.add_resource(_VENDOR)
        self._props.update({"label": label, "height": height, "legend": legend, "keyed": on_key is not None})
        self._props["selects"] = on_select is not None
        self.classes("w-full")
        for event, handler in (("pick", on_pick), ("key", on_key), ("zoomed", on_zoom), ("selected", on_select)):
            if handler is not None:
                self.on(event, lambda e, handler=handler: handler(dict(e.args)))

    def show(self, drawing: DrawingSpec) -> None:
        """Replace the plotted curves."""
        self.run_method("show", vars(drawing))

    def remark(
        self, identity: str, marks: Sequence[dict[str, Any]], cut: Sequence[tuple[Any, ...]], label: str
    ) -> None:
        """Replace the marks, shaded ranges and text alternative of the plotted recording."""
        self.run_method("remark", identity, marks, cut, label)

    def zoom(self, factor: float) -> None:
        """Scale the visible range by ``factor`` around the first mark; 0 displays the whole recording."""
        self.run_method("zoom", factor)

    def look(self, low: float, high: float) -> None:
        """Display the range from ``low`` to ``high`` seconds."""
        self.run_method("look", low, high)

    def pan(self, share: float) -> None:
        """Move the visible range by a share of its length."""
        self.run_method("pan", share)


_DASHES: tuple[list[int], ...] = ([], [7, 4], [2, 3])


def curve_styles(names: Sequence[str]) -> list[dict[str, object]]:
    """Return label, colour and dashes of each curve, as `ReviewPlot.show` takes them."""
    return [
        {"label": n, "stroke": LINES[i % len(LINES)], "dash": _DASHES[i // len(LINES) % len(_DASHES)]}
        for i, n in enumerate(names)
    ]
