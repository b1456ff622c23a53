"""Figures that several reports share, their file formats, shades for tables, and labels of points.

This module places labels itself, because adjustText needs SciPy, may leave overlaps and cannot leave a label out.
"""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, need

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's blue and vermillion, which colour-blind readers can distinguish; line styles differ as well.
_TRAIN, _VALIDATION = ("#0072b2", "-", "training"), ("#d55e00", "--", "validation")
_CELL_IN = 0.36


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, without pyplot, which would open a window and keep a reference."""
    figure: Figure = need("matplotlib.figure", "reports").Figure(figsize=(width, height), layout="constrained")
    return figure


def confusion(labels: Sequence[str], counts: Any, *, title: str = "") -> Figure:
    """Draw a confusion matrix as a heat map. The shade is the share in the row; frames mark correct predictions.

    Args:
        labels: K class names in class order.
        counts: (K, K) numbers of windows, true classes in rows, predicted ones in columns.
        title: written above; may be empty.

    Raises:
        ConfigError: when the counts are not K × K.
    """
    table = np.asarray(counts)
    k = len(labels)
    if table.shape != (k, k) or k == 0:
        raise ConfigError(f"A confusion matrix of {k} labels needs {k} × {k} counts (at least 1), not {table.shape}.")
    longest = max(len(label) for label in labels) * 0.085
    side = max(k * _CELL_IN, 2.0)
    figure = new_figure(side + longest + 0.9, side + longest + 0.9)
    axes = figure.add_subplot()
    shades = [[shade(float(share)) for share in row] for row in row_shares(table)]
    patch = need("matplotlib.patches", "reports").Rectangle
    size = 8.0 if table.max() < 1000 else 6.5
    for i, j in product(range(k), range(k)):
        background, ink = shades[i][j]
        edge = {"edgecolor": "#000000", "linewidth": 1.2} if i == j else {"edgecolor": "#ffffff", "linewidth": 0.5}
        cell = patch((j - 0.5, i - 0.5), 1, 1, facecolor=background, zorder=1 + (i == j), clip_on=False, **edge)
        axes.add_patch(cell)
        if table[i, j]:
            axes.text(j, i, str(int(table[i, j])), ha="center", va="center", color=ink, fontsize=size, zorder=3)
    axes.set(xlim=(-0.5, k - 0.5), ylim=(k - 0.5, -0.5), xlabel="Read as", ylabel="Truth", aspect="equal")
    # Labels are user text, in which "$" must not start a formula.
    axes.set_xticks(range(k), labels, rotation=90, parse_math=False)
    axes.set_yticks(range(k), labels, parse_math=False)
    axes.tick_params(length=0, labelsize=9)
    for side_line in axes.spines.values():
        side_line.set_visible(False)
    if title:
        axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def training_curves(histories: Sequence[Sequence[Mapping[str, Any]]], *, title: str = "", of: str = "folds") -> Figure:
    """Draw loss and accuracy by epoch: thin lines for folds, a thick one for the mean of the folds still training.

    Args:
        histories: a list of epochs for each fold; an epoch is a mapping with epoch, train_loss, train_accuracy,
            validation_loss, and as accuracy of validation ``accuracy`` or validation_accuracy (any may be missing).
        title: written above; may be empty.
        of: plural noun for the histories in the legend.
    """
    figure = new_figure(9.2, 3.4)
    left, right = figure.subplots(1, 2)
    for axes, measure, y_label in (
        (left, "loss", "Loss (cross-entropy, nats)"),
        (right, "accuracy", "Accuracy (share of windows)"),
    ):
        for part, (colour, style, name) in (("train", _TRAIN), ("validation", _VALIDATION)):
            key = f"{part}_{measure}"
            if key == "validation_accuracy" and any("accuracy" in row for history in histories for row in history):
                key = "accuracy"
            lines = [line for line in (_curve(history, key) for history in histories) if line[0].size]
            for epochs, values in lines if len(lines) > 1 else ():
                axes.plot(epochs, values, color=colour, linewidth=0.5, alpha=0.3)
            if lines:
                epochs, mean = _mean(lines)
                label = f"{name}, mean of {len(lines)} {of}" if len(lines) > 1 else name
                axes.plot(epochs, mean, style, color=colour, linewidth=2.0, label=label)
        axes.set_xlabel("Epoch")
        axes.set_ylabel(y_label)
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.get_major_locator().set_params(integer=True)
        if axes.lines:
            axes.legend(fontsize=8, frameon=False)
    left.set_ylim(bottom=0)
    right.set_ylim(0, 1)
    if title:
        figure.suptitle(title, fontsize=10).set_parse_math(False)
    return figure


def _curve(history: Sequence[Mapping[str, Any]], key: str) -> tuple[Any, Any]:
    """Return the epochs and the values of ``key`` in one fold, without values that are missing or not finite."""
    points = [(epoch.get("epoch", i + 1), epoch[key]) for i, epoch in enumerate(history) if epoch.get(key) is not None]
    table = np.asarray([point for point in points if np.isfinite(point[1])], dtype=float).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _mean(lines: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
    """Return the epochs that at least half of the folds have, and the means there; a mean of fewer would mislead."""
    epochs = np.unique(np.concatenate([line[0] for line in lines]))
    table = np.full((len(lines), epochs.size), np.nan)
    for row, (at, values) in zip(table, lines, strict=True):
        row[np.searchsorted(epochs, at)] = values
    enough = 2 * np.isfinite(table).sum(axis=0) >= len(lines)
    return epochs[enough], np.nanmean(table[:, enough], axis=0)


def svg(figure: Figure) -> bytes:
    """Return a figure as SVG with text as outlines, so that it needs no font; equal data give equal bytes."""
    with need("matplotlib", "reports").rc_context({"svg.fonttype": "path", "svg.hashsalt": "plushsense"}):
        return _saved(figure, format="svg", metadata={"Date": None, "Creator": None})


def png(figure: Figure, dpi: int = 90) -> bytes:
    """Return a figure as PNG; equal data give equal bytes."""
    return _saved(figure, format="png", dpi=dpi, metadata={"Software": None})


def data_uri(figure: Figure) -> str:
    """Return a figure as a data URI of its SVG, for embedding in a page."""
    return svg_uri(svg(figure))


def svg_uri(content: bytes) -> str:
    """Return SVG as a data URI."""
    return "data:image/svg+xml;base64," + base64.b64encode(content).decode("ascii")


def _saved(figure: Figure, **options: Any) -> bytes:
    out = io.BytesIO()
    with warnings.catch_warnings():
        # A character that is not in the font is drawn as a box; the user can do nothing about the warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(out, **options)
    return out.getvalue()


# The ends of a single-hue scale (ColorBrewer "Blues"), whose order is that of lightness, so that it works in grey and
# with any colour vision. Cells also show the count. White text has the higher contrast from a share of 0.7 on.
_LIGHT, _DARK = (247, 251, 255), (8, 64, 129)
_WHITE_TEXT_FROM = 0.7


def shade(share: float) -> tuple[str, str]:
    """Return background and text colour (CSS) for a share from 0 to 1, with a contrast of at least 4.5 : 1."""
    share = min(max(share, 0.0), 1.0)
    rgb = tuple(round(a + (b - a) * share) for a, b in zip(_LIGHT, _DARK, strict=True))
    return "#{:02x}{:02x}{:02x}".format(*rgb), "#ffffff" if share > _WHITE_TEXT_FROM else "#000000"


def row_shares(counts: NDArray[Any]) -> NDArray[np.float64]:
    """Divide each row of a confusion matrix (K, K) by its sum; a row without windows stays zero."""
    table = np.asarray(counts, dtype=np.float64)
    totals = table.sum(axis=1, keepdims=True)
    shares = np.zeros_like(table)
    np.divide(table, totals, out=shares, where=totals > 0)
    return shares


# Places of a label around its point: the horizontal and vertical ones of each distance are tried first.
_DIRECTIONS = sorted(
    ((float(np.cos(a)), float(np.sin(a))) for a in np.arange(16) * np.pi / 8), key=lambda d: min(abs(d[0]), abs(d[1]))
)
_DISTANCES_PT = (9.0, 14.0, 22.0, 32.0, 44.0, 58.0, 74.0, 92.0, 112.0)
_POINT_PT, _GAP_PT = 6.5, 2.5
_LABEL: dict[str, Any] = {
    "bbox": {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
    "arrowprops": {"arrowstyle": "-", "color": "#777777", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 5},
    "ha": "center",
    "va": "center",
    "linespacing": 1.2,
    "zorder": 6,
    "parse_math": False,
}


@dataclass(frozen=True)
class LabelledPoint:
    """A point in data coordinates with its label, or "" if it has none but must not be covered by others."""

    x: float
    y: float
    label: str


def place_labels(
    figure: Figure,
    axes: Axes,
    points: Sequence[LabelledPoint],
    *,
    avoid: Sequence[tuple[float, float, float, float]] = (),
    size: float = 7.5,
) -> None:
    """Write labels beside their points, each at the nearest place where it covers neither a point nor a label.

    A thin line connects a label with its point. A label for which there is no free place is left out; the table beside
    the figure contains it.

    Args:
        avoid: straight lines in data coordinates (left, bottom, right, top) that no label may cover.
        size: font size in points.
    """
    from matplotlib.transforms import Bbox

    # Compute the layout, which determines the positions in pixels.
    figure.draw_without_rendering()
    pixel = figure.dpi / 72
    at = axes.transData.transform([(p.x, p.y) for p in points]) if points else np.empty((0, 2))
    taken = [Bbox.from_bounds(x, y, 0, 0).padded(_POINT_PT * pixel) for x, y in at]
    for left, bottom, right, top in avoid:
        taken.append(Bbox(axes.transData.transform([(left, bottom), (right, top)])).padded(pixel))
    inside = axes.get_window_extent()
    for (x, y), point in zip(at, points, strict=True):
        if not point.label:
            continue
        place = (point.x, point.y)
        text = axes.annotate(point.label, place, (0, 0), textcoords="offset points", fontsize=size, **_LABEL)
        text.set_in_layout(False)  # `constrained` layout must not make room for it
        extent = text.get_window_extent()
        width, height = extent.width + 2 * _GAP_PT * pixel, extent.height
        for distance, (dx, dy) in product(_DISTANCES_PT, _DIRECTIONS):
            middle_x, middle_y = x + dx * (distance * pixel + width / 2), y + dy * (distance * pixel + height / 2)
            box = Bbox.from_bounds(middle_x - width / 2, middle_y - height / 2, width, height)
            within = inside.x0 <= box.x0 and box.x1 <= inside.x1 and inside.y0 <= box.y0 and box.y1 <= inside.y1
            if within and not box.count_overlaps(taken):
                taken.append(box)
                text.set_position(((middle_x - x) / pixel, (middle_y - y) / pixel))
                break
        else:
            text.remove()
