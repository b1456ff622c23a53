"""``plushsense verify OUT [--target …] [--dataset DS] [--samples N] [--faults] [--trust]``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from plushsense.cli.output import emit, table, warn
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.deploy.proof.verify import VerificationReport

_SAMPLES = 100_000


def add(parser: argparse.ArgumentParser) -> None:
    from plushsense.deploy.targets import TARGETS

    repeated: dict[str, Any] = {"action": "append", "default": []}
    add = parser.add_argument
    add("export", metavar="OUT", help="folder written by plushsense export")
    add(
        "--target",
        metavar="NAME",
        **repeated,
        help=f"{', '.join(TARGETS)}; several joined by commas (default: all with installed compilers and emulators)",
    )
    add("--dataset", metavar="DS", help="also stream these recordings through the C; nothing of them is stored")
    add("--subject", metavar="CODE", **repeated, help="only these people of DS; several joined by commas")
    add(
        "--samples",
        metavar="N",
        type=int,
        help=f"samples to stream besides the golden vectors: of DS ({_SAMPLES:,}), else synthetic (default: none)",
    )
    add("--faults", action="store_true", help="also test that deliberate errors (mutants) are detected; takes minutes")
    add(
        "--trust",
        action="store_true",
        help="compile and run C files that this version would not write (default: refuse them); they can do whatever "
        "you can on this computer, and the result says that they are not ours",
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.deploy.package import changed_copies
    from plushsense.deploy.proof.vectors import Export
    from plushsense.deploy.proof.verify import verify

    if args.subject and not args.dataset:
        raise ConfigError("--subject chooses people of a data set: give --dataset too.")
    if args.samples is not None and args.samples < 1:
        raise ConfigError(f"--samples is {args.samples}: give 1 or more.")
    export = Export(args.export)
    if changed := changed_copies(export.folder):
        warn(f"only the originals are verified; these copies of them were changed: {', '.join(changed)}")
    if args.dataset:
        vectors = export.recorded(open_dataset(args.dataset), listed(*args.subject), args.samples or _SAMPLES)
        if args.samples and sum(v.samples for v in vectors) < args.samples:
            warn(f"these recordings make {sum(v.samples for v in vectors):,} samples, not {args.samples:,}")
    else:
        vectors = export.made_up(args.samples or 0)
    mutants = (lambda mutant: True) if args.faults else None
    done = verify(
        export, listed(*args.target), vectors, mutants=mutants, trust=args.trust, progress=ProgressReporter("verify")
    )
    emit(args, {"export": args.export, **done.to_dict()}, _text(done))
    return 0 if done.passed else 1


def _text(done: VerificationReport) -> list[str]:
    streams = [f"{v.name}: {v.samples:,} samples of {v.frames:,} frames, {v.answers:,} answers" for v in done.counts]
    rows = [
        (r.target, r.compiler, r.flags, f"{r.vectors}", f"{r.mismatches}", f"{r.max_abs_diff}", f"{r.seconds:.1f}")
        for r in done.runs
    ]
    head = ("target", "compiler", "flags", "vectors", "mismatches", "largest difference", "seconds")
    lines = [done.title, *streams, "", table(head, rows)]
    lines += [f"not run: {what} ({why})" for what, why in done.not_run]
    if done.mutants:
        targets = list(dict.fromkeys(m.target for m in done.mutants))
        by_mutant: dict[tuple[str, str], dict[str, str]] = {}
        for m in done.mutants:
            by_mutant.setdefault((m.kind, m.name), {})[m.target] = (
                "caught" if m.caught else "not shown" if m.silent else "NOT CAUGHT"
            )
        outcomes = [(*mutant, *(row.get(t, "") for t in targets)) for mutant, row in by_mutant.items()]
        lines += ["", table(("kind", "mutant", *targets), outcomes)]
        if any(m.silent for m in done.mutants):
            lines += ["", "not shown: no test scenario of this network depends on that line of the rules."]
    if done.first:
        lines += ["", done.first]
    elif done.passed:
        lines += ["", "Every number of every answer is equal."]
    elif not done.decisions:
        lines += ["", "Nothing is proven: the toy was still warming up in all answers. Export the model again."]
    else:
        lines += ["", "A mutant was not detected: the golden vectors of this export are too weak for it."]
    if not done.own:
        lines += [
            "",
            f"NOT OURS: {', '.join(done.changed)} {'is' if len(done.changed) == 1 else 'are'} not what this PlushSense "
            "writes for the bundle in the folder. It was run because of --trust; equal "
            "answers say nothing about what else it does. Export again to be sure.",
        ]
    return lines
