"""Implement ``plushsense sweep DATASET --grid paper|FILE``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.output import emit, figure, plural, say, table, warn
from plushsense.cli.settings import grid_changes, marks, work_options


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.run import preview, sweep

    changes = grid_changes(args, "split", "epochs")
    if args.dry_run:
        plan = preview(args.dataset, args.grid, warn=warn, **changes)
        emit(args, plan, preview_lines(plan))
        return 1 if plan["problems"] else 0
    done = sweep(args.dataset, args.grid, **work_options(args), display=True, warn=warn, **changes)
    result = done.to_dict()
    say(f"written: {done.out}; make a page of it with  plushsense report {done.out}")
    emit(args, result, lines(result))
    return 1 if result["trainings_lost"] else 0


def preview_lines(plan: dict[str, Any]) -> list[str]:
    """Format the plan of a sweep as text, or the problems of its grid if there are any."""
    if plan["problems"]:
        return [f"- {line}" for line in plan["problems"]]
    return [
        *marks(plan),
        f"{plural(plan['trials'], 'trial')} in {plural(plan['trainings'], 'training')} "
        f"({plural(plan['folds'], 'fold')}, {plural(plan['seeds'], 'seed')})",
        f"{plural(plan['held'], 'training')} done before; split {plan['split']}",
        f"about {plan['macs']:.2e} multiply-accumulates; trial by trial {plan['macs_one_by_one']:.2e}",
        f"memory of each process: windows {plan['windows_mb']:.0f} MB; a step of the largest training "
        + ("as PyTorch takes it" if plan["training_mb"] is None else f"{plan['training_mb']:.0f} MB"),
        "",
        table(("network", "share of the cost"), [(arch, f"{share:.1%}") for arch, share in plan["cost"].items()]),
    ]


def lines(s: dict[str, Any]) -> list[str]:
    """Format the best trials of a sweep as text."""
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
