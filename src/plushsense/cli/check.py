"""``plushsense check DATASET [--only CHECK,…] [--report FILE.html] [--accept CHECK:RECORDING --why "…"]``."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.dataset.quality.checking import CheckReport
    from plushsense.dataset.quality.findings import Finding

LINES = 8
DECISIONS = 20


def add(parser: argparse.ArgumentParser) -> None:
    from plushsense.dataset.quality.registry import CHECKS

    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--only", metavar="CHECK,…", default="", help=f"only these checks (default: all). They are {', '.join(CHECKS)}"
    )
    parser.add_argument("--report", metavar="FILE.html", help="write a page with plots of everything that was found")
    parser.add_argument(
        "--limit",
        metavar="NAME=NUMBER",
        action="append",
        default=[],
        help="change a limit, e.g. duration=0.5; may be given again (see docs/checks.md)",
    )
    parser.add_argument(
        "--accept",
        metavar="CHECK:RECORDING",
        action="append",
        default=[],
        help="mark what a check found as known and no fault; patterns such as 'gaps:P26/*'; may be given again",
    )
    parser.add_argument(
        "--unaccept", metavar="CHECK:RECORDING", action="append", default=[], help="take an acceptance back"
    )
    parser.add_argument(
        "--exclude",
        metavar="RECORDING",
        action="append",
        default=[],
        help="mark recordings as not to be used; patterns such as 'P19/*'; the files stay",
    )
    parser.add_argument("--include", metavar="RECORDING", action="append", default=[], help="use them again")
    parser.add_argument("--why", metavar="TEXT", default="", help="the reason, kept with the mark")
    parser.add_argument("--who", metavar="NAME", help="who decides (default: the login name)")


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.quality.checking import known_checks
    from plushsense.workflow.datasets import decide

    only = listed(args.only)
    known_checks(only)
    if args.report:
        from plushsense.reports.page import check_page_path

        check_page_path(args.report)
    result, marked = decide(
        args.dataset,
        accept=args.accept,
        unaccept=args.unaccept,
        exclude=args.exclude,
        include=args.include,
        why=args.why,
        who=args.who,
        only=only,
        limits=_limits(args.limit),
        progress=ProgressReporter("checking"),
    )
    if args.accept or args.unaccept or args.exclude or args.include:
        say(f"{marked} mark{'s' if marked != 1 else ''} added" + ("" if marked else ": so it was already") + ".")
    page = result.report(args.report, ProgressReporter("drawing")) if args.report else None
    emit(
        args,
        {**result.to_dict(), "marked": marked, "report": str(page) if page else None},
        [*overview(result), *([f"\nPlots: {page}"] if page else [])],
    )
    return 0 if result.ok else 1


def _limits(given: Sequence[str]) -> dict[str, float]:
    limits = {}
    for said in given:
        name, _, number = said.partition("=")
        try:
            limits[name.strip()] = float(number)
        except ValueError:
            raise ConfigError(f"--limit {said}: give a name and a number, e.g. duration=0.5.") from None
    return limits


def overview(result: CheckReport) -> Iterator[str]:
    """Format the findings as text: what needs a decision, then errors by check and person, then notes."""
    from plushsense.dataset.quality.registry import CHECKS

    people = len(result.dataset.subjects)
    excluded = f", {result.excluded} excluded" if result.excluded else ""
    yield (
        f"{result.dataset.path}: {result.recordings} recordings of {people} people looked at{excluded}; "
        f"{result.seconds:.1f} s"
    )
    if result.dataset.head.simulated:
        yield "These recordings are of the virtual toy."
    accepted = [f for f in result.findings if f.accepted]
    if accepted:
        yield f"{len(accepted)} finding{'s were' if len(accepted) > 1 else ' was'} accepted earlier and not shown."
    undecided = result.undecided
    if undecided:
        yield f"\nTo decide: {len(undecided)}"
        for f in undecided[:DECISIONS]:
            yield f"  {f.check}  {f.about or 'the data set'}"
            yield f"      {f.message}"
            yield f"      -> {f.action}"
        if len(undecided) > DECISIONS:
            rest = Counter(f.check for f in undecided[DECISIONS:])
            yield f"  and {len(undecided) - DECISIONS} more: " + ", ".join(f"{c} {n}" for c, n in rest.items())
    for severity, title in (("warning", "To look at"), ("info", "Good to know")):
        found = [f for f in result.findings if f.severity == severity and not f.accepted]
        if found:
            yield f"\n{title}: {len(found)}"
        for check in CHECKS:
            mine = [f for f in found if f.check == check]
            if mine:
                yield f"  {check} ({len(mine)}): {CHECKS[check].action}"
                yield from _by_person(mine, LINES if severity == "warning" else 2)
    if not result.findings:
        yield "Nothing was found."
    yield ""
    yield (
        "Nothing needs a decision."
        if result.ok
        else (
            "Decide with --exclude RECORDING or --accept CHECK:RECORDING, and --why; all findings: --json or --report."
        )
    )


def _by_person(found: Sequence[Finding], lines: int) -> Iterator[str]:
    """Format at most ``lines`` lines; several findings of a person share one line with their number."""
    by_person: dict[str, list[Finding]] = {}
    for f in found:
        by_person.setdefault(f.subject, []).append(f)
    if len(found) <= lines:
        groups = [[f] for f in found]
    else:
        groups = sorted(by_person.values(), key=len, reverse=True)
    for group in groups[:lines]:
        first = group[0]
        if len(group) == 1:
            yield f"      {first.about + ': ' if first.about else ''}{first.message}"
        else:
            yield f"      {first.subject}: {len(group)}, as {first.about}: {first.message}"
    if len(groups) > lines:
        yield f"      and {sum(map(len, groups[lines:]))} more of {len(groups) - lines} people"
