"""Implement ``plushsense lens``, ``compare``, ``merge`` and ``explain``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import SIMULATION, listed, marks, report_jobs, settings
from plushsense.core.sentences import plural


def run_lens(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.people.lens import PAGE, lens, lens_id
    from plushsense.experiments.people.report import (
        calibration_sentence,
        people_table,
        split_table,
        trait_table,
    )
    from plushsense.workflow.preparation import prepare

    config = settings(args, workers=args.workers)
    dataset = open_dataset(args.dataset)
    splits = listed(args.splits)
    name = f"lens_{lens_id(prepare(dataset, config), splits)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = lens(
        dataset,
        config,
        splits=splits,
        out=out,
        overwrite=args.force,
        cluster=args.cluster,
        progress=report_jobs("evaluating"),
        warn=warn,
    )
    result |= {"out": str(out), "report": str(out / PAGE)}
    say(f"written: {out}")
    lines = [SIMULATION, ""] if result["simulated"] else []
    lines.append(split_table(result).text())
    if result["people"]:
        lines += ["", calibration_sentence(result["calibration"]), "", people_table(result, 1).text()]
        lines += ["", trait_table(result).text()]
    emit(args, result, lines)
    return 0


def run_compare(args: argparse.Namespace) -> int:
    from plushsense.experiments.people.comparison import PAGE, compare
    from plushsense.experiments.people.report import OTHER_WINDOWS, model_table, pair_table

    result = compare(args.evaluations, out=args.out, overwrite=args.force)
    if args.out:
        result |= {"out": args.out, "report": str(Path(args.out) / PAGE)}
        say(f"written: {args.out}")
    lines = [SIMULATION, ""] if result["simulated"] else []
    lines += [model_table(result).text(), "", *(f"{m['name']}: {m['folder']}" for m in result["models"])]
    if result["scored"] == "recordings":
        lines += ["", OTHER_WINDOWS]
    for key in result["pairs"]:
        pairs = pair_table(result, key)
        lines += ["", pairs.title, pairs.text()]
    emit(args, result, lines)
    return 0


def run_merge(args: argparse.Namespace) -> int:
    from plushsense.experiments.people.merging import propose_merges

    result = propose_merges(args.dataset, args.evaluation, merges=args.merges, groups=args.groups, out=args.out)
    if args.out:
        say(f"written: {args.out}; train and evaluate with  --classes {args.out}")
    emit(args, result, _merge_lines(result))
    return 0


def _merge_lines(result: dict[str, Any]) -> list[str]:
    """Format the merges as text, one row for each number of merges."""
    from plushsense.scoring.metrics import column_metrics

    names = {key: metric.name for key, metric in column_metrics().items()}
    rows, known = [], set[str]()
    for step in result["steps"]:
        groups = [" + ".join(group) for group in step["merged"]]
        new = [group for group in groups if group not in known]
        known = set(groups)
        scores = [figure(step[kind][key]["mean"]) for key in names for kind in ("scores", "crossfitted")]
        rows.append(
            (step["merges"], step["classes"], figure(step["largest"]), *scores, figure(step["confusion"]),
             "-" if step["people"] is None else f"{step['people']} of {result['people']}", "; ".join(new))
        )  # fmt: skip
    heads = [head for name in names.values() for head in (name, "cross-fitted")]
    return [
        *marks(result),
        f"split {result['split']}; means over {plural(result['people'], 'person')}; nothing was trained again",
        "",
        table(("merges", "classes", "largest class", *heads, "confused", "in people", "merged last"), rows),
        "",
        "largest class: the share of windows that a program gets right which always names that class. Fewer classes",
        "are easier, so a higher score alone is no gain. cross-fitted: each person is scored with the merges that all",
        "others choose.",
        *_grouping_lines(result),
    ]


def _grouping_lines(result: dict[str, Any]) -> list[str]:
    """Format the merges that are named beforehand as text, one row for each."""
    from plushsense.scoring.metrics import column_metrics

    metrics = column_metrics()
    rows = [
        (
            g["name"],
            g["classes"],
            figure(g["largest"]),
            *(figure(g["scores"][key]["mean"]) for key in metrics),
            "; ".join(" + ".join(group) for group in g["merged"]),
        )
        for g in result["groupings"]
    ]
    heads = ("named", "classes", "largest class", *(metric.name for metric in metrics.values()), "merged")
    return ["", "named beforehand, so nothing is chosen on these people:", "", table(heads, rows)] if rows else []


def run_explain(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.people.explanation import PAGE, explain, explain_id
    from plushsense.experiments.people.explanation_report import SIMULATED_PEOPLE, TRAINED_ON, gesture_table
    from plushsense.models.bundle import Bundle

    bundle, dataset = Bundle.load(args.bundle), open_dataset(args.dataset)
    gestures = None if args.gestures is None else listed(args.gestures)
    name = f"explain_{explain_id(bundle, dataset, gestures)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = explain(bundle, dataset, gestures=gestures, out=out, overwrite=args.force, warn=warn)
    result |= {"out": str(out), "report": str(out / PAGE)}
    say(f"written: {out}")
    lines = [SIMULATED_PEOPLE, ""] if result["simulated"] else []
    lines += [TRAINED_ON, ""] if result["trained_on"] else []
    lines += [
        gesture_table(result).text(),
        "",
        "area: under the mean probability while blocks are deleted, the highest attribution first; lower than at "
        "random if the attribution names what decided",
    ]
    emit(args, result, lines)
    return 0
