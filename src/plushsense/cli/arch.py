"""``plushsense arch SPEC --filters 8,12,16``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit
from plushsense.models.arch import Arch


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "spec",
        metavar="SPEC",
        help="architecture: kernel lengths in samples, joined by _, dilations after d (14d1_39d2_41d4)",
    )
    parser.add_argument("--filters", required=True, metavar="N,N,...", help="filters of each layer, such as 8,12,16")
    parser.add_argument("--padding", default="stream", help="stream (default), causal or mirror")
    parser.add_argument("--norm", default="batch", help="batch (default) or layer")
    parser.add_argument("--channels", type=int, default=11, metavar="N", help="number of input channels (11)")
    parser.add_argument("--classes", type=int, default=18, metavar="N", help="number of classes (18)")
    parser.add_argument("--window", type=int, default=250, metavar="N", help="window in samples (250: 2.5 s at 100 Hz)")
    parser.add_argument("--step", type=int, default=5, metavar="N", help="samples between two live decisions (5)")
    parser.add_argument(
        "--pool",
        type=int,
        metavar="N",
        help="samples that a decision averages, stream padding only (default: fill the window)",
    )


def run(args: argparse.Namespace) -> int:
    arch = Arch.parse(
        args.spec,
        args.filters,
        channels=args.channels,
        classes=args.classes,
        padding=args.padding,
        norm=args.norm,
        window=args.window,
        step=args.step,
        pool=args.pool,
    )
    from plushsense.workflow.reporting import card

    printed = f" (the paper's Table 3 prints {arch.table3})" if arch.table3 else ""
    again = "" if arch.padding == "stream" else "; this padding recomputes the window at every step"
    emit(
        args,
        card(arch),
        [
            f"{arch.symbol}  filters {','.join(map(str, arch.filters))}  padding {arch.padding}  norm {arch.norm}",
            f"  parameters        {arch.parameters:,}{printed}",
            f"  receptive field   {arch.receptive_field} samples",
            f"  span              {arch.span} samples seen by a decision",
            f"  MACs a window     {arch.macs_per_window:,}",
            f"  MACs a step       {arch.macs_per_step:,} (every {arch.step} samples{again})",
            f"  state, int8       {arch.state_bytes_int8:,} bytes",
        ],
    )
    return 0
