"""``plushsense protocol --model BUNDLE [--people 5] [--out DIR]``, or with ``--dataset DS`` or ``--session DIR``"""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.apps.cli.output import bar, emit, table
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", required=True, metavar="BUNDLE", help="a .plush bundle")
    parser.add_argument("--people", type=int, metavar="N", help="virtual people (5, as in the paper)")
    parser.add_argument(
        "--first",
        type=int,
        metavar="N",
        help="number of the first virtual person (1001: nobody met them)",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of the virtual population (1)")
    parser.add_argument("--repetitions", type=int, metavar="N", help="of each gesture by each person (3)")
    parser.add_argument("--dataset", metavar="DS", help="recorded sessions instead: a data set with session streams")
    parser.add_argument(
        "--session",
        metavar="DIR",
        help="recorded sessions instead: a folder as a recorder leaves it, stream and recordings",
    )
    parser.add_argument(
        "--subjects", metavar="NAME,...", help="people of DS or DIR (default: all that the network never met)"
    )
    parser.add_argument(
        "--engine",
        default="float",
        choices=("float", "int8"),
        help="float (default), or int8: the toy's own arithmetic",
    )
    parser.add_argument(
        "--no-rules", action="store_true", help="leave out the old heuristic, which has to be tuned first"
    )
    parser.add_argument(
        "--out", metavar="DIR", help="folder for protocol.html, table.csv, trials.csv and protocol.json"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.apps.cli.settings import listed
    from plushsense.apps.protocol import protocol

    virtual = {name: getattr(args, name) for name in ("people", "first", "seed", "repetitions")}
    virtual = {name: value for name, value in virtual.items() if value is not None}
    if virtual and (args.dataset or args.session):
        raise ConfigError(f"--{next(iter(virtual))} is for virtual people: leave it out, or --dataset and --session.")
    result = protocol(
        args.model,
        **virtual,
        dataset=args.dataset,
        session=args.session,
        subjects=listed(args.subjects) if args.subjects else None,
        engine=args.engine,
        rules=not args.no_rules,
        out=args.out,
        progress=bar("people"),
    )
    emit(args, result, lines(result))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """The table as text, the aims, and what has to be known."""
    from plushsense.reports.protocol import SIMULATION, aim_rows, between_rows, text_lines

    head, *rows = text_lines(result)
    out = [result["heading"], *([SIMULATION] if result["simulated"] else [])]
    out += [f"{name}: {value}" for name, value in result["about"]]
    out += ["", table(head, rows), ""]
    out += [
        f"{row['system']}, {row['minutes']} minutes between the gestures: {row['positive']} positive and "
        f"{row['negative']} negative events, {row['none']} without affect: {row['reactions']} an hour"
        for row in between_rows(result)
    ]
    if result["aims"]:
        out += ["", *(f"{row['met']}: {row['aim']}: {row['measured']}" for row in aim_rows(result))]
    out += ["", *result["said"]]
    return [*out, f"written: {result['files'][0]}"] if "files" in result else out
