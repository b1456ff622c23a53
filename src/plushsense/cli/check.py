"""Implement ``plushsense check DATASET [--only CHECK,…] [--report FILE.html] [--accept CHECK:RECORDING --why "…"]``.

With options such as ``--label`` and ``--relabel`` it writes labels instead, see `plushsense.cli.label`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from plushsense.cli.label import decides_labels
from plushsense.cli.label import run as run_label
from plushsense.cli.options import options
from plushsense.cli.output import emit, say
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.dataset.quality.checking import CheckReport
    from plushsense.dataset.quality.findings import Finding

_LINES = 8
_DECISIONS = 20


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.quality.checking import known_checks
    from plushsense.workflow.datasets import decide

    if decides_labels(args):
        return run_label(args)
    only = listed(args.only)
    known_checks(only)
    if args.report:
        from plushsense.reports.page import check_page_path

        check_page_path(args.report)
    result, marked = decide(
        args.dataset,
        **options(args, "accept", "unaccept", "exclude", "include", "why", "who"),
        only=only,
        limits=_limits(args.limit),
        progress=ProgressReporter("checking"),
    )
    if args.accept or args.unaccept or args.exclude or args.include:
        say(f"{marked} mark{'s' if marked != 1 else ''} added" + ("" if marked else ": all were there already") + ".")
    page = result.report(args.report, ProgressReporter("drawing")) if args.report else None
    emit(
        args,
        {**result.to_dict(), "marked": marked, "report": str(page) if page else None},
        [*overview(result), *([f"\nPlots: {page}"] if page else [])],
    )
    return 0 if result.ok else 1


def _limits(texts: Sequence[str]) -> dict[str, float]:
    limits = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            limits[name.strip()] = float(number)
        except ValueError:
            raise ConfigError(f"--limit {text}: give a name and a number, e.g. duration=0.5.") from None
    return limits


def overview(result: CheckReport) -> Iterator[str]:
    """Format the findings as text: those that need a decision first, the others by severity, check and person."""
    from plushsense.dataset.quality.checking import CHECKS

    people = len(result.dataset.subjects)
    excluded = f", {result.excluded} excluded" if result.excluded else ""
    yield (
        f"{result.dataset.path}: {plural(result.recordings, 'recording')} of {plural(people, 'person')} checked"
        f"{excluded}; {result.seconds:.1f} s"
    )
    if result.dataset.head.simulated:
        yield "SIMULATION: these recordings say nothing about a real toy."
    accepted = [f for f in result.findings if f.accepted]
    if accepted:
        yield f"{len(accepted)} finding{'s were' if len(accepted) > 1 else ' was'} accepted earlier and not listed."
    undecided = result.undecided
    if undecided:
        yield f"\nTo decide: {len(undecided)}"
        for f in undecided[:_DECISIONS]:
            yield f"  {f.check}  {f.about or 'the data set'}"
            yield f"      {f.message}"
            yield f"      -> {f.action}"
        if len(undecided) > _DECISIONS:
            rest = Counter(f.check for f in undecided[_DECISIONS:])
            yield f"  and {len(undecided) - _DECISIONS} more: " + ", ".join(f"{c} {n}" for c, n in rest.items())
    for severity, title in (("warning", "To look at"), ("info", "Good to know")):
        findings = [f for f in result.findings if f.severity == severity and not f.accepted]
        if findings:
            yield f"\n{title}: {len(findings)}"
        for check in CHECKS:
            mine = [f for f in findings if f.check == check]
            if mine:
                yield f"  {check} ({len(mine)}): {CHECKS[check].action}"
                yield from _by_person(mine, _LINES if severity == "warning" else 2)
    if not result.findings:
        yield "Nothing was found."
    yield ""
    if result.ok:
        yield "Nothing needs a decision."
    else:
        yield (
            "Decide with --exclude RECORDING or --accept CHECK:RECORDING, and --why; all findings: --json or --report."
        )


def _by_person(findings: Sequence[Finding], lines: int) -> Iterator[str]:
    """Format findings as about ``lines`` lines; if there are more, combine those of each person in one line."""
    by_person: dict[str, list[Finding]] = {}
    for f in findings:
        by_person.setdefault(f.subject, []).append(f)
    if len(findings) <= lines:
        groups = [[f] for f in findings]
    else:
        groups = sorted(by_person.values(), key=len, reverse=True)
    for group in groups[:lines]:
        first = group[0]
        if len(group) == 1:
            yield f"      {first.about + ': ' if first.about else ''}{first.message}"
        else:
            yield f"      {first.subject}: {len(group)}, for example {first.about}: {first.message}"
    if len(groups) > lines:
        yield f"      and {sum(map(len, groups[lines:]))} more of {plural(len(groups) - lines, 'person')}"
