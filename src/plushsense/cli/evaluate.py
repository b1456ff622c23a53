"""Implement ``plushsense evaluate``, ``baselines`` and ``report``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, figure, say, spread, table, warn
from plushsense.cli.settings import SIMULATION, listed, marks, report_jobs, say_advice, settings
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.experiments.baselines.score import BaselinesResult


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.workflow.advice import measure_advice
    from plushsense.workflow.api import FoldsSpec, evaluate_run
    from plushsense.workflow.learning import check_sizes, measure_curve, save_curve
    from plushsense.workflow.preparation import prepare, require_people_left_out
    from plushsense.workflow.reporting import PAGE, write_report

    config = settings(args, split=args.split, train_context=args.train_context, workers=args.workers)
    if args.save_windows:
        from plushsense.core.sentences import join_names
        from plushsense.workflow.export import save_windows

        saved = save_windows(args.dataset, args.save_windows, config, overwrite=args.force, warn=warn)
        sizes = join_names(f"{n} {name}" for name, n in saved.windows.items())
        emit(args, saved.to_json(), [f"{saved.path}: windows: {sizes}; {saved.bytes:,} bytes"])
        return 0
    dataset = open_dataset(args.dataset)
    made = prepare(dataset, config, warn)
    most = check_sizes(made, args.people) if args.people else 0
    if args.advice:
        require_people_left_out(made, "--advice")
    out = Path(args.out) if args.out else dataset.path / "evaluations" / made.name
    spec = FoldsSpec(out, args.force, args.cluster, args.int8)
    result = evaluate_run(made, spec, progress=report_jobs("evaluating"), warn=warn)
    content = {**result.to_json(), "out": str(out), "simulated": dataset.head.simulated}
    if args.people:
        curve = measure_curve(made, result, most, args.people, args.cluster, report_jobs("learning curve"))
        if curve is None:
            warn("No learning curve: it needs two numbers of people to train on, and three people left out.")
        else:
            content["learning"] = curve.to_json()
            save_curve(curve, made, out)
    if args.advice:
        bar = report_jobs("advice")
        found = measure_advice(dataset, config, result, args.cluster, bar, warn)
        content["advice"] = [advice.to_json() for advice in found]
        if not found:
            say("everything that is advised is used")
    content["report"] = str(write_report(out / PAGE, dataset, [out]))
    say(f"written: {out}")
    schedule = f"{plural(made.training.epochs, 'epoch')}, batches of {made.training.batch}"
    emit(args, content, lines(content, schedule))
    say_advice(args.dataset, config.windows.window_s)
    return 0


def lines(e: dict[str, Any], schedule: str = "") -> list[str]:
    """Format the scores of an evaluation as text, with its ``schedule``: a row for each person, then the means."""
    from plushsense.reports.wording import describe_confidence, describe_leakage, describe_learning
    from plushsense.scoring.metrics import METRICS, column_metrics

    names = {key: metric.name for key, metric in column_metrics().items()}
    out = marks(e)
    context = e["context"]
    if e["train_context"] != context:
        context += f" (trained on {e['train_context']})"
    seeds = ", ".join(map(str, e["seeds"]))
    out.append(", ".join(filter(None, (f"split {e['split']}", f"context {context}", schedule, f"seed {seeds}\n"))))
    rows = [
        (s["subject"], s["windows"], s["recordings"], *(figure(s[k]) for k in (*names, "by_recording_accuracy")))
        for s in e["subjects"]
    ]
    out.append(table(("subject", "windows", "recordings", *names.values(), "by recording"), rows))
    units = e["over"]
    n = len(e[units])
    out.append("")
    out.append(f"mean ± standard deviation over {n} {'people' if units == 'subjects' else 'folds'}")
    if units == "folds" and n > 1:
        out.append("an interval over so few folds is too narrow, and is not one over people")
    out += [f"{name:<16}{spread(e[key])}" for key, name in names.items()]
    rest = e["nobody"] if units == "subjects" else None
    if rest:
        out.append(
            f"without recordings at rest: {plural(rest['recordings'], 'recording')}, accuracy "
            f"{figure(rest['accuracy'])}"
        )
    if rest and (whole := e.get("with_rest")):
        scores = ", ".join(f"{METRICS[key].name} {spread(of)}" for key, of in whole.items())
        out.append(f"with them, over all classes and {plural(len(e['folds']), 'fold')}, as the paper: {scores}")
    for title, of in (("pooled recordings, by vote", e["by_recording"]), ("pooled windows", e["pooled"])):
        scores = ", ".join(f"{name} {figure(of[k])}" for k, name in names.items())
        out.append(f"{title}{', with recordings at rest' if rest and title == 'pooled windows' else ''}: {scores}")
    for kind, part in e["by_context"].items():
        out.append(f"  on {kind} windows: accuracy {figure(part['accuracy'])} ({plural(part['windows'], 'window')})")
    if e.get("confidence"):
        out.append(describe_confidence(e["confidence"]))
    if "leakage" in e:
        out.append(describe_leakage(e["leakage"]))
    if curve := e.get("learning"):
        rows = [(point["people"], figure(point["accuracy"]), _interval(point["ci95"])) for point in curve["points"]]
        out += ["", table(("people trained on", "accuracy", "95 % interval"), rows), describe_learning(curve)]
    return out + (deployed(e["int8"]) if "int8" in e else [])


def _interval(ci95: Sequence[float] | None) -> str:
    return "-" if ci95 is None else f"{ci95[0]:.3f} to {ci95[1]:.3f}"


def deployed(e: dict[str, Any]) -> list[str]:
    """Format the scores of the 8-bit networks as text: a row for each person (or fold), then the means."""
    from plushsense.scoring.metrics import column_metrics

    unit = "subject" if e["over"] == "subjects" else "fold"
    names = {key: metric.name for key, metric in column_metrics().items()}
    keys = (*(key for name in names for key in (name, f"{name}_int8")), "macro_f1_loss", "agreement")
    rows = [(r[unit], *(figure(r[key]) for key in keys)) for r in e["rows"]]
    return [
        "",
        "the same networks deployed in 8 bits, on the same windows (lost: macro-F1 of float minus that of 8 bits):\n",
        table((unit, *(head for name in names.values() for head in (name, "int8")), "lost", "agree"), rows),
        "",
        f"macro-F1 in 8 bits  {spread(e['macro_f1'])}",
        *(f"{name + ' lost':<20}{spread(e['loss'][key])}" for key, name in reversed(names.items())),
        f"float and 8 bits agree on {100 * (e['agreement'] or 0):.1f} % of the windows",
    ]


def run_report(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.sweep_page import is_sweep
    from plushsense.workflow.reporting import write_report

    if is_sweep(args.out):
        return _sweep_report(args)
    if args.dataset is None or args.page:
        problem = "--dataset is missing" if args.dataset is None else "--page is for a sweep"
        raise ConfigError(
            f"'{args.out}' is not a folder written by sweep, and {problem}: give a sweep's folder, or  "
            "plushsense report OUT.html --dataset DATASET"
        )
    folder = Path(args.dataset) / "evaluations"
    evaluations = args.evaluation or [str(p.parent) for p in sorted(folder.glob("*/evaluation.json"))]
    path = write_report(
        args.out, args.dataset, evaluations, args.model, args.title, recordings=True, recording=args.recording
    )
    emit(args, {"report": str(path), "evaluations": len(evaluations), "models": len(args.model)}, str(path))
    return 0


def _sweep_report(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.sweep_page import write_sweep_report

    if args.dataset or args.evaluation or args.model or args.recording:
        raise ConfigError(
            f"'{args.out}' is a sweep: --dataset, --evaluation, --model and --recording are for a page of evaluations."
        )
    done = write_sweep_report(args.out, args.page, title=args.title)
    emit(args, done.to_json(), [f"{done.report}: {done.done} of {plural(done.trials, 'trial')}", *done.summary])
    return 0


def run_baselines(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.baselines.run_baselines import PAGE, ComparisonSpec, baselines, comparison_id
    from plushsense.workflow.preparation import prepare

    config = settings(args, workers=args.workers)
    dataset = open_dataset(args.dataset)
    spec = ComparisonSpec(listed(args.split), listed(args.models), listed(args.features), args.pca)
    name = f"baselines_{comparison_id(prepare(dataset, config), spec)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = baselines(
        dataset,
        config,
        spec,
        out=out,
        overwrite=args.force,
        cluster=args.cluster,
        progress=report_jobs("comparing", "fits"),
        warn=warn,
    )
    say(f"written: {out}")
    emit(args, {**result.to_json(), "out": str(out), "report": str(out / PAGE)}, _baseline_lines(result))
    return 0


def _baseline_lines(result: BaselinesResult) -> list[str]:
    """Format the comparison as text: a table with one line per model, with explanations."""
    from plushsense.experiments.baselines.baselines_page import (
        COUNTS,
        LEAKY,
        describe_costs,
        describe_data,
        program_table,
    )

    out = [SIMULATION, ""] if result.simulated else []
    out += [describe_data(result), "", program_table(result).text(), "", describe_costs(result)]
    if any(split.leaky for split in result.splits):
        out += ["", COUNTS if result.gaps else LEAKY]
    return out
