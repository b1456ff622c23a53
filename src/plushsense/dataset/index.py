"""The index of a data set: made anew from the raw files and the marks, whenever either changed."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.core.gestures import NOBODY, Gesture, plain_label
from plushsense.core.recfile import Frames, ReadResult, parse_name, read_bytes, read_recording, read_stream
from plushsense.dataset.freshness import (
    RECORDINGS_INDEX,
    STAMP,
    STREAMS_INDEX,
    is_fresh,
    missing_files,
    raw_files,
    same_files,
    taken,
    write_stamp,
)
from plushsense.dataset.marks import Standing, read_marks
from plushsense.dataset.quality import Examined, findings, measured_rate_hz, usual_rows
from plushsense.dataset.quality.finding import PARTLY_THERE
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


def open_dataset(path: str | Path) -> Dataset:
    """Open a data set folder; the index is made anew when the raw files, the marks or the head changed since.

    On a disk that cannot be written the index is made in memory each time it is out of date.

    Raises:
        DatasetError: when the folder is missing, empty, or not a data set, or a raw file is gone or cannot be read
            any more.
    """
    folder = Path(path)
    head = DatasetHead.read(folder)
    try:
        if is_fresh(folder):
            return Dataset(
                folder,
                head,
                read_index(folder / RECORDINGS_INDEX, RecordingInfo),
                read_index(folder / STREAMS_INDEX, StreamInfo),
            )
        if missing := missing_files(folder):
            raise DatasetError(
                f"'{folder}' lacks {len(missing)} raw file{'s' if len(missing) > 1 else ''} that it had "
                f"('{missing[0]}'): bring them back, or delete {STAMP} there to go on without them."
            )
        stamp = taken(folder)
        # A decision changes no raw file: the index stays, and only the marks are laid over it anew.
        built = _remarked(folder, head) if same_files(folder, stamp) else build(folder, head)
    except OSError as cause:
        raise DatasetError(f"'{folder}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    if built.unreadable:
        file, reason = next(iter(built.unreadable.items()))
        raise DatasetError(
            f"'{folder / file}' can no longer be read"
            f"{f', nor can {len(built.unreadable) - 1} other files' if len(built.unreadable) > 1 else ''}: "
            f"bring it back, or take it out of the data set. {reason}"
        )
    # A read-only disk: the index is only there to be fast.
    with contextlib.suppress(OSError):
        write(built.dataset, stamp)
    return built.dataset


def _remarked(folder: Path, head: DatasetHead) -> Rebuilt:
    """The index on disk with the marks as they stand; for raw files that are as they were when it was made."""
    bare = [
        replace(r, start=0, stop=r.rows, excluded=False) for r in read_index(folder / RECORDINGS_INDEX, RecordingInfo)
    ]
    streams = read_index(folder / STREAMS_INDEX, StreamInfo)
    return Rebuilt(Dataset(folder, head, with_marks(bare, read_marks(folder)), streams))


def rebuild(folder: Path, head: DatasetHead | None = None, progress: Progress | None = None) -> Rebuilt:
    """Make the index anew; while a raw file cannot be read, the index on disk is left as it is."""
    stamp = taken(folder)
    built = build(folder, head or DatasetHead.read(folder), progress)
    if not built.unreadable:
        write(built.dataset, stamp)
    return built


def write(dataset: Dataset, stamp: dict[str, Any] | None = None) -> None:
    """Replace the index files by what ``dataset`` holds; ``stamp`` is what was `taken` before the raw files were read.

    Raises:
        OSError: when the disk refuses.
    """
    stamp = stamp or taken(dataset.path)
    write_index(dataset.path / STREAMS_INDEX, dataset.streams, StreamInfo)
    write_index(dataset.path / RECORDINGS_INDEX, dataset.recordings, RecordingInfo)
    write_stamp(dataset.path, stamp)


def build(folder: Path, head: DatasetHead, progress: Progress | None = None) -> Rebuilt:
    """Read every raw file, locate the recordings in their streams and apply the marks; nothing is written."""
    files = raw_files(folder)
    unreadable: dict[str, str] = {}
    streams: list[_Read] = []
    recordings: list[_Read] = []
    for done, (kind, path) in enumerate(files):
        reader = read_stream if kind == STREAMS else read_recording
        relative = path.relative_to(folder).as_posix()
        try:
            data = read_bytes(path)
            result = reader(path, head.layout, data)
            read = _Read(path, path.relative_to(folder / kind).parts[0], result, hashlib.sha256(data).hexdigest())
        except FileFormatError as cause:
            unreadable[relative] = str(cause)
            continue
        (streams if kind == STREAMS else recordings).append(read)
        if progress is not None:
            progress(done + 1, len(files))
    infos = [*_from_files(folder, head, recordings, streams), *_from_labels(folder, head, streams)]
    infos = with_marks(infos, read_marks(folder))
    infos.sort(key=lambda r: r.id)
    return Rebuilt(Dataset(folder, head, infos, [_stream_info(folder, head, s) for s in streams]), unreadable)


AGAIN = "again-"


def _session(relative: Path, labelled: bool = False) -> str:
    """The session of a raw file by its path below ``recordings/`` or ``streams/``: the folder in the person's.

    Without one it is 1; but streams with labels lie side by side, and each is a session by its own name.
    """
    inner = relative.parts[1:-1]
    if inner and not inner[0].startswith(AGAIN):
        return inner[0]
    return relative.stem if labelled else "1"


def _stream_session(folder: Path, read: _Read) -> str:
    return _session(read.path.relative_to(folder / STREAMS), read.result.frames.labels is not None)


def _subject(folder_name: str, gesture: Gesture | None) -> str:
    """Whose a recording is: its folder's person, but nobody's where the gesture is made by nobody."""
    return NOBODY if gesture is not None and gesture.nobody else folder_name


def _stream_id(folder: Path, read: _Read) -> str:
    return read.path.relative_to(folder / STREAMS).with_suffix("").as_posix()


def _stream_info(folder: Path, head: DatasetHead, read: _Read) -> StreamInfo:
    frames = read.result.frames
    steps = np.diff(frames.device_ms)
    broken = (steps < 0) | (steps > head.layout.gap_ms)
    said = findings(Examined(frames, head.layout, None, None, stream=True))
    return StreamInfo(
        id=_stream_id(folder, read),
        subject=read.subject,
        session=_stream_session(folder, read),
        file=read.path.relative_to(folder).as_posix(),
        rows=len(frames),
        seconds=float(steps[~broken].sum()) / 1000.0,
        restarts=int(broken.sum()),
        flags=tuple(read.result.warnings + said),
        sha256=read.sha256,
    )


def _locate(recording: ReadResult, stream: ReadResult, at: _RowLookup) -> tuple[int, int]:
    """Row of the stream at which a recording begins, and how many of its rows follow there; (−1, 0) when absent."""
    frames, whole = recording.frames, stream.frames
    # Delays that were added up begin at 0 in every file: only their differences can be compared.
    relative = recording.integrated or stream.integrated
    rows: Iterable[int]
    if frames.host_ms is not None and whole.host_ms is not None:
        rows = at.at(int(frames.host_ms[0]))
    elif whole.host_ms is None and not relative:
        rows = at.at(int(frames.device_ms[0]))
    else:
        rows = np.flatnonzero((whole.values == frames.values[0]).all(axis=1)).tolist()
    best = (-1, 0)
    for row in rows:
        n = min(len(frames), len(whole) - row)
        shift = int(whole.device_ms[row] - frames.device_ms[0]) if relative else 0
        same = (frames.device_ms[:n] + shift == whole.device_ms[row : row + n]) & (
            frames.values[:n] == whole.values[row : row + n]
        ).all(axis=1)
        # Rows that the host stamped alike may be missing from one of the two files: the start decides.
        agreeing = int(np.argmin(same)) if not same.all() else n
        if agreeing > best[1]:
            best = (row, agreeing)
    return best


def _best_stream(
    folder: Path, recording: _Read, session: str, streams: Iterable[_Read], lookups: dict[int, _RowLookup]
) -> tuple[_Read | None, int, int]:
    """The person's stream that holds most of a recording, its row there, and how many rows follow; (None, −1, 0).

    The session's own first. Another session's only if it holds all of it: a day that begins with the same stamps is
    not where the recording was made.
    """
    best: tuple[_Read | None, int, int] = (None, -1, 0)
    for own in (True, False):
        for stream in streams:
            if (_stream_session(folder, stream) == session) is not own:
                continue
            row, rows = _locate(recording.result, stream.result, lookups[id(stream)])
            if rows > best[2] and (own or rows == len(recording.result.frames)):
                best = (stream, row, rows)
            if best[2] == len(recording.result.frames):
                return best
    return best


def _from_files(folder: Path, head: DatasetHead, recordings: list[_Read], streams: list[_Read]) -> list[RecordingInfo]:
    named = []
    gestures: dict[str, Gesture | None] = {}
    for read in recordings:
        name = parse_name(read.path.name)
        if name is None:
            raise DatasetError(
                f"'{read.path}' is not named <label>_<epoch ms>_<rows>.csv: move it out of {RECORDINGS}/."
            )
        if name.label not in gestures:
            gestures[name.label] = head.gestures.find(name.label)
        found = gestures[name.label]
        named.append((read, name, found.label if found else name.label))
    usual = usual_rows((label, len(read.result.frames)) for read, _, label in named)
    by_subject: dict[str, list[_Read]] = {}
    for stream in streams:
        by_subject.setdefault(stream.subject, []).append(stream)
    # Duplicates are by content: the first in name order is the original.
    originals: dict[str, str] = {}
    lookups = {id(s): _RowLookup.of(s.result.frames) for s in streams}
    infos = []
    for read, name, label in named:
        frames = read.result.frames
        identity = read.path.relative_to(folder / RECORDINGS).with_suffix("").as_posix()
        flags = read.result.warnings + findings(Examined(frames, head.layout, name.rows, usual[label]))
        known = gestures[name.label]
        if known is None or (known.affect == "none" and head.gestures.tells_affect):
            flags.append(f"its label '{name.label}' is not in the gesture set '{head.gestures.name}': no affect")
        if read.sha256 in originals:
            flags.append(f"the same content as {originals[read.sha256]}")
        originals.setdefault(read.sha256, identity)
        session = _session(read.path.relative_to(folder / RECORDINGS))
        mine = by_subject.get(read.subject, [])
        found_in, stream_row, rows = _best_stream(folder, read, session, mine, lookups)
        if found_in is not None and rows < len(frames):
            flags.append(f"{PARTLY_THERE} {rows} rows are in the session's stream")
        elif mine and found_in is None:
            flags.append("not found in the session's stream")
        infos.append(
            RecordingInfo(
                id=identity,
                subject=_subject(read.subject, known),
                session=session,
                gesture=label,
                file=read.path.relative_to(folder).as_posix(),
                first_row=0,
                rows=len(frames),
                start=0,
                stop=len(frames),
                stream="" if found_in is None else _stream_id(folder, found_in),
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


@dataclass(frozen=True)
class _RowLookup:
    """Rows of a stream by their stamp, the host's where there is one."""

    stamps: NDArray[np.int64]
    rows: NDArray[np.int64]

    @classmethod
    def of(cls, frames: Frames) -> _RowLookup:
        stamps = frames.device_ms if frames.host_ms is None else frames.host_ms
        order = np.argsort(stamps, kind="stable")
        return cls(stamps[order], order)

    def at(self, stamp: int) -> list[int]:
        first, last = np.searchsorted(self.stamps, [stamp, stamp + 1])
        found: list[int] = self.rows[first:last].tolist()
        return found


def _from_labels(folder: Path, head: DatasetHead, streams: list[_Read]) -> list[RecordingInfo]:
    """Recordings of streams that carry a label on every row: one for each run of equal labels.

    Rows without a label belong to none.
    """
    infos = []
    for read in streams:
        labels = read.result.frames.labels
        if labels is None:
            continue
        frames = read.result.frames
        edges = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), len(labels)]
        for number, (first, last) in enumerate(itertools.pairwise(edges)):
            said = str(labels[first])
            if not plain_label(said):
                continue
            found = head.gestures.find(said)
            label = found.label if found else said
            part = frames.slice(first, last)
            flags = findings(Examined(part, head.layout, None, None))
            infos.append(
                RecordingInfo(
                    id=f"{_stream_id(folder, read)}#{number:03d} {label}",
                    subject=_subject(read.subject, found),
                    session=_stream_session(folder, read),
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


def with_marks(infos: Iterable[RecordingInfo], marks: dict[str, Standing]) -> list[RecordingInfo]:
    """The recordings as the marks leave them."""
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
