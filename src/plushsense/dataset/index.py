"""The index of a data set: made anew from the raw files and the marks, whenever either changed."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.core.recfile import Frames, ReadResult, parse_name, read_recording, read_stream
from plushsense.dataset.marks import MARKS, Standing, read_marks
from plushsense.dataset.quality import Subject, findings, measured_rate_hz
from plushsense.dataset.store import (
    RECORDINGS,
    STREAMS,
    Dataset,
    DatasetHead,
    RecordingInfo,
    StreamInfo,
    read_index,
    write_index,
)

RECORDINGS_INDEX = "recordings.csv"
STREAMS_INDEX = "streams.csv"
Progress = Callable[[int, int], None]


@dataclass
class _Read:
    path: Path
    subject: str
    result: ReadResult
    sha256: str


@dataclass
class Rebuilt:
    """What came of rebuilding: files that could not be read, with the reason."""

    dataset: Dataset
    unreadable: dict[str, str] = field(default_factory=dict)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def open_dataset(path: str | Path) -> Dataset:
    """Open a data set folder; the index is rebuilt when it is missing or older than the marks.

    Raises:
        DatasetError: when the folder is missing, empty, or not a data set.
    """
    folder = Path(path)
    head = DatasetHead.read(folder)
    index, streams = folder / RECORDINGS_INDEX, folder / STREAMS_INDEX
    marks = folder / MARKS
    stale = not index.is_file() or not streams.is_file()
    if not stale and marks.is_file() and marks.stat().st_mtime_ns > index.stat().st_mtime_ns:
        stale = True
    if stale:
        return rebuild(folder, head).dataset
    return Dataset(folder, head, read_index(index, RecordingInfo), read_index(streams, StreamInfo))


def rebuild(folder: Path, head: DatasetHead | None = None, progress: Progress | None = None) -> Rebuilt:
    """Read every raw file, locate the recordings in their streams, apply the marks, and replace the index."""
    head = head or DatasetHead.read(folder)
    files = [(kind, p) for kind in (STREAMS, RECORDINGS) for p in sorted((folder / kind).rglob("*.csv"))]
    unreadable: dict[str, str] = {}
    streams: list[_Read] = []
    recordings: list[_Read] = []
    for done, (kind, path) in enumerate(files):
        reader = read_stream if kind == STREAMS else read_recording
        relative = path.relative_to(folder).as_posix()
        try:
            read = _Read(path, path.relative_to(folder / kind).parts[0], reader(path, head.layout), sha256_of(path))
        except FileFormatError as cause:
            unreadable[relative] = str(cause)
            continue
        (streams if kind == STREAMS else recordings).append(read)
        if progress is not None:
            progress(done + 1, len(files))
    infos = [*_from_files(folder, head, recordings, streams), *_from_labels(folder, head, streams)]
    infos = _with_marks(infos, read_marks(folder))
    infos.sort(key=lambda r: r.id)
    stream_infos = [_stream_info(folder, head, s) for s in streams]
    write_index(folder / STREAMS_INDEX, stream_infos, StreamInfo)
    write_index(folder / RECORDINGS_INDEX, infos, RecordingInfo)
    return Rebuilt(Dataset(folder, head, infos, stream_infos), unreadable)


def _stream_id(folder: Path, read: _Read) -> str:
    return read.path.relative_to(folder / STREAMS).with_suffix("").as_posix()


def _stream_info(folder: Path, head: DatasetHead, read: _Read) -> StreamInfo:
    frames = read.result.frames
    steps = np.diff(frames.device_ms)
    broken = (steps < 0) | (steps > head.layout.gap_ms)
    said = findings(Subject(frames, head.layout, None, None))
    return StreamInfo(
        id=_stream_id(folder, read),
        subject=read.subject,
        session="1",
        file=read.path.relative_to(folder).as_posix(),
        rows=len(frames),
        seconds=float(steps[~broken].sum()) / 1000.0,
        restarts=int(broken.sum()),
        flags=tuple(read.result.warnings + said),
        sha256=read.sha256,
    )


def _locate(frames: Frames, stream: Frames, at: dict[int, list[int]]) -> tuple[int, int]:
    """Row of the stream at which a recording begins, and how many of its rows follow there; (−1, 0) when absent."""
    stamps = frames.device_ms if frames.host_ms is None or stream.host_ms is None else frames.host_ms
    best = (-1, 0)
    for row in at.get(int(stamps[0]), ()):
        n = min(len(frames), len(stream) - row)
        same = (frames.device_ms[:n] == stream.device_ms[row : row + n]) & (
            frames.values[:n] == stream.values[row : row + n]
        ).all(axis=1)
        # Rows that the host stamped alike may be missing from one of the two files: the start decides.
        agreeing = int(np.argmin(same)) if not same.all() else n
        if agreeing > best[1]:
            best = (row, agreeing)
    return best


def _usual_rows(reads: Iterable[tuple[str, int]]) -> dict[str, float]:
    rows: dict[str, list[int]] = {}
    for gesture, n in reads:
        rows.setdefault(gesture, []).append(n)
    return {gesture: float(np.median(ns)) for gesture, ns in rows.items()}


def _from_files(folder: Path, head: DatasetHead, recordings: list[_Read], streams: list[_Read]) -> list[RecordingInfo]:
    named = []
    for read in recordings:
        name = parse_name(read.path.name)
        if name is None:
            raise DatasetError(
                f"'{read.path}' is not named <label>_<epoch ms>_<rows>.csv: move it out of {RECORDINGS}/."
            )
        found = head.gestures.find(name.label)
        named.append((read, name, found.label if found else name.label))
    usual = _usual_rows((label, len(read.result.frames)) for read, _, label in named)
    by_subject: dict[str, list[_Read]] = {}
    for stream in streams:
        by_subject.setdefault(stream.subject, []).append(stream)
    # Duplicates are by content: the first in name order is the original.
    originals: dict[str, str] = {}
    lookups = {id(s): _row_lookup(s.result.frames) for s in streams}
    infos = []
    for read, name, label in named:
        frames = read.result.frames
        identity = read.path.relative_to(folder / RECORDINGS).with_suffix("").as_posix()
        flags = read.result.warnings + findings(Subject(frames, head.layout, name.rows, usual[label]))
        known = head.gestures.find(name.label)
        if known is None or (known.affect == "none" and not head.gestures.inferred):
            flags.append(f"its label '{name.label}' is not in the gesture set '{head.gestures.name}': no affect")
        if read.sha256 in originals:
            flags.append(f"the same content as {originals[read.sha256]}")
        originals.setdefault(read.sha256, identity)
        stream_id, stream_row = "", -1
        candidates = by_subject.get(read.subject, [])
        for stream in candidates:
            row, rows = _locate(frames, stream.result.frames, lookups[id(stream)])
            if row >= 0:
                stream_id, stream_row = _stream_id(folder, stream), row
                if rows < len(frames):
                    flags.append(f"only its first {rows} rows are in the session's stream")
                break
        if candidates and stream_row < 0:
            flags.append("not found in the session's stream")
        infos.append(
            RecordingInfo(
                id=identity,
                subject=read.subject,
                session="1",
                gesture=label,
                file=read.path.relative_to(folder).as_posix(),
                first_row=0,
                rows=len(frames),
                start=0,
                stop=len(frames),
                stream=stream_id,
                stream_row=stream_row,
                start_ms=int(frames.device_ms[0]),
                epoch_ms=int(frames.host_ms[0]) if frames.host_ms is not None else name.epoch_ms,
                rate_hz=measured_rate_hz(frames),
                excluded=False,
                flags=tuple(flags),
                sha256=read.sha256,
            )
        )
    return infos


def _row_lookup(frames: Frames) -> dict[int, list[int]]:
    stamps = frames.device_ms if frames.host_ms is None else frames.host_ms
    at: dict[int, list[int]] = {}
    for row, stamp in enumerate(stamps.tolist()):
        at.setdefault(stamp, []).append(row)
    return at


def _from_labels(folder: Path, head: DatasetHead, streams: list[_Read]) -> list[RecordingInfo]:
    """Recordings of streams that carry a label on every row: one for each run of equal labels."""
    infos = []
    for read in streams:
        labels = read.result.frames.labels
        if labels is None:
            continue
        frames = read.result.frames
        edges = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), len(labels)]
        for number, (first, last) in enumerate(itertools.pairwise(edges)):
            said = str(labels[first])
            found = head.gestures.find(said)
            label = found.label if found else said
            part = frames.slice(first, last)
            flags = findings(Subject(part, head.layout, None, None))
            infos.append(
                RecordingInfo(
                    id=f"{_stream_id(folder, read)}#{number:03d} {label}",
                    subject=read.subject,
                    session=_stream_id(folder, read).rsplit("/", 1)[-1],
                    gesture=label,
                    file=read.path.relative_to(folder).as_posix(),
                    first_row=first,
                    rows=last - first,
                    start=0,
                    stop=last - first,
                    stream=_stream_id(folder, read),
                    stream_row=first,
                    start_ms=int(part.device_ms[0]),
                    epoch_ms=int(part.host_ms[0]) if part.host_ms is not None else int(part.device_ms[0]),
                    rate_hz=measured_rate_hz(part),
                    excluded=False,
                    flags=tuple(flags),
                    sha256=read.sha256,
                )
            )
    return infos


def _with_marks(infos: list[RecordingInfo], marks: dict[str, Standing]) -> list[RecordingInfo]:
    out = []
    for info in infos:
        mark = marks.get(info.id)
        if mark is not None:
            stop = info.rows if mark.stop < 0 else min(mark.stop, info.rows)
            values = {
                **info.__dict__,
                "excluded": mark.excluded,
                "start": min(mark.start, stop),
                "stop": stop,
            }
            info = RecordingInfo(**values)
        out.append(info)
    return out
