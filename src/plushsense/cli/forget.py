"""Implement ``plushsense forget DATASET SUBJECT [--yes]``."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.workflow.forgetting import Forgotten

_MOST_FILES = 10


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.forgetting import forget

    result = forget(args.dataset, args.subject, bundles=args.bundles)
    confirmed = args.yes or (not args.json and sys.stdin.isatty() and _confirm(result, args.subject))
    if confirmed:
        result = forget(args.dataset, args.subject, confirm=True, bundles=args.bundles)
    emit(args, result.to_dict(), _removal_lines(result))
    if not confirmed:
        say(f"plushsense: nothing was removed; to do it:  plushsense forget {args.dataset} {args.subject} --yes")
    return 0 if confirmed else 1


def _confirm(result: Forgotten, subject: str) -> bool:
    say("\n".join(_removal_lines(result)))
    say(f"This cannot be undone. To continue, type the person's code ({subject}):")
    return sys.stdin.readline().strip() == subject


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
