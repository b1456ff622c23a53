"""Tables, figures and the page of explanations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import GRAVITY_FRACTION_BITS, MAGNITUDE_FRACTION_BITS, Layout
from plushsense.experiments.people.occlusion import Blocks, ExplainedGesture
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import Column, Table, number, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIMULATED_PEOPLE = "SIMULATION: the people are virtual; what decided for them says nothing about a real toy."
TRAINED_ON = "TRAINED ON: the bundle was trained on everybody in this data set."
# Okabe and Ito's colours; line styles differ as well.
_AXES = (("#0072b2", "-"), ("#d55e00", "-"), ("#009e73", "-"))
_CHANNELS_LISTED = 3


def gesture_table(result: Mapping[str, Any]) -> Table:
    """Return one row for each gesture: its main channels, its main moment, and the areas under the deletion curves."""
    rows = []
    for row in result["gestures"]:
        ranked = sorted(row["shares"].items(), key=lambda item: -item[1])[:_CHANNELS_LISTED]
        moment = row["decided_s"]
        rows.append(
            {
                **row,
                "people": len(row["people"]),
                "channels": "; ".join(f"{name} {percent(share, 0)}" for name, share in ranked if share > 0),
                "moment": moment and f"{number(moment[0], 2)} to {number(moment[1], 2)} s",
            }
        )
    whole = {"gesture": "mean", "area": result["area"], "area_random": result["area_random"]}
    columns = (
        Column("gesture", "Gesture"),
        Column("windows", "Windows", "count"),
        Column("people", "People", "count"),
        Column("probability", "Prob-\nability", "share", plain="probability"),
        Column("channels", "Channels that decided, share of the positive attribution"),
        Column("moment", "Highest block,\nbefore the decision", "right"),
        Column("area", "by attribution", "share", group="Area under deletion", plain="area"),
        Column("area_random", "at random", "share", group="Area under deletion", plain="area at random"),
    )
    return Table("explained", "What decided", columns, (*rows, whole))


def explanation_page(
    result: Mapping[str, Any], explained: Sequence[ExplainedGesture], layout: Layout, blocks: Blocks
) -> str:
    """Return the page of an explanation as HTML."""
    pictures = [
        (each.row["gesture"], each.row["recording"], data_uri(gesture_figure(each, layout, blocks)))
        for each in explained
    ]
    return render_page(
        "explanation.html.j2",
        title=f"What decided: {result['name']} on {result['dataset']}",
        simulated=result["simulated"],
        trained_on=TRAINED_ON if result["trained_on"] else "",
        table=gesture_table(result),
        unread=result["unread"],
        deletion=data_uri(deletion_figure(result)),
        pictures=pictures,
    )


def physical(values: NDArray[Any], layout: Layout) -> NDArray[np.float64]:
    """Return unscaled inputs (C, T) in the units of the layout's channels."""
    channels = {c.name: c for c in layout.channels}
    sizes = {name: c.step * c.scale for name, c in channels.items()}
    bits = {"magnitude": MAGNITUDE_FRACTION_BITS, "gravity": GRAVITY_FRACTION_BITS}
    sizes |= {d.name: sizes[d.of[0]] / 2 ** bits[d.kind] for d in layout.derived}
    return np.asarray(values * np.array([sizes[name] for name in layout.inputs])[:, None])


def gesture_figure(explained: ExplainedGesture, layout: Layout, blocks: Blocks) -> Figure:
    """Draw an example window, one panel for each channel or vector, above the mean attribution as a heat map."""
    row = explained.row
    signals, quiet = physical(explained.signals, layout), physical(explained.quiet, layout)
    heights = [1.5 if len(inputs) > 1 else 0.52 for inputs in blocks.inputs]
    heights.append(max(1.2, 0.5 + 0.24 * len(heights)))
    figure = new_figure(9.2, sum(heights) + 0.9)
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights, width_ratios=(1, 0.02))
    heat = figure.add_subplot(grid[-1, 0])
    seconds = (np.arange(signals.shape[1]) - signals.shape[1] + 1) / layout.rate_hz
    units = {c.name: c.unit for c in layout.channels} | {
        d.name: next(c.unit for c in layout.channels if c.name == d.of[0]) for d in layout.derived
    }
    for place, (name, inputs) in enumerate(zip(blocks.names, blocks.inputs, strict=True)):
        axes = figure.add_subplot(grid[place, 0], sharex=heat)
        for at, (colour, style) in zip(inputs, _AXES, strict=False):
            axes.plot(seconds, quiet[at], ":", color=colour, linewidth=1.0)
            axes.plot(seconds, signals[at], style, color=colour, linewidth=1.1, label=layout.inputs[at])
        _row_label(axes, f"{name}\n({units[layout.inputs[inputs[0]]]})")
        axes.tick_params(labelbottom=False, labelsize=7.5)
        axes.locator_params(axis="y", nbins=3 if len(inputs) > 1 else 2)
        axes.grid(axis="x", color="#dddddd", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        if len(inputs) > 1:
            legend = axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
            for text in legend.get_texts():
                text.set_parse_math(False)
    table = np.asarray(row["attribution"])
    most = max(float(np.abs(table).max()), 1e-6)
    edges = (blocks.starts - len(blocks.block_of)) / layout.rate_hz
    # Blue and red differ in lightness from white alike, and in hue for colour-blind readers.
    mesh = heat.pcolormesh(edges, np.arange(len(table) + 1), table, cmap="RdBu_r", vmin=-most, vmax=most)
    heat.set_yticks(np.arange(len(table)) + 0.5, blocks.names, parse_math=False)
    heat.tick_params(labelsize=8)
    heat.invert_yaxis()
    heat.set(xlim=(edges[0], 0), xlabel="Seconds before the decision")
    bar = figure.colorbar(mesh, cax=figure.add_subplot(grid[-1, 1]), ticks=(-most, 0, most), format="%.2g")
    bar.set_label("Loss of log-\nprobability (nats)", fontsize=8)
    bar.ax.tick_params(labelsize=7.5)
    title = f"{row['gesture']}: a window of {row['recording']}, and the mean attribution of {row['windows']} windows"
    figure.suptitle(title, fontsize=10).set_parse_math(False)
    return figure


def _row_label(axes: Axes, label: str) -> None:
    axes.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8, parse_math=False)


def deletion_figure(result: Mapping[str, Any]) -> Figure:
    """Draw the mean probability against the share of replaced blocks: a panel for all gestures, then for each one."""
    rows = result["gestures"]
    whole = {
        "gesture": "mean of the gestures",
        "area": result["area"],
        "area_random": result["area_random"],
        "deletion": {
            key: np.mean([row["deletion"][key] for row in rows], axis=0) for key in ("shares", "attributed", "random")
        },
    }
    panels = [whole, *rows] if len(rows) > 1 else list(rows)
    wide = min(4, len(panels))
    tall = -(-len(panels) // wide)
    figure = new_figure(2.9 * wide + 0.4, 2.3 * tall + 0.7)
    grid = figure.subplots(tall, wide, squeeze=False, sharex=True, sharey=True)
    for place, (axes, row) in enumerate(zip(grid.flat, panels, strict=False)):
        curves = row["deletion"]
        for key, colour, style, label in (
            ("attributed", "#d55e00", "-", "highest attribution first"),
            ("random", "#0072b2", "--", "random order"),
        ):
            axes.plot(100 * np.asarray(curves["shares"]), curves[key], style, color=colour, linewidth=1.6, label=label)
        axes.set_title(row["gesture"], fontsize=9, parse_math=False)
        areas = f"area {number(row['area'], 2)}; random {number(row['area_random'], 2)}"
        axes.text(98, 1.18, areas, ha="right", va="top", fontsize=7.5)
        axes.set(xlim=(0, 100), ylim=(0, 1.19))
        axes.tick_params(labelbottom=place + wide >= len(panels), labelsize=8)
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_axis_off()
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=8.5, frameon=False)
    figure.supxlabel("Blocks replaced (%)", fontsize=9)
    figure.supylabel("Mean probability of the gesture", fontsize=9)
    return figure
