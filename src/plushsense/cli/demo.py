"""``plushsense demo [--quick] [--out DIR]``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from plushsense.cli.evaluate import spread
from plushsense.cli.output import emit, say, table
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="fewer people, fewer epochs: under a minute and a half")
    parser.add_argument(
        "--out", metavar="DIR", default="plushsense-demo", help="where everything is left (plushsense-demo)"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.demo import SIMULATION, run_demo

    began = time.monotonic()
    bars = {what: ProgressReporter(f"     {what}") for what in ("recording", "importing", "training", "folds")}
    say(f"PlushSense demo. {SIMULATION}")
    done = run_demo(Path(args.out), quick=args.quick, stage=say, progress=lambda what, at, of: bars[what](at, of))
    scores, heard = done["scores"], done["live"]["gestures"]
    rows = [(f"{g['t_s']:.1f}", g["performed"], g["said"], g["affect"], g["said_affect"]) for g in heard]
    right = sum(g["affect"] == g["said_affect"] for g in heard)
    summary = done["live"]["summary"]
    emit(
        args,
        {**done, "seconds": round(time.monotonic() - began, 1)},
        [
            "",
            f"SIMULATION. On virtual people left out ({scores['split']}, {scores['context']} context, one seed):",
            f"  accuracy {spread(scores['accuracy'])}",
            f"  macro-F1 {spread(scores['macro_f1'])}",
            "",
            "Live, a virtual person it never met; what it said as each gesture ended:",
            table(("at s", "performed", "said", "affect", "said"), rows),
            f"  affect right at the end of {right} of {len(heard)} gestures; "
            f"{summary['decisions_per_s']:.1f} decisions a second, {summary['counters']['lost']} lines lost, "
            f"{summary['counters']['malformed']} malformed",
            "",
            f"data set  {done['dataset']}",
            f"bundle    {done['bundle']}",
            f"report    {done['report']}   (open it in a browser)",
            f"C export  {done['export']}   (prove it: plushsense verify {done['export']})",
            f"{time.monotonic() - began:.0f} s. {SIMULATION}",
        ],
    )
    return 0
