"""``plushsense toy --serial-pty | --tcp PORT | --lsl NAME``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from plushsense.cli.output import emit, say
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--serial-pty", action="store_true", help="a pseudo terminal that looks like a serial port")
    where.add_argument("--tcp", type=int, metavar="PORT", help="a port of 127.0.0.1; 0 takes a free one")
    where.add_argument("--lsl", metavar="NAME", help="a stream of this name on the lab streaming layer")
    parser.add_argument(
        "--person", type=int, default=101, metavar="N", help="which virtual person plays (101: in no data set)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="same seed, same bytes (1)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time (1)")
    parser.add_argument("--layout", default="plush-15", metavar="NAME", help="firmware: plush-15 (default) or plush-14")
    parser.add_argument(
        "--gestures", metavar="LABELS", help="labels joined by commas, over and over (default: all, at random)"
    )
    parser.add_argument(
        "--lost",
        type=float,
        metavar="P",
        help="share of lines that are lost, 0 to 0.9 (0.0005)",
    )
    parser.add_argument(
        "--garbled",
        type=float,
        metavar="P",
        help="share of lines that are garbled, 0 to 0.9 (0.0003)",
    )
    parser.add_argument(
        "--glitch",
        type=float,
        metavar="P",
        help="share of frames in which a sensor reads nonsense, 0 to 0.9 (0.00002)",
    )
    parser.add_argument(
        "--follow",
        metavar="LOG",
        help="make the gestures that a recorder asks for: the session.jsonl that `plushsense record` writes "
        "(it need not be there yet); default: plays by itself",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=0.0,
        metavar="S",
        help="stop after so many seconds of the toy's time (0: never)",
    )
    parser.add_argument("--truth", metavar="FILE", help="append what is performed, as JSON lines (default: nowhere)")


def run(args: argparse.Namespace) -> int:
    from plushsense.core.layouts import load_layout
    from plushsense.devices.virtual.server import ToyServer
    from plushsense.devices.virtual.stream import LogPrompts, PerformedGesture, ToySpec

    gestures = tuple(g.strip() for g in args.gestures.split(",")) if args.gestures else ()
    spec = ToySpec(args.person, args.seed, lost=args.lost, garbled=args.garbled, glitch=args.glitch, gestures=gestures)
    try:
        truth = Path(args.truth).open("a", encoding="utf-8") if args.truth else None
    except OSError as cause:
        raise ConfigError(f"The truth cannot be written to '{args.truth}': {cause.strerror}.") from None

    def ready(url: str) -> None:
        emit(args, {"url": url}, url)
        say(f"virtual toy, person {args.person}; read it with  plushsense live --device {url} --model ...; Ctrl-C ends")

    def performed(gesture: PerformedGesture) -> None:
        say(f"{gesture.start_ms / 1000:9.1f} s  {gesture.label}")
        if truth is not None:
            truth.write(json.dumps(gesture.to_dict(), ensure_ascii=False) + "\n")
            truth.flush()

    server = ToyServer(
        spec,
        load_layout(args.layout),
        args.speed,
        args.seconds,
        on_ready=ready,
        on_performed=performed,
        prompts=LogPrompts(args.follow) if args.follow else None,
    )
    try:
        if args.lsl is not None:
            from plushsense.devices.lsl import serve_lsl

            counters = serve_lsl(args.lsl, server)
        else:
            counters = server.serve_pty() if args.serial_pty else server.serve_tcp(args.tcp)
    except KeyboardInterrupt:
        say("stopped")
        return 0
    finally:
        if truth is not None:
            truth.close()
    if args.lsl is not None:
        say(f"published {counters.sent} frames")  # who took them, LSL does not say
    else:
        say(f"sent {counters.sent} lines, {counters.dropped} found no reader")
    return 0
