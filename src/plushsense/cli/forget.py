"""Implement ``plushsense forget DATASET SUBJECT [--everywhere] [--dry-run] [--yes]``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say
from plushsense.core.errors import BadInput
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plushsense.workflow.forgetting import Forgotten, HomeTraces, PersonTrace

_MOST_FILES = 10
_TRACES = {
    "dataset": "their part of the data set",
    "sessions": "their sessions",
    "network": "network that has read them",
    "backup": "backup, with everybody in it:",
    "key": "their line in the key",
    "notes": "notes in",
}


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.forgetting import forget

    if args.everywhere:
        return _forget_everywhere(args)
    result = forget(args.dataset, args.subject, bundles=args.bundles)
    confirmed = _confirmed(args, _removal_lines(result))
    if confirmed:
        result = forget(args.dataset, args.subject, confirm=True, bundles=args.bundles)
    emit(args, result.to_dict(), _removal_lines(result))
    return _status(args, confirmed)


def _forget_everywhere(args: argparse.Namespace) -> int:
    from plushsense.workflow.forgetting import find_traces, forget_everywhere

    if args.bundles:
        raise BadInput("--everywhere looks through the whole folder of the studio: leave out --bundles.")
    home = Path(args.dataset)
    if not home.is_dir():
        raise BadInput(f"There is no folder '{home}': give the folder of a studio, as for  plushsense studio --home.")
    found = find_traces(home, args.subject)
    confirmed = _confirmed(args, _trace_lines(found))
    if not confirmed:
        emit(args, {"done": False, **found.to_json()}, _trace_lines(found))
        return _status(args, confirmed)
    receipt = forget_everywhere(home, args.subject, [trace.id for trace in found.traces if trace.certain])
    lines = [f"removed: {_named(trace)}" for trace in receipt.removed]
    lines += [f"not removed, as it may be of somebody else: {_named(trace)}" for trace in receipt.kept]
    lines += [f"NOT removed: {_named(trace)}: {why}" for trace, why in receipt.failed]
    emit(args, {"done": True, **receipt.to_json()}, [*lines, *_rest_lines(receipt.found)])
    return 1 if receipt.failed else 0


def _confirmed(args: argparse.Namespace, lines: Sequence[str]) -> bool:
    """Return whether to remove what ``lines`` list; on a terminal, ask."""
    if args.dry_run or args.yes or args.json or not sys.stdin.isatty():
        return bool(args.yes and not args.dry_run)
    return _confirm(lines, args.subject)


def _status(args: argparse.Namespace, confirmed: bool) -> int:
    if confirmed or args.dry_run:
        return 0
    how = " --everywhere" if args.everywhere else ""
    say(f"plushsense: nothing was removed; to do it:  plushsense forget {args.dataset} {args.subject}{how} --yes")
    return 1


def _confirm(lines: Sequence[str], subject: str) -> bool:
    say("\n".join(lines))
    say(f"This cannot be undone. To continue, type the person's code ({subject}):")
    return sys.stdin.readline().strip() == subject


def _trace_lines(found: HomeTraces) -> list[str]:
    lines = [
        f"{'to remove' if trace.certain else 'perhaps, stays'}: {_named(trace)}"
        + (f" ({plural(trace.count, 'file')})" if trace.count > 1 else "")
        for trace in found.traces
    ]
    return [*(lines or [f"'{found.person}' is not known there: check the code."]), *_rest_lines(found)]


def _named(trace: PersonTrace) -> str:
    return f"{_TRACES.get(trace.kind, trace.kind)} {trace.path}"


def _rest_lines(found: HomeTraces) -> list[str]:
    codes = [f"in packages the person is {', '.join(found.pseudonyms)}"] if found.pseudonyms else []
    return [
        *(f"contains the code or cannot be read, check it: {path}" for path in found.mentions),
        *codes,
        *(f"published as https://doi.org/{doi}: publish a new version without them" for doi in found.published),
        "Out of reach: copies elsewhere. docs/privacy.md describes what to do about them.",
    ]


def _removal_lines(result: Forgotten) -> list[str]:
    plan = result.plan
    lines = []
    if plan.absent:
        lines.append(
            f"'{plan.subject}' is not in the data set (check the code; codes of removed people are not kept); only "
            "files that may be derived from the person are listed:"
        )
    lines.append(
        f"{'removed' if result.done else 'to remove'}: {plural(len(plan.files), 'file')} of '{plan.subject}' "
        f"({plan.raw} raw), {plural(plan.marks, 'mark')}, "
        f"{'their line in the people table, ' if plan.listed else ''}{plural(len(plan.caches), 'cache')}, "
        f"{plural(len(plan.evaluations), 'evaluation')}, {plural(len(plan.leftovers), 'unfinished leftover')}"
    )
    paths = [*plan.files[:_MOST_FILES], *plan.caches, *plan.evaluations, *plan.leftovers]
    lines += [f"  {path}" for path in paths]
    if len(plan.files) > _MOST_FILES:
        lines.append(f"  … and {len(plan.files) - _MOST_FILES} more files")
    lines += [f"contains the code or cannot be read, check it: {path}" for path in plan.mentions]
    lines += [f"a running program uses it, and removes it when it ends: {path}" for path in plan.running]
    lines += [f"bundle: {b.bundle}: {b.message}" for b in result.bundles]
    lines += [f"discarded recordings of this code, delete them: {path}" for path in result.discarded]
    lines += [f"contains the code or cannot be read, check it: {path}" for path in result.elsewhere]
    if plan.published:
        lines.append(f"published as https://doi.org/{plan.published}: publish a new version without them")
    lines.append(
        "Out of reach: backups, published copies, copies under pseudonyms and their key, evaluations and models kept "
        "elsewhere. docs/privacy.md describes what to do about them."
    )
    return lines
