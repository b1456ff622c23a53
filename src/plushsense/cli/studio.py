"""``plushsense studio [--dataset DIR] [--device URL]``."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from plushsense.cli.output import say
from plushsense.core.errors import ConfigError

_HOME = "PlushSense"


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--home",
        metavar="DIR",
        help="the folder that holds what is made: recordings, data sets, bundles, exports (default: PlushSense in your "
        "home folder); pages see nothing outside it and what is named here",
    )
    parser.add_argument(
        "--dataset", metavar="DIR", action="append", default=[], help="a data set that lies elsewhere; several times"
    )
    parser.add_argument(
        "--model", metavar="BUNDLE", action="append", default=[], help="a bundle that lies elsewhere; several times"
    )
    parser.add_argument(
        "--device", metavar="URL", action="append", default=[], help="a toy to choose from; several times"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time of a virtual toy (1)")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where to listen (default: 127.0.0.1, this machine alone); elsewhere, such as 0.0.0.0 for a tablet, a "
        "one-time token is asked for",
    )
    parser.add_argument(
        "--name", metavar="NAME", action="append", default=[], help="a name under which browsers may call this machine"
    )
    parser.add_argument("--port", type=int, metavar="N", help="default: 8137 or the next free one; 0: any")
    parser.add_argument("--no-show", action="store_true", help="open no browser")


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.store import DatasetHead
    from plushsense.devices.opening import parse_url
    from plushsense.models.bundle import Bundle
    from plushsense.studio.app.serve import run as serve
    from plushsense.studio.app.workspace import Workspace

    if not 0.0 < args.speed <= 1000.0:
        raise ConfigError(f"--speed is {args.speed:g}; above 0 to 1000 is accepted.")
    if args.port is not None and not 0 <= args.port <= 65535:
        raise ConfigError(f"--port is {args.port}; 0 to 65535 is accepted.")
    for url in args.device:
        parse_url(url)
    for folder in args.dataset:
        DatasetHead.read(Path(folder))
    for model in args.model:
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
            say(f"The studio is at  {address}   Ctrl-C ends it. Everything stays in {workspace.folder}")

    serve(
        workspace,
        host=args.host,
        port=args.port,
        names=tuple(args.name),
        show=not args.no_show,
        on_ready=on_ready,
    )
    return 0
