"""Risk against coverage as a figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from plushsense.reports.figures import _figure
from plushsense.scoring.abstaining import RiskCoverage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours with line styles, so that any colour vision tells them apart.
_STYLES = (
    ("#0072b2", "-"),
    ("#d55e00", "--"),
    ("#009e73", "-."),
    ("#cc79a7", ":"),
    ("#e69f00", "-"),
    ("#56b4e9", "--"),
    ("#000000", "-."),
)


def curves(found: Mapping[str, RiskCoverage], *, title: str = "") -> Figure:
    """One curve a confidence, between the oracle's and chance's; the best on top of the legend."""
    figure = _figure(6.4, 4.2)
    axes = figure.add_subplot()
    ranked = sorted(found.items(), key=lambda item: item[1].area)
    first = ranked[0][1]
    axes.axhline(100 * first.random, color="#888888", linewidth=1.0, label=f"chance (area {first.random:.3f})")
    for (name, curve), (colour, style) in zip(ranked, _STYLES, strict=False):
        label = f"{name} ({curve.area:.3f}; {100 * curve.gain:.0f} % of the oracle's gain)"
        axes.plot(100 * curve.coverage, 100 * curve.risk, style, color=colour, linewidth=1.5, label=label)
    right = 1 - first.random
    coverage = np.linspace(0.001, 1, 400)
    axes.plot(
        100 * coverage,
        100 * np.maximum(coverage - right, 0) / coverage,
        color="#888888",
        linewidth=1.0,
        linestyle=(0, (1, 1)),
        label=f"oracle ({first.oracle:.3f})",
    )
    axes.set(xlim=(0, 100), ylim=(0, None), xlabel="Coverage (% of gestures answered, the surest first)")
    axes.set_ylabel("Risk (% of the answers that are wrong)")
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(0, 1.0))
    axes.set_ylim(0, 100 * max(first.random, *(float(c.risk.max()) for c in found.values())) * 1.75)
    if title:
        axes.set_title(title, fontsize=10, parse_math=False)
    return figure
