"""``plushsense publish DATASET OUT`` and ``plushsense publish --check PACKAGE``."""

from __future__ import annotations

import argparse

from plushsense.cli.output import emit, say
from plushsense.cli.settings import listed, options, report_stages
from plushsense.core.errors import ConfigError

_MOST_PROBLEMS = 20


def add(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", metavar="DATASET", nargs="?", help="data set folder")
    add("out", metavar="OUT", nargs="?", help="new or empty folder; the zip file is OUT.zip")
    add("--check", metavar="PACKAGE", help="validate an existing package, a folder or a zip file, and write nothing")
    add("--licence", default="", metavar="SPDX", help="licence, such as CC-BY-4.0 (default: from dataset.toml)")
    add("--contact", default="", metavar="WHO", help='contact as "Name <mail>" (default: from dataset.toml)')
    add("--consent", default="", metavar="TEXT", help="consent statement (default: from dataset.toml)")
    add("--save", action="store_true", help="write licence, contact and consent into dataset.toml")
    add("--no-streams", action="store_true", help="leave out the session streams between the recordings")
    add("--allow-excluded", action="store_true", help="publish excluded recordings too, marked")
    add("--allow-columns", default="", metavar="A,B", help="columns of subjects.csv besides age_group and gender")
    add(
        "--key",
        metavar="FILE",
        help="secret that fixes the time shifts for later versions; created if absent (default: random each time)",
    )
    add("--bids", action="store_true", help="add a tree in the manner of Motion-BIDS")
    add("--no-reidentification", action="store_true", help="do not test whether people can be recognised")
    add("--seed", type=int, default=1, metavar="N", help="seed of the re-identification (1)")
    add("--thorough", action="store_true", help="let slow validators read all rows of the streams")


def run(args: argparse.Namespace) -> int:
    return _check(args) if args.check else _publish(args)


def _check(args: argparse.Namespace) -> int:
    from plushsense.dataset.publishing.checking import validate_package

    if args.dataset:
        raise ConfigError("Give either DATASET OUT, or --check PACKAGE, not both.")
    checked = validate_package(args.check, thorough=args.thorough)
    _print_problems(args, checked.to_dict()["problems"])
    verdict = "valid" if checked.valid else f"not valid: {len(checked.problems)} problems"
    emit(args, {"package": args.check, **checked.to_dict()}, f"{args.check}: {verdict}")
    return 0 if checked.valid else 1


def _publish(args: argparse.Namespace) -> int:
    from plushsense.workflow.datasets import publish_dataset

    if not args.dataset or not args.out:
        raise ConfigError("Publishing needs DATASET and OUT, or --check PACKAGE.  See  plushsense publish --help")
    done = publish_dataset(
        args.dataset,
        args.out,
        **options(args, "licence", "contact", "consent", "save", "key", "bids", "seed", "thorough"),
        streams=not args.no_streams,
        excluded=args.allow_excluded,
        columns=tuple(listed(args.allow_columns)),
        reidentification=not args.no_reidentification,
        progress=report_stages(),
    )
    result = done.to_dict()
    if not args.json:
        for line in [*result["warnings"], *result["notes"]]:
            say(f"note: {line}")
    _print_problems(args, result["problems"])
    megabytes = f"{result['bytes'] / 1e6:.1f} MB"
    verdict = f"valid; {result['zip']}" if done.valid else f"not valid: {len(result['problems'])} problems, no zip"
    emit(args, result, f"{args.out}: {done.files} files, {megabytes}, {verdict}; {result['seconds']} s")
    return 0 if done.valid else 1


def _print_problems(args: argparse.Namespace, problems: list[dict[str, str]]) -> None:
    if args.json:
        return
    for p in problems[:_MOST_PROBLEMS]:
        say(f"{p['validator']}: {p['file'] or 'package'}: {p['problem']}")
    if len(problems) > _MOST_PROBLEMS:
        say(f"... and {len(problems) - _MOST_PROBLEMS} more; --json lists all")
