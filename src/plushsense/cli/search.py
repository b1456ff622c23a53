"""``plushsense search DATASET --max-parameters P --max-state-bytes S --max-macs-per-step M``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import add_grid, add_out, add_work, grid_changes, marks
from plushsense.cli.sweep import several
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.experiments.search.run import SearchProgress

_SEARCH_OPTIONS = ("rungs", "folds", "share", "eta", "max_parameters", "max_state_bytes", "max_macs_per_step")


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--grid",
        default="paper",
        metavar="GRID",
        help="networks to try: paper (default, 52), or a TOML file with [grid] and [search]",
    )
    parser.add_argument("--max-parameters", type=int, metavar="P", help="only networks of at most P parameters")
    parser.add_argument(
        "--max-state-bytes", type=int, metavar="S", help="only networks of at most S bytes of 8-bit state"
    )
    parser.add_argument(
        "--max-macs-per-step", type=int, metavar="M", help="only networks of at most M multiply-accumulates in 50 ms"
    )
    parser.add_argument(
        "--split", metavar="SPLIT", help="by-subject:5 (default), leave-one-subject-out, by-recording:K, windows:K"
    )
    parser.add_argument("--rungs", metavar="N,...", help="epochs after which networks are compared (4,15,60)")
    parser.add_argument("--folds", metavar="N,...", help="folds to use in each rung but the last (default: all)")
    parser.add_argument(
        "--share",
        type=float,
        metavar="X",
        help="largest share of the cost of the whole grid (0.25; more if only few networks fit)",
    )
    parser.add_argument(
        "--eta", type=float, metavar="X", help="one in X continues after each rung, if the cost allows (2)"
    )
    defaults = {"batches": "64", "padding": "stream", "norm": "batch", "context": "stream", "classes": "shared"}
    add_grid(parser, {**defaults, "device": "auto", "seeds": "1"})
    default = "DATASET/evaluations/search-GRID-…"
    add_out(parser, "the tables and search.json", default, "a search of other settings or data")
    add_work(parser, "trainings")
    parser.add_argument(
        "--dry-run", action="store_true", help="print what would be tried, left out and spent, without training"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.search.run import search

    changes = grid_changes(args, "split", *_SEARCH_OPTIONS)
    if args.dry_run:
        return _dry_run(args, changes)
    done = search(
        args.dataset,
        args.grid,
        out=None if args.out is None else Path(args.out),
        overwrite=args.force,
        workers=args.workers or 0,
        cluster=args.cluster,
        progress=report_search(),
        warn=warn,
        **changes,
    )
    result = done.to_dict()
    say(f"written: {done.out}")
    emit(args, result, lines(result))
    return 0


def _dry_run(args: argparse.Namespace, changes: dict[str, Any]) -> int:
    from plushsense.experiments.search.run import preview_search

    found = preview_search(args.dataset, args.grid, warn=warn, **changes)
    text = [f"left out: {row['arch']} {row['filters']}: {row['why']}" for row in found["left_out"]]
    rungs = ", ".join(f"{e} epochs on {f} folds" for e, f in zip(found["rungs"], found["folds"], strict=True))
    text += [
        *marks(found),
        f"{several(found['candidates'], 'network')}, split {found['split']}, {several(found['seeds'], 'seed')}; "
        f"compared after {rungs}",
        f"at most {found['bound_macs']:.2e} multiply-accumulates, {found['bound_share']:.0%} of the whole grid's "
        f"{found['grid_macs']:.2e}; the first rung takes {found['first_share']:.1%}",
    ]
    emit(args, found, text)
    return 0


def report_search() -> Callable[[SearchProgress], None]:
    """Return a callback that reports the rungs of a search."""
    reporters: dict[int, ProgressReporter] = {}

    def report(at: SearchProgress) -> None:
        title = f"search, rung {at.rung} of {at.rungs}, networks {at.networks}"
        reporter = reporters.setdefault(at.rung, ProgressReporter(title, "trainings", keep=True))
        best = "" if at.best is None else f"best so far {at.best.name} {at.best.score:.3f}"
        epoch = f"{at.name} epoch {at.epoch} of {at.epochs}" if at.epoch else ""
        detail = ", ".join(filter(None, (best, epoch)))
        reporter(at.done, at.total, detail=detail, resumed=at.resumed, share=at.share)

    return report


def lines(s: dict[str, Any]) -> list[str]:
    """Format the rungs, the best network and those equal to it."""
    from plushsense.scoring.metrics import column_metrics

    out = marks(s)
    mark = " (leaky)" if s["leaky"] else ""
    beyond = f" within the limits, {len(s['left_out'])} beyond" if s["left_out"] else ""
    out.append(
        f"{several(s['candidates'], 'network')}{beyond}; split {s['split']}, context {s['context']}, "
        f"{several(len(s['grid']['seeds']), 'seed')}\n"
    )
    out.append(_rungs(s, mark))
    best, cost = s["winner"], s["cost"]
    out.append("")
    out.append(
        table(
            ("to the end", "filters", "batch", "parameters", "MAC/step", "state bytes",
             *(f"{metric.name}{mark}" for metric in column_metrics().values()), "over folds", "over seeds", ""),
            [_finalist(row) for row in s["finalists"]],
        )
    )  # fmt: skip
    out.append(
        "Pareto: none other that was trained to the end is as good and smaller; equal: within one standard error."
    )
    out.append(
        f"\nBest: {best['arch']} with {best['filters']}, macro-F1 {figure(best['macro_f1'])}{mark} over "
        f"{best['folds']} folds. It is the best of {s['chosen_among']} on these people: slightly too high."
    )
    small = s["smallest_equal"]
    if small["trial"] != best["trial"]:
        out.append(
            f"Smallest within one standard error: {small['arch']} with {small['filters']}, {small['parameters']:,} "
            f"parameters, macro-F1 {figure(small['macro_f1'])}{mark}."
        )
    out.append(
        f"Cost: {cost['macs']:.2e} multiply-accumulates of training, {cost['share']:.1%} of the whole grid's "
        f"{cost['grid_macs']:.2e} (bound {cost['bound_share']:.0%}); {cost['training_seconds']:.0f} s of training."
    )
    out.append(f"Train it on everybody:\n  {s['command']}")
    return out


def _rungs(s: dict[str, Any], mark: str) -> str:
    """Format a row for each network, the longest trained first: its score after each rung, and why it stopped."""
    rows: dict[tuple[str, str, str], list[object]] = {}
    for i, rung in enumerate(s["rungs"]):
        for n in rung["networks"]:
            row = rows.setdefault((n["arch"], n["filters"], n["batch_asked"]), [None] * len(s["rungs"]) + [""])
            row[i], row[-1] = figure(n["macro_f1"]), n["went"]
    # The order of the last rung that each was in.
    names = [(n["arch"], n["filters"], n["batch_asked"]) for rung in reversed(s["rungs"]) for n in rung["networks"]]
    title = [f"after {rung['epochs']}" for rung in s["rungs"]]
    text = [
        f"macro-F1{mark} after each rung of epochs",
        table(("network", "filters", "batch", *title, ""), [(*name, *rows[name]) for name in dict.fromkeys(names)]),
    ]
    for rung in s["rungs"]:
        error = rung["standard_error"]
        apart = "" if error is None else f", standard error of a difference {figure(error)}"
        entered, folds = several(rung["entered"], "network"), several(rung["folds"], "fold")
        text.append(
            f"up to epoch {rung['epochs']}: {entered} on {folds}, {rung['share']:.1%} of the grid's cost{apart}"
        )
    return "\n".join(text)


def _finalist(row: dict[str, Any]) -> tuple[object, ...]:
    from plushsense.scoring.metrics import column_metrics

    marks = ["Pareto"] * row["pareto"] + ["equal"] * row["equals_best"]
    spread = (f"± {figure(row[key])}" if row[key] is not None else "" for key in ("sd_folds", "sd_seeds"))
    sizes = (row[key] for key in ("parameters", "macs_per_step", "state_bytes_int8"))
    scores = (figure(row[key]) for key in column_metrics())
    return (row["arch"], row["filters"], row["batch_asked"], *sizes, *scores, *spread, ", ".join(marks))
