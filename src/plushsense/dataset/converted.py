"""Files of other programs, laid out as the recorder would have left them: a stream, and recordings cut from it.

What is written here becomes the raw file of the data set. The original is not copied in (it may hold other devices,
dates and names, which nobody could take out again); ``origin.json`` beside the stream names it with its SHA-256.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import (
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    recording_filename,
    write_recording,
)
from plushsense.core.rows import LONGEST_LABEL
from plushsense.core.signal import HOST_MS, Layout
from plushsense.dataset.sources import COMPANIONS, Found
from plushsense.dataset.store import RECORDINGS, STREAMS

ORIGIN = "origin.json"
LARGEST = 2.0**53
# A channel that moves by few steps of its layout is of another scale, when its values lie between the steps.
_FEW_STEPS = 10.0
_BETWEEN = 0.05


@dataclass(frozen=True)
class Cut:
    """One recording: rows ``start`` to ``stop`` of the session's frames."""

    label: str
    start: int
    stop: int


@dataclass(frozen=True)
class Original:
    """The file that something was converted from, and what to say of it in ``origin.json``."""

    path: Path
    shown: str
    more: dict[str, Any]

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def to_json(self) -> str:
        """The text of ``origin.json``."""
        table = {"source": self.shown, "sha256": self.sha256} | self.more
        return json.dumps(table, ensure_ascii=False, indent=1) + "\n"


def whole_steps(values: NDArray[np.float64], layout: Layout) -> tuple[NDArray[np.int64], str]:
    """Values (T, C) in the layout's units as integer steps, and a sentence when these are too coarse for them."""
    steps = np.array([c.step for c in layout.channels])
    scaled = values / steps
    rounded = np.round(scaled)
    if not len(values):
        return rounded.astype(np.int64), ""
    between = np.mean(np.abs(scaled - rounded) > _BETWEEN, axis=0) > 0.1
    coarse = between & (np.std(scaled, axis=0) < _FEW_STEPS)
    odd = [f"'{n}'" for n, is_odd in zip(layout.names, coarse, strict=True) if is_odd]
    said = (
        f"{', '.join(odd)}: the values are small fractions of what layout '{layout.name}' counts in and were rounded "
        "to it: give a layout with a smaller step"
        if odd
        else ""
    )
    return np.clip(rounded, -LARGEST, LARGEST).astype(np.int64), said


def usable_rows(*columns: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Rows (T,) in which every value of every column is a number that a file can hold."""
    good = np.ones(len(columns[0]), dtype=bool)
    for column in columns:
        # NaN compares as false.
        fits = np.abs(column) < LARGEST
        good &= fits.all(axis=1) if fits.ndim == 2 else fits
    return good


def lay_out(
    folder: Path,
    subject: str,
    session: str,
    frames: Frames,
    cuts: Sequence[Cut],
    layout: Layout,
    original: Original,
    *,
    with_stream: bool,
) -> Iterator[Found]:
    """Write one session into the new ``folder``: its recordings, the stream if wanted, and ``origin.json``.

    A layout with a label on every row gets one stream that carries the labels, and no recordings of their own.
    """
    folder.mkdir(parents=True)
    where = f"{original.shown}: {subject}{f', session {session}' if session else ''}"
    main: Path | None = None
    if layout.is_labelled:
        apart = layout.csv.separator.strip() or " "
        written = [" ".join(cut.label.replace(apart, "_").split()) for cut in cuts]
        labels = np.full(len(frames), "", dtype=f"<U{max(map(len, written), default=1)}")
        for cut, label in zip(cuts, written, strict=True):
            labels[cut.start : cut.stop] = label
        frames = Frames(frames.values, frames.device_ms, frames.host_ms, labels)
        with_stream, cuts = True, ()
    if with_stream:
        main = folder / STREAM_NAME
        with main.open("w", encoding="utf-8", newline="\n") as file:
            if frames.labels is not None:
                file.write(format_header(layout))
            for start in range(0, len(frames), 20_000):
                file.write(format_rows(frames.slice(start, start + 20_000), layout))
        yield Found(main, STREAMS, subject, session=session, origin=f"{where}, the whole stream")
    written_paths: set[Path] = set()
    clock = frames.device_ms if frames.host_ms is None or HOST_MS not in layout.csv.columns else frames.host_ms
    for cut in cuts:
        name = f"{where}, rows {cut.start + 1} to {cut.stop} ('{cut.label[:40]}')"
        at_ms = abs(int(clock[cut.start]))
        # Recordings of one label and length whose clocks all begin at 0 would have one name.
        while (path := folder / recording_filename(cut.label, at_ms, cut.stop - cut.start)) in written_paths:
            at_ms += 1
        written_paths.add(path)
        if len(path.name.encode("utf-8")) > LONGEST_LABEL:
            yield Found(path, "", origin=name, reason="its label is too long for a file name")
            continue
        write_recording(path, frames.slice(cut.start, cut.stop), layout)
        yield Found(path, RECORDINGS, subject, session=session, origin=name)
    about = folder / ORIGIN
    about.write_text(original.to_json(), encoding="utf-8", newline="\n")
    yield Found(about, COMPANIONS, subject, session=session, origin=f"{where}, {ORIGIN}", beside=main)
