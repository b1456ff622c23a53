"""What leaves with a package, and nothing else: a data set of its own with shifted times and plain columns.

Raw files are not copied but written anew, with the columns of the layout by their keys, one separator, and shifted
times; so no note, sidecar, note in a header or malformed line of the original can slip through. Sessions are numbered,
since their names may be dates; marks lose who, why and when.
"""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from plushsense.core.errors import DatasetError
from plushsense.core.recfile import (
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    parse_name,
    read_recording,
    read_stream,
    recording_filename,
)
from plushsense.core.signal import DEVICE_MS, HOST_MS, CsvFormat, Layout
from plushsense.dataset.index import AGAIN, build
from plushsense.dataset.marks import MARKS, Mark, read_marks
from plushsense.dataset.people import PEOPLE, PersonInfo, read_people, write_people
from plushsense.dataset.publish.description import DATA
from plushsense.dataset.publish.shifting import WALL_CLOCK_MS, Shift, shift_of
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, Dataset, DatasetHead, RecordingInfo, StreamInfo

Progress = Callable[[int, int], None]
PUBLIC_COLUMNS = ("age_group", "gender")
# What pandas takes for a missing value, and for a number: a code like these would not come back.
_NOT_A_CODE = re.compile(r"[-+]?[\d.]+(e\d+)?|na|n/a|null|none|nan|inf(inity)?|true|false", re.IGNORECASE)


@dataclass(frozen=True)
class Options:
    """What is published: ``columns`` of the people's file besides age group and gender; ``key`` fixes the shifts."""

    streams: bool = True
    excluded: bool = False
    columns: tuple[str, ...] = ()
    key: bytes = field(default_factory=lambda: secrets.token_bytes(32), repr=False)


@dataclass(frozen=True)
class Contents:
    """What was written: the published data set, and which of its recordings came from which."""

    dataset: Dataset
    people: dict[str, PersonInfo]
    origin: dict[str, RecordingInfo]
    notes: tuple[str, ...]


def public_layout(layout: Layout, host: bool) -> Layout:
    """The layout with plain columns: keys as header, ``,`` between, clocks first."""
    clocks = (HOST_MS, DEVICE_MS) if host else (DEVICE_MS,)
    columns = (*clocks, *layout.names, *(("label",) if layout.is_labelled else ()))
    return replace(layout, csv=CsvFormat(columns, columns, ","))


def write_contents(
    dataset: Dataset, root: Path, head: DatasetHead, options: Options, progress: Progress | None = None
) -> Contents:
    """Write the data set that strangers get into ``root/data``; every file is read back and compared.

    Raises:
        DatasetError: when nothing would be left, or a file does not come back as it was.
    """
    return _Writing(dataset, root / DATA, head, options, progress).run()


class _Writing:
    def __init__(
        self, dataset: Dataset, folder: Path, head: DatasetHead, options: Options, progress: Progress | None
    ) -> None:
        self.source = dataset
        self.folder = folder
        self.options = options
        self.progress = progress or (lambda done, total: None)
        self.labelled = dataset.layout.is_labelled
        self.notes: list[str] = []
        if self.labelled and not options.streams:
            raise DatasetError(
                f"'{dataset.path}' holds its recordings as parts of streams: it cannot be published without streams."
            )
        self.kept = [r for r in dataset.recordings if options.excluded or self.labelled or not r.excluded]
        if not self.kept:
            raise DatasetError(f"'{dataset.path}' has no recording left to publish: every one is excluded.")
        self.streams = dataset.streams if options.streams else []
        self.layout = public_layout(dataset.layout, self._all_have_host())
        self.head = replace(head, layout=self.layout, source="")
        held = {_folder_of(r.file) for r in self.kept} | {_folder_of(s.file) for s in self.streams}
        self.codes = {folder: public for folder, public in public_codes(dataset).items() if folder in held}
        self.shifts = self._shifts()
        self.sessions = self._sessions()
        self.taken: set[str] = set()

    def run(self) -> Contents:
        total = len(self.kept) * (not self.labelled) + len(self.streams)
        done = 0
        files: dict[str, str] = {}
        for stream in self.streams:
            files[stream.file] = self._write_stream(stream)
            self.progress(done := done + 1, total)
        for recording in [] if self.labelled else self.kept:
            files[recording.file] = self._write_recording(recording)
            self.progress(done := done + 1, total)
        people = self._write_people()
        ids = {r.id: self._id(r, files) for r in self.kept}
        self._write_marks(ids)
        (self.folder / HEAD).write_text(self.head.to_toml(), encoding="utf-8", newline="\n")
        built = build(self.folder, self.head)
        published = {r.id: r for r in built.dataset.recordings}
        origin = {ids[r.id]: r for r in self.kept}
        if built.unreadable or published.keys() != origin.keys():
            odd = next(iter([*built.unreadable, *(published.keys() ^ origin.keys())]))
            raise DatasetError(
                f"The package would not hold what the data set holds: '{odd}' differs. Please report it."
            )
        for identity, before in origin.items():
            after = published[identity]
            for key in ("gesture", "rows", "first_row", "start", "stop", "excluded"):
                if getattr(before, key) != getattr(after, key):
                    raise DatasetError(
                        f"'{identity}' would be published with another {key}: {getattr(after, key)!r} instead of "
                        f"{getattr(before, key)!r}. Please report it."
                    )
        self._say_what_was_left_out(built.dataset, origin)
        return Contents(built.dataset, people, origin, tuple(self.notes))

    # ---- files

    def _write_stream(self, stream: StreamInfo) -> str:
        code = _folder_of(stream.file)
        number = self.sessions[code][stream.session]
        folder = f"{STREAMS}/{self.codes[code]}"
        if self.labelled:
            target = self._free(f"{folder}/session-{number}.csv")
        else:
            target = self._free(f"{folder}/{self._inner(code, stream.session)}{STREAM_NAME}")
        raw = read_stream(self.source.path / stream.file, self.source.layout).frames
        self._put(target, self.shifts[code].frames(raw, self._host), raw.values)
        return target

    def _write_recording(self, recording: RecordingInfo) -> str:
        code = _folder_of(recording.file)
        name = parse_name(Path(recording.file).name)
        if name is None:
            raise DatasetError(f"'{recording.file}' is not named <label>_<epoch ms>_<rows>.csv.")
        raw = read_recording(self.source.path / recording.file, self.source.layout)
        frames = raw.frames
        if raw.integrated and recording.stream_row >= 0 and self.streams:
            # Delays that were added up begin at 0; in the package the clock is the stream's, so that it is found there.
            at = int(self.source.read_stream(recording.stream).device_ms[recording.stream_row])
            frames = replace(frames, device_ms=frames.device_ms - frames.device_ms[0] + at)
        shift = self.shifts[code]
        shown = shift.frames(frames, self._host)
        epoch = shift.time(name.epoch_ms)
        if epoch is None:
            clock = shown.host_ms if shown.host_ms is not None else shown.device_ms
            epoch = int(clock[0])
        folder = f"{RECORDINGS}/{self.codes[code]}/{self._inner(code, recording.session)}"
        target = self._free(folder + recording_filename(name.label, max(0, epoch), name.rows))
        self._put(target, shown, frames.values)
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
            raise DatasetError(f"'{target}' would not be read back as it was recorded. Please report it.")

    def _free(self, wanted: str) -> str:
        """A path below the data folder that no other file has; in any case, since file systems differ."""
        place, _, name = wanted.rpartition("/")
        number = 2
        while wanted.casefold() in self.taken:
            wanted = f"{place}/{AGAIN}{number}/{name}"
            number += 1
        self.taken.add(wanted.casefold())
        return wanted

    def _inner(self, code: str, session: str) -> str:
        return f"{self.sessions[code][session]}/" if len(self.sessions[code]) > 1 else ""

    def _id(self, recording: RecordingInfo, files: dict[str, str]) -> str:
        target = Path(files[recording.file])
        kind = STREAMS if self.labelled else RECORDINGS
        identity = target.relative_to(kind).with_suffix("").as_posix()
        return identity if not self.labelled else f"{identity}#{recording.id.rpartition('#')[2]}"

    # ---- times and names

    @property
    def _host(self) -> bool:
        return HOST_MS in self.layout.csv.columns

    def _all_have_host(self) -> bool:
        if HOST_MS not in self.source.layout.csv.columns:
            return False
        layout, folder = self.source.layout, self.source.path
        lacking = sum(read_stream(folder / s.file, layout).frames.host_ms is None for s in self.streams)
        if not self.labelled:
            lacking += sum(read_recording(folder / r.file, layout).frames.host_ms is None for r in self.kept)
        if lacking:
            self.notes.append(
                f"Left out: the computer's clock, since {_count(lacking, 'file')} lacked it; the toy's clock stays."
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
            shifts[code] = shift_of(code, firsts, max(clocks, default=0) >= WALL_CLOCK_MS, self.options.key)
        return shifts

    def _sessions(self) -> dict[str, dict[str, int]]:
        """Of each person, the sessions by number, in the order of time; those without a recording come last."""
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

    # ---- people and marks

    def _write_people(self) -> dict[str, PersonInfo]:
        known = read_people(self.source.path)
        columns = {c for p in known.values() for c in p.more}
        for wanted in self.options.columns:
            if wanted not in columns:
                raise DatasetError(
                    f"{PEOPLE} has no column '{wanted}' to publish; besides {', '.join(PUBLIC_COLUMNS)} it has "
                    f"{', '.join(sorted(columns)) or 'none'}."
                )
        people = {}
        for code, public in self.codes.items():
            if code in known:
                p = known[code]
                more = {c: p.more.get(c, "") for c in self.options.columns}
                people[public] = PersonInfo(public, p.age_group, p.gender, "", more)
        if people:
            write_people(self.folder, people.values())
        left = sorted(columns - set(self.options.columns)) + ["consent"] * any(p.consent for p in known.values())
        if left:
            # How many, not which: a column's name may tell something already.
            self.notes.append(f"Left out: {_count(len(left), 'column')} of the people's table.")
        return people

    def _write_marks(self, ids: dict[str, str]) -> None:
        standing = read_marks(self.source.path)
        marks = []
        for recording in self.kept:
            mark = standing.get(recording.id)
            if mark is None:
                continue
            identity = ids[recording.id]
            if (mark.start, mark.stop) != (0, -1):
                marks.append(Mark(identity, "trim", "", start=mark.start, stop=mark.stop))
            if mark.excluded:
                marks.append(Mark(identity, "exclude", ""))
            marks += [Mark(identity, "accept", "", check=check) for check in sorted(mark.accepted)]
        if marks:
            lines = "".join(json.dumps(asdict(mark), ensure_ascii=False) + "\n" for mark in marks)
            (self.folder / MARKS).write_text(lines, encoding="utf-8", newline="\n")

    def _say_what_was_left_out(self, published: Dataset, origin: dict[str, RecordingInfo]) -> None:
        out = [r for r in self.source.recordings if r.excluded]
        if out and not self.options.excluded and not self.labelled:
            still = " Their rows still stand in the session's stream." if self.streams else ""
            self.notes.append(f"Left out: {_count(len(out), 'excluded recording')}.{still}")
        elif out:
            self.notes.append(f"In the package, but marked as excluded: {_count(len(out), 'recording')}.")
        if self.source.streams and not self.streams:
            self.notes.append(f"Left out: {_count(len(self.source.streams), 'session stream')}.")
        trimmed = sum((r.start, r.stop) != (0, r.rows) for r in published.recordings)
        if trimmed:
            self.notes.append(
                f"Trimmed: {_count(trimmed, 'recording')}; the files hold all rows, start and stop say which remain."
            )
        renamed = [code for code, public in self.codes.items() if code != public]
        if renamed:
            self.notes.append(
                f"Renamed: {_count(len(renamed), 'subject code')} that looked like a number or nothing, now with "
                "a P in front."
            )
        if self.streams and published.recordings and not self.labelled:
            lost = sum(o.stream_row >= 0 and n.stream_row < 0 for n, o in _pairs(published, origin))
            if lost:
                self.notes.append(f"No longer found in their stream: {_count(lost, 'recording')}.")


def _pairs(published: Dataset, origin: dict[str, RecordingInfo]) -> list[tuple[RecordingInfo, RecordingInfo]]:
    return [(r, origin[r.id]) for r in published.recordings]


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _folder_of(file: str) -> str:
    """The person's folder of a raw file."""
    return Path(file).parts[1]


def public_codes(dataset: Dataset) -> dict[str, str]:
    """Public codes by a person's folder: as they are, but none that a reader takes for a number or for nothing."""
    folders = {_folder_of(r.file) for r in dataset.recordings} | {_folder_of(s.file) for s in dataset.streams}
    # "none" is nobody, by our own convention.
    fine = {f for f in folders if f == "none" or not _NOT_A_CODE.fullmatch(f)}
    codes: dict[str, str] = {}
    taken = {f.casefold() for f in fine}
    for folder in sorted(folders):
        public = folder
        while folder not in fine and (public == folder or public.casefold() in taken):
            public = f"P{public}"
        taken.add(public.casefold())
        codes[folder] = public
    return codes
