"""``plushsense stream-eval DATASET|FOLDER --model BUNDLE`` or ``… DATASET --split by-subject:5``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import add_settings, listed, report_folds, settings, warn


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="DATASET|FOLDER", help="data set; with --model also a folder of recordings with their stream"
    )
    parser.add_argument("--model", metavar="BUNDLE", help="a .plush bundle, with its own decision settings")
    parser.add_argument(
        "--subjects", metavar="P01,P02", help="whose streams, for --model (default: all it was not trained on)"
    )
    parser.add_argument(
        "--split",
        metavar="SPLIT",
        help="instead of --model: train and tune each fold, compare all systems; by-subject:5 or leave-one-subject-out",
    )
    parser.add_argument(
        "--systems",
        metavar="NAME,...",
        help="for --split, which to compare: argmax, smoothed, hysteresis, hybrid, anywhere-smoothed, anywhere, full "
        "(default: all)",
    )
    parser.add_argument(
        "--late",
        type=float,
        default=1.0,
        metavar="S",
        help="how long after its end a gesture may still be answered, seconds (1)",
    )
    parser.add_argument(
        "--anywhere-pool",
        type=float,
        metavar="S",
        help="for --split: seconds that networks trained anywhere in the stream pool (default: as the others)",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="folds at a time (default 0: one a processor)")
    parser.add_argument("--out", metavar="DIR", help="for --split: folder for the page, figures, CSV and JSON")
    parser.add_argument("--force", action="store_true", help="replace a benchmark that is in --out")
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError

    if (args.model is None) == (args.split is None):
        raise ConfigError("Give either --model BUNDLE, to replay streams through it, or --split by-subject:5.")
    if not 0.0 <= args.late <= 10.0:
        raise ConfigError(f"--late is {args.late:g}: accepted are 0 to 10 seconds.")
    return _one(args) if args.model is not None else _folds(args)


def _one(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError
    from plushsense.experiments.streams.run import stream_eval

    if args.out or args.systems or args.anywhere_pool is not None:
        raise ConfigError("--out, --systems and --anywhere-pool belong to --split: leave them or --model out.")
    result = stream_eval(
        args.source,
        args.model,
        subjects=None if args.subjects is None else listed(args.subjects),
        late_s=args.late,
        warn=warn,
    )
    emit(args, result, _format_model(result))
    return 0


def _folds(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError
    from plushsense.experiments.streams.run import PAGE, stream_benchmark

    if args.subjects:
        raise ConfigError("--subjects belongs to --model: a split scores everybody once.")
    config = settings(args, workers=args.workers)
    result = stream_benchmark(
        args.source,
        config,
        split=args.split,
        systems=None if args.systems is None else listed(args.systems),
        out=args.out,
        overwrite=args.force,
        late_s=args.late,
        anywhere_pool_s=args.anywhere_pool,
        progress=report_folds("streams"),
        warn=warn,
    )
    if args.out:
        result["out"] = args.out
        say(f"written: {Path(args.out) / PAGE}")
    emit(args, result, _compared(result))
    return 0


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"


_HEAD = (
    "truths",
    "hits",
    "deleted",
    "events",
    "false",
    "fragmented",
    "merged",
    "recall",
    "F1",
    "false/h",
    "median s",
    "90 % s",
)


def _row(s: dict[str, Any]) -> tuple[object, ...]:
    late = s["latency_s"]
    return (
        *(s[k] for k in ("truths", "hits", "deletions", "events", "insertions", "fragmentations", "merges")),
        _number(s["recall"]),
        _number(s["f1"]),
        _rate(s.get("false_events_per_hour")),
        _number(late["median"]),
        _number(late["p90"]),
    )


def _marks(result: dict[str, Any]) -> list[str]:
    if not result["simulated"]:
        return []
    return ["SIMULATION: these figures are of the virtual toy and say nothing about a real one.", ""]


def _format_model(result: dict[str, Any]) -> list[str]:
    """Format one model's figures as text: a row a person, a row a gesture, then all."""
    people = [
        (person + (" TRAINED ON" if row["trained_on"] else ""), *_row(row)) for person, row in result["people"].items()
    ]
    gestures = [(label, *_row(row)) for label, row in result["per_class"].items()]
    place = result["outside"]
    return [
        *_marks(result),
        table(("person", *_HEAD), [*people, ("all", *_row(result))]),
        "",
        table(("gesture", *_HEAD), gestures),
        "",
        f"{result['hours']:.2f} h of streams, {result['uncovered_hours']:.2f} h outside of any true gesture",
        f"false events: {result['confused']} within another gesture; outside {place['all']}, of these "
        f"{place['rest']} at rest ({_rate(result['at_rest_per_hour'])} an hour), {place['other']} in gestures that the "
        "model does not know",
        f"outside of true gestures {_rate(result['outside_per_uncovered_hour'])} an hour",
        result["note"],
        *([f"TRAINED ON {', '.join(result['trained_on'])}: no result"] if result["trained_on"] else []),
    ]


def _compared(result: dict[str, Any]) -> list[str]:
    """Format the systems as text: a row a system and setting, then false events at equal recall."""
    rows = [
        (system["title"], how, *_row(system[how]))
        for system in result["systems"].values()
        for how in ("plain", "balanced", "cheapest")
        if how in system
    ]
    names = list(result["systems"])
    equal = []
    for row in result["at_recall"]:
        cells = [f"{row['recall']:.2f}"]
        for name in names:
            found = row["systems"][name]
            ratio = "" if found["ratio"] is None or name == result["reference"] else f" (x {found['ratio']:.2f})"
            cells.append(_rate(found["false_events_per_hour"]) + ratio)
        equal.append(cells)
    people = len(result["subjects"])
    return [
        *_marks(result),
        f"split {result['split']}, {people} people left out in turn, seed {result['seed']}",
        "",
        table(("system", "setting", *_HEAD), rows),
        "",
        "plain: no threshold; balanced, cheapest: highest F1 and lowest cost on those who tune",
        "",
        *(["false events an hour at equal recall:", "", table(("recall", *names), equal), ""] if equal else []),
        result["note"],
    ]
