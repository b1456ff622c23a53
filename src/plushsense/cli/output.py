"""Print results on standard output and everything else on standard error."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from plushsense.core.errors import ConfigError, nearest
from plushsense.jobs.progress import close_active
from plushsense.reports.table import Table


class Parser(argparse.ArgumentParser):
    """An argument parser whose refusals are PlushSense's: one sentence, the nearest known option, status 2."""

    words: Sequence[str] = ()

    def parse_args(self, args: Sequence[str], namespace: Any = None) -> argparse.Namespace:  # type: ignore[override]
        """Parse as argparse does; keep the words for suggestions about misspelt options."""
        self.words = args
        parsed: argparse.Namespace = super().parse_args(args, namespace)
        return parsed

    def error(self, message: str) -> NoReturn:
        # An option misspelt is also one that is missing, which argparse notices first.
        known = [o for action in self._actions for o in action.option_strings]
        typed = [word.partition("=")[0] for word in self.words if word.startswith("--") and word != "--"]
        unknown = [word for word in typed if not any(option.startswith(word) for option in known)]
        hint = nearest(unknown[0], known) if unknown else ""
        if hint and "unrecognized" not in message:
            message = f"unknown option {unknown[0]}; {message}"
        raise ConfigError(f"{message[0].upper()}{message[1:]}.{hint} See  {self.prog} --help")


def utf8() -> None:
    """Set the output to UTF-8, whatever the console's code page."""
    for stream, errors in ((sys.stdout, "strict"), (sys.stderr, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors=errors)


def say(text: str) -> None:
    """Print a message on standard error; a closed terminal is no error."""
    with contextlib.suppress(OSError):
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


def emit(args: argparse.Namespace, result: dict[str, Any], text: str | Iterable[str]) -> None:
    """Print the result: one JSON object with ``--json``, else text."""
    close_active()
    if args.json:
        sys.stdout.write(json.dumps(result, ensure_ascii=False, allow_nan=False) + "\n")
    else:
        sys.stdout.write((text if isinstance(text, str) else "\n".join(text)).rstrip("\n") + "\n")
    sys.stdout.flush()


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a plain text table; numbers to the right."""
    return Table.of(head, rows).text()
