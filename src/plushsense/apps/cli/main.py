"""``plushsense VERB …``: finds the verb, runs it, and turns every refusal into one sentence.

A verb is a module with ``add(parser)`` and ``run(args) -> int``; only the one that was asked for is loaded.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from plushsense import __version__
from plushsense.apps.cli.output import Parser, say
from plushsense.core.errors import PlushSenseError, nearest

VERBS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the whole path on a virtual toy, in a few minutes"),
    "simulate": ("simulate", "recordings of virtual people, as the authors' recorder would leave them"),
    "import": ("importing", "make a data set from recordings"),
    "info": ("info", "what a data set or a model bundle holds"),
    "arch": ("arch", "count a network: parameters, receptive field, multiply-accumulates, state"),
    "train": ("train", "train one network and save it as a bundle"),
    "evaluate": ("evaluate", "how good it is, on people it never met"),
    "report": ("report", "one HTML page from evaluations and bundles"),
    "live": ("live", "read a toy and say what it feels, 20 times a second"),
    "toy": ("toy", "a virtual toy that speaks the wire format over a pty or TCP"),
}


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {what}" for name, (_, what) in VERBS.items()]
    return (
        "PlushSense: software that understands how people touch a soft toy.\n\n"
        "usage: plushsense VERB [options]      plushsense VERB --help\n\n"
        + "\n".join(lines)
        + "\n\nEvery verb takes --json: one JSON object on standard output and nothing else there.\n"
        "Exit status: 0 done, 1 the check said no, 2 bad input (one sentence).\n"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(_overview())
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"plushsense {__version__}\n")
        return 0
    verb, rest = words[0], words[1:]
    try:
        if verb not in VERBS:
            raise PlushSenseError(f"Unknown verb '{verb}': accepted are {', '.join(VERBS)}.{nearest(verb, VERBS)}")
        module, what = VERBS[verb]
        command = importlib.import_module(f"plushsense.apps.cli.{module}")
        parser = Parser(prog=f"plushsense {verb}", description=what[0].upper() + what[1:] + ".")
        command.add(parser)
        parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
        args: argparse.Namespace = parser.parse_args(rest)
        return int(command.run(args))
    except PlushSenseError as refusal:
        say(f"plushsense: {refusal}")
        return 2
    except KeyboardInterrupt:
        say("plushsense: stopped; what was finished is kept.")
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`| head`): not our failure.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
