"""Implement ``plushsense explain BUNDLE DATASET``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit, say, warn
from plushsense.cli.settings import listed


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.experiments.explanation.report import SIMULATION, TRAINED_ON, gesture_table
    from plushsense.experiments.explanation.run import PAGE, explain, explain_id
    from plushsense.models.bundle import Bundle

    bundle, dataset = Bundle.load(args.bundle), open_dataset(args.dataset)
    gestures = None if args.gestures is None else listed(args.gestures)
    name = f"explain_{explain_id(bundle, dataset, gestures)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = explain(bundle, dataset, gestures=gestures, out=out, overwrite=args.force, warn=warn)
    result |= {"out": str(out), "report": str(out / PAGE)}
    say(f"written: {out}")
    lines = [SIMULATION, ""] if result["simulated"] else []
    lines += [TRAINED_ON, ""] if result["trained_on"] else []
    lines += [
        gesture_table(result).text(),
        "",
        "area: under the mean probability while blocks are deleted, the highest attribution first; lower than at "
        "random if the attribution names what decided",
    ]
    emit(args, result, lines)
    return 0
