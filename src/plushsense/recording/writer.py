"""Putting a session on disk so that a crash, a pulled plug or a full disk takes at most the last second of it.

Whatever is said to be written has been handed to the disk (fsync), the folder's entry too. Every function here raises
OSError when the disk refuses; the stream is then cut back to its last whole line.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.recfile import Frames, format_rows, recording_filename, write_recording
from plushsense.core.signal import DELAY_MS, Layout
from plushsense.devices.base import Frame
from plushsense.recording.sessionfile import SESSION_LOG, SIDECAR, Event

PART, NEW = ".part", ".new"
"""How files end that are not whole yet; what a crash leaves of them is removed, their rows are in the stream."""


def to_frames(frames: Sequence[Frame], channels: int) -> Frames:
    """Frames of a toy as rows: ``values`` (T, channels)."""
    values = np.array([f.values for f in frames], dtype=np.int64).reshape(len(frames), channels)
    return Frames(
        values,
        np.array([f.device_ms for f in frames], dtype=np.int64),
        np.array([f.host_ms for f in frames], dtype=np.int64),
    )


def sync_folder(folder: Path) -> None:
    """Make the names in a folder as lasting as the files; Windows does so by itself."""
    if os.name == "posix":
        at = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(at)
        finally:
            os.close(at)


class AppendedFile:
    """A file that only grows, by whole lines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("ab", buffering=0)
        self._good = self._file.seek(0, os.SEEK_END)

    def append(self, data: bytes) -> None:
        """Append lines and hand them to the disk; on OSError the file is as it was before."""
        try:
            left = memoryview(data)
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError:
            # A disk without room still lets go of what it had begun.
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fileno(), self._good)
            raise
        self._good += len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class StreamFile(AppendedFile):
    """``fulldatastream.csv``: everything the toy sent, in the columns of the authors' recorder, without header."""

    def __init__(self, path: Path, layout: Layout) -> None:
        super().__init__(path)
        self.layout = layout
        # Delays refer to the row before: its frame is kept, so that pieces join without a seam.
        self._overlap = DELAY_MS in layout.csv.columns
        self._last: Frame | None = None

    def write(self, frames: Sequence[Frame]) -> None:
        """Append these frames."""
        if not frames:
            return
        before = [self._last] if self._overlap and self._last is not None else []
        text = format_rows(to_frames([*before, *frames], self.layout.n_channels), self.layout)
        self.append((text.split("\n", 1)[1] if before else text).encode())
        self._last = frames[-1]


class LogFile(AppendedFile):
    """``session.jsonl``: what happened, one event a line."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / SESSION_LOG)

    def write(self, events: Iterable[Event]) -> None:
        """Append these events."""
        if data := "".join(e.to_line() for e in events).encode():
            self.append(data)


def save_take(
    folder: Path, frames: Frames, layout: Layout, gesture: str, saved_ms: int, sidecar: dict[str, Any]
) -> Path:
    """Write one recording and its sidecar, each whole or not at all; nothing is ever replaced.

    The sidecar comes first: a recording is what has its CSV, so a crash between the two leaves no recording without
    its sidecar, and a sidecar alone says nothing (it is removed when the session is opened again).

    Returns:
        The CSV, named by gesture, time of saving and rows as the authors' recorder does.
    """
    path = folder / recording_filename(gesture, saved_ms, len(frames))
    while path.exists():
        saved_ms += 1
        path = folder / recording_filename(gesture, saved_ms, len(frames))
    beside, fresh = path.with_suffix(SIDECAR), path.with_name(path.name + NEW)
    part = beside.with_name(beside.name + PART)
    done = False
    try:
        text = json.dumps({"file": path.name} | sidecar, ensure_ascii=False, indent=1) + "\n"
        part.write_text(text, encoding="utf-8", newline="\n")
        _sync(part)
        os.replace(part, beside)
        write_recording(fresh, frames, layout)
        _sync(fresh)
        sync_folder(folder)
        os.replace(fresh, path)
        done = True
        sync_folder(folder)
    finally:
        if not done:
            for left in (part, beside, fresh, fresh.with_name(fresh.name + PART)):
                with contextlib.suppress(OSError):
                    left.unlink(missing_ok=True)
    return path


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
