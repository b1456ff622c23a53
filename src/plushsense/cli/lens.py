"""Implement ``plushsense lens DATASET`` and ``plushsense compare EVALUATION EVALUATION ...``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit, say, warn
from plushsense.cli.settings import listed, report_jobs, settings


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.people.lens import PAGE, lens, lens_id
    from plushsense.experiments.people.report import (
        SIMULATION,
        calibration_sentence,
        people_table,
        split_table,
        trait_table,
    )

    config = settings(args, workers=args.workers)
    dataset = open_dataset(args.dataset)
    splits = listed(args.splits)
    out = Path(args.out) if args.out else dataset.path / "evaluations" / f"lens_{lens_id(dataset, config, splits)[:8]}"
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
    from plushsense.experiments.people.report import SIMULATION, model_table, pair_table

    result = compare(args.evaluations, out=args.out, overwrite=args.force)
    if args.out:
        result |= {"out": args.out, "report": str(Path(args.out) / PAGE)}
        say(f"written: {args.out}")
    lines = [SIMULATION, ""] if result["simulated"] else []
    lines.append(model_table(result).text())
    for key in result["pairs"]:
        table = pair_table(result, key)
        lines += ["", table.title, table.text()]
    emit(args, result, lines)
    return 0
