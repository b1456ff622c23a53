"""A clip as it lies on disk: a session of the protocol ``live``, and the recordings that were cut from its stream."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from plushsense.core.recfile import STREAM_NAME
from plushsense.core.signal import Layout
from plushsense.recording.sessionfile import SIDECAR, SessionHead, read_events

PROTOCOL = "live"
"""What the sessions of clips name as their protocol: nobody was asked for anything."""


@dataclass(frozen=True)
class Label:
    """A recording cut from a clip: rows ``first`` to before ``last`` of its stream."""

    file: str
    gesture: str
    first: int
    last: int


@dataclass(frozen=True)
class Clip:
    """One clip as it lies on disk. ``seconds``: by the toy's clock, or by its rate where a crash ended it. ``added``:
    names of the data sets that have its recordings, all so far."""

    folder: Path
    head: SessionHead
    rows: int
    seconds: float
    labels: tuple[Label, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """A name for pages: subject/session."""
        return f"{self.folder.parent.name}/{self.folder.name}"

    @property
    def layout(self) -> Layout:
        """Of its rows."""
        return Layout.from_dict(self.head.layout, f"layout of '{self.folder}'")


def read_clip(folder: Path) -> Clip | None:
    """The clip in a session's folder; None where it holds another session, or none.

    Raises:
        DatasetError: for a head that cannot be read.
    """
    head = SessionHead.read(folder)
    if head is None or head.protocol.get("name") != PROTOCOL:
        return None
    labels: dict[str, Label] = {}
    added: list[str] = []
    seconds: float | None = None
    for event in read_events(folder):
        more = event.more
        if event.what == "close" and isinstance(more.get("seconds"), int | float):
            seconds = float(more["seconds"])
        if event.what == "take":
            file, first = str(more.get("file")), _first_row(folder / str(more.get("file")))
            held = more.get("rows")
            last = first + (held if isinstance(held, int) else 0)
            labels[file] = Label(file, str(more.get("gesture")), first, last)
            added = []
        elif event.what == "added" and more.get("dataset") not in added:
            added.append(str(more.get("dataset")))
    stream = folder / STREAM_NAME
    rows = stream.read_bytes().count(b"\n") if stream.is_file() else 0
    if seconds is None:
        seconds = rows / Layout.from_dict(head.layout, f"layout of '{folder}'").rate_hz
    return Clip(folder, head, rows, seconds, tuple(labels.values()), tuple(added))


def _first_row(recording: Path) -> int:
    """Where in its session's stream a recording begins, as its sidecar says."""
    try:
        return int(json.loads(recording.with_suffix(SIDECAR).read_text(encoding="utf-8"))["stream_row"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0
