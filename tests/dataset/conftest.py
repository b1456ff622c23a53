"""Sources to import, written here: session folders as `recording.sessionfile` fixes them, and XDF files."""

from __future__ import annotations

import importlib.util
import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.recording.writer import SESSION_LOG, SIDECAR, SessionEvent, SessionHead
from support.requirements import missing

START_MS = 1_760_000_000_000
SessionWriter = Callable[..., Path]


def write_session(
    out: Path,
    subject: str = "P01",
    session: str = "s1",
    gestures: Sequence[str] = ("Tail pull", "Hold strong"),
    *,
    layout: Layout | None = None,
    seed: int = 0,
    redo: Sequence[int] = (),
    rows: int = 80,
    **said: object,
) -> Path:
    """One session: a stream of all gestures with 40 idle rows between, each gesture's recording with its sidecar.

    ``redo`` are the numbers of takes that the log says were made again.
    """
    layout = layout or load_layout("plush-15")
    folder = out / subject / session
    folder.mkdir(parents=True)
    total = 40 + len(gestures) * (rows + 40)
    clock = np.arange(total, dtype=np.int64) * 10
    begin = START_MS + seed * 1_000_000
    values = np.random.default_rng(seed).integers(0, 900, (total, layout.n_channels))
    stream = Frames(values, clock + 5_000, clock + begin)
    head = SessionHead(subject, session, begin, layout.to_dict(), {"name": "test"}, **said)  # type: ignore[arg-type]
    head.write(folder)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, layout), encoding="utf-8")
    events = []
    for number, gesture in enumerate(gestures):
        start = 40 + number * (rows + 40)
        part = stream.slice(start, start + rows)
        path = folder / recording_filename(gesture, begin + (start + rows) * 10, rows)
        write_recording(path, part, layout)
        path.with_suffix(SIDECAR).write_text(json.dumps({"gesture": gesture, "lost": 0}), encoding="utf-8")
        events.append(SessionEvent("take", begin + number, {"file": path.name, "gesture": gesture, "repetition": 1}))
        if number in redo:
            events.append(SessionEvent("redo", begin + number, {"file": path.name, "why": "sneezed"}))
    (folder / SESSION_LOG).write_text("".join(e.to_line() for e in events), encoding="utf-8")
    return folder


@pytest.fixture
def session_writer() -> SessionWriter:
    """Writes one session folder."""
    return write_session


@dataclass
class XdfStream:
    """A stream to write into an XDF file: ``samples`` are rows of numbers, or texts."""

    name: str
    times: Sequence[float]
    samples: Sequence[Any]
    format: str = "float32"
    labels: Sequence[str] = ()
    rate: float = 100.0
    offset: float = 0.0
    source: str = ""
    uid: str = ""

    @property
    def width(self) -> int:
        return len(self.samples[0]) if isinstance(self.samples[0], (list, tuple)) else 1

    def header(self) -> str:
        channels = "".join(f"<channel><label>{name}</label></channel>" for name in self.labels)
        return (
            f"<?xml version='1.0'?><info><name>{self.name}</name><type>x</type>"
            f"<channel_count>{self.width}</channel_count><nominal_srate>{self.rate}</nominal_srate>"
            f"<channel_format>{self.format}</channel_format><source_id>{self.source}</source_id><uid>{self.uid}</uid><desc><channels>{channels}</channels></desc></info>"
        )

    def sample(self, row: Any) -> bytes:
        if self.format == "string":
            texts = [str(text).encode() for text in (row if isinstance(row, (list, tuple)) else [row])]
            return b"".join(b"\x04" + struct.pack("<I", len(text)) + text for text in texts)
        return np.asarray(row, dtype={"float32": "<f4", "double64": "<f8", "int32": "<i4"}[self.format]).tobytes()


def xdf_chunk(tag: int, content: bytes) -> bytes:
    """A chunk: its length (of 4 bytes), tag and content."""
    return b"\x04" + struct.pack("<IH", len(content) + 2, tag) + content


def write_xdf(path: Path, streams: Sequence[XdfStream], at_once: int = 64) -> Path:
    """An XDF 1.0 file: header, stream headers, clock offsets, samples in chunks of ``at_once``, footers."""
    out = [b"XDF:", xdf_chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>")]
    for number, stream in enumerate(streams, 1):
        which = struct.pack("<I", number)
        out.append(xdf_chunk(2, which + stream.header().encode()))
        for time in (0.0, 1.0, 2.0):
            out.append(xdf_chunk(4, which + struct.pack("<dd", time, stream.offset)))
        for at in range(0, len(stream.samples), at_once):
            part = list(zip(stream.times, stream.samples, strict=True))[at : at + at_once]
            rows = b"".join(b"\x08" + struct.pack("<d", time) + stream.sample(row) for time, row in part)
            out.append(xdf_chunk(3, which + b"\x04" + struct.pack("<I", len(part)) + rows))
        out.append(xdf_chunk(6, which + b"<?xml version='1.0'?><info></info>"))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(out))
    return path


XdfWriter = Callable[..., Path]


def require(request: pytest.FixtureRequest, module: str, word: str) -> None:
    """Skip, or fail where PLUSHSENSE_REQUIRE names ``word``, when an optional package is not installed."""
    if importlib.util.find_spec(module) is None:
        missing(word, f"the package {module} is not installed")


@pytest.fixture
def xdf_writer(request: pytest.FixtureRequest) -> XdfWriter:
    """Writes one XDF file; needs the reader to be there."""
    require(request, "pyxdf", "lsl")
    return write_xdf


@pytest.fixture
def parquet(request: pytest.FixtureRequest) -> None:
    """Parquet can be read and written."""
    require(request, "polars", "tables")


@pytest.fixture
def xdf_stream() -> type[XdfStream]:
    """A stream for `xdf_writer`."""
    return XdfStream
