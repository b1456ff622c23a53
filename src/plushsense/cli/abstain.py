"""``plushsense abstain DATASET --split by-subject:5 [--withhold]``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plushsense.cli.evaluate import figure
from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import add_settings, settings, warn
from plushsense.jobs.progress import ProgressReporter


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder, with streams")
    parser.add_argument(
        "--split", metavar="SPLIT", default="by-subject:5", help="by-subject:K (5) or leave-one-subject-out"
    )
    parser.add_argument(
        "--withhold",
        action="store_true",
        help="also train without each gesture, and ask whether it is noticed as unknown: as many trainings again for "
        "each",
    )
    parser.add_argument(
        "--coverage",
        type=float,
        default=0.9,
        metavar="SHARE",
        help="share of steps in which the set of classes shall hold the true one (0.9)",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="trainings at a time (default 0: one a processor)")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for abstaining.json and risk-coverage.png (default: DATASET/abstaining)",
    )
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.experiments.abstention import abstaining

    config = settings(args, workers=args.workers)
    out = Path(args.out) if args.out else Path(args.dataset) / "abstaining"

    reporter = ProgressReporter("training", "networks", keep=True)
    found = abstaining(
        args.dataset,
        config,
        split=args.split,
        withhold=args.withhold,
        coverage=args.coverage,
        out=out,
        progress=lambda done, total, resumed: reporter(done, total, resumed=resumed),
        warn=warn,
    )
    say(f"written: {out}")
    emit(args, {**found.to_dict(), "out": str(out)}, lines(found.to_dict()))
    return 0


def lines(found: dict[str, Any]) -> list[str]:
    """Format the figures as text."""
    out = ["SIMULATION: of the virtual toy; it says nothing about a real one."] if found["simulated"] else []
    out.append(
        f"{found['recordings']} gestures of {found['people']} people left out, answered at their end in the stream; "
        f"{100 * found['accuracy']:.1f} % right\n"
    )
    rows = [
        (
            row["confidence"],
            figure(row["aurc"]),
            figure(row["gain"]),
            _spread(row["gain_by_person"]),
            figure(row["coverage_at_risk_20"]),
            figure(row["auroc_right"]),
        )
        for row in found["confidences"]
    ]
    head = ("confidence", "AURC", "oracle's gain", "by person", "coverage at 20 % wrong", "AUROC right")
    out.append(table(head, rows))
    out.append(f"\nAURC of chance {figure(found['aurc_random'])}, of an oracle {figure(found['aurc_oracle'])}")
    stated = found["stated_coverage"]
    out.append(
        f"sets stated to hold the truth in {100 * stated['stated']:g} % held it in {_spread(stated['by_person'])} "
        f"of the {stated['on']} (over people; least {figure(stated['least'])}), with "
        f"{stated['classes_in_set']:.1f} classes in them"
    )
    if found["free_choice"]:
        out += ["", "gestures that the network was never meant to know (free choice and the rarer ones):"]
        out += _unknown({"": found["free_choice"]})
    if found["withheld"]:
        out += [
            "",
            "each gesture withheld from the training (AUROC against the known ones, over folds):",
            *_unknown(found["withheld"]),
        ]
        mean = found["withheld_mean"]
        out.append("mean over gestures: " + ", ".join(f"{name} {_spread(s)}" for name, s in mean.items()))
    return out


def _unknown(rows: dict[str, Any]) -> list[str]:
    shown = [
        (
            label or "all of these",
            row["recordings"],
            *(_spread(row["auroc"][name]) for name in ("softmax, smoothed", "logit, smoothed", "energy")),
            _spread(row["known_passed"]),
            _spread(row["unknown_caught"]),
        )
        for label, row in rows.items()
    ]
    head = ("gesture", "recordings", "AUROC softmax", "logit", "energy", "known passed", "unknown caught")
    return [table(head, shown)]


def _spread(score: dict[str, Any]) -> str:
    if score["mean"] is None:
        return "-"
    return f"{score['mean']:.3f}" + ("" if score["sd"] is None else f" ± {score['sd']:.3f}")
