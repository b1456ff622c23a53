"""Implement the options of ``plushsense check`` that label streams and relabel recordings, instead of the checks."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import seconds_between
from plushsense.core.sentences import plural

_LINES = 40


def decides_labels(args: argparse.Namespace) -> bool:
    """Return whether an option of labels is given."""
    return bool(args.label or args.unlabel or args.relabel or args.labels or args.save_labels)


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.labelling import check_labels_path, decide_labels, write_stretches

    if args.save_labels:
        check_labels_path(args.save_labels)
    done = decide_labels(
        args.dataset,
        label=[(stream, seconds_between("--label", times), label) for stream, times, label in args.label],
        unlabel=[(stream, seconds_between("--unlabel", times)) for stream, times in args.unlabel],
        relabel=args.relabel,
        file=args.labels,
        **options(args, "who", "why"),
    )
    if args.save_labels:
        write_stretches(args.save_labels, done.stretches)
        say(f"written: {args.save_labels}")
    seconds: dict[str, float] = {}
    for s in done.stretches:
        seconds[s.label] = seconds.get(s.label, 0.0) + s.stop_s - s.start_s
    result: dict[str, Any] = {
        "stretches": [asdict(s) for s in done.stretches],
        "seconds": {label: round(total, 1) for label, total in sorted(seconds.items())},
        "labelled": done.labelled,
        "undone": done.undone,
        "relabelled": list(done.relabelled),
    }
    for word, given in (("labelled", args.label or args.labels), ("undone", args.unlabel)):
        if given:
            say(f"{word} {result[word]}")
    if args.relabel:
        say(f"relabelled {plural(len(done.relabelled), 'recording')}")
    rows = [(s.stream, f"{s.start_s:.2f}", f"{s.stop_s:.2f}", s.label) for s in done.stretches]
    listing = [table(("stream", "start s", "stop s", "label"), rows), ""] if 0 < len(rows) <= _LINES else []
    totals = "".join(f"; {label} {total:.0f} s" for label, total in sorted(seconds.items()))
    emit(args, result, [*listing, f"{plural(len(rows), 'labelled stretch')}{totals}"])
    return 0
