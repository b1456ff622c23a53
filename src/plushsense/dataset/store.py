"""Read and write the files of a data set folder.

dataset.toml                 version, name, licence, consent statement; the layout and gesture set in full
recordings/<subject>/*.csv   raw recordings, never rewritten
streams/<subject>/*.csv      raw session streams, or files with a label on every row
marks.jsonl                  decisions about recordings, append-only (`dataset.marks`)
recordings.csv, streams.csv  index of the files above, replaced atomically
index.json                   fingerprint of the indexed files; if it differs, the index is rebuilt
subjects.csv                 people by code: age group, gender, consent reference; never names
forgotten.jsonl              a line for each removed person, without identifying them
cache/                       can be deleted
"""

from __future__ import annotations

import csv
import hashlib
import html
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeVar

import tomli_w

from plushsense.core.errors import DatasetError, FileFormatError, ForgottenError
from plushsense.core.files import refuse_special_files, write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames, ReadResult, read_bytes, read_recording, read_stream
from plushsense.core.sentences import plural
from plushsense.core.toml import load_table, read_toml
from plushsense.dataset.about import About, HeadFile
from plushsense.dataset.marks import LabelledStretch, Mark, MarkState, append_marks, apply_mark, locked, read_marks
from plushsense.recording.takes import duration_s

FORMAT_VERSION = 1
HEAD = "dataset.toml"
RECORDINGS = "recordings"
STREAMS = "streams"
PEOPLE = "subjects.csv"
SAVED_SETS = ("train", "validation", "test")
"""Sets of windows in an imported file; the session of a recording names those that it lay in."""
UNKNOWN_SUBJECT = "unknown"
FORGOTTEN = "forgotten.jsonl"
UNDER_WAY = "forgetting.json"
PEOPLE_COLUMNS = {
    "subject": "code of the person, never a name; must be there, each code once",
    "age_group": "age group, such as child",
    "gender": "gender",
    "consent": "reference of the signed consent",
}

Progress = Callable[[int, int], None]
"""Called with the work done and its total."""


@dataclass(frozen=True)
class Generation:
    """The number of people removed from a data set so far, to prevent that results of a removed person are written.

    `forget` holds the data set's lock while it removes a person and appends a line to ``forgotten.jsonl``. Code that
    writes results holds the same lock and checks that the number of lines is that at the time of opening the data set.
    """

    folder: Path
    removals: int

    @classmethod
    def of(cls, folder: Path) -> Generation:
        """Return the current generation of the data set in ``folder``; call it before any data is read."""
        try:
            return cls(folder, (folder / FORGOTTEN).read_bytes().count(b"\n"))
        except (FileNotFoundError, NotADirectoryError):
            return cls(folder, 0)

    def check(self) -> None:
        """Raise ForgottenError if a person has been removed since, or is being removed, or the data set is gone."""
        if not (self.folder / HEAD).is_file():
            raise ForgottenError(
                "The data set '{folder}' was moved or deleted while this ran, so its results were not written: run "
                "it again on the data set where it is now.",
                folder=self.folder,
            )
        if self.of(self.folder) != self:
            raise ForgottenError(
                "A person was removed from '{folder}' (plushsense forget) while this ran, so its results were not "
                "written: run it again on the data set as it is now.",
                folder=self.folder,
            )
        if (self.folder / UNDER_WAY).exists():
            raise ForgottenError(
                "The removal of a person from '{folder}' is not finished, so nothing was written: run  plushsense "
                "forget  there first.",
                folder=self.folder,
            )

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the data set's lock (`locked`) while derived data is written, after `check`; do not nest.

        Raises:
            ForgottenError: like `check`.
            DatasetError: if another program holds the lock for too long.
        """
        # The lock file would create the folder again.
        self.check()
        with locked(self.folder):
            self.check()
            yield


def writing_around(path: Path) -> Callable[[], AbstractContextManager[None]]:
    """Return `Generation.writing` of the data set whose folder contains ``path``; if none does, it has no effect.

    Call this before results in ``path`` are read, for code that derives others from them without the data set.
    """
    folder = next((p for p in path.resolve().parents if (p / HEAD).is_file()), None)
    return nullcontext if folder is None else Generation.of(folder).writing


@dataclass(frozen=True)
class _Row:
    """A typed row of an index file."""

    @classmethod
    def from_text(cls, row: dict[str, str], where: str) -> Self:
        try:
            known = (f for f in fields(cls) if f.name in row or f.default is MISSING)
            return cls(**{f.name: _PARSERS[str(f.type)](row[f.name]) for f in known})
        except (KeyError, ValueError, TypeError) as cause:
            raise DatasetError(
                f"The index '{where}' is damaged ({cause}): delete it, it is rebuilt from the recordings."
            ) from None

    def to_text(self) -> dict[str, str]:
        return {name: _cell(value) for name, value in vars(self).items()}


_PARSERS: dict[str, Callable[[str], Any]] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": lambda text: text == "yes",
    "tuple[str, ...]": lambda text: tuple(t for t in text.split(" | ") if t),
}


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return " | ".join(value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class RecordingInfo(_Row):
    """A row of the recording index.

    The recording is rows ``first_row`` to ``first_row + rows`` of ``file``, of which ``start`` to ``stop`` remain after
    trimming. ``recorded`` is the gesture that it is named after, ``gesture`` the one that marks state, by default the
    same. It begins at ``stream_row`` of ``stream`` (−1: not found). ``start_ms`` is the device clock at the first
    row, ``epoch_ms`` the wall clock.
    """

    id: str
    subject: str
    session: str
    gesture: str
    file: str
    first_row: int
    rows: int
    start: int
    stop: int
    stream: str
    stream_row: int
    start_ms: int
    epoch_ms: int
    rate_hz: float
    excluded: bool
    flags: tuple[str, ...]
    sha256: str
    recorded: str = ""

    def __post_init__(self) -> None:
        # An index of an earlier version has no such column.
        if not self.recorded:
            object.__setattr__(self, "recorded", self.gesture)

    @property
    def seconds(self) -> float:
        """Duration of the rows in use, after trimming, by `duration_s`."""
        return duration_s(self.stop - self.start, self.rate_hz)

    @property
    def whole_seconds(self) -> float:
        """Duration of all rows, by `duration_s`."""
        return duration_s(self.rows, self.rate_hz)


@dataclass(frozen=True)
class StreamInfo(_Row):
    """A row of the stream index."""

    id: str
    subject: str
    session: str
    file: str
    rows: int
    seconds: float
    restarts: int
    flags: tuple[str, ...]
    sha256: str


def write_index(path: Path, rows: Iterable[_Row], kind: type[_Row]) -> None:
    """Write an index file atomically."""
    out = io.StringIO()
    writer = csv.DictWriter(out, [f.name for f in fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(row.to_text() for row in rows)
    write_file(path, out.getvalue())


R = TypeVar("R", bound=_Row)


def read_index(path: Path, kind: type[R]) -> list[R]:
    """Read the rows of an index file; raise DatasetError if it is damaged."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [kind.from_text(row, path.name) for row in csv.DictReader(file)]
    except (UnicodeDecodeError, csv.Error) as cause:
        raise DatasetError(
            f"The index '{path.name}' is damaged ({cause}): delete it, it is rebuilt from the recordings."
        ) from None


@dataclass(frozen=True)
class DatasetHead:
    """Contents of ``dataset.toml``."""

    name: str
    layout: Layout
    gestures: GestureSet
    version: str = "1.0.0"
    licence: str = ""
    consent: str = ""
    source: str = ""
    simulated: bool = False
    about: About = field(default_factory=About)

    def __post_init__(self) -> None:
        named = {key: getattr(self, key) for key in ("name", "version", "licence", "consent", "source")}
        for key, text in _texts_by_key(named | {"about": self.about.to_table()}):
            if found := _NO_XML.search(text):
                raise DatasetError(
                    "'{key}' of the data set holds the control character U+{ord:04X}: remove it.",
                    key=key,
                    ord=ord(found.group()),
                )

    def to_toml(self) -> str:
        """Return the text of ``dataset.toml``."""
        table = {
            "format": FORMAT_VERSION,
            **{k: getattr(self, k) for k in ("name", "version", "licence", "consent", "source", "simulated")},
            **({"about": about} if (about := self.about.to_table()) else {}),
            "layout": self.layout.to_dict(),
            "gesture_set": self.gestures.to_dict(),
        }
        return tomli_w.dumps(json.loads(json.dumps(table)))

    @classmethod
    def read(cls, folder: Path) -> DatasetHead:
        """Read the head of the data set in ``folder``; raise DatasetError if the folder is missing or no data set."""
        path = folder / HEAD
        if not folder.is_dir():
            raise DatasetError("There is no folder '{folder}': give the folder of a data set.", folder=folder)
        if not path.is_file():
            raise DatasetError(
                "'{folder}' is not a data set (it has no {head}): create one with  plushsense import SRC {folder}",
                folder=folder,
                head=HEAD,
            )
        refuse_special_files(folder, DatasetError)
        table = read_toml(path, "data set", DatasetError)
        version = table.pop("format", None)
        if version != FORMAT_VERSION:
            raise DatasetError(
                "'{path}' has the format {version}; this PlushSense reads {format_version}: update PlushSense.",
                path=path,
                version=version,
                format_version=FORMAT_VERSION,
                folder=folder.name,
            )
        file = load_table(table, HeadFile, f"'{path}'", DatasetError, "The data set cannot be opened. {problem}")
        values = vars(file) | {
            "layout": Layout.from_dict(file.layout, f"layout in '{path}'"),
            "gestures": GestureSet.from_dict(file.gesture_set, f"gesture set in '{path}'"),
            "about": load_table(file.about, About, f"[about] in '{path}'", DatasetError),
        }
        del values["gesture_set"]
        return cls(**values)


# What no metadata file in XML can hold.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _texts_by_key(value: object, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield the texts in tables and lists with their keys, such as ``about.creators[0].name``."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _texts_by_key(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        for n, inner in enumerate(value):
            yield from _texts_by_key(inner, f"{key}[{n}]")
    elif isinstance(value, str):
        yield key, value


@dataclass(frozen=True)
class GestureCounts:
    """Numbers of the used recordings of a gesture and of their people, and the median duration."""

    label: str
    affect: str
    recordings: int
    subjects: int
    median_s: float | None


_CACHED_BYTES = 64 << 20


class Dataset:
    """A data set, opened for reading.

    ``generation`` protects results derived from it (see `Generation`); get it before any file is read.
    """

    def __init__(
        self,
        path: Path,
        head: DatasetHead,
        recordings: list[RecordingInfo],
        streams: list[StreamInfo],
        generation: Generation | None = None,
    ):
        self.generation = generation or Generation.of(path)
        self.path = path
        self.head = head
        self.recordings = recordings
        self.streams = streams
        self._stored_layout = head.layout
        self._with_stretches = True
        self._cached: dict[str, Frames] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Workers read the streams that they need.
        return self.__dict__ | {"_cached": {}}

    def with_inputs(self, layout: Layout) -> Dataset:
        """Return this data set as a network with ``layout`` reads it; itself if it is of other channels.

        Besides the inputs, offsets, valid ranges, rate, gap and self-calibration become those of ``layout``: in a data
        set, they may have been measured when it was imported (`Layout.reads_as`).
        """
        own = self.layout
        keys = ("channels", "rate_hz", "gap_ms", "inputs", "derived", "self_calibration")
        given = {key: getattr(layout, key) for key in keys}
        if not own.reads_as(layout) or given == {key: getattr(own, key) for key in given}:
            return self
        head = replace(self.head, layout=replace(own, **given))
        return self._copy(head, self.recordings)

    def with_gestures(self, gestures: GestureSet) -> Dataset:
        """Return this data set with recordings named by a set of merged gestures; itself if none of them is merged."""
        if not any(gesture.labels for gesture in gestures.gestures):
            return self
        names = {g.label: found.label for g in self.gestures.gestures if (found := gestures.find(g.label)) is not None}
        others = tuple(g for g in self.gestures.gestures if g.label not in names)
        head = replace(self.head, gestures=GestureSet(gestures.name, (*gestures.gestures, *others)))
        recordings = [replace(r, gesture=names.get(r.gesture, r.gesture)) for r in self.recordings]
        return self._copy(head, recordings)

    def only_people(self, people: Iterable[str]) -> Dataset:
        """Return this data set with the recordings of some people only."""
        chosen = set(people)
        return self._copy(self.head, [r for r in self.recordings if r.subject in chosen])

    def without(self, recordings: Iterable[str]) -> Dataset:
        """Return this data set with some recordings, given by their ids, excluded as by a mark."""
        chosen = set(recordings)
        return self._copy(self.head, [replace(r, excluded=r.excluded or r.id in chosen) for r in self.recordings])

    def without_stretches(self) -> Dataset:
        """Return this data set without the labels of `stretches`, as if no stream had any."""
        other = self._copy(self.head, self.recordings)
        other._with_stretches = False
        return other

    def _copy(self, head: DatasetHead, recordings: list[RecordingInfo]) -> Dataset:
        other = Dataset(self.path, head, recordings, self.streams, self.generation)
        other._stored_layout, other._with_stretches = self._stored_layout, self._with_stretches
        return other

    @property
    def layout(self) -> Layout:
        """The sensor layout of every recording."""
        return self.head.layout

    @property
    def gestures(self) -> GestureSet:
        """The gesture set, in class order."""
        return self.head.gestures

    @property
    def subjects(self) -> list[str]:
        """Codes of the people, sorted, without "none" (nobody) and "unknown"."""
        return sorted({r.subject for r in self.recordings} - {NOBODY, UNKNOWN_SUBJECT})

    @property
    def used(self) -> list[RecordingInfo]:
        """Recordings that are not excluded by a mark."""
        return [r for r in self.recordings if not r.excluded]

    @cached_property
    def stretches(self) -> tuple[LabelledStretch, ...]:
        """Stretches of the streams that marks label, by stream and row, without the rows of located recordings.

        They are read from the marks at the first use.
        """
        marks = read_marks(self.path) if self._with_stretches and self.streams else {}
        return tuple(
            s for stream in self.streams for s in self._stretches_in(stream, marks.get(stream.id, MarkState()))
        )

    def _stretches_in(self, stream: StreamInfo, marks: MarkState) -> list[LabelledStretch]:
        pieces = [piece for s in marks.stretches for piece in s.outside(stream.rows, -1)]
        for r in self.recordings:
            if pieces and r.stream == stream.id and r.stream_row >= 0:
                first, last = r.stream_row + r.start, r.stream_row + r.stop
                pieces = [rest for piece in pieces for rest in piece.outside(first, last)]
        return pieces

    def append_marks(self, marks: Iterable[Mark]) -> tuple[Mark, ...]:
        """Append those of ``marks``, in their order, that change something, and return them.

        This object is not updated: open the data set again.

        Raises:
            ForgottenError: if a person was removed since the data set was opened, see `Generation.check`.
            DatasetError: like `plushsense.dataset.marks.append_marks`.
        """
        standing, new = dict(read_marks(self.path)), []
        for mark in marks:
            before = standing.get(mark.recording, MarkState())
            standing[mark.recording] = apply_mark(before, mark)
            if standing[mark.recording] != before:
                new.append(mark)
        append_marks(self.path, new, self.generation.check)
        return tuple(new)

    def read(self, recording: RecordingInfo) -> Frames:
        """Read the rows of one recording that remain after trimming."""
        if self.layout.is_labelled:
            return self.read_stream(recording.stream).slice(
                recording.first_row + recording.start, recording.first_row + recording.stop
            )
        return self._frames(read_recording, recording).slice(recording.start, recording.stop)

    def read_stream(self, stream: str) -> Frames:
        """Read the rows of one session stream; the latest are cached, as a training reads all of them several times."""
        if stream not in self._cached:
            info = next((s for s in self.streams if s.id == stream), None)
            if info is None:
                raise DatasetError(f"Data set '{self.head.name}' has no stream '{stream}'.")
            self._cached[stream] = self._frames(read_stream, info)
            while len(self._cached) > 1 and sum(f.values.nbytes for f in self._cached.values()) > _CACHED_BYTES:
                del self._cached[next(iter(self._cached))]
        return self._cached[stream]

    def read_people(self, subjects: Iterable[str]) -> Iterator[Frames]:
        """Yield the frames of each person's streams, or of their used recordings if there are none."""
        for subject in subjects:
            streams = [s for s in self.streams if s.subject == subject]
            if streams:
                yield from (self.read_stream(s.id) for s in streams)
            else:
                yield from (self.read(r) for r in self.used if r.subject == subject)

    def _frames(self, read: Callable[..., ReadResult], info: RecordingInfo | StreamInfo) -> Frames:
        path = self.path / info.file
        try:
            data = read_bytes(path)
            if hashlib.sha256(data).hexdigest() != info.sha256:
                raise FileFormatError(
                    "'{file}' is not the file that was imported (its SHA-256 differs): restore it from a backup.",
                    file=path,
                )
            return read(path, self.layout, data).frames
        except FileFormatError:
            # The file may have been deleted because its person was removed.
            self.generation.check()
            raise

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the layout, the streams, their labels and all used recordings with person, gesture, trimming."""
        digest = hashlib.sha256(json.dumps(self._stored_layout.to_dict(), sort_keys=True).encode())
        for r in sorted(self.used, key=lambda r: r.id):
            digest.update(
                repr((r.id, r.subject, r.gesture, r.sha256, r.first_row, r.start, r.stop, r.stream_row)).encode()
            )
        for s in sorted(self.streams, key=lambda s: s.id):
            digest.update(repr((s.id, s.sha256)).encode())
        for stretch in sorted(self.stretches, key=lambda s: (s.stream, s.start)):
            digest.update(repr((stretch.stream, stretch.start, stretch.stop, stretch.label)).encode())
        return digest.hexdigest()

    def gesture_counts(self) -> list[GestureCounts]:
        """Count the used recordings of each gesture of the set."""
        counts = []
        for gesture in self.gestures.gestures:
            recordings = [r for r in self.used if r.gesture == gesture.label]
            seconds = sorted(r.seconds for r in recordings if r.rate_hz > 0)
            people = {r.subject for r in recordings} - {NOBODY, UNKNOWN_SUBJECT}
            median_s = round(seconds[len(seconds) // 2], 2) if seconds else None
            counts.append(GestureCounts(gesture.label, gesture.affect, len(recordings), len(people), median_s))
        return counts

    def summary(self) -> dict[str, object]:
        """Return counts for JSON: people, recordings, streams, durations by gesture."""
        return {
            "name": self.head.name,
            "licence": self.head.licence or None,
            "layout": self.layout.name,
            "simulated": self.head.simulated,
            "recordings": len(self.recordings),
            "excluded": len(self.recordings) - len(self.used),
            "trimmed": sum(r.stop - r.start < r.rows for r in self.used),
            "offsets": {c.name: c.offset for c in self.layout.channels if c.offset},
            "subjects": len(self.subjects),
            "streams": len(self.streams),
            "located_in_stream": sum(r.stream_row >= 0 for r in self.recordings),
            "with_warnings": sum(bool(r.flags) for r in self.recordings),
            "gestures": [vars(counts) for counts in self.gesture_counts()],
            "hash": self.hash,
        }

    def __repr__(self) -> str:
        return (
            f"Dataset({self.head.name!r}: {plural(len(self.recordings), 'recording')}, "
            f"{plural(len(self.subjects), 'person')}, {plural(len(self.gestures), 'gesture')}, "
            f"{plural(len(self.streams), 'stream')})"
        )

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{html.escape(g.label)}</td><td>{g.affect}</td><td>{g.recordings}</td>"
            f"<td>{g.subjects}</td><td>{'' if g.median_s is None else g.median_s}</td></tr>"
            for g in self.gesture_counts()
        )
        head = "".join(f"<th>{h}</th>" for h in ("gesture", "affect", "recordings", "people", "median s"))
        return f"<p>{html.escape(repr(self))}</p><table><tr>{head}</tr>{rows}</table>"


@dataclass(frozen=True)
class PersonInfo:
    """Information about a person; unknown values are "", ``more`` holds columns that the user added."""

    subject: str
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    more: dict[str, str] = field(default_factory=dict)


def read_people(path: Path) -> dict[str, PersonInfo]:
    """Read a people's file, or that of the data set folder ``path``, by code; empty if there is no such file.

    Raises:
        DatasetError: if the column ``subject`` is missing, or a code is missing or repeated.
    """
    path = path / PEOPLE if path.is_dir() else path
    people: dict[str, PersonInfo] = {}
    try:
        columns, rows = read_csv_rows(path, "people's file")
    except FileNotFoundError:
        return people
    if "subject" not in columns or len(set(columns)) != len(columns):
        raise DatasetError(
            f"The people's file '{path}' has the columns {', '.join(columns) or 'nothing'}; it needs 'subject', "
            f"accepted besides are {', '.join([*PEOPLE_COLUMNS][1:])} and others of your own, each once."
        )
    for line, cells in rows:
        code = cells.pop("subject")
        if not code or code in people:
            problem = (
                f"names '{code}' again: give one line per person" if code else "names no subject: fill in the code"
            )
            raise DatasetError(f"The people's file '{path}' line {line} {problem}.")
        known = {key: cells.pop(key, "") for key in [*PEOPLE_COLUMNS][1:]}
        people[code] = PersonInfo(code, **known, more=cells)
    return people


def read_csv_rows(path: Path, kind: str) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Read a CSV file that a user wrote, separated by ``,`` or ``;``.

    Returns:
        The columns in lower case, and the line number and cells by column of each row; missing cells are "".

    Raises:
        FileNotFoundError: when there is no such file.
        DatasetError: for a file that cannot be read; ``what`` describes the file in the message.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        first = text.partition("\n")[0]
        reader = csv.DictReader(io.StringIO(text), delimiter=";" if ";" in first else ",", strict=True)
        columns = reader.fieldnames = [c.strip().casefold() for c in reader.fieldnames or ()]
        rows = []
        for row in reader:
            cells = {k: (v or "").strip() for k, v in row.items() if isinstance(k, str) and not isinstance(v, list)}
            rows.append((reader.line_num, cells))
    except FileNotFoundError:
        raise
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise DatasetError(f"The {kind} '{path}' cannot be read ({cause}): give a CSV file in UTF-8.") from None
    return columns, rows


def write_people(folder: Path, people: Iterable[PersonInfo]) -> None:
    """Replace the people's file of the data set in ``folder``, sorted by code."""
    by_code = sorted(people, key=lambda p: p.subject)
    more = list(dict.fromkeys(key for p in by_code for key in p.more))
    out = io.StringIO()
    writer = csv.DictWriter(out, [*PEOPLE_COLUMNS, *more], lineterminator="\n", restval="")
    writer.writeheader()
    for p in by_code:
        writer.writerow(p.more | {key: getattr(p, key) for key in PEOPLE_COLUMNS})
    write_file(folder / PEOPLE, out.getvalue())


def sets_of_session(session: str, windows: int) -> list[str]:
    """Return the set of each of the ``windows`` of a recording, as many as it had in the file; [] if it was in none."""
    names, counts = session.split()[::2], session.split()[1::2]
    if not names or not set(names) <= set(SAVED_SETS):
        return []
    if not counts:
        return names * windows if len(names) == 1 else []
    if len(counts) != len(names) or not all(n.isascii() and n.isdigit() and len(n) < 7 for n in counts):
        return []
    return [name for name, n in zip(names, counts, strict=True) for _ in range(int(n))]
