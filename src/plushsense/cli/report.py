"""``plushsense report OUT.html --dataset DS [--evaluation DIR …] [--model FILE …]``, or ``plushsense report SWEEP``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out",
        metavar="OUT.html|SWEEP",
        help="the page to write: a new file, or a report to replace; or a folder that sweep wrote",
    )
    parser.add_argument("--dataset", metavar="DATASET", help="data set folder (needed for a page of evaluations)")
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
    parser.add_argument("--page", metavar="FILE", help="of a sweep: the page to write (default: SWEEP/report.html)")
    parser.add_argument(
        "--mlflow", metavar="WHERE", help="of a sweep: log its finished trials to MLflow too, a folder or a URI"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.report import is_sweep
    from plushsense.workflow.reporting import write_report

    if is_sweep(args.out):
        return _sweep(args)
    if args.dataset is None or args.page or args.mlflow:
        what = "--dataset is missing" if args.dataset is None else "--page and --mlflow are for a sweep"
        raise ConfigError(
            f"'{args.out}' is not a folder that sweep wrote, and {what}: give a sweep's folder, or  "
            "plushsense report OUT.html --dataset DATASET"
        )
    folder = Path(args.dataset) / "evaluations"
    found = args.evaluation or [str(p.parent) for p in sorted(folder.glob("*/evaluation.json"))]
    path = write_report(args.out, args.dataset, found, args.model, args.title)
    emit(args, {"report": str(path), "evaluations": len(found), "models": len(args.model)}, str(path))
    return 0


def _sweep(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.report import write_sweep_report

    if args.dataset or args.evaluation or args.model:
        raise ConfigError(
            f"'{args.out}' is a sweep: --dataset, --evaluation and --model are for a page of evaluations."
        )
    done = write_sweep_report(args.out, args.page, title=args.title, mlflow=args.mlflow)
    emit(args, done, [f"{done['report']}: {done['done']} of {done['trials']} trials", *done["said"]])
    return 0
