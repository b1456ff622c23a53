"""Implement ``plushsense sweep``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import marks
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.experiments.sweep.results import SweepResult
    from plushsense.experiments.sweep.run_sweep import SweepPreview
    from plushsense.reports.table import Row

_KEYS = ("split", "epochs", "share", "eta", "max_parameters", "max_state_bytes", "max_macs_per_step")
_MOST_SEEDS = 1000
# Settings that the lines above them already name.
_NAMED = ("name", "architectures", "filters", "split", "seeds")


def run_sweep(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.run_sweep import SweepSpec, preview, sweep

    spec = SweepSpec(
        args.grid, _changes(args), args.out, args.force, args.workers or 0, args.cluster, args.keep_predictions
    )
    if args.dry_run:
        plan = preview(args.dataset, spec, warn=warn)
        emit(args, plan.to_json(), _preview_lines(plan))
        return 1 if plan.problems else 0
    done = sweep(args.dataset, spec, display=True, warn=warn)
    say(f"written: {done.out}; make a page of it with  plushsense report {done.out}")
    emit(args, {**done.head, "out": str(done.out)}, _result_lines(done))
    return 1 if done.head["trainings_lost"] else 0


def _changes(args: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options that change a grid."""
    changes: dict[str, Any] = {}
    for text in args.set:
        key, equals, value = text.partition("=")
        if not equals or key.strip() in changes:
            raise ConfigError(
                f"--set was given '{text}': KEY=VALUE is accepted, with a key of a grid file, each at most once."
            )
        changes[key.strip()] = value.strip()
    if args.seeds is not None and args.seeds > _MOST_SEEDS:
        raise ConfigError(f"--seeds is {args.seeds}: accepted are 1 to {_MOST_SEEDS} seeds.")
    # ``--seeds 0`` gives an empty tuple, which is reported with the other problems of the grid.
    seeds = None if args.seeds is None else tuple(range(args.seeds))
    given = {**options(args, *_KEYS), "seeds": seeds, "halving": args.halving or None}
    return changes | {key: value for key, value in given.items() if value is not None}


def _preview_lines(preview: SweepPreview) -> list[str]:
    """Format the plan of a sweep as text, or the problems of its grid if there are any."""
    if preview.problems:
        return [f"- {line}" for line in preview.problems]
    plan: dict[str, Any] = preview.to_json()
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
    head, mark = done.head, " (leaky)" * done.leaky
    out = marks(head)
    out.append(
        f"grid {head['name']}, split {head['split']}, context {head['context']}: {head['done']} of "
        f"{plural(head['trials'], 'trial')} done ({head['resumed']} from before)\n"
    )
    out.append(done.best_table(terminal=True).text())
    if (row := head["best_on_validation"]) is not None:
        out.append("")
        out.append(
            f"The best of {head['done']} on the test windows is partly luck. Chosen by validation macro-F1 it is "
            f"{row['arch']} {row['filters']}, {row['epochs']} epochs, batch {row['batch_asked']}: accuracy "
            f"{figure(row['accuracy'])}, macro-F1 {figure(row['macro_f1'])}{mark}."
        )
    if "halving" in head:
        out += ["", *_halving_lines(head["halving"], mark)]
    lost = (f"failed: {one['arch']} {one['filters']}, {one['epochs']} epochs: {one['why']}" for one in head["failed"])
    return [*out, *lost]


def _halving_lines(halving: Row, mark: str) -> list[str]:
    """Format halving as text: its rungs by network, the best network, the cost, and what to do next."""
    rungs, best, small, cost = (halving[key] for key in ("rungs", "winner", "smallest_equal", "cost"))
    rows: dict[tuple[str, str, str], list[object]] = {}
    for i, rung in enumerate(rungs):
        for n in rung["networks"]:
            row = rows.setdefault((n["arch"], n["filters"], n["batch_asked"]), [None] * len(rungs) + [""])
            row[i], row[-1] = figure(n["macro_f1"]), n["went"]
    # Sort networks by the last rung that they reached, in the order of that rung.
    names = [(n["arch"], n["filters"], n["batch_asked"]) for rung in reversed(rungs) for n in rung["networks"]]
    heads = ("network", "filters", "batch", *(f"after {rung['epochs']}" for rung in rungs), "")
    lines = [
        f"macro-F1{mark} after each rung of epochs",
        table(heads, [(*name, *rows[name]) for name in dict.fromkeys(names)]),
        *(
            f"up to epoch {rung['epochs']}: {plural(rung['entered'], 'network')}, {rung['share']:.1%} of the grid's "
            f"cost, standard error of a difference {figure(rung['standard_error'])}"
            for rung in rungs
        ),
        "",
        f"Best: {best['arch']} with {best['filters']}, macro-F1 {figure(best['macro_f1'])}{mark}. "
        f"It is the best of {rungs[0]['entered']} on these people: slightly too high.",
    ]
    if small["trial"] != best["trial"]:
        lines.append(
            f"Smallest within one standard error: {small['arch']} with {small['filters']}, "
            f"{small['parameters']:,} parameters, macro-F1 {figure(small['macro_f1'])}{mark}."
        )
    lines.append(
        f"Cost: {cost['macs']:.2e} multiply-accumulates of training, {cost['share']:.1%} of the whole "
        f"grid's {cost['grid_macs']:.2e} (bound {cost['bound_share']:.0%})."
    )
    return [*lines, f"Train it on everybody:\n  {halving['command']}"]
