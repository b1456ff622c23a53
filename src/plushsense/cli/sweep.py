"""Implement ``plushsense sweep`` and ``search``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import grid_changes, marks, work_options
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.experiments.search.run import SearchProgress

_SEARCH_OPTIONS = ("rungs", "folds", "share", "eta", "max_parameters", "max_state_bytes", "max_macs_per_step")


def run_sweep(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.run import preview, sweep

    changes = grid_changes(args, "split", "epochs") | options(args, "keep_predictions")
    if args.dry_run:
        plan = preview(args.dataset, args.grid, warn=warn, **changes)
        emit(args, plan, _sweep_plan_lines(plan))
        return 1 if plan["problems"] else 0
    done = sweep(args.dataset, args.grid, **work_options(args), display=True, warn=warn, **changes)
    result = done.to_dict()
    say(f"written: {done.out}; make a page of it with  plushsense report {done.out}")
    emit(args, result, _sweep_lines(result))
    return 1 if result["trainings_lost"] else 0


def _sweep_plan_lines(plan: dict[str, Any]) -> list[str]:
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


def _sweep_lines(s: dict[str, Any]) -> list[str]:
    """Format the best trials of a sweep as text."""
    from plushsense.experiments.sweep.run import best_table

    out = marks(s)
    out.append(
        f"grid {s['name']}, split {s['split']}, context {s['context']}: {s['done']} of "
        f"{plural(s['trials'], 'trial')} done "
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


def run_search(args: argparse.Namespace) -> int:
    from plushsense.experiments.search.run import preview_search, search

    changes = grid_changes(args, "split", *_SEARCH_OPTIONS)
    if args.dry_run:
        plan = preview_search(args.dataset, args.grid, warn=warn, **changes)
        emit(args, plan, _search_plan_lines(plan))
        return 0
    done = search(args.dataset, args.grid, **work_options(args), progress=report_search(), warn=warn, **changes)
    result = done.to_dict()
    say(f"written: {done.out}")
    emit(args, result, _search_lines(result))
    return 0


def _search_plan_lines(plan: dict[str, Any]) -> list[str]:
    """Format the plan of a search as text: networks to compare, networks left out, and the cost."""
    rungs = ", ".join(f"{e} epochs on {plural(f, 'fold')}" for e, f in zip(plan["rungs"], plan["folds"], strict=True))
    return [
        *(f"left out: {row['arch']} {row['filters']}: {row['why']}" for row in plan["left_out"]),
        *marks(plan),
        f"{plural(plan['candidates'], 'network')}, split {plan['split']}, {plural(plan['seeds'], 'seed')}; "
        f"compared after {rungs}",
        f"at most {plan['bound_macs']:.2e} multiply-accumulates, {plan['bound_share']:.0%} of the whole grid's "
        f"{plan['grid_macs']:.2e}; the first rung takes {plan['first_share']:.1%}",
    ]


def report_search() -> Callable[[SearchProgress], None]:
    """Return a callback that displays the progress of a search, rung by rung."""
    reporters: dict[int, ProgressReporter] = {}

    def report(at: SearchProgress) -> None:
        title = f"search, rung {at.rung} of {at.rungs}, networks {at.networks}"
        reporter = reporters.setdefault(at.rung, ProgressReporter(title, "trainings", keep=True))
        best = "" if at.best is None else f"best so far {at.best.name} {at.best.score:.3f}"
        epoch = f"{at.name} epoch {at.epoch} of {at.epochs}" if at.epoch else ""
        detail = ", ".join(filter(None, (best, epoch)))
        reporter(at.done, at.total, detail=detail, resumed=at.resumed, share=at.share)

    return report


def _search_lines(s: dict[str, Any]) -> list[str]:
    """Format the result of a search as text: the rungs, the finalists, the best network and the cost."""
    from plushsense.scoring.metrics import column_metrics

    out = marks(s)
    mark = " (leaky)" if s["leaky"] else ""
    beyond = f" within the limits, {len(s['left_out'])} beyond" if s["left_out"] else ""
    out.append(
        f"{plural(s['candidates'], 'network')}{beyond}; split {s['split']}, context {s['context']}, "
        f"{plural(len(s['grid']['seeds']), 'seed')}\n"
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
        f"{plural(best['folds'], 'fold')}. It is the best of {s['chosen_among']} on these people: slightly too high."
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
    """Format a row per network, longest trained first, with its score after each rung and why it stopped."""
    rows: dict[tuple[str, str, str], list[object]] = {}
    for i, rung in enumerate(s["rungs"]):
        for n in rung["networks"]:
            row = rows.setdefault((n["arch"], n["filters"], n["batch_asked"]), [None] * len(s["rungs"]) + [""])
            row[i], row[-1] = figure(n["macro_f1"]), n["went"]
    # Sort networks by the last rung that they reached, in the order of that rung.
    names = [(n["arch"], n["filters"], n["batch_asked"]) for rung in reversed(s["rungs"]) for n in rung["networks"]]
    title = [f"after {rung['epochs']}" for rung in s["rungs"]]
    text = [
        f"macro-F1{mark} after each rung of epochs",
        table(("network", "filters", "batch", *title, ""), [(*name, *rows[name]) for name in dict.fromkeys(names)]),
    ]
    for rung in s["rungs"]:
        error = rung["standard_error"]
        apart = "" if error is None else f", standard error of a difference {figure(error)}"
        entered, folds = plural(rung["entered"], "network"), plural(rung["folds"], "fold")
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
