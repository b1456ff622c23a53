"""Implement ``plushsense info DATASET|BUNDLE [--durations]`` and ``arch SPEC --filters 8,12,16``."""

from __future__ import annotations

import argparse
from dataclasses import asdict, astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, table
from plushsense.core.errors import ConfigError, printable
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.dataset.statistics import Duration
    from plushsense.dataset.store import Dataset


def run(args: argparse.Namespace) -> int:
    if Path(args.path).suffix == ".plush":
        if args.durations:
            raise ConfigError(f"'{args.path}' is a bundle: --durations describe a data set.")
        return _bundle(args)
    from plushsense.dataset.index import open_dataset

    dataset = open_dataset(args.path)
    summary = dataset.summary()
    rows = [astuple(counts) for counts in dataset.gesture_counts()]
    text = [
        repr(dataset),
        f"layout {summary['layout']}, {summary['located_in_stream']} recordings located in a stream, "
        f"{summary['with_warnings']} with warnings, {summary['excluded']} excluded",
        f"hash {summary['hash']}",
        "",
        table(("gesture", "affect", "recordings", "people", "median s"), rows),
    ]
    if args.durations:
        more, lines = _durations(dataset)
        summary |= more
        text += ["", *lines]
    emit(args, summary, text)
    return 0


def _bundle(args: argparse.Namespace) -> int:
    from plushsense.models.bundle import Bundle
    from plushsense.reports.evaluation import model_rows
    from plushsense.workflow.reporting import card

    bundle = Bundle.load(args.path)
    result = card(
        bundle.arch,
        rate_hz=bundle.layout.rate_hz,
        layout=bundle.layout.name,
        gestures=list(bundle.gestures.labels),
        provenance=bundle.provenance,
    )
    adapted = {key: value for key, value in (bundle.personal or {}).items() if key != "original"}
    if adapted:
        result["adapted"] = adapted
    rows = [
        *model_rows(result),
        ("Layout", bundle.layout.name),
        ("Gestures", ", ".join(bundle.gestures.labels)),
        *((key.capitalize(), value) for key, value in adapted.items()),
    ]
    # A name from the file must not look like a line of this program.
    emit(args, result, [f"{printable(name):<31}{printable(str(value))}" for name, value in rows])
    return 0


def _durations(dataset: Dataset) -> tuple[dict[str, Any], list[str]]:
    """Return the durations of the recordings: JSON and text."""
    from plushsense.dataset.statistics import duration_table

    durations = duration_table(dataset)
    trimmed = sum(d.trimmed for d in durations)
    simulated = " (a simulation: it says nothing about people)" if dataset.head.simulated else ""
    text = [f"Durations{simulated}: {plural(len(dataset.used), 'recording')}, {trimmed} trimmed", ""]
    head = ("gesture", "recordings", "people", "mean s", "median s", "variance s²", "range s", "rows")
    for title, after in [("Whole recordings", False), ("After trimming", True)][: 2 if trimmed else 1]:
        text += [title, table(head, [_duration_row(d, after) for d in durations]), ""]
    return {"trimmed": trimmed, "durations": [asdict(d) for d in durations]}, text


def _duration_row(d: Duration, after: bool) -> tuple[object, ...]:
    s, rows = (d.after_s, d.after_rows) if after else (d.before_s, d.before_rows)
    return (
        d.gesture,
        d.recordings,
        d.people,
        f"{s.mean:.2f}",
        f"{s.median:.2f}",
        None if s.variance is None else f"{s.variance:.3f}",
        f"{s.min:.2f}–{s.max:.2f}",
        f"{rows.min:.0f}–{rows.max:.0f}, mean {rows.mean:.0f}",
    )


def run_arch(args: argparse.Namespace) -> int:
    from plushsense.models.arch import Arch
    from plushsense.workflow.reporting import card

    if not 0 < args.rate < float("inf"):
        raise ConfigError(f"--rate is {args.rate:g}: accepted are samples a second, above 0.")
    arch = Arch.parse(
        args.spec,
        args.filters,
        **options(args, "channels", "classes", "padding", "norm", "window", "step", "pool", "vectors", "pooling"),
    )
    printed = f" (the paper's Table 3 prints {arch.table3})" if arch.table3 else ""
    seconds = arch.receptive_field / args.rate
    again = "" if arch.padding == "stream" else "; this padding recomputes the window at every step"
    emit(
        args,
        card(arch, rate_hz=args.rate),
        [
            f"{arch.symbol}  filters {','.join(map(str, arch.filters))}  padding {arch.padding}  norm {arch.norm}"
            f"  pooling {arch.pooling}",
            f"  parameters        {arch.parameters:,}{printed}",
            f"  receptive field   {arch.receptive_field} samples, {seconds:.2f} s at {args.rate:g} Hz",
            f"  span              {arch.span} samples seen by a decision, {arch.span / args.rate:.2f} s",
            f"  MACs a window     {arch.macs_per_window:,}",
            f"  MACs a step       {arch.macs_per_step:,} (every {arch.step} samples{again})",
            f"  state, int8       {arch.state_bytes_int8:,} bytes",
        ],
    )
    return 0
