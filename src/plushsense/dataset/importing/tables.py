"""Import tables with one row per sample: ``subject, [session], [recording], label, time`` and the channels.

Objects of JSON and rows of Parquet may also hold lists of samples, as in data sets of Hugging Face: one for each
recording or stream.

Rows are grouped by person and session, in the order of the file. A recording is a run of rows with the same label (and
the same ``recording``, if there is such a column); without that column it also ends where the time decreases or pauses
for more than a second. Empty lines, and the other lines of ``between`` in `ImportPattern`, end a recording too, and so
does every ``recording_rows`` rows. A file whose path names the label or the take is one recording otherwise.

Rows without a label, or with one of ``idle``, belong to no recording. A session with such rows is also written as
stream, and so is one in which most recordings begin where the one before ends.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from plushsense.core.sentences import Sentence
from plushsense.dataset.files import sha256_of
from plushsense.dataset.importing.intervals import IntervalFile, label_rows
from plushsense.dataset.importing.pattern import UNITS, ImportPattern
from plushsense.dataset.importing.sources import COMPANIONS, SourceFile
from plushsense.dataset.importing.table_files import ImportedColumns, TableFile, forward_steps, read_rows, unit_of_time
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
    def table(self) -> dict[str, Any]:
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
            warning = Sentence(
                f"{names}: the values are small fractions of the step of layout '{layout.name}' and were rounded to "
                "it: give a layout with a smaller step",
                reason="values_rounded",
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
            note = Sentence("its label is too long for a file name", reason="label_too_long")
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


def about_file(name: str, note: str) -> Sentence:
    """Return a note about the file ``name``."""
    return Sentence(f"{name}: {note}", reason="about_file", file=name, note=note)


def _codes(texts: Iterable[str]) -> tuple[NDArray[np.int64], list[str]]:
    """Number ``texts`` by first appearance; return the number of each, and the distinct texts."""
    known: dict[str, int] = {}
    numbers = [known.setdefault(text, len(known)) for text in texts]
    return np.array(numbers, dtype=np.int64), list(known)


PAUSE_MS = 1000.0


@dataclass(frozen=True)
class _TableSamples:
    """The usable rows of a table: their ``frames`` (T,), and the number of each one's person, session, label and take.

    ``row`` (T,) are the numbers of the rows in the file, with those that are left out.

    ``people``, ``sessions`` and ``labels`` have the texts of these numbers; labels are as the source spells them.
    """

    frames: Frames
    person: NDArray[np.int64]
    session: NDArray[np.int64]
    label: NDArray[np.int64]
    take: NDArray[np.int64]
    row: NDArray[np.int64]
    people: list[str]
    sessions: list[str]
    labels: list[str]


@dataclass
class TableImport:
    """Conversion of tables into recordings below the new ``folder``.

    ``person`` is the person of files that name none, None if it is not known. ``intervals`` are the files that label
    the rows of tables, if the pattern names such files.
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
    ) -> Iterator[SourceFile | Sentence]:
        """Write the recordings of a table; yield the files, and warnings as `about_file` makes them.

        ``place`` are the parts of the path, None without a pattern, when each session gets its ``origin.json`` at once.

        Raises:
            FileFormatError: for a table that cannot be read, lacks a column, or has no usable row.
            MissingExtraError: for Parquet without polars.
        """
        table = TableFile(path, display_name, self.layout, self.pattern, place)
        columns = read_rows(table)
        place = place or {}
        notes: list[Sentence] = []
        if self.pattern.intervals:
            columns = self._labelled(table, columns, notes)
        subject = place.get("subject", person)
        if "subject" not in columns.names and subject is None:
            raise table.error(
                f"has no column 'subject': {table.hint('subject')}, or the person with --subjects map.csv "
                "(file,subject)",
                reason="person_unknown",
            )
        samples = self._samples(table, columns, subject or "", notes)
        yield from notes
        if not len(samples.frames):
            raise table.error(
                f"has no usable row: each needs a subject, a time and {self.layout.n_channels} numbers",
                reason="rows_unusable",
                n=self.layout.n_channels,
            )
        group = samples.person * len(samples.sessions) + samples.session
        order = np.argsort(group, kind="stable")
        edges = [0, *(np.flatnonzero(np.diff(group[order])) + 1).tolist(), len(order)]
        original = ConvertedSource(path, display_name, {"columns": columns.names})
        apart = "recording" in columns.names or columns.own_recordings or bool({"label", "recording"} & set(place))
        apart |= self.pattern.recording_rows > 0
        for first, last in itertools.pairwise(edges):
            mine = order[first:last]
            moved = in_order(samples.frames.device_ms[mine])
            if table.place is not None and (n := int(np.sum(moved != np.arange(len(moved))))):
                yield about_file(display_name, f"{n} rows put into the order of their times")
                mine = mine[moved]
            yield from self._write(table, original, samples, mine, apart)

    def _labelled(self, table: TableFile, columns: ImportedColumns, notes: list[Sentence]) -> ImportedColumns:
        """Label the rows of a table by the file of intervals that belongs to it."""
        mine = [intervals for intervals in self.intervals if intervals.fits(table.place or {})]
        if len(mine) != 1:
            listed = f"several files of intervals ({', '.join(i.name for i in mine[:3])})" if mine else "no such file"
            raise table.error(
                f"has its labels in another file, and {listed} belongs to it: intervals in the pattern, now "
                f"'{self.pattern.intervals}', needs the same parts as paths"
            )
        times = columns.numbers["time"]
        factor, _ = self._factor(columns, times)
        labelled, found = label_rows(columns, times * factor, mine[0], factor)
        notes += [about_file(table.display_name, note) for note in found]
        return labelled

    def _samples(
        self, table: TableFile, columns: ImportedColumns, subject: str, notes: list[Sentence]
    ) -> _TableSamples:
        """Return the usable rows of a table as samples; add what is to be said about the file to ``notes``."""
        name, place = table.display_name, table.place or {}
        times = columns.numbers["time"]
        factor, note = self._factor(columns, times)
        notes += [about_file(name, note)] if note else []
        device = times * factor
        notes += _too_fine(table, columns, device)
        host = columns.numbers.get(HOST_MS, device)
        rows = len(device)

        def part(role: str, otherwise: str) -> tuple[NDArray[np.int64], list[str]]:
            return _codes(columns.texts.get(role) or itertools.repeat(place.get(role, otherwise), rows))

        people, codes = part("subject", subject)
        # Files with rows between their recordings are sessions of their own, since each is a stream.
        own_session = table.place is not None and not place.get("label")
        sessions, session_names = part("session", table.path.stem if own_session else "")
        labels, spellings = part("label", "")
        takes, _ = part("recording", "")
        takes = takes * (int(columns.block_of_row.max(initial=0)) + 1) + columns.block_of_row
        raw = np.column_stack([columns.numbers[n] for n in self.layout.names])
        invalid = np.isinf(raw)
        raw[invalid] = 0.0
        good = usable_rows(raw, device, host)
        known = np.array([bool(c) for c in codes], dtype=bool)[people] if rows else np.empty(0, bool)
        notes += _left_out(table, columns, good, known)
        notes += _blocks(table, columns)
        good &= known
        values, note = whole_steps(raw[good], self.layout)
        notes += [about_file(name, note)] if note else []
        if count := int(invalid[good].sum()):
            # A value beyond the valid range is invalid for every reader, which repeats the last valid one.
            values = np.where(invalid[good], self.layout.valid_max_int + 1, values)
            words = ", ".join(f"'{word}'" for word in self.pattern.missing)
            notes.append(about_file(name, f"{count} values are missing ({words}): they count as invalid"))
        device_ms, host_ms = (np.round(clock[good]).astype(np.int64) for clock in (device, host))
        frames = Frames(values, device_ms, host_ms)
        return _TableSamples(
            frames,
            people[good],
            sessions[good],
            labels[good],
            takes[good],
            columns.number_of_row[good],
            codes,
            session_names,
            spellings,
        )

    def _write(
        self, table: TableFile, original: ConvertedSource, samples: _TableSamples, mine: NDArray[np.int64], apart: bool
    ) -> Iterator[SourceFile | Sentence]:
        """Write the session whose rows are ``mine``; ``apart``: the file itself tells its recordings apart."""
        every = samples.frames
        assert every.host_ms is not None
        frames = Frames(every.values[mine], every.device_ms[mine], every.host_ms[mine])
        label, take = samples.label[mine], samples.take[mine]
        names = [self.pattern.label_of(text) for text in samples.labels]
        good = [self.pattern.names_gesture(n) and len(n) <= LONGEST_LABEL for n in names]
        named = np.array(good, dtype=bool)[label]
        new = (np.diff(label) != 0) | (np.diff(take) != 0)
        if not apart:
            steps = np.diff(frames.device_ms)
            new |= (steps < 0) | (steps > PAUSE_MS)
        if self.pattern.recording_rows:
            new |= self._ends_by_rows(new, samples.row[mine])
        runs = [0, *(np.flatnonzero(new) + 1).tolist(), len(mine)]
        # Without a clock, nothing is known of the time between recordings that a file tells apart.
        timed = not (apart and self.pattern.row_rate_hz)
        with_stream = not named.all() or (timed and self._go_on(frames.device_ms, new))
        cuts = [
            LabelledSegment(names[label[a]], a, b, samples.labels[label[a]])
            for a, b in itertools.pairwise(runs)
            if named[a]
        ]
        yield from self._short(table.display_name, [samples.row[mine[c.start : c.stop]] for c in cuts])
        key = samples.people[samples.person[mine[0]]], samples.sessions[samples.session[mine[0]]]
        taken = None if table.place is None else self._taken.setdefault(key, set())
        target = SessionTarget(self.folder / str(self._written), *key, self.layout)
        self._written += 1
        files = list(write_session(target, original, frames, cuts, with_stream=with_stream, taken=taken))
        yield from files
        yield from self._merged(table.display_name, sorted({cut.label for cut in cuts}))
        if taken is not None:
            made = {f.source.name: f.origin for f in files if f.kind == RECORDINGS}
            self._origins.setdefault(key, []).append(original.table | {"recordings": made})

    def _ends_by_rows(self, new: NDArray[np.bool_], row: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return after which rows (T − 1,) a recording ends by ``recording_rows``.

        Args:
            new: (T − 1,) whether another run of rows begins after the row; rows are counted from its beginning.
            row: (T,) number of each row in the file.
        """
        begins = np.flatnonzero(np.append(True, new))
        first = np.repeat(row[begins], np.diff([*begins.tolist(), len(row)]))
        return np.asarray(np.diff((row - first) // self.pattern.recording_rows) != 0)

    def _go_on(self, device_ms: NDArray[np.int64], new: NDArray[np.bool_]) -> bool:
        """Return whether most runs of rows go on where the one before ends, so that they are parts of one stream.

        Args:
            new: (T − 1,) whether another run begins after the row.
        """
        steps = np.diff(device_ms)
        forward = steps[steps > 0]
        if not new.any() or not len(forward):
            return False
        gap_ms = max(self.layout.gap_ms, SLOW_FACTOR * float(np.median(forward)))
        return float(np.mean((steps[new] > 0) & (steps[new] <= gap_ms))) > 0.5

    def _short(self, source: str, recordings: Sequence[NDArray[np.int64]]) -> Iterator[Sentence]:
        """Yield a note about recordings, given as the numbers of their rows, with fewer than ``recording_rows``."""
        count = sum(int(np.ptp(rows)) + 1 < self.pattern.recording_rows for rows in recordings)
        if count:
            n = self.pattern.recording_rows
            message = f"{count} of {len(recordings)} recordings have fewer than {n} rows: is recording_rows right?"
            values = {"n": count, "of": len(recordings), "rows": n}
            yield about_file(source, Sentence(message, reason="recordings_cut_short", **values))

    def _merged(self, source: str, labels: Sequence[str]) -> Iterator[Sentence]:
        """Yield a note for each label that becomes the same as another one, for want of characters in file names."""
        for label in labels:
            name = parse_name(recording_filename(label, 0, 0))
            assert name is not None
            others = self._spellings.setdefault(plain_label(name.label), [label])
            if plain_label(label) not in map(plain_label, others):
                others.append(label)
                note = (
                    f"'{label}' and '{others[0]}' become one gesture, '{name.label}', as names of files have no "
                    '\\ / : * ? " < > | ( ), and no full stop at the end: if they are two, rename one in the source, '
                    "or give aliases in a --pattern"
                )
                yield about_file(source, note)

    def _factor(self, columns: ImportedColumns, times: NDArray[np.float64]) -> tuple[float, str]:
        """Return the milliseconds per unit of the time column, and a note if the unit is stated nowhere."""
        if columns.in_ms:
            return 1.0, ""
        if self.pattern.time_unit:
            return UNITS[self.pattern.time_unit], ""
        name = columns.names["time"]
        unit, stated = unit_of_time(name, times, self.layout.rate_hz)
        if stated:
            return UNITS[unit], ""
        # Steps of a clock that stands still say nothing about its unit.
        suggests = len(forward_steps(times)) > 0 and not rows_at_one_time(times[np.isfinite(times)])
        why = f", as the rate of {self.layout.rate_hz:g} Hz suggests" if suggests else ""
        unit = unit if suggests else "ms"
        message = f"column '{name}' is read as {unit if suggests else 'milliseconds'}{why}"
        return UNITS[unit], Sentence(message, reason="time_unit", column=name, unit=unit)

    def origins(self) -> Iterator[SourceFile]:
        """Write ``origin.json`` of each session that was converted with a pattern, with the original names."""
        for number, ((subject, session), sources) in enumerate(self._origins.items()):
            about = self.folder / "origins" / str(number) / ORIGIN
            about.parent.mkdir(parents=True)
            about.write_text(_json({"sources": sources}), encoding="utf-8", newline="\n")
            where = f"{subject}{f', session {session}' if session else ''}, {ORIGIN}"
            yield SourceFile(about, COMPANIONS, subject, session=session, origin=where)


def _left_out(
    table: TableFile, columns: ImportedColumns, good: NDArray[np.bool_], known: NDArray[np.bool_]
) -> Iterator[Sentence]:
    """Yield notes about the rows that are not used, with the line of the first of each kind."""

    def first(bad: NDArray[np.bool_]) -> str:
        return f"line {columns.lines[int(np.argmax(bad))]}" if len(columns.lines) and bad.any() else ""

    ask = "; if such lines separate recordings, describe them with  between  in a pattern" if columns.text_lines else ""
    for count, reason, where in (
        (columns.malformed, columns.why_malformed, columns.first_malformed + ask),
        (int(np.sum(~good)), "without a number in every column", first(~good)),
        (int(np.sum(good & ~known)), "without a subject", first(good & ~known)),
    ):
        if count:
            at = f" (the first: {where})" if where else ""
            message = f"{count} row{'s' if count > 1 else ''} {reason} left out{at}"
            yield about_file(table.display_name, Sentence(message, reason="rows_left_out", n=count))


def _too_fine(table: TableFile, columns: ImportedColumns, device: NDArray[np.float64]) -> Iterator[Sentence]:
    """Yield a note if the times in ``device`` (T,), in ms, would stand still since they are kept in whole ms."""
    steps = forward_steps(device)
    if len(steps) and float(np.median(steps)) < _FINEST_MS:
        name, step = columns.names["time"], float(np.median(steps))
        message = f"by column '{name}', rows are {step:g} ms apart, but times are kept in whole ms: is its unit right?"
        yield about_file(table.display_name, Sentence(message, reason="time_too_fine", column=name))


def _blocks(table: TableFile, columns: ImportedColumns) -> Iterator[Sentence]:
    """Yield a note about the blocks of rows, if a table has several."""
    count = int(columns.block_of_row.max(initial=0)) + 1
    if count > 1:
        join = ': between = "none" in the pattern joins them' if table.place is not None else ""
        message = (
            f"{count} blocks of rows, separated by empty lines, comments or repeated column names, are recordings of "
            f"their own{join}"
        )
        yield about_file(table.display_name, Sentence(message, reason="blocks_of_rows", n=count))
