"""The plot of macro-F1 against network size, with the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from plushsense.scoring.metrics import pareto_front
from plushsense.studio.app.words import Words
from plushsense.studio.pages.train.results import ResultRow, score_text

# CSS variables, so that the plot follows a change between the light and the dark theme.
_INK, _DIM, _LINE, _BACKGROUND = "var(--ps-ink)", "var(--ps-dim)", "var(--ps-line)", "var(--train-page)"
_FRONT, _POINT = "#D55E00", "#0072B2"
_TICKS = (1, 2, 5)


def pareto_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Return the Pareto front of macro-F1 and parameters, the smallest network first."""
    scored = [row for row in rows if row.macro_f1 is not None]
    on_front = pareto_front([(float(row.macro_f1 or 0.0), float(row.parameters)) for row in scored])
    return sorted((row for row, best in zip(scored, on_front, strict=True) if best), key=lambda row: row.parameters)


def pareto_options(rows: Sequence[ResultRow], *, x: str, y: str, leaky: str) -> dict[str, Any]:
    """Return the options of an ECharts plot of scored rows, for its SVG renderer.

    Args:
        rows: results with a macro-F1.
        x: title of the axis of parameters, which is logarithmic.
        y: title of the axis of macro-F1.
        leaky: word added to the labels of leaky results, which are hollow diamonds.
    """
    front = pareto_rows(rows)
    ids = {row.id for row in front}
    low_x, high_x = _log_range([row.parameters for row in rows])
    bars: list[list[float | None]] = []
    for row in rows:
        if row.macro_f1_sd is not None:
            score = row.macro_f1 or 0.0
            bars += [[row.parameters, score - row.macro_f1_sd], [row.parameters, score + row.macro_f1_sd], [None, None]]
    points = [_point(row, row.id in ids, leaky, math.sqrt(low_x * high_x)) for row in rows]
    line = {"type": "line", "showSymbol": False, "silent": True, "emphasis": {"disabled": True}}
    return {
        "animation": False,
        "grid": {"left": 70, "right": 24, "top": 20, "bottom": 56},
        # Rich text is drawn, not parsed as HTML.
        "tooltip": {"renderMode": "richText", "confine": True},
        "xAxis": {
            "type": "log",
            "min": low_x,
            "max": high_x,
            "axisLabel": {"customValues": _ticks(low_x, high_x), ":formatter": _SHORT, "color": _INK},
            "axisTick": {"customValues": _ticks(low_x, high_x)},
            **_axis(x, 32),
        },
        "yAxis": {
            "type": "value",
            "scale": True,
            "axisLabel": {":formatter": "(v) => v.toFixed(2)", "color": _INK},
            **_axis(y, 48),
        },
        "series": [
            {**line, "data": bars, "lineStyle": {"color": _DIM, "width": 1.5}},
            {**line, "data": [[r.parameters, r.macro_f1] for r in front], "lineStyle": {"color": _FRONT, "width": 2}},
            {
                "type": "scatter",
                "data": points,
                "emphasis": {"disabled": True},
                "labelLayout": {"hideOverlap": True},
            },
        ],
    }


def pareto_table(w: Words, rows: Sequence[ResultRow]) -> Markup:
    """Render the data of the plot as a table, the smallest network first."""
    ids = {row.id for row in pareto_rows(rows)}
    head = Markup("").join(
        Markup('<th scope="col" class="{}">{}</th>').format(kind, title)
        for kind, title in (
            ("", w("train.columns.network")),
            ("", w("train.columns.schedule")),
            ("n", w("train.columns.parameters")),
            ("n", w("train.columns.macro_f1")),
            ("", w("train.pareto_front")),
        )
    )
    line = Markup('<tr><td>{}</td><td>{}</td><td class="n">{}</td><td class="n">{}</td><td>{}</td></tr>')
    body = Markup("").join(
        line.format(
            row.network,
            f"{row.schedule} ({w('train.leaky')})" if row.leaky else row.schedule,
            f"{row.parameters:,}",
            score_text(row.macro_f1, row.macro_f1_sd),
            "✓" if row.id in ids else "–",
        )
        for row in sorted(rows, key=lambda row: row.parameters)
    )
    return Markup('<table class="ps-table"><thead><tr>{}</tr></thead><tbody>{}</tbody></table>').format(head, body)


_SHORT = "(v) => v >= 1000 ? `${v / 1000}k` : `${v}`"


def _point(row: ResultRow, front: bool, leaky: str, middle: float) -> dict[str, Any]:
    name = f"{row.network.rpartition(' ')[0]}, {row.schedule.partition(', ')[2]}"
    if row.leaky:
        name = f"{name} ({leaky})"
    text = f"{name}: {row.parameters:,}, {score_text(row.macro_f1, row.macro_f1_sd)}"
    hollow = {"color": _BACKGROUND, "borderColor": _FRONT, "borderWidth": 2.5}
    return {
        "name": name,
        "value": [row.parameters, row.macro_f1],
        "symbol": "diamond" if row.leaky else "circle",
        # Of overlapping labels, ECharts keeps that of the larger symbol.
        "symbolSize": 13 if front else 10,
        "itemStyle": {"opacity": 1, **(hollow if row.leaky else {"color": _POINT, "borderColor": _BACKGROUND})},
        "label": {
            "show": True,
            "formatter": "{b}",
            "position": "right" if row.parameters < middle else "left",
            "minMargin": 4,
            "color": _INK,
            "fontWeight": "bold" if front else "normal",
        },
        "tooltip": {"formatter": text},
    }


def _axis(name: str, gap: int) -> dict[str, Any]:
    return {
        "name": name,
        "nameLocation": "middle",
        "nameGap": gap,
        "nameTextStyle": {"color": _INK},
        "axisLine": {"lineStyle": {"color": _DIM}},
        "splitLine": {"lineStyle": {"color": _LINE}},
    }


def _log_range(values: Sequence[int]) -> tuple[float, float]:
    """Return limits of a logarithmic axis, with a margin around the values."""
    low, high = math.log10(min(values)), math.log10(max(values))
    margin = max(0.15, 0.08 * (high - low))
    return 10 ** (low - margin), 10 ** (high + margin)


def _ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [m * 10.0**e for e in decades for m in _TICKS if low <= m * 10.0**e <= high]
