"""``plushsense VERB …``: finds the verb, runs it, and turns every refusal into one sentence.

A verb is a module with ``add(parser)`` and ``run(args) -> int``; only the one that was asked for is loaded.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Sequence

from plushsense.cli.output import Parser, say, utf8
from plushsense.core.errors import PlushSenseError, nearest
from plushsense.core.version import __version__
from plushsense.jobs.progress import close_active

VERBS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the whole path on a virtual toy, in a few minutes"),
    "devices": ("devices", "what toys are there, and the URL that opens each"),
    "record": ("record", "record a session with a toy: prompts, countdown, nothing lost"),
    "import": ("import_", "make a data set from recordings"),
    "check": ("check", "what may be wrong in a data set, what to do about it, and decisions as marks"),
    "trim": ("trim", "where each gesture begins: suggested, then accepted, adjusted or undone"),
    "stats": ("stats", "how long gestures last, before and after trimming"),
    "info": ("info", "what a data set or a model bundle holds"),
    "publish": ("publish", "a package that strangers can find, open and cite, proved by validators"),
    "pseudonymise": ("pseudonymise", "a copy of a data set with random codes and moved dates"),
    "backup": ("backup", "one file that restores a data set, with a check"),
    "restore": ("restore", "bring a data set back from a backup"),
    "forget": ("forget", "take a person out of a data set, for good"),
    "arch": ("arch", "count a network: parameters, receptive field, multiply-accumulates, state"),
    "train": ("train", "train one network and save it as a bundle"),
    "evaluate": ("evaluate", "how good it is, on people it never met"),
    "abstain": ("abstain", "whether it knows when it does not know, on people it never met"),
    "stream-eval": ("stream_eval", "whole streams against what really happened: events, false events, how soon"),
    "baselines": ("baselines", "classical programs, LSTMs and our network side by side, and what a leaky split hides"),
    "sweep": ("sweep", "train and compare every network of a grid, and go on after whatever stopped it"),
    "search": ("search", "the best network within limits of size, for a share of what a whole sweep costs"),
    "report": ("report", "one HTML page from evaluations and bundles, or of a sweep"),
    "export": ("export", "C for the toy that gives the same answers, bit for bit"),
    "verify": ("verify", "prove that the C of an export gives the same answers, here and on emulated chips"),
    "profile": ("profile", "what an export costs on a chip: instructions, bytes, stack, and an estimate of the time"),
    "live": ("live", "read a toy and say what it feels, 20 times a second"),
    "adapt": ("adapt", "adapt a bundle to one person from a minute of their gestures, where that helps; undo"),
    "protocol": ("protocol", "the paper's real-time protocol: who answers which touch, and how soon"),
    "studio": ("studio", "the whole work in a browser, on this machine alone"),
    "toy": ("toy", "a virtual toy that speaks the wire format over a pty or TCP"),
    "simulate": ("simulate", "recordings of virtual people, as the authors' recorder would leave them"),
}

# What a stopped verb has left; the others leave nothing that would need a word.
STOPPED = {
    "demo": "what was finished is kept, and the same command goes on from there",
    "evaluate": "finished folds are kept, and the same command goes on from there",
    "abstain": "finished trainings are kept, and the same command goes on from there",
    "stream-eval": "finished folds are kept, and the same command goes on from there",
    "sweep": "finished trainings are kept, and the same command goes on from there",
    "search": "finished trainings are kept, and the same command goes on from there",
    "baselines": "finished folds are kept, and the same command goes on from there",
    "simulate": "nothing was written",
    "import": "nothing was written, or with --add nothing by halves: the same command goes on",
    "record": "what was recorded is kept, and the same command goes on from there",
    "pseudonymise": "nothing was written",
    "backup": "no backup was written",
    "restore": "nothing was written",
    "forget": "the same command finishes what was begun",
    "studio": "everything is kept, and the same command goes on from there",
    "publish": "there is no zip; a folder that was written whole can be proved with  plushsense publish --check OUT",
    "train": "no bundle was written",
    "adapt": "no bundle was written; of --evaluate, trained networks are kept",
    "report": "no page was written",
    "protocol": "nothing was written",
    "export": "nothing was written",
    "verify": "nothing was changed",
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
    utf8()
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
        command = importlib.import_module(f"plushsense.cli.{module}")
        parser = Parser(prog=f"plushsense {verb}", description=what[0].upper() + what[1:] + ".")
        command.add(parser)
        if verb == "live":
            said = "changes nothing: decisions are JSON always, one object a line"
        else:
            said = "one JSON object on standard output, and nothing else there (default: text)"
        parser.add_argument("--json", action="store_true", help=said)
        args: argparse.Namespace = parser.parse_args(rest)
        return int(command.run(args))
    except PlushSenseError as refusal:
        say(f"plushsense: {refusal}")
        return 2
    except KeyboardInterrupt:
        say(f"plushsense: stopped; {STOPPED[verb]}." if verb in STOPPED else "plushsense: stopped.")
        return 130
    except OSError as cause:
        if _reader_gone(cause):
            # The reader of our output went away (`| head`): not our failure.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        say(f"plushsense: {_in_words(cause)}")
        return 2
    finally:
        close_active()


def _reader_gone(cause: OSError) -> bool:
    """Return whether standard output has no reader any more, which Windows reports as an invalid argument."""
    if isinstance(cause, BrokenPipeError):
        return True
    return sys.platform == "win32" and cause.errno == errno.EINVAL and cause.filename is None


def _in_words(cause: OSError) -> str:
    """Format a refusal of the operating system as a sentence with the path."""
    paths = " and ".join(f"'{os.fsdecode(p)}'" for p in (cause.filename, cause.filename2) if isinstance(p, str | bytes))
    why = cause.strerror or str(cause) or type(cause).__name__
    if not paths:
        return f"The system refused: {why}."
    return f"{paths} cannot be used: {why[0].lower()}{why[1:]}; check the path and whether you may write there."


if __name__ == "__main__":
    sys.exit(main())
