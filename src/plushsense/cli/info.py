"""``plushsense info DATASET|BUNDLE``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit, table


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help="a data set folder or a .plush bundle")


def run(args: argparse.Namespace) -> int:
    if Path(args.path).suffix == ".plush":
        return _bundle(args)
    from plushsense.dataset.index import open_dataset

    dataset = open_dataset(args.path)
    summary = dataset.summary()
    rows = [(g["label"], g["affect"], g["recordings"], g["subjects"], g["median_s"]) for g in summary["gestures"]]
    emit(
        args,
        summary,
        f"{dataset!r}\nlayout {summary['layout']}, {summary['located_in_stream']} recordings located in a stream, "
        f"{summary['with_warnings']} with warnings, {summary['excluded']} excluded\nhash {summary['hash']}\n\n"
        + table(("gesture", "affect", "recordings", "people", "median s"), rows),
    )
    return 0


def _bundle(args: argparse.Namespace) -> int:
    from plushsense.models.bundle import Bundle
    from plushsense.workflow.reporting import card

    bundle = Bundle.load(args.path)
    result = card(
        bundle.arch,
        rate_hz=bundle.layout.rate_hz,
        layout=bundle.layout.name,
        gestures=list(bundle.gestures.labels),
        provenance=bundle.provenance,
    )
    if bundle.personal:
        result["adapted"] = {key: value for key, value in bundle.personal.items() if key != "original"}
    emit(args, result, [f"{key:<20}{value}" for key, value in result.items()])
    return 0
