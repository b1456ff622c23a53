"""Import tables with one row per sample: ``subject, [session], [recording], label, time`` and the channels.

Objects of JSON and rows of Parquet may also hold lists of samples, as in data sets of Hugging Face: one for each
recording or stream.

Rows are grouped by person and session, in the order of the file. A recording is a run of rows with the same label (and
the same ``recording``, if there is such a column); without that column it also ends where the time decreases or pauses
for more than a second. Empty lines, and the other lines of ``between`` in `ImportPattern`, end a recording too. A file
whose path names the label or the take is one recording otherwise.

Rows without a label, or with one of ``idle``, belong to no recording. A session with such rows is also written as
stream, and so is one in which most recordings begin where the one before ends.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import plain_label
from plushsense.core.layouts import HOST_MS, Layout
from plushsense.core.recorder_csv import (
    LONGEST_LABEL,
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    parse_name,
    recording_filename,
)
from plushsense.core.sentences import Message
from plushsense.dataset.files import sha256_of
from plushsense.dataset.importing.intervals import IntervalFile, label_rows
from plushsense.dataset.importing.pattern import UNITS, ImportPattern
from plushsense.dataset.importing.sources import COMPANIONS, SourceFile
from plushsense.dataset.importing.table_files import (
    ImportedColumns,
    TableFile,
    forward_steps,
    left_out_note,
    read_rows,
    unit_of_time,
)
from plushsense.dataset.quality.measurements import SLOW_FACTOR, in_order, rows_at_one_time
from plushsense.dataset.store import RECORDINGS, STREAMS

ORIGIN = "origin.json"
LARGEST = 2.0**53
# A channel with values between the steps of its layout, and a spread of few steps, probably has another scale.
_FEW_STEPS = 10.0
_BETWEEN = 0.05
# More than 20 rows in turn would have one time.
_FINEST_MS = 0.05


@dataclass(frozen=True)
class LabelledSegment:
    """Labelled part of a session: the rows from ``start`` to before ``stop`` of its frames.

    ``spelling`` is the label as the source spells it, "" if it is the same.
    """

    label: str
    start: int
    stop: int
    spelling: str = ""


@dataclass(frozen=True)
class ConvertedSource:
    """File from which recordings were converted; ``more`` are additional values for ``origin.json``."""

    path: Path
    display_name: str
    more: dict[str, Any]

    @cached_property
    def table(self) -> dict[str, object]:
        """Content of ``origin.json``: the source, its SHA-256 and ``more``."""
        return {"source": self.display_name, "sha256": sha256_of(self.path)} | self.more


def _json(table: Mapping[str, Any]) -> str:
    return json.dumps(table, ensure_ascii=False, indent=1) + "\n"


def whole_steps(values: NDArray[np.float64], layout: Layout) -> tuple[NDArray[np.int64], str]:
    """Round values (T, C) to integer steps of the layout; return them and a warning, "" unless steps are too coarse."""
    scaled = values / np.array([c.step for c in layout.channels])
    rounded = np.round(scaled)
    warning = ""
    if len(values):
        between = np.mean(np.abs(scaled - rounded) > _BETWEEN, axis=0) > 0.1
        coarse = between & (np.std(scaled, axis=0) < _FEW_STEPS)
        if names := ", ".join(f"'{n}'" for n, is_coarse in zip(layout.names, coarse, strict=True) if is_coarse):
            warning = Message(
                "{columns}: the values are small fractions of the step of layout '{layout}' and were rounded to it: "
                "give a layout with a smaller step",
                columns=names,
                layout=layout.name,
            )
    return np.clip(rounded, -LARGEST, LARGEST).astype(np.int64), warning


def usable_rows(*columns: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each row (T,) whether every value in every column is a number below `LARGEST` in magnitude."""
    # Comparisons with NaN are false.
    return np.asarray(np.all(np.abs(np.column_stack(columns)) < LARGEST, axis=1))


@dataclass(frozen=True)
class SessionTarget:
    """A session to write: its new ``folder``, the codes of person and session, and the layout of its files."""

    folder: Path
    subject: str
    session: str
    layout: Layout


def write_session(
    target: SessionTarget,
    original: ConvertedSource,
    frames: Frames,
    cuts: Sequence[LabelledSegment],
    *,
    with_stream: bool,
    taken: set[str] | None = None,
) -> Iterator[SourceFile]:
    """Write one session: its recordings, with ``with_stream`` the stream, and ``origin.json``; yield the files.

    For a layout with a label on every row, one labelled stream is written instead of recordings. ``taken`` are names of
    recordings in other files of the session, to which the new ones are added; with it, no ``origin.json`` is written.
    """
    folder, layout, session = target.folder, target.layout, target.session
    file_of = partial(SourceFile, subject=target.subject, session=session)
    folder.mkdir(parents=True)
    where = f"{original.display_name}: {target.subject}{f', session {session}' if session else ''}"
    main: Path | None = None
    if layout.is_labelled:
        separator = layout.csv.separator.strip() or " "
        cells = [" ".join(cut.label.replace(separator, "_").split()) for cut in cuts]
        labels = np.full(len(frames), "", dtype=f"<U{max(map(len, cells), default=1)}")
        for cut, label in zip(cuts, cells, strict=True):
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
        yield file_of(main, STREAMS, origin=f"{where}, the whole stream")
    names = set[str]() if taken is None else taken
    clock = frames.device_ms if frames.host_ms is None or HOST_MS not in layout.csv.columns else frames.host_ms
    for cut in cuts:
        name = f"{where}, rows {cut.start + 1} to {cut.stop} ('{(cut.spelling or cut.label)[:40]}')"
        at_ms = abs(int(clock[cut.start]))
        # Recordings of the same label and length would have the same name if their clocks all begin at 0.
        while (path := folder / recording_filename(cut.label, at_ms, cut.stop - cut.start)).name in names:
            at_ms += 1
        names.add(path.name)
        if len(path.name.encode("utf-8")) > LONGEST_LABEL:
            note = Message("its label is too long for a file name")
            yield file_of(path, "", origin=name, reason=note)
            continue
        # Nothing is lost if these temporary files are: they need not be on the disk before the import copies them.
        rows = format_rows(frames.slice(cut.start, cut.stop), layout)
        path.write_text(format_header(layout) + rows, encoding="utf-8", newline="\n")
        yield file_of(path, RECORDINGS, origin=name)
    if taken is not None:
        return
    about = folder / ORIGIN
    about.write_text(_json(original.table), encoding="utf-8", newline="\n")
    yield file_of(about, COMPANIONS, origin=f"{where}, {ORIGIN}", beside=main)


ABOUT_FILE = "{file}: {note}"


def about_file(name: str, note: str) -> Message:
    """Return a note about the file ``name``."""
    return Message(ABOUT_FILE, file=name, note=note)


def _codes(texts: Iterable[str]) -> tuple[NDArray[np.int64], list[str]]:
    """Number ``texts`` by first appearance; return the number of each, and the distinct texts."""
    known: dict[str, int] = {}
    numbers = [known.setdefault(text, len(known)) for text in texts]
    return np.array(numbers, dtype=np.int64), list(known)


PAUSE_MS = 1000.0


@dataclass(frozen=True)
class _TableSamples:
    """The usable rows of a table: their ``frames`` (T,), and the number of each one's person, session, label and take.

    ``people``, ``sessions`` and ``labels`` have the texts of these numbers; labels are as the source spells them.
    ``apart``: the file itself tells its recordings apart.
    """

    frames: Frames
    person: NDArray[np.int64]
    session: NDArray[np.int64]
    label: NDArray[np.int64]
    take: NDArray[np.int64]
    people: list[str]
    sessions: list[str]
    labels: list[str]
    apart: bool


@dataclass
class TableImport:
    """Conversion of tables into recordings below the new ``folder``.

    ``intervals`` are the files that label the rows of tables, if the pattern names such files.
    """

    folder: Path
    layout: Layout
    pattern: ImportPattern
    intervals: list[IntervalFile] = field(default_factory=list)
    _taken: dict[tuple[str, str], set[str]] = field(default_factory=dict)
    _origins: dict[tuple[str, str], list[dict[str, Any]]] = field(default_factory=dict)
    _spellings: dict[str, list[str]] = field(default_factory=dict)
    _written: int = 0

    def convert(
        self, path: Path, display_name: str, person: str | None, place: Mapping[str, str] | None = None
    ) -> Iterator[SourceFile | Message]:
        """Write the recordings of a table; yield the files, and notes as `about_file` makes them.

        Args:
            person: the person of a file that names none; None if it is not known.
            place: the parts of the path, None without a pattern, when each session gets its ``origin.json`` at once.

        Raises:
            FileFormatError: for a table that cannot be read, lacks a column, or has no usable row.
            MissingExtraError: for Parquet without polars.
        """
        table = TableFile(path, display_name, self.layout, self.pattern, place)
        for entry in self._convert(table, person):
            yield entry if isinstance(entry, SourceFile) else about_file(display_name, entry)

    def _convert(self, table: TableFile, person: str | None) -> Iterator[SourceFile | str]:
        columns = read_rows(table)
        if self.pattern.intervals:
            columns, notes = self._labelled(table, columns)
            yield from notes
        subject = (table.place or {}).get("subject", person)
        if "subject" not in columns.names and subject is None:
            raise table.error(
                "'{file}' has no column 'subject': {hint}, or the person with --subjects map.csv (file,subject)",
                hint=table.hint("subject"),
                needs="person",
            )
        samples = yield from self._samples(table, columns, subject or "")
        every = samples.frames
        if not len(every):
            raise table.error(
                "'{file}' has no usable row: each needs a subject, a time and {n} numbers", n=self.layout.n_channels
            )
        group = samples.person * len(samples.sessions) + samples.session
        order = np.argsort(group, kind="stable")
        edges = [0, *(np.flatnonzero(np.diff(group[order])) + 1).tolist(), len(order)]
        original = ConvertedSource(table.path, table.display_name, {"columns": columns.names})
        for first, last in itertools.pairwise(edges):
            mine = order[first:last]
            moved = in_order(every.device_ms[mine])
            if table.place is not None and (n := int(np.sum(moved != np.arange(len(moved))))):
                yield f"{n} rows put into the order of their times"
                mine = mine[moved]
            yield from self._write(table, original, samples, mine)

    def _labelled(self, table: TableFile, columns: ImportedColumns) -> tuple[ImportedColumns, list[str]]:
        """Label the rows of a table by the file of intervals that belongs to it; return them, and notes."""
        mine = [intervals for intervals in self.intervals if intervals.fits(table.place or {})]
        if len(mine) != 1:
            listed = f"several files of intervals ({', '.join(i.name for i in mine[:3])})" if mine else "no such file"
            raise table.error(
                "'{file}' has its labels in another file, and {listed} belongs to it: intervals in the pattern, now "
                "'{intervals}', needs the same parts as paths",
                listed=listed,
                intervals=self.pattern.intervals,
            )
        factor, _ = self._factor(columns)
        return label_rows(columns, columns.numbers["time"] * factor, mine[0], factor)

    def _samples(
        self, table: TableFile, columns: ImportedColumns, subject: str
    ) -> Generator[SourceFile | str, None, _TableSamples]:
        """Return the usable rows of a table as samples; yield what is to be said about the file."""
        place = table.place or {}
        factor, note = self._factor(columns)
        device = columns.numbers["time"] * factor
        steps = forward_steps(device)
        if note:
            yield note
        if len(steps) and float(np.median(steps)) < _FINEST_MS:
            yield Message(
                "by column '{column}', rows are {step:g} ms apart, but times are kept in whole ms: is its unit right?",
                column=columns.names["time"],
                step=float(np.median(steps)),
            )
        host = columns.numbers.get(HOST_MS, device)

        def part(role: str, otherwise: str) -> tuple[NDArray[np.int64], list[str]]:
            return _codes(columns.texts.get(role) or itertools.repeat(place.get(role, otherwise), len(device)))

        person, people = part("subject", subject)
        # Files with rows between their recordings are sessions of their own, since each is a stream.
        own_session = table.place is not None and not place.get("label")
        session, sessions = part("session", table.path.stem if own_session else "")
        label, labels = part("label", "")
        take, _ = part("recording", "")
        blocks = int(columns.blocks.max(initial=0)) + 1
        raw = np.column_stack([columns.numbers[n] for n in self.layout.names])
        invalid = np.isinf(raw)
        raw[invalid] = 0.0
        good = usable_rows(raw, device, host)
        known = np.array([bool(code) for code in people], dtype=bool)[person]
        yield from columns.notes
        for bad, reason in ((~good, "without a number in every column"), (good & ~known, "without a subject")):
            if count := int(np.sum(bad)):
                first = f"line {columns.lines[int(np.argmax(bad))]}" if len(columns.lines) else ""
                yield left_out_note(count, reason, first)
        if blocks > 1:
            yield Message(
                "{n} blocks of rows, separated by empty lines, comments or repeated column names, are recordings of "
                "their own{join}",
                n=blocks,
                join=': between = "none" in the pattern joins them' if table.place is not None else "",
            )
        good &= known
        values, note = whole_steps(raw[good], self.layout)
        if note:
            yield note
        if count := int(invalid[good].sum()):
            # A value beyond the valid range is invalid for every reader, which repeats the last valid one.
            values = np.where(invalid[good], self.layout.valid_max_int + 1, values)
            words = ", ".join(f"'{word}'" for word in self.pattern.missing)
            yield f"{count} values are missing ({words}): they count as invalid"
        device_ms, host_ms = (np.round(clock[good]).astype(np.int64) for clock in (device, host))
        person, session, label = (each[good] for each in (person, session, label))
        take = (take * blocks + columns.blocks)[good]
        apart = "recording" in columns.names or columns.own_recordings or bool({"label", "recording"} & set(place))
        frames = Frames(values, device_ms, host_ms)
        return _TableSamples(frames, person, session, label, take, people, sessions, labels, apart)

    def _write(
        self, table: TableFile, original: ConvertedSource, samples: _TableSamples, mine: NDArray[np.int64]
    ) -> Iterator[SourceFile | str]:
        """Write the session whose rows are ``mine``."""
        every = samples.frames
        assert every.host_ms is not None
        frames = Frames(every.values[mine], every.device_ms[mine], every.host_ms[mine])
        label = samples.label[mine]
        names = [self.pattern.label_of(text) for text in samples.labels]
        good = [self.pattern.names_gesture(n) and len(n) <= LONGEST_LABEL for n in names]
        named = np.array(good, dtype=bool)[label]
        new = (np.diff(label) != 0) | (np.diff(samples.take[mine]) != 0)
        steps = np.diff(frames.device_ms)
        if not samples.apart:
            new |= (steps < 0) | (steps > PAUSE_MS)
        runs = [0, *(np.flatnonzero(new) + 1).tolist(), len(mine)]
        # Without a clock, nothing is known of the time between recordings that a file tells apart.
        timed = not (samples.apart and self.pattern.row_rate_hz)
        with_stream = not named.all() or (timed and self._go_on(steps, new))
        cuts = [
            LabelledSegment(names[label[a]], a, b, samples.labels[label[a]])
            for a, b in itertools.pairwise(runs)
            if named[a]
        ]
        key = samples.people[samples.person[mine[0]]], samples.sessions[samples.session[mine[0]]]
        taken = None if table.place is None else self._taken.setdefault(key, set())
        target = SessionTarget(self.folder / str(self._written), *key, self.layout)
        self._written += 1
        files = list(write_session(target, original, frames, cuts, with_stream=with_stream, taken=taken))
        yield from files
        yield from self._merged(sorted({cut.label for cut in cuts}))
        if taken is not None:
            made = {f.source.name: f.origin for f in files if f.kind == RECORDINGS}
            self._origins.setdefault(key, []).append(original.table | {"recordings": made})

    def _go_on(self, steps: NDArray[np.int64], new: NDArray[np.bool_]) -> bool:
        """Return whether most runs of rows go on where the one before ends, so that they are parts of one stream.

        Args:
            steps: (T − 1,) the time to the next row in ms.
            new: (T − 1,) whether another run begins after the row.
        """
        forward = steps[steps > 0]
        if not new.any() or not len(forward):
            return False
        gap_ms = max(self.layout.gap_ms, SLOW_FACTOR * float(np.median(forward)))
        return float(np.mean((steps[new] > 0) & (steps[new] <= gap_ms))) > 0.5

    def _merged(self, labels: Sequence[str]) -> Iterator[str]:
        """Yield a note for each label that becomes the same as another one, for want of characters in file names."""
        for label in labels:
            name = parse_name(recording_filename(label, 0, 0))
            assert name is not None
            others = self._spellings.setdefault(plain_label(name.label), [label])
            if plain_label(label) not in map(plain_label, others):
                others.append(label)
                yield (
                    f"'{label}' and '{others[0]}' become one gesture, '{name.label}', as names of files have no "
                    '\\ / : * ? " < > | ( ), and no full stop at the end: if they are two, rename one in the source, '
                    "or give aliases in a --pattern"
                )

    def _factor(self, columns: ImportedColumns) -> tuple[float, str]:
        """Return the milliseconds per unit of the time column, and a note if the unit is stated nowhere."""
        if columns.in_ms or self.pattern.time_unit:
            return 1.0 if columns.in_ms else UNITS[self.pattern.time_unit], ""
        name, times = columns.names["time"], columns.numbers["time"]
        unit, stated = unit_of_time(name, times, self.layout.rate_hz)
        if stated:
            return UNITS[unit], ""
        # Steps of a clock that stands still say nothing about its unit.
        suggests = len(forward_steps(times)) > 0 and not rows_at_one_time(times[np.isfinite(times)])
        unit = unit if suggests else "ms"
        return UNITS[unit], Message(
            "column '{column}' is read as {read_as}{why}",
            column=name,
            read_as=unit if suggests else "milliseconds",
            why=f", as the rate of {self.layout.rate_hz:g} Hz suggests" if suggests else "",
            unit=unit,
        )

    def origins(self) -> Iterator[SourceFile]:
        """Write ``origin.json`` of each session that was converted with a pattern, with the original names."""
        for number, ((subject, session), sources) in enumerate(self._origins.items()):
            about = self.folder / "origins" / str(number) / ORIGIN
            about.parent.mkdir(parents=True)
            about.write_text(_json({"sources": sources}), encoding="utf-8", newline="\n")
            where = f"{subject}{f', session {session}' if session else ''}, {ORIGIN}"
            yield SourceFile(about, COMPANIONS, subject, session=session, origin=where)
