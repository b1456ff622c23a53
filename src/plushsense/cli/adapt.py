"""Implement ``plushsense adapt BUNDLE RECORDINGS --out BUNDLE`` and ``plushsense feedback BUNDLE STREAM``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, spread, table, warn
from plushsense.cli.settings import listed, marks, settings
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.experiments.adaptation import Adapted
    from plushsense.live.feedback import Corrected


def run(args: argparse.Namespace) -> int:
    from plushsense.models.bundle import check_bundle_path

    if args.evaluate is not None:
        return _evaluate(args)
    given = sum((args.recordings is not None or args.feedback is not None, args.undo))
    if args.bundle is None or given != 1:
        raise ConfigError(
            "Give BUNDLE and RECORDINGS, or BUNDLE --feedback FILE, or both, or BUNDLE --undo, or --evaluate DATASET."
        )
    if args.out is None:
        raise ConfigError("--out is missing: give the bundle to write; the given bundle is never changed.")
    out = check_bundle_path(args.out)
    if out.exists() and Path(args.bundle).exists() and out.samefile(args.bundle):
        raise ConfigError(f"'{out}' is the bundle to adapt, which is never changed: choose another --out.")
    if out.exists() and not args.force:
        raise ConfigError(f"'{out}' is already there: choose another --out, or --force to replace it.")
    if args.undo:
        return _undo(args, out)
    if args.recordings is None:
        return _correct(args, out)
    from plushsense.experiments.adaptation import adapt

    chosen = options(args, "subject", "use", "feedback")
    done = adapt(args.bundle, args.recordings, **chosen, warn=warn)
    if done.accepted:
        done.save(out)
    emit(args, {"bundle": str(out) if done.accepted else None, **done.to_dict()}, _lines(done, out))
    return 0 if done.accepted else 1


def _correct(args: argparse.Namespace, out: Path) -> int:
    from plushsense.live.feedback import correct, read_corrections
    from plushsense.models.bundle import Bundle

    if args.subject is not None or args.use is not None:
        raise ConfigError("--subject and --use choose among RECORDINGS: give RECORDINGS, or leave them out.")
    done = correct(Bundle.load(args.bundle), read_corrections(args.feedback))
    if done.accepted:
        done.bundle.save(out)
    emit(args, {"bundle": str(out) if done.accepted else None, **done.to_dict()}, _correction_lines(done, str(out)))
    return 0 if done.accepted else 1


def _correction_lines(done: Corrected, out: str) -> list[str]:
    if done.accepted:
        return [f"{out}: corrected by {done.bundle.adapted_to}; {done.reason}."]
    return [f"the corrections change nothing, because {done.reason}."]


def run_feedback(args: argparse.Namespace) -> int:
    from plushsense.core.recorder_csv import STREAM_NAME, read_stream
    from plushsense.live.feedback import append_corrections, check_corrections_path, correction_of, events_of
    from plushsense.models.bundle import Bundle

    if args.out is not None:
        check_corrections_path(args.out)
    bundle, path = Bundle.load(args.bundle), Path(args.stream)
    frames = read_stream(path / STREAM_NAME if path.is_dir() else path, bundle.layout).frames
    events = events_of(bundle, frames)
    labels = bundle.gestures.labels
    wrong = {_number(text, len(events)): "" for text in listed(args.wrong or "")}
    for text in listed(args.right or ""):
        number, equals, label = text.partition("=")
        if not equals:
            raise ConfigError(f"--right '{text}' names no gesture: write the number of the event, = and the gesture.")
        wrong[_number(number, len(events))] = label.strip()
    if not wrong:
        rows = [
            {
                "event": n,
                "begun_s": round(e.start_s, 2),
                "ended_s": round(e.stop_s, 2),
                "gesture": labels[e.gesture] if e.gesture < len(labels) else None,
            }
            for n, e in enumerate(events, 1)
        ]
        lines = [table(("event", "begun s", "ended s", "gesture"), [tuple(row.values()) for row in rows])]
        emit(args, {"events": rows, "corrections": 0, "file": None}, [*lines, "mark one with --wrong EVENT"])
        return 0
    if args.subject is None or args.out is None:
        raise ConfigError("--subject and --out are missing: say who corrects, and the file to append to.")
    corrections = [
        correction_of(bundle, frames, events[n - 1], subject=args.subject, right=right)
        for n, right in sorted(wrong.items())
    ]
    append_corrections(args.out, corrections)
    result = {"events": [], "corrections": len(corrections), "file": args.out}
    told = [f"{c.gesture}: {f'it was {c.right}' if c.right else 'wrong'}" for c in corrections]
    emit(args, result, [*told, f"corrections appended to {args.out}: {len(corrections)}"])
    return 0


def _number(text: str, events: int) -> int:
    if not text.strip().isdecimal() or not 1 <= int(text) <= events:
        raise ConfigError(f"There is no event '{text}': the bundle reports {events} on this stream, from 1.")
    return int(text)


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
    if done.corrected is not None:
        text += _correction_lines(done.corrected, "corrections")
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
        random=args.choices or 0,
        int8=args.int8,
        progress=say,
        warn=warn,
    )
    emit(args, result, _evaluation_lines(result))
    return 0


def _evaluation_lines(e: dict[str, Any]) -> list[str]:
    out = marks({**e, "leaky": False})
    out.append(
        f"split {e['split']}, context {e['context']}; {plural(e['use'], 'recording')} of each gesture adapt, the rest "
        f"test; {e['choices']} choices of recordings, {100 * e['refused']:.1f} % left the bundle as it is\n"
    )
    for engine, scores in e["engines"].items():
        rows = [
            (
                row["subject"],
                f"{row['recordings']:.0f}",
                *(figure(row[f"{s}_{w}"]) for s in ("accuracy", "macro_f1") for w in ("before", "after")),
                f"{row['right_change']:.1f}",
                row["right_change_worst"],
            )
            for row in scores["people"]
        ]
        head = ("subject", "tested", "accuracy", "after", "macro-F1", "after", "more correct", "worst choice")
        out += [f"{engine}\n", table(head, rows), ""]
        for score, name in (("accuracy", "accuracy"), ("macro_f1", "macro-F1")):
            for when in ("before", "after", "gain", "first"):
                label = "gain, first recordings" if when == "first" else when
                out.append(f"{name} {label:<24}{spread(scores[score][when])}")
        right = scores["right"]
        out.append(
            f"recordings correct, after minus before: mean {right['mean']:.1f}; the person who gains least "
            f"{right['worst_mean']:.1f}, the worst single choice {right['worst']}; people worse by more than one: "
            f"{right['worse_people']}, choices: {100 * right['worse_choices']:.1f} %\n"
        )
    if e["agreement"]:
        same = e["agreement"]
        out.append(
            f"float and int8 agree on {100 * same['before']:.1f} % of the windows, after adapting "
            f"{100 * same['after']:.1f} %"
        )
    return [*out, "For people with one session, this does not show whether the gain lasts until another day."]
