"""Import XDF files (LabRecorder): the stream that matches the layout, cut into recordings by a stream of markers.

The toy's stream is the one whose channels have the names of the layout, or, if none has names, their number. Streams of
one source that follow each other are joined. The markers are those of the studio, or of the stream whose texts name
gestures (`plushsense.dataset.importing.markers`).
"""

from __future__ import annotations

import gzip
import io
import logging
import re
import shlex
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, FileFormatError, need
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import DEVICE_MS, Layout, StreamColumns
from plushsense.core.recorder_csv import Frames
from plushsense.core.sentences import Message
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.markers import Marker, MarkerCuts, cut_by_markers, read_marker
from plushsense.dataset.importing.pattern import MARKERS_ROLE, ROLES, STREAM_ROLE, ImportPattern
from plushsense.dataset.importing.sources import LEFT_OUT, XDF_ENDINGS, ScanSpec, SourceFile, SourceScan
from plushsense.dataset.importing.tables import (
    ConvertedSource,
    LabelledSegment,
    SessionTarget,
    about_file,
    usable_rows,
    whole_steps,
    write_session,
)
from plushsense.devices.lsl import MARK, MARKERS

_MAGIC = b"XDF:"
_HEADER, _SAMPLES = 2, 3
# Equal rows of two streams, whose clocks were synchronised apart, may differ by this much.
_SAME_S = 0.005
_SIZES = {"string": 1, "int8": 1, "int16": 2, "int32": 4, "float32": 4, "int64": 8, "double64": 8}
_BIDS = re.compile(r"(?:^|_)(sub|ses|run)-([^_]+)")
_CHUNK = 1 << 20
# Values in a stream of numbers without a rate that may be markers.
_MOST_EVENTS = 100_000
# Different values of a stream of numbers that may be codes of gestures.
_MOST_CODES = 20
# A stream of numbers with fewer samples is rather one of markers.
_MOST_MARKERS = 50
_FEWEST_SAMPLES = 3


@dataclass(frozen=True, eq=False)
class XdfStream:
    """A stream of an XDF file: its number, what its header says, times (T,) in seconds, and samples: rows of values.

    ``clock`` (T,) numbers the clock of each sample, which is another one after its computer was started again.
    """

    number: int
    name: str
    type: str
    source: str
    uid: str
    format: str
    rate: str
    labels: list[str]
    times_s: NDArray[np.float64]
    clock: NDArray[np.int64]
    samples: Any

    @classmethod
    def of(cls, stream: dict[str, Any]) -> XdfStream:
        """Create a stream from what pyxdf returns."""
        keys = ("name", "type", "source_id", "uid", "channel_format", "nominal_srate")
        times = np.asarray(stream["time_stamps"], dtype=np.float64)
        name, kind, source, uid, number_format, rate = (_text(stream, key) for key in keys)
        number, labels, samples = int(stream["info"]["stream_id"]), _labels(stream), stream["time_series"]
        clock = np.zeros(len(times), dtype=np.int64)
        for first, _ in stream["info"]["clock_segments"][1:]:
            clock[first:] += 1
        return cls(number, name, kind, source, uid, number_format, rate, labels, times, clock, samples)

    def __str__(self) -> str:
        return f"'{self.name}' (#{self.number})"

    @property
    def is_text(self) -> bool:
        return self.format == "string"

    @property
    def is_irregular(self) -> bool:
        """Whether its samples are events: texts, or values without a rate."""
        return self.is_text or not float(self.rate or 0.0)

    def is_named(self, choice: str) -> bool:
        """Return whether ``choice`` is its name or ``#`` and its number."""
        return choice in (self.name, f"#{self.number}")


def is_xdf(path: Path) -> bool:
    """Return whether a file has one of the `XDF_ENDINGS`."""
    return path.name.lower().endswith(XDF_ENDINGS)


def xdf_stem(path: Path) -> str:
    """Return the name of an XDF file without its ending, which may have two parts."""
    return next((path.name[: -len(end)] for end in XDF_ENDINGS if path.name.lower().endswith(end)), path.stem)


def person_and_session(path: Path, folder: str | None) -> tuple[str | None, str]:
    """Return person and session by a file name of LabRecorder (``sub-P001_ses-S001_task-x_run-001_eeg.xdf``).

    If the name lacks them, the person is ``folder`` (None if unknown), and the session the name of the file.
    """
    entities = dict(_BIDS.findall(xdf_stem(path)))
    session = "-".join(entities[key] for key in ("ses", "run") if key in entities) or xdf_stem(path)
    return entities.get("sub", folder), session


def uncompressed(path: Path, folder: Path, limits: UnpackLimits) -> Path:
    """Return the path of an XDF file, or of its content in the new ``folder`` if it is compressed by gzip.

    Of a file that is cut off or damaged, the content before is written.

    Raises:
        DatasetError: if it is larger than ``limits`` allow.
    """
    with path.open("rb") as file:
        if file.read(2) != b"\x1f\x8b":
            return path
    folder.mkdir(parents=True)
    plain, size = folder / "content.xdf", 0
    with gzip.open(path) as packed, plain.open("wb") as out:
        try:
            while chunk := packed.read1(_CHUNK):
                size += len(chunk)
                limits.check(path, 1, size, folder)
                out.write(chunk)
        except (EOFError, gzip.BadGzipFile, zlib.error):
            # A chunk that is not complete, so that the file is reported as cut off.
            out.write(b"\x01")
    return plain


def _varlen(file: BinaryIO) -> int:
    size = file.read(1)
    wide = {b"\x01": 1, b"\x04": 4, b"\x08": 8}.get(size)
    if wide is None:
        raise FileFormatError("a length is damaged" if size else "the end")
    raw = file.read(wide)
    if len(raw) < wide:
        raise FileFormatError("the end")
    return int.from_bytes(raw, "little")


def complete_chunks(path: Path, name: str) -> tuple[int, int]:
    """Return the number of leading bytes that are complete, plausible chunks, and the size of the file.

    The sample count of a chunk, which pyxdf does not check, is compared with its length.

    Raises:
        FileFormatError: for a file that is not XDF.
    """
    size = path.stat().st_size
    widths: dict[int, int] = {}
    with path.open("rb") as file:
        if file.read(4) != _MAGIC:
            raise FileFormatError(
                "'{file}' is no XDF file: it does not begin with {decode}", file=name, decode=_MAGIC.decode()
            )
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


def _load(path: Path, length: int, name: str) -> list[XdfStream]:
    pyxdf = need("pyxdf", extra="lsl")
    logging.getLogger("pyxdf").addHandler(logging.NullHandler())
    with path.open("rb") as whole:
        file = io.BytesIO(whole.read(length))
    with np.errstate(all="ignore"):
        try:
            # Keep the original time stamps, since dejittering would hide jitter and lost samples.
            streams, _ = pyxdf.load_xdf(file, dejitter_timestamps=False)
        except Exception as cause:  # noqa: BLE001, RUF100
            message = " ".join(str(cause).split())[:120] or type(cause).__name__
            raise FileFormatError("'{file}' cannot be read as XDF: {message}", file=name, message=message) from None
    return [XdfStream.of(stream) for stream in streams]


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


@dataclass(frozen=True)
class XdfSample:
    """What an XDF file holds, from which a pattern is guessed.

    Attributes:
        stream: name of the stream that may be the toy, and ``others`` of further ones.
        columns: some values of each of its channels, as texts, and ``time_ms``; none of channels that are named as a
            time, a person or the like, and of those of one name, which are ``repeated``.
        markers: name of the stream of markers that may name gestures, and ``other_markers`` of further ones. Numbers
            are markers only where no texts are.
        labels: what its markers name.
    """

    stream: str
    others: tuple[str, ...]
    columns: dict[str, list[str]]
    repeated: tuple[str, ...]
    markers: str
    other_markers: tuple[str, ...]
    labels: list[str]


def sample_xdf(path: Path, rows: int, folder: Path, limits: UnpackLimits) -> XdfSample:
    """Return what an XDF file holds, with the first ``rows`` samples of the longest stream of numbers.

    Args:
        folder: a new folder, for the content of a compressed file.

    Raises:
        FileFormatError: for a damaged file, or one without a stream of numbers whose channels can be told apart.
        MissingExtraError: without pyxdf.
    """
    plain = uncompressed(path, folder, limits)
    streams = _load(plain, complete_chunks(plain, path.name)[0], path.name)
    numbers = [
        s for s in streams if not s.is_text and len(s.times_s) > (_MOST_MARKERS if s.is_irregular else _FEWEST_SAMPLES)
    ]
    if not numbers:
        raise FileFormatError("'{file}' holds no stream of numbers with a row for each sample", file=path.name)
    toy = max(numbers, key=lambda s: len(s.times_s))
    samples = np.asarray(toy.samples)[:rows].reshape(min(rows, len(toy.times_s)), -1)
    labels = [label.strip() for label in toy.labels]
    if len(labels) != samples.shape[1] or not all(labels):
        labels = [f"c{k + 1}" for k in range(samples.shape[1])]
    columns = {"time_ms": [f"{1000.0 * time:.3f}" for time in toy.times_s[:rows].tolist()]}
    counts = Counter(label.casefold() for label in labels)
    repeated = tuple(dict.fromkeys(label for label in labels if counts[label.casefold()] > 1))
    for label, values in zip(labels, samples.T, strict=True):
        if label not in repeated and not any(label.casefold() in names for names in ROLES.values()):
            columns[label] = [str(value) if np.isfinite(value) else "" for value in values]
    if len(columns) == 1 and repeated:
        raise FileFormatError(
            "'{file}': several channels of the stream '{stream}' are called '{label}': give each a name of its own",
            file=path.name,
            stream=toy.name,
            label=repeated[0],
        )
    named = _labels_of([s for s in streams if s.is_text]) or _labels_of([s for s in streams if _has_codes(s)])
    markers = MARKERS if MARKERS in named else max(named, key=lambda name: len(named[name]), default="")
    others = tuple(s.name for s in numbers if s is not toy and s.name != markers)
    other_markers = tuple(name for name in named if name != markers)
    name = f"#{toy.number}" if toy.name in others else toy.name
    return XdfSample(name, others, columns, repeated, markers, other_markers, named.get(markers, []))


def _labels_of(streams: Sequence[XdfStream]) -> dict[str, list[str]]:
    """Return the labels that the markers in each stream name, by its name; only of streams that name some."""
    read = _read_markers(streams, None)
    return {s.name: labels for s in streams if (labels := [m.label for m in read.get(s.number, ()) if m.label])}


def _has_codes(stream: XdfStream) -> bool:
    """Return whether a stream holds single whole numbers at irregular times, few of them different."""
    if stream.is_text or not stream.is_irregular or not 0 < stream.samples.size == len(stream.times_s) <= _MOST_EVENTS:
        return False
    values = np.unique(stream.samples)
    return bool(len(values) <= _MOST_CODES and np.isfinite(values).all() and (values == np.rint(values)).all())


def _joined(streams: Sequence[XdfStream]) -> tuple[XdfStream, str] | None:
    """Return streams of one source as one, and a note; None if they overlap and are not the same samples."""
    whole, *later = sorted(streams, key=lambda s: float(s.times_s[0]))
    again, gaps = 0, []
    for stream in later:
        last = float(whole.times_s.max())
        n = int(np.sum(stream.times_s <= last + _SAME_S))
        if n:
            near = np.abs(whole.times_s - stream.times_s[0]) <= _SAME_S
            same = (np.array_equal(whole.samples[at : at + n], stream.samples[:n]) for at in np.flatnonzero(near))
            # A recorder that is asked for one stream twice, one of them a little later, stores it twice.
            if not stream.uid or stream.uid != whole.uid or not any(same):
                return None
            again += 1
        else:
            gaps.append(float(stream.times_s[0]) - last)
        times = np.concatenate([whole.times_s, stream.times_s[n:]])
        clock = np.concatenate([whole.clock, whole.clock[-1] + stream.clock[n:]])
        samples = np.concatenate([whole.samples, stream.samples[n:]])
        whole = replace(whole, times_s=times, clock=clock, samples=samples)
    how = ", with equal rows: they are used once" if again else ""
    if gaps:
        how += f", one after another: joined, with gaps of {', '.join(f'{gap:.3g} s' for gap in gaps[:5])}"
    template = "the stream '{stream}' is in the file {n} times{how}"
    return whole, Message(template, stream=whole.name, n=len(streams), how=how)


def _renamed(labels: Sequence[str], channels: Mapping[str, str]) -> list[str]:
    """Return ``labels`` with the name of the channel for each that ``channels`` gives one, and of no other."""
    named = {label.strip().casefold(): channel for channel, label in channels.items()}
    taken = {channel.casefold() for channel in channels}
    keys = [label.strip().casefold() for label in labels]
    return [named.get(key, "" if key in taken else label) for key, label in zip(keys, labels, strict=True)]


@dataclass
class _Toy:
    """The toy's stream with its columns, notes, and why the other streams are not it, by their numbers."""

    stream: XdfStream
    columns: StreamColumns
    notes: list[str]
    others: dict[int, str]


def _find_toy(streams: Sequence[XdfStream], layout: Layout, choices: Mapping[str, str]) -> _Toy:
    """Return the stream that fits the layout.

    ``choices`` are the name, or # and the number, of the ``stream``, and the labels of channels with other names.

    Raises:
        FileFormatError: if not exactly one stream fits.
    """
    choice = choices.get(STREAM_ROLE, "")
    channels = {role: label for role, label in choices.items() if role not in (STREAM_ROLE, MARKERS_ROLE)}
    fitting: list[tuple[XdfStream, StreamColumns]] = []
    others: dict[int, str] = {}
    for stream in streams:
        labels = _renamed(stream.labels, channels)
        columns = layout.match_columns(labels, np.shape(stream.samples)[-1], stream.format != "float32")
        if isinstance(columns, str):
            others[stream.number] = columns
        elif not len(stream.times_s):
            others[stream.number] = "it is empty"
        elif choice and not stream.is_named(choice):
            others[stream.number] = f"the stream '{choice}' was selected"
        else:
            fitting.append((stream, columns))
    if len({c.by_number for _, c in fitting}) > 1:
        for stream, _ in (f for f in fitting if f[1].by_number):
            others[stream.number] = "its channels have no names, and those of another stream have"
        fitting = [f for f in fitting if not f[1].by_number]
    if not fitting:
        reasons = "; ".join(f"{s}: {others[s.number]}" for s in streams[:5]) or "there are only streams of texts"
        remedy = (
            f"; --column {layout.names[0]}=LABEL names the label of a channel" if any(s.labels for s in streams) else ""
        )
        raise FileFormatError(
            "no stream fits layout '{layout}': {reasons}{remedy}",
            layout=layout.name,
            reasons=reasons,
            remedy=remedy,
            n=0,
        )
    found = [stream for stream, _ in fitting]
    one_source = len({(s.name, s.source, s.format, tuple(s.labels)) for s in found}) == 1
    joined = _joined(found) if len(found) > 1 and one_source else None
    if len(found) > 1 and joined is None:
        listed = ", ".join(f"{s}{f', source {s.source!r}' if s.source else ''}" for s in found[:6])
        raise FileFormatError(
            "{n} streams fit layout '{layout}': {listed}; choose one with --column stream=NAME or stream=#{number}",
            n=len(found),
            layout=layout.name,
            listed=listed,
            number=found[0].number,
        )
    stream, notes = (joined[0], [joined[1]]) if joined else (found[0], [])
    notes += [about_file(f"stream {stream}", note) for note in fitting[0][1].notes]
    return _Toy(stream, fitting[0][1], notes, others)


def _read_markers(streams: Sequence[XdfStream], gestures: GestureSet | None) -> dict[int, list[Marker]]:
    """Return the markers in each stream of events, by its number."""
    return {
        s.number: [
            marker
            for time, sample in zip(s.times_s.tolist(), s.samples, strict=True)
            if np.isfinite(time)
            and (marker := read_marker(time, sample, gestures))
            and not (s.name == MARKERS and marker.text == MARK)
        ]
        for s in streams
        if s.is_irregular and (s.is_text or s.samples.size <= _MOST_EVENTS)
    }


def _spelled(marker: Marker, pattern: ImportPattern) -> Marker:
    """Return a marker with its label as a pattern spells it; one of idle time only ends a recording."""
    label = pattern.label_of(marker.label)
    if not marker.label or pattern.names_gesture(label):
        return replace(marker, label=label)
    return replace(marker, label="", ends=True)


def _find_markers(
    streams: Sequence[XdfStream], gestures: GestureSet | None, choice: str, pattern: ImportPattern | None = None
) -> tuple[list[Marker], dict[int, str], str]:
    """Return the markers, why other streams of events are not used, by their numbers, and a hint if there are none.

    ``choice`` is a name, or # and a number; "" for the stream of the studio, or the only one that names gestures.
    ``pattern`` has other spellings of labels, and those of idle time.

    Raises:
        FileFormatError: if several streams name gestures, or no stream has the chosen name.
    """
    read = _read_markers(streams, gestures)
    if pattern is not None:
        read = {number: [_spelled(marker, pattern) for marker in markers] for number, markers in read.items()}
    events = [s for s in streams if read.get(s.number)]
    listed = "; ".join(f"{s} of {s.format}: {_quoted(m.text for m in read[s.number])}" for s in events[:5])
    if choice:
        chosen = [s for s in events if s.is_named(choice)]
    else:
        # Without a gesture set every text names a gesture; numbers are too often codes of something else.
        naming = [s for s in events if s.is_text or gestures is not None]
        naming = [s for s in naming if any(m.label for m in read[s.number])]
        chosen = [s for s in naming if s.name == MARKERS] or naming
    if (choice and not chosen) or len({s.name for s in chosen}) > 1:
        why = (
            f"no stream '{choice}' has markers" if choice else f"{len(chosen)} streams have texts that may be gestures"
        )
        raise FileFormatError(
            "{why} (there are {listed}): choose one with --column markers=NAME or markers=#NUMBER",
            why=why,
            listed=listed or "none",
            streams=listed,
        )
    others = {s.number: "it is not the stream of markers" for s in events if s.is_text and chosen}
    others |= {s.number: "" for s in chosen}
    markers: list[Marker] = []
    merged = [m for s in chosen for m in read[s.number]]
    for marker in sorted(merged, key=lambda m: m.time_s) if len(chosen) > 1 else merged:
        twice = len(chosen) > 1 and markers and markers[-1].text == marker.text
        if not (twice and marker.time_s - markers[-1].time_s <= _SAME_S):
            markers.append(marker)
    hint = ""
    if events and not chosen:
        hint = f"; there are {listed}: a gesture set (--gestures FILE) says which are gestures"
        if gestures is None and (numbers := [s for s in events if not s.is_text]):
            name = numbers[0].name if len(numbers) == 1 and numbers[0].name else "NAME"
            hint += f", or --column {shlex.quote(f'markers={name}')} takes numbers as gestures"
    return markers, others, hint


def _frames(toy: _Toy, layout: Layout) -> tuple[Frames, NDArray[np.float64], list[int]]:
    """Return the frames of the toy, the time of each in seconds, and the rows after a reset of the clock.

    Notes on rows and values are added to the toy.
    """
    stream, columns = toy.stream, toy.columns
    series = np.asarray(stream.samples, dtype=np.float64).reshape(len(stream.times_s), -1)
    times = stream.times_s
    device = times * 1000.0 if columns.clock is None else series[:, columns.clock]
    good = usable_rows(series[:, columns.channels], times * 1000.0, device)
    if lost := int(np.sum(~good)):
        toy.notes.append(Message("{n} samples without a number in every channel left out", n=lost))
    values, warning = whole_steps(series[good][:, columns.channels], layout)
    toy.notes += [warning] if warning else []
    host_ms = np.round(times[good] * 1000.0).astype(np.int64)
    device_ms = np.round(device[good]).astype(np.int64)
    resets = (np.flatnonzero(np.diff(stream.clock[good])) + 1).tolist()
    return Frames(values, device_ms, host_ms), times[good], resets


def _quoted(texts: Iterable[str]) -> str:
    few = list(dict.fromkeys(texts))
    return ", ".join(f"'{text[:40]}'" for text in few[:8]) + (", …" if len(few) > 8 else "")


_CUTS = (
    "{n} markers name no gesture and begin no recording: {markers}",
    "{n} markers end a recording; a gesture set can make them a gesture (--gestures FILE): {markers}",
    "{n} markers name a gesture where the stream has no samples, and give no recording: {markers}",
    "{n} recordings are cut short by the stream or a marker that names no gesture: {markers}",
)


def _about_cuts(cuts: MarkerCuts, hint: str) -> Iterator[Message]:
    """Yield what is to be said about markers that give no recording, or not quite."""
    for texts, template in zip((cuts.unknown, cuts.zeros, cuts.empty, cuts.shortened), _CUTS, strict=True):
        if texts:
            yield Message(template, n=len(texts), markers=_quoted(texts))
    if not cuts.segments:
        yield Message("no marker gives a recording{hint}", hint=hint)


def convert_xdf(
    path: Path,
    name: str,
    person: str | None,
    spec: ScanSpec,
    scan: SourceScan,
    place: Mapping[str, str] | None = None,
) -> tuple[str, str]:
    """Convert an XDF file, and add its recordings and notes to ``scan``; return the person and the session.

    ``place`` are the parts that its path gives by a pattern: a label makes one recording of the whole file.

    Raises:
        ConfigError: for an unknown role in the columns of ``spec``.
        FileFormatError: for a damaged file, one of an unknown person, or if not exactly one stream matches.
        MissingExtraError: without pyxdf.
    """
    subject, session = person_and_session(path, person)
    place = place or {}
    subject, session = place.get("subject", subject), place.get("session", session)
    if spec.mapping is not None:
        subject = person
    if subject is None:
        raise FileFormatError(
            "the person of '{name}' is not known: name the person with --subjects map.csv (file,subject), or call "
            "the file sub-<code>_ses-<session>.xdf as LabRecorder does",
            name=name,
            needs="person",
        )
    accepted = (STREAM_ROLE, MARKERS_ROLE, DEVICE_MS, *scan.layout.names)
    for role in set(spec.columns) - set(accepted):
        raise ConfigError(f"--column {role}=…: in an XDF file, accepted are {', '.join(accepted)}.")
    target = SessionTarget(spec.new_folder("converted"), subject, session, scan.layout)
    scan.add(_recordings(path, name, target, scan.gestures, spec, place.get("label", "")))
    return subject, session


def _recordings(
    path: Path, display_name: str, target: SessionTarget, gestures: GestureSet | None, spec: ScanSpec, label: str
) -> Iterator[SourceFile | str]:
    """Write the recordings of an XDF file into the new folder of ``target``; yield the files, and notes as text.

    The whole file is a recording of ``label``, unless that is "".
    """
    layout, folder, choices = target.layout, target.folder, spec.columns
    plain = uncompressed(path, folder / "uncompressed", spec.limits)
    good, size = complete_chunks(plain, display_name)
    streams = _load(plain, good, display_name)
    if good < size:
        yield Message(
            "{file}: cut off or damaged from byte {good} of {size} on; the bytes before are used",
            file=display_name,
            good=good,
            size=size,
        )
    toy = _find_toy([s for s in streams if not s.is_text], layout, choices)
    events = [s for s in streams if s.is_text or s.name != toy.stream.name]
    frames, times, resets = _frames(toy, layout)
    others: dict[int, str] = {}
    if label:
        said = spec.pattern.label_of(label) if spec.pattern else label
        cuts, notes = MarkerCuts([LabelledSegment(said, 0, len(times), label)]), toy.notes
    else:
        markers, others, hint = _find_markers(events, gestures, choices.get(MARKERS_ROLE, ""), spec.pattern)
        tolerance_s = max(layout.gap_ms / 1000.0, 2.0 / layout.rate_hz)
        cuts = cut_by_markers(markers, times, resets, tolerance_s) if len(times) else MarkerCuts()
        notes = [*toy.notes, *_about_cuts(cuts, hint)]
    yield from (about_file(display_name, note) for note in notes)
    if not len(frames):
        raise FileFormatError(
            "the stream '{stream}' has no sample with a number in every channel",
            stream=toy.stream.name,
            n=layout.n_channels,
        )
    about = {"stream": toy.stream.name, "type": toy.stream.type, "nominal_rate_hz": toy.stream.rate}
    original = ConvertedSource(path, display_name, about)
    inner = replace(target, folder=folder / "session")
    yield from write_session(inner, original, frames, cuts.segments, with_stream=not label)
    for stream in streams:
        if reason := (toy.others | others).get(stream.number):
            yield SourceFile(path, LEFT_OUT, origin=f"{display_name}: stream '{stream.name}'", reason=reason)
