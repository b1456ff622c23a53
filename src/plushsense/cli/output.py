"""Print results on standard output and everything else on standard error."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from plushsense.core.errors import ConfigError, nearest, printable
from plushsense.jobs.progress import close_active
from plushsense.reports.table import Table


class Parser(argparse.ArgumentParser):
    """Argument parser that reports an error as a ConfigError, with the nearest known option as a hint."""

    words: Sequence[str] = ()

    def parse_args(self, args: Sequence[str], namespace: Any = None) -> argparse.Namespace:  # type: ignore[override]
        """Parse arguments as argparse does, and store them in order to suggest options if one is misspelt."""
        self.words = args
        parsed: argparse.Namespace = super().parse_args(args, namespace)
        return parsed

    def error(self, message: str) -> NoReturn:
        # If a required option is misspelt, argparse reports only that it is missing.
        known = [o for action in self._actions for o in action.option_strings]
        typed = [word.partition("=")[0] for word in self.words if word.startswith("--") and word != "--"]
        unknown = [word for word in typed if not any(option.startswith(word) for option in known)]
        hint = nearest(unknown[0], known) if unknown else ""
        if hint and "unrecognized" not in message:
            message = f"unknown option {unknown[0]}; {message}"
        raise ConfigError(f"{message[0].upper()}{message[1:]}.{hint} See  {self.prog} --help")


def utf8() -> None:
    """Set the encoding of standard output and standard error to UTF-8, regardless of the console's code page.

    What is no text, such as bytes in the name of a file, is escaped, in a way that is valid in JSON.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def say(text: str) -> None:
    """Print a message on standard error, with control characters escaped; ignore errors, such as a closed terminal."""
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(text, lines=True) + "\n")
        sys.stderr.flush()


def warn(sentence: str) -> None:
    """Print a warning on standard error."""
    say(f"warning: {printable(sentence)}")


def emit(args: argparse.Namespace, result: dict[str, Any], text: str | Iterable[str]) -> None:
    """Print the result on standard output: ``result`` as a JSON object with ``--json``, otherwise ``text``."""
    close_active()
    if args.json:
        write_line(json.dumps(result, ensure_ascii=False, allow_nan=False))
    else:
        write_line((text if isinstance(text, str) else "\n".join(text)).rstrip("\n"))


def write_line(text: str) -> None:
    """Print a text or JSON on standard output, with control characters, which a file may contain, escaped."""
    sys.stdout.write(printable(text, lines=True) + "\n")
    sys.stdout.flush()


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a plain-text table; align columns of numbers to the right."""
    return Table.of(head, rows).text()


def figure(value: float | None, digits: int = 3) -> str:
    """Format a score with ``digits`` decimal places, or as a dash if it is None."""
    return "-" if value is None else f"{value:z.{digits}f}"


def spread(score: dict[str, Any]) -> str:
    """Format mean, standard deviation and confidence interval, as in ``0.573 ± 0.120 (95 % 0.520 to 0.620)``."""
    mean, sd, ci = score["mean"], score["sd"], score.get("ci95")
    if mean is None:
        return "-"
    interval = f" (95 % {ci[0]:z.3f} to {ci[1]:z.3f})" if ci else ""
    return f"{mean:z.3f}" + ("" if sd is None else f" ± {sd:.3f}{interval}")
