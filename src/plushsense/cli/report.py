"""Implement ``plushsense report OUT.html --dataset DS [--evaluation DIR …] [--model FILE …]`` and ``report SWEEP``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit
from plushsense.core.errors import ConfigError


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.sweep.report import is_sweep
    from plushsense.workflow.reporting import write_report

    if is_sweep(args.out):
        return _sweep(args)
    if args.dataset is None or args.page or args.mlflow:
        problem = "--dataset is missing" if args.dataset is None else "--page and --mlflow are for a sweep"
        raise ConfigError(
            f"'{args.out}' is not a folder written by sweep, and {problem}: give a sweep's folder, or  "
            "plushsense report OUT.html --dataset DATASET"
        )
    folder = Path(args.dataset) / "evaluations"
    evaluations = args.evaluation or [str(p.parent) for p in sorted(folder.glob("*/evaluation.json"))]
    path = write_report(args.out, args.dataset, evaluations, args.model, args.title)
    emit(args, {"report": str(path), "evaluations": len(evaluations), "models": len(args.model)}, str(path))
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
