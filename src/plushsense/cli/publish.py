"""``plushsense publish DATASET OUT`` and ``plushsense publish --check PACKAGE``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

SHOWN_PROBLEMS = 20


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", nargs="?", help="data set folder")
    parser.add_argument("out", metavar="OUT", nargs="?", help="new or empty folder; the zip is OUT.zip beside it")
    parser.add_argument("--check", metavar="PACKAGE", help="only prove a package that is there, a folder or a zip")
    parser.add_argument("--licence", default="", metavar="SPDX", help="as CC-BY-4.0 (default: what dataset.toml says)")
    parser.add_argument(
        "--contact", default="", metavar="WHO", help='as "Name <mail>" (default: what dataset.toml says)'
    )
    parser.add_argument(
        "--consent", default="", metavar="TEXT", help="what the people agreed to (default: what dataset.toml says)"
    )
    parser.add_argument("--save", action="store_true", help="also write these three into dataset.toml")
    parser.add_argument("--no-streams", action="store_true", help="leave out what lay between the recordings")
    parser.add_argument("--allow-excluded", action="store_true", help="publish excluded recordings too, marked")
    parser.add_argument(
        "--allow-columns",
        default="",
        metavar="A,B",
        help="columns of subjects.csv besides age_group and gender (default: none)",
    )
    parser.add_argument(
        "--key",
        metavar="FILE",
        help="secret that fixes the shifts of time for later versions; made if absent (default: drawn anew)",
    )
    parser.add_argument("--bids", action="store_true", help="add a Motion-BIDS-like tree")
    parser.add_argument(
        "--no-reidentification",
        action="store_true",
        help="do not look whether people can be recognised; the package says that nobody looked",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the re-identification (1)")
    parser.add_argument("--thorough", action="store_true", help="slow validators read all rows of the streams too")


def run(args: argparse.Namespace) -> int:
    return _check(args) if args.check else _publish(args)


def _check(args: argparse.Namespace) -> int:
    from plushsense.workflow.datasets import validate_package

    if args.dataset:
        raise ConfigError("Give either DATASET OUT, or --check PACKAGE, not both.")
    checked = validate_package(args.check, thorough=args.thorough)
    _say_problems(args, checked.to_dict()["problems"])
    said = "valid" if checked.valid else f"not valid: {len(checked.problems)} problems"
    emit(args, {"package": args.check, **checked.to_dict()}, f"{args.check}: {said}")
    return 0 if checked.valid else 1


def _publish(args: argparse.Namespace) -> int:
    from plushsense.workflow.datasets import publish_dataset

    if not args.dataset or not args.out:
        raise ConfigError("Publishing needs DATASET and OUT, or --check PACKAGE.  See  plushsense publish --help")
    bars: dict[str, ProgressReporter] = {}

    def report_progress(what: str, done: int, total: int) -> None:
        bars.setdefault(what, ProgressReporter(what))(done, total)

    done = publish_dataset(
        args.dataset,
        args.out,
        licence=args.licence,
        contact=args.contact,
        consent=args.consent,
        save=args.save,
        streams=not args.no_streams,
        excluded=args.allow_excluded,
        columns=tuple(listed(args.allow_columns)),
        key=args.key,
        bids=args.bids,
        reidentification=not args.no_reidentification,
        seed=args.seed,
        thorough=args.thorough,
        progress=report_progress,
    )
    result = done.to_dict()
    if not args.json:
        for line in [*result["warnings"], *result["notes"]]:
            say(f"note: {line}")
    _say_problems(args, result["problems"])
    megabytes = f"{result['bytes'] / 1e6:.1f} MB"
    said = f"valid; {result['zip']}" if done.valid else f"not valid: {len(result['problems'])} problems, no zip"
    emit(args, result, f"{args.out}: {done.files} files, {megabytes}, {said}; {result['seconds']} s")
    return 0 if done.valid else 1


def _say_problems(args: argparse.Namespace, problems: list[dict[str, str]]) -> None:
    if args.json:
        return
    for p in problems[:SHOWN_PROBLEMS]:
        say(f"{p['validator']}: {p['file'] or 'package'}: {p['problem']}")
    if len(problems) > SHOWN_PROBLEMS:
        say(f"... and {len(problems) - SHOWN_PROBLEMS} more; --json lists all")
