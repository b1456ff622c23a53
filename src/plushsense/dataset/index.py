"""Open a data set, and (re)build its index from the raw files and the marks if these changed."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, FileFormatError, ForgottenError
from plushsense.core.gestures import NOBODY, Gesture, GestureSet, plain_label
from plushsense.core.recorder_csv import Frames, ReadResult, parse_name, read_bytes, read_recording, read_stream
from plushsense.core.row_times import kept_rows
from plushsense.core.simulation import is_marked
from plushsense.dataset.files import RECORDINGS_INDEX, STAMP, STREAMS_INDEX, IndexStamp, raw_files
from plushsense.dataset.marks import MARKS, MarkState, read_marks
from plushsense.dataset.quality.checking import import_flags
from plushsense.dataset.quality.findings import PARTLY_THERE
from plushsense.dataset.quality.measurements import Examination, usual_rows
from plushsense.dataset.store import (
    RECORDINGS,
    STREAMS,
    Dataset,
    DatasetHead,
    Generation,
    Progress,
    RecordingInfo,
    StreamInfo,
    read_index,
    write_index,
)
from plushsense.recording.takes import measured_rate_hz


@dataclass
class _RawFile:
    path: Path
    subject: str
    result: ReadResult
    sha256: str


@dataclass
class IndexBuild:
    """Result of building the index: the data set, and the reason for each file that could not be read.

    ``virtual`` counts the recordings whose times have the mark of a simulation.
    """

    dataset: Dataset
    unreadable: dict[str, str] = field(default_factory=dict)
    virtual: int = 0


def open_dataset(path: str | Path) -> Dataset:
    """Open a data set folder; the index is rebuilt if the raw files or the head changed, updated if only marks did.

    On a read-only disk an outdated index is rebuilt in memory at every call.

    Raises:
        DatasetError: if the folder is missing, empty or not a data set, a raw file is missing, unreadable or not the
            one that was indexed, or marks are missing.
    """
    folder = Path(path)
    head = DatasetHead.read(folder)
    try:
        generation = Generation.of(folder)
        before, now = IndexStamp.read(folder), IndexStamp.of(folder)
        same_raw_data = before is not None and replace(before, marks=now.marks) == now
        # If only the marks changed, the raw files need not be read again.
        dataset = _indexed(folder, head, generation, now.files) if same_raw_data else None
        if dataset is not None and before == now:
            return dataset
        if before is not None:
            _refuse_losses(folder, before)
        if dataset is not None:
            dataset.recordings = apply_marks(dataset.recordings, read_marks(folder), head.gestures)
        else:
            dataset = _rebuilt(folder, head)
            if before is not None and before.is_intact(folder):
                _refuse_changed(folder, dataset)
    except OSError as cause:
        raise DatasetError(
            "'{folder}' cannot be read: {why} ({file}).",
            folder=folder,
            why=cause.strerror or cause,
            file=cause.filename,
        ) from None
    try:
        with generation.writing():
            write_index_files(dataset, now)
    except ForgottenError:
        if Generation.of(folder) != generation:
            return open_dataset(folder)
        # The removal of a person was interrupted: the data can be used, and completing it writes the index.
    except OSError:
        # The disk is read-only; the index only saves time.
        pass
    return dataset


def _refuse_losses(folder: Path, before: IndexStamp) -> None:
    """Raise DatasetError if raw files or marks of the stamp ``before`` are missing."""
    if missing := before.missing(folder):
        raise DatasetError(
            "'{folder}' lacks {n} raw file{more} that it had ('{file}'): restore them, or delete {stamp} there to go "
            "on without them.",
            folder=folder,
            n=len(missing),
            more="s" if len(missing) > 1 else "",
            file=missing[0],
            stamp=STAMP,
        )
    if before.marks_rewritten(folder):
        raise DatasetError(
            "Marks that '{path}' had are missing or changed, but marks are only appended: restore the file, or "
            "delete {stamp} there to go on with the marks as they are now.",
            path=folder / MARKS,
            stamp=STAMP,
            folder=folder.name,
        )


def _rebuilt(folder: Path, head: DatasetHead) -> Dataset:
    """Return the data set with a new index; raise DatasetError if a raw file cannot be read."""
    built = build_index(folder, head)
    if built.unreadable:
        file, reason = next(iter(built.unreadable.items()))
        raise DatasetError(
            "'{path}' can no longer be read{more}: restore it, or remove it from the data set. {reason}",
            path=folder / file,
            more=f", nor can {len(built.unreadable) - 1} other files" if len(built.unreadable) > 1 else "",
            reason=reason,
            folder=folder.name,
            file=file,
        )
    return built.dataset


def _refuse_changed(folder: Path, now: Dataset) -> None:
    """Raise DatasetError if a raw file is not the one that the index on disk describes."""
    before = _read_index(folder)
    if before is None:
        return
    known = {info.file: info.sha256 for infos in before for info in infos}
    files = {info.file: info.sha256 for infos in (now.recordings, now.streams) for info in infos}
    if changed := sorted(file for file, sha256 in files.items() if known.get(file, sha256) != sha256):
        raise DatasetError(
            "{n} raw file{more} in '{folder}' changed since the import ('{file}'), but raw files are never "
            "rewritten: restore them, or delete {stamp} there to go on with what they hold now.",
            n=len(changed),
            more="s" if len(changed) > 1 else "",
            folder=folder,
            file=changed[0],
            stamp=STAMP,
        )


def _read_index(folder: Path) -> tuple[list[RecordingInfo], list[StreamInfo]] | None:
    """Return the rows of the index files; None if they are damaged."""
    try:
        return read_index(folder / RECORDINGS_INDEX, RecordingInfo), read_index(folder / STREAMS_INDEX, StreamInfo)
    except DatasetError:
        return None


def _indexed(folder: Path, head: DatasetHead, generation: Generation, files: Iterable[str]) -> Dataset | None:
    """Return the data set as its index on disk describes it; None if that is damaged, or not of the raw ``files``."""
    index = _read_index(folder)
    if index is None or {info.file for infos in index for info in infos} != set(files):
        return None
    return Dataset(folder, head, *index, generation)


def rebuild_index(folder: Path, head: DatasetHead | None = None, progress: Progress | None = None) -> IndexBuild:
    """Rebuild the index; it is written only if every raw file can be read.

    Raises:
        ForgottenError: if a person was removed from the data set meanwhile.
    """
    stamp = IndexStamp.of(folder)
    built = build_index(folder, head or DatasetHead.read(folder), progress)
    if not built.unreadable:
        with built.dataset.generation.writing():
            write_index_files(built.dataset, stamp)
    return built


def write_index_files(dataset: Dataset, stamp: IndexStamp | None = None) -> None:
    """Write the index files of ``dataset``; ``stamp`` is the `IndexStamp` from before the raw files were read."""
    stamp = stamp or IndexStamp.of(dataset.path)
    write_index(dataset.path / STREAMS_INDEX, dataset.streams, StreamInfo)
    write_index(dataset.path / RECORDINGS_INDEX, dataset.recordings, RecordingInfo)
    stamp.with_index(dataset.path).write(dataset.path)


def build_index(folder: Path, head: DatasetHead, progress: Progress | None = None) -> IndexBuild:
    """Read every raw file, locate the recordings in their streams and apply the marks, without writing anything."""
    generation = Generation.of(folder)
    files = raw_files(folder)
    unreadable: dict[str, str] = {}
    streams: list[_RawFile] = []
    recordings: list[_RawFile] = []
    for done, (kind, path) in enumerate(files):
        name = path.relative_to(folder).as_posix()
        if (shown := name.encode(errors="backslashreplace").decode()) != name:
            raise DatasetError(
                "'{file}' in '{folder}' has a name that is no text: rename it.", file=shown, folder=folder
            )
        reader = read_stream if kind == STREAMS else read_recording
        try:
            data = read_bytes(path)
            result = reader(path, head.layout, data)
        except FileFormatError as cause:
            unreadable[name] = cause.message
            continue
        subject = path.relative_to(folder / kind).parts[0]
        read = _RawFile(path, subject, result, hashlib.sha256(data).hexdigest())
        (streams if kind == STREAMS else recordings).append(read)
        if progress is not None:
            progress(done + 1, len(files))
    infos = _recordings_from_files(folder, head, recordings, streams) + _recordings_from_labels(folder, head, streams)
    infos = sorted(apply_marks(infos, read_marks(folder), head.gestures), key=lambda r: r.id)
    stream_infos = [_stream_info(folder, head, s) for s in streams]
    virtual = sum(is_marked(read.result.frames) for read in recordings)
    return IndexBuild(Dataset(folder, head, infos, stream_infos, generation), unreadable, virtual)


DUPLICATE_FOLDER = "again-"


def _session(relative: Path, labelled: bool = False) -> str:
    """Return the session of a raw file from its path below ``recordings/`` or ``streams/``.

    The session is the name of the folder in the person's folder, or 1 if there is none. A labelled stream without such
    a folder is a session of its own, named after its file.
    """
    inner = relative.parts[1:-1]
    if inner and not inner[0].startswith(DUPLICATE_FOLDER):
        return inner[0]
    return relative.stem if labelled else "1"


def _stream_session(folder: Path, read: _RawFile) -> str:
    return _session(read.path.relative_to(folder / STREAMS), read.result.frames.labels is not None)


def _subject(folder_name: str, gesture: Gesture | None) -> str:
    """Return the person of a recording: its folder, or `NOBODY` for a gesture without a person (the toy at rest)."""
    return NOBODY if gesture is not None and gesture.nobody else folder_name


def _stream_id(folder: Path, read: _RawFile) -> str:
    return read.path.relative_to(folder / STREAMS).with_suffix("").as_posix()


def _stream_info(folder: Path, head: DatasetHead, read: _RawFile) -> StreamInfo:
    frames = read.result.frames
    steps = np.diff(frames.device_ms[kept_rows(frames.device_ms, head.layout.gap_ms)])
    broken = (steps < 0) | (steps > head.layout.gap_ms)
    flags = import_flags(Examination(frames, head.layout, stream=True))
    return StreamInfo(
        id=_stream_id(folder, read),
        subject=read.subject,
        session=_stream_session(folder, read),
        file=read.path.relative_to(folder).as_posix(),
        rows=len(frames),
        seconds=float(steps[~broken].sum()) / 1000.0,
        restarts=int(broken.sum()),
        flags=tuple(read.result.warnings + flags),
        sha256=read.sha256,
    )


def locate(recording: ReadResult, stream: ReadResult, at: RowLookup) -> tuple[int, int]:
    """Return the stream row at which a recording begins and how many rows from there agree; (−1, 0) if none does."""
    frames, whole = recording.frames, stream.frames
    # A clock that was summed from delays begins at 0 in every file, so only time differences can be compared.
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
        # Rows with equal host stamps may be missing from one of the files: count the agreeing rows from the start.
        agreeing = int(np.argmin(same)) if not same.all() else n
        if agreeing > best[1]:
            best = (row, agreeing)
    return best


def _best_stream(
    folder: Path, recording: _RawFile, session: str, streams: Iterable[_RawFile], lookups: dict[int, RowLookup]
) -> tuple[_RawFile | None, int, int]:
    """Return the stream of ``streams`` that contains most of a recording, its first row there, and the agreeing rows.

    Return (None, −1, 0) if there is none. The session's own streams are searched first; another one must contain the
    whole recording, since recordings of different days may begin with the same time stamps.
    """
    best: tuple[_RawFile | None, int, int] = (None, -1, 0)
    for own in (True, False):
        for stream in streams:
            if (_stream_session(folder, stream) == session) is not own:
                continue
            row, rows = locate(recording.result, stream.result, lookups[id(stream)])
            if rows > best[2] and (own or rows == len(recording.result.frames)):
                best = (stream, row, rows)
            if best[2] == len(recording.result.frames):
                return best
    return best


def _recordings_from_files(
    folder: Path, head: DatasetHead, recordings: list[_RawFile], streams: list[_RawFile]
) -> list[RecordingInfo]:
    named = []
    gestures: dict[str, Gesture | None] = {}
    for read in recordings:
        name = parse_name(read.path.name)
        if name is None:
            raise DatasetError(
                "'{file}' is not named <label>_<epoch ms>_<rows>.csv: move it out of {recordings}/.",
                file=read.path,
                recordings=RECORDINGS,
            )
        if name.label not in gestures:
            gestures[name.label] = head.gestures.find(name.label)
        gesture = gestures[name.label]
        named.append((read, name, gesture.label if gesture else name.label))
    usual = usual_rows((label, read.subject, len(read.result.frames)) for read, _, label in named)
    by_subject: dict[str, list[_RawFile]] = {}
    for stream in streams:
        by_subject.setdefault(stream.subject, []).append(stream)
    # Of files with equal content, the first in the order of the paths is the original.
    originals: dict[str, str] = {}
    lookups = {id(s): RowLookup.of(s.result.frames) for s in streams}
    infos = []
    for read, name, label in named:
        frames = read.result.frames
        identity = read.path.relative_to(folder / RECORDINGS).with_suffix("").as_posix()
        flags = read.result.warnings + import_flags(Examination(frames, head.layout, name.rows, usual[label]))
        known = gestures[name.label]
        if known is None or (known.affect == "none" and head.gestures.has_affect):
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
        stream_id = "" if found_in is None else _stream_id(folder, found_in)
        infos.append(
            RecordingInfo(
                **_facts(folder, read, frames, name.epoch_ms),
                id=identity,
                subject=_subject(read.subject, known),
                session=session,
                gesture=label,
                recorded=label,
                first_row=0,
                stream=stream_id,
                stream_row=stream_row,
                flags=tuple(flags),
            )
        )
    return infos


def _facts(folder: Path, read: _RawFile, frames: Frames, epoch_ms: int) -> dict[str, Any]:
    """Return the index fields that depend on the rows only; ``epoch_ms`` is used if there are no host times."""
    return {
        "file": read.path.relative_to(folder).as_posix(),
        "rows": len(frames),
        "start": 0,
        "stop": len(frames),
        "start_ms": int(frames.device_ms[0]),
        "epoch_ms": int(frames.host_ms[0]) if frames.host_ms is not None else epoch_ms,
        "rate_hz": measured_rate_hz(frames.device_ms),
        "excluded": False,
        "sha256": read.sha256,
    }


@dataclass(frozen=True)
class RowLookup:
    """Rows of a stream by time stamp: that of the host, or of the device if there is none."""

    stamps: NDArray[np.int64]
    rows: NDArray[np.int64]

    @classmethod
    def of(cls, frames: Frames) -> RowLookup:
        stamps = frames.device_ms if frames.host_ms is None else frames.host_ms
        order = np.argsort(stamps, kind="stable")
        return cls(stamps[order], order)

    def at(self, stamp: int) -> list[int]:
        first, last = np.searchsorted(self.stamps, [stamp, stamp + 1])
        return [int(row) for row in self.rows[first:last]]


def _recordings_from_labels(folder: Path, head: DatasetHead, streams: list[_RawFile]) -> list[RecordingInfo]:
    """Return the recordings in streams with a label on every row: one for each run of equal labels."""
    infos = []
    for read in streams:
        labels = read.result.frames.labels
        if labels is None:
            continue
        frames = read.result.frames
        edges = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1).tolist(), len(labels)]
        for number, (first, last) in enumerate(itertools.pairwise(edges)):
            text = str(labels[first])
            if not plain_label(text):
                continue
            gesture = head.gestures.find(text)
            label = gesture.label if gesture else text
            part = frames.slice(first, last)
            infos.append(
                RecordingInfo(
                    **_facts(folder, read, part, int(part.device_ms[0])),
                    id=f"{_stream_id(folder, read)}#{number:03d} {label}",
                    subject=_subject(read.subject, gesture),
                    session=_stream_session(folder, read),
                    gesture=label,
                    recorded=label,
                    first_row=first,
                    stream=_stream_id(folder, read),
                    stream_row=first,
                    flags=tuple(import_flags(Examination(part, head.layout))),
                )
            )
    return infos


def apply_marks(
    infos: Iterable[RecordingInfo], marks: dict[str, MarkState], gestures: GestureSet
) -> list[RecordingInfo]:
    """Return the recordings as ``marks`` trim, exclude and relabel them; ``gestures`` is the set of the data set."""
    out = []
    for info in infos:
        mark = marks.get(info.id, MarkState())
        stop = info.rows if mark.stop < 0 else min(mark.stop, info.rows)
        gesture, subject = mark.gesture or info.recorded, info.subject
        if gesture != info.gesture:
            subject = _subject(info.id.split("/", 1)[0], gestures.find(gesture))
        out.append(
            replace(
                info, excluded=mark.excluded, start=min(mark.start, stop), stop=stop, gesture=gesture, subject=subject
            )
        )
    return out


def as_dataset(dataset: Dataset | str | os.PathLike[str]) -> Dataset:
    """Return ``dataset``, or open it if it is a path."""
    return dataset if isinstance(dataset, Dataset) else open_dataset(Path(dataset))
