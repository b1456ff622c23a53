"""Tables, figure and page of the real-time protocol: groups of gestures by system, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense.experiments.protocol.score import GROUPS, NAMELESS, PrintedFigures, ProtocolResult, SummaryRow
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import DASH, Column, Table, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SIMULATION = "SIMULATION: virtual people touched a virtual toy. These figures say nothing about a real one."
# Okabe and Ito's colours; the marker distinguishes the systems without colour.
_LOOKS = {"toy": ("#cc79a7", "^"), "rules": ("#d55e00", "s"), "cnn": ("#0072b2", "o"), "hybrid": ("#009e73", "D")}
_SHORT = {"toy": "Toy's own rules", "rules": "Rules", "cnn": "Network", "hybrid": "Hybrid"}
_JUDGED = {
    "right": "right",
    "family": "other of its family",
    "affect": "other of its affect",
    "wrong": "wrong",
    "unnamed": "not named",
}


def percent(part: int, of: int) -> str:
    """Format a share with its counts: ``98 % (44/45)``; shares near 0 % or 100 % have one decimal."""
    if not of:
        return DASH
    share = 100.0 * part / of
    digits = 0 if share in (0.0, 100.0) or 1.0 <= share <= 97.0 else 1
    return f"{share:.{digits}f} % ({part}/{of})"


def seconds(value: float | None) -> str:
    """Format seconds with two decimals."""
    return DASH if value is None else f"{round(value, 2) + 0.0:.2f}"


_CELLS = (
    Column("answered", "Answered\n(right affect)", "right", plain="answered"),
    Column("named", "Right gesture\nnamed", "right", plain="right gesture named"),
    Column("median", "median", "right", group="Reaction time, s", plain="median s"),
    Column("p90", "p90", "right", group="Reaction time, s", plain="p90 s"),
    Column("quick", "≤ 0.2 s", "right", group="Reaction time, s", plain="in 0.2 s"),
    Column("likelihood", "Likelihood", "right", plain="likelihood"),
    Column("negative", "Called\nnegative", "right", plain="called negative"),
)
# The paper's figures by group and system.
PAPER = {(name, system): figures for name, group in GROUPS.items() for system, figures in group.paper.items()}
# The paper's rules were those of a real toy.
PAPER |= {(name, "toy"): figures for (name, system), figures in PAPER.items() if system == "rules"}
_PRINTED = ("answered", "time", "likelihood")
_PAPER_CELLS = tuple(
    Column(f"paper_{key}", key, group="The paper, real toy", plain=f"paper: {key}", style="paper") for key in _PRINTED
)


def _cells(row: SummaryRow, energetic: bool) -> dict[str, str]:
    found, n = row.figures, row.figures.trials
    return {
        "answered": percent(found.activated, n),
        "named": DASH if row.system in NAMELESS else percent(found.named, n),
        "median": seconds(found.reaction_s["median"]),
        "p90": seconds(found.reaction_s["p90"]),
        "quick": percent(found.within_200_ms, n) if energetic else "",
        "likelihood": number(found.likelihood, 2),
        "negative": percent(found.called_negative, found.gentle) if found.gentle else "",
    }


def group_table(result: ProtocolResult) -> Table:
    """Return one row for each group and system, with the paper's figures if it has any for these groups."""
    rows: list[dict[str, Any]] = []
    last = None
    for row in result.scored.rows:
        paper = PAPER.get((row.group, row.system), PrintedFigures())
        first = row.group != last
        rows.append(
            {
                "title": row.title if first else "",
                "trials": str(row.figures.trials) if first else "",
                "system": _SHORT[row.system],
                **_cells(row, row.group in ("energetic", "fast")),
                **{f"paper_{key}": getattr(paper, key) or DASH for key in _PRINTED},
                "class": "top" if first else "",
            }
        )
        last = row.group
    columns = (
        Column("title", "Gestures", plain="gesture"),
        Column("trials", "Trials", "right", plain="trials"),
        Column("system", "System", plain="system"),
        *_CELLS,
        *(_PAPER_CELLS if has_paper(result) else ()),
    )
    return Table("groups", "By group of gestures", columns, tuple(rows))


def gesture_table(result: ProtocolResult) -> Table:
    """Return one row for each gesture and system."""
    rows: list[dict[str, Any]] = []
    energetic = {o.gesture for o in result.scored.outcomes if o.group in ("energetic", "fast")}
    last = None
    for row in result.scored.by_gesture:
        first = row.gesture != last
        rows.append(
            {
                "title": row.gesture if first else "",
                "system": _SHORT[row.system],
                **_cells(row, row.gesture in energetic),
                "called": DASH if row.system in NAMELESS else _judgements(row.figures.called),
                "class": "top" if first else "",
            }
        )
        last = row.gesture
    heads = ("Answered", "Named right", "Median, s", "p90, s", "≤ 0.2 s", "Likelihood", "Called negative")
    cells = (replace(c, head=head, group="") for c, head in zip(_CELLS, heads, strict=True))
    columns: tuple[Column, ...] = (Column("title", "Gesture"), Column("system", "System"), *cells)
    return Table(
        "gestures", "Gesture by gesture", (*columns, Column("called", "Said first", style="words")), tuple(rows)
    )


def _judgements(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {_JUDGED[judged]}" for judged, n in counts.items() if n) or DASH


def confusion_table(result: ProtocolResult) -> Table:
    """Return one row for each true family and system with a network: the recognised families, most frequent first."""
    called: dict[tuple[str, str], list[str]] = {}
    for entry in result.scored.confusions:
        if entry.system not in NAMELESS:
            name = entry.called or "not named"
            called.setdefault((entry.did, entry.system), []).append(f"{name} {100 * (entry.share or 0.0):.0f} %")
    rows = tuple(
        {"did": did, "system": _SHORT[system], "called": ", ".join(called[did, system])}
        for did in dict.fromkeys(did for did, _ in called)
        for system in _SHORT
        if (did, system) in called
    )
    columns = (
        Column("did", "Family that was made"),
        Column("system", "System"),
        Column("called", "Called", style="words"),
    )
    return Table("confusions", "Confusions of families", columns, rows)


def between_table(result: ProtocolResult) -> Table:
    """Return one row for each system with its events that began outside all trials."""
    rows = tuple(
        {
            **vars(row),
            "system": _SHORT[row.system],
            "minutes": f"{60 * row.hours:.0f}",
            "reactions": number(row.reactions_per_hour, 1),
            "negatives": number(row.negative_per_hour, 1),
        }
        for row in result.scored.between
    )
    columns = (
        Column("system", "System"),
        Column("minutes", "Minutes", "right"),
        Column("positive", "Positive events", "count"),
        Column("negative", "Negative events", "count"),
        Column("none", "Without affect", "count"),
        Column("neutral", "Neutral events", "count"),
        Column("reactions", "All but neutral,\nan hour", "right"),
        Column("negatives", "Negative,\nan hour", "right"),
    )
    return Table("between", "Between the gestures", columns, rows)


def figure_table(result: ProtocolResult) -> Table:
    """Return one row for each group and each gesture by system, as numbers for CSV, with the paper's figures."""
    rows = []
    for row in (*result.scored.rows, *result.scored.by_gesture):
        paper = PAPER.get((row.group, row.system), PrintedFigures())
        found = row.figures
        rows.append(
            {
                "of": "group" if row.gesture is None else "gesture",
                "name": row.title if row.gesture is None else row.gesture,
                "system": row.system,
                **{k: getattr(found, k) for k in ("trials", "activated", "activation", "named", "gesture_activation")},
                "reaction_median_s": found.reaction_s["median"],
                "reaction_p90_s": found.reaction_s["p90"],
                **{k: getattr(found, k) for k in ("within_200_ms", "likelihood", "gentle", "called_negative")},
                **{f"said_first_{judged}": n for judged, n in found.called.items()},
                **{f"paper_{key}": getattr(paper, key) for key in _PRINTED},
                "simulated": "yes" if result.simulated else "no",
            }
        )
    return Table.from_rows("table", "Figures of every group and gesture", rows)


def has_paper(result: ProtocolResult) -> bool:
    """Return whether the paper has figures for any group and system of the result."""
    return any((row.group, row.system) in PAPER for row in result.scored.rows)


def figure(result: ProtocolResult) -> Figure:
    """Draw the reaction times of all trials by group and system: medians, unanswered trials, and the paper's ranges."""
    rows = [row for row in result.scored.rows if row.group != "all"]
    picture = new_figure(10.0, 1.6 + 0.42 * len(rows))
    axes = picture.add_subplot()
    rng = np.random.default_rng(0)
    places, names = [], []
    y, last = 0.0, None
    drawn: set[str] = set()
    longest = max((o.reaction_s for o in result.scored.outcomes if o.reaction_s is not None), default=1.0)
    right = max(3.4, longest) + 0.2
    for row in rows:
        y += 1.6 if last not in (None, row.group) else 1.0
        last = row.group
        colour, mark = _LOOKS[row.system]
        times = [
            o.reaction_s
            for o in result.scored.outcomes
            if o.group == row.group and o.system == row.system and o.reaction_s is not None
        ]
        paper = PAPER.get((row.group, row.system), PrintedFigures()).reaction_s
        if paper:
            low, high = paper
            axes.plot(
                [low - 0.02, high + 0.02], [y, y], color="#bbbbbb", linewidth=11, solid_capstyle="butt", zorder=1,
                label=None if "paper" in drawn else "the paper, section 4.6",
            )  # fmt: skip
            drawn.add("paper")
        spread = y + rng.uniform(-0.26, 0.26, len(times))
        axes.scatter(
            times, spread, s=13, marker=mark, facecolor=colour, edgecolor="none", alpha=0.45, zorder=2,
            label=None if row.system in drawn else _SHORT[row.system],
        )  # fmt: skip
        drawn.add(row.system)
        if times:
            middle = float(np.median(times))
            axes.plot([middle, middle], [y - 0.38, y + 0.38], color="#000000", linewidth=1.8, zorder=3)
        missed = row.figures.trials - len(times)
        axes.text(
            right + 0.08, y, f"{missed} of {row.figures.trials} not answered" if missed else "all answered",
            va="center", fontsize=8, color="#b3261e" if missed else "#57606a",
        )  # fmt: skip
        places.append(y)
        names.append(f"{row.title}: {_SHORT[row.system].lower()}")
    axes.axvline(0.0, color="#57606a", linewidth=0.8)
    axes.set_yticks(places, names, fontsize=8.5, parse_math=False)
    axes.set_ylim(y + 0.8, 0.2)
    axes.set_xlim(-0.6, right)
    axes.set_xlabel("Reaction time after the onset, seconds (black: median; only answered trials)")
    axes.grid(axis="x", color="#dddddd", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    picture.legend(loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    axes.set_title("SIMULATION" if result.simulated else "", fontsize=10, loc="left")
    return picture


def page(result: ProtocolResult) -> str:
    """Return the result of the protocol as one self-contained HTML page."""
    return render_page(
        "protocol.html.j2",
        title=result.heading,
        simulated=result.simulated,
        about=result.about,
        remarks=result.said,
        groups=group_table(result),
        gestures=gesture_table(result),
        confusions=confusion_table(result),
        between=between_table(result),
        left=result.left,
        with_paper=has_paper(result),
        counted=result.counted,
        picture=data_uri(figure(result)),
    )
