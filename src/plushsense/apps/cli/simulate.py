"""``plushsense simulate OUT [--people 25 --seed 1]``"""

from __future__ import annotations

import argparse

from plushsense.apps.cli.output import bar, emit


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out", metavar="OUT", help="new or empty folder: one folder a person, recordings and session stream"
    )
    parser.add_argument("--people", type=int, default=25, metavar="N", help="virtual people (25, as in the paper)")
    parser.add_argument(
        "--repetitions", type=int, default=3, metavar="N", help="recordings of each gesture by each person (3)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="same seed, same recordings (1)")


def run(args: argparse.Namespace) -> int:
    from plushsense.apps.api import simulate

    summary = simulate(
        args.out, people=args.people, repetitions=args.repetitions, seed=args.seed, progress=bar("people")
    )
    emit(
        args,
        summary,
        f"{args.out}: {summary['recordings']} recordings of {summary['people']} virtual people. "
        f"A simulation: scores on it say nothing about a real toy.",
    )
    return 0
