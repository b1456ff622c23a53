"""Read the rows of a table: text with separators, JSON lines or Parquet, as an `ImportPattern` describes it.

To support another format, add a function to ``READERS`` and its endings to `pattern.ENDINGS`.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError, need
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Layout
from plushsense.core.sentences import Message
from plushsense.core.toml import loads_json
from plushsense.dataset.importing.pattern import INTERVAL, PARTS, ROLES, UNITS, ImportPattern

_NOT_A_NUMBER, _MISSING = float("nan"), float("inf")
_SEPARATORS = ",;\t"
# Beginnings of lines that are no rows, but comments and rulers between recordings.
_COMMENTS = ("#", "%", "//", "--", "==", "**")
# Time between two blocks of rows, of which nothing is known without a clock.
_APART_MS = 10_000.0


@dataclass(frozen=True)
class ImportedColumns:
    """Columns of a table by role or channel.

    Attributes:
        names: column of each role or channel.
        texts: person, session, label and take of each row, as far as there are such columns.
        numbers: channels and clocks (T,): NaN if a cell is no number, infinite for a missing-value word.
        blocks: number of the block of each row (T,), from 0: lines between recordings separate blocks.
        notes: what is to be said about rows that are not like the others.
        lines: line of the file of each row, from 1; empty if the format has no lines.
        in_ms: whether the times were dates and are milliseconds now.
        own_recordings: whether the file tells recordings apart itself, as by objects that hold whole recordings.
    """

    names: dict[str, str]
    texts: dict[str, list[str]]
    numbers: dict[str, NDArray[np.float64]]
    blocks: NDArray[np.int64]
    notes: list[Message] = field(default_factory=list)
    lines: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    in_ms: bool = False
    own_recordings: bool = False


_TIME_OF_DAY = re.compile(r"(?:(\d+):)?(\d+):(\d+(?:[.,]\d+)?)")


def date_ms(text: str) -> float:
    """Return the milliseconds of a date in ISO form, in UTC if it names no zone, or of a time; NaN if ``text`` is none.

    Times are ``12:01:02.5`` and, as spreadsheets show them, minutes and seconds with decimals: ``01:02.5``.
    """
    text = text.strip()
    with contextlib.suppress(ValueError):
        found = datetime.fromisoformat(text)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp() * 1000.0
    time = _TIME_OF_DAY.fullmatch(text)
    if time is None or (time[1] is None and time[3].isdecimal()):
        return _NOT_A_NUMBER
    return 1000.0 * (3600.0 * int(time[1] or 0) + 60.0 * int(time[2]) + float(time[3].replace(",", ".")))


@dataclass(frozen=True)
class TableFile:
    """A table to read: ``place`` are the parts that its path gives, None without a pattern; see `ImportPattern`."""

    path: Path
    display_name: str
    layout: Layout
    pattern: ImportPattern
    place: Mapping[str, str] | None = None

    def error(self, template: str, /, **values: object) -> FileFormatError:
        """Return the error that this file, ``{file}`` in the template, cannot be used."""
        return FileFormatError(template, file=self.display_name, **values)

    def hint(self, role: str) -> str:
        """Return how to say in which column a role stands."""
        if self.place is None:
            return f"name the right one with --column {role}=NAME"
        or_path = f", or let {{{role}}} stand in paths" if role in PARTS else ""
        clock = ", or give row_rate_hz if there is no clock" if role == "time" else ""
        return f'name the right one with  {role} = "NAME"  under [columns] of the pattern{or_path}{clock}'

    def choose_columns(self, there: Sequence[str]) -> dict[str, int]:
        """Return the index in ``there``, the names of all columns, for each role and channel that has a column.

        Raises:
            FileFormatError: for a missing column, or two columns of the same name.
        """
        plain = [name.strip().casefold() for name in there]
        layout, given = self.layout, self.pattern.columns
        headers = dict(zip(layout.csv.columns, layout.csv.header, strict=True))
        candidates: dict[str, tuple[str, ...]] = ROLES | {n: (n, headers.get(n, n)) for n in layout.names}
        for key, role in ((DEVICE_MS, "time"), (HOST_MS, HOST_MS)):
            candidates[role] = (*candidates[role], headers.get(key, key))
        needed = {"label", "time", *layout.names} - set(self.place or ())
        if self.pattern.intervals:
            needed -= {"label"}
            del candidates["label"]
        if self.pattern.row_rate_hz or INTERVAL in given:
            needed -= {"time"}
            del candidates["time"]
        chosen: dict[str, int] = {}
        for role, names in candidates.items():
            if role in given:
                names = (given[role],)
            elif role in (self.place or ()):
                continue
            at = self.column_index(names, plain)
            if at is not None:
                chosen[role] = at
            elif role in given or role in needed:
                if not any(plain):
                    raise self.error(
                        "'{file}' begins with no line of column names: a table needs a header{names}",
                        names=", or names in the pattern" if self.place is not None else "",
                    )
                listed = ", ".join(t.strip()[:30] for t in there[:20]) + (", …" if len(there) > 20 else "")
                missing = given.get(role, role)
                raise self.error(
                    "'{file}' has no column '{column}'; it has {there}: {hint}",
                    column=missing,
                    there=listed,
                    hint=self.hint(role),
                )
        return chosen

    def column_index(self, names: Sequence[str], plain: list[str]) -> int | None:
        """Return the index of the first column that ``names`` name: ``x``, ``x#2`` (the second x) or ``#3``."""
        for name in (n.strip().casefold() for n in names):
            if name in plain:
                if plain.count(name) > 1:
                    or_number = f", or name them {name}#1 and {name}#2 under [columns]"
                    raise self.error(
                        "'{file}' has two columns '{column}': rename one of them{or_number}",
                        column=name,
                        or_number=or_number if self.place is not None else "",
                    )
                return plain.index(name)
            base, sign, number = name.rpartition("#")
            if sign and number.isdecimal() and int(number):
                same = [k for k, other in enumerate(plain) if other == base] if base else range(len(plain))
                if int(number) <= len(same):
                    return same[int(number) - 1]
        return None

    def parser(self, role: str) -> Callable[[str], float]:
        """Return the function that reads the number in a cell: NaN if it holds none, infinite for a missing-value word.

        Dates in a column of times become milliseconds, see `date_ms`.
        """
        missing, comma = self.pattern.missing, self.pattern.decimal == ","

        def number(text: str) -> float:
            if missing and text.strip() in missing:
                return _MISSING
            if comma:
                text = text.replace(".", "_").replace(",", ".")
            try:
                value = float(text)
            except ValueError:
                return _NOT_A_NUMBER
            # Python would accept 1_000 as a number.
            return value if isfinite(value) and "_" not in text else _NOT_A_NUMBER

        def date(text: str) -> float:
            found = date_ms(text)
            return number(text) if isnan(found) else found

        return date if self.pattern.time_unit == "iso" and role in ("time", HOST_MS) else number


@dataclass
class _Rows:
    """Rows that are read one by one, as columns; a row has a cell for each of the roles in ``names``."""

    file: TableFile
    names: dict[str, str]
    why_malformed: str = "of another width than the header"
    texts: dict[str, list[str]] = field(default_factory=dict)
    numbers: dict[str, array[float]] = field(default_factory=dict)
    lines: array[int] = field(default_factory=lambda: array("q"))
    _between: dict[int, float] = field(default_factory=dict)
    _malformed: list[int] = field(default_factory=list)
    _first: str = ""
    _has_text_lines: bool = False

    def __post_init__(self) -> None:
        same: dict[str, str] = {}

        def text_of(cell: str) -> str:
            text = cell.strip()
            return same.setdefault(text, text)

        # One function for each cell of a row: a table may have millions of cells.
        self._store: list[tuple[Callable[[Any], None], Callable[[str], Any]]] = []
        for role in self.names:
            if role in PARTS:
                self._store.append((self.texts.setdefault(role, []).append, text_of))
            else:
                self._store.append((self.numbers.setdefault(role, array("d")).append, self.file.parser(role)))

    def add(self, line: int, cells: Iterable[str]) -> None:
        """Add a row, with its cell for each role."""
        for (store, read), cell in zip(self._store, cells, strict=True):
            store(read(cell))
        self.lines.append(line)

    def pass_over(self, lines: float) -> None:
        """Count ``lines`` that are no rows, before the next row; infinitely many always separate recordings."""
        self._between[len(self.lines)] = self._between.get(len(self.lines), 0) + lines

    def leave_out(self, line: int, text: str, *, is_text: bool = False) -> None:
        """Count a row that is not like the others."""
        self._malformed.append(len(self.lines))
        self._has_text_lines |= is_text
        self._first = self._first or f"line {line}: '{text.strip()[:60]}'"

    def columns(self, own_recordings: bool = False) -> ImportedColumns:
        """Return the columns. Without a clock, rows that are left out have taken their time, too."""
        rate, rows = self.file.pattern.row_rate_hz, len(self.lines)
        names, blocks = self.names, number_blocks(self._between, rows)
        numbers = {role: np.array(values, dtype=np.float64) for role, values in self.numbers.items()}
        if rate:
            before = np.searchsorted(self._malformed, np.arange(rows), side="right")
            numbers["time"] = (np.arange(rows) + before) * (1000.0 / rate) + blocks * _APART_MS
            names = names | {"time": "row number"}
        notes = []
        if count := len(self._malformed):
            ask = "; if such lines separate recordings, describe them with  between  in a pattern"
            notes.append(left_out_note(count, self.why_malformed, self._first + ask * self._has_text_lines))
        in_ms = bool(rate) or self.file.pattern.time_unit == "iso"
        lines = np.array(self.lines, dtype=np.int64)
        return ImportedColumns(names, self.texts, numbers, blocks, notes, lines, in_ms, own_recordings)


def left_out_note(count: int, reason: str, first: str) -> Message:
    """Return the note that rows are left out, with where the ``first`` of them stands, "" if that is not known."""
    at = f" (the first: {first})" if first else ""
    return Message("{n} row{more} {reason} left out{at}", n=count, more="s" if count > 1 else "", reason=reason, at=at)


def read_csv(file: TableFile) -> ImportedColumns:
    """Read a table of text with a header; skip lines of another width. See `ImportPattern` for what can differ."""
    pattern = file.pattern
    with file.path.open(encoding=pattern.text_encoding, newline="") as text:
        for _ in range(pattern.skip_before):
            text.readline()
        first = text.readline()
        separator = pattern.separator or max(_SEPARATORS, key=first.count)
        if file.place is not None and not pattern.separator and separator not in first and len(first.split()) > 1:
            separator = " "
        skipped, begin, there = pattern.skip_before, [first], list(pattern.names)
        if not there:
            there, begin = next(_split([first], separator), []), []
            skipped += 1 + pattern.skip_after
            for _ in range(pattern.skip_after):
                text.readline()
        at = file.choose_columns(there)
        rows = _Rows(file, {role: there[index].strip() for role, index in at.items()})
        for line, row in _numbered(itertools.chain(begin, text), separator, skipped):
            while len(row) > len(there) and not row[-1].strip():
                row.pop()
            if is_between(row, there, pattern):
                rows.pass_over(inf if row and row[0].strip() else 1)
                continue
            if not row:
                continue
            if row[-1].endswith(";"):
                # Some loggers end each line so.
                row[-1] = row[-1].rstrip("; ")
            # Spreadsheets save a line of text as a row with text in its first cell only.
            if len(row) == len(there) and (row[-1] or any(row[1:]) or not (row[0] and is_text(row))):
                rows.add(line, [row[k] for k in at.values()])
            else:
                rows.leave_out(line, separator.join(row), is_text=is_text(row))
    return rows.columns()


def is_between(row: Sequence[str], there: Sequence[str], pattern: ImportPattern) -> bool:
    """Return whether the cells of a line are no row, but separate recordings; see ``between`` of `ImportPattern`.

    Args:
        there: the names of the columns.
    """
    if pattern.between:
        return re.fullmatch(pattern.between, (pattern.separator or ",").join(row).strip()) is not None
    if not row or not row[0].strip():
        # A row of empty cells may have missing values.
        return not any(cell.strip() for cell in row) and not (row and "" in pattern.missing)
    return row[0].lstrip().startswith(_COMMENTS) or row == there


def number_blocks(between: Mapping[int, float], rows: int) -> NDArray[np.int64]:
    """Return the number of the block of each of ``rows`` rows, from 0.

    If every line of a file has two line ends, as after a wrong conversion, there is an empty line between any two rows:
    a block ends where there are more of them than usual.

    Args:
        between: number of lines that are no rows before a row; infinite for lines that always end a block.
    """
    inside = {row: lines for row, lines in between.items() if 0 < row < rows}
    usual = float(np.median(list(inside.values()))) if 2 * len(inside) > rows else 0.0
    begins = np.zeros(rows, dtype=np.int64)
    begins[[row for row, lines in inside.items() if lines > usual]] = 1
    return np.cumsum(begins)


def is_text(row: Sequence[str]) -> bool:
    """Return whether no cell begins with a number."""
    return not any(re.match(r"\s*[-+.,]?\d", cell) for cell in row)


def _split(lines: Iterable[str], separator: str) -> Iterator[list[str]]:
    if separator == " ":
        return (line.split() for line in lines)
    return csv.reader(lines, delimiter=separator)


def _numbered(lines: Iterable[str], separator: str, skipped: int) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the line, from 1, and the cells of each row behind ``skipped`` lines."""
    if separator == " ":
        yield from enumerate(_split(lines, separator), skipped + 1)
        return
    reader = csv.reader(lines, delimiter=separator)
    for row in reader:
        yield skipped + reader.line_num, row


def read_json(file: TableFile) -> ImportedColumns:
    """Read JSON objects, one a line or in a list: an object is a row, or a recording if its values are lists."""
    text = file.path.read_text(encoding=file.pattern.text_encoding)
    try:
        objects = one_recording_each(json_objects(text))
        first = next((item for _, item in objects if isinstance(item, dict)), None)
        there = list(dict.fromkeys(_paths(first)))
    except RecursionError:
        raise file.error("'{file}' holds JSON objects that are nested too deeply") from None
    if first is None:
        raise file.error("'{file}' holds no JSON object: accepted is one object a line, or a list of objects")
    at = file.choose_columns(there)
    paths = [there[k].split(".") for k in at.values()]
    names = {role: there[k].strip() for role, k in at.items()}
    if _length([_value(first, path) for path in paths]) is not None and "recording" not in at:
        # An object that holds a whole recording tells it apart from others by its number.
        names["recording"] = ""
    numbered = len(names) > len(at)
    rows, lists = _Rows(file, names, "without a JSON object whose lists have one length"), False
    for number, (line, item) in enumerate(objects):
        values = [_value(item, path) for path in paths] if isinstance(item, dict) else []
        length = _length(values) if isinstance(item, dict) else -1
        if length == -1:
            rows.leave_out(line, str(item))
            continue
        lists |= length is not None
        for k in range(1 if length is None else length):
            rows.add(line, [_cell(value, k) for value in values] + [str(number)] * numbered)
    columns = rows.columns(own_recordings=lists)
    return replace(columns, names={role: name for role, name in columns.names.items() if name}) if numbered else columns


def json_objects(text: str) -> list[tuple[int, Any]]:
    """Return the line, from 1 (in a list the number of the item), and the value of each object; a text if damaged."""
    if text.lstrip()[:1] == "[":
        found = _loaded(text)
        return [(1, found)] if found is text else list(enumerate(found, 1))
    # Texts may hold other characters that `splitlines` takes for line ends.
    lines = [(line, row) for line, row in enumerate(text.split("\n"), 1) if row.strip()]
    if lines and _loaded(lines[0][1]) is lines[0][1] and (whole := _loaded(text)) is not text:
        # A single object may take many lines.
        return [(lines[0][0], whole)]
    return [(line, _loaded(row)) for line, row in lines]


def _loaded(text: str) -> Any:
    """Return a JSON value; the text itself, which messages quote, if it is damaged."""
    try:
        return loads_json(text)
    except (ValueError, RecursionError):
        return text


# Lists of so many values are series of samples; shorter ones are rather the axes of one sample.
_SERIES = 8


def one_recording_each(objects: list[tuple[int, Any]]) -> list[tuple[int, Any]]:
    """Replace objects with lists of recordings by one object for each recording, with the values around it.

    micro:bit CreateAI nests them so: ``{"name": …, "recordings": [{"data": {"x": […], …}}, …]}``. Sensors that a list
    names beside rows of values, as in the data acquisition format of Edge Impulse, become ``sensors.NAME``.
    """
    found = {k: item for k, (_, item) in enumerate(objects) if isinstance(item, dict)}
    for key in dict.fromkeys(key for item in found.values() for key in item):
        held = {k: item[key] for k, item in found.items() if key in item}
        listed = any(map(_are_recordings, held.values()))
        lists = {k: value for k, value in held.items() if listed and isinstance(value, list)}
        inner = [(k, value) for k, value in held.items() if isinstance(value, dict)]
        inner += [(k, one) for k, value in lists.items() for one in value]
        outer = one_recording_each(inner) if inner else []
        if listed or any(one is not held[k] for k, one in outer):
            others = [item for k, item in enumerate(objects) if k not in {*lists, *(k for k, _ in inner)}]
            return others + [(objects[k][0], {**found[k], key: one}) for k, one in outer]
    return [(line, _by_sensor(item)) for line, item in objects]


def _are_recordings(value: Any) -> bool:
    """Return whether a JSON value is a list of objects with series of samples, and not of single samples."""
    if not isinstance(value, list) or not value or not all(isinstance(inner, dict) for inner in value):
        return False
    if any(_are_recordings(held) for inner in value for held in inner.values()):
        return True
    series = [list(_lengths(inner)) for inner in value]
    longest = {max(lengths, default=0) for lengths in series}
    # Samples of many cells have one length; a recording has several channels, or another length than the next.
    several = any(sum(n == max(lengths) for n in lengths) > 1 for lengths in series if lengths)
    return max(longest) >= _SERIES and (several or len(longest) > 1)


def _lengths(item: Any) -> Iterator[int]:
    """Yield the lengths of the lists in a JSON object, also of objects within it."""
    for value in item.values() if isinstance(item, dict) else ():
        if isinstance(value, list):
            yield len(value)
        else:
            yield from _lengths(value)


def _by_sensor(item: Any) -> Any:
    """Return an object whose list ``sensors`` names the columns of ``values`` with the series of each sensor."""
    if not isinstance(item, dict):
        return item
    sensors, values = item.get("sensors"), item.get("values")
    if not isinstance(sensors, list) or not isinstance(values, list):
        return item
    names = [sensor.get("name") if isinstance(sensor, dict) else None for sensor in sensors]
    if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        return item
    rows = [row if isinstance(row, list) else [row] for row in values]
    if not names or any(len(row) != len(names) for row in rows):
        return item
    return {**item, "sensors": {name: [row[k] for row in rows] for k, name in enumerate(names)}}


def json_cells(objects: Sequence[tuple[int, Any]]) -> dict[str, tuple[list[list[str]], bool]]:
    """Return the cells of each value in JSON objects by its path, and whether an object has a list of them.

    The cells of each list are apart; those of single values are together.
    """
    found: dict[str, tuple[list[list[str]], bool]] = {}
    for _, item in objects:
        values = {path: _value(item, path.split(".")) for path in _paths(item)} if isinstance(item, dict) else {}
        rows: Counter[int] = Counter()
        for value in values.values():
            if isinstance(value, list) and not any(isinstance(cell, list | dict) for cell in value):
                rows[len(value)] += len(value)
        # A list of another length than the series describes something else.
        length = max(rows, key=lambda n: (rows[n], n), default=0)
        # Short lists in each of many objects are the axes of a sample.
        length = 0 if length < _SERIES and len(objects) >= _SERIES else length
        for path, value in values.items():
            in_list = isinstance(value, list)
            cells = value if in_list else [value]
            if any(isinstance(cell, list | dict) for cell in cells) or (in_list and len(cells) != length):
                continue
            parts, _ = found.setdefault(path, ([], in_list))
            texts = [_cell(cell, 0) for cell in cells]
            if in_list or not parts:
                parts.append(texts)
            else:
                parts[0] += texts
    # The items of a list of plain values are its cells already, and sensors with names need no numbers.
    lists = {path for path, (_, in_list) in found.items() if in_list}
    numbered = {path.replace(".sensors.", ".values.").rpartition(".")[0] for path in found if ".sensors." in path}
    return {
        path: cells
        for path, cells in found.items()
        if path.rpartition(".")[0] not in lists | numbered and path not in numbered
    }


def _paths(item: Any, before: str = "") -> Iterator[str]:
    """Yield the path of every value in a JSON object, such as ``touch.x`` or ``acc.0``."""
    if isinstance(item, dict):
        for key, value in item.items():
            yield from _paths(value, f"{before}{key}.")
        return
    yield before[:-1]
    if isinstance(item, list) and item:
        if isinstance(item[0], dict):
            yield from _paths(item[0], before)
        else:
            inner = item[0] if isinstance(item[0], list) else item
            yield from (f"{before}{k}" for k in range(min(len(inner), 64)))


def _value(item: Any, steps: Sequence[str]) -> Any:
    """Return the value at ``steps`` in a JSON value; None if there is none.

    In a list of objects or of lists, it is the list of the values in each of them.
    """
    for k, step in enumerate(steps):
        if isinstance(item, dict):
            item = item.get(step)
        elif isinstance(item, list) and any(isinstance(inner, dict | list) for inner in item):
            return [_value(inner, steps[k:]) for inner in item]
        elif isinstance(item, list) and step.isdecimal() and int(step) < len(item):
            item = item[int(step)]
        else:
            return None
    return item


def _length(values: Iterable[Any]) -> int | None:
    """Return the common length of the lists among ``values``; None without lists, -1 if they differ."""
    lengths = {len(value) for value in values if isinstance(value, list)}
    return None if not lengths else lengths.pop() if len(lengths) == 1 else -1


def _cell(value: Any, at: int) -> str:
    """Return a JSON value, or item ``at`` of a list, as the text of a cell."""
    if isinstance(value, list):
        value = value[at]
    return "" if value is None else str(int(value)) if isinstance(value, bool) else str(value)


@contextlib.contextmanager
def _parquet_errors(name: str) -> Iterator[None]:
    """Raise FileFormatError for what polars raises when it cannot read the Parquet file ``name``."""
    try:
        yield
    except FileFormatError:
        raise
    except BaseException as cause:
        # A panic of polars on damaged bytes is a BaseException but no Exception.
        if not isinstance(cause, Exception) and type(cause).__name__ != "PanicException":
            raise
        message = " ".join(str(cause).split())[:120] or type(cause).__name__
        raise FileFormatError("'{file}' cannot be read as Parquet: {why}", file=name, why=message) from None


def is_parquet(path: Path) -> bool:
    """Return whether a file begins as a Parquet table does."""
    with path.open("rb") as opened:
        return opened.read(4) == b"PAR1"


def parquet_columns(path: Path) -> tuple[str, ...]:
    """Return the names of the columns of a Parquet table, sorted; () if it cannot be read."""
    pl = need("polars", extra="tables")
    try:
        with _parquet_errors(path.name), path.open("rb") as opened:
            return tuple(sorted(pl.read_parquet_schema(opened)))
    except FileFormatError:
        return ()


def parquet_objects(path: Path, rows: int) -> list[tuple[int, Any]]:
    """Return the first rows of a Parquet table as objects, as `json_cells` takes them.

    Columns whose cells are no values and no lists of values, such as pictures, are left out.

    Raises:
        FileFormatError: for a table that cannot be read.
        MissingExtraError: without polars.
    """
    pl = need("polars", extra="tables")
    with _parquet_errors(path.name), path.open("rb") as opened:
        table = pl.read_parquet(opened, n_rows=rows)
        for column in table.get_columns():
            inner = column.dtype.inner if column.dtype in (pl.List, pl.Array) else column.dtype
            if inner.is_nested() or inner in (pl.Binary, pl.Object):
                table = table.drop(column.name)
        floats = pl.selectors.float()
        return list(enumerate(table.with_columns(pl.when(floats.is_finite()).then(floats)).to_dicts(), 1))


def read_parquet(file: TableFile) -> ImportedColumns:
    """Read a Parquet table with polars; each value of a list becomes a row, and a row of lists a recording."""
    if not is_parquet(file.path):
        raise file.error("'{file}' is no Parquet file: it does not begin with PAR1")
    pattern = file.pattern
    if pattern.missing:
        raise file.error("'{file}' is a Parquet table, whose columns have types: missing is for text, leave it out")
    pl = need("polars", extra="tables")
    with _parquet_errors(file.display_name):
        with file.path.open("rb") as opened:
            schema = pl.read_parquet_schema(opened)
        series = [n for n, kind in schema.items() if kind.base_type() in (pl.List, pl.Array)]
        # ``a.0`` is the first value of the lists in column a.
        axes = {f"{n}.{k}": (n, k) for n in series for k in range(_SERIES)}
        there = [*schema, *(name for name in axes if name not in schema)]
        names = {role: there[at] for role, at in file.choose_columns(there).items()}
        with file.path.open("rb") as opened:
            read = [name if name in schema else axes[name][0] for name in names.values()]
            table = pl.read_parquet(opened, columns=list(dict.fromkeys(read)))
        for name in set(names.values()) - set(schema):
            of, k = axes[name]
            lists_of = table[of].cast(pl.List(table[of].dtype.inner))
            table = table.with_columns(lists_of.list.get(k, null_on_oob=True).alias(name))
        table = table.select(list(dict.fromkeys(names.values())))
        lists = [n for n in table.columns if table[n].dtype.base_type() in (pl.List, pl.Array)]
        if lists:
            row = "row" + "_" * max(map(len, table.columns))
            table = table.with_row_index(row).explode(lists)
            names.setdefault("recording", row)
        nested = next((n for n in table.columns if table[n].dtype.is_nested()), None)
        if nested is not None:
            raise file.error("'{file}' has more than one value in a cell of column '{column}'", column=nested)
        texts = {r: [text.strip() for text in _parquet_texts(pl, table[n])] for r, n in names.items() if r in PARTS}
        numbers = {r: _parquet_numbers(pl, table[n]) for r, n in names.items() if r not in PARTS}
        in_ms = "time" in names and table[names["time"]].dtype.is_temporal()
        if pattern.time_unit == "iso" and "time" in names and not in_ms:
            raise file.error(
                "'{file}' has no dates in column '{column}': leave time_unit out, or give a unit", column=names["time"]
            )
    if pattern.row_rate_hz:
        numbers["time"] = np.arange(len(table), dtype=np.float64) * (1000.0 / pattern.row_rate_hz)
        names["time"], in_ms = "row number", True
    return ImportedColumns(names, texts, numbers, np.zeros(len(table), dtype=np.int64), in_ms=in_ms)


def _parquet_texts(pl: Any, column: Any) -> list[str]:
    # As in JSON, true is 1.
    column = column.cast(pl.Int8) if column.dtype == pl.Boolean else column
    return list(column.cast(pl.String).fill_null("").to_list())


def _parquet_numbers(pl: Any, column: Any) -> NDArray[np.float64]:
    if column.dtype == pl.Time:
        column = column.cast(pl.Int64).cast(pl.Duration("ns"))
    if column.dtype.is_temporal():
        microseconds = column.dt.total_microseconds() if column.dtype == pl.Duration else column.dt.epoch("us")
        column = microseconds.cast(pl.Float64) / 1000.0
    numbers = np.asarray(column.cast(pl.Float64, strict=False).fill_null(_NOT_A_NUMBER).to_numpy())
    return np.where(np.isinf(numbers), _NOT_A_NUMBER, numbers)


READERS: dict[str, Callable[[TableFile], ImportedColumns]] = {
    "csv": read_csv,
    "json": read_json,
    "parquet": read_parquet,
}


def read_rows(file: TableFile) -> ImportedColumns:
    """Read a table in one of the formats of `READERS`.

    Raises:
        FileFormatError: for a table that cannot be read or lacks a column.
        MissingExtraError: for Parquet without polars.
    """
    try:
        columns = READERS[file.pattern.format_of(file.path)](file)
    except UnicodeError:
        hint = ", or name its encoding in the pattern" if file.place is not None else ""
        encoding = file.pattern.encoding.upper()
        raise file.error("'{file}' is not {encoding}: save it as UTF-8{hint}", encoding=encoding, hint=hint) from None
    except csv.Error as cause:
        raise file.error("'{file}' is no CSV table: {cause}", cause=cause) from None
    if INTERVAL not in columns.numbers:
        return columns
    times = np.cumsum(columns.numbers[INTERVAL])
    numbers = {**columns.numbers, "time": np.concatenate([[0.0], times[:-1]]) if len(times) else times}
    return replace(columns, numbers=numbers, names=columns.names | {"time": columns.names[INTERVAL]}, in_ms=True)


def forward_steps(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the differences of neighbouring times that are numbers above 0."""
    with np.errstate(invalid="ignore"):  # two missing times
        steps = np.diff(times)
    return steps[np.isfinite(steps) & (steps > 0)]


def unit_in_name(name: str) -> str:
    """Return the unit of time that the name of a column ends in, as ``t_ms`` and ``t (ms)`` do; "" without one."""
    plain = name.strip().casefold().rstrip(")")
    return next((unit for unit in UNITS if plain.endswith((f"_{unit}", f"({unit}", f"[{unit}]"))), "")


def unit_of_time(name: str, times: NDArray[np.float64], rate_hz: float) -> tuple[str, bool]:
    """Return the unit of a column of times, and whether its name states it.

    Otherwise the unit is the one that agrees best with the layout's rate.
    """
    if unit := unit_in_name(name):
        return unit, True
    forward = forward_steps(times[:100_000])
    if not len(forward):
        return "ms", False
    step = float(np.median(forward))
    return min(UNITS, key=lambda u: abs(np.log(step * UNITS[u] * rate_hz / 1000.0))), False
