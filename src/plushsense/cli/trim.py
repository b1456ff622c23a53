"""Implement ``plushsense trim DATASET [--only GLOB] [--accept GLOB] [--set ID FROM:TO] [--undo GLOB]``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import seconds_between
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.dataset.trimming import TrimResult

_LINES = 20


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.trimming import TrimDecisions, decide_trims

    if args.plot:
        from plushsense.reports.quality_figures import check_picture_path

        check_picture_path(Path(args.plot))
    decisions = TrimDecisions(
        **options(args, "only", "accept", "undo", "offset", "who", "why"),
        above=args.accept_above,
        keep=[(identity, *seconds_between("--set", text)) for identity, text in args.set],
    )
    result = decide_trims(args.dataset, decisions, ProgressReporter("reading"))
    drawn: list[Path] = []
    if args.plot:
        from plushsense.reports.quality_figures import save_trims

        least_sure_first = sorted(result.trims, key=lambda t: t.suggestion.onset_confidence)
        drawn = save_trims(result.dataset, least_sure_first, Path(args.plot), args.offset)
    _print(args, result, drawn)
    return 0


def _decides(args: argparse.Namespace) -> bool:
    """Return whether the given options change marks."""
    return bool(args.accept or args.set or args.undo) or args.accept_above is not None


def _print(args: argparse.Namespace, done: TrimResult, drawn: list[Path]) -> None:
    accepted, states = done.accepted, done.states
    result: dict[str, Any] = {
        "recordings": [t.to_dict(args.offset) for t in done.trims],
        "states": states,
        "accepted": list(accepted.marked),
        "already": len(accepted.already),
        "not_visible": len(accepted.not_visible),
        "kept_by_hand": list(accepted.kept_by_hand),
        "adjusted": list(done.adjusted),
        "undone": list(done.undone),
        "plots": [str(path) for path in drawn],
    }
    # After a decision only the changed recordings are listed.
    decided = _decides(args)
    rows = []
    for t in done.trims:
        if not decided or t.recording.id in done.changed:
            start, stop = (f"{t.seconds[row]:.2f}" for row in t.current_rows(args.offset))
            surest = f"{t.suggestion.onset_confidence:.2f}"
            rows.append((t.recording.id, t.recording.rows, start, stop, surest, t.state, t.suggestion.why))
    if not args.json and (args.accept or args.accept_above is not None):
        below = " or below the confidence" if args.accept_above else ""
        say(
            f"accepted {len(accepted.marked)}, accepted before {len(accepted.already)}, "
            f"no visible onset{below} {len(accepted.not_visible)}, "
            f"kept as set by hand {len(accepted.kept_by_hand)}"
        )
    if not args.json and args.set:
        say(f"adjusted {len(done.adjusted)}, unchanged {len(args.set) - len(done.adjusted)}")
    if not args.json and args.undo:
        say(f"undone {len(done.undone)}")
    counts = ", ".join(f"{n} {state}" for state, n in sorted(states.items()))
    head = ("recording", "rows", "start s", "stop s", "confidence", "state", "note")
    listing = [] if decided and not 0 < len(rows) <= _LINES else [table(head, rows), ""]
    emit(
        args,
        result,
        [*listing, f"{plural(len(done.trims), 'recording')}{': ' if counts else ''}{counts}", *map(str, drawn)],
    )
