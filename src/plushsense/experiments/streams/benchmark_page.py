"""Figures, tables and page of the continuous benchmark: recall against false events, and latency."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from plushsense.core.errors import need
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import DASH, Column, Table, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from plushsense.experiments.streams.score import BenchmarkResult

# Okabe and Ito's colours; marker and line style distinguish the systems without colour.
_LOOKS: dict[str, tuple[str, str, str]] = {
    "argmax": ("#999999", ":", "v"),
    "smoothed": ("#000000", "-", "o"),
    "hysteresis": ("#0072b2", "-", "s"),
    "hybrid": ("#56b4e9", "--", "D"),
    "anywhere-smoothed": ("#e69f00", ":", "^"),
    "anywhere": ("#d55e00", "-", "P"),
    "full": ("#cc79a7", "--", "X"),
}
_OTHER = ("#009e73", "-.", "*")
_LONGEST_S = 4.0
SETTINGS = {
    "plain": "no threshold",
    "balanced": "highest F1 on the tuning people",
    "prompt": "quickest with an F1 at most 0.05 lower",
    "quiet": "highest F1 with at most 60 false events an hour",
    "cheapest": "lowest cost on the tuning people",
}


def curves(result: BenchmarkResult) -> Figure:
    """Draw false events per hour against recall for every system; a star marks a system without its threshold."""
    figure = new_figure(8.6, 6.0)
    axes = figure.add_subplot()
    for name, system in result.systems.items():
        colour, style, marker = _LOOKS.get(name, _OTHER)
        points = sorted({(p["recall"], p["false_events_per_hour"]) for p in system["curve"]})
        drawn = [(r, f) for r, f in points if f > 0]
        axes.plot(
            [r for r, _ in drawn],
            [f for _, f in drawn],
            style,
            color=colour,
            marker=marker,
            markersize=5,
            linewidth=1.6,
            label=system["title"],
        )
        if "plain" in system and system["plain"]["recall"] is not None:
            axes.plot(
                system["plain"]["recall"],
                max(system["plain"]["false_events_per_hour"], 1e-3),
                "*",
                color=colour,
                markersize=13,
                markeredgecolor="#ffffff",
                label=f"{system['title']}, no threshold",
            )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(need("matplotlib.ticker", "reports").FuncFormatter(lambda v, _: f"{v:g}"))
    lowest = min((p["recall"] for s in result.systems.values() for p in s["curve"]), default=0.0)
    axes.set_xlim(max(0.0, int(10 * lowest) / 10 - 0.1), 1)
    axes.set_xlabel("Recall: share of true gestures answered with the right gesture")
    axes.set_ylabel("False events an hour of stream (log scale)")
    axes.grid(color="#dddddd", linewidth=0.5, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=3)
    axes.set_title(result.title, fontsize=10, loc="left", parse_math=False)
    return figure


def latencies(result: BenchmarkResult) -> Figure:
    """Draw the share of true gestures answered within a time of the onset, against that time.

    The left panel counts answers with the right gesture, the right one any event. The latter is left out where every
    sample has a label.
    """
    # If every sample has a label, there is always an event.
    panels = [("gesture", "the right gesture"), ("anything", "any event")][: 1 if result.labelled else 2]
    figure = new_figure(4.8 * len(panels) + 0.6, 4.8)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (level, answer) in zip(grid, panels, strict=True):
        for name, system in result.systems.items():
            colour, style, _ = _LOOKS.get(name, _OTHER)
            row = system["balanced"]
            quantiles = row["latency_shares"].get(level) or []
            recall = row["levels"][level]["recall"] or 0.0
            n = len(quantiles)
            if n:
                shares = [recall * i / (n - 1) for i in range(n)]
                axes.plot(
                    [0.0, *quantiles, max(quantiles[-1], _LONGEST_S)],
                    [0.0, *shares, recall],
                    style,
                    color=colour,
                    linewidth=1.6,
                    label=system["title"],
                )
        axes.axvline(1.0, color="#999999", linewidth=0.8)
        axes.set_xlim(0, _LONGEST_S)
        axes.set_ylim(0, 1)
        axes.set_xlabel(f"Seconds from the onset to {answer}")
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("Share of true gestures")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=2 * len(panels))
    title = (
        f"{result.title}\nsettings of the highest F1 on the tuning people; the line at 1 s is the aim for the median"
    )
    figure.suptitle(title, fontsize=9).set_parse_math(False)
    return figure


def setting_table(result: BenchmarkResult) -> Table:
    """Return one row for each system and chosen setting."""
    rows = []
    for system in result.systems.values():
        for how, setting in SETTINGS.items():
            if how not in system:
                continue
            s = system[how]
            rows.append(
                {
                    **{k: s[k] for k in ("deletions", "insertions", "fragmentations", "merges")},
                    **{k: number(s[k], 2) for k in ("recall", "precision", "f1", "cost_per_truth")},
                    "system": system["title"],
                    "setting": setting,
                    "hits": f"{s['hits']} of {s['truths']}",
                    "false": rate(s["false_events_per_hour"]),
                    "outside": rate(s["outside_per_uncovered_hour"]),
                    "rest": f"{rate(s['at_rest_per_hour'])} ({s['outside']['rest']} in {60 * s['rest_hours']:.1f} min)",
                    "median": number(s["latency_s"]["median"], 2),
                    "p90": number(s["latency_s"]["p90"], 2),
                    "any": number(s["levels"]["anything"]["latency_s"]["median"], 2),
                }
            )
    columns = (
        Column("system", "System"),
        Column("setting", "Setting"),
        Column("recall", "Recall", "right"),
        Column("precision", "Precision", "right"),
        Column("f1", "F1", "right"),
        Column("hits", "Hits", "right"),
        Column("deletions", "Deletions", "count"),
        Column("insertions", "Insertions", "count"),
        Column("fragmentations", "Fragmented", "count"),
        Column("merges", "Merged", "count"),
        Column("false", "False an hour", "right"),
        Column("outside", "Outside truth, an hour", "right"),
        Column("rest", "At rest, an hour", "right"),
        Column("median", "Median s", "right"),
        Column("p90", "90 % s", "right"),
        Column("any", "Any event, median s", "right"),
        Column("cost_per_truth", "Cost a truth", "right"),
    )
    return Table("settings", "Single settings", columns, tuple(rows))


def recall_table(result: BenchmarkResult) -> Table:
    """Return the false events per hour of every system at equal recall, with the ratio to the reference."""
    rows = []
    for row in result.at_recall:
        cells = {"recall": f"{row['recall']:.2f}"}
        for name in result.systems:
            cell = row["systems"][name]
            cells[name] = rate(cell["false_events_per_hour"])
            if cells[name] != DASH and name != result.reference and cell["ratio"] is not None:
                interval = ", 95 % {:.2f} to {:.2f}".format(*cell["ci95"]) if cell["ci95"] else ""
                cells[name] += f" (× {cell['ratio']:.2f}{interval})"
        rows.append(cells)
    systems = (Column(name, system["title"], "right") for name, system in result.systems.items())
    return Table("recalls", "At equal recall", (Column("recall", "Recall", "right"), *systems), tuple(rows))


def class_tables(result: BenchmarkResult, how: str = "balanced") -> list[Table]:
    """Return a table for each system: one row for each gesture."""
    columns = (
        Column("label", "Gesture"),
        Column("truths", "Truths", "count"),
        Column("recall", "Recall", "right"),
        Column("precision", "Precision", "right"),
        Column("f1", "F1", "right"),
        Column("insertions", "False", "count"),
        Column("median", "Median s", "right"),
        Column("p90", "90 % s", "right"),
    )
    tables = []
    for name, system in result.systems.items():
        rows = tuple(
            {
                **{k: row[k] for k in ("truths", "insertions")},
                **{k: number(row[k], 2) for k in ("recall", "precision", "f1")},
                "label": label,
                "median": number(row["latency_s"]["median"], 2),
                "p90": number(row["latency_s"]["p90"], 2),
            }
            for label, row in system[how]["per_class"].items()
        )
        tables.append(Table(f"classes-{name}", system["title"], columns, rows))
    return tables


def point_table(result: BenchmarkResult) -> Table:
    """Return the points of the curves and the chosen settings as numbers, for CSV."""
    names = ["system", "title", "point", "target", "recall", "precision", "f1", "false_events_per_hour"]
    names += ["latency_median_s", "latency_p90_s", "simulated"]
    rows: list[dict[str, Any]] = []
    for name, system in result.systems.items():
        head = {"system": name, "title": system["title"], "simulated": "yes" if result.simulated else "no"}
        rows += [{**head, "point": "curve", **point} for point in system["curve"]]
        for how in SETTINGS:
            if how in system:
                row, latency = system[how], system[how]["latency_s"]
                times = {"latency_median_s": latency["median"], "latency_p90_s": latency["p90"]}
                rows.append({**head, "point": how, **row, **times})
    return Table("streams", "Points of the curves", tuple(Column(name, name) for name in names), tuple(rows))


def rate(value: float | None) -> str:
    """Format a rate, with one decimal below 10."""
    return DASH if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def page(result: BenchmarkResult) -> str:
    """Return the benchmark as one self-contained HTML page."""
    return render_page(
        "streams.html.j2",
        title=f"PlushSense continuous benchmark: {result.dataset}",
        simulated=result.simulated,
        note=result.note,
        late_s=f"{result.late_s:g}",
        people=", ".join(result.subjects),
        n=len(result.subjects),
        split=result.split,
        settings=setting_table(result),
        recalls=recall_table(result),
        classes=class_tables(result),
        curves=data_uri(curves(result)),
        latencies=data_uri(latencies(result)),
    )
