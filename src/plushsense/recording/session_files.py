"""Files of a session's folder: head, event log, stream and recordings, which survive a crash.

session.json                     person, protocol and toy: `SessionHead`, replaced atomically
session.jsonl                    one `SessionEvent` per line, append-only
fulldatastream.csv               all frames of the toy, in the format of the authors' recorder
<label>_<epoch ms>_<rows>.csv    one recording each; beside it a sidecar of the same name that ends in .json

The folder of a person contains one folder for each session: ``OUT/<subject>/<session>/``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.toml import load_table, loads_json

SESSION_HEAD = "session.json"
SESSION_LOG = "session.jsonl"
SIDECAR = ".json"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class SessionHead:
    """Description of a session. ``subject`` is a code, never a name; ``protocol`` and ``layout`` are complete.

    ``consent`` is a reference to the signed form, not the form. ``simulated`` is whether the toy was a virtual one.
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
        """Write the head to ``folder``, completely or not at all."""
        text = json.dumps({"format": FORMAT_VERSION} | asdict(self), ensure_ascii=False, indent=1) + "\n"
        write_file(folder / SESSION_HEAD, text)

    @classmethod
    def read(cls, folder: Path) -> SessionHead | None:
        """Read the head of the session in ``folder``; None if there is none, DatasetError if it is damaged."""
        path = folder / SESSION_HEAD
        try:
            table = loads_json(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, RecursionError) as cause:
            raise DatasetError(
                "'{path}' cannot be read ({cause}): restore it from a copy.", path=path, cause=cause, name=folder.name
            ) from None
        if not isinstance(table, dict) or table.pop("format", None) != FORMAT_VERSION:
            raise DatasetError(
                "'{path}' is no session head of format {format_version}: update PlushSense, or restore the file.",
                path=path,
                format_version=FORMAT_VERSION,
                name=folder.name,
            )
        return load_table(table, cls, f"'{path}'", DatasetError)


@dataclass(frozen=True)
class SessionEvent:
    """Event of a session: its ``kind``, the computer's time ``at_ms``, and details.

    Kinds, with their details: ``open`` and ``close`` (a program opened or closed the session), ``countdown``
    (``gesture``, ``repetition``, ``countdown_s``), ``start`` (of a recording, with its first row), ``take`` (finished
    recording: ``file``, ``gesture``, ``repetition``), ``abandon`` (recording stopped on purpose, ``why``: redo, pause,
    exchange or quit; its rows are in the stream only), ``unfinished`` (stopped by a crash), ``redo`` (``file`` is
    discarded), ``keep`` (``file`` is used again), ``skip``, ``go`` (to another step), ``note``, ``pause``, ``resume``,
    ``exchange`` (another toy from ``row`` on: ``device``, ``former``), ``mark`` (a moment to find in a video:
    ``host_ms``, ``device_ms``), ``gap``, ``mended`` (repaired after a crash), ``failed``, ``finished`` (``early``:
    although steps are missing), ``reopened``, ``renamed`` (the person's code was changed; with the former ``subject``
    and ``session``). Readers ignore other kinds.
    """

    kind: str
    at_ms: int
    details: dict[str, Any] = field(default_factory=dict)

    def to_line(self) -> str:
        """Return the event as a line of the log."""
        return json.dumps({"what": self.kind, "at_ms": self.at_ms} | self.details, ensure_ascii=False) + "\n"


def read_events(folder: Path) -> Iterator[SessionEvent]:
    """Yield the events of the log in ``folder``, in order; skip lines that are incomplete because of a crash."""
    try:
        lines = (folder / SESSION_LOG).read_bytes().split(b"\n")
    except FileNotFoundError:
        return
    except OSError as cause:
        raise DatasetError(
            "'{path}' cannot be read: {why}.", path=folder / SESSION_LOG, why=cause.strerror or cause, name=folder.name
        ) from None
    for line in filter(None, lines):
        try:
            table = loads_json(line.decode("utf-8"))
            yield SessionEvent(str(table.pop("what")), int(table.pop("at_ms")), table)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            continue


def discarded_recordings(folder: Path) -> dict[str, str]:
    """Return the reason for each discarded recording of a session, by file name."""
    discarded: dict[str, str] = {}
    for event in read_events(folder):
        file = str(event.details.get("file") or "")
        if event.kind == "redo" and file:
            discarded[file] = str(event.details.get("why") or "recorded again")
        elif event.kind == "keep":
            discarded.pop(file, None)
    return discarded
