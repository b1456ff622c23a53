"""Programs side by side: one table with a column pair a split, one figure of how far a leaky split flatters."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from plushsense.core.extras import need
from plushsense.reports import words
from plushsense.reports.figures import svg
from plushsense.reports.html import fill
from plushsense.reports.words import count, mean_sd, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIMULATION = "SIMULATION: these scores are of the virtual toy and say nothing about a real one."
COUNTS = (
    "Only the number by person counts: in the leaky split overlapping windows of one recording, and recordings of one "
    "person, stand on both sides, so that a program is paid for recognising what it has already seen, while whoever "
    "touches the toy next is new to it."
)
LEAKY = (
    "A leaky split has overlapping windows of one recording, and recordings of one person, on both sides: its numbers "
    "say little about a new person, and only a split by person counts."
)
# Okabe and Ito's blue and vermillion; filled against open says the same without colour.
_HONEST, _LEAKY = "#0072b2", "#d55e00"


def rows_of(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a program, the best under the first split first: finished text.

    Each has ``title``, ``reads``, ``ours``, ``scores`` (a split each: accuracy with its deviation, macro-F1, both
    pooled), ``gap`` (of accuracy, between the first leaky and the first split by person), and the costs, which are
    those under the first split.
    """
    splits = [split["split"] for split in result["splits"]]
    by_program: dict[tuple[str, str, bool], dict[str, Mapping[str, Any]]] = {}
    for row in result["models"]:
        by_program.setdefault((row["name"], row["features"], row["pca"]), {})[row["split"]] = row
    gaps: dict[tuple[str, str, bool], float] = {}
    for gap in result["gaps"]:
        gaps.setdefault((gap["name"], gap["features"], gap["pca"]), gap["accuracy"])

    def best_first(item: tuple[Any, dict[str, Mapping[str, Any]]]) -> float:
        return -float(item[1][splits[0]]["accuracy"]["mean"])

    shown = []
    for key, of_split in sorted(by_program.items(), key=best_first):
        first = of_split[splits[0]]
        shown.append(
            {
                "title": first["title"],
                "reads": first["features"] + (", PCA" if first["pca"] else ""),
                "ours": first["name"] == "network",
                "scores": [
                    {
                        "accuracy": mean_sd(of_split[s]["accuracy"]),
                        "macro_f1": mean_sd(of_split[s]["macro_f1"]),
                        "macro_f1_mean": number(of_split[s]["macro_f1"]["mean"]),
                        "pooled": f"{number(of_split[s]['pooled']['accuracy'])} / "
                        f"{number(of_split[s]['pooled']['macro_f1'])}",
                    }
                    for s in splits
                ],
                "gap": f"{gaps[key]:+.3f}" if key in gaps else "",
                "size": size(first["size_bytes"]),
                "predict": milliseconds(first["predict_ms"]),
                "batch": milliseconds(first["predict_batch_ms"]),
                "train": f"{first['train_s']:.2f}" if first["train_s"] < 10 else f"{first['train_s']:.0f}",
            }
        )
    return shown


def size(n: int) -> str:
    """Bytes as kB or MB (thousands)."""
    return f"{n / 1e6:.1f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB"


def milliseconds(value: float) -> str:
    """Three digits or so."""
    return f"{value:.3f}" if value < 1 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def headings(result: Mapping[str, Any]) -> list[str]:
    """Each split as a column is named."""
    return [split["split"] + (" (leaky)" if split["leaky"] else "") for split in result["splits"]]


def cost_words(result: Mapping[str, Any]) -> str:
    """What sizes and times are, and whose."""
    return (
        "Size: classical programs as they are pickled in memory, our network as its bundle, recurrent ones as their "
        "float32 weights. Processor time in milliseconds a window, read alone (median) or many at once, and seconds of "
        "training (median over folds), with everything from raw samples to probabilities, on this machine: "
        f"{result['machine']}."
    )


def said(result: Mapping[str, Any]) -> str:
    """On what the comparison was made."""
    return (
        f"{result['dataset']}: {count(result['windows'])} windows of {count(result['recordings'])} recordings, "
        f"{result['subjects']} people, {len(result['labels'])} gestures; {result['window_s']:g} s windows, "
        f"{words.CONTEXT_SHORT.get(result['context'], result['context'])}; seed {result['seed']}."
    )


def figure(result: Mapping[str, Any]) -> Figure:
    """A line a program from its accuracy under the first split by person to that under the first leaky one."""
    splits: Sequence[Mapping[str, Any]] = result["splits"]
    honest = next((s["split"] for s in splits if not s["leaky"]), None)
    leaky = next((s["split"] for s in splits if s["leaky"]), None)
    at: dict[tuple[str, str, bool], dict[str, float]] = {}
    named: dict[tuple[str, str, bool], str] = {}
    for row in result["models"]:
        key = (row["name"], row["features"], row["pca"])
        at.setdefault(key, {})[row["split"]] = row["accuracy"]["mean"]
        named[key] = f"{row['title']}, {row['features']}{', PCA' if row['pca'] else ''}"
    main = honest or leaky or ""
    order = sorted(at, key=lambda key: at[key][main])
    made: Figure = need("matplotlib.figure", "reports").Figure(
        figsize=(9.0, 1.5 + 0.24 * len(order)), layout="constrained"
    )
    axes = made.add_subplot()
    for y, key in enumerate(order):
        if honest is not None and leaky is not None:
            axes.plot([at[key][honest], at[key][leaky]], [y, y], color="#999999", linewidth=1.4, zorder=1)
    for split, inside, edge, mark in ((honest, _HONEST, _HONEST, ""), (leaky, "#ffffff", _LEAKY, " (leaky)")):
        if split is not None:
            axes.scatter(
                [at[key][split] for key in order],
                range(len(order)),
                s=34,
                linewidths=1.6,
                zorder=2,
                facecolor=inside,
                edgecolor=edge,
                label=f"{split}{mark}",
            )
    axes.set_yticks(range(len(order)), [named[key] for key in order], fontsize=8, parse_math=False)
    for tick, key in zip(axes.get_yticklabels(), order, strict=True):
        if key[0] == "network":
            tick.set_fontweight("bold")
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.7, len(order) - 0.3)
    axes.set_xlabel("Accuracy: share of windows, mean over people (leaky split: over folds)")
    axes.grid(axis="x", color="#dddddd", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    made.legend(loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    title = f"{result['dataset']}, {result['subjects']} people"
    axes.set_title(title + (": SIMULATION" if result["simulated"] else ""), fontsize=10, loc="left", parse_math=False)
    return made


def page(result: Mapping[str, Any]) -> str:
    """The comparison as one HTML page that is complete in itself."""
    picture = base64.b64encode(svg(figure(result))).decode("ascii")
    return fill(
        "baselines.html.j2",
        title=f"PlushSense baselines: {result['dataset']}",
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        simulated=result["simulated"],
        simulated_title=words.SIMULATED_TITLE,
        simulated_words=words.SIMULATED_WORDS,
        said=said(result),
        splits=[{"title": s["split"], "leaky": s["leaky"], "folds": s["folds"]} for s in result["splits"]],
        with_gap=bool(result["gaps"]),
        rows=rows_of(result),
        counts=COUNTS if result["gaps"] else LEAKY,
        any_leaky=any(s["leaky"] for s in result["splits"]),
        costs=cost_words(result),
        picture=f"data:image/svg+xml;base64,{picture}",
    )
