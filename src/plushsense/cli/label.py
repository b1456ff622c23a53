"""Implement ``plushsense label DATASET``: ``[STREAM] [--from S --to S --as LABEL | --undo | --import FILE]``, or
``--recording ID --as GESTURE | --undo``.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

_LINES = 40


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.labelling import check_labels_path, decide_labels, write_stretches

    if args.recording:
        return _relabel(args)
    if args.export:
        check_labels_path(args.export)
    done = decide_labels(
        args.dataset,
        args.stream,
        start_s=getattr(args, "from"),
        stop_s=args.to,
        label=getattr(args, "as"),
        file=getattr(args, "import"),
        **options(args, "undo", "who", "why"),
    )
    if args.export:
        write_stretches(args.export, done.stretches)
        say(f"written: {args.export}")
    seconds: dict[str, float] = {}
    for s in done.stretches:
        seconds[s.label] = seconds.get(s.label, 0.0) + s.stop_s - s.start_s
    result = {
        "stretches": [asdict(s) for s in done.stretches],
        "seconds": {label: round(total, 1) for label, total in sorted(seconds.items())},
        "labelled": done.labelled,
        "undone": done.undone,
    }
    if getattr(args, "as") or getattr(args, "import"):
        say(f"labelled {done.labelled}")
    if args.undo:
        say(f"undone {done.undone}")
    rows = [(s.stream, f"{s.start_s:.2f}", f"{s.stop_s:.2f}", s.label) for s in done.stretches]
    listing = [table(("stream", "start s", "stop s", "label"), rows), ""] if 0 < len(rows) <= _LINES else []
    totals = "".join(f"; {label} {total:.0f} s" for label, total in sorted(seconds.items()))
    emit(args, result, [*listing, f"{plural(len(rows), 'labelled stretch')}{totals}"])
    return 0


def _relabel(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.labelling import relabel
    from plushsense.dataset.trimming import find_recordings

    gesture = getattr(args, "as") or ""
    if bool(gesture) == args.undo:
        raise ConfigError("Give the gesture that was made with --as GESTURE, or --undo to restore the recorded one.")
    dataset = open_dataset(args.dataset)
    chosen = [r.id for r in find_recordings(dataset, args.recording)]
    changed = relabel(dataset, chosen, gesture, **options(args, "who", "why"))
    emit(args, {"relabelled": list(changed)}, [f"relabelled {len(changed)} of {plural(len(chosen), 'recording')}"])
    return 0
