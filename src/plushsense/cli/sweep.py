"""``plushsense sweep DATASET --grid paper|FILE``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import add_networks, add_work, marks

# Keys of the grid that an option changes, each an attribute of the arguments.
_CHANGES = (
    "split", "architectures", "filters", "epochs", "batches", "padding", "norm", "context", "classes", "device",
    "threads",
)  # fmt: skip


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument("--grid", default="paper", metavar="GRID", help="paper (default, 468 trials), or a TOML file")
    parser.add_argument(
        "--split",
        metavar="SPLIT",
        help="leave-one-subject-out, by-subject:K, by-recording:K; leaky, as in the paper: windows:holdout, windows:K "
        "(default: the grid's; paper windows:holdout)",
    )
    parser.add_argument(
        "--out", metavar="DIR", help="folder for the tables and sweep.json (default: DATASET/evaluations/sweep-GRID)"
    )
    parser.add_argument("--force", action="store_true", help="replace a sweep of another grid or data in --out")
    add_work(parser, "trainings")
    parser.add_argument("--seeds", type=int, metavar="N", help="seeds of every trial, 0 to N - 1 (default: the grid's)")
    add_networks(parser)
    parser.add_argument("--epochs", metavar="N,...", help="only these numbers of epochs (default: the grid's)")
    parser.add_argument("--batches", metavar="N,...", help="only these batches, windows or full (default: the grid's)")
    parser.add_argument("--padding", help="stream, causal or mirror (default: the grid's; paper mirror)")
    parser.add_argument("--norm", help="batch or layer (default: the grid's; paper batch)")
    parser.add_argument("--context", help="stream or loop (default: the grid's; paper loop)")
    parser.add_argument("--classes", metavar="LABELS", help="all, shared, or labels (default: the grid's; paper all)")
    parser.add_argument("--device", help="auto, cpu or cuda (default: the grid's; paper auto)")
    parser.add_argument(
        "--dry-run", action="store_true", help="say what would be trained and what is wrong; no training"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.run import report_jobs, sweep

    changes: dict[str, Any] = {key: getattr(args, key) for key in _CHANGES}
    if args.seeds is not None:
        # None at all is a problem of the grid, said with the others.
        changes["seeds"] = tuple(range(args.seeds))
    if args.dry_run:
        return _dry_run(args, changes)
    found = sweep(
        args.dataset,
        args.grid,
        out=None if args.out is None else Path(args.out),
        overwrite=args.force,
        workers=args.workers or 0,
        cluster=args.cluster,
        table=report_jobs,
        warn=warn,
        **changes,
    )
    shown = found.to_dict()
    say(f"written: {found.out}; a page of it:  plushsense report {found.out}")
    emit(args, shown, lines(shown))
    return 1 if shown["trainings_lost"] else 0


def _dry_run(args: argparse.Namespace, changes: dict[str, Any]) -> int:
    from plushsense.experiments.sweep.run import preview

    found = preview(args.dataset, args.grid, warn=warn, **changes)
    text = [f"- {line}" for line in found["problems"]]
    if not text:
        text = [
            *marks(found),
            f"{several(found['trials'], 'trial')} in {several(found['trainings'], 'training')} "
            f"({several(found['folds'], 'fold')}, {several(found['seeds'], 'seed')})",
            f"{several(found['held'], 'training')} done before; split {found['split']}",
            f"about {found['macs']:.2e} multiply-accumulates; trial by trial {found['macs_one_by_one']:.2e}",
            f"memory of each process: windows {found['windows_mb']:.0f} MB; a step of the largest training "
            + ("as PyTorch takes it" if found["training_mb"] is None else f"{found['training_mb']:.0f} MB"),
            "",
            table(("network", "share of the cost"), [(arch, f"{share:.1%}") for arch, share in found["cost"].items()]),
        ]
    emit(args, found, text)
    return 1 if found["problems"] else 0


def several(n: int, what: str) -> str:
    return f"{n} {what}{'s' * (n != 1)}"


def lines(s: dict[str, Any]) -> list[str]:
    """Format the best trials as text."""
    from plushsense.experiments.sweep.run import best_table

    out = marks(s)
    out.append(
        f"grid {s['name']}, split {s['split']}, context {s['context']}: {s['done']} of {s['trials']} trials done "
        f"({s['resumed']} from before)\n"
    )
    mark = " (leaky)" if s["leaky"] else ""
    out.append(best_table(s).text())
    picked = s["best_on_validation"]
    if picked is not None:
        out.append("")
        out.append(
            f"The best of {s['done']} on the test windows is partly luck. Chosen by validation macro-F1 it is "
            f"{picked['arch']} {picked['filters']}, {picked['epochs']} epochs, batch {picked['batch_asked']}: accuracy "
            f"{figure(picked['accuracy'])}, macro-F1 {figure(picked['macro_f1'])}{mark}."
        )
    for failed in s["failed"]:
        out.append(f"failed: {failed['arch']} {failed['filters']}, {failed['epochs']} epochs: {failed['why']}")
    return out
