"""``plushsense forget DATASET SUBJECT [--yes]``."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say

if TYPE_CHECKING:
    from plushsense.workflow.datasets import Forgotten

SHOWN = 10


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument("subject", metavar="SUBJECT", help="the person's code")
    parser.add_argument("--yes", action="store_true", help="do it: without, it is only said what would go (status 1)")
    parser.add_argument(
        "--bundles",
        action="append",
        default=[],
        metavar="DIR",
        help="also search this folder for models trained on the person (can be given again)",
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.datasets import forget

    found = forget(args.dataset, args.subject, bundles=args.bundles)
    sure = args.yes or (not args.json and sys.stdin.isatty() and _typed(found, args.subject))
    if sure:
        found = forget(args.dataset, args.subject, confirm=True, bundles=args.bundles)
    emit(args, found.to_dict(), _lines(found))
    if not sure:
        say(f"plushsense: nothing was removed; to do it:  plushsense forget {args.dataset} {args.subject} --yes")
    return 0 if sure else 1


def _typed(found: Forgotten, subject: str) -> bool:
    say("\n".join(_lines(found)))
    say(f"This cannot be undone. To go on, type the person's code ({subject}):")
    return sys.stdin.readline().strip() == subject


def _lines(found: Forgotten) -> list[str]:
    plan = found.plan
    verb = "removed" if found.done else "would go"
    out = [
        f"{verb}: {len(plan.files)} files of '{plan.subject}' ({plan.raw} raw), {plan.marks} marks, "
        f"{'their line in the people table, ' if plan.listed else ''}{len(plan.caches)} caches, "
        f"{len(plan.evaluations)} evaluations, {len(plan.leftovers)} unfinished leftovers"
    ]
    if plan.absent:
        out.insert(
            0,
            f"'{plan.subject}' is not in the data set (check the code: who was taken out before is not kept); only "
            "what may be derived from them goes:",
        )
    shown = [*plan.files[:SHOWN], *plan.caches, *plan.evaluations, *plan.leftovers]
    out += [f"  {path}" for path in shown]
    if len(plan.files) > SHOWN:
        out.append(f"  … and {len(plan.files) - SHOWN} more files")
    out += [f"still names them, look at it: {path}" for path in plan.mentions]
    out += [f"bundle: {b.bundle}: {b.message}" for b in found.bundles]
    if plan.published:
        out.append(f"published as https://doi.org/{plan.published}: make a new version without them")
    out.append(
        "Out of reach: backups, published copies, copies under pseudonyms and their key, evaluations and models kept "
        "elsewhere. What to do about them is in docs/privacy.md."
    )
    return out
