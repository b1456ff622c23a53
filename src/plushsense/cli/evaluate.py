"""``plushsense evaluate DATASET --split leave-one-subject-out|by-subject:5|by-recording:5|windows:5``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import add_settings, add_work, marks, report_folds, settings, warn
from plushsense.workflow.reporting import name_of

if TYPE_CHECKING:
    pass


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--split",
        metavar="SPLIT",
        help="leave-one-subject-out (default), by-subject:K or by-recording:K for K folds; leaky, as in the paper: "
        "windows:K, windows:holdout",
    )
    parser.add_argument(
        "--train-context",
        metavar="CONTEXT",
        help="context of the windows to train on: stream, loop or anywhere (default: as those to score)",
    )
    add_work(parser, "folds")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for evaluation.json, predictions.parquet and report.html "
        "(default: DATASET/evaluations/, a folder for each settings and data)",
    )
    parser.add_argument("--force", action="store_true", help="replace an evaluation of other settings or data in --out")
    parser.add_argument(
        "--int8",
        action="store_true",
        help="also deploy each fold's network in 8 bits, and say what that costs, person by person",
    )
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.workflow.api import evaluate
    from plushsense.workflow.reporting import PAGE, write_report

    config = settings(args, split=args.split, train_context=args.train_context, workers=args.workers)
    dataset = open_dataset(args.dataset)
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name_of(config, dataset)
    result = evaluate(
        dataset,
        config,
        out=out,
        overwrite=args.force,
        cluster=args.cluster,
        int8=args.int8,
        progress=report_folds("evaluating"),
        warn=warn,
    )
    report = write_report(out / PAGE, dataset, [out])
    shown = {**result.to_dict(), "out": str(out), "report": str(report), "simulated": dataset.head.simulated}
    say(f"written: {out}")
    emit(args, shown, lines(shown))
    return 0


def figure(value: float | None) -> str:
    """Format three digits; a dash for what could not be computed."""
    return "-" if value is None else f"{value:z.3f}"


def spread(score: dict[str, Any]) -> str:
    """Format mean, spread and interval: ``0.573 ± 0.120 (95 % 0.52 to 0.62)``."""
    mean, sd, ci = score["mean"], score["sd"], score["ci95"]
    if mean is None:
        return "-"
    text = f"{mean:z.3f}"
    return text if sd is None else f"{text} ± {sd:.3f} (95 % {ci[0]:z.3f} to {ci[1]:z.3f})"


def lines(e: dict[str, Any]) -> list[str]:
    """Format the scores as text: a row a person, then the means."""
    from plushsense.scoring.metrics import column_metrics

    names = {key: metric.name for key, metric in column_metrics().items()}
    out = marks(e)
    context = (
        e["context"] if e["context"] == e["train_context"] else f"{e['context']} (trained on {e['train_context']})"
    )
    out.append(f"split {e['split']}, context {context}, seed {', '.join(map(str, e['seeds']))}\n")
    rows = [
        (
            s["subject"],
            s["windows"],
            s["recordings"],
            *(figure(s[k]) for k in (*names, "by_recording_accuracy")),
        )
        for s in e["subjects"]
    ]
    out.append(table(("subject", "windows", "recordings", *names.values(), "by recording"), rows))
    units = e["over"]
    n = len(e[units])
    out.append("")
    out.append(f"mean ± standard deviation over {n} {'people' if units == 'subjects' else 'folds'}")
    if units == "folds" and n > 1:
        out.append("an interval over so few folds is too narrow, and it is not one over people")
    out += [f"{name:<16}{spread(e[key])}" for key, name in names.items()]
    voted = e["by_recording"]
    out.append(f"vote by recording, pooled: {', '.join(f'{name} {figure(voted[k])}' for k, name in names.items())}")
    for kind, part in e["by_context"].items():
        out.append(f"  on {kind} windows: accuracy {figure(part['accuracy'])} ({part['windows']} windows)")
    return out + (deployed(e["int8"]) if "int8" in e else [])


def deployed(e: dict[str, Any]) -> list[str]:
    """Format the cost of deploying as text: a row a person (or fold), then the means."""
    from plushsense.scoring.metrics import column_metrics

    unit = "subject" if e["over"] == "subjects" else "fold"
    names = {key: metric.name for key, metric in column_metrics().items()}
    keys = (*(key for name in names for key in (name, f"{name}_int8")), "macro_f1_loss", "agreement")
    rows = [(r[unit], *(figure(r[key]) for key in keys)) for r in e["rows"]]
    return [
        "",
        "the same networks deployed in 8 bits, on the same windows (lost: macro-F1 less in 8 bits; below 0: more):\n",
        table((unit, *(head for name in names.values() for head in (name, "int8")), "lost", "agree"), rows),
        "",
        f"macro-F1 in 8 bits  {spread(e['macro_f1'])}",
        *(f"{name + ' lost':<20}{spread(e['loss'][key])}" for key, name in reversed(names.items())),
        f"both say the same on {100 * (e['agreement'] or 0):.1f} % of the windows",
    ]
