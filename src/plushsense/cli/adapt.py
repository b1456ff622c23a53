"""Implement ``plushsense adapt BUNDLE RECORDINGS --out BUNDLE``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, spread, table, warn
from plushsense.cli.settings import marks, report_jobs, settings
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.experiments.adaptation import Adapted, AdaptingResult


def run(args: argparse.Namespace) -> int:
    from plushsense.models.bundle import check_bundle_path

    if args.evaluate is not None:
        return _evaluate(args)
    if args.bundle is None or (args.recordings is not None) == args.undo:
        raise ConfigError("Give BUNDLE and RECORDINGS, or BUNDLE --undo, or --evaluate DATASET.")
    if args.out is None:
        raise ConfigError("--out is missing: give the bundle to write; the given bundle is never changed.")
    out = check_bundle_path(args.out)
    if out.exists() and Path(args.bundle).exists() and out.samefile(args.bundle):
        raise ConfigError(f"'{out}' is the bundle to adapt, which is never changed: choose another --out.")
    if out.exists() and not args.force:
        raise ConfigError(f"'{out}' is already there: choose another --out, or --force to replace it.")
    if args.undo:
        return _undo(args, out)
    from plushsense.experiments.adaptation import adapt

    done = adapt(args.bundle, args.recordings, **options(args, "subject", "use"), warn=warn)
    if done.accepted:
        done.save(out)
    emit(args, {"bundle": str(out) if done.accepted else None, **done.to_dict()}, _lines(done, out))
    return 0 if done.accepted else 1


def _undo(args: argparse.Namespace, out: Path) -> int:
    from plushsense.live.adaptation import restore_original
    from plushsense.models.bundle import Bundle

    bundle = Bundle.load(args.bundle)
    subject = bundle.adapted_to
    restore_original(bundle).save(out)
    result = {"bundle": str(out), "undone": True, "subject": subject}
    emit(args, result, f"{out}: as before it was adapted to {subject}")
    return 0


def _lines(done: Adapted, out: Path) -> list[str]:
    personal = done.personal
    mark = "  [SIMULATION]" if done.simulated else ""
    head = f"{out}: adapted to {done.subject}{mark}" if done.accepted else "nothing written: the bundle stays as it is"
    text = [head, f"{personal.reason}." if personal.accepted else f"recordings not used: {personal.reason}."]
    if done.tested is not None:
        before, after = done.tested
        text.append(
            f"on {plural(before.recordings, 'recording')} that were not used to adapt: {after.right} correct, before "
            f"{before.right}; log loss {after.log_loss:.3f}, before {before.log_loss:.3f}."
        )
    return text


def _evaluate(args: argparse.Namespace) -> int:
    from plushsense.experiments.adaptation import evaluate_adapting

    given = {"BUNDLE": args.bundle, "--out": args.out, "--subject": args.subject, "--undo": args.undo or None}
    for name, value in given.items():
        if value is not None:
            raise ConfigError(f"--evaluate trains its own networks for all people: leave {name} out.")
    result = evaluate_adapting(
        args.evaluate,
        settings(args),
        split=args.split or "leave-one-subject-out",
        use=2 if args.use is None else args.use,
        progress=report_jobs("adapting"),
        warn=warn,
    )
    emit(args, result.to_json(), _evaluation_lines(result))
    return 0


def _evaluation_lines(result: AdaptingResult) -> list[str]:
    rows = [
        (
            row.subject,
            f"{row.recordings:.0f}",
            *(figure(row.scores[s][w]) for s in ("accuracy", "macro_f1") for w in ("before", "after")),
            f"{row.right_change:.1f}",
            row.right_change_worst,
        )
        for row in result.people
    ]
    right = result.right
    return [
        *marks({"simulated": result.simulated, "leaky": False}),
        f"split {result.split}, context {result.context}; {plural(result.use, 'recording')} of each gesture adapt, the "
        f"rest test; {result.choices} choices of recordings, {100 * result.refused:.1f} % left the bundle as it is\n",
        table(("subject", "tested", "accuracy", "after", "macro-F1", "after", "more correct", "worst choice"), rows),
        "",
        *(
            f"{name} {'gain, first recordings' if when == 'first' else when:<24}{spread(one.to_json())}"
            for score, name in (("accuracy", "accuracy"), ("macro_f1", "macro-F1"))
            for when, one in result.score(score).items()
        ),
        f"recordings correct, after minus before: mean {right['mean']:.1f}; the person who gains least "
        f"{right['worst_mean']:.1f}, the worst single choice {right['worst']}; people worse by more than one: "
        f"{right['worse_people']}, choices: {100 * right['worse_choices']:.1f} %\n",
        "For people with one session, this does not show whether the gain lasts until another day.",
    ]
