"""``plushsense devices [--lsl-out URL]``, ``toy --serial-pty | --tcp PORT | --lsl NAME`` and ``simulate OUT``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import listed, options, report_stages
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--scan-s", type=float, default=3.0, metavar="S", help="seconds to search for Bluetooth and LSL devices (3)")
    add(
        "--lsl-out",
        metavar="URL",
        help="publish this toy as an LSL stream until Ctrl-C instead, and reconnect when it disappears",
    )
    add("--lsl-name", metavar="NAME", help="name of that stream (default: PlushSense)")
    add("--layout", metavar="NAME", help="layout of that toy: name or TOML file (default: plush-15)")


def run(args: argparse.Namespace) -> int:
    if args.lsl_out is not None:
        return _publish(args)
    if args.lsl_name is not None or args.layout is not None:
        raise ConfigError("--lsl-name and --layout belong to --lsl-out URL: add it, or leave them out.")
    from plushsense.devices.opening import list_devices

    listing = list_devices(args.scan_s)
    rows = [(d.url, d.name, d.description) for d in listing.devices]
    emit(args, listing.to_dict(), table(("URL", "name", "description"), rows))
    if not args.json:
        for note in listing.notes:
            say(note)
    return 0


def _publish(args: argparse.Namespace) -> int:
    from plushsense.devices.lsl import LslOutlet, forward
    from plushsense.devices.opening import open_device

    with (
        open_device(args.lsl_out, args.layout, reconnect=True) as device,
        LslOutlet(device.layout, args.lsl_name or "PlushSense") as outlet,
    ):
        emit(args, {"url": outlet.url, "device": device.url, "layout": device.layout.name}, outlet.url)
        say(f"publishing {device.url} ({device.layout.name}) as LSL stream '{outlet.name}'; Ctrl-C ends")
        try:
            forward(device, outlet)
        except KeyboardInterrupt:
            say("stopped")
        finally:
            counters = device.counters
            say(f"published {counters.frames} frames; lost {counters.lost}, reconnected {counters.reconnects} times")
    return 0


def add_toy(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    transport = parser.add_mutually_exclusive_group(required=True)
    transport.add_argument("--serial-pty", action="store_true", help="serve on a pseudo terminal, like a serial port")
    transport.add_argument("--tcp", type=int, metavar="PORT", help="serve on a port of 127.0.0.1; 0: any free one")
    transport.add_argument("--lsl", metavar="NAME", help="publish an LSL stream of this name")
    add("--person", type=int, default=101, metavar="N", help="number of the virtual person (101: in no data set)")
    add("--seed", type=int, default=1, metavar="N", help="random seed; the same seed sends the same bytes (1)")
    add("--speed", type=float, default=1.0, metavar="X", help="speed relative to real time (1)")
    add("--layout", default="plush-15", metavar="NAME", help="firmware: plush-15 (default) or plush-14")
    add("--gestures", metavar="LABELS", help="labels joined by commas, repeated (default: all, at random)")
    add("--lost", type=float, metavar="P", help="share of lines that are lost, 0 to 0.9 (0.0005)")
    add("--garbled", type=float, metavar="P", help="share of lines that are garbled, 0 to 0.9 (0.0003)")
    add("--glitch", type=float, metavar="P", help="share of frames with an invalid reading, 0 to 0.9 (0.00002)")
    add(
        "--follow",
        metavar="LOG",
        help="perform the gestures that a recorder prompts: the session.jsonl of `plushsense record`, which need not "
        "exist yet (default: independent)",
    )
    add("--seconds", type=float, default=0.0, metavar="S", help="stop after this much of the toy's time (0: never)")
    add("--truth", metavar="FILE", help="append the performed gestures as JSON lines")


def run_toy(args: argparse.Namespace) -> int:
    from plushsense.core.layouts import load_layout
    from plushsense.devices.virtual.server import ToyServer
    from plushsense.devices.virtual.stream import LogPrompts, PerformedGesture, ToySpec

    gestures = tuple(listed(args.gestures or ""))
    spec = ToySpec(args.person, args.seed, lost=args.lost, garbled=args.garbled, glitch=args.glitch, gestures=gestures)
    try:
        truth = Path(args.truth).open("a", encoding="utf-8") if args.truth else None
    except OSError as error:
        raise ConfigError(f"--truth '{args.truth}' cannot be written: {error.strerror}.") from None

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
        say(f"published {counters.sent} frames")  # LSL does not report who received them
    else:
        say(f"sent {counters.sent} lines; {counters.dropped} had no reader")
    return 0


def add_simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("out", metavar="OUT", help="new or empty folder; gets one folder a person with recordings and session stream")
    add("--people", type=int, default=25, metavar="N", help="number of virtual people (25, as in the paper)")
    add("--repetitions", type=int, default=3, metavar="N", help="recordings of each gesture by each person (3)")
    add("--seed", type=int, default=1, metavar="N", help="random seed; the same seed gives the same recordings (1)")
    add("--dataset", metavar="DIR", help="also import them as a data set in this new folder")


def run_simulate(args: argparse.Namespace) -> int:
    from plushsense.workflow.api import simulate

    summary = simulate(
        args.out,
        **options(args, "people", "repetitions", "seed", "dataset"),
        progress=report_stages(),
    )
    emit(
        args,
        summary,
        f"{args.dataset or args.out}: {summary['recordings']} recordings of {args.people} virtual people. "
        "A simulation: scores on it say nothing about a real toy.",
    )
    return 0
