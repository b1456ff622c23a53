"""``plushsense search DATASET --max-parameters P --max-state-bytes S --max-macs-per-step M``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import add_networks, add_work, marks
from plushsense.cli.sweep import several
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.experiments.search.run import SearchProgress

# Keys of the grid that an option changes, each an attribute of the arguments.
_CHANGES = (
    "split",
    "architectures",
    "filters",
    "batches",
    "padding",
    "norm",
    "context",
    "classes",
    "device",
    "threads",
)
_ASKED = ("rungs", "folds", "share", "eta", "max_parameters", "max_state_bytes", "max_macs_per_step")


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--grid",
        default="paper",
        metavar="GRID",
        help="whose networks are tried: paper (default, 52), or a TOML file with [grid] and [search]",
    )
    parser.add_argument("--max-parameters", type=int, metavar="P", help="only networks of at most P parameters")
    parser.add_argument(
        "--max-state-bytes", type=int, metavar="S", help="of at most S bytes of state between samples, 8-bit"
    )
    parser.add_argument(
        "--max-macs-per-step", type=int, metavar="M", help="of at most M multiply-accumulates a step of 50 ms"
    )
    parser.add_argument(
        "--split", metavar="SPLIT", help="by-subject:5 (default), leave-one-subject-out, by-recording:K, windows:K"
    )
    parser.add_argument("--rungs", metavar="N,...", help="epochs after which networks are compared (4,15,60)")
    parser.add_argument("--folds", metavar="N,...", help="folds that the rungs before the last look at (default: all)")
    parser.add_argument(
        "--share",
        type=float,
        metavar="X",
        help="of the cost of the whole grid, at most (0.25; more if only few networks fit)",
    )
    parser.add_argument("--eta", type=float, metavar="X", help="one in X goes on from each rung, if cost allows (2)")
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds of every training, 0 to N - 1 (1)")
    add_networks(parser)
    parser.add_argument("--batches", metavar="N,...", help="windows a batch, or full (64)")
    parser.add_argument("--padding", help="stream (default), causal or mirror")
    parser.add_argument("--norm", help="batch (default) or layer")
    parser.add_argument("--context", help="stream (default) or loop")
    parser.add_argument("--classes", metavar="LABELS", help="shared (default), all, or labels")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for the tables and search.json (default: DATASET/evaluations/search-GRID-…)",
    )
    parser.add_argument("--force", action="store_true", help="replace a search of another grid or data in --out")
    add_work(parser, "trainings")
    parser.add_argument("--device", help="auto (default), cpu or cuda")
    parser.add_argument(
        "--dry-run", action="store_true", help="say what would be tried, left out and spent; no training"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.search.run import search

    changes: dict[str, Any] = {key: getattr(args, key) for key in _CHANGES}
    if args.seeds is not None:
        changes["seeds"] = tuple(range(args.seeds))
    asked = {key: getattr(args, key) for key in _ASKED}
    if args.dry_run:
        return _dry_run(args, changes, asked)
    found = search(
        args.dataset,
        args.grid,
        **asked,
        out=None if args.out is None else Path(args.out),
        overwrite=args.force,
        workers=args.workers or 0,
        cluster=args.cluster,
        progress=report_search(),
        warn=warn,
        **changes,
    )
    shown = found.to_dict()
    say(f"written: {found.out}")
    emit(args, shown, lines(shown))
    return 0


def _dry_run(args: argparse.Namespace, changes: dict[str, Any], asked: dict[str, Any]) -> int:
    from plushsense.experiments.search.run import preview_search

    found = preview_search(args.dataset, args.grid, asked=asked, changes=changes, warn=warn)
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
        best = "" if at.best is None else f"best so far {at.best[0]} {at.best[1]:.3f}"
        epoch = f"{at.what} epoch {at.epoch} of {at.epochs}" if at.epoch else ""
        detail = ", ".join(filter(None, (best, epoch)))
        reporter(at.done, at.trainings, detail=detail, resumed=at.resumed, share=at.share)

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
        f"{best['folds']} folds. It is the best of {s['chosen_among']} on these people, which flatters it a little."
    )
    small = s["smallest_equal"]
    if small["trial"] != best["trial"]:
        out.append(
            f"Smallest that cannot be told from it: {small['arch']} with {small['filters']}, {small['parameters']:,} "
            f"parameters, macro-F1 {figure(small['macro_f1'])}{mark}."
        )
    out.append(
        f"Cost: {cost['macs']:.2e} multiply-accumulates of training, {cost['share']:.1%} of the whole grid's "
        f"{cost['grid_macs']:.2e} (bound {cost['bound_share']:.0%}); {cost['training_seconds']:.0f} s of training."
    )
    out.append(f"Train it on everybody:\n  {s['command']}")
    return out


def _rungs(s: dict[str, Any], mark: str) -> str:
    """Format one row a network, the longest trained first: its score after each rung, and why it stopped."""
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
