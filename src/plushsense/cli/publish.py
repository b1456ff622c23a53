"""Implement ``plushsense publish DATASET OUT [--without-metadata]`` and ``plushsense publish --check PACKAGE``."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import TYPE_CHECKING

from plushsense.cli.options import options
from plushsense.cli.output import emit, say
from plushsense.cli.settings import report_stages
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural

if TYPE_CHECKING:
    from plushsense.dataset.publishing.checking import ValidationResult
    from plushsense.workflow.datasets import PublishSpec

_MOST_PROBLEMS = 20


def run(args: argparse.Namespace) -> int:
    return _check(args) if args.check else _publish(args)


def _check(args: argparse.Namespace) -> int:
    from plushsense.dataset.publishing.checking import validate_package

    if args.dataset:
        raise ConfigError("Give either DATASET OUT, or --check PACKAGE, not both.")
    checked = validate_package(args.check)
    _print_problems(args, checked)
    verdict = "valid" if checked.valid else f"not valid: {len(checked.problems)} problems"
    emit(args, {"package": args.check, **checked.to_dict()}, f"{args.check}: {verdict}")
    return 0 if checked.valid else 1


def _publish(args: argparse.Namespace) -> int:
    from plushsense.workflow.datasets import PublishSpec, publish_dataset, share_copy

    if not args.dataset or not args.out:
        raise ConfigError("Publishing needs DATASET and OUT, or --check PACKAGE.  See  plushsense publish --help")
    spec = PublishSpec(
        **options(args, "licence", "contact", "consent", "save", "key", "pseudonyms"),
        streams=not args.no_streams,
        excluded=args.allow_excluded,
        reidentification=not args.no_reidentification,
    )
    if args.without_metadata:
        copy = share_copy(args.dataset, args.out, spec, report_stages())
        _print_notes(args, copy.notes)
        text = f"{args.out}: {plural(len(copy.dataset.recordings), 'recording')} with shifted times"
        emit(args, copy.to_dict(), [text, *_about_key(spec)])
        return 0
    done = publish_dataset(args.dataset, args.out, spec, report_stages())
    _print_notes(args, [*done.warnings, *done.description.notes])
    _print_problems(args, done.checked)
    verdict = f"valid; {done.zip}" if done.valid else f"not valid: {len(done.checked.problems)} problems, no zip"
    text = f"{args.out}: {done.files} files, {done.bytes / 1e6:.1f} MB, {verdict}; {done.seconds:.1f} s"
    emit(args, done.to_dict(), [text, *_about_key(spec)])
    return 0 if done.valid else 1


def _about_key(spec: PublishSpec) -> list[str]:
    if not spec.pseudonyms:
        return []
    return [f"The codes of the people are in {spec.key}: store it apart from the data, and never publish it."]


def _print_notes(args: argparse.Namespace, notes: Iterable[str]) -> None:
    for line in () if args.json else notes:
        say(f"note: {line}")


def _print_problems(args: argparse.Namespace, checked: ValidationResult) -> None:
    if args.json:
        return
    for p in checked.problems[:_MOST_PROBLEMS]:
        say(f"{p.validator}: {p.file or 'package'}: {p.problem}")
    if len(checked.problems) > _MOST_PROBLEMS:
        say(f"... and {len(checked.problems) - _MOST_PROBLEMS} more; --json lists all")
