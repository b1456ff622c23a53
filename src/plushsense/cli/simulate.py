"""``plushsense simulate OUT [--people 25 --seed 1]``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out", metavar="OUT", help="new or empty folder: one folder a person, recordings and session stream"
    )
    parser.add_argument("--people", type=int, default=25, metavar="N", help="virtual people (25, as in the paper)")
    parser.add_argument(
        "--repetitions", type=int, default=3, metavar="N", help="recordings of each gesture by each person (3)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="same seed, same recordings (1)")
    parser.add_argument("--dataset", metavar="DIR", help="also import them as a data set in this new folder")


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.api import simulate

    bars = {"recording": ProgressReporter("people"), "importing": ProgressReporter("importing")}
    summary = simulate(
        args.out,
        people=args.people,
        repetitions=args.repetitions,
        seed=args.seed,
        dataset=args.dataset,
        progress=lambda what, done, total: bars[what](done, total),
    )
    emit(
        args,
        summary,
        f"{args.dataset or args.out}: {summary['recordings']} recordings of {args.people} virtual people. "
        "A simulation: scores on it say nothing about a real toy.",
    )
    return 0
