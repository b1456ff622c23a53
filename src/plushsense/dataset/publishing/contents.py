"""Write the published data set: raw files with shifted times and plain columns, and nothing private.

Raw files are rewritten with the layout's column keys, one separator and shifted times; sidecars, header notes and
malformed lines are not included. Sessions are numbered, since their names may be dates. Marks are written without their
author, reason and time. On request, people get new codes (`keys`).
"""

from __future__ import annotations

import hmac
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import NOBODY, Gesture, GestureSet
from plushsense.core.layouts import DEVICE_MS, HOST_MS, CsvFormat
from plushsense.core.recorder_csv import (
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    parse_name,
    read_recording,
    read_stream,
    recording_filename,
)
from plushsense.core.sentences import Message, join_names
from plushsense.dataset.files import walk_files
from plushsense.dataset.index import DUPLICATE_FOLDER, build_index
from plushsense.dataset.marks import MARKS, PRACTICE, Mark, MarkState, mark_line, read_marks
from plushsense.dataset.privacy.searching import NamePatterns, words_of_rows
from plushsense.dataset.publishing.keys import KEPT, PublicationKey
from plushsense.dataset.publishing.texts import is_misread, label_prefix, public_label
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    STREAMS,
    Dataset,
    DatasetHead,
    PersonInfo,
    Progress,
    RecordingInfo,
    StreamInfo,
    read_people,
    write_people,
)

YEAR_2000_MS = 946_684_800_000
_SPREAD_MS = 366 * 86_400_000
# Limit of all shifted times; the sessions of one person may be a few years apart.
LATEST_MS = 1_262_304_000_000
_FAR_MS = 9 * 366 * 86_400_000
# A 32-bit clock in ms wraps after 49 days; larger values are dates.
WALL_CLOCK_MS = 2**32
# What of a recording must be the same in the package.
_facts_of = attrgetter("gesture", "rows", "first_row", "start", "stop", "excluded")


@dataclass(frozen=True)
class Shift:
    """Time shift of one person from ``anchor_ms`` to ``target_ms``; ``device``: also shift the device clock."""

    anchor_ms: int
    target_ms: int
    device: bool

    def plausible(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which times are near the anchor; others are transmission errors and, shifted, could reveal it."""
        return (times >= self.anchor_ms - _SPREAD_MS) & (times < self.anchor_ms + _FAR_MS)

    def times(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Shift times; replace an implausible one by the last plausible one before it."""
        good = self.plausible(times)
        if not good.all():
            if not good.any():
                return np.full(len(times), self.target_ms, dtype=np.int64)
            last = np.maximum.accumulate(np.where(good, np.arange(len(times)), -1))
            times = times[np.where(last < 0, int(np.argmax(good)), last)]
        return times - self.anchor_ms + self.target_ms

    def time(self, time: int) -> int | None:
        """Shift one time; None if it is implausible."""
        return time - self.anchor_ms + self.target_ms if self.plausible(np.array([time]))[0] else None

    def frames(self, frames: Frames, keep_host: bool) -> Frames:
        """Return the rows with shifted clocks, without the host's unless ``keep_host``; the values are not copied."""
        host = self.times(frames.host_ms) if keep_host and frames.host_ms is not None else None
        device = self.times(frames.device_ms) if self.device else frames.device_ms
        return replace(frames, host_ms=host, device_ms=device)


def shift_of(subject: str, firsts: list[int], device: bool, key: bytes) -> Shift:
    """Return the time shift of one person.

    Args:
        firsts: the first wall-clock time of each of the person's files.
        device: whether the device clock is a wall clock too.
        key: the secret from which the new time is derived; the same key gives the same shift.
    """
    drawn = int.from_bytes(hmac.digest(key, subject.encode("utf-8"), "sha256")[:8], "big") % _SPREAD_MS
    # The median decides which times are plausible, so that one damaged file has no effect.
    middle = sorted(firsts)[len(firsts) // 2] if firsts else 0
    near = [t for t in firsts if abs(t - middle) <= _FAR_MS // 2]
    return Shift(min(near, default=0), YEAR_2000_MS + drawn, device)


@dataclass(frozen=True)
class ContentsSpec:
    """What to publish of a data set.

    Attributes:
        streams: whether to include the streams of whole sessions.
        excluded: whether to include excluded recordings, marked as such.
        key: the key of the time shifts and, with ``pseudonyms``, of the new codes; a new one by default.
        pseudonyms: whether people get the codes of ``key`` instead of their own.
    """

    streams: bool = True
    excluded: bool = False
    key: PublicationKey = field(default_factory=PublicationKey)
    pseudonyms: bool = False


@dataclass(frozen=True)
class PackageContents:
    """Published data set, its people, and the original recording of each published id, under public labels."""

    dataset: Dataset
    people: dict[str, PersonInfo]
    origin: dict[str, RecordingInfo]
    notes: tuple[Message, ...]


class ContentsWriter:
    """Writer of the published data set into the new ``folder``; every written file is read again and compared.

    Raises:
        DatasetError: if no recording is left to publish, or a file would differ from the original.
    """

    def __init__(
        self, dataset: Dataset, folder: Path, head: DatasetHead, spec: ContentsSpec, progress: Progress
    ) -> None:
        self.source = dataset
        self.folder = folder
        self.spec = spec
        self.progress = progress
        self.labelled = dataset.layout.is_labelled
        self.notes: list[Message] = []
        if self.labelled and not spec.streams:
            raise DatasetError(
                "'{path}' holds its recordings as parts of streams: it cannot be published without streams.",
                path=dataset.path,
            )
        codes = public_codes(dataset, spec)
        self.kept = [r for r in dataset.recordings if spec.excluded or self.labelled or not r.excluded]
        self.streams = list(dataset.streams) if spec.streams else []
        if spec.pseudonyms:
            # In the order of the new codes, so that neither marks nor times of files reveal the old order.
            self.kept.sort(key=lambda r: codes[_folder_of(r.file)])
            self.streams.sort(key=lambda s: codes[_folder_of(s.file)])
        if not self.kept:
            raise DatasetError("'{path}' has no recording left to publish: every one is excluded.", path=dataset.path)
        clocks = (HOST_MS, DEVICE_MS) if self._all_have_host() else (DEVICE_MS,)
        columns = (*clocks, *dataset.layout.names, *(("label",) if self.labelled else ()))
        self.layout = replace(dataset.layout, csv=CsvFormat(columns, columns, ","))
        self.label = public_labels(dataset)
        self.head = replace(head, layout=self.layout, gestures=self._gestures(), source="")
        folders = {_folder_of(r.file) for r in self.kept} | {_folder_of(s.file) for s in self.streams}
        self.codes = {folder: public for folder, public in codes.items() if folder in folders}
        self.shifts = self._shifts()
        self.sessions = self._sessions()
        self.taken: set[str] = set()

    def write(self) -> PackageContents:
        """Write all files; return the published data set, with notes on what was left out or changed."""
        infos: list[StreamInfo | RecordingInfo] = [*self.streams, *([] if self.labelled else self.kept)]
        files: dict[str, str] = {}
        for done, info in enumerate(infos, 1):
            if isinstance(info, StreamInfo):
                files[info.file] = self._write_stream(info)
            else:
                files[info.file] = self._write_recording(info)
            self.progress(done, len(infos))
        people = self._write_people()
        ids = {r.id: self._id(r, files) for r in self.kept}
        self._write_marks(ids, files)
        (self.folder / HEAD).write_text(self.head.to_toml(), encoding="utf-8", newline="\n")
        built = build_index(self.folder, self.head)
        published = {r.id: r for r in built.dataset.recordings}
        origin = {ids[r.id]: replace(r, gesture=self.label(r.gesture)) for r in self.kept}
        odd = [*built.unreadable, *(published.keys() ^ origin.keys())]
        odd += [name for name, r in origin.items() if name in published and _facts_of(r) != _facts_of(published[name])]
        if odd:
            raise DatasetError("The package would differ from the data set in '{name}'. Please report it.", name=odd[0])
        self._note_changes(built.dataset, origin)
        return PackageContents(built.dataset, people, origin, tuple(self.notes))

    def _write_stream(self, stream: StreamInfo) -> str:
        code = _folder_of(stream.file)
        number = self.sessions[code][stream.session]
        folder = f"{STREAMS}/{self.codes[code]}"
        if self.labelled:
            target = self._free(f"{folder}/{number}.csv")
        else:
            target = self._free(f"{folder}/{self._inner(code, stream.session)}{STREAM_NAME}")
        raw = read_stream(self.source.path / stream.file, self.source.layout).frames
        if raw.labels is not None:
            raw = replace(raw, labels=np.array(list(map(self.label, raw.labels.tolist()))))
        self._put(target, self.shifts[code].frames(raw, self._host), raw.values)
        return target

    def _write_recording(self, recording: RecordingInfo) -> str:
        code = _folder_of(recording.file)
        name = parse_name(Path(recording.file).name)
        if name is None:
            raise DatasetError("'{file}' is not named <label>_<epoch ms>_<rows>.csv.", file=recording.file)
        raw = read_recording(self.source.path / recording.file, self.source.layout)
        frames = raw.frames
        if raw.integrated and recording.stream_row >= 0 and self.streams:
            # A clock summed from delays begins at 0: use the stream's clock, by which the recording can be located.
            at = int(self.source.read_stream(recording.stream).device_ms[recording.stream_row])
            frames = replace(frames, device_ms=frames.device_ms - frames.device_ms[0] + at)
        shift = self.shifts[code]
        shifted = shift.frames(frames, self._host)
        epoch = shift.time(name.epoch_ms)
        if epoch is None:
            clock = shifted.host_ms if shifted.host_ms is not None else shifted.device_ms
            epoch = int(clock[0])
        folder = f"{RECORDINGS}/{self.codes[code]}/{self._inner(code, recording.session)}"
        target = self._free(folder + recording_filename(self.label(name.label), max(0, epoch), name.rows))
        self._put(target, shifted, frames.values)
        return target

    def _put(self, target: str, frames: Frames, values: object) -> None:
        path = self.folder / target
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(format_header(self.layout) + format_rows(frames, self.layout), encoding="utf-8", newline="\n")
        back = read_recording(path, self.layout)
        same = (
            back.malformed == 0
            and np.array_equal(back.frames.values, values)  # type: ignore[arg-type]
            and np.array_equal(back.frames.device_ms, frames.device_ms)
            and (frames.labels is None or np.array_equal(back.frames.labels, frames.labels))  # type: ignore[arg-type]
        )
        if not same:
            raise DatasetError(
                "'{name}' would differ from the recording when it is read. Please report it.", name=target
            )

    def _free(self, path: str) -> str:
        """Return a path below the data folder that is unused, also on file systems that ignore case."""
        place, _, name = path.rpartition("/")
        number = 2
        while path.casefold() in self.taken:
            path = f"{place}/{DUPLICATE_FOLDER}{number}/{name}"
            number += 1
        self.taken.add(path.casefold())
        return path

    def _inner(self, code: str, session: str) -> str:
        return f"{self.sessions[code][session]}/" if len(self.sessions[code]) > 1 else ""

    def _id(self, recording: RecordingInfo, files: dict[str, str]) -> str:
        target = Path(files[recording.file])
        identity = target.relative_to(target.parts[0]).with_suffix("").as_posix()
        if not self.labelled:
            return identity
        number = recording.id.removeprefix(f"{recording.stream}#").partition(" ")[0]
        return f"{identity}#{number} {self.label(recording.recorded)}"

    @property
    def _host(self) -> bool:
        return HOST_MS in self.layout.csv.columns

    def _gestures(self) -> GestureSet:
        def public(g: Gesture) -> Gesture:
            labels = tuple(map(self.label, g.labels))
            return replace(g, label=self.label(g.label), family=self.label(g.family), labels=labels)

        gestures = self.source.gestures
        return replace(gestures, gestures=tuple(map(public, gestures.gestures)))

    def _all_have_host(self) -> bool:
        if HOST_MS not in self.source.layout.csv.columns:
            return False
        layout, folder = self.source.layout, self.source.path
        lacking = sum(read_stream(folder / s.file, layout).frames.host_ms is None for s in self.streams)
        if not self.labelled:
            lacking += sum(read_recording(folder / r.file, layout).frames.host_ms is None for r in self.kept)
        if lacking:
            self.notes.append(
                Message("Left out: the computer's clock, since {n:file} lacked it; the toy's clock is kept.", n=lacking)
            )
        return lacking == 0

    def _shifts(self) -> dict[str, Shift]:
        shifts = {}
        for code in self.codes:
            mine = [r for r in self.kept if _folder_of(r.file) == code]
            firsts = [r.epoch_ms for r in mine]
            clocks = [r.start_ms for r in mine]
            for stream in () if mine else [s for s in self.streams if _folder_of(s.file) == code]:
                frames = read_stream(self.source.path / stream.file, self.source.layout).frames
                firsts.append(int((frames.device_ms if frames.host_ms is None else frames.host_ms)[0]))
                clocks.append(int(frames.device_ms[0]))
            shifts[code] = shift_of(code, firsts, max(clocks, default=0) >= WALL_CLOCK_MS, self.spec.key.secret)
        return shifts

    def _sessions(self) -> dict[str, dict[str, int]]:
        """Number each person's sessions by time; sessions without a recording come last."""
        numbered = {}
        for code in self.codes:
            began: dict[str, int] = {}
            for r in self.kept:
                if _folder_of(r.file) == code:
                    began[r.session] = min(r.epoch_ms, began.get(r.session, r.epoch_ms))
            rest = sorted({s.session for s in self.streams if _folder_of(s.file) == code} - set(began))
            ordered = [name for _, name in sorted((at, name) for name, at in began.items())] + rest
            numbered[code] = {name: number for number, name in enumerate(ordered, 1)}
        return numbered

    def _write_people(self) -> dict[str, PersonInfo]:
        known = read_people(self.source.path)
        people = {
            public: PersonInfo(public, p.age_group, p.gender)
            for code, public in self.codes.items()
            if (p := known.get(code)) is not None
        }
        if people:
            write_people(self.folder, people.values())
        left_out = len({c for p in known.values() for c in p.more}) + any(p.consent for p in known.values())
        if left_out:
            # Give only the number, since even the name of a column may be private.
            self.notes.append(Message("Left out: {n:column} of the people's table.", n=left_out))
        return people

    def _write_marks(self, ids: dict[str, str], files: dict[str, str]) -> None:
        states = read_marks(self.source.path)
        marks = []
        for recording in self.kept:
            mark = states.get(recording.id, MarkState())
            identity = ids[recording.id]
            if (mark.start, mark.stop) != (0, -1):
                marks.append(Mark(identity, "trim", "", start=mark.start, stop=mark.stop))
            if mark.gesture:
                marks.append(Mark(identity, "relabel", "", gesture=self.label(mark.gesture)))
            if mark.excluded:
                marks.append(Mark(identity, "exclude", ""))
            marks += [Mark(identity, "accept", "", check=check) for check in sorted(mark.accepted)]
        for stream in self.streams:
            # The rows of a stream are those of the source, so the rows of its labels are, too.
            identity = Path(files[stream.file]).relative_to(STREAMS).with_suffix("").as_posix()
            stretches = states.get(stream.id, MarkState()).stretches
            for s in stretches:
                label = f"{PRACTICE}{self.label(s.gesture)}" if s.gesture else s.label
                marks.append(Mark(identity, "label", "", start=s.start, stop=s.stop, label=label))
        if marks:
            (self.folder / MARKS).write_text("".join(map(mark_line, marks)), encoding="utf-8", newline="\n")

    def _note_changes(self, published: Dataset, origin: dict[str, RecordingInfo]) -> None:
        excluded = sum(r.excluded for r in self.source.recordings)
        marked = excluded if self.spec.excluded or self.labelled else 0
        renamed = 0 if self.spec.pseudonyms else sum(code != public for code, public in self.codes.items())
        trimmed = sum((r.start, r.stop) != (0, r.rows) for r in published.recordings)
        relabelled = sum(r.gesture != r.recorded for r in published.recordings)
        lost = sum(origin[r.id].stream_row >= 0 and r.stream_row < 0 for r in published.recordings)
        odd = sorted(r for r in {r.gesture for r in self.kept} if self.label(r) != r)
        left_out = "Left out: {n:excluded recording}."
        if self.streams:
            left_out = "Left out: {n:excluded recording}. Their rows are still in the session's stream."
        notes = {
            left_out: excluded - marked,
            "In the package, but marked as excluded: {n:recording}.": marked,
            "Left out: {n:session stream}.": 0 if self.streams else len(self.source.streams),
            "Trimmed: {n:recording}; the files hold all rows, start and stop say which remain.": trimmed,
            "Relabelled: {n:recording}; the files are named after the gesture that was asked for, the tables "
            "state the one that was made.": relabelled,
            "Renamed: {n:subject code} that looked like a number or nothing, now with a P in front.": renamed,
            "Renamed: gestures that other programs read as a number, a date or no value; {listed}.": len(odd),
            "No longer found in their stream: {n:recording}.": lost if self.streams and not self.labelled else 0,
        }
        listed = join_names(f"'{label}' is now '{self.label(label)}'" for label in odd)
        self.notes += [
            Message(note, n=n, **({"listed": listed} if "{listed}" in note else {})) for note, n in notes.items() if n
        ]


def _folder_of(file: str) -> str:
    """Return the person's folder of a raw file."""
    return Path(file).parts[1]


def public_codes(dataset: Dataset, spec: ContentsSpec | None = None) -> dict[str, str]:
    """Return the public code of each person's folder.

    With pseudonyms it is that of the key; else P is prepended to those that look like a number or no value.
    """
    folders = person_codes(dataset)
    if spec is not None and spec.pseudonyms:
        return {folder: spec.key.codes.get(folder, folder) for folder in folders}
    fine = {f for f in folders if f == NOBODY or not is_misread(f)}
    codes: dict[str, str] = {}
    taken = {f.casefold() for f in fine}
    for folder in folders:
        public = folder
        while folder not in fine and (public == folder or public.casefold() in taken):
            public = f"P{public}"
        taken.add(public.casefold())
        codes[folder] = public
    return codes


def person_codes(dataset: Dataset) -> list[str]:
    """Return the folders of the recordings and streams, sorted: codes of people, and those without a person."""
    return sorted({_folder_of(r.file) for r in dataset.recordings} | {_folder_of(s.file) for s in dataset.streams})


def refuse_traces(folder: Path, codes: Iterable[str]) -> None:
    """Search names and texts of all files in ``folder`` for the original codes of people.

    Codes that are too short to be told from other words are not found.

    Raises:
        DatasetError: if one is there.
    """
    originals = set(codes) - set(KEPT)
    names = NamePatterns(originals)
    for path in walk_files(folder):
        file = path.relative_to(folder).as_posix()
        for found in (*(originals & set(file.split("/"))), *names.find_in(f"{file}\n{_text_of(path)}")):
            raise DatasetError(
                "'{file}' would still hold '{name}': nothing was written. If that is a gesture or another word of "
                "the data, rename the person or the gesture, or change the text in dataset.toml first.",
                file=file,
                name=found,
            )


def _text_of(path: Path) -> str:
    data = path.read_bytes()
    return words_of_rows(data) if path.suffix == ".csv" else data.decode("utf-8", "replace")


def public_labels(dataset: Dataset) -> Callable[[str], str]:
    """Return the function that gives the public label of a gesture or family of a data set."""
    used = {label for g in dataset.gestures.gestures for label in (g.label, *g.labels)}
    used |= {label for r in dataset.recordings for label in (r.gesture, r.recorded)}
    return partial(public_label, prefix=label_prefix(used))
