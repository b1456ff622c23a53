"""The continuous benchmark shown: recall against false events, how soon, and both as tables."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from plushsense.core.extras import need
from plushsense.reports import words
from plushsense.reports.figures import svg
from plushsense.reports.html import fill
from plushsense.reports.words import DASH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours; marker and line style say the same without colour.
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
_MOST_SHOWN_S = 4.0
HOWS = {
    "plain": "no threshold",
    "balanced": "highest F1 on those who tune",
    "cheapest": "lowest cost on those who tune",
}


def curves(result: Mapping[str, Any]) -> Figure:
    """Recall against false events an hour of every system, over all people left out; a star where there is no
    threshold."""
    figure: Figure = need("matplotlib.figure", "reports").Figure(figsize=(8.6, 6.0), layout="constrained")
    axes = figure.add_subplot()
    for name, system in result["systems"].items():
        colour, style, marker = _LOOKS.get(name, _OTHER)
        points = sorted({(p["recall"], p["false_events_per_hour"]) for p in system["curve"]})
        shown = [(r, f) for r, f in points if f > 0]
        axes.plot(
            [r for r, _ in shown],
            [f for _, f in shown],
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
    lowest = min((p["recall"] for s in result["systems"].values() for p in s["curve"]), default=0.0)
    axes.set_xlim(max(0.0, int(10 * lowest) / 10 - 0.1), 1)
    axes.set_xlabel("Recall: share of true gestures answered with the right gesture")
    axes.set_ylabel("False events an hour of stream (log scale)")
    axes.grid(color="#dddddd", linewidth=0.5, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=3)
    axes.set_title(_title(result), fontsize=10, loc="left", parse_math=False)
    return figure


def latencies(result: Mapping[str, Any]) -> Figure:
    """How soon: of all true gestures the share that was answered within so many seconds of the onset, rightly (left)
    and at all (right, not where every sample has a label)."""
    # Where every sample has a label, something is always being said, and "any event" would tell nothing.
    panels = [("gesture", "the right gesture"), ("anything", "any event")][: 1 if result["labelled"] else 2]
    figure: Figure = need("matplotlib.figure", "reports").Figure(
        figsize=(4.8 * len(panels) + 0.6, 4.8), layout="constrained"
    )
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (level, said) in zip(grid, panels, strict=True):
        for name, system in result["systems"].items():
            colour, style, _ = _LOOKS.get(name, _OTHER)
            row = system["balanced"]
            quantiles = row["latency_shares"].get(level) or []
            recall = row["levels"][level]["recall"] or 0.0
            n = len(quantiles)
            if n:
                shares = [recall * i / (n - 1) for i in range(n)]
                axes.plot(
                    [0.0, *quantiles, max(quantiles[-1], _MOST_SHOWN_S)],
                    [0.0, *shares, recall],
                    style,
                    color=colour,
                    linewidth=1.6,
                    label=system["title"],
                )
        axes.axvline(1.0, color="#999999", linewidth=0.8)
        axes.set_xlim(0, _MOST_SHOWN_S)
        axes.set_ylim(0, 1)
        axes.set_xlabel(f"Seconds from the onset to {said}")
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0].set_ylabel("Share of true gestures")
    drawn, named = grid[0].get_legend_handles_labels()
    figure.legend(drawn, named, fontsize=8, frameon=False, loc="outside lower center", ncols=2 * len(panels))
    title = f"{_title(result)}\nsettings of the highest F1 on those who tune; the line at 1 s is the aim for the median"
    figure.suptitle(title, fontsize=9).set_parse_math(False)
    return figure


def _title(result: Mapping[str, Any]) -> str:
    simulated = ": SIMULATION" if result["simulated"] else ""
    return f"{result['dataset']}, {len(result['subjects'])} people left out in turn ({result['split']}){simulated}"


def system_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """A row a system and choice of setting, as finished text."""
    rows = []
    for system in result["systems"].values():
        for how, said in HOWS.items():
            if how not in system:
                continue
            s = system[how]
            rows.append(
                [
                    system["title"],
                    said,
                    share(s["recall"]),
                    share(s["precision"]),
                    share(s["f1"]),
                    f"{s['hits']} of {s['truths']}",
                    str(s["deletions"]),
                    str(s["insertions"]),
                    str(s["fragmentations"]),
                    str(s["merges"]),
                    rounded(s["false_events_per_hour"]),
                    rounded(s["outside_per_uncovered_hour"]),
                    f"{rounded(s['at_rest_per_hour'])} ({s['outside']['rest']} in {60 * s['rest_hours']:.1f} min)",
                    seconds(s["latency_s"]["median"]),
                    seconds(s["latency_s"]["p90"]),
                    seconds(s["levels"]["anything"]["latency_s"]["median"]),
                    share(s["cost_per_truth"]),
                ]
            )
    return rows


HEAD = (
    "System", "Setting", "Recall", "Precision", "F1", "Hits", "Deletions", "Insertions", "Fragmented", "Merged",
    "False an hour", "Outside truth, an hour", "At rest, an hour", "Median s", "90 % s", "Any event, median s",
    "Cost a truth",
)  # fmt: skip


def recall_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """Of each recall the false events an hour of every system, and the ratio to the reference."""
    rows = []
    for row in result["at_recall"]:
        cells = [f"{row['recall']:.2f}"]
        for name in result["systems"]:
            found = row["systems"][name]
            if found["false_events_per_hour"] is None:
                cells.append(DASH)
                continue
            text = rounded(found["false_events_per_hour"])
            if name != result["reference"] and found["ratio"] is not None:
                text += f" (× {found['ratio']:.2f}"
                text += f", 95 % {found['ci95'][0]:.2f} to {found['ci95'][1]:.2f})" if found["ci95"] else ")"
            cells.append(text)
        rows.append(cells)
    return rows


def class_rows(result: Mapping[str, Any], how: str = "balanced") -> list[tuple[str, list[list[str]]]]:
    """Of each system a row a gesture: truths, hits, F1, latency."""
    found = []
    for system in result["systems"].values():
        rows = [
            [
                label,
                str(row["truths"]),
                share(row["recall"]),
                share(row["precision"]),
                share(row["f1"]),
                str(row["insertions"]),
                seconds(row["latency_s"]["median"]),
                seconds(row["latency_s"]["p90"]),
            ]
            for label, row in system[how]["per_class"].items()
        ]
        found.append((system["title"], rows))
    return found


def share(value: float | None) -> str:
    """Two digits; a dash for what could not be computed."""
    return DASH if value is None else f"{value:.2f}"


def seconds(value: float | None) -> str:
    """Hundredths."""
    return DASH if value is None else f"{value:.2f}"


def rounded(value: float | None) -> str:
    """A rate: whole from 10 on."""
    return DASH if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def page(result: Mapping[str, Any]) -> str:
    """The benchmark as one HTML page that is complete in itself."""
    pictures: Sequence[tuple[str, Figure]] = (
        ("Recall against false events an hour", curves(result)),
        ("How soon", latencies(result)),
    )
    return fill(
        "streams.html.j2",
        title=f"PlushSense continuous benchmark: {result['dataset']}",
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        simulated=result["simulated"],
        simulated_title=words.SIMULATED_TITLE,
        simulated_words=words.SIMULATED_WORDS,
        note=result["note"],
        late_s=f"{result['late_s']:g}",
        people=", ".join(result["subjects"]),
        n=len(result["subjects"]),
        split=result["split"],
        head=HEAD,
        rows=system_rows(result),
        systems=[system["title"] for system in result["systems"].values()],
        recalls=recall_rows(result),
        classes=class_rows(result),
        pictures=[
            (said, "data:image/svg+xml;base64," + base64.b64encode(svg(drawn)).decode("ascii"))
            for said, drawn in pictures
        ],
    )
