"""Telling the virtual toy's person what to do: a recorder's prompts, heard directly or read from a session's log."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Cue:
    """A gesture to make, and when its recording begins on the toy's clock (ms); None: as soon as it can be."""

    label: str
    begin_ms: int | None = None


Cues = Callable[[], Cue | None]
"""Asked again and again: the cue that came since the last time, the newest when there were several."""


class LogCues:
    """Cues from a session's log (``session.jsonl``) that a recorder is writing, from now on.

    The toy is told nothing over its line, so that a real one never hears bytes that it does not know. The file need
    not be there yet. Its ``countdown`` events say ``gesture``, ``device_ms`` and ``countdown_s``.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        try:
            self._at = self._path.stat().st_size
        except OSError:
            self._at = 0
        self._rest = b""

    def __call__(self) -> Cue | None:
        """The newest cue since the last call; None when there is none."""
        try:
            if self._path.stat().st_size <= self._at:
                return None
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
        except OSError:
            return None
        self._at += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        cue = None
        for line in lines:
            try:
                event = json.loads(line)
                if event["what"] == "countdown":
                    at = event.get("device_ms")
                    begin = None if at is None else int(at) + round(1000.0 * float(event.get("countdown_s", 0.0)))
                    cue = Cue(str(event["gesture"]), begin)
            except (ValueError, KeyError, TypeError):
                continue
        return cue
