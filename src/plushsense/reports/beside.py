"""The folder beside a page: a report's tables and figures, and a list of them, so that nothing else is touched."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from plushsense.core.errors import ConfigError

_LIST = "README.txt"
_LIST_HEAD = "Tables and figures of a PlushSense sweep report; `plushsense report` replaces the files named here."


def files_before(folder: Path) -> list[str]:
    """The files that an earlier report left in the folder.

    Raises:
        ConfigError: when the folder is something else.
    """
    if not folder.exists():
        return []
    try:
        lines = (folder / _LIST).read_text(encoding="utf-8").splitlines() if folder.is_dir() else []
        empty = folder.is_dir() and not any(folder.iterdir())
    except (OSError, ValueError):
        lines, empty = [], False
    if not empty and lines[:1] != [_LIST_HEAD]:
        raise ConfigError(f"'{folder}' is there and is not of a report of PlushSense: name another page.")
    return [name for name in lines[1:] if name and Path(name).name == name and name != _LIST]


def put_files(folder: Path, made: Mapping[str, bytes], before: Sequence[str]) -> None:
    """Write the files, each in one step, and take away those of an earlier report that this one has not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        listed = "\n".join([_LIST_HEAD, *sorted({*made, *before}), ""])
        _put(folder / _LIST, listed.encode())
        for name, content in made.items():
            _put(folder / name, content)
        for name in before:
            if name not in made:
                (folder / name).unlink(missing_ok=True)
        _put(folder / _LIST, "\n".join([_LIST_HEAD, *made, ""]).encode())
    except OSError as cause:
        raise ConfigError(
            f"The report's files cannot be written to '{folder}' ({cause.strerror}): name a page where you may write."
        ) from cause


def _put(path: Path, content: bytes) -> None:
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
