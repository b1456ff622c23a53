"""Replay a recording or a session's stream like a connected toy."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from plushsense.core.errors import DeviceError, FileFormatError
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames, parse_name, read_recording, read_stream
from plushsense.devices.base import Frame, LossCounter, PacedDevice, now_ms
from plushsense.devices.opening import DeviceAddress

_BLOCK = 500


class ReplayDevice(PacedDevice):
    """A device that replays a file at ``speed`` times the pace of its device clock, or without waiting (0).

    ``host_ms`` of the frames is from the file, or the current time if it has none. ``warnings`` are from reading it.
    """

    def __init__(self, url: str, layout: Layout, path: Path, speed: float = 1.0) -> None:
        super().__init__(url, layout, speed)
        try:
            result = (read_recording if parse_name(path.name) else read_stream)(path, layout)
        except FileFormatError as cause:
            raise DeviceError("'{url}' cannot be replayed: {cause}", url=url, cause=cause) from None
        self.path = path
        self.warnings = result.warnings
        self.counters.malformed = result.malformed
        self._frames: Frames = result.frames
        self._at = 0
        self._loss = LossCounter()
        low, high = layout.valid_min_int, layout.valid_max_int
        self._garbage = np.any((result.frames.values < low) | (result.frames.values > high), axis=1)

    def _next_ms(self) -> int | None:
        return int(self._frames.device_ms[self._at]) if self._at < len(self._frames) else None

    def read(self) -> list[Frame] | None:
        """Return the frames that are due, waiting at most about ``wait_s``; return None at the end of the file."""
        frames: list[Frame] = []
        for device_ms in self._due(_BLOCK):
            at = self._at
            host = now_ms() if self._frames.host_ms is None else int(self._frames.host_ms[at])
            frames.append(Frame(host, device_ms, tuple(self._frames.values[at].tolist())))
            self.counters.frames += 1
            self.counters.garbage += int(self._garbage[at])
            self.counters.lost += self._loss.push(device_ms)
            self._at += 1
        return frames if frames or self._next_ms() is not None else None


def _path(place: str) -> Path:
    """Return the path in a URL: ``/C:/x.csv`` becomes a Windows path; ``%20`` a space, unless such a file exists."""
    text = place[1:] if re.match(r"/[A-Za-z]:[\\/]", place) else place
    return Path(text if Path(text).exists() else unquote(text)).expanduser()


def open_replay(address: DeviceAddress, layout: Layout) -> ReplayDevice:
    """Open ``replay:///path?speed=1``; for a folder, replay the stream in it."""
    address.check_keys(("speed",))
    speed = address.number("speed", 1.0)
    path = _path(address.place)
    if path.is_dir() and address.place:
        path = path / "fulldatastream.csv"
    if not address.place or not path.is_file():
        raise DeviceError(
            "'{url}': there is no file '{file}' to replay; give the path of a recording or of a fulldatastream.csv.",
            url=address.url,
            file=path if address.place else "",
        )
    return ReplayDevice(address.url, layout, path, speed)
