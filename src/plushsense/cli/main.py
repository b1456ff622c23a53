"""Run ``plushsense VERB ...``: import the verb's module, parse its options, and report errors in one sentence.

A verb consists of a function in a module of this package, usually ``run(args) -> int``, and a table in ``verbs.toml``.
Only the module of the given verb is imported.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Callable, Sequence

from plushsense.cli.options import VERBS, add_options
from plushsense.cli.output import Parser, say, utf8
from plushsense.core.errors import BadInput, PlushSenseError, check_known, printable
from plushsense.core.version import __version__
from plushsense.jobs.progress import close_active


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {verb['summary']}" for name, verb in VERBS.items()]
    return (
        "PlushSense: touch gesture recognition for soft toys.\n\n"
        "usage: plushsense VERB [options]      plushsense VERB --help\n\n"
        + "\n".join(lines)
        + "\n\nEvery verb accepts --json: print one JSON object on standard output and nothing else there.\n"
        "Exit status: 0 success, 1 a check failed, 2 invalid input.\n"
    )


def load_verb(verb: str) -> Callable[[argparse.Namespace], int]:
    """Import and return the function that runs a verb.

    Raises:
        PlushSenseError: for an unknown verb.
    """
    check_known(verb, VERBS, "verb", BadInput)
    module_name, colon, name = VERBS[verb].get("module", verb).partition(":")
    module = importlib.import_module(f"plushsense.cli.{module_name}")
    run: Callable[[argparse.Namespace], int] = getattr(module, f"run_{name}" if colon else "run")
    return run


def parser_of(verb: str) -> Parser:
    """Return the parser of a verb's options: those in ``verbs.toml``, and ``--json``."""
    summary = VERBS[verb]["summary"]
    parser = Parser(prog=f"plushsense {verb}", description=summary[0].upper() + summary[1:] + ".")
    add_options(parser, verb)
    json_help = "print one JSON object on standard output and nothing else there (default: text)"
    if verb == "live":
        json_help = "no effect: decisions are always JSON, one object a line"
    parser.add_argument("--json", action="store_true", help=json_help)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    utf8()
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(_overview())
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"plushsense {__version__}\n")
        return 0
    verb = words[0]
    try:
        run = load_verb(verb)
        return int(run(parser_of(verb).parse_args(words[1:])))
    except PlushSenseError as error:
        say("\n".join([f"plushsense: {error}", *getattr(error, "__notes__", ())]))
        return 2
    except KeyboardInterrupt:
        say(f"plushsense: stopped; {left}." if (left := VERBS[verb].get("stopped")) else "plushsense: stopped.")
        return 130
    except OSError as error:
        if _output_closed(error):
            # The program that reads standard output has ended (as in `| head`), which is not an error.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        say(f"plushsense: {printable(_sentence(error))}")
        return 2
    except RuntimeError as error:
        # Path.resolve, before Python 3.13.
        if "Symlink loop" not in str(error):
            raise
        say(f"plushsense: A path is a link that leads back to itself: {printable(str(error))}; give another path.")
        return 2
    finally:
        close_active()


def _output_closed(error: OSError) -> bool:
    """Return whether standard output was closed by its reader, which Windows reports as an invalid argument."""
    if isinstance(error, BrokenPipeError):
        return True
    return sys.platform == "win32" and error.errno == errno.EINVAL and error.filename is None


def _sentence(error: OSError) -> str:
    """Format an error of the operating system as a sentence that includes the paths concerned."""
    paths = " and ".join(f"'{os.fsdecode(p)}'" for p in (error.filename, error.filename2) if isinstance(p, str | bytes))
    why = error.strerror or str(error) or type(error).__name__
    if not paths:
        return f"The system refused: {why}."
    return f"{paths} cannot be used: {why[0].lower()}{why[1:]}; check the path and whether you may write there."
