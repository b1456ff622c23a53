"""Implement ``plushsense check DATASET [--only CHECK,…] [--report FILE.html] [--accept CHECK:RECORDING --why "…"]``.

With options such as ``--label`` and ``--relabel`` it writes labels instead of running the checks.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import listed, seconds_between
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.dataset.quality.checking import CheckReport
    from plushsense.dataset.quality.findings import Finding

_LINES = 8
_DECISIONS = 20
_STRETCHES = 40


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.quality.checking import known_checks
    from plushsense.workflow.datasets import DecisionSpec, decide

    if _decides_labels(args):
        return _label(args)
    only = listed(args.only)
    known_checks(only)
    if args.report:
        from plushsense.reports.page import check_page_path

        check_page_path(args.report)
    spec = DecisionSpec(**options(args, "accept", "unaccept", "exclude", "include", "why", "who"))
    limits, progress = _limits(args.limit), ProgressReporter("checking")
    result, marked = decide(args.dataset, spec, only=only, limits=limits, progress=progress)
    if spec:
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


def _decides_labels(args: argparse.Namespace) -> bool:
    """Return whether an option of labels is given."""
    return bool(args.label or args.unlabel or args.relabel or args.labels or args.save_labels)


def _label(args: argparse.Namespace) -> int:
    from plushsense.dataset.labelling import check_labels_path, decide_labels, write_stretches

    if args.save_labels:
        check_labels_path(args.save_labels)
    done = decide_labels(
        args.dataset,
        label=[(stream, seconds_between("--label", times), label) for stream, times, label in args.label],
        unlabel=[(stream, seconds_between("--unlabel", times)) for stream, times in args.unlabel],
        relabel=args.relabel,
        file=args.labels,
        **options(args, "who", "why"),
    )
    if args.save_labels:
        write_stretches(args.save_labels, done.stretches)
        say(f"written: {args.save_labels}")
    seconds: dict[str, float] = {}
    for s in done.stretches:
        seconds[s.label] = seconds.get(s.label, 0.0) + s.stop_s - s.start_s
    result: dict[str, Any] = {
        "stretches": [asdict(s) for s in done.stretches],
        "seconds": {label: round(total, 1) for label, total in sorted(seconds.items())},
        "labelled": done.labelled,
        "undone": done.undone,
        "relabelled": list(done.relabelled),
    }
    for word, given in (("labelled", args.label or args.labels), ("undone", args.unlabel)):
        if given:
            say(f"{word} {result[word]}")
    if args.relabel:
        say(f"relabelled {plural(len(done.relabelled), 'recording')}")
    rows = [(s.stream, f"{s.start_s:.2f}", f"{s.stop_s:.2f}", s.label) for s in done.stretches]
    listing = [table(("stream", "start s", "stop s", "label"), rows), ""] if 0 < len(rows) <= _STRETCHES else []
    totals = "".join(f"; {label} {total:.0f} s" for label, total in sorted(seconds.items()))
    emit(args, result, [*listing, f"{plural(len(rows), 'labelled stretch')}{totals}"])
    return 0


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
