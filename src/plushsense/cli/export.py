"""``plushsense export BUNDLE OUT``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.output import emit
from plushsense.cli.settings import listed, warn


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help="a .plush bundle, trained with padding stream and norm batch")
    parser.add_argument("out", metavar="OUT", help="new or empty folder")
    parser.add_argument(
        "--dataset",
        metavar="DS",
        help="the data set that it was trained on: calibrates on its training people's windows (default: what training "
        "kept in the bundle)",
    )
    parser.add_argument(
        "--also",
        default="",
        metavar="A,B",
        help="the network for other runtimes as well, each tried there first: onnx, onnx-int8 (extra onnx), tflite, "
        "tflite-int8 (extra tflite), espdl, espdl-esp32, espdl-esp32p4 (extra espdl)",
    )


def _converted(found: dict[str, Any]) -> str:
    apart = found["largest_difference"]
    said = "" if apart is None else f"; logits differ by up to {apart:.1g} from those it was made of"
    return f"  {found['file']:<17} {found['bytes']:,} bytes{said}"


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.export import export

    also = listed(args.also)
    done = export(args.bundle, args.out, dataset=args.dataset, also=also, warn=warn)
    facts = done.facts
    simulated = (
        ["  SIMULATION: trained on a virtual toy; it knows no real person's touch"] if facts["simulated"] else []
    )
    emit(
        args,
        done.to_dict(),
        [
            f"{args.out}: {facts['title']}, {facts['classes']} gestures, layout {facts['layout']}",
            *simulated,
            f"  model             {done.flash_bytes:,} bytes of flash; the code comes on top (plushsense profile)",
            f"  memory            {done.ram_bytes:,} bytes of RAM a toy",
            f"  a step            {facts['step_ms']:g} ms, {facts['macs_per_step']:,} MACs",
            *(_converted(each) for each in facts.get("conversions", {}).values()),
            f"  prove it          plushsense verify {args.out}",
        ],
    )
    return 0
