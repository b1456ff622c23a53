"""Sources to import, written here: session folders as `recording.sessionfile` fixes them, and XDF files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.recording.writer import SESSION_LOG, SIDECAR, SessionEvent, SessionHead
from support.requirements import installed
from support.xdf_files import XdfStream, write_xdf

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


XdfWriter = Callable[..., Path]


@pytest.fixture
def xdf_writer() -> XdfWriter:
    """Writes one XDF file; needs the reader to be there."""
    installed("pyxdf", "lsl")
    return write_xdf


@pytest.fixture
def parquet() -> None:
    """Parquet can be read and written."""
    installed("polars", "tables")


@pytest.fixture
def xdf_stream() -> type[XdfStream]:
    """A stream for `xdf_writer`."""
    return XdfStream
