"""``plushsense pseudonymise DATASET OUT --key KEYFILE``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit, say
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder; it is not touched")
    parser.add_argument("out", metavar="OUT", help="new or empty folder for the data set under pseudonyms")
    parser.add_argument(
        "--key",
        required=True,
        metavar="FILE",
        help="who got which code (CSV); kept outside of both data sets; one that is there is added to",
    )
    parser.add_argument(
        "--words", metavar="FILE", help="a text file with a word or name a line that may not be left anywhere"
    )
    parser.add_argument("--drop-notes", action="store_true", help="leave out notes and reasons in free words")


def run(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError
    from plushsense.dataset.privacy.pseudonymise import pseudonymise

    words: list[str] = []
    if args.words:
        try:
            words = Path(args.words).read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as cause:
            raise ConfigError(f"--words '{args.words}' cannot be read ({cause}): give a text file in UTF-8.") from None
    done = pseudonymise(
        args.dataset,
        args.out,
        key=args.key,
        words=words,
        drop_notes=args.drop_notes,
        progress=ProgressReporter("rewriting"),
    )
    result = done.to_dict()
    if not args.json:
        for finding in done.findings:
            where = f"{finding['file']}{':' + str(finding['line']) if finding['line'] else ''}: "
            say(f"finding: {where if finding['file'] else ''}{finding['message']}")
    emit(
        args,
        result,
        f"{args.out}: {result['recordings']} recordings of {result['subjects']} people under pseudonyms, "
        f"{result['files']} files; {len(done.findings)} findings to read.\n"
        f"The key is {args.key}: keep it apart from the data, and never publish it.",
    )
    return 0
