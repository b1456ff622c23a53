"""Implement ``plushsense demo [--quick] [--out DIR]``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from plushsense.cli.output import emit, say, spread, table
from plushsense.cli.settings import report_stages
from plushsense.core.sentences import plural


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.demo import SIMULATION, run_demo

    began = time.monotonic()
    say(f"PlushSense demo. {SIMULATION}")
    done = run_demo(Path(args.out), quick=args.quick, stage=say, progress=report_stages(indent=5 * " "))
    result, gestures, counters = done.evaluation, done.gestures, done.live.counters
    rows = [(f"{g.t_s:.1f}", g.performed, g.decided, g.affect, g.decided_affect) for g in gestures]
    right = sum(g.affect == g.decided_affect for g in gestures)
    means = {key: result.scores.means[key].to_json() for key in ("accuracy", "macro_f1")}
    emit(
        args,
        {**done.to_json(), "seconds": round(time.monotonic() - began, 1)},
        [
            "",
            f"SIMULATION. On virtual people left out ({result.split.text}, {result.context} context, one seed):",
            f"  accuracy {spread(means['accuracy'])}",
            f"  macro-F1 {spread(means['macro_f1'])}",
            "",
            "Live, a virtual person left out of the training; the decision at the end of each gesture:",
            table(("at s", "performed", "decided", "affect", "decided"), rows),
            f"  affect correct at the end of {right} of {plural(len(gestures), 'gesture')}; "
            f"{done.live.decisions_per_s:.1f} decisions a second, {plural(counters['lost'], 'line')} lost, "
            f"{counters['malformed']} malformed",
            "",
            f"data set  {done.dataset}",
            f"bundle    {done.bundle}",
            f"report    {done.report}   (open it in a browser)",
            f"C export  {done.export}   (prove it: plushsense verify {done.export})",
            f"{time.monotonic() - began:.0f} s. {SIMULATION}",
        ],
    )
    return 0
