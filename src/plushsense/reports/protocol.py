"""The real-time protocol as a page and as text: each group of gestures by each system, beside the paper's figures."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense.core.extras import need
from plushsense.reports import words
from plushsense.reports.figures import svg
from plushsense.reports.html import fill
from plushsense.reports.protocol_paper import CONFUSED, PAPER, SOURCE, Printed
from plushsense.reports.words import DASH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIMULATION = "SIMULATION: virtual people touched a virtual toy. These figures say nothing about a real one."
# Okabe and Ito's; the mark says the same without colour.
_LOOKS = {"rules": ("#d55e00", "s"), "cnn": ("#0072b2", "o"), "hybrid": ("#009e73", "D")}
_SHORT = {"rules": "Rules", "cnn": "Network", "hybrid": "Hybrid"}
_JUDGED = {
    "right": "right",
    "family": "other of its family",
    "affect": "other of its affect",
    "wrong": "wrong",
    "unnamed": "not named",
}


def percent(part: int, of: int) -> str:
    """``44/45 98 %``, with a digit where the share is neither none nor all and small numbers matter."""
    if not of:
        return DASH
    share = 100.0 * part / of
    shown = f"{share:.0f}" if share in (0.0, 100.0) or 1.0 <= share <= 97.0 else f"{share:.1f}"
    return f"{shown} % ({part}/{of})"


def seconds(value: float | None) -> str:
    """Seconds with two digits."""
    return DASH if value is None else f"{round(value, 2) + 0.0:.2f}"


def table_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a group and system, as finished text, with what the paper prints of the same."""
    rows = []
    seen = None
    for row in result["rows"]:
        paper = PAPER.get((row["group"], row["system"]), Printed())
        rows.append(
            {
                "title": row["title"] if row["group"] != seen else "",
                "trials": str(row["trials"]) if row["group"] != seen else "",
                "system": _SHORT[row["system"]],
                **_cells(row, row["group"] in ("energetic", "fast")),
                "paper": (paper.activation or DASH, paper.reaction or DASH, paper.likelihood or DASH),
                "first": row["group"] != seen,
            }
        )
        seen = row["group"]
    return rows


def _cells(row: Mapping[str, Any], energetic: bool) -> dict[str, str]:
    n = row["trials"]
    return {
        "answered": percent(row["activated"], n),
        "named": DASH if row["system"] == "rules" else percent(row["named"], n),
        "median": seconds(row["reaction_s"]["median"]),
        "p90": seconds(row["reaction_s"]["p90"]),
        "quick": percent(row["within_200_ms"], n) if energetic else "",
        "likelihood": words.number(row["likelihood"], 2),
        "negative": percent(row["called_negative"], row["gentle"]) if row["gentle"] else "",
    }


def gesture_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a gesture and system, as finished text."""
    rows = []
    energetic = {o["gesture"] for o in result["outcomes"] if o["group"] in ("energetic", "fast")}
    seen = None
    for row in result["by_gesture"]:
        rows.append(
            {
                "title": row["gesture"] if row["gesture"] != seen else "",
                "first": row["gesture"] != seen,
                "system": _SHORT[row["system"]],
                **_cells(row, row["gesture"] in energetic),
                "called": DASH if row["system"] == "rules" else _called(row["called"]),
            }
        )
        seen = row["gesture"]
    return rows


def _called(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {_JUDGED[word]}" for word, n in counts.items() if n) or DASH


def judged_rows(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """A row a group and network system: what was named first, in words."""
    return [
        {"title": row["title"], "system": _SHORT[row["system"]]}
        | {word: percent(row["called"][word], row["trials"]) for word in _JUDGED}
        for row in result["rows"]
        if row["system"] != "rules"
    ]


def confusion_rows(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """A row a family and network system: what it was called, most often first."""
    rows: dict[tuple[str, str], list[str]] = {}
    for entry in result["confusions"]:
        if entry["system"] != "rules":
            said = entry["called"] or "not named"
            rows.setdefault((entry["did"], entry["system"]), []).append(f"{said} {100 * entry['share']:.0f} %")
    order = list(dict.fromkeys(did for did, _ in rows))
    return [
        {"did": did, "system": _SHORT[system], "called": ", ".join(rows[did, system])}
        for did in order
        for system in _SHORT
        if (did, system) in rows
    ]


def between_rows(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """A row a system: what it said while nobody made a gesture."""
    return [
        {
            "system": _SHORT[row["system"]],
            "minutes": f"{60 * row['hours']:.0f}",
            **{name: str(row[name]) for name in ("positive", "neutral", "negative", "none")},
            "reactions": words.number(row["reactions_per_hour"], 1),
            "negatives": words.number(row["negative_per_hour"], 1),
        }
        for row in result["between"]
    ]


def aim_rows(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """A row an aim, what came out, and whether it is met."""
    rows = []
    for aim in result["aims"]:
        measured = seconds(aim["measured"]) + " s" if aim["unit"] == "s" else percent(aim["part"], aim["of"])
        open_ = aim["met"] is None
        rows.append(
            {
                "aim": aim["aim"],
                "measured": DASH if open_ else measured,
                "met": "not measured" if open_ else "met" if aim["met"] else "NOT met",
            }
        )
    return rows


def csv_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The figures of every group and gesture by each system, as numbers, with what the paper prints of the same."""
    rows = []
    for kind, key in (("rows", "group"), ("by_gesture", "gesture")):
        for row in result[kind]:
            paper = PAPER.get((row[key], row["system"]), Printed())
            rows.append(
                {
                    "of": key,
                    "name": row["title"] if key == "group" else row["gesture"],
                    "system": row["system"],
                    **{k: row[k] for k in ("trials", "activated", "activation", "named", "gesture_activation")},
                    "reaction_median_s": row["reaction_s"]["median"],
                    "reaction_p90_s": row["reaction_s"]["p90"],
                    **{k: row[k] for k in ("within_200_ms", "likelihood", "gentle", "called_negative")},
                    **{f"said_first_{word}": n for word, n in row["called"].items()},
                    "paper_answered": paper.activation,
                    "paper_time": paper.reaction,
                    "paper_likelihood": paper.likelihood,
                    "simulated": "yes" if result["simulated"] else "no",
                }
            )
    return rows


def text_lines(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The main table as cells for a plain table; its head first; without the paper where it has no such group."""
    head = (
        *("gesture", "system", "answered", "right gesture named", "median s", "p90 s", "in 0.2 s", "likelihood"),
        *("called negative", "paper: answered", "paper: time"),
    )
    body = [
        (
            *(row["title"], row["system"], row["answered"], row["named"], row["median"], row["p90"], row["quick"]),
            *(row["likelihood"], row["negative"], *row["paper"][:2]),
        )
        for row in table_rows(result)
    ]
    return [line if _with_paper(result) else line[:-2] for line in (head, *body)]


def _with_paper(result: Mapping[str, Any]) -> bool:
    return any((row["group"], row["system"]) in PAPER for row in result["rows"])


def figure(result: Mapping[str, Any]) -> Figure:
    """Every answered trial's reaction time by group and system, its median, who was missed, and the paper's ranges."""
    rows = [row for row in result["rows"] if row["group"] != "all"]
    made: Figure = need("matplotlib.figure", "reports").Figure(
        figsize=(10.0, 1.6 + 0.42 * len(rows)), layout="constrained"
    )
    axes = made.add_subplot()
    rng = np.random.default_rng(0)
    places, names = [], []
    y, seen = 0.0, None
    drawn: set[str] = set()
    longest = max((o["reaction_s"] for o in result["outcomes"] if o["reaction_s"] is not None), default=1.0)
    right = max(3.4, longest) + 0.2
    for row in rows:
        y += 1.6 if seen not in (None, row["group"]) else 1.0
        seen = row["group"]
        colour, mark = _LOOKS[row["system"]]
        times = [
            o["reaction_s"]
            for o in result["outcomes"]
            if o["group"] == row["group"] and o["system"] == row["system"] and o["reaction_s"] is not None
        ]
        paper = PAPER.get((row["group"], row["system"]), Printed()).reaction_s
        if paper is not None:
            low, high = paper
            axes.plot(
                [low - 0.02, high + 0.02], [y, y], color="#bbbbbb", linewidth=11, solid_capstyle="butt", zorder=1,
                label=None if "paper" in drawn else "the paper, section 4.6",
            )  # fmt: skip
            drawn.add("paper")
        spread = y + rng.uniform(-0.26, 0.26, len(times))
        axes.scatter(
            times, spread, s=13, marker=mark, facecolor=colour, edgecolor="none", alpha=0.45, zorder=2,
            label=None if row["system"] in drawn else _SHORT[row["system"]],
        )  # fmt: skip
        drawn.add(row["system"])
        if times:
            middle = float(np.median(times))
            axes.plot([middle, middle], [y - 0.38, y + 0.38], color="#000000", linewidth=1.8, zorder=3)
        missed = row["trials"] - len(times)
        axes.text(
            right + 0.08, y, f"{missed} of {row['trials']} not answered" if missed else "all answered",
            va="center", fontsize=8, color="#b3261e" if missed else "#57606a",
        )  # fmt: skip
        places.append(y)
        names.append(f"{row['title']}: {_SHORT[row['system']].lower()}")
    axes.axvline(0.0, color="#57606a", linewidth=0.8)
    axes.set_yticks(places, names, fontsize=8.5, parse_math=False)
    axes.set_ylim(y + 0.8, 0.2)
    axes.set_xlim(-0.6, right)
    axes.set_xlabel("Reaction time after the onset, seconds (black: median; only answered trials)")
    axes.grid(axis="x", color="#dddddd", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    made.legend(loc="outside upper right", ncols=4, fontsize=8, frameon=False)
    axes.set_title("SIMULATION" if result["simulated"] else "", fontsize=10, loc="left")
    return made


def page(result: Mapping[str, Any]) -> str:
    """The protocol as one HTML page that is complete in itself."""
    picture = base64.b64encode(svg(figure(result))).decode("ascii")
    return fill(
        "protocol.html.j2",
        title=result["heading"],
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        simulated=result["simulated"],
        simulated_title="This is a simulation.",
        simulated_words="Virtual people touched a virtual toy: these figures say nothing about a real toy.",
        about=result["about"],
        said=result["said"],
        aims=aim_rows(result),
        rows=table_rows(result),
        gestures=gesture_rows(result),
        judged=judged_rows(result),
        judged_words=_JUDGED,
        confusions=confusion_rows(result),
        between=between_rows(result),
        left=result["left"],
        with_paper=_with_paper(result),
        source=SOURCE,
        confused=CONFUSED,
        counted=result["counted"],
        picture=f"data:image/svg+xml;base64,{picture}",
    )
