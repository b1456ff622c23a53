"""Import a table with one row per sample: ``subject, [session], [recording], label, time`` and the channels.

A Parquet table may also have one row per recording or stream, with lists of samples as cells, as in data sets of
Hugging Face.

Rows are grouped by person and session, in the order of the file. A recording is a run of rows with the same label (and
the same ``recording``, if there is such a column); without that column it also ends where the time decreases or pauses
for more than a second. Rows without a label belong to no recording; a session with such rows is also written as stream.
"""

from __future__ import annotations

import csv
import itertools
import json
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, FileFormatError, nearest, need
from plushsense.core.gestures import plain_label
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Layout
from plushsense.core.recorder_csv import (
    LONGEST_LABEL,
    STREAM_NAME,
    Frames,
    format_header,
    format_rows,
    recording_filename,
    write_recording,
)
from plushsense.core.sentences import Sentence
from plushsense.dataset.files import sha256_of
from plushsense.dataset.importing.sources import COMPANIONS, SourceFile
from plushsense.dataset.store import RECORDINGS, STREAMS

ORIGIN = "origin.json"
LARGEST = 2.0**53
# A channel with values between the steps of its layout, and a spread of few steps, probably has another scale.
_FEW_STEPS = 10.0
_BETWEEN = 0.05


@dataclass(frozen=True)
class LabelledSegment:
    """Labelled part of a session: the rows from ``start`` to before ``stop`` of its frames."""

    label: str
    start: int
    stop: int


@dataclass(frozen=True)
class ConvertedSource:
    """File from which recordings were converted; ``more`` are additional values for ``origin.json``."""

    path: Path
    display_name: str
    more: dict[str, Any]

    @cached_property
    def text(self) -> str:
        """Text of ``origin.json``: the source, its SHA-256 and ``more``."""
        table = {"source": self.display_name, "sha256": sha256_of(self.path)} | self.more
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


def write_session(
    folder: Path,
    subject: str,
    session: str,
    frames: Frames,
    cuts: Sequence[LabelledSegment],
    layout: Layout,
    original: ConvertedSource,
    *,
    with_stream: bool,
) -> Iterator[SourceFile]:
    """Write one session into the new ``folder``: recordings, with ``with_stream`` the stream, and ``origin.json``.

    For a layout with a label on every row, one labelled stream is written instead of recordings. Yields the files.
    """
    folder.mkdir(parents=True)
    where = f"{original.display_name}: {subject}{f', session {session}' if session else ''}"
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
        yield SourceFile(main, STREAMS, subject, session=session, origin=f"{where}, the whole stream")
    written_paths: set[Path] = set()
    clock = frames.device_ms if frames.host_ms is None or HOST_MS not in layout.csv.columns else frames.host_ms
    for cut in cuts:
        name = f"{where}, rows {cut.start + 1} to {cut.stop} ('{cut.label[:40]}')"
        at_ms = abs(int(clock[cut.start]))
        # Recordings of the same label and length would have the same name if their clocks all begin at 0.
        while (path := folder / recording_filename(cut.label, at_ms, cut.stop - cut.start)) in written_paths:
            at_ms += 1
        written_paths.add(path)
        if len(path.name.encode("utf-8")) > LONGEST_LABEL:
            note = Sentence("its label is too long for a file name", reason="label_too_long")
            yield SourceFile(path, "", origin=name, reason=note)
            continue
        write_recording(path, frames.slice(cut.start, cut.stop), layout)
        yield SourceFile(path, RECORDINGS, subject, session=session, origin=name)
    about = folder / ORIGIN
    about.write_text(original.text, encoding="utf-8", newline="\n")
    yield SourceFile(about, COMPANIONS, subject, session=session, origin=f"{where}, {ORIGIN}", beside=main)


PAUSE_MS = 1000.0
STREAM_ROLE = "stream"
# Accepted column names by role.
ROLES: dict[str, tuple[str, ...]] = {
    "subject": ("subject", "participant", "person", "subject_id", "participant_id"),
    "session": ("session", "session_id"),
    "recording": ("recording", "recording_id", "trial"),
    "label": ("label", "gesture", "activity"),
    "time": (DEVICE_MS, "time", "timestamp", "time_ms", "time_s", "timestamp_ms", "timestamp_s", "t"),
    HOST_MS: (HOST_MS,),
}
_TEXTS = ("subject", "session", "recording", "label")
_UNITS = {"ns": 1e-6, "us": 1e-3, "µs": 1e-3, "ms": 1.0, "s": 1000.0}


@dataclass(frozen=True)
class ImportedColumns:
    """Columns of a table by role or channel: their ``names``, texts, and numbers (T,) with NaN for missing ones."""

    names: dict[str, str]
    texts: dict[str, list[str]]
    numbers: dict[str, NDArray[np.float64]]
    malformed: int = 0
    in_ms: bool = False
    """Whether the time column had a temporal type and was converted to milliseconds."""


def check_roles(columns: Mapping[str, str], layout: Layout) -> None:
    """Raise ConfigError for an unknown role in ``columns`` (the option ``--column``)."""
    known = (*ROLES, STREAM_ROLE, *layout.names)
    for role in columns:
        if role not in known:
            raise ConfigError(f"--column {role}=…: accepted are {', '.join(known)}.{nearest(role, known)}")


def choose_columns(there: list[str], layout: Layout, given: Mapping[str, str], display_name: str) -> dict[str, str]:
    """Return the name in ``there`` (the table's columns) for each role and channel; ``given`` overrides the defaults.

    Raises:
        FileFormatError: for a missing column, or two columns of the same name.
    """
    plain = [name.strip().casefold() for name in there]
    candidates: dict[str, tuple[str, ...]] = dict(ROLES)
    headers = dict(zip(layout.csv.columns, layout.csv.header, strict=True))
    candidates |= {n: (n, headers.get(n, n)) for n in layout.names}
    for key, role in ((DEVICE_MS, "time"), (HOST_MS, HOST_MS)):
        candidates[role] = (*candidates[role], headers.get(key, key))
    chosen = {}
    for role, names in candidates.items():
        if role in given:
            names = (given[role],)
        match = next((n.strip().casefold() for n in names if n.strip().casefold() in plain), None)
        if match is not None and plain.count(match) > 1:
            message = f"'{display_name}' has two columns '{match}': rename one of them"
            raise FileFormatError(message, reason="column_twice", file=display_name, column=match)
        if match is not None:
            chosen[role] = there[plain.index(match)]
        elif role in given or role in ("label", "time") or role in layout.names:
            if not any(plain):
                message = f"'{display_name}' begins with no line of column names: a table needs a header"
                raise FileFormatError(message, reason="table_no_header", file=display_name)
            listed = ", ".join(t[:30] for t in there[:20]) + (", …" if len(there) > 20 else "")
            raise FileFormatError(
                f"'{display_name}' has no column '{names[0]}'; it has {listed}: name the right one with "
                f"--column {role}=NAME",
                reason="table_column_missing",
                file=display_name,
                column=names[0],
                there=listed,
            )
    return chosen


def read_csv(path: Path, display_name: str, layout: Layout, given: Mapping[str, str]) -> ImportedColumns:
    """Read a CSV table in UTF-8 with a header and ``,``, ``;`` or tab as separator; skip lines of another width."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            separator = max(",;\t", key=first.count)
            there = next(csv.reader([first], delimiter=separator), [])
            names = choose_columns(there, layout, given, display_name)
            at = {role: there.index(name) for role, name in names.items()}
            texts: dict[str, list[str]] = {role: [] for role in names if role in _TEXTS}
            numbers = {role: array("d") for role in names if role not in _TEXTS}
            text_at = [(values.append, at[role]) for role, values in texts.items()]
            number_at = [(values.append, at[role]) for role, values in numbers.items()]
            same: dict[str, str] = {}
            malformed = 0
            for row in csv.reader(file, delimiter=separator):
                if len(row) != len(there):
                    malformed += bool(row)
                    continue
                for append, index in text_at:
                    text = row[index].strip()
                    append(same.setdefault(text, text))
                for push, index in number_at:
                    push(_number(row[index]))
    except UnicodeDecodeError:
        message = f"'{display_name}' is not UTF-8: save it as UTF-8"
        raise FileFormatError(message, reason="table_not_utf8", file=display_name) from None
    except csv.Error as cause:
        message = f"'{display_name}' is no CSV table: {cause}"
        raise FileFormatError(message, reason="table_damaged", file=display_name) from None
    return ImportedColumns(
        names, texts, {role: np.array(v, dtype=np.float64) for role, v in numbers.items()}, malformed
    )


def _number(text: str) -> float:
    try:
        # Python would accept 1_000 as a number.
        return float(text) if "_" not in text else float("nan")
    except ValueError:
        return float("nan")


def read_parquet(path: Path, display_name: str, layout: Layout, given: Mapping[str, str]) -> ImportedColumns:
    """Read a Parquet table with polars; each value of a list becomes a row, and a row of lists a recording."""
    with path.open("rb") as file:
        if file.read(4) != b"PAR1":
            message = f"'{display_name}' is no Parquet file: it does not begin with PAR1"
            raise FileFormatError(message, reason="table_damaged", file=display_name)
    pl = need("polars", extra="tables")
    try:
        with path.open("rb") as file:
            there = list(pl.read_parquet_schema(file))
        names = choose_columns(there, layout, given, display_name)
        with path.open("rb") as file:
            table = pl.read_parquet(file, columns=list(dict.fromkeys(names.values())))
        lists = [n for n in table.columns if table[n].dtype.base_type() in (pl.List, pl.Array)]
        if lists:
            row = "row" + "_" * max(map(len, table.columns))
            table = table.with_row_index(row).explode(lists)
            if "recording" not in names:
                names["recording"] = row
        nested = next((n for n in table.columns if table[n].dtype.is_nested()), None)
        if nested is not None:
            message = f"'{display_name}' has more than one value in a cell of column '{nested}'"
            raise FileFormatError(message, reason="table_damaged", file=display_name)
        texts = {
            r: [text.strip() for text in table[n].cast(pl.String).fill_null("").to_list()]
            for r, n in names.items()
            if r in _TEXTS
        }
        numbers = {r: _parquet_numbers(pl, table[n]) for r, n in names.items() if r not in _TEXTS}
        in_ms = table[names["time"]].dtype.is_temporal()
    except FileFormatError:
        raise
    except BaseException as cause:
        # A panic of polars on damaged bytes is a BaseException but no Exception.
        if not isinstance(cause, Exception) and type(cause).__name__ != "PanicException":
            raise
        message = " ".join(str(cause).split())[:120] or type(cause).__name__
        message = f"'{display_name}' cannot be read as Parquet: {message}"
        raise FileFormatError(message, reason="table_damaged", file=display_name) from None
    return ImportedColumns(names, texts, numbers, in_ms=in_ms)


def _parquet_numbers(pl: Any, column: Any) -> NDArray[np.float64]:
    if column.dtype.is_temporal():
        microseconds = column.dt.total_microseconds() if column.dtype == pl.Duration else column.dt.epoch("us")
        column = microseconds.cast(pl.Float64) / 1000.0
    return np.asarray(column.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy())


def milliseconds(name: str, times: NDArray[np.float64], rate_hz: float) -> tuple[float, str]:
    """Return the milliseconds per unit of the time column, and a note if its name does not state the unit.

    In that case, the unit is the one that agrees best with the layout's rate.
    """
    plain = name.strip().casefold().rstrip(")")
    for unit, factor in _UNITS.items():
        if plain.endswith((f"_{unit}", f"({unit}", f"[{unit}]")):
            return factor, ""
    steps = np.diff(times[:100_000])
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not len(forward):
        return 1.0, Sentence(f"column '{name}' is read as milliseconds", reason="time_unit", column=name, unit="ms")
    step = float(np.median(forward))
    unit = min(_UNITS, key=lambda u: abs(np.log(step * _UNITS[u] * rate_hz / 1000.0)))
    message = f"column '{name}' is read as {unit}, as the rate of {rate_hz:g} Hz suggests"
    return _UNITS[unit], Sentence(message, reason="time_unit", column=name, unit=unit)


def about_file(name: str, note: str) -> Sentence:
    """Return a note about the file ``name``."""
    return Sentence(f"{name}: {note}", reason="about_file", file=name, note=note)


def _codes(texts: Iterable[str]) -> tuple[NDArray[np.int64], list[str]]:
    """Number ``texts`` by first appearance; return the number of each, and the distinct texts."""
    known: dict[str, int] = {}
    numbers = [known.setdefault(text, len(known)) for text in texts]
    return np.array(numbers, dtype=np.int64), list(known)


def read_table(
    path: Path, display_name: str, folder: Path, subject: str | None, layout: Layout, given: Mapping[str, str]
) -> Iterator[SourceFile | str]:
    """Write the recordings of a table into the new ``folder``; yield the files, and warnings as text.

    ``subject`` is the person if the table has no such column.

    Raises:
        FileFormatError: for a table that cannot be read, lacks a column, or has no usable row.
        MissingExtraError: for Parquet without polars.
    """
    read = read_parquet if path.suffix.lower() == ".parquet" else read_csv
    columns = read(path, display_name, layout, given)
    if "subject" not in columns.names and subject is None:
        raise FileFormatError(
            f"'{display_name}' has no column 'subject': name the right one with --column subject=NAME, or the person "
            "with --subjects map.csv (file,subject)",
            reason="person_unknown",
        )
    raw = np.column_stack([columns.numbers[n] for n in layout.names])
    times = columns.numbers["time"]
    factor, note = (1.0, "") if columns.in_ms else milliseconds(columns.names["time"], times, layout.rate_hz)
    device = times * factor
    host = columns.numbers.get(HOST_MS, device)
    rows = len(device)
    people, codes = _codes(columns.texts.get("subject", itertools.repeat(subject or "", rows)))
    sessions, session_names = _codes(columns.texts.get("session", itertools.repeat("", rows)))
    labels, label_names = _codes(columns.texts["label"])
    takes, _ = _codes(columns.texts.get("recording", itertools.repeat("", rows)))
    known = np.array([bool(c) for c in codes], dtype=bool)[people] if rows else np.empty(0, bool)
    good = usable_rows(raw, device, host)
    if note:
        yield about_file(display_name, note)
    for count, reason in (
        (columns.malformed, "of another width than the header"),
        (int(np.sum(~good)), "without a number in every column"),
        (int(np.sum(good & ~known)), "without a subject"),
    ):
        if count:
            message = f"{count} row{'s' if count > 1 else ''} {reason} left out"
            yield about_file(display_name, Sentence(message, reason="rows_left_out", n=count))
    good &= known
    if not good.any():
        raise FileFormatError(
            f"'{display_name}' has no usable row: each needs a subject, a time and {layout.n_channels} numbers",
            reason="rows_unusable",
            n=layout.n_channels,
        )
    values, note = whole_steps(raw[good], layout)
    if note:
        yield about_file(display_name, note)
    device_ms, host_ms = (np.round(clock[good]).astype(np.int64) for clock in (device, host))
    people, sessions, labels, takes = people[good], sessions[good], labels[good], takes[good]
    named = np.array([bool(plain_label(n)) and len(n) <= LONGEST_LABEL for n in label_names], dtype=bool)
    group = people * len(session_names) + sessions
    order = np.argsort(group, kind="stable")
    edges = [0, *(np.flatnonzero(np.diff(group[order])) + 1).tolist(), len(order)]
    original = ConvertedSource(path, display_name, {"columns": columns.names})
    for number, (first, last) in enumerate(itertools.pairwise(edges)):
        mine = order[first:last]
        frames = Frames(values[mine], device_ms[mine], host_ms[mine])
        new = (np.diff(labels[mine]) != 0) | (np.diff(takes[mine]) != 0)
        if "recording" not in columns.names:
            steps = np.diff(frames.device_ms)
            new |= (steps < 0) | (steps > PAUSE_MS)
        runs = [0, *(np.flatnonzero(new) + 1).tolist(), len(mine)]
        labelled = named[labels[mine]]
        cuts = [LabelledSegment(label_names[labels[mine[a]]], a, b) for a, b in itertools.pairwise(runs) if labelled[a]]
        yield from write_session(
            folder / str(number),
            codes[people[mine[0]]],
            session_names[sessions[mine[0]]],
            frames,
            cuts,
            layout,
            original,
            with_stream=not labelled.all(),
        )
