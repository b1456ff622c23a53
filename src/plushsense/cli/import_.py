"""Implement ``plushsense import SRC DEST [--layout NAME] [--add]``."""

from __future__ import annotations

import argparse

from plushsense.cli.options import options
from plushsense.cli.output import emit, plural, say
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

_MOST_WARNINGS = 20
_FEW = 5


def _columns(texts: list[str]) -> dict[str, str]:
    columns = dict(text.partition("=")[::2] for text in texts)
    for text in texts:
        if not all(text.partition("=")):
            raise ConfigError(f"--column {text}: write ROLE=NAME, for example  --column label=activity")
    return columns


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.importing.archives import UnpackLimits
    from plushsense.dataset.importing.importers import import_recordings

    done = import_recordings(
        args.source,
        args.dest,
        **options(args, "layout", "gestures", "subjects", "name", "licence", "consent", "people"),
        progress=ProgressReporter("reading"),
        add_to=args.add,
        adopt_proposals=args.adopt,
        columns=_columns(args.column),
        limits=UnpackLimits.of_gigabytes(args.max_gb),
    )
    result = done.to_dict()
    if not args.json:
        for line in result["warnings"][:_MOST_WARNINGS]:
            say(f"warning: {line}")
        if len(result["warnings"]) > _MOST_WARNINGS:
            say(f"... and {len(result['warnings']) - _MOST_WARNINGS} more warnings; all are in {args.dest}/*.csv")
        for proposal in done.proposals:
            say(f"suggestion: {proposal['reason']}: {proposal['advice']}")
        for status, entries in (("left out", done.left_out), ("rejected", done.rejected)):
            by_reason: dict[str, list[str]] = {}
            for entry in entries:
                by_reason.setdefault(entry["reason"], []).append(entry["file"])
            for reason, files in by_reason.items():
                several = f"{len(files)} files, for instance " if len(files) > _FEW else ""
                for file in files[: 1 if several else _FEW]:
                    say(f"{status}: {several}{file}: {reason}")
    new = f", {done.added['recordings']} of them new, {done.already_there} files already there" if args.add else ""
    emit(
        args,
        result,
        f"{args.dest}: {plural(done.recordings, 'recording')} of {done.subjects} people{new}, "
        f"{plural(len(done.gestures), 'gesture')}, {plural(done.streams, 'stream')}; "
        f"{plural(len(result['warnings']), 'warning')}, {plural(len(done.rejected), 'file')} rejected; "
        f"{done.seconds:.1f} s",
    )
    return 0
