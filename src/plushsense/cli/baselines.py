"""Implement ``plushsense baselines DATASET --split leave-one-subject-out,windows:5``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.output import emit, say, warn
from plushsense.cli.settings import listed, report_jobs, settings


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.baselines.run import PAGE, baselines, comparison_id

    config = settings(args, workers=args.workers)
    dataset = open_dataset(args.dataset)
    choice: dict[str, Any] = {"splits": listed(args.split), "pca": args.pca}
    choice |= {"models": listed(args.models), "features": listed(args.features)}
    name = f"baselines_{comparison_id(dataset, config, **choice)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = baselines(
        dataset,
        config,
        **choice,
        out=out,
        overwrite=args.force,
        cluster=args.cluster,
        progress=report_jobs("comparing", "fits"),
        warn=warn,
    )
    result |= {"out": str(out), "report": str(out / PAGE)}
    say(f"written: {out}")
    emit(args, result, lines(result))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """Format the comparison as text: a table with one line per model, with explanations."""
    from plushsense.experiments.baselines.report import (
        COUNTS,
        LEAKY,
        SIMULATION,
        describe_costs,
        describe_data,
        program_table,
    )

    out = [SIMULATION, ""] if result["simulated"] else []
    out += [describe_data(result), "", program_table(result).text(), "", describe_costs(result)]
    if any(split["leaky"] for split in result["splits"]):
        out += ["", COUNTS if result["gaps"] else LEAKY]
    return out
