"""``plushsense protocol --model BUNDLE [--people 5] [--out DIR]``, or with ``--dataset DS`` or ``--session DIR``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.output import emit
from plushsense.cli.settings import listed, options
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--model", required=True, metavar="BUNDLE", help=".plush bundle")
    add("--people", type=int, metavar="N", help="number of virtual people (5, as in the paper)")
    add("--first", type=int, metavar="N", help="number of the first virtual person (1001: in no data set)")
    add("--seed", type=int, metavar="N", help="seed of the virtual population (1)")
    add("--repetitions", type=int, metavar="N", help="recordings of each gesture by each person (3)")
    add("--dataset", metavar="DS", help="use recorded sessions: a data set with session streams")
    add("--session", metavar="DIR", help="use recorded sessions: a folder of recordings with their stream")
    add("--subjects", metavar="NAME,...", help="people of DS or DIR (default: all that the network was not trained on)")
    add("--engine", default="float", choices=("float", "int8"), help="float (default), or int8: the toy's arithmetic")
    add("--no-rules", action="store_true", help="leave out the rule baseline, which has to be fitted first")
    add("--out", metavar="DIR", help="folder for protocol.html, table.csv, trials.csv and protocol.json")


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
    """Format the table, the aims and the notes as text."""
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
