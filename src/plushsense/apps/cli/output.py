"""What verbs print: results on standard output, everything else on standard error."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from plushsense.core.errors import ConfigError, nearest

Progress = Callable[[int, int], None]


class Parser(argparse.ArgumentParser):
    """An argument parser whose refusals are PlushSense's: one sentence, the nearest known option, status 2."""

    words: Sequence[str] = ()

    def parse_args(self, args: Sequence[str], namespace: Any = None) -> argparse.Namespace:  # type: ignore[override]
        """As argparse does, remembering what was typed: a slip in an option's name is looked for there."""
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
    """What is printed is UTF-8, whatever the console's code page: names and labels are anybody's."""
    for stream, errors in ((sys.stdout, "strict"), (sys.stderr, "backslashreplace")):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors=errors)


def say(text: str) -> None:
    """A message for the person, on standard error; a terminal that was closed is no failure."""
    with contextlib.suppress(OSError):
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


def emit(args: argparse.Namespace, result: dict[str, Any], text: str | Iterable[str]) -> None:
    """The result: one JSON object with ``--json``, else text."""
    if args.json:
        sys.stdout.write(json.dumps(result, ensure_ascii=False, allow_nan=False) + "\n")
    else:
        sys.stdout.write((text if isinstance(text, str) else "\n".join(text)).rstrip("\n") + "\n")
    sys.stdout.flush()


def bar(what: str) -> Progress:
    """A progress bar on a terminal; elsewhere a line on standard error every few seconds."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        shown: tqdm[Any] | None = None

        def draw(done: int, total: int) -> None:
            nonlocal shown
            if shown is None:
                shown = tqdm(total=total, desc=what, leave=False, file=sys.stderr, dynamic_ncols=True)
            shown.total = total
            shown.update(done - shown.n)
            if done >= total:
                shown.close()
                shown = None

        return draw
    began = last = time.monotonic()

    def line(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= 5.0 or (done >= total and now - began >= 5.0):
            last = now
            say(f"{what}: {done} of {total}")

    return line


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A plain text table; numbers to the right."""
    cells = [[("" if v is None else str(v)) for v in row] for row in rows]
    widths = [max(len(h), *(len(r[i]) for r in cells), 0) if cells else len(h) for i, h in enumerate(head)]

    def right(i: int) -> bool:
        return bool(cells) and all(not r[i] or r[i][0].isdigit() or r[i][0] in "-±" for r in cells)

    def line(row: Sequence[str]) -> str:
        return "  ".join(
            c.rjust(w) if right(i) else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()

    return "\n".join([line(head), line(["-" * w for w in widths]), *map(line, cells)])
