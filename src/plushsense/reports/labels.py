"""Labels of points that cover neither each other nor a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Box = tuple[float, float, float, float]
_DISTANCES_PT = (9.0, 14.0, 22.0, 32.0, 44.0, 58.0, 74.0, 92.0, 112.0)
_DIRECTIONS = tuple((float(np.cos(a)), float(np.sin(a))) for a in np.arange(16) * np.pi / 8)
_POINT_PT = 6.5
_NEAR_PT = 10.0
_GAP_PT = 2.5


@dataclass(frozen=True)
class LabelledPoint:
    """A point in data coordinates; one without a label only keeps labels away."""

    x: float
    y: float
    label: str


def place_labels(
    figure: Figure, axes: Axes, points: Sequence[LabelledPoint], *, avoid: Sequence[Box] = (), size: float = 7.5
) -> None:
    """Write the labels beside their points, the nearest free place first; a far one gets a thin line.

    ``avoid`` are straight lines in data coordinates (left, bottom, right, top) that no label may cover.
    The figure is laid out first, as places are known only then. A label that finds no free place is left out:
    the table beside the figure has it.
    """
    figure.draw_without_rendering()
    pixel = figure.dpi / 72
    at = axes.transData.transform([(p.x, p.y) for p in points]) if points else np.empty((0, 2))
    around = _POINT_PT * pixel
    taken: list[Box] = [(x - around, y - around, x + around, y + around) for x, y in at]
    for left, bottom, right, top in avoid:
        (x0, y0), (x1, y1) = axes.transData.transform([(left, bottom), (right, top)])
        taken.append((x0 - pixel, y0 - pixel, x1 + pixel, y1 + pixel))
    inside = axes.get_window_extent()
    for (x, y), point in zip(at, points, strict=True):
        if not point.label:
            continue
        text = axes.annotate(
            point.label,
            (point.x, point.y),
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=size,
            ha="center",
            va="center",
            linespacing=1.2,
            zorder=6,
            parse_math=False,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )
        text.set_in_layout(False)
        box = text.get_window_extent()
        width, height = box.width + 2 * _GAP_PT * pixel, box.height
        for distance in _DISTANCES_PT:
            found = _free(x, y, width, height, distance * pixel, taken, (inside.x0, inside.y0, inside.x1, inside.y1))
            if found is not None:
                break
        else:
            text.remove()
            continue
        centre_x, centre_y, place = found
        taken.append(place)
        text.set_position(((centre_x - x) / pixel, (centre_y - y) / pixel))
        if distance > _NEAR_PT:
            line = axes.annotate(
                "",
                (point.x, point.y),
                xytext=_nearest(place, x, y, pixel),
                textcoords="offset points",
                arrowprops={"arrowstyle": "-", "color": "#777777", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3},
                zorder=4,
            )
            line.set_in_layout(False)


def _free(
    x: float, y: float, width: float, height: float, distance: float, taken: Sequence[Box], inside: Box
) -> tuple[float, float, Box] | None:
    """Return the first free box at that distance; horizontal and vertical directions are tried first."""
    for dx, dy in sorted(_DIRECTIONS, key=lambda d: min(abs(d[0]), abs(d[1]))):
        centre_x = x + dx * (distance + width / 2)
        centre_y = y + dy * (distance + height / 2)
        box = (centre_x - width / 2, centre_y - height / 2, centre_x + width / 2, centre_y + height / 2)
        within = inside[0] <= box[0] and box[2] <= inside[2] and inside[1] <= box[1] and box[3] <= inside[3]
        if within and not any(overlap(box, other) for other in taken):
            return centre_x, centre_y, box
    return None


def overlap(one: Box, other: Box) -> bool:
    """Return whether two boxes (left, bottom, right, top) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _nearest(box: Box, x: float, y: float, pixel: float) -> tuple[float, float]:
    """Return the point of a box nearest to (x, y), as an offset in points."""
    return (min(max(x, box[0]), box[2]) - x) / pixel, (min(max(y, box[1]), box[3]) - y) / pixel
