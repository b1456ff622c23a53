"""``plushsense evaluate DATASET --split leave-one-subject-out|by-subject:5|by-recording:5|windows:5``"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.apps.cli.output import emit, say, table
from plushsense.apps.cli.settings import add_settings, folds_shown, settings, warn


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--split",
        help="leave-one-subject-out (default), by-subject:5, by-recording:5; leaky: windows:5, windows:holdout",
    )
    parser.add_argument(
        "--train-context", help="train on windows of another context than the scored ones: stream or loop"
    )
    parser.add_argument("--workers", type=int, help="folds at a time (one a processor)")
    parser.add_argument("--out", metavar="DIR", help="folder for evaluation.json, predictions.parquet and report.html")
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.apps.api import evaluate
    from plushsense.apps.reporting import write_report
    from plushsense.dataset.index import open_dataset

    config = settings(args, split=args.split, train_context=args.train_context, workers=args.workers)
    dataset = open_dataset(args.dataset)
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name_of(config)
    result = evaluate(dataset, config, out=out, progress=folds_shown("evaluating"), warn=warn)
    report = write_report(out / "report.html", dataset, [out])
    shown = {**result.to_dict(), "out": str(out), "report": str(report), "simulated": dataset.head.simulated}
    say(f"written: {out}")
    emit(args, shown, lines(shown))
    return 0


def name_of(config: Any) -> str:
    """A folder name that tells evaluations apart."""
    evaluation, model = config.evaluation, config.model
    context = config.windows.context
    if evaluation.train_context not in (None, context):
        context = f"{evaluation.train_context}-to-{context}"
    filters = "-".join(map(str, model.filters))
    classes = evaluation.classes if isinstance(evaluation.classes, str) else "some"
    parts = (evaluation.split.replace(":", "-"), model.arch, filters, config.padding, model.norm, context)
    tail = "" if classes == "shared" else "_" + "".join(c if c.isalnum() else "-" for c in classes)[:40]
    return "_".join(parts) + f"_{config.preset}_e{config.training.epochs}_seed{config.training.seed}{tail}"


def spread(score: dict[str, Any]) -> str:
    """``0.573 ± 0.120 (95 % 0.52 to 0.62)``"""
    mean, sd, ci = score["mean"], score["sd"], score["ci95"]
    if mean is None:
        return "-"
    text = f"{mean:.3f}"
    return text if sd is None else f"{text} ± {sd:.3f} (95 % {ci[0]:.3f} to {ci[1]:.3f})"


def lines(e: dict[str, Any]) -> list[str]:
    """The scores as text: a row a person, then the means."""
    out = []
    if e["simulated"]:
        out.append("SIMULATION: these scores are of the virtual toy and say nothing about a real one.")
    if e["leaky"]:
        out.append("LEAKY: windows of one recording stand on both sides of this split; the scores flatter.")
    context = (
        e["context"] if e["context"] == e["train_context"] else f"{e['context']} (trained on {e['train_context']})"
    )
    out.append(f"split {e['split']}, context {context}, seed {', '.join(map(str, e['seeds']))}\n")
    rows = [
        (
            s["subject"],
            s["windows"],
            s["recordings"],
            *(f"{s[k]:.3f}" for k in ("accuracy", "macro_f1")),
            f"{s['by_recording_accuracy']:.3f}",
        )
        for s in e["subjects"]
    ]
    out.append(table(("subject", "windows", "recordings", "accuracy", "macro-F1", "by recording"), rows))
    out.append("")
    out.append(f"accuracy        {spread(e['accuracy'])}")
    out.append(f"macro-F1        {spread(e['macro_f1'])}")
    voted = e["by_recording"]
    out.append(f"vote by recording, pooled: accuracy {voted['accuracy']:.3f}, macro-F1 {voted['macro_f1']:.3f}")
    for kind, part in e["by_context"].items():
        out.append(f"  on {kind} windows: accuracy {part['accuracy']:.3f} ({part['windows']} windows)")
    return out
