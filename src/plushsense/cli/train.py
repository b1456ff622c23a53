"""Implement ``plushsense train DATASET --arch SPEC --filters …``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, warn
from plushsense.cli.settings import report_epochs, say_advice, settings
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.models.bundle import Bundle
    from plushsense.workflow.api import TrainingScores


def run(args: argparse.Namespace) -> int:
    from plushsense.models.bundle import check_bundle_path
    from plushsense.workflow.api import train, unfinished

    if check_bundle_path(args.out).exists() and not args.force:
        raise ConfigError(f"'{args.out}' is already there: choose another --out, or replace it with --force.")
    config = settings(args)
    done = train(
        args.dataset,
        config,
        **options(args, "quantize_aware", "temperature", "fit_decisions"),
        journal=unfinished(args.dataset),
        progress=report_epochs(),
        warn=warn,
    )
    bundle = done.save(args.out)
    scores, int8, batch = done.scores, done.scores.int8, done.bundle.provenance["training"]["batch"]
    mark = "  [SIMULATION]" if scores.simulated else ""
    emit(
        args,
        {"bundle": str(bundle), "history": done.history, "scores": scores.to_json(), "decision": done.bundle.decision},
        [
            f"{bundle}: {done.bundle.arch.symbol}, {done.bundle.arch.parameters:,} parameters, "
            f"epoch {scores.best_epoch} of {len(done.history)} kept, batches of {batch}{mark}",
            _reads(done.bundle),
            f"accuracy {figure(scores.accuracy)}, macro-F1 {figure(scores.macro_f1)} on {scores.windows} "
            f"windows of {scores.description}{_counted(scores)}.",
            *(
                [
                    f"In 8 bits, as in the toy: accuracy {figure(int8.accuracy)}, macro-F1 "
                    f"{figure(int8.macro_f1)}; the same answer on {100 * int8.agreement:.1f} % of them."
                ]
                if int8
                else []
            ),
            *decided(done.bundle.decision),
        ],
    )
    say_advice(args.dataset, config.windows.window_s)
    return 0


def _reads(bundle: Bundle) -> str:
    """Format what a decision reads, in seconds and samples, as text."""
    arch, rate = bundle.arch, bundle.layout.rate_hz
    return (
        f"A decision reads the last {arch.span / rate:.2f} s ({arch.span} samples at {rate:g} Hz), through kernels of "
        f"{arch.receptive_field / rate:.2f} s ({arch.receptive_field})."
    )


def _counted(scores: TrainingScores) -> str:
    from plushsense.reports.wording import MEAN
    from plushsense.workflow.preparation import WHOLE_PEOPLE

    rest = scores.nobody
    apart = f", whose accuracy is {figure(rest.accuracy)}" if rest else ""
    return f" ({MEAN}{apart})" if scores.split == WHOLE_PEOPLE else ""


def decided(decision: Mapping[str, Any]) -> list[str]:
    """Format a summary of the fitted decision settings as text; return no lines if none were fitted."""
    fitted = decision.get("fitted")
    if not fitted:
        return []
    people = plural(fitted["people"], "person")
    events, answers = fitted["events"], fitted.get("answers")
    text = f"Decisions fitted on {people} who {'was' if fitted['people'] == 1 else 'were'} held back"
    if "cost" in events:
        text += f" ({plural(fitted['gestures'], 'gesture')} in {60 * fitted['hours']:.0f} min of streams): mean "
        text += "cost of errors "
        text += f"per gesture {figure(events['cost_before'])} with the defaults, "
        text += f"{figure(events['cost'])} now" if events["moved"] else "and no settings are reliably better"
    else:
        text += "; they have no streams, so events keep the defaults"
    out = [text + "."]
    gate = fitted.get("gate")
    if gate:
        out.append(_gate(gate))
    if answers:
        line = f"If the toy may name several gestures: {answers['classes_in_set']:.1f} on average, "
        line += f"with the true one among them in {100 * answers['coverage']:g} %"
        if answers["coverage_left_out"] is not None:
            line += (
                f" ({100 * answers['coverage_left_out']:.1f} % of each person, with a threshold fitted on the others)"
            )
        out.append(line + f" of the {answers['on']}.")
    return out


def _gate(gate: Mapping[str, Any]) -> str:
    """Format the scores of the fitted gate as text, or the reason why there is no gate."""
    if "reason" in gate:
        return f"No gate (threshold rules that detect energetic gestures, such as hits, at once): {gate['reason']}."
    false = gate["false_alarms_per_hour"]
    alarms = "" if false is None else f", with {false:.1f} false alarms an hour"
    return (
        f"Gate fitted on {plural(gate['people'], 'person')}: it detects {100 * gate['recall']:.0f} % of their "
        f"{plural(gate['recordings'], 'energetic recording')}{alarms}."
    )
