"""The tables of a sweep that mirror the paper's: the best trials, Table 3, Table 4, one trial by gesture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from plushsense.models.arch import TABLE3_MISPRINT
from plushsense.models.symbol import slashed
from plushsense.reports import sweep_paper as paper
from plushsense.reports.sweep_results import Network, Row, Sweep, acr, finite
from plushsense.reports.sweep_rows import Column, Table, name_of, schedule, yes
from plushsense.reports.words import count

TOP = 3
"""Networks of a size class in Table 4, as in the paper."""


def best_trials(sweep: Sweep, top: int = 10) -> Table:
    """The trials with the highest accuracy, of equal ones the smallest first."""
    ranked = sorted(sweep.done, key=lambda t: (-float(t["accuracy"]), int(t["parameters"])))[:top]
    spread = any(
        finite(t.get("accuracy_sd")) and int(t.get("seeds") or 1) * int(t.get("folds") or 1) > 1 for t in ranked
    )
    columns = [
        Column("arch", "Architecture"),
        Column("filters", "Filters"),
        Column("epochs", "Epochs", "count"),
        Column("batch_asked", "Batch"),
        Column("parameters", "Parameters", "count"),
        Column("accuracy", "Accuracy", "percent", score=True),
        *([Column("accuracy_sd", "± sd", "percent", score=True)] if spread else []),
        Column("macro_f1", "Macro-F1", "share", score=True),
        *([Column("macro_f1_sd", "± sd", "share", score=True)] if spread else []),
        Column("validation_accuracy", "Accuracy on validation", "percent", score=True),
        *([Column("status", "Status")] if any(t.get("status", "done") != "done" for t in ranked) else []),
        Column("trial", "Trial"),
    ]
    notes = ["Ranked on the test part itself, as the paper did: the first of many is flattered by luck."]
    return Table("best-trials", "The best trials", tuple(columns), tuple(ranked), tuple(notes))


def table3(sweep: Sweep) -> Table:
    """Parameters for each architecture and filter set, beside what the paper prints."""
    sets = sweep.filter_sets[::-1]
    cells: dict[tuple[str, str], Network] = {(n.label, n.filter_set): n for n in sweep.networks}
    rows, met, near, off, seen = [], 0, 0, [], False
    other = any(
        paper.printed(n.arch, n.filters) and paper.counted(n.arch, n.filters) != n.parameters for n in sweep.networks
    )
    for label in dict.fromkeys(n.label for n in sweep.networks):
        row: dict[str, Any] = {"arch": label}
        for filter_set in sets:
            network = cells.get((label, filter_set))
            if network is None:
                continue
            said = paper.printed(network.arch, network.filters)
            row[f"{filter_set} ours"] = network.parameters
            row[f"{filter_set} paper"] = said
            if said is None:
                continue
            seen = True
            ours = row[f"{filter_set} at the paper's size"] = paper.counted(network.arch, network.filters)
            if paper.misprint(network.arch, network.filters):
                row[f"{filter_set} paper"] = f"{said} (misprint?)"
                off.append(f"{label} at {network.filters}: we count {count(ours)}, the paper prints {said}")
            elif paper.meets(said, ours):
                met += 1
            elif abs(ours / paper.value_of(said) - 1) <= 0.04:
                near += 1
            else:
                off.append(f"{label} at {network.filters}: we count {count(ours)}, the paper prints {said}")
        rows.append(row)
    columns = [Column("arch", "Architecture")]
    for filter_set in sets:
        columns.append(Column(f"{filter_set} ours", f"[{filter_set.replace('/', ' ')}] ours", "count"))
        if seen and other:
            head = f"at {paper.PAPER_CHANNELS} channels, {paper.PAPER_CLASSES} classes"
            columns.append(Column(f"{filter_set} at the paper's size", head, "count"))
        if seen:
            columns.append(Column(f"{filter_set} paper", "paper"))
    return Table(
        "table-3",
        "Learnable parameters (the paper's Table 3)",
        tuple(columns),
        tuple(rows),
        tuple(_table3_words(met, near, off, other)),
    )


def _table3_words(met: int, near: int, off: Sequence[str], other: bool) -> list[str]:
    total = met + near + len(off)
    if not total:
        return ["None of these networks is in the paper's Table 3."]
    words = [
        f"Of {total} cells that the paper prints, {met} meet our count to the printed digits (rounded or cut off)"
        + (f", {near} more within 4\N{NO-BREAK SPACE}%" if near else "")
        + (f". Not: {'; '.join(off)}." if off else ".")
    ]
    arch, filters = TABLE3_MISPRINT
    if any(said.startswith(f"{arch} at {slashed(filters)}") for said in off):
        words.append(
            f"The cell of {arch} looks like a misprint: the paper's other three sizes of it agree with our count "
            "within 1 %."
        )
    if other:
        words.append(
            f"The paper counts for {paper.PAPER_CHANNELS} channels and {paper.PAPER_CLASSES} classes; the data of this "
            "sweep have others, so that ours stand beside the same network counted at the paper's size."
        )
    return words


def top_networks(sweep: Sweep, top: int = TOP) -> list[Network]:
    """The ``top`` networks of every size class by their best trial, all together from the best down."""
    found: list[Network] = []
    for filter_set in sweep.filter_sets:
        mine = [n for n in sweep.networks if n.filter_set == filter_set and n.done]
        found += sorted(mine, key=_rank)[:top]
    return sorted(found, key=_rank)


def _rank(network: Network) -> tuple[float, int]:
    best = network.best()
    return (-float(best["accuracy"]) if best else 0.0, network.parameters)


def table4(sweep: Sweep, *, threshold: float = paper.PAPER_THRESHOLD, top: int = TOP) -> Table:
    """The best networks of each size class, the paper's figures beside ours where it has them."""
    rows = [_table4_row(n, threshold) for n in top_networks(sweep, top)]
    beside = any(row["paper_accuracy"] is not None for row in rows)
    over = [n for n in sweep.networks if (b := n.best()) and float(b["accuracy"]) > threshold]
    columns = [
        Column("arch", "Architecture"),
        Column("filters", "Filters"),
        Column("parameters", "Parameters", "count"),
        Column("accuracy", "Highest accuracy", "percent", score=True),
        Column("schedule", "by (epochs, batch)"),
        Column("mean_accuracy", "Mean accuracy", "percent", score=True),
        Column("trials", "over trials", "count"),
        Column("acr", "ACR", "percent", score=True),
        Column("macro_f1", "Macro-F1", "share", score=True),
        Column("validated_accuracy", "Accuracy, chosen by validation", "percent", score=True),
        Column("above", f"above {100 * threshold:g} %"),
    ]
    if beside:
        columns += [
            Column("paper_accuracy", "Paper: highest (leaky)", "percent"),
            Column("paper_mean", "Paper: mean (leaky)", "percent"),
            Column("paper_acr", "Paper: ACR (leaky)", "percent"),
        ]
    scored = sum(bool(n.done) for n in sweep.networks)
    words = [
        f"The best {top} of each size class (a filter set), by their highest accuracy over epochs and batch; the mean "
        "is over the same trials. The highest is picked on the test part, as the paper did, and so is optimistic: "
        "beside it, the test accuracy of the trial that validation would have picked.",
        f"The paper heads its Table 4 with accuracy above {100 * paper.PAPER_THRESHOLD:g} %, and prints two rows below "
        f"that; here {len(over)} of {scored} scored networks are above {100 * threshold:g} %, and rows below stay, "
        "marked. ACR = accuracy / log10(parameters).",
    ]
    if beside:
        words.append(
            "The paper's figures are of its own recordings, split over windows (leaky): of other data than these, "
            "unless the data set above is the paper's."
        )
    return Table(
        "table-4", "The best of each size class (the paper's Table 4)", tuple(columns), tuple(rows), tuple(words)
    )


def _table4_row(network: Network, threshold: float) -> dict[str, Any]:
    best, validated = network.best(), network.best("validation_accuracy")
    assert best is not None
    said = paper.TABLE4.get((network.arch, network.filters))
    return {
        "arch": network.label,
        "filters": network.filters,
        "filter_set": network.filter_set,
        "parameters": network.parameters,
        "accuracy": best["accuracy"],
        "schedule": schedule(best),
        "mean_accuracy": network.mean(),
        "trials": len(network.done),
        "acr": acr(best["accuracy"], network.parameters),
        "macro_f1": best["macro_f1"],
        "validated_accuracy": validated["accuracy"] if validated else None,
        "above": yes(float(best["accuracy"]) > threshold),
        "paper_accuracy": said.highest if said else None,
        "paper_mean": said.mean if said else None,
        "paper_acr": said.acr if said else None,
    }


def per_class(sweep: Sweep, trial: Row) -> Table | None:
    """Recall, precision and F1 of each gesture in one trial; None where they were not kept."""
    kept = (sweep.head.get("per_class") or {}).get(trial["trial"])
    if not isinstance(kept, Sequence) or not all(isinstance(row, Mapping) for row in kept) or not kept:
        return None
    affects = dict(zip(sweep.labels, sweep.affects, strict=True))
    rows = tuple({**row, "affect": affects.get(str(row.get("label")))} for row in kept)
    columns = (
        Column("label", "Gesture"),
        Column("affect", "Affect"),
        Column("f1", "F1", "share", score=True),
        Column("recall", "Recall", "share", score=True),
        Column("precision", "Precision", "share", score=True),
        Column("support", "Windows", "count"),
    )
    return Table(f"per-class-{trial['trial']}", f"By gesture: {name_of(trial)}", columns, rows)
