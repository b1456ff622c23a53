"""Implement ``plushsense import SRC DEST [--layout NAME] [--pattern FILE] [--add]``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table
from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import plural
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.dataset.importing.results import ImportPreview, ImportResult

_MOST_WARNINGS = 20
_FEW = 5
_MOST_CHANNELS = 8


def _columns(texts: list[str]) -> dict[str, str]:
    columns = dict(text.partition("=")[::2] for text in texts)
    for text in texts:
        if not all(text.partition("=")):
            raise ConfigError(f"--column {text}: write ROLE=NAME, for example  --column label=activity")
    return columns


def _report(result: ImportResult | ImportPreview, names: str) -> None:
    """Print warnings, and what was left out or rejected, on standard error; ``names`` says where all warnings are."""
    from plushsense.dataset.importing.importers import ADOPTED

    for line in result.messages[:_MOST_WARNINGS]:
        say(line if getattr(line, "template", "") == ADOPTED else f"warning: {line}")
    if len(result.messages) > _MOST_WARNINGS:
        say(f"... and {len(result.messages) - _MOST_WARNINGS} more warnings{names}")
    for sensor in result.sensors:
        say(f"accelerometer {', '.join(sensor.axes)}: {sensor.summary}")
    for proposal in (p for p in result.proposals if not p.adopted):
        say(f"suggestion: {proposal.reason}: {proposal.advice}")
    for status, entries in (("left out", result.left_out), ("rejected", result.rejected)):
        by_reason: dict[str, list[str]] = {}
        for entry in entries:
            by_reason.setdefault(entry.reason, []).append(entry.file)
        for reason, files in by_reason.items():
            several = f"{len(files)} files, for instance " if len(files) > _FEW else ""
            for file in files[: 1 if several else _FEW]:
                say(f"{status}: {several}{file}: {reason}")


def _guess(args: argparse.Namespace) -> int:
    from plushsense.dataset.importing.guessing import guess_pattern

    guessed = guess_pattern(args.source)
    guessed.write(args.guess)
    text = [f"wrote {args.guess}; to check: {len(guessed.doubts)}", *(f"  {doubt}" for doubt in guessed.doubts)]
    text.append(f"next: plushsense import {args.source} --pattern {args.guess} --dry-run")
    emit(args, {"pattern": args.guess, "doubts": guessed.doubts}, text)
    return 0


def _dry_run(args: argparse.Namespace, given: dict[str, Any]) -> int:
    from plushsense.dataset.importing.importers import preview_import

    found = preview_import(args.source, **given)
    if not args.json:
        _report(found, "")
    channels = list(found.rows[0].values) if found.rows else []
    few = channels[:_MOST_CHANNELS]
    more = [f"and {len(channels) - len(few)} more channels"] if len(channels) > len(few) else []
    rows = [
        [row.subject, row.session, row.gesture, row.time_ms]
        + ["invalid" if (value := row.values[c]) is None else format(value, "g") for c in few]
        for row in found.rows
    ]
    people = set(found.subjects) - {NOBODY, UNKNOWN_SUBJECT}
    gestures = ", ".join(f"{label} ({n})" for label, n in found.gestures.items())
    emit(
        args,
        found.to_json(),
        [
            table(["person", "session", "gesture", "time in ms", *few], rows),
            *more,
            f"{plural(found.recordings, 'recording')} of {plural(len(people), 'person')}, "
            f"{plural(found.streams, 'stream')}, layout {found.layout}; nothing was written",
            *([f"gestures: {gestures}"] if gestures else []),
        ],
    )
    return 0


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.importing.archives import UnpackLimits
    from plushsense.dataset.importing.importers import import_recordings

    if args.guess:
        return _guess(args)
    given = {
        **options(args, "layout", "gestures", "subjects", "pattern", "streams"),
        "columns": _columns(args.column),
        "limits": UnpackLimits.of_gigabytes(args.max_gb),
    }
    if args.dry_run:
        return _dry_run(args, given)
    if args.dest is None:
        raise ConfigError(f"import {args.source} needs DEST, the folder of the new data set, or --dry-run or --guess.")
    done = import_recordings(
        args.source,
        args.dest,
        **given,
        **options(args, "name", "licence", "consent", "people"),
        progress=ProgressReporter("reading"),
        add_to=args.add,
        adopt_proposals=args.adopt,
        readmit=args.readmit,
    )
    if not args.json:
        _report(done, f"; all are in {args.dest}/*.csv")
    new = f", {done.added_recordings} of them new, {done.already_there} files already there" if args.add else ""
    emit(
        args,
        done.to_json(),
        f"{args.dest}: {plural(done.recordings, 'recording')} of {plural(done.subjects, 'person')}{new}, "
        f"{plural(len(done.gestures), 'gesture')}, {plural(done.streams, 'stream')}; "
        f"{plural(len(done.messages), 'warning')}, {plural(len(done.rejected), 'file')} rejected; "
        f"{done.seconds:.1f} s",
    )
    return 0
