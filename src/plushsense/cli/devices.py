"""Implement ``plushsense devices [--lsl-out URL]``, ``toy`` on a port or into a folder, and ``simulate OUT``."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table, warn
from plushsense.cli.settings import listed, report_stages
from plushsense.cli.signals import interrupt_on_signals
from plushsense.core.errors import ConfigError
from plushsense.core.files import check_output_file
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.devices.virtual.stream import ToySpec


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
        interrupt_on_signals(),
        open_device(args.lsl_out, args.layout, reconnect=True) as device,
        LslOutlet(device.layout, args.lsl_name or "PlushSense") as outlet,
    ):
        emit(args, {"url": outlet.url, "device": device.url, "layout": device.layout.name}, outlet.url)
        say(f"publishing {device.url} ({device.layout.name}) as LSL stream '{outlet.name}'; Ctrl-C ends")
        try:
            forward(device, outlet, warn=warn)
        except KeyboardInterrupt:
            say("stopped")
        finally:
            counters = device.counters
            say(
                f"published {plural(counters.frames, 'frame')}; lost {counters.lost}, reconnected "
                f"{plural(counters.reconnects, 'time')}"
            )
    return 0


def run_toy(args: argparse.Namespace) -> int:
    from plushsense.core.layouts import load_layout
    from plushsense.devices.virtual.server import ToyServer
    from plushsense.devices.virtual.stream import LogPrompts, PerformedGesture

    spec = _toy_spec(args)
    if args.out is not None:
        return _play_to_folder(args, spec)
    if args.truth:
        check_output_file(Path(args.truth), '{"label": ', "a file of truth", ConfigError, append=True)
    try:
        truth = Path(args.truth).open("a", encoding="utf-8") if args.truth else None
    except OSError as error:
        raise ConfigError(f"--truth '{args.truth}' cannot be written: {error.strerror or error}.") from None

    def ready(url: str) -> None:
        emit(args, {"url": url}, url)
        who = f"person {spec.person}" if spec.scenario is None else f"scenario {args.scenario}"
        say(f"virtual toy, {who}; read it with  plushsense live --device {url} --model ...; Ctrl-C ends")

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
        counters = server.serve_pty() if args.serial_pty else server.serve_tcp(args.tcp)
    except KeyboardInterrupt:
        say("stopped")
        return 0
    finally:
        if truth is not None:
            truth.close()
    say(f"sent {plural(counters.sent, 'line')}; {counters.dropped} had no reader")
    return 0


def _toy_spec(args: argparse.Namespace) -> ToySpec:
    from plushsense.devices.virtual.scenario import load_scenario
    from plushsense.devices.virtual.stream import ToySpec

    shares = {name: getattr(args, name) for name in ("lost", "garbled", "glitch")}
    if args.scenario is None:
        person, seed = (default if given is None else given for given, default in ((args.person, 101), (args.seed, 1)))
        return ToySpec(person, seed, gestures=tuple(listed(args.gestures or "")), **shares)
    for option in ("person", "gestures"):
        if getattr(args, option) is not None:
            raise ConfigError(f"The scenario says the {option}: leave out --{option}, or --scenario.")
    return ToySpec.of(load_scenario(args.scenario), args.seed, **shares)


def _play_to_folder(args: argparse.Namespace, spec: ToySpec) -> int:
    from plushsense.recording.simulate import RECORDED, play_to_folder

    for option in ("follow", "truth"):
        if getattr(args, option) is not None:
            raise ConfigError(f"--out writes a scenario as it is, with its truth: leave out --{option}.")
    if args.scenario is None:
        raise ConfigError("--out needs a toy that ends: add --scenario FILE.")
    for option, value in (("seconds", args.seconds), ("speed", args.speed - 1.0)):
        if value:
            raise ConfigError(f"--out plays the whole scenario without waiting: leave out --{option}.")
    played = play_to_folder(spec, args.out, args.layout)
    counters = ", ".join(f"{name} {number}" for name, number in played.counters.to_dict().items())
    emit(
        args,
        played.to_dict(),
        f"{args.out}: {played.seconds:.1f} s, {plural(played.gestures, 'gesture')} of "
        f"{plural(len(played.people), 'virtual person')}; "
        f"{counters}. Replay it as replay://{args.out}, or import {Path(args.out) / RECORDED}. A simulation.",
    )
    return 0


def run_simulate(args: argparse.Namespace) -> int:
    from plushsense.workflow.api import simulate

    done = simulate(args.out, **options(args, "people", "repetitions", "seed", "dataset"), progress=report_stages())
    emit(
        args,
        asdict(done) | ({"dataset": args.dataset} if args.dataset else {}),
        f"{args.dataset or args.out}: {plural(done.recordings, 'recording')} of "
        f"{plural(args.people, 'virtual person')}. "
        "A simulation: scores on it say nothing about a real toy.",
    )
    return 0
