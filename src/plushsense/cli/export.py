"""``plushsense export BUNDLE OUT``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.output import emit, warn
from plushsense.cli.settings import listed


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help=".plush bundle, trained with padding stream and norm batch")
    parser.add_argument("out", metavar="OUT", help="new or empty folder")
    parser.add_argument(
        "--dataset",
        metavar="DS",
        help="data set that it was trained on: calibrate on the windows of its training people (default: use the "
        "calibration in the bundle)",
    )
    parser.add_argument(
        "--also",
        default="",
        metavar="A,B",
        help="formats for other runtimes, each tried there first: onnx, onnx-int8 (extra onnx), tflite, tflite-int8 "
        "(extra tflite), espdl, espdl-esp32, espdl-esp32p4 (extra espdl)",
    )


def _conversion(entry: dict[str, Any]) -> str:
    largest = entry["largest_difference"]
    difference = "" if largest is None else f"; logits differ from the original by at most {largest:.1g}"
    return f"  {entry['file']:<17} {entry['bytes']:,} bytes{difference}"


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.export import export

    done = export(args.bundle, args.out, dataset=args.dataset, also=listed(args.also), warn=warn)
    facts = done.facts
    simulated = ["  SIMULATION: trained on a virtual toy, not on real touch"] if facts["simulated"] else []
    emit(
        args,
        done.to_dict(),
        [
            f"{args.out}: {facts['title']}, {facts['classes']} gestures, layout {facts['layout']}",
            *simulated,
            f"  model             {done.flash_bytes:,} bytes of flash, without the code (see plushsense profile)",
            f"  memory            {done.ram_bytes:,} bytes of RAM",
            f"  a step            {facts['step_ms']:g} ms, {facts['macs_per_step']:,} MACs",
            *(_conversion(entry) for entry in facts.get("conversions", {}).values()),
            f"  prove it          plushsense verify {args.out}",
        ],
    )
    return 0
