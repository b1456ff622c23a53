"""``plushsense trim DATASET [--only GLOB] [--accept GLOB | --accept-above 0.8] [--set ID FROM:TO] [--undo GLOB]``"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.apps.cli.output import bar, emit, say, table

if TYPE_CHECKING:
    from plushsense.dataset.trim import Accepted, Trim

LINES = 20


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--only", metavar="GLOB", default="*", help="recordings to show, draw and accept, as 'P01/*' (default: all)"
    )
    parser.add_argument(
        "--accept", action="append", default=[], metavar="ID|GLOB", help="mark what is suggested for these; repeatable"
    )
    parser.add_argument(
        "--accept-above", type=float, metavar="C", help="mark every suggestion of at least this confidence, 0 to 1"
    )
    parser.add_argument(
        "--set",
        nargs=2,
        action="append",
        default=[],
        metavar=("ID", "FROM:TO"),
        help="keep these seconds of one recording, as 0.35:2.1, 0.35: or :2.1; repeatable",
    )
    parser.add_argument(
        "--undo", action="append", default=[], metavar="ID|GLOB", help="take these marks back; repeatable"
    )
    parser.add_argument(
        "--offset",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="accept the suggested end too (default: the start alone, as in the paper)",
    )
    parser.add_argument("--who", metavar="NAME", help="who decides, kept in the mark (default: the login name)")
    parser.add_argument("--why", default="", metavar="TEXT", help="why, kept in the mark (default: nothing)")
    parser.add_argument(
        "--plot", metavar="FILE.png|DIR", help="draw recordings, the least sure first: one page, or all into a folder"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError
    from plushsense.core.extras import need
    from plushsense.dataset import trim
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.quality.deciding import signed

    if args.accept_above is not None and not 0.0 <= args.accept_above <= 1.0:
        raise ConfigError(f"--accept-above is {args.accept_above:g}: a confidence from 0 to 1 is accepted.")
    if args.plot:
        need("matplotlib", "reports")
    times = [(identity, *_seconds(text)) for identity, text in args.set]
    dataset = open_dataset(args.dataset)
    shown = trim.choose(dataset, args.only)
    if args.only == "*":
        shown = dataset.used
    found = {t.recording.id: t for t in trim.trims(dataset, shown, bar("reading"))}
    # Everything is found and understood before the first mark is made.
    undone = {r.id: r for pattern in args.undo for r in trim.choose(dataset, pattern)}
    by_name = {r.id: r for pattern in args.accept for r in trim.choose(dataset, pattern)}
    to_set = []
    for identity, start_s, stop_s in times:
        (info, *others) = trim.choose(dataset, identity)
        if others:
            raise ConfigError(f"--set changes one recording, and '{identity}' names {1 + len(others)}: give an id.")
        to_set.append((info, start_s, stop_s))
    missing = [r for r in [*by_name.values(), *(i for i, _, _ in to_set)] if r.id not in found]
    extra = {t.recording.id: t for t in trim.trims(dataset, missing)}
    for info, start_s, stop_s in to_set:
        trim.kept_rows((found | extra)[info.id], start_s, stop_s)

    who = signed(args.who) if _decides(args) else ""
    taken_back = trim.undo(dataset, list(undone.values()), who, args.why)
    adjusted = [
        info.id
        for info, start_s, stop_s in to_set
        if trim.set_trim(dataset, (found | extra)[info.id], start_s, stop_s, who, args.why)
    ]
    accepted = trim.Accepted()
    if by_name or args.accept_above is not None:
        chosen = list(by_name) if by_name else list(found)
        again = trim.renewed(dataset, [(found | extra)[identity] for identity in chosen])
        accepted = trim.accept(dataset, again, who, args.why, above=args.accept_above or 0.0, offset=args.offset)
    listed = trim.renewed(dataset, list(found.values()))
    drawn: list[Path] = []
    if args.plot:
        from plushsense.reports.trims import save_trims

        least_sure_first = sorted(listed, key=lambda t: t.suggestion.onset_confidence)
        drawn = save_trims(dataset, least_sure_first, Path(args.plot), args.offset)
    _tell(args, listed, accepted, adjusted, taken_back, drawn)
    return 0


def _decides(args: argparse.Namespace) -> bool:
    """Whether marks were asked for, rather than to look."""
    return bool(args.accept or args.set or args.undo) or args.accept_above is not None


def _seconds(text: str) -> tuple[float | None, float | None]:
    from plushsense.core.errors import ConfigError

    start, colon, stop = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return (float(start) if start.strip() else None, float(stop) if stop.strip() else None)
    except ValueError:
        raise ConfigError(f"--set was given '{text}': seconds as FROM:TO are accepted, such as 0.35:2.1.") from None


def _tell(
    args: argparse.Namespace,
    listed: list[Trim],
    accepted: Accepted,
    adjusted: list[str],
    undone: tuple[str, ...],
    drawn: list[Path],
) -> None:
    states = Counter(t.state for t in listed)
    result: dict[str, Any] = {
        "recordings": [t.to_dict(args.offset) for t in listed],
        "states": dict(states),
        "accepted": list(accepted.marked),
        "already": len(accepted.already),
        "not_visible": len(accepted.not_visible),
        "kept_by_hand": list(accepted.kept_by_hand),
        "adjusted": adjusted,
        "undone": list(undone),
        "plots": [str(path) for path in drawn],
    }
    # After a decision, what it changed; the rest was shown when it was made.
    decided = _decides(args)
    changed = {*accepted.marked, *adjusted, *undone}
    rows = [
        (
            r["recording"],
            r["rows"],
            f"{r['start_s']:.2f}",
            f"{r['stop_s']:.2f}",
            f"{r['confidence']:.2f}",
            r["state"],
            r["note"],
        )
        for r in result["recordings"]
        if not decided or r["recording"] in changed
    ]
    if not args.json and (args.accept or args.accept_above is not None):
        less_sure = " or not sure enough" if args.accept_above else ""
        say(
            f"accepted {len(accepted.marked)}, already so {len(accepted.already)}, "
            f"no visible onset{less_sure} {len(accepted.not_visible)}, "
            f"kept as set by hand {len(accepted.kept_by_hand)}"
        )
    if not args.json and args.set:
        say(f"adjusted {len(adjusted)}, already so {len(args.set) - len(adjusted)}")
    if not args.json and args.undo:
        say(f"undone {len(undone)}")
    counts = ", ".join(f"{n} {state}" for state, n in sorted(states.items()))
    head = ("recording", "rows", "start s", "stop s", "confidence", "state", "note")
    shown = [] if decided and not 0 < len(rows) <= LINES else [table(head, rows), ""]
    emit(args, result, [*shown, f"{len(listed)} recordings{': ' if counts else ''}{counts}", *map(str, drawn)])
