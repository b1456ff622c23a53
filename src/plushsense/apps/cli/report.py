"""``plushsense report OUT.html --dataset DS [--evaluation DIR …] [--model FILE …]``"""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.apps.cli.output import emit


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT.html", help="the page to write: a new file, or a report to replace")
    parser.add_argument("--dataset", required=True, metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--evaluation",
        action="append",
        metavar="DIR",
        help="a folder that evaluate wrote; may be given again (default: all of DATASET/evaluations)",
    )
    parser.add_argument(
        "--model",
        action="append",
        metavar="FILE",
        default=[],
        help="a bundle, for its model card; may be given again (default: none)",
    )
    parser.add_argument("--title", metavar="TEXT", help="heading of the page (default: the data set's name)")


def run(args: argparse.Namespace) -> int:
    from plushsense.apps.reporting import write_report

    folder = Path(args.dataset) / "evaluations"
    found = args.evaluation or [str(p.parent) for p in sorted(folder.glob("*/evaluation.json"))]
    path = write_report(args.out, args.dataset, found, args.model, args.title)
    emit(args, {"report": str(path), "evaluations": len(found), "models": len(args.model)}, str(path))
    return 0
