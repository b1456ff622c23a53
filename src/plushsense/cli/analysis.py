"""Implement ``plushsense compare`` and ``merge``."""

from __future__ import annotations

import argparse
from pathlib import Path

from plushsense.cli.output import emit, say
from plushsense.cli.settings import SIMULATION, marks
from plushsense.core.sentences import plural


def run_compare(args: argparse.Namespace) -> int:
    from plushsense.experiments.analysis.comparison import PAGE, compare
    from plushsense.experiments.analysis.tables import SCORED, model_table, pair_table, split_table

    result = compare(args.evaluations, out=args.out, overwrite=args.force)
    table = result.to_json()
    if args.out:
        table |= {"out": args.out, "report": str(Path(args.out) / PAGE)}
        say(f"written: {args.out}")
    lines = [SIMULATION, ""] if result.simulated else []
    lines += [model_table(result).text(), "", *(f"{m.name}: {m.evaluation.folder}" for m in result.models)]
    lines += ["", split_table(result).text()]
    if SCORED[result.scored]:
        lines += ["", SCORED[result.scored]]
    for key in result.pairs:
        pairs = pair_table(result, key)
        lines += ["", pairs.title, pairs.text()]
    emit(args, table, lines)
    return 0


def run_merge(args: argparse.Namespace) -> int:
    from plushsense.experiments.analysis.merging import propose_merges
    from plushsense.experiments.analysis.tables import grouping_table, merge_table

    result = propose_merges(args.dataset, args.evaluation, merges=args.merges, groups=args.groups, out=args.out)
    if args.out:
        say(f"written: {args.out}; train and evaluate with  --classes {args.out}")
    table = result.to_json()
    lines = [
        *marks(table),
        f"split {result.split}; means over {plural(result.people, 'person')}; nothing was trained again",
        "",
        merge_table(result).text(),
        "",
        "largest class: the share of windows that a program gets right which always names that class. Fewer classes",
        "are easier, so a higher score alone is no gain. cross-fitted: each person is scored with the merges that all",
        "others choose.",
    ]
    if result.groupings:
        lines += ["", "named beforehand, so nothing is chosen on these people:", "", grouping_table(result).text()]
    emit(args, table, lines)
    return 0
