"""Import XDF files (LabRecorder): the stream that matches the layout, cut into recordings by markers.

A marker that names a gesture begins a recording, which ends at the next marker of any kind or the end of the stream.
``start Tail pull`` and ``Tail pull/begin`` begin one too; ``end``, ``stop``, ``end Tail pull`` and the like only end
one. Without a gesture set, every other marker is the name of a gesture.
"""

from __future__ import annotations

import io
import logging
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError, need
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout, StreamColumns
from plushsense.core.recorder_csv import LONGEST_LABEL, Frames
from plushsense.core.sentences import Sentence
from plushsense.dataset.importing.sources import LEFT_OUT, SourceFile
from plushsense.dataset.importing.tables import (
    ConvertedSource,
    LabelledSegment,
    about_file,
    usable_rows,
    whole_steps,
    write_session,
)

_MAGIC = b"XDF:"
_HEADER, _SAMPLES = 2, 3
# After clock synchronisation, equal times may differ by this much.
_SAME_S = 1e-6
_SIZES = {"string": 1, "int8": 1, "int16": 2, "int32": 4, "float32": 4, "int64": 8, "double64": 8}
_BEGIN = re.compile(r"^(?:start|begin)[\s_:/-]+(?P<a>.+)$|^(?P<b>.+)[\s_:/-]+(?:start|begin)$", re.IGNORECASE)
_END = re.compile(r"^(?:end|stop)(?:[\s_:/-].*)?$|^.*[\s_:/-](?:end|stop)$", re.IGNORECASE | re.DOTALL)
_BIDS = re.compile(r"(?:^|_)(sub|ses|run)-([^_]+)")


@dataclass(frozen=True)
class Marker:
    """Text of a marker, and its time in seconds."""

    time_s: float
    text: str


def person_and_session(path: Path, folder: str | None) -> tuple[str | None, str]:
    """Return person and session by a file name of LabRecorder (``sub-P001_ses-S001_task-x_run-001_eeg.xdf``).

    If the name lacks them, the person is ``folder`` (None if unknown), and the session the name of the file.
    """
    entities = dict(_BIDS.findall(path.stem))
    session = "-".join(entities[key] for key in ("ses", "run") if key in entities) or path.stem
    return entities.get("sub", folder), session


def segments_of(
    markers: list[Marker], times_s: NDArray[np.float64], gestures: GestureSet | None
) -> tuple[list[LabelledSegment], list[str]]:
    """Return the recordings that the markers delimit, as rows of ``times_s`` (T,), and markers that name no gesture."""
    rising = np.maximum.accumulate(times_s)
    cuts: list[LabelledSegment] = []
    unknown: list[str] = []
    label, start = "", 0
    for marker in sorted(markers, key=lambda m: m.time_s):
        row = int(np.searchsorted(rising, marker.time_s - _SAME_S, side="left"))
        if label and row > start:
            cuts.append(LabelledSegment(label, start, row))
        label, start = _named(marker.text, gestures), row
        if not label and not _END.match(marker.text.strip()):
            unknown.append(marker.text)
    if label and len(times_s) > start:
        cuts.append(LabelledSegment(label, start, len(times_s)))
    return cuts, unknown


def _named(text: str, gestures: GestureSet | None) -> str:
    """Return the gesture that a marker begins; "" if it begins none."""
    text = " ".join(text.split())
    begin = _BEGIN.match(text)
    named = (begin["a"] or begin["b"]) if begin else text
    if gestures is not None:
        gesture = gestures.find(text) or gestures.find(named)
        return gesture.label if gesture else ""
    return "" if _END.match(named) or len(named) > LONGEST_LABEL // 2 else named


def _varlen(file: BinaryIO) -> int:
    size = file.read(1)
    wide = {b"\x01": 1, b"\x04": 4, b"\x08": 8}.get(size)
    if wide is None:
        raise FileFormatError("a length is damaged" if size else "the end")
    raw = file.read(wide)
    if len(raw) < wide:
        raise FileFormatError("the end")
    return int.from_bytes(raw, "little")


def complete_chunks(path: Path) -> tuple[int, int]:
    """Return the number of leading bytes that are complete, plausible chunks, and the size of the file.

    The sample count of a chunk, which pyxdf does not check, is compared with its length.

    Raises:
        FileFormatError: for a file that is not XDF.
    """
    size = path.stat().st_size
    widths: dict[int, int] = {}
    with path.open("rb") as file:
        if file.read(4) != _MAGIC:
            message = f"'{path.name}' is no XDF file: it does not begin with {_MAGIC.decode()}"
            raise FileFormatError(message, reason="xdf_damaged", file=path.name)
        good = 4
        while good < size:
            try:
                length = _varlen(file)
                body = file.tell()
                if length < 2 or body + length > size:
                    break
                (tag,) = struct.unpack("<H", file.read(2))
                if tag == _HEADER and length >= 6:
                    (stream,) = struct.unpack("<I", file.read(4))
                    widths[stream] = _sample_bytes(file.read(length - 6))
                elif tag == _SAMPLES:
                    if length < 7:
                        break
                    (stream,) = struct.unpack("<I", file.read(4))
                    samples = _varlen(file)
                    if stream not in widths or samples * widths[stream] > length:
                        break
            except (FileFormatError, struct.error):
                break
            good = body + length
            file.seek(good)
    return good, size


def _sample_bytes(header: bytes) -> int:
    """Return the minimum size in bytes of a sample (time stamp flag and values) by the header of its stream."""
    count = re.search(rb"<channel_count>\s*(\d{1,6})\s*</", header)
    kind = re.search(rb"<channel_format>\s*(\w+)\s*</", header)
    size = _SIZES.get(kind[1].decode("ascii", "replace")) if kind else None
    if count is None or size is None:
        raise FileFormatError("a stream's header names no channels")
    return 1 + int(count[1]) * size


class _FirstBytes(io.FileIO):
    """File that ends after its first ``length`` bytes."""

    def __init__(self, path: Path, length: int):
        super().__init__(path)
        self._length = length

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset, whence = offset + self._length, os.SEEK_SET
        return super().seek(offset, whence)

    def readinto(self, buffer: Any) -> int:
        left = max(0, self._length - self.tell())
        return super().readinto(memoryview(buffer)[:left]) or 0


def _load(path: Path, length: int) -> list[dict[str, Any]]:
    pyxdf = need("pyxdf", extra="lsl")
    logging.getLogger("pyxdf").addHandler(logging.NullHandler())
    with io.BufferedReader(_FirstBytes(path, length)) as file, np.errstate(all="ignore"):
        try:
            # Keep the original time stamps, since dejittering would hide jitter and lost samples.
            streams, _ = pyxdf.load_xdf(file, dejitter_timestamps=False)
        except Exception as cause:  # noqa: BLE001, RUF100
            message = " ".join(str(cause).split())[:120] or type(cause).__name__
            message = f"'{path.name}' cannot be read as XDF: {message}"
            raise FileFormatError(message, reason="xdf_damaged", file=path.name) from None
    return list(streams)


def _text(stream: dict[str, Any], *keys: str) -> str:
    """Return the text at the path ``keys`` in a stream's header; "" if there is none."""
    at: Any = stream["info"]
    for key in keys:
        at = (at.get(key) or [None])[0] if isinstance(at, dict) else None
    return at if isinstance(at, str) else ""


def _labels(stream: dict[str, Any]) -> list[str]:
    desc = (stream["info"].get("desc") or [None])[0]
    channels = (desc.get("channels") or [None])[0] if isinstance(desc, dict) else None
    listed = channels.get("channel") or [] if isinstance(channels, dict) else []
    return [str((c.get("label") or [""])[0] or "") if isinstance(c, dict) else "" for c in listed]


def _frames(
    stream: dict[str, Any], layout: Layout, columns: StreamColumns
) -> tuple[Frames, NDArray[np.float64], list[str]]:
    """Return the frames of a stream, the time of each frame in seconds, and warnings."""
    series = np.asarray(stream["time_series"], dtype=np.float64).reshape(len(stream["time_stamps"]), -1)
    times = np.asarray(stream["time_stamps"], dtype=np.float64)
    device = times * 1000.0 if columns.clock is None else series[:, columns.clock]
    good = usable_rows(series[:, columns.channels], times * 1000.0, device)
    notes: list[str] = []
    if lost := int(np.sum(~good)):
        message = f"{lost} samples without a number in every channel left out"
        notes.append(Sentence(message, reason="rows_left_out", n=lost))
    values, warning = whole_steps(series[good][:, columns.channels], layout)
    host_ms = np.round(times[good] * 1000.0).astype(np.int64)
    device_ms = np.round(device[good]).astype(np.int64)
    return Frames(values, device_ms, host_ms), times[good], notes + ([warning] if warning else [])


def read_xdf(
    path: Path,
    display_name: str,
    folder: Path,
    subject: str,
    session: str,
    layout: Layout,
    gestures: GestureSet | None,
    stream_name: str = "",
) -> Iterator[SourceFile | str]:
    """Write the recordings of an XDF file into the new ``folder``; yield the files, and warnings as text.

    ``stream_name`` selects one of several streams that match the layout.

    Raises:
        FileFormatError: for a damaged file, or if not exactly one stream matches.
        MissingExtraError: without pyxdf.
    """
    good, size = complete_chunks(path)
    streams = _load(path, good)
    if good < size:
        message = f"{display_name}: cut off or damaged from byte {good} of {size} on; the bytes before are used"
        yield Sentence(message, reason="xdf_cut", file=display_name)
    texts = [s for s in streams if _text(s, "channel_format") == "string"]
    fitting, others = [], []
    for stream in streams:
        name = _text(stream, "name")
        if _text(stream, "channel_format") == "string":
            continue
        columns = layout.match_columns(_labels(stream), np.shape(stream["time_series"])[-1])
        if isinstance(columns, str):
            others.append((name, columns))
        elif not len(stream["time_stamps"]):
            others.append((name, "it is empty"))
        elif stream_name and name != stream_name:
            others.append((name, f"the stream '{stream_name}' was selected"))
        else:
            fitting.append((stream, name, columns))
    if len(fitting) != 1:
        names = ", ".join(f"'{name}'" for _, name, _ in fitting)
        why = (
            f"{len(fitting)} streams fit layout '{layout.name}' ({names}): name one with --column stream=NAME"
            if fitting
            else f"no stream fits layout '{layout.name}': "
            + ("; ".join(f"'{n}': {r}" for n, r in others[:5]) or f"there are {len(texts)} of texts and no other")
        )
        raise FileFormatError(why, reason="xdf_streams", n=len(fitting), layout=layout.name)
    stream, name, columns = fitting[0]
    frames, times, notes = _frames(stream, layout, columns)
    markers = [
        Marker(float(time), str(sample[0]))
        for text in texts
        for time, sample in zip(text["time_stamps"], text["time_series"], strict=True)
        if np.isfinite(time) and sample and sample[0]
    ]
    cuts, unknown = segments_of(markers, times, gestures) if len(times) else ([], [])
    if unknown:
        listed = ", ".join(f"'{u[:40]}'" for u in dict.fromkeys(unknown[:20]))
        message = f"{len(unknown)} markers name no gesture and begin no recording: {listed}"
        notes.append(Sentence(message, reason="xdf_markers", n=len(unknown), markers=listed))
    if not cuts:
        notes.append(Sentence("no marker names a gesture: only the stream is imported", reason="xdf_no_gesture"))
    yield from (about_file(display_name, note) for note in notes)
    if not len(frames):
        message = f"the stream '{name}' has no sample with a number in every channel"
        raise FileFormatError(message, reason="rows_unusable", n=layout.n_channels)
    about = {"stream": name, "type": _text(stream, "type"), "nominal_rate_hz": _text(stream, "nominal_srate")}
    yield from write_session(
        folder, subject, session, frames, cuts, layout, ConvertedSource(path, display_name, about), with_stream=True
    )
    for other, reason in others:
        yield SourceFile(path, LEFT_OUT, origin=f"{display_name}: stream '{other}'", reason=reason)
