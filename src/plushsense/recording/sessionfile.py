"""A session's folder: who was recorded, by which protocol, and what happened, as files that survive a crash.

session.json                     who, which protocol, which toy: `SessionHead`, replaced atomically
session.jsonl                    what happened, one `Event` a line, append-only
fulldatastream.csv               everything the toy sent, as the authors' recorder keeps it
<label>_<epoch ms>_<rows>.csv    one recording each, and beside it a sidecar of the same name that ends in .json

The folder of a person holds one folder a session: ``OUT/<subject>/<session>/``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.tomlfile import refuse_unknown

SESSION_HEAD = "session.json"
SESSION_LOG = "session.jsonl"
SIDECAR = ".json"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class SessionHead:
    """Whose session this is. ``subject`` is a code, never a name; ``protocol`` and ``layout`` are kept in full.

    ``consent`` is a reference to the signed form, not the form. ``simulated``: the toy was the virtual one.
    """

    subject: str
    session: str
    started_ms: int
    layout: dict[str, Any]
    protocol: dict[str, Any]
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    device: str = ""
    software: str = ""
    simulated: bool = False

    def write(self, folder: Path) -> None:
        """Put the head into ``folder``, whole or not at all."""
        path = folder / SESSION_HEAD
        part = path.with_name(f"{SESSION_HEAD}.{os.getpid()}.part")
        text = json.dumps({"format": FORMAT_VERSION} | asdict(self), ensure_ascii=False, indent=1) + "\n"
        with part.open("w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)

    @classmethod
    def read(cls, folder: Path) -> SessionHead | None:
        """The head of the session in ``folder``; None where there is none.

        Raises:
            DatasetError: for a head that is damaged or of another format.
        """
        path = folder / SESSION_HEAD
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, RecursionError) as cause:
            raise DatasetError(f"'{path}' cannot be read ({cause}): bring it back from a copy.") from None
        if not isinstance(table, dict) or table.pop("format", None) != FORMAT_VERSION:
            raise DatasetError(f"'{path}' is no session head of format {FORMAT_VERSION}: check which version wrote it.")
        refuse_unknown(table, cls.__dataclass_fields__, f"'{path}'", DatasetError)
        kinds: dict[str, type] = {"int": int, "bool": bool, "str": str}
        for f in fields(cls):
            wanted = kinds.get(str(f.type), dict)
            if f.name in table and type(table[f.name]) is not wanted:
                raise DatasetError(
                    f"'{path}': {f.name} is {table[f.name]!r}; it must be of the kind {wanted.__name__}."
                )
        try:
            return cls(**table)
        except TypeError as cause:
            raise DatasetError(f"'{path}' lacks something: {cause}.") from None


@dataclass(frozen=True)
class Event:
    """One thing that happened: ``what`` in a word, ``at_ms`` by the computer's clock, and its particulars.

    ``open`` and ``close`` (a program took the session up, and left it), ``countdown`` (``gesture``, ``repetition``,
    ``countdown_s``), ``start`` (the first row), ``take`` (finished: ``file``, ``gesture``, ``repetition``),
    ``abandon`` (broken off on purpose: its rows are in the stream only), ``unfinished`` (broken off by a crash),
    ``redo`` (``file``: that recording is not to be used), ``keep`` (``file``: it is after all), ``skip``, ``go`` (back
    to another recording), ``note``, ``pause``, ``resume``, ``gap``, ``mended`` (what a crash had left), ``failed``,
    ``finished``. A reader passes over words that it does not know.
    """

    what: str
    at_ms: int
    more: dict[str, Any] = field(default_factory=dict)

    def to_line(self) -> str:
        """The event as a line of the log."""
        return json.dumps({"what": self.what, "at_ms": self.at_ms} | self.more, ensure_ascii=False) + "\n"


def read_events(folder: Path) -> Iterator[Event]:
    """What the log in ``folder`` says, in order; a line that a crash tore is passed over."""
    try:
        lines = (folder / SESSION_LOG).read_bytes().split(b"\n")
    except FileNotFoundError:
        return
    except OSError as cause:
        raise DatasetError(f"'{folder / SESSION_LOG}' cannot be read: {cause.strerror or cause}.") from None
    for line in filter(None, lines):
        try:
            table = json.loads(line.decode("utf-8"))
            yield Event(str(table.pop("what")), int(table.pop("at_ms")), table)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            continue


def set_aside(folder: Path) -> dict[str, str]:
    """Recordings of a session that are not to be used, by file name, with the reason: those that were made again."""
    aside: dict[str, str] = {}
    for event in read_events(folder):
        file = str(event.more.get("file") or "")
        if event.what == "redo" and file:
            aside[file] = str(event.more.get("why") or "recorded again")
        elif event.what == "keep":
            aside.pop(file, None)
    return aside
