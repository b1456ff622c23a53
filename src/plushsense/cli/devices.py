"""``plushsense devices`` lists toys; ``plushsense devices --lsl-out URL`` publishes one as an LSL stream."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say, table
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scan-s",
        type=float,
        default=3.0,
        metavar="S",
        help="seconds to search for Bluetooth and LSL devices (3)",
    )
    parser.add_argument(
        "--lsl-out",
        metavar="URL",
        help="publish this toy as an LSL stream until Ctrl-C instead, and reconnect when it disappears",
    )
    parser.add_argument("--lsl-name", metavar="NAME", help="name of that stream (default: PlushSense)")
    parser.add_argument("--layout", metavar="NAME", help="layout of that toy: name or TOML file (default: plush-15)")


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
