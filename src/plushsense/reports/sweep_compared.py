"""Networks of a sweep compared: by architecture, by ACR, by epochs and batch, and the fronts that none beats."""

from __future__ import annotations

import statistics
from typing import Any

from plushsense.reports.sweep_results import Network, Sweep, acr, finite
from plushsense.reports.sweep_rows import Column, Table, schedule, spread
from plushsense.training.search import pareto as on_front

SHOWN = 20
"""Rows of a long table on the page; its CSV has all."""
COSTS: dict[str, str] = {
    "parameters": "Parameters",
    "macs_per_step": "Multiply-accumulates a step",
    "state_bytes_int8": "State on the chip (bytes, int8)",
}


def architectures(sweep: Sweep, filter_set: str | None = None) -> list[dict[str, Any]]:
    """Highest and mean accuracy of each architecture, over all filter sets or one; the figures of Figs 7 and 8."""
    rows = []
    for label in dict.fromkeys(n.label for n in sweep.networks):
        mine = [n for n in sweep.networks if n.label == label and filter_set in (None, n.filter_set)]
        scores = [float(t["accuracy"]) for n in mine for t in n.done]
        if mine:
            rows.append(
                {
                    "arch": label,
                    "filter_set": filter_set or "all",
                    "highest": max(scores, default=None),
                    "mean": statistics.fmean(scores) if scores else None,
                    "sd": spread(scores),
                    "trials": len(scores),
                    "parameters": max(n.parameters for n in mine),
                }
            )
    return rows


def architecture_table(sweep: Sweep) -> Table:
    """The numbers of Figures 7 and 8."""
    parts: list[str | None] = [None, *(sweep.filter_sets if len(sweep.filter_sets) > 1 else [])]
    columns = (
        Column("arch", "Architecture"),
        Column("filter_set", "Filter set"),
        Column("highest", "Highest accuracy", "percent", score=True),
        Column("mean", "Mean accuracy", "percent", score=True),
        Column("sd", "sd over trials", "percent", score=True),
        Column("trials", "Trials", "count"),
        Column("parameters", "Parameters (of the largest)", "count"),
    )
    rows = tuple(row for part in parts for row in architectures(sweep, part))
    shown = len(architectures(sweep))
    return Table("architectures", "Each architecture over all its trials", columns, rows, (), shown)


def acr_ranking(sweep: Sweep) -> Table:
    """All networks by the accuracy–complexity ratio of their best trial."""
    rows = [
        {
            "arch": n.label,
            "filters": n.filters,
            "parameters": n.parameters,
            "accuracy": b["accuracy"],
            "macro_f1": b["macro_f1"],
        }
        | {"acr": acr(b["accuracy"], n.parameters)}
        for n in sweep.networks
        if (b := n.best())
    ]
    rows.sort(key=lambda r: -(r["acr"] or 0.0))
    for rank, row in enumerate(rows, start=1):
        row["rank"] = rank
    columns = (
        Column("rank", "Rank", "count"),
        Column("arch", "Architecture"),
        Column("filters", "Filters"),
        Column("parameters", "Parameters", "count"),
        Column("acr", "ACR", "percent", score=True),
        Column("accuracy", "Highest accuracy", "percent", score=True),
        Column("macro_f1", "Macro-F1", "share", score=True),
    )
    words = [
        "ACR = accuracy / log10(parameters), in percent (paper, 3.6.3). It favours the small: ten times the parameters "
        "must buy much accuracy to rank higher."
    ]
    return Table("acr", "Accuracy–complexity ratio", columns, tuple(rows), tuple(words), SHOWN)


def batches(sweep: Sweep) -> list[str]:
    """The batches as asked for, small to large, "full" last."""
    asked = {str(t["batch_asked"]) for t in sweep.trials}
    return sorted(asked, key=lambda b: (not b.isdecimal(), int(b) if b.isdecimal() else 0))


def epochs(sweep: Sweep) -> list[int]:
    return sorted({int(t["epochs"]) for t in sweep.trials})


def compared(sweep: Sweep) -> tuple[list[Network], bool]:
    """The networks that the effect of epochs and batch is taken over, and whether each has every schedule scored."""
    every = {(int(t["epochs"]), str(t["batch_asked"])) for t in sweep.trials}
    whole = [n for n in sweep.networks if {(int(t["epochs"]), str(t["batch_asked"])) for t in n.done} == every]
    return (whole, True) if whole else ([n for n in sweep.networks if n.done], False)


def effect(sweep: Sweep) -> Table:
    """Mean and spread over the networks for each number of epochs and batch."""
    networks, whole = compared(sweep)
    rows = []
    for e in epochs(sweep):
        for b in batches(sweep):
            mine = [t for n in networks for t in n.done if (t["epochs"], str(t["batch_asked"])) == (e, b)]
            scores = [float(t["accuracy"]) for t in mine]
            f1 = [float(t["macro_f1"]) for t in mine if finite(t["macro_f1"])]
            if scores:
                rows.append(
                    {
                        "epochs": e,
                        "batch_asked": b,
                        "networks": len(scores),
                        "accuracy": statistics.fmean(scores),
                        "accuracy_sd": spread(scores),
                        "highest": max(scores),
                        "macro_f1": statistics.fmean(f1) if f1 else None,
                        "macro_f1_sd": spread(f1),
                    }
                )
    columns = (
        Column("epochs", "Epochs", "count"),
        Column("batch_asked", "Batch"),
        Column("networks", "Networks", "count"),
        Column("accuracy", "Mean accuracy", "percent", score=True),
        Column("accuracy_sd", "sd over networks", "percent", score=True),
        Column("highest", "Highest", "percent", score=True),
        Column("macro_f1", "Mean macro-F1", "share", score=True),
        Column("macro_f1_sd", "sd", "share", score=True),
    )
    said = (
        f"Over the {len(networks)} networks that have every schedule scored, so that the rows differ in nothing else."
        if whole
        else "No network has every schedule scored yet: each row is over others, and they are not to be compared."
    )
    return Table(
        "effect",
        "Effect of epochs and batch",
        columns,
        tuple(rows),
        (said, "The spread is over networks, not over seeds.") if rows else (),
    )


def pareto_points(sweep: Sweep, cost: str) -> list[dict[str, Any]]:
    """Each network with its cost, its best macro-F1, and whether it is on the front."""
    rows = [
        {
            "cost": cost,
            "value": int(t[cost]),
            "macro_f1": float(t["macro_f1"]),
            "arch": n.label,
            "filters": n.filters,
            "filter_set": n.filter_set,
            "schedule": schedule(t),
            "trial": t["trial"],
        }
        for n in sweep.networks
        if (t := n.best("macro_f1")) and finite(t.get(cost)) and t[cost] > 0
    ]
    for row, on in zip(rows, on_front([(r["macro_f1"], r["value"]) for r in rows]), strict=True):
        row["front"] = on
    return sorted(rows, key=lambda r: (r["value"], -r["macro_f1"]))


def pareto(sweep: Sweep) -> Table:
    """The members of the three fronts."""
    rows = [{**r, "cost": COSTS[cost]} for cost in COSTS for r in pareto_points(sweep, cost) if r["front"]]
    columns = (
        Column("cost", "Front of macro-F1 against"),
        Column("value", "Cost", "count"),
        Column("macro_f1", "Macro-F1", "share", score=True),
        Column("arch", "Architecture"),
        Column("filters", "Filters"),
        Column("schedule", "by (epochs, batch)"),
        Column("trial", "Trial"),
    )
    words = [
        "On a front is a network that no other beats in both; of equal ones, each. A network counts with its best "
        "macro-F1 over epochs and batch, picked on the test part."
    ]
    return Table("pareto", "Pareto fronts", columns, tuple(rows), tuple(words))
