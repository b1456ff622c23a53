"""Implement ``plushsense backup DATASET FILE.zip``, ``backup --check FILE.zip``, ``backup --restore FILE.zip DEST``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from plushsense.cli.output import emit, say
from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.backup import backup

    if args.check:
        return _check(args)
    if args.restore:
        return _restore(args)
    if not args.file:
        raise ConfigError("Give the data set and the new file:  plushsense backup DATASET FILE.zip")
    done = asdict(backup(args.dataset, args.file, progress=ProgressReporter("saving")))
    for name in done["left_out"]:
        say(f"left out: {name} is a link, which is not followed")
    emit(args, done, f"{args.file}: {_counts(done)}; written and read back")
    return 0


def _check(args: argparse.Namespace) -> int:
    from plushsense.dataset.backup import check_backup

    if args.dataset or args.file:
        raise ConfigError("--check reads one backup and writes nothing: give  plushsense backup --check FILE.zip")
    try:
        found = asdict(check_backup(args.check, progress=ProgressReporter("reading")))
    except DatasetError as error:
        say(f"plushsense: {error}")
        emit(args, {"file": args.check, "valid": False, "problem": str(error)}, f"{args.check}: not valid")
        return 1
    emit(args, {**found, "valid": True}, f"{args.check}: valid, {_counts(found)}")
    return 0


def _restore(args: argparse.Namespace) -> int:
    from plushsense.dataset.backup import restore
    from plushsense.dataset.importing.archives import UnpackLimits

    if not args.dataset or args.file:
        raise ConfigError("Give the backup and one new folder:  plushsense backup --restore FILE.zip DATASET")
    limits = UnpackLimits.of_gigabytes(args.max_gb)
    dataset = restore(
        args.restore, args.dataset, progress=ProgressReporter("restoring"), limits=limits, readmit=args.readmit
    )
    counts = {"recordings": len(dataset.recordings), "subjects": len(dataset.subjects)}
    result = {"dataset": args.dataset, **counts, "streams": len(dataset.streams), "hash": dataset.hash}
    people = plural(counts["subjects"], "person")
    emit(args, result, f"{args.dataset}: restored {plural(counts['recordings'], 'recording')} of {people}")
    return 0


def _counts(table: dict[str, Any]) -> str:
    return (
        f"{plural(table['recordings'], 'recording')} of {plural(table['subjects'], 'person')}, "
        f"{plural(table['files'], 'file')}"
    )
