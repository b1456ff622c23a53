"""Implement ``plushsense protocol --model BUNDLE [--people 5 | --dataset DS | --session DIR] [--out DIR]``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.options import options
from plushsense.cli.output import emit
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.protocol.run import protocol

    virtual = options(args, "people", "first", "seed", "repetitions")
    virtual = {name: value for name, value in virtual.items() if value is not None}
    if virtual and (args.dataset or args.session):
        raise ConfigError(f"--{next(iter(virtual))} is for virtual people: leave it out, or --dataset and --session.")
    result = protocol(
        args.model,
        **virtual,
        **options(args, "dataset", "session", "engine", "out"),
        subjects=listed(args.subjects) if args.subjects else None,
        rules=not args.no_rules,
        progress=ProgressReporter("people"),
    )
    emit(args, result, lines(result))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """Format the result as text: the table, the aims and the notes."""
    from plushsense.experiments.protocol.report import SIMULATION, aim_table, between_table, group_table

    out = [result["heading"], *([SIMULATION] if result["simulated"] else [])]
    out += [f"{name}: {value}" for name, value in result["about"]]
    out += ["", group_table(result).text(), ""]
    out += [
        f"{row['system']}, {row['minutes']} minutes between the gestures: {row['positive']} positive and "
        f"{row['negative']} negative events, {row['none']} without affect: {row['reactions']} an hour"
        for row in between_table(result).rows
    ]
    if result["aims"]:
        out += ["", *(f"{row['met']}: {row['aim']}: {row['measured']}" for row in aim_table(result).rows)]
    out += ["", *result["said"]]
    return [*out, f"written: {result['files'][0]}"] if "files" in result else out
