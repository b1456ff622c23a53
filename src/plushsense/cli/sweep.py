"""Implement ``plushsense sweep``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import grid_changes, marks, work_options
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.experiments.sweep.folder import SweepResult
    from plushsense.experiments.sweep.halving import Halving, RungResult
    from plushsense.experiments.sweep.run import SweepPreview

_GRID_OPTIONS = ("split", "epochs", "share", "eta", "max_parameters", "max_state_bytes", "max_macs_per_step")
# Settings that the lines above them already name.
_NAMED = ("name", "architectures", "filters", "split", "seeds")


def run_sweep(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.run import preview, sweep

    changes = grid_changes(args, *_GRID_OPTIONS) | options(args, "keep_predictions")
    # Without the option, the grid's file decides.
    changes["halving"] = args.halving or None
    if args.dry_run:
        plan = preview(args.dataset, args.grid, warn=warn, **changes)
        emit(args, plan.to_json(), _preview_lines(plan))
        return 1 if plan.problems else 0
    done = sweep(args.dataset, args.grid, **work_options(args), display=True, warn=warn, **changes)
    say(f"written: {done.out}; make a page of it with  plushsense report {done.out}")
    emit(args, {**done.to_json(), "out": str(done.out)}, _result_lines(done))
    return 1 if done.trainings_lost else 0


def _preview_lines(preview: SweepPreview) -> list[str]:
    """Format the plan of a sweep as text, or the problems of its grid if there are any."""
    if preview.problems:
        return [f"- {line}" for line in preview.problems]
    plan = preview.to_json()
    lines = [
        *(f"left out: {row['arch']} {row['filters']}: {row['why']}" for row in plan["left_out"]),
        *marks(plan),
        f"{plural(plan['trials'], 'trial')} in {plural(plan['trainings'], 'training')} "
        f"({plural(plan['folds'], 'fold')}, {plural(plan['seeds'], 'seed')})",
        f"{plural(plan['held'], 'training')} done before; split {plan['split']}",
        f"about {plan['macs']:.2e} multiply-accumulates",
        f"memory of each process: windows {plan['windows_mb']:.0f} MB; a step of the largest training "
        + ("as PyTorch takes it" if plan["training_mb"] is None else f"{plan['training_mb']:.0f} MB"),
    ]
    if preview.halving is not None:
        halving = plan["halving"]
        lines.append(
            f"halving: {plural(halving['networks'], 'network')} after {', '.join(map(str, halving['rungs']))} epochs, "
            f"at most {halving['bound_macs']:.2e} multiply-accumulates, {halving['bound_share']:.0%} of all; the "
            f"first rung takes {halving['first_share']:.1%}"
        )
    grid = {key: value for key, value in plan["grid"].items() if key not in _NAMED and value is not None}
    settings = [(key, _text(value)) for key, value in {**grid, **plan["training"]}.items()]
    return [
        *lines,
        "",
        table(("setting", "value"), settings),
        "",
        table(("network", "share of the cost"), [(arch, f"{share:.1%}") for arch, share in plan["cost"].items()]),
    ]


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return "none" if value is None else str(value)


def _result_lines(done: SweepResult) -> list[str]:
    """Format the best trials of a sweep as text."""
    head = done.head
    mark = " (leaky)" if head.leaky else ""
    out = marks({"simulated": head.simulated, "leaky": head.leaky})
    out.append(
        f"grid {head.name}, split {head.split}, context {head.context}: {len(done.done)} of "
        f"{plural(len(done.results), 'trial')} done ({done.resumed} from before)\n"
    )
    out.append(done.best_table().text())
    picked = done.best_on_validation
    if picked is not None:
        row = picked.row()
        out.append("")
        out.append(
            f"The best of {len(done.done)} on the test windows is partly luck. Chosen by validation macro-F1 it is "
            f"{row['arch']} {row['filters']}, {row['epochs']} epochs, batch {row['batch_asked']}: accuracy "
            f"{figure(row['accuracy'])}, macro-F1 {figure(row['macro_f1'])}{mark}."
        )
    if done.halving is not None:
        out += ["", *_halving_lines(done.halving, mark)]
    return out + [f"failed: {one.arch} {one.filters}, {one.epochs} epochs: {one.why}" for one in done.failed]


def _halving_lines(halving: Halving, mark: str) -> list[str]:
    """Format halving as text: the rungs, the best network, the cost, and the command that trains it."""
    found, costs = halving.found, halving.costs
    best, small = halving.winner, halving.smallest_equal
    lines = [*_rung_lines(halving, mark), ""]
    lines.append(
        f"Best: {best.trial.arch.symbol} with {best.trial.network[1]}, macro-F1 {figure(best.mean('macro_f1'))}{mark}. "
        f"It is the best of {len(halving.networks)} on these people: slightly too high."
    )
    if small is not best:
        lines.append(
            f"Smallest within one standard error: {small.trial.arch.symbol} with {small.trial.network[1]}, "
            f"{small.trial.arch.parameters:,} parameters, macro-F1 {figure(small.mean('macro_f1'))}{mark}."
        )
    lines.append(
        f"Cost: {found.spent:.2e} multiply-accumulates of training, {found.spent / costs.whole:.1%} of the whole "
        f"grid's {costs.whole:.2e} (bound {costs.share:.0%})."
    )
    return [*lines, f"Train it on everybody:\n  {halving.command}"]


def _rung_lines(halving: Halving, mark: str) -> list[str]:
    """Format a row for each network, the longest trained first, with its score after each rung and why it stopped."""
    rungs = halving.to_json()["rungs"]
    rows: dict[tuple[str, str, str], list[object]] = {}
    for i, rung in enumerate(rungs):
        for n in rung["networks"]:
            row = rows.setdefault((n["arch"], n["filters"], n["batch_asked"]), [None] * len(rungs) + [""])
            row[i], row[-1] = figure(n["macro_f1"]), n["went"]
    # Sort networks by the last rung that they reached, in the order of that rung.
    names = [(n["arch"], n["filters"], n["batch_asked"]) for rung in reversed(rungs) for n in rung["networks"]]
    heads = ("network", "filters", "batch", *(f"after {rung['epochs']}" for rung in rungs), "")
    return [
        f"macro-F1{mark} after each rung of epochs",
        table(heads, [(*name, *rows[name]) for name in dict.fromkeys(names)]),
        *(_cost_line(finished, halving.costs.whole) for finished in halving.found.rungs),
    ]


def _cost_line(finished: RungResult, whole: float) -> str:
    rung, error = finished.rung, finished.error
    apart = "" if error is None else f", standard error of a difference {figure(error)}"
    entered = plural(len(rung.entered), "network")
    return f"up to epoch {rung.epochs}: {entered}, {rung.cost / whole:.1%} of the grid's cost{apart}"
