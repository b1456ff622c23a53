"""Implement ``plushsense abstain DATASET --split by-subject:5 [--withhold]``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, spread, table, warn
from plushsense.cli.settings import marks, report_jobs, settings
from plushsense.core.sentences import plural


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.abstention import abstaining

    config = settings(args, workers=args.workers)
    out = Path(args.out) if args.out else Path(args.dataset) / "evaluations" / "abstaining"
    result = abstaining(
        args.dataset,
        config,
        **options(args, "split", "withhold", "coverage"),
        out=out,
        progress=report_jobs("training", "networks"),
        warn=warn,
    )
    say(f"written: {out}")
    emit(args, {**result.to_dict(), "out": str(out)}, lines(result.to_dict()))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """Format the scores of abstention as text."""
    out = marks({**result, "leaky": False})
    out.append(
        f"{plural(result['recordings'], 'gesture')} of {plural(result['people'], 'person')} left out, classified at "
        f"their end in the stream; {100 * result['accuracy']:.1f} % correct\n"
    )
    rows = [
        (
            row["confidence"],
            figure(row["aurc"]),
            figure(row["gain"]),
            spread(row["gain_by_person"]),
            figure(row["coverage_at_risk_20"]),
            figure(row["auroc_right"]),
        )
        for row in result["confidences"]
    ]
    head = ("confidence", "AURC", "oracle's gain", "by person", "coverage at 20 % wrong", "AUROC right")
    out.append(table(head, rows))
    out.append(f"\nAURC of chance {figure(result['aurc_random'])}, of an oracle {figure(result['aurc_oracle'])}")
    stated = result["stated_coverage"]
    out.append(
        f"sets of classes fitted to contain the true one in {100 * stated['stated']:g} % contain it in "
        f"{spread(stated['by_person'])} of the {stated['on']} (over people; least {figure(stated['least'])}), with "
        f"{stated['classes_in_set']:.1f} classes in them"
    )
    if result["free_choice"]:
        out += ["", "gestures that are not among the classes (free choice and rare ones):"]
        out += _unknown({"": result["free_choice"]})
    if result["withheld"]:
        out += [
            "",
            "each gesture withheld from training in turn (AUROC against the known ones, over folds):",
            *_unknown(result["withheld"]),
        ]
        mean = result["withheld_mean"]
        out.append("mean over gestures: " + ", ".join(f"{name} {spread(s)}" for name, s in mean.items()))
    return out


_SHOWN = ("softmax, smoothed", "logit", "known score", "energy", "relative Mahalanobis")


def _unknown(rows: dict[str, Any]) -> list[str]:
    cells = [
        (
            label or "all of these",
            row["recordings"],
            *(spread(row["auroc"][name]) for name in _SHOWN),
            spread(row["known_passed"]),
            spread(row["unknown_caught"]),
        )
        for label, row in rows.items()
    ]
    head = (
        "gesture",
        "recordings",
        "AUROC softmax",
        "logit",
        "known score",
        "energy",
        "Mahalanobis",
        "known passed",
        "unknown caught",
    )
    return [table(head, cells)]
