"""``plushsense backup DATASET FILE.zip`` and ``plushsense backup --check FILE.zip``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", nargs="?", help="data set folder")
    parser.add_argument("file", metavar="FILE", nargs="?", help="the new zip file")
    parser.add_argument("--check", metavar="FILE", help="read a backup through and say whether it is whole")


def run(args: argparse.Namespace) -> int:
    from plushsense.core.errors import ConfigError, DatasetError
    from plushsense.dataset.backup import backup, check_backup

    if args.check:
        if args.dataset or args.file:
            raise ConfigError("--check reads one backup and writes nothing: give  plushsense backup --check FILE.zip")
        try:
            whole = check_backup(args.check, progress=ProgressReporter("reading"))
        except DatasetError as refusal:
            say(f"plushsense: {refusal}")
            emit(args, {"file": args.check, "valid": False, "problem": str(refusal)}, f"{args.check}: not whole")
            return 1
        emit(args, {**whole.to_dict(), "valid": True}, f"{args.check}: whole, {_counts(whole.to_dict())}")
        return 0
    if not args.file:
        raise ConfigError("Give the data set and the new file:  plushsense backup DATASET FILE.zip")
    done = backup(args.dataset, args.file, progress=ProgressReporter("saving")).to_dict()
    for name in done["left_out"]:
        say(f"left out: {name} is a link, which is not followed")
    emit(args, done, f"{args.file}: {_counts(done)}; written and read back")
    return 0


def _counts(found: dict[str, object]) -> str:
    return f"{found['recordings']} recordings of {found['subjects']} people, {found['files']} files"
