"""``plushsense train DATASET --arch SPEC --filters …``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plushsense.cli.evaluate import figure
from plushsense.cli.output import emit
from plushsense.cli.settings import add_settings, report_epochs, settings, warn
from plushsense.core.errors import ConfigError


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument("--out", metavar="FILE", default="model.plush", help="the bundle to write (model.plush)")
    parser.add_argument("--force", action="store_true", help="replace a bundle that is already there")
    parser.add_argument(
        "--quantize-aware",
        type=int,
        default=0,
        metavar="EPOCHS",
        help="fine-tune for 8 bits after the training, for so many epochs (default 0: off; training says when it "
        "would be worth it)",
    )
    parser.add_argument(
        "--no-fit-decisions",
        dest="fit_decisions",
        action="store_false",
        help="leave out how decisions are made: the default settings instead of those that suit the people held back",
    )
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.api import train, unfinished

    if Path(args.out).exists() and not args.force:
        raise ConfigError(f"'{args.out}' is already there: choose another --out, or --force to replace it.")
    done = train(
        args.dataset,
        settings(args),
        quantize_aware=args.quantize_aware,
        fit_decisions=args.fit_decisions,
        journal=unfinished(args.dataset),
        progress=report_epochs(),
        warn=warn,
    )
    bundle = done.save(args.out)
    scores = done.scores
    int8 = scores["int8"]
    mark = "  [SIMULATION]" if scores["simulated"] else ""
    emit(
        args,
        {
            "bundle": str(bundle),
            "history": done.history,
            "scores": scores,
            "decision": done.bundle.decision,
        },
        [
            f"{bundle}: {done.bundle.arch.symbol}, {done.bundle.arch.parameters:,} parameters, "
            f"epoch {scores['best_epoch']} of {len(done.history)} kept{mark}",
            f"accuracy {figure(scores['accuracy'])}, macro-F1 {figure(scores['macro_f1'])} on {scores['windows']} "
            f"windows of {scores['said']}.",
            *(
                [
                    f"In 8 bits, as in the toy: accuracy {figure(int8['accuracy'])}, macro-F1 "
                    f"{figure(int8['macro_f1'])}; the same answer on {100 * int8['agreement']:.1f} % of them."
                ]
                if int8
                else []
            ),
            *decided(done.bundle.decision),
        ],
    )
    return 0


def decided(decision: Mapping[str, Any]) -> list[str]:
    """Format the decision settings and the people they were fitted on."""
    fitted = decision.get("fitted")
    if not fitted:
        return []
    people = "1 person" if fitted["people"] == 1 else f"{fitted['people']} people"
    events, answers = fitted["events"], fitted.get("answers")
    said = f"Decisions fitted on {people} who {'was' if fitted['people'] == 1 else 'were'} held back"
    if "cost" in events:
        said += f" ({fitted['gestures']} gestures in {60 * fitted['hours']:.0f} min of streams): an event's cost "
        said += f"{figure(events['cost_before'])} with the defaults, "
        said += f"{figure(events['cost'])} now" if events["moved"] else "and nothing was found that is surely better"
    else:
        said += "; no stream of theirs, so events keep the defaults"
    out = [said + "."]
    gate = fitted.get("gate")
    if gate:
        out.append(_gate(gate))
    if answers:
        line = f"Sets of {answers['classes_in_set']:.1f} classes hold the true one in {100 * answers['coverage']:g} %"
        if answers["coverage_left_out"] is not None:
            line += f" (person by person, with the others' threshold: {100 * answers['coverage_left_out']:.1f} %)"
        out.append(line + f" of the {answers['on']}.")
    return out


def _gate(gate: Mapping[str, Any]) -> str:
    """Format what the gate's fit found on its people, or why there is no gate."""
    if "reason" in gate:
        return f"No gate for energetic gestures: {gate['reason']}."
    false = gate["false_alarms_per_hour"]
    often = "" if false is None else f", with {false:.1f} false alarms an hour"
    return (
        f"Gate fitted on {gate['people']} people: it notices {100 * gate['recall']:.0f} % of their "
        f"{gate['recordings']} energetic recordings{often}."
    )
