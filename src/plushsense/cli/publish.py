"""Implement ``plushsense publish DATASET OUT`` and ``plushsense publish --check PACKAGE``."""

from __future__ import annotations

import argparse

from plushsense.cli.options import options
from plushsense.cli.output import emit, say
from plushsense.cli.settings import listed, report_stages
from plushsense.core.errors import ConfigError

_MOST_PROBLEMS = 20


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
        **options(args, "licence", "contact", "consent", "save", "key", "seed", "thorough"),
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
