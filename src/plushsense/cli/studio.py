"""Implement ``plushsense studio [--dataset DIR] [--device URL]``."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from plushsense.cli.output import say
from plushsense.cli.signals import interrupt_on_signals
from plushsense.core.errors import ConfigError

_HOME = "PlushSense"


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.store import DatasetHead
    from plushsense.devices.opening import parse_url
    from plushsense.studio.app.serve import run as serve
    from plushsense.studio.app.workspace import Workspace

    if not 0.0 < args.speed <= 1000.0:
        raise ConfigError(f"--speed is {args.speed:g}; give a number above 0 and up to 1000.")
    if args.port is not None and not 0 <= args.port <= 65535:
        raise ConfigError(f"--port is {args.port}; give 0 to 65535.")
    for url in args.device:
        parse_url(url)
    for folder in args.dataset:
        DatasetHead.read(Path(folder))
    for model in args.model:
        from plushsense.models.bundle import Bundle

        Bundle.load(model)
    folder = Path(args.home) if args.home else Path.home() / _HOME
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"'{folder}' is a file: give a folder with --home.")
    workspace = Workspace(
        folder,
        given=tuple(map(Path, args.dataset)),
        devices=tuple(args.device),
        models=tuple(map(Path, args.model)),
        speed=args.speed,
    )

    def on_ready(address: str) -> None:
        if args.json:
            sys.stdout.write(json.dumps({"url": address, "home": str(workspace.folder)}) + "\n")
            sys.stdout.flush()
        else:
            say(f"The studio is at  {address}   Ctrl-C ends it. All files are in {workspace.folder}")

    names = tuple(args.name)
    with interrupt_on_signals():
        serve(workspace, host=args.host, port=args.port, names=names, show=not args.no_show, on_ready=on_ready)
    return 0
