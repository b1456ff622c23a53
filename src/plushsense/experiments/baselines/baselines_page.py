"""Report of the baselines as table, figure and page: scores of each program under each split, and its costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plushsense.experiments.baselines.score import (
    BaselinesResult,
    ComparisonResult,
    Program,
    ProgramScores,
    flat,
    reads,
)
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import Column, Table, count, mean_sd, number
from plushsense.reports.wording import CONTEXT_SHORT, describe_leakage
from plushsense.scoring.metrics import column_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COUNTS = (
    "Only the number by person counts: in the leaky split overlapping windows of one recording, and recordings of one "
    "person, stand on both sides, so that a program is paid for recognising what it has already seen, while whoever "
    "touches the toy next is new to it."
)
LEAKY = (
    "A leaky split has overlapping windows of one recording, and recordings of one person, on both sides: its numbers "
    "say little about a new person, and only a split by person counts."
)
# Okabe and Ito's blue and vermillion; filled and open markers show the same difference without colour.
_HONEST, _LEAKY = "#0072b2", "#d55e00"


def program_table(result: ComparisonResult) -> Table:
    """Return one row for each program, ordered by accuracy under the first split, the best first.

    A row has the span that it reads, in seconds; accuracy and macro-F1 of each split, with those pooled over all
    windows as a note; the gap in accuracy between the first leaky split and the first split by person; and the costs
    measured under the first split.
    """
    by_program: dict[Program, dict[str, ProgramScores]] = {}
    for row in result.models:
        by_program.setdefault(row.program, {})[row.split] = row
    gaps: dict[Program, float] = {}
    for gap in result.gaps:
        gaps.setdefault(gap.program, gap.metrics["accuracy"])
    first = result.splits[0].split
    ranked = sorted(by_program.items(), key=lambda item: -float(item[1][first].metrics["accuracy"]["mean"]))
    columns = [Column("title", "Program", plain="program"), Column("reads", "Reads", plain="reads")]
    columns.append(Column("span", "Span, s", "right", plain="span s"))
    for split in result.splits:
        group = f"{split.split}, {split.folds} folds"
        for key, metric in column_metrics().items():
            plain = f"{metric.name}, {split.split}" if key == "accuracy" else metric.name
            name = f"{key} {split.split}"
            columns.append(Column(name, metric.title, "right", group=group, leaky=split.leaky, plain=plain))
    if result.gaps:
        columns.append(Column("gap", "Gap in accuracy", "right", plain="gap"))
    columns += [
        Column("size", "Size", "right", plain="size"),
        Column("predict", "alone", "right", group="ms a window", plain="ms alone"),
        Column("batch", "in a batch", "right", group="ms a window", plain="ms batch"),
        Column("train", "Training, s", "right", plain="train s"),
    ]
    rows = tuple(_program_row(by_split, first, gaps.get(program)) for program, by_split in ranked)
    return Table("programs", "Every program", tuple(columns), rows)


def _program_row(by_split: dict[str, ProgramScores], first_split: str, gap: float | None) -> dict[str, object]:
    first = by_split[first_split]
    row: dict[str, object] = {
        "title": first.title,
        "reads": reads(first.features, first.pca),
        "span": f"{first.span_s:.2f}",
        "gap": "" if gap is None else f"{gap:+.3f}",
        "size": size(first.size_bytes),
        "predict": milliseconds(first.predict_ms),
        "batch": milliseconds(first.predict_batch_ms),
        "train": f"{first.train_s:.2f}" if first.train_s < 10 else f"{first.train_s:.0f}",
        "class": "ours" if first.name == "network" else "",
    }
    for split, scores in by_split.items():
        row |= {f"{key} {split}": mean_sd(scores.metrics[key]) for key in column_metrics()}
        note = "pooled " + " / ".join(number(scores.pooled[key]) for key in column_metrics())
        row[f"accuracy {split}"] = (mean_sd(scores.metrics["accuracy"]), note)
    return row


def score_table(result: ComparisonResult) -> Table:
    """Return one row for each program and split as numbers, for CSV."""
    rows = []
    for row in result.models:
        scores = {f"{m}_{part}": row.metrics[m][part] for m in column_metrics() for part in ("mean", "sd")}
        rows.append(flat(row) | scores | {f"{m}_pooled": row.pooled[m] for m in column_metrics()})
    names = ["name", "title", "features", "pca", "span_s", "split", "leaky", "over", "folds"]
    names += [f"{m}_{part}" for m in column_metrics() for part in ("mean", "sd", "pooled")]
    names += ["size_bytes", "predict_ms", "predict_batch_ms", "train_s", "train_s_in_all"]
    return Table("baselines", "Every program and split", tuple(Column(name, name) for name in names), tuple(rows))


def size(n: int) -> str:
    """Format a number of bytes as kB or MB (powers of 1000)."""
    return f"{n / 1e6:.1f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB"


def milliseconds(value: float) -> str:
    """Format milliseconds with about three digits."""
    return f"{value:.3f}" if value < 1 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def describe_costs(result: BaselinesResult) -> str:
    """Return a note on how sizes and times were measured."""
    return (
        "Size: classical programs as they are pickled in memory, our network as its bundle, recurrent ones as their "
        "float32 weights. Processor time in milliseconds a window, read alone (median) or many at once, and seconds of "
        "training (median over folds), with everything from raw samples to probabilities, on this machine: "
        f"{result.machine}."
    )


def describe_data(result: BaselinesResult) -> str:
    """Return a sentence that describes the data of the comparison."""
    return (
        f"{result.dataset}: {count(result.windows)} windows of {count(result.recordings)} recordings, "
        f"{result.subjects} people, {len(result.labels)} gestures; {result.window_s:g} s windows, "
        f"{CONTEXT_SHORT.get(result.context, result.context)}; seed {result.seed}."
    )


def figure(result: BaselinesResult) -> Figure:
    """Draw a line for each program between its accuracies under the first split by person and the first leaky split."""
    honest = next((s.split for s in result.splits if not s.leaky), None)
    leaky = next((s.split for s in result.splits if s.leaky), None)
    at: dict[Program, dict[str, float]] = {}
    named: dict[Program, str] = {}
    for row in result.models:
        at.setdefault(row.program, {})[row.split] = row.metrics["accuracy"]["mean"]
        named[row.program] = f"{row.title}, {reads(row.features, row.pca)}"
    main = honest or leaky or ""
    order = sorted(at, key=lambda key: at[key][main])
    picture = new_figure(9.0, 1.5 + 0.24 * len(order))
    axes = picture.add_subplot()
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
    picture.legend(loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    title = f"{result.dataset}, {result.subjects} people"
    axes.set_title(title + (": SIMULATION" if result.simulated else ""), fontsize=10, loc="left", parse_math=False)
    return picture


def page(result: BaselinesResult) -> str:
    """Return the comparison as one self-contained HTML page."""
    return render_page(
        "baselines.html.j2",
        title=f"PlushSense baselines: {result.dataset}",
        simulated=result.simulated,
        about=describe_data(result),
        table=program_table(result),
        metrics=column_metrics(),
        audits={s.split: describe_leakage(s.leakage.to_json()) for s in result.splits},
        counts=COUNTS if result.gaps else LEAKY,
        any_leaky=any(s.leaky for s in result.splits),
        costs=describe_costs(result),
        picture=data_uri(figure(result)),
    )
