"""One table of everything, a row a sample: ``subject, [session], [recording], label, time`` and the channels.

Rows are taken person by person and session by session, in the order of the file. A recording is a run of rows with one
label (and one ``recording``, where there is such a column); without that column it also ends where the time runs back
or pauses for more than a second. Rows without a label belong to no recording: where a session has such rows, all its
rows are kept as its stream too.
"""

from __future__ import annotations

import csv
import itertools
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, FileFormatError, nearest
from plushsense.core.extras import need
from plushsense.core.gestures import plain_label
from plushsense.core.recfile import Frames
from plushsense.core.rows import LONGEST_LABEL
from plushsense.core.signal import DEVICE_MS, HOST_MS, Layout
from plushsense.dataset.converted import Cut, Original, lay_out, usable_rows, whole_steps
from plushsense.dataset.sources import Found

PAUSE_MS = 1000.0
STREAM_ROLE = "stream"
# What a column may be called when nobody says.
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
class Columns:
    """The columns that are used, by role or channel: texts as lists, numbers (T,) with NaN where there is none."""

    names: dict[str, str]
    texts: dict[str, list[str]]
    numbers: dict[str, NDArray[np.float64]]
    malformed: int = 0
    in_ms: bool = False
    """The time is of a type that knows its unit, already in milliseconds."""


def check_roles(columns: Mapping[str, str], layout: Layout) -> None:
    """Refuse a ``--column`` of a role that there is not."""
    known = (*ROLES, STREAM_ROLE, *layout.names)
    for role in columns:
        if role not in known:
            raise ConfigError(f"--column {role}=…: accepted are {', '.join(known)}.{nearest(role, known)}")


def choose(there: list[str], layout: Layout, given: Mapping[str, str], shown: str) -> dict[str, str]:
    """Which column of ``there`` is what: role or channel to column name.

    Raises:
        FileFormatError: for a column that is missing, or there twice.
    """
    plain = [name.strip().casefold() for name in there]
    wanted: dict[str, tuple[str, ...]] = dict(ROLES)
    headers = dict(zip(layout.csv.columns, layout.csv.header, strict=True))
    wanted |= {n: (n, headers.get(n, n)) for n in layout.names}
    for key, role in ((DEVICE_MS, "time"), (HOST_MS, HOST_MS)):
        wanted[role] = (*wanted[role], headers.get(key, key))
    chosen = {}
    for role, names in wanted.items():
        if role in given:
            names = (given[role],)
        found = next((n.strip().casefold() for n in names if n.strip().casefold() in plain), None)
        if found is not None and plain.count(found) > 1:
            raise FileFormatError(f"'{shown}' has two columns '{found}': rename one of them")
        if found is not None:
            chosen[role] = there[plain.index(found)]
        elif role in given or role in ("label", "time") or role in layout.names:
            if not any(plain):
                raise FileFormatError(f"'{shown}' begins with no line of column names: a table needs a header")
            listed = ", ".join(t[:30] for t in there[:20]) + (", …" if len(there) > 20 else "")
            raise FileFormatError(
                f"'{shown}' has no column '{names[0]}'; it has {listed}: name the right one with --column {role}=NAME"
            )
    return chosen


def read_csv(path: Path, shown: str, layout: Layout, given: Mapping[str, str]) -> Columns:
    """The columns of a CSV table: ``,``, ``;`` or tab, a header, UTF-8. Lines of another width are left out."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            separator = max(",;\t", key=first.count)
            there = next(csv.reader([first], delimiter=separator), [])
            names = choose(there, layout, given, shown)
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
        raise FileFormatError(f"'{shown}' is not UTF-8: save it as UTF-8") from None
    except csv.Error as cause:
        raise FileFormatError(f"'{shown}' is no CSV table: {cause}") from None
    return Columns(names, texts, {role: np.array(v, dtype=np.float64) for role, v in numbers.items()}, malformed)


def _number(text: str) -> float:
    try:
        # Python alone takes 1_000 for a number.
        return float(text) if "_" not in text else float("nan")
    except ValueError:
        return float("nan")


def read_parquet(path: Path, shown: str, layout: Layout, given: Mapping[str, str]) -> Columns:
    """The columns of a Parquet table, through polars."""
    with path.open("rb") as file:
        if file.read(4) != b"PAR1":
            raise FileFormatError(f"'{shown}' is no Parquet file: it does not begin with PAR1")
    pl = need("polars", extra="tables")
    try:
        with path.open("rb") as file:
            there = list(pl.read_parquet_schema(file))
        names = choose(there, layout, given, shown)
        with path.open("rb") as file:
            table = pl.read_parquet(file, columns=list(dict.fromkeys(names.values())))
        nested = next((n for n in table.columns if table[n].dtype.is_nested()), None)
        if nested is not None:
            raise FileFormatError(f"'{shown}' has more than one value in a cell of column '{nested}'")
        texts = {r: _parquet_texts(pl, table[n]) for r, n in names.items() if r in _TEXTS}
        numbers = {r: _parquet_numbers(pl, table[n]) for r, n in names.items() if r not in _TEXTS}
        in_ms = table[names["time"]].dtype.is_temporal()
    except FileFormatError:
        raise
    except BaseException as cause:
        # A panic of polars on damaged bytes is no Exception.
        if not isinstance(cause, Exception) and type(cause).__name__ != "PanicException":
            raise
        said = " ".join(str(cause).split())[:120] or type(cause).__name__
        raise FileFormatError(f"'{shown}' cannot be read as Parquet: {said}") from None
    return Columns(names, texts, numbers, in_ms=in_ms)


def _parquet_texts(pl: Any, column: Any) -> list[str]:
    return [text.strip() for text in column.cast(pl.String).fill_null("").to_list()]


def _parquet_numbers(pl: Any, column: Any) -> NDArray[np.float64]:
    if column.dtype.is_temporal():
        microseconds = column.dt.total_microseconds() if column.dtype == pl.Duration else column.dt.epoch("us")
        column = microseconds.cast(pl.Float64) / 1000.0
    numbers: NDArray[np.float64] = column.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy()
    return numbers


def milliseconds(name: str, times: NDArray[np.float64], rate_hz: float) -> tuple[float, str]:
    """Milliseconds in one unit of the time column, and a sentence when its name does not say.

    The unit is then the one that puts the rows nearest to the layout's rate: units lie a thousand times apart.
    """
    plain = name.strip().casefold().rstrip(")")
    for unit, factor in _UNITS.items():
        if plain.endswith((f"_{unit}", f"({unit}", f"[{unit}]")):
            return factor, ""
    steps = np.diff(times[:100_000])
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not len(forward):
        return 1.0, f"column '{name}' is taken for milliseconds"
    step = float(np.median(forward))
    unit = min(_UNITS, key=lambda u: abs(np.log(step * _UNITS[u] * rate_hz / 1000.0)))
    return _UNITS[unit], f"column '{name}' is taken for {unit}, as the rate of {rate_hz:g} Hz suggests"


def _codes(texts: Iterable[str]) -> tuple[NDArray[np.int64], list[str]]:
    """Texts as numbers by first appearance, and the texts."""
    known: dict[str, int] = {}
    numbers = [known.setdefault(text, len(known)) for text in texts]
    return np.array(numbers, dtype=np.int64), list(known)


READERS = {".csv": read_csv, ".parquet": read_parquet}


def read_table(
    path: Path, shown: str, folder: Path, subject: str | None, layout: Layout, given: Mapping[str, str]
) -> Iterator[Found | str]:
    """Lay out a table's recordings in the new ``folder``; yields the files, and sentences about what was odd.

    ``subject`` is whose the table is when it has no column that says so.

    Raises:
        FileFormatError: for a table that cannot be read, or lacks a column.
        MissingExtraError: for Parquet without polars.
    """
    columns = READERS[path.suffix.lower()](path, shown, layout, given)
    if "subject" not in columns.names and subject is None:
        raise FileFormatError(
            f"'{shown}' has no column 'subject': name the right one with --column subject=NAME, or the person with "
            "--subjects map.csv (file,subject)"
        )
    raw = np.column_stack([columns.numbers[n] for n in layout.names])
    times = columns.numbers["time"]
    factor, said = (1.0, "") if columns.in_ms else milliseconds(columns.names["time"], times, layout.rate_hz)
    device = times * factor
    host = columns.numbers.get(HOST_MS, device)
    rows = len(device)
    people, codes = _codes(columns.texts.get("subject", itertools.repeat(subject or "", rows)))
    sessions, session_names = _codes(columns.texts.get("session", itertools.repeat("", rows)))
    labels, label_names = _codes(columns.texts["label"])
    takes, _ = _codes(columns.texts.get("recording", itertools.repeat("", rows)))
    known = np.array([bool(c) for c in codes], dtype=bool)[people] if rows else np.empty(0, bool)
    good = usable_rows(raw, device, host)
    if said:
        yield f"{shown}: {said}"
    for count, what in (
        (columns.malformed, "of another width than the header"),
        (int(np.sum(~good)), "without a number in every column"),
        (int(np.sum(good & ~known)), "without a subject"),
    ):
        if count:
            yield f"{shown}: {count} row{'s' if count > 1 else ''} {what} left out"
    good &= known
    if not good.any():
        raise FileFormatError(
            f"'{shown}' has no usable row: each needs a subject, a time and {layout.n_channels} numbers"
        )
    values, said = whole_steps(raw[good], layout)
    if said:
        yield f"{shown}: {said}"
    whole = Frames(values, np.round(device[good]).astype(np.int64), np.round(host[good]).astype(np.int64))
    people, sessions, labels, takes = people[good], sessions[good], labels[good], takes[good]
    named = np.array([bool(plain_label(n)) and len(n) <= LONGEST_LABEL for n in label_names], dtype=bool)
    group = people * len(session_names) + sessions
    order = np.argsort(group, kind="stable")
    edges = [0, *(np.flatnonzero(np.diff(group[order])) + 1).tolist(), len(order)]
    original = Original(path, shown, {"columns": columns.names})
    for number, (first, last) in enumerate(itertools.pairwise(edges)):
        mine = order[first:last]
        frames = Frames(whole.values[mine], whole.device_ms[mine], host_ms=_rows(whole.host_ms, mine))
        new = (np.diff(labels[mine]) != 0) | (np.diff(takes[mine]) != 0)
        if "recording" not in columns.names:
            steps = np.diff(frames.device_ms)
            new |= (steps < 0) | (steps > PAUSE_MS)
        runs = [0, *(np.flatnonzero(new) + 1).tolist(), len(mine)]
        labelled = named[labels[mine]]
        cuts = [Cut(label_names[labels[mine[a]]], a, b) for a, b in itertools.pairwise(runs) if labelled[a]]
        yield from lay_out(
            folder / str(number),
            codes[people[mine[0]]],
            session_names[sessions[mine[0]]],
            frames,
            cuts,
            layout,
            original,
            with_stream=not labelled.all(),
        )


def _rows(column: NDArray[np.int64] | None, rows: NDArray[np.int64]) -> NDArray[np.int64] | None:
    return None if column is None else column[rows]
