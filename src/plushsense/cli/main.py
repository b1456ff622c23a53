"""Run ``plushsense VERB ...``: load the verb's module, parse its options, and report errors as one sentence.

A verb is a function ``run(args) -> int`` in a module of this package, and a table of its options in ``options.toml``.
In `VERBS`, ``module:name`` means the function ``run_name``. Only the module of the given verb is imported.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Callable, Sequence

from plushsense.cli.options import add_options
from plushsense.cli.output import Parser, say, utf8
from plushsense.core.errors import BadInput, PlushSenseError, check_known
from plushsense.core.version import __version__
from plushsense.jobs.progress import close_active

VERBS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "run the whole pipeline on a virtual toy, in a few minutes"),
    "devices": ("devices", "list the toys that can be reached, and the URL that opens each"),
    "record": ("record", "record a session with a toy, guided by prompts"),
    "import": ("import_", "create a data set from recordings"),
    "check": ("check", "check the quality of a data set, and mark decisions about findings"),
    "trim": ("trim", "suggest where each gesture begins, and accept, adjust or undo trims"),
    "stats": ("info:stats", "show how long gestures last, before and after trimming"),
    "info": ("info", "show what a data set or a model bundle contains"),
    "publish": ("publish", "write a data set as a package with standard metadata, and validate it"),
    "pseudonymise": ("privacy:pseudonymise", "copy a data set with random codes and shifted dates"),
    "backup": ("backup", "save a data set as one checked file, or check such a file"),
    "restore": ("backup:restore", "restore a data set from a backup"),
    "forget": ("privacy:forget", "remove a person from a data set permanently"),
    "arch": ("info:arch", "count a network's parameters, receptive field, multiply-accumulates and state"),
    "train": ("train", "train one network and save it as a bundle"),
    "evaluate": ("evaluate", "cross-validate a network on people left out of the training"),
    "abstain": ("abstain", "measure how well the confidence predicts errors, on people left out"),
    "stream-eval": ("stream_eval", "score the events in whole streams: hits, false events, latency"),
    "baselines": ("baselines", "compare classical models, LSTMs and our network on the same splits"),
    "sweep": ("sweep", "train and compare every network of a grid"),
    "search": ("search", "find the best network within limits of size, at a share of the cost of a sweep"),
    "report": ("report", "write an HTML page of evaluations and bundles, or of a sweep"),
    "export": ("export", "write C for the toy that gives the same answers, bit for bit"),
    "verify": ("export:verify", "prove that the C of an export gives the same answers, here and on emulated chips"),
    "profile": ("export:profile", "measure what an export costs on a chip: instructions, bytes, stack, estimated time"),
    "live": ("live", "classify the touches of a toy live, 20 times a second"),
    "adapt": ("adapt", "adapt a bundle to one person, or undo it"),
    "protocol": ("protocol", "run the paper's real-time protocol: which system answers which touch, and how soon"),
    "studio": ("studio", "open the web application, by default for this machine only"),
    "toy": ("devices:toy", "serve a virtual toy on a pseudo terminal, a TCP port or an LSL stream"),
    "simulate": ("devices:simulate", "write recordings of virtual people, as the authors' recorder writes them"),
}

_RESUMES = "finished work is kept; give the same command again to resume"
# What an interrupted verb leaves behind; verbs that write nothing are not listed.
INTERRUPTED = {
    **dict.fromkeys(("demo", "evaluate", "abstain", "stream-eval", "sweep", "search", "baselines"), _RESUMES),
    **dict.fromkeys(("simulate", "pseudonymise", "restore", "protocol", "export"), "nothing was written"),
    "import": "nothing was written; with --add no file is half written: give the same command again to resume",
    "record": "what was recorded is kept; give the same command again to resume",
    "backup": "no backup was written",
    "forget": "give the same command again to finish the removal",
    "studio": "everything is kept; give the same command again to resume",
    "publish": "there is no zip file; check a complete folder with  plushsense publish --check OUT",
    "train": "no bundle was written; give the same command again to resume the training",
    "adapt": "no bundle was written; networks that --evaluate trained are kept",
    "report": "no page was written",
    "verify": "nothing was changed",
}


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {summary}" for name, (_, summary) in VERBS.items()]
    return (
        "PlushSense: touch gesture recognition for soft toys.\n\n"
        "usage: plushsense VERB [options]      plushsense VERB --help\n\n"
        + "\n".join(lines)
        + "\n\nEvery verb accepts --json: print one JSON object on standard output and nothing else there.\n"
        "Exit status: 0 success, 1 a check failed, 2 invalid input.\n"
    )


def load_verb(verb: str) -> Callable[[argparse.Namespace], int]:
    """Import the function ``run`` of a verb.

    Raises:
        PlushSenseError: for an unknown verb.
    """
    check_known(verb, VERBS, "verb", BadInput)
    module_name, colon, name = VERBS[verb][0].partition(":")
    module = importlib.import_module(f"plushsense.cli.{module_name}")
    run: Callable[[argparse.Namespace], int] = getattr(module, f"run_{name}" if colon else "run")
    return run


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
        summary = VERBS[verb][1]
        parser = Parser(prog=f"plushsense {verb}", description=summary[0].upper() + summary[1:] + ".")
        add_options(parser, verb)
        json_help = "print one JSON object on standard output and nothing else there (default: text)"
        if verb == "live":
            json_help = "no effect: decisions are always JSON, one object a line"
        parser.add_argument("--json", action="store_true", help=json_help)
        return int(run(parser.parse_args(words[1:])))
    except PlushSenseError as error:
        say(f"plushsense: {error}")
        return 2
    except KeyboardInterrupt:
        say(f"plushsense: stopped; {INTERRUPTED[verb]}." if verb in INTERRUPTED else "plushsense: stopped.")
        return 130
    except OSError as error:
        if _output_closed(error):
            # The reader of standard output has ended (`| head`): not a failure of ours.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        say(f"plushsense: {_sentence(error)}")
        return 2
    finally:
        close_active()


def _output_closed(error: OSError) -> bool:
    """Return whether standard output has no reader any more, which Windows reports as an invalid argument."""
    if isinstance(error, BrokenPipeError):
        return True
    return sys.platform == "win32" and error.errno == errno.EINVAL and error.filename is None


def _sentence(error: OSError) -> str:
    """Format an error of the operating system as a sentence with the path."""
    paths = " and ".join(f"'{os.fsdecode(p)}'" for p in (error.filename, error.filename2) if isinstance(p, str | bytes))
    why = error.strerror or str(error) or type(error).__name__
    if not paths:
        return f"The system refused: {why}."
    return f"{paths} cannot be used: {why[0].lower()}{why[1:]}; check the path and whether you may write there."


if __name__ == "__main__":
    sys.exit(main())
