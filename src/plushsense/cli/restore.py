"""``plushsense restore FILE.zip DEST``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="a zip file that plushsense backup wrote")
    parser.add_argument("dest", metavar="DEST", help="new or empty folder for the data set")


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.backup import restore

    dataset = restore(args.file, args.dest, progress=ProgressReporter("restoring"))
    result = {
        "dataset": args.dest,
        "recordings": len(dataset.recordings),
        "subjects": len(dataset.subjects),
        "streams": len(dataset.streams),
        "hash": dataset.hash,
    }
    emit(args, result, f"{args.dest}: {result['recordings']} recordings of {result['subjects']} people, as saved")
    return 0
