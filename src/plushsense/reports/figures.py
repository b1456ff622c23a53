"""Figures that stand alone: a confusion matrix, training curves. Each is returned, never shown."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense.core.errors import ConfigError
from plushsense.core.extras import need
from plushsense.reports.tables import row_shares, shade

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's blue and vermillion, told apart with any colour vision; the line style says the same.
_TRAIN, _VALIDATION = ("#0072b2", "-", "training"), ("#d55e00", "--", "validation")
_CELL_IN = 0.36


def _figure(width: float, height: float) -> Figure:
    """A figure outside pyplot: nothing global holds it, so no window opens and no memory stays."""
    made: Figure = need("matplotlib.figure", "reports").Figure(figsize=(width, height), layout="constrained")
    return made


def confusion(labels: Sequence[str], counts: Any, *, title: str = "") -> Figure:
    """A confusion matrix as a heat map: shade = share of the truth's row, figure = count, frame = right.

    Args:
        labels: K class names in class order.
        counts: (K, K) windows, truth in rows, prediction in columns.
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
    figure = _figure(side + longest + 0.9, side + longest + 0.9)
    axes = figure.add_subplot()
    shares = row_shares(table)
    patch = need("matplotlib.patches", "reports").Rectangle
    size = 8.0 if table.max() < 1000 else 6.5
    for i in range(k):
        for j in range(k):
            background, ink = shade(float(shares[i, j]))
            edge, width = ("#000000", 1.2) if i == j else ("#ffffff", 0.5)
            axes.add_patch(
                patch(
                    (j - 0.5, i - 0.5),
                    1,
                    1,
                    facecolor=background,
                    edgecolor=edge,
                    linewidth=width,
                    zorder=1 + (i == j),
                    clip_on=False,
                )
            )
            if table[i, j]:
                axes.text(j, i, str(int(table[i, j])), ha="center", va="center", color=ink, fontsize=size, zorder=3)
    axes.set(xlim=(-0.5, k - 0.5), ylim=(k - 0.5, -0.5), xlabel="Read as", ylabel="Truth", aspect="equal")
    # A label is a person's own text: a "$" in it is no formula.
    axes.set_xticks(range(k), labels, rotation=90, parse_math=False)
    axes.set_yticks(range(k), labels, parse_math=False)
    axes.tick_params(length=0, labelsize=9)
    for side_line in axes.spines.values():
        side_line.set_visible(False)
    if title:
        axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def training_curves(histories: Sequence[Sequence[Mapping[str, Any]]], *, title: str = "", of: str = "folds") -> Figure:
    """Loss and accuracy by epoch: a thin line a fold, a thick one for the mean of the folds still training.

    Args:
        histories: one list of epochs a fold; an epoch holds epoch, train_loss, train_accuracy,
            validation_loss, validation_accuracy (any may be missing or None).
        title: written above; may be empty.
        of: what a history is one of, for the legend.
    """
    figure = _figure(9.2, 3.4)
    left, right = figure.subplots(1, 2)
    for axes, measure, label in (
        (left, "loss", "Loss (cross-entropy, nats)"),
        (right, "accuracy", "Accuracy (share of windows)"),
    ):
        for part, (colour, style, name) in (("train", _TRAIN), ("validation", _VALIDATION)):
            lines = [line for line in (_curve(history, f"{part}_{measure}") for history in histories) if line[0].size]
            for epochs, values in lines if len(lines) > 1 else ():
                axes.plot(epochs, values, color=colour, linewidth=0.5, alpha=0.3)
            if lines:
                epochs, mean = _mean(lines)
                said = f"{name}, mean of {len(lines)} {of}" if len(lines) > 1 else name
                axes.plot(epochs, mean, style, color=colour, linewidth=2.0, label=said)
        axes.set_xlabel("Epoch")
        axes.set_ylabel(label)
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
    """Epochs and finite values of one fold."""
    points = [(epoch.get("epoch", i + 1), epoch[key]) for i, epoch in enumerate(history) if epoch.get(key) is not None]
    table = np.asarray([point for point in points if np.isfinite(point[1])], dtype=float).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _mean(lines: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
    """Mean over the folds, as far as at least half of them train: a mean of few survivors would mislead."""
    epochs = np.unique(np.concatenate([line[0] for line in lines]))
    table = np.full((len(lines), epochs.size), np.nan)
    for row, (at, values) in zip(table, lines, strict=True):
        row[np.searchsorted(epochs, at)] = values
    enough = 2 * np.isfinite(table).sum(axis=0) >= len(lines)
    return epochs[enough], np.nanmean(table[:, enough], axis=0)


def svg(figure: Figure) -> bytes:
    """A figure as SVG, letters as outlines: it asks for no font, and the same data give the same bytes."""
    with need("matplotlib", "reports").rc_context({"svg.fonttype": "path", "svg.hashsalt": "plushsense"}):
        return _saved(figure, format="svg", metadata={"Date": None, "Creator": None})


def png(figure: Figure, dpi: int = 90) -> bytes:
    """A figure as PNG; the same data give the same bytes."""
    return _saved(figure, format="png", dpi=dpi, metadata={"Software": None})


def _saved(figure: Figure, **how: Any) -> bytes:
    out = io.BytesIO()
    with warnings.catch_warnings():
        # A letter that the font lacks is drawn as a box; whoever named a gesture so can do nothing about it here.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(out, **how)
    return out.getvalue()
