"""Implement ``plushsense merge DATASET EVALUATION [--merges N --out FILE]``."""

from __future__ import annotations

import argparse
from typing import Any

from plushsense.cli.output import emit, figure, say, table
from plushsense.cli.settings import marks


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.people.merging import propose_merges

    result = propose_merges(args.dataset, args.evaluation, merges=args.merges, out=args.out)
    if args.out:
        say(f"written: {args.out}; train and evaluate with  --classes {args.out}")
    emit(args, result, lines(result))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """Format the merges as text: a row for each number of merges."""
    from plushsense.scoring.metrics import column_metrics

    names = {key: metric.name for key, metric in column_metrics().items()}
    rows, known = [], set[str]()
    for step in result["steps"]:
        groups = [" + ".join(group) for group in step["merged"]]
        new = [group for group in groups if group not in known]
        known = set(groups)
        scores = [figure(step[kind][key]["mean"]) for key in names for kind in ("scores", "crossfitted")]
        rows.append(
            (step["merges"], step["classes"], figure(step["largest"]), *scores, figure(step["confusion"]),
             "-" if step["people"] is None else f"{step['people']} of {result['people']}", "; ".join(new))
        )  # fmt: skip
    heads = [head for name in names.values() for head in (name, "cross-fitted")]
    return [
        *marks(result),
        f"split {result['split']}; means over {result['people']} people; nothing was trained again",
        "",
        table(("merges", "classes", "largest class", *heads, "confused", "in people", "merged last"), rows),
        "",
        "largest class: the share of windows that a program gets right which always names that class. Fewer classes",
        "are easier, so a higher score alone is no gain. cross-fitted: each person is scored with the merges that all",
        "others choose.",
    ]
