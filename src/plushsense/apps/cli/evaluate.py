"""``plushsense evaluate DATASET --split leave-one-subject-out|by-subject:5|by-recording:5|windows:5``"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.apps.cli.output import emit, say, table
from plushsense.apps.cli.settings import add_settings, add_work, folds_shown, marks, settings, warn

if TYPE_CHECKING:
    from plushsense.apps.config import RunConfig
    from plushsense.dataset.store import Dataset


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
    from plushsense.apps.api import evaluate
    from plushsense.apps.reporting import PAGE, write_report
    from plushsense.dataset.index import open_dataset

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
        progress=folds_shown("evaluating"),
        warn=warn,
    )
    report = write_report(out / PAGE, dataset, [out])
    shown = {**result.to_dict(), "out": str(out), "report": str(report), "simulated": dataset.head.simulated}
    say(f"written: {out}")
    emit(args, shown, lines(shown))
    return 0


def name_of(config: RunConfig, dataset: Dataset) -> str:
    """A folder name for an evaluation: a person tells them apart by the words, the hash by everything else."""
    from plushsense.apps.reporting import evaluation_id

    evaluation, model = config.evaluation, config.model
    context = config.windows.context
    if evaluation.train_context not in (None, context):
        context = f"{evaluation.train_context}-to-{context}"
    filters = "-".join(map(str, model.filters))
    parts = (evaluation.split.replace(":", "-"), model.arch, filters, config.padding, model.norm, context)
    words = "_".join(parts) + f"_{config.preset}_e{config.training.epochs}_seed{config.training.seed}"
    return f"{words[:180]}_{evaluation_id(config, dataset)[:8]}"


def figure(value: float | None) -> str:
    """Three digits; a dash for what could not be computed."""
    return "-" if value is None else f"{value:z.3f}"


def spread(score: dict[str, Any]) -> str:
    """``0.573 ± 0.120 (95 % 0.52 to 0.62)``"""
    mean, sd, ci = score["mean"], score["sd"], score["ci95"]
    if mean is None:
        return "-"
    text = f"{mean:z.3f}"
    return text if sd is None else f"{text} ± {sd:.3f} (95 % {ci[0]:z.3f} to {ci[1]:z.3f})"


def lines(e: dict[str, Any]) -> list[str]:
    """The scores as text: a row a person, then the means."""
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
            *(figure(s[k]) for k in ("accuracy", "macro_f1", "by_recording_accuracy")),
        )
        for s in e["subjects"]
    ]
    out.append(table(("subject", "windows", "recordings", "accuracy", "macro-F1", "by recording"), rows))
    units = e["over"]
    n = len(e[units])
    out.append("")
    out.append(f"mean ± standard deviation over {n} {'people' if units == 'subjects' else 'folds'}")
    if units == "folds" and n > 1:
        out.append("an interval over so few folds is too narrow, and it is not one over people")
    out.append(f"accuracy        {spread(e['accuracy'])}")
    out.append(f"macro-F1        {spread(e['macro_f1'])}")
    voted = e["by_recording"]
    out.append(f"vote by recording, pooled: accuracy {figure(voted['accuracy'])}, macro-F1 {figure(voted['macro_f1'])}")
    for kind, part in e["by_context"].items():
        out.append(f"  on {kind} windows: accuracy {figure(part['accuracy'])} ({part['windows']} windows)")
    return out + (deployed(e["int8"]) if "int8" in e else [])


def deployed(e: dict[str, Any]) -> list[str]:
    """What deploying costs, as text: a row a person (or fold), then the means."""
    unit = "subject" if e["over"] == "subjects" else "fold"
    wanted = ("accuracy", "accuracy_int8", "macro_f1", "macro_f1_int8", "macro_f1_loss", "agreement")
    rows = [(r[unit], *(figure(r[name]) for name in wanted)) for r in e["rows"]]
    return [
        "",
        "the same networks deployed in 8 bits, on the same windows (lost: macro-F1 less in 8 bits; below 0: more):\n",
        table((unit, "accuracy", "int8", "macro-F1", "int8", "lost", "agree"), rows),
        "",
        f"macro-F1 in 8 bits  {spread(e['macro_f1'])}",
        f"macro-F1 lost       {spread(e['loss']['macro_f1'])}",
        f"accuracy lost       {spread(e['loss']['accuracy'])}",
        f"both say the same on {100 * (e['agreement'] or 0):.1f} % of the windows",
    ]
