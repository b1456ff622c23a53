"""``plushsense verify OUT [--target …] [--dataset DS] [--samples N] [--faults]``"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from plushsense.apps.cli.output import bar, emit, table
from plushsense.apps.cli.settings import listed, warn
from plushsense.core.errors import ConfigError

if TYPE_CHECKING:
    from plushsense.deploy.verify import Verified

_SAMPLES = 100_000


def add(parser: argparse.ArgumentParser) -> None:
    from plushsense.deploy.targets import TARGETS

    parser.add_argument("export", metavar="OUT", help="export folder, as plushsense export leaves it")
    parser.add_argument(
        "--target",
        metavar="NAME",
        action="append",
        default=[],
        help=f"{', '.join(TARGETS)}; several with commas (default: all whose compilers and emulators are installed "
        "here)",
    )
    parser.add_argument(
        "--dataset", metavar="DS", help="also stream these recordings through the C; nothing of them is kept"
    )
    parser.add_argument(
        "--subject", metavar="CODE", action="append", default=[], help="only this person of DS; several with commas"
    )
    parser.add_argument(
        "--samples",
        metavar="N",
        type=int,
        help=f"samples to stream besides the golden vectors: of DS ({_SAMPLES:,}), or made up (default: none)",
    )
    parser.add_argument(
        "--faults",
        action="store_true",
        help="also plant faults, one at a time, each of which must be noticed (minutes)",
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.deploy.package import changed_copies
    from plushsense.deploy.vectors import Export
    from plushsense.deploy.verify import verify

    if args.subject and not args.dataset:
        raise ConfigError("--subject chooses people of a data set: give --dataset too.")
    if args.samples is not None and args.samples < 1:
        raise ConfigError(f"--samples is {args.samples}: give 1 or more.")
    export = Export(args.export)
    if changed := changed_copies(export.folder):
        warn(f"only the originals are proved, and these copies of them were changed: {', '.join(changed)}")
    if args.dataset:
        vectors = export.recorded(open_dataset(args.dataset), listed(*args.subject), args.samples or _SAMPLES)
        if args.samples and sum(v.samples for v in vectors) < args.samples:
            warn(f"these recordings make {sum(v.samples for v in vectors):,} samples, not {args.samples:,}")
    else:
        vectors = export.made_up(args.samples or 0)
    plant = (lambda fault: True) if args.faults else None
    done = verify(export, listed(*args.target), vectors, plant=plant, progress=bar("verify"))
    emit(args, {"export": args.export, **done.to_dict()}, _text(done))
    return 0 if done.passed else 1


def _text(done: Verified) -> list[str]:
    streams = [f"{v.name}: {v.samples:,} samples of {v.frames:,} frames, {v.answers:,} answers" for v in done.counts]
    rows = [
        (r.target, r.compiler, r.flags, f"{r.vectors}", f"{r.mismatches}", f"{r.max_abs_diff}", f"{r.seconds:.1f}")
        for r in done.runs
    ]
    head = ("target", "compiler", "flags", "vectors", "mismatches", "largest difference", "seconds")
    said = [done.title, *streams, "", table(head, rows)]
    said += [f"not run: {what} ({why})" for what, why in done.not_run]
    if done.faults:
        targets = list(dict.fromkeys(f.target for f in done.faults))
        by_fault: dict[tuple[str, str], dict[str, str]] = {}
        for f in done.faults:
            by_fault.setdefault((f.kind, f.fault), {})[f.target] = (
                "caught" if f.caught else "not shown" if f.silent else "NOT CAUGHT"
            )
        shown = [(*fault, *(found.get(t, "") for t in targets)) for fault, found in by_fault.items()]
        said += ["", table(("planted", "fault", *targets), shown)]
        if any(f.silent for f in done.faults):
            said += ["", "not shown: nothing that this network does in any drill hangs on that line of the rules."]
    if done.first:
        said += ["", done.first]
    elif done.passed:
        said += ["", "Every number of every answer is equal."]
        if not done.own:
            said += [
                "The model here is not what this PlushSense makes of the bundle beside it: the C agrees with the "
                "golden vectors in the folder, and nobody vouches for those. Export again to be sure."
            ]
    elif not done.decisions:
        said += ["", "Nothing is proven: in none of the answers the toy had stopped warming. Export the model again."]
    else:
        said += ["", "A planted fault was not noticed: the golden vectors of this export are too weak for it."]
    return said
