"""``plushsense stats DATASET [--by age_group|gender|COLUMN] [--channels]``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, table

if TYPE_CHECKING:
    from plushsense.dataset.statistics import Duration, SummaryStatistics


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--by",
        metavar="COLUMN",
        help="also by age_group, gender or another column of subjects.csv, or by subject (default: all together)",
    )
    parser.add_argument(
        "--channels", action="store_true", help="also mean and standard deviation of every channel (default: not)"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.dataset.statistics import channel_table, duration_table

    dataset = open_dataset(args.dataset)
    durations = duration_table(dataset, args.by)
    channels = channel_table(dataset) if args.channels else []
    trimmed = sum(r.stop - r.start < r.rows for r in dataset.used)
    result: dict[str, Any] = {
        "dataset": dataset.head.name,
        "by": args.by,
        "simulated": dataset.head.simulated,
        "recordings": len(dataset.used),
        "trimmed": trimmed,
        "durations": [d.to_dict() for d in durations],
        "channels": [c.to_dict() for c in channels],
    }
    simulated = " (a simulation: it says nothing about people)" if dataset.head.simulated else ""
    said = [f"{dataset.head.name}{simulated}: {len(dataset.used)} recordings, {trimmed} trimmed", ""]
    said += ["Whole recordings", _durations(durations, args.by, after=False), ""]
    if trimmed:
        said += ["After trimming", _durations(durations, args.by, after=True), ""]
    if channels:
        head = ("gesture", "channel", "unit", "rows", "mean", "sd")
        rows = [(c.gesture, c.channel, c.unit, c.rows, f"{c.mean:.4g}", f"{c.sd:.4g}") for c in channels]
        said += ["Channels, after trimming", table(head, rows)]
    emit(args, result, said)
    return 0


def _durations(durations: list[Duration], by: str | None, after: bool) -> str:
    groups = (by,) if by else ()
    head = ("gesture", *groups, "recordings", "people", "mean s", "median s", "variance s²", "range s", "rows")
    return table(head, [_row(d, bool(by), after) for d in durations])


def _row(d: Duration, grouped: bool, after: bool) -> tuple[object, ...]:
    s: SummaryStatistics = d.after_s if after else d.before_s
    rows: SummaryStatistics = d.after_rows if after else d.before_rows
    return (
        d.gesture,
        *([d.group] if grouped else []),
        d.recordings,
        d.people,
        f"{s.mean:.2f}",
        f"{s.median:.2f}",
        None if s.variance is None else f"{s.variance:.3f}",
        f"{s.min:.2f}–{s.max:.2f}",
        f"{rows.min:.0f}–{rows.max:.0f}, mean {rows.mean:.0f}",
    )
