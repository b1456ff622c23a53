"""Guess the pattern of an import from the files of a folder: separator, header, columns, clock, and parts of the paths.

A guess is a TOML file with comments for a person to look through, not a decision: what is uncertain is listed.
"""

from __future__ import annotations

import csv
import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.files import write_file
from plushsense.core.gestures import plain_label
from plushsense.core.recorder_csv import parse_name
from plushsense.core.sentences import join_names
from plushsense.core.toml import load_table, loads_json
from plushsense.dataset.importing.columns import (
    CODE_NAMES,
    MOST_CODES,
    SampledColumn,
    TableForm,
    find_form,
    is_number,
    named_column,
    stated_rate,
)
from plushsense.dataset.importing.counters import CLOCK, COUNTER, Floats, no_reading
from plushsense.dataset.importing.intervals import interval_columns
from plushsense.dataset.importing.path_parts import MOST_LABELS, PathParts, guess_paths
from plushsense.dataset.importing.pattern import (
    ENDINGS,
    INTERVAL,
    LABELS,
    ROLES,
    UNITS,
    ImportPattern,
    path_expression,
)
from plushsense.dataset.importing.sources import source_files, split_regular_files
from plushsense.dataset.importing.table_files import (
    is_between,
    is_text,
    json_cells,
    json_objects,
    number_blocks,
    one_recording_each,
    unit_of_time,
)
from plushsense.dataset.quality.measurements import rows_at_one_time

_FILES, _LINES, _FEW = 12, 2000, 5
_HEAD, _MOST_BYTES, _MOST_JSON = 16_384, 400_000, 64 << 20
_USUAL_HZ = 50.0
# The first with which the rows have the same number of cells; a comma may also be in decimals.
_SEPARATORS = ("\t", ";", "|", ",", " ")
_MOST_STEPS = 1e7
_IDLE_LABELS = frozenset(("0", "null", "null class", "none", "idle", "nothing", "background", "no gesture", "noise"))
_LABEL_NAMES = ("label", "gesture", "activity", *LABELS)
_PERSON_NAMES = ("subject", "participant", "person", "user", "child", "who")
# acc_x, x_acc, accX, aX, Accelerometer_x, and x, y, z alone; not accuracy.
_ACCELERATION = re.compile(r"(?<![a-z])(acc(?!u)|accel|a_?[xyz](?![a-z]))|acc(el)?_?[xyz]?$|^[xyz](_\d+)?$")
_AXES = ({"x", "y", "z"}, {"0", "1", "2"})
_NO_CHANNEL = re.compile(r"index|row|frame|sample|no|nr|id|count_?er|unnamed.*|#", re.IGNORECASE)
# The share of its rows that a recording of the GestureRecorder keeps when it is cut is above 1 / this.
_MOST_CUT = 20
_TAKE = re.compile(r"(^|_)(id|sample|take|trial|rep|repetition|recording|segment|window|block|session)", re.IGNORECASE)
# Files of micro:bit CreateAI name no rate; older ones write ID, newer ones id.
_MICROBIT_HZ = {"recordings.ID": 40.0, "recordings.id": 50.0}
# Objects around channels in JSON that say nothing about them.
_AROUND = re.compile(r"^((recordings|payload|data|sensors|values|samples)\.(?!\d+$))+")


@dataclass(frozen=True)
class GuessedPattern:
    """The TOML of a pattern, and sentences about what a person should check in it."""

    toml: str
    doubts: list[str]

    @property
    def pattern(self) -> ImportPattern:
        """The pattern itself, as `importers.preview_import` takes it."""
        return load_table(tomllib.loads(self.toml), ImportPattern, "guessed pattern", ConfigError)

    def write(self, path: str | Path) -> None:
        """Write the TOML file; raise ConfigError if the file exists."""
        if Path(path).exists():
            raise ConfigError("'{path}' exists already: give the name of a new file.", path=Path(path))
        write_file(Path(path), self.toml)


@dataclass
class _PatternDraft:
    """The keys, columns, channels and doubts of the pattern being guessed, filled in step by step."""

    keys: dict[str, Any] = field(default_factory=dict)
    taken: set[str] = field(default_factory=set)
    """Parts that have a column."""
    columns: dict[str, str] = field(default_factory=dict)
    channels: list[dict[str, Any]] = field(default_factory=list)
    vectors: list[list[str]] = field(default_factory=list)
    labels: Counter[str] = field(default_factory=Counter)
    rate_hz: float = 0.0
    times: list[Floats] = field(default_factory=list)
    """The time of each row of each file or recording; empty without a clock."""
    codes: dict[str, SampledColumn] = field(default_factory=dict)
    """Columns of whole numbers that change rarely."""
    is_json: bool = False
    width: int = 1
    separator: str = ""
    form: TableForm | None = None
    doubts: list[str] = field(default_factory=list)


def guess_pattern(source: str | Path) -> GuessedPattern:
    """Look at the files of a folder, or at one file, and return the pattern that they suggest.

    Raises:
        DatasetError: for a folder without text files.
    """
    source = Path(source)
    if not source.exists():
        raise DatasetError(f"There is no '{source}': a pattern is guessed from a folder, or from one file.")
    base, found = (source, source_files(source)) if source.is_dir() else (source.parent, [source])
    files = [f for f in split_regular_files(found)[0] if not f.name.startswith(".") and _is_text(f)]
    if not files:
        raise DatasetError(f"'{source}' holds no text file: a pattern is guessed from tables of text and JSON lines.")
    sizes: Counter[str] = Counter()
    for file in files:
        sizes[file.suffix.lower()] += file.stat().st_size
    ending = sizes.most_common(1)[0][0]
    of_ending = [f for f in files if f.suffix.lower() == ending]
    mine = [f for f in of_ending if _has_rows(f)]
    if not mine:
        raise DatasetError(f"'{source}' holds no table: its files that end in '{ending}' have no row with a number.")
    some = mine[:: max(1, len(mine) // _FILES)][:_FILES]
    if sum(_is_recorded(f) for f in some) > 0.8 * len(some):
        raise DatasetError(f"'{source}' holds recordings of the GestureRecorder: import it without a pattern.")
    guess = _PatternDraft()
    if others := len(files) - len(of_ending):
        guess.doubts.append(f"files that do not end in '{ending}' are left out: {others}")
    guess.is_json = ENDINGS.get(ending) == "json" or _text(some[0], None, _HEAD).lstrip()[:1] in ("{", "[")
    if guess.is_json:
        columns = _json_columns([_json_text(f, guess) for f in some], guess)
    else:
        columns = _text_columns([lines for f in some if (lines := _text(f, guess).splitlines()[:_LINES])], guess)
    if guess.is_json and ENDINGS.get(ending) != "json":
        guess.keys["format"] = "json"
    if not guess.is_json:
        mine = [f for f in mine if _fits(_text(f, None, _HEAD).splitlines(), guess)] or mine
    without = sorted(set(of_ending) - set(mine))
    _roles(columns, guess)
    if not guess.channels:
        listed = ", ".join(column.name.strip()[:30] for column in columns[:20]) or "no columns of one length"
        raise DatasetError(f"No column of numbers that could be a channel was found in '{source}'; it has {listed}.")
    parts = _paths(base, mine, without, ending, guess)
    guess.doubts += parts.doubts
    if parts.labels:
        guess.labels = parts.labels
    _codes(parts, guess)
    _idle(guess)
    _aliases(guess)
    # Names in the files may hold characters that no line of text can show.
    guess.doubts = ["".join(c if c.isprintable() else " " for c in doubt) for doubt in guess.doubts]
    return GuessedPattern(_toml(guess, source.resolve().stem), guess.doubts)


def _paths(base: Path, mine: list[Path], without: list[Path], ending: str, guess: _PatternDraft) -> PathParts:
    """Find the parts of the paths of the tables ``mine``, and files of intervals among those ``without`` such rows."""
    relative = [f.relative_to(base) for f in mine]
    of_labels = _interval_files(base, without, guess)
    taken = guess.taken | ({"label"} if of_labels else set())
    parts = guess_paths(relative, ending, taken, set(guess.labels), dotted=INTERVAL in guess.columns)
    if of_labels and _intervals(of_labels, relative, parts, guess):
        without = [file for file in without if file.relative_to(base) not in of_labels]
    elif of_labels:
        parts = guess_paths(relative, ending, guess.taken)
    guess.keys["paths"] = parts.patterns
    _exclude([f.relative_to(base) for f in without], relative, guess)
    return parts


def _is_text(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(4096)
    return bool(head.strip()) and b"\x00" not in head and path.suffix.lower() not in (".md", ".toml", ".py", ".pdf")


def _is_recorded(path: Path) -> bool:
    """Return whether the name of a file may have its number of rows at the end, as those of the GestureRecorder have.

    The authors' script has cut rows away; a date in place of the rows is a far larger number.
    """
    name = parse_name(path.name)
    if name is None:
        return False
    with path.open("rb") as file:
        rows = sum(1 for _ in file)
    return rows - 2 <= name.rows <= _MOST_CUT * rows


def _has_rows(path: Path) -> bool:
    """Return whether the first lines of a file hold a row with a number, or a JSON value."""
    with path.open("rb") as file:
        lines = file.read(4096).decode("utf-8-sig", "replace").splitlines()
    return any(line.lstrip()[:1] in ("{", "[") or any(map(is_number, re.split(r"[,;\t| ]", line))) for line in lines)


def _text(path: Path, guess: _PatternDraft | None = None, most: int = _MOST_BYTES) -> str:
    """Return the first bytes of a file as text, without the beginning of a line at the end.

    The encoding of a file that is used for ``guess`` is that of the pattern.
    """
    with path.open("rb") as file:
        raw = file.read(most)
    cut = len(raw) == most
    try:
        text = raw.decode("utf-8-sig", "ignore" if cut else "strict")
    except UnicodeDecodeError:
        if guess is not None:
            guess.keys["encoding"] = "latin-1"
        text = raw.decode("latin-1")
    return text[: text.rfind("\n") + 1] or text if cut else text


def _json_text(path: Path, guess: _PatternDraft) -> str:
    """Return some lines of JSON, or a whole document of several lines.

    Raises:
        DatasetError: for a document that is too long.
    """
    text = _text(path, guess)
    lines = text.splitlines()
    try:
        if isinstance(loads_json(lines[0]), dict):
            return "\n".join(lines[:_LINES])
    except (ValueError, RecursionError):
        pass
    if path.stat().st_size > _MOST_JSON:
        raise DatasetError(
            f"'{path}' is one JSON document of {path.stat().st_size >> 20} MB, too long to be guessed from: the most "
            f"is {_MOST_JSON >> 20} MB. Give a folder with a shorter file of the same form, or write the pattern."
        )
    return _text(path, guess, _MOST_JSON + 1)


def _same(names: Sequence[str], others: Sequence[str]) -> bool:
    return sorted(name.casefold() for name in names) == sorted(name.casefold() for name in others)


def _fits(lines: list[str], guess: _PatternDraft) -> bool:
    """Return whether a file begins with the columns that were found, and has a row of them."""
    rows = list(_cells(lines, guess.separator))
    form = find_form(rows, guess.width)
    return guess.form is not None and form.begin < len(rows) and _same(form.names, guess.form.names)


def _separator(samples: list[list[str]]) -> tuple[int, str]:
    """Return the number of cells of most rows, and the separator with which each file has rows of one width."""
    for separator in _SEPARATORS:
        fitting: Counter[int] = Counter()
        total = 0
        for lines in samples:
            body = [line for line in lines[5:] if line.strip()] or lines
            width, count = Counter(len(row) for row in _cells(body, separator)).most_common(1)[0]
            # A separator at the end of every line only ends it.
            ends_line = width == 2 and all(line.rstrip().endswith(separator) for line in body)
            total += len(body)
            if count >= 0.8 * len(body) and width > 1 and not ends_line:
                fitting[width] += len(body)
        if sum(fitting.values()) >= 0.8 * total:
            return fitting.most_common(1)[0][0], separator
    return 1, ""


def _text_columns(samples: list[list[str]], guess: _PatternDraft) -> list[SampledColumn]:
    """Find separator, lines before and after the names, and the columns of tables of text.

    Files with other columns than most rows have are not used: they may be lists of people or labels.
    """
    width, separator = _separator(samples)
    guess.width, guess.separator = width, separator
    tables = [list(_cells(lines, separator)) for lines in samples]
    forms = [find_form(rows, width) for rows in tables]
    data = [[row for row in rows[form.begin :] if len(row) == width] for rows, form in zip(tables, forms, strict=True)]
    most: Counter[tuple[str, ...]] = Counter()
    for form, rows in zip(forms, data, strict=True):
        most[tuple(sorted(name.casefold() for name in form.names))] += len(rows)
    usual_names = most.most_common(1)[0][0]
    like = [k for k, form in enumerate(forms) if _same(form.names, usual_names)]
    guess.form = form = forms[max(like, key=lambda k: len(data[k]))]
    # The columns of a file may stand in another order.
    data = [data[k] for k in like if forms[k].names == form.names]
    rows = tables[like[0]]
    if separator and separator != ",":
        guess.keys["separator"] = separator
    if separator == ";" and any(re.fullmatch(r"-?\d+,\d+", cell) for row in rows for cell in row):
        guess.keys["decimal"] = ","
    names = list(form.names)
    if form.head is not None:
        guess.keys |= {"skip_before": form.head, "skip_after": form.begin - form.head - 1}
    else:
        names = [f"c{k + 1}" for k in range(width)]
        guess.keys |= {"names": names, "skip_before": form.begin}
        guess.doubts.append("the files have no line of column names: give the columns their names in names")
    counts = Counter(name.casefold() for name in names)
    seen: Counter[str] = Counter()
    columns = []
    head = list(form.names) if form.head is not None else []
    data = [
        [row for row in rows if not is_between(row, head, ImportPattern()) and not _is_marker(row)] for rows in data
    ]
    _row_blocks([samples[k] for k in like], head, guess)
    for k, name in enumerate(names):
        seen[name.casefold()] += 1
        # Columns without a name are counted among all columns.
        key = f"{name}#{seen[name.casefold()]}" if name and counts[name.casefold()] > 1 else name or f"#{k + 1}"
        columns.append(
            SampledColumn(name, key, [[row[k] for row in rows] for rows in data], guess.keys.get("decimal", "."))
        )
    return columns


def _row_blocks(samples: list[list[str]], head: list[str], guess: _PatternDraft) -> None:
    """Add a doubt if empty lines, comments or lines of column names separate blocks of rows."""
    blocks, markers = 0, Counter[str]()
    for lines in samples:
        between, rows = dict[int, float](), 0
        for line in lines:
            row = next(iter(_cells([line], guess.separator)), [])
            if is_between(row, head, ImportPattern()):
                between[rows] = between.get(rows, 0) + (math.inf if row and row[0].strip() else 1)
            elif rows and _is_marker(row):
                markers[row[0].strip()] += 1
            else:
                rows += len(row) == guess.width and any(map(is_number, row))
        blocks = max(blocks, int(number_blocks(between, rows).max(initial=0)) + 1)
    if blocks > 1:
        guess.doubts.append(
            "empty lines, comments or repeated column names separate blocks of rows: each block is taken for a "
            f'recording (up to {blocks} in the first lines of a file); if they are no recordings, add  between = "none"'
        )
    if markers:
        line = markers.most_common(1)[0][0][:40]
        guess.doubts.append(
            f"lines of text stand between rows, such as '{line}': if they separate recordings, describe them with a "
            f"regular expression, such as  between = '{re.escape(line.split()[0])}.*'"
        )


def _is_marker(row: Sequence[str]) -> bool:
    """Return whether a line has text in its first cell only."""
    return bool(row) and bool(row[0].strip()) and is_text(row) and not any(cell.strip() for cell in row[1:])


def _cells(lines: Iterable[str], separator: str) -> Iterable[list[str]]:
    if separator != ";":
        lines = (line.rstrip("; ") for line in lines)
    if separator in (" ", ""):
        return (line.split() if separator else [line.strip()] for line in lines if line.strip())
    return csv.reader((line for line in lines if line.strip()), delimiter=separator)


def _json_columns(samples: list[str], guess: _PatternDraft) -> list[SampledColumn]:
    """Return the values of JSON objects as columns, by their path within an object."""
    cells: dict[str, list[list[str]]] = {}
    lists: set[str] = set()
    objects = recordings = 0
    for text in samples:
        whole = json_objects(text)
        each = one_recording_each(whole)
        objects, recordings = objects + len(whole), recordings + len(each)
        for key, (parts, in_list) in json_cells(each).items():
            cells.setdefault(key, []).extend(parts)
            lists |= {key} if in_list else set()
    if recordings > objects:
        guess.doubts.append(f"lists within objects are taken for recordings: {recordings} in {objects} objects")
    guess.rate_hz = next((rate for key, rate in _MICROBIT_HZ.items() if any(_ends(k, key) for k in cells)), 0.0)
    return [
        SampledColumn(key, key, parts, of_recording=bool(lists) and key not in lists) for key, parts in cells.items()
    ]


def _ends(key: str, end: str) -> bool:
    """Return whether the path of a value in JSON ends in ``end``."""
    return key == end or key.endswith(f".{end}")


def _roles(columns: list[SampledColumn], guess: _PatternDraft) -> None:
    """Decide which columns are time, person, label and channels."""
    left = list(columns)

    def take(role: str, column: SampledColumn | None) -> SampledColumn | None:
        if column is not None:
            left.remove(column)
            guess.taken.add(role)
            if column.name.casefold() not in ROLES[role] or column.key != column.name:
                guess.columns[role] = column.key
        return column

    dates = next((c for c in left if c.is_date and not c.of_recording), None)
    numeric = [c for c in left if c.is_numeric and not c.of_recording]
    time = (
        dates or named_column(numeric, (*ROLES["time"], "time", "stamp")) or next(filter(_may_be_clock, numeric), None)
    )
    time = _readable_clock(time, left, guess)
    interval = next((c for c in left if c.of_recording and c.is_numeric and _ends(c.key, INTERVAL)), None)
    if time is None and interval is not None and min(interval.values) > 0:
        take(INTERVAL, interval)
        guess.rate_hz = float(f"{1000.0 / float(np.median(interval.values)):.3g}")
    else:
        if time is None and not guess.rate_hz and (stated := stated_rate(columns)) is not None:
            guess.rate_hz = guess.keys["row_rate_hz"] = stated[1]
            guess.doubts.append(f"the files have no clock: the rate is that of '{stated[0]}', {stated[1]:g}")
        _clock(take("time", time), guess)
    guess.times = time.moments if time is not None else []
    texts = [c for c in left if not c.is_numeric and c.words and not c.is_date]
    take("subject", named_column([*texts, *left], (*ROLES["subject"], *_PERSON_NAMES)) if len(columns) > 1 else None)
    texts = [c for c in texts if c in left]
    for role in ("session", "recording"):
        take(role, next((c for c in left if c.name.casefold() in ROLES[role]), None))
    texts = [c for c in texts if c in left]
    take("label", _label(texts, left, guess))
    _unused(left, guess)
    missing: Counter[str] = Counter()
    for column in [c for c in left if c.is_numeric and not c.of_recording]:
        kind = no_reading(_with_times(column, guess.times))
        if _NO_CHANNEL.fullmatch(column.name.strip()):
            guess.doubts.append(f"the column '{column.key}' is taken for a number of the row, not for a channel")
        elif column.codes and (not kind or _TAKE.search(column.name)):
            guess.codes[column.key] = column
        elif kind or (column.rises and re.search("time|stamp", column.name.casefold())):
            guess.doubts.append(f"the column '{column.key}' is taken for {kind or CLOCK}, not for a channel")
        else:
            missing += column.words
            guess.channels.append(_measured(column, guess))
    if missing:
        guess.keys["missing"] = sorted(missing)
        guess.doubts.append(f"the words {', '.join(sorted(missing))} are taken for missing values")
    _vectors(guess)


def _unused(left: list[SampledColumn], guess: _PatternDraft) -> None:
    """Add a doubt about columns that hold texts in place of numbers: a sensor that was off, or a description."""
    texts = [c for c in left if not c.is_numeric and c.words and not c.of_recording]
    if texts:
        listed = ", ".join(f"'{c.key}' ('{next(iter(c.words))[:30]}')" for c in texts[:_FEW])
        more = ", …" if len(texts) > _FEW else ""
        guess.doubts.append(f"columns with texts are no channels: {listed}{more}")


def _readable_clock(
    time: SampledColumn | None, left: list[SampledColumn], guess: _PatternDraft
) -> SampledColumn | None:
    """Return the clock, or a column of few dates without one; None with a doubt if it stands still or is unreadable."""
    words = [c for c in left if not c.is_numeric and c.words and not c.of_recording]
    unread = named_column(words, (*ROLES["time"], "time", "stamp"))
    if time is None and unread is not None and unread.holds_dates:
        time = unread
    if time is not None and (still := rows_at_one_time(time.times)):
        left.remove(time)
        guess.doubts.append(
            f"the clock in '{time.key}' stands still ({still} rows in turn have the same time), as where a spreadsheet "
            "or float32 cut digits off: export its times again, or let row_rate_hz stand instead of it"
        )
        return None
    if time is None and unread is not None and re.search(r"\d", next(iter(unread.words))):
        left.remove(unread)
        guess.doubts.append(
            f"the times in '{unread.key}', such as '{next(iter(unread.words))[:30]}', cannot be read: write them as "
            "2026-03-01 12:01:02.5, as 12:01:02.5, or as numbers"
        )
    return time


def _with_times(column: SampledColumn, times: list[Floats]) -> list[tuple[Floats, Floats]]:
    """Return the numbers of a column in each file or recording, and their times, or the numbers of the rows."""
    fits = [len(a) for a in column.numbers] == [len(b) for b in times]
    return list(zip(column.numbers, times if fits else [np.arange(float(len(a))) for a in column.numbers], strict=True))


def _may_be_clock(column: SampledColumn) -> bool:
    """Return whether a column rises, and does not only count the rows."""
    return column.rises and no_reading(_with_times(column, [])) != COUNTER


def _label(texts: list[SampledColumn], left: list[SampledColumn], guess: _PatternDraft) -> SampledColumn | None:
    """Return the column of labels: by its name, or else the first one of few texts, a ``name`` before others."""
    label = named_column(texts, (*ROLES["label"], *_LABEL_NAMES))
    numbers = next((c for c in left if c.name.strip().casefold() in CODE_NAMES and c.codes), None)
    if label is None and numbers is not None:
        guess.labels = Counter(map(str, numbers.codes))
        guess.doubts.append(f"the labels in '{numbers.key}' are numbers: give them their names in [aliases]")
        return numbers
    if label is None:
        # A device describes itself in texts, and what differs in every file is an identifier.
        few = [
            c
            for c in texts
            if 1 < len(c.words) <= MOST_LABELS and INTERVAL not in guess.columns
            if len(c.words) < len(c.parts) or any(len(set(cells)) > 1 for cells in c.parts)
        ]
        mixed = [c for c in few if c.alternates]
        for column in mixed:
            listed = join_names(repr(word) for word in list(column.words)[:2])
            guess.doubts.append(
                f"the column '{column.key}' changes from row to row ({listed}), so that it is not taken for the label: "
                "if it names sensors, their rows are mixed; write a table with a column for each sensor"
            )
        few = [c for c in few if c not in mixed]
        label = next(iter([*(c for c in few if _ends(c.key.casefold(), "name")), *few]), None)
        if label is not None:
            listed = ", ".join(repr(word) for word in list(label.words)[:2])
            guess.doubts.append(f"the column '{label.key}' is taken for the label: {listed}")
    if label is not None:
        guess.labels = label.words
    return label


def _codes(parts: PathParts, guess: _PatternDraft) -> None:
    """Take whole numbers that change rarely for the label or the take, if there is no other; list the others."""
    labelled = bool(guess.labels) or "intervals" in guess.keys
    takes = [c for c in guess.codes.values() if c.counts and (labelled or _TAKE.search(c.name))]
    may_be = [c for c in guess.codes.values() if c not in takes and len(c.codes) <= MOST_CODES]
    for column in sorted(guess.codes.values(), key=lambda c: not named_column([c], CODE_NAMES)):
        values = ", ".join(map(str, column.codes[:6]))
        seen = f"the column '{column.key}' has whole numbers that change rarely ({values}), so that it is"
        if column in may_be and not labelled:
            labelled = True
            guess.columns["label"] = column.key
            guess.labels = Counter(map(str, column.codes))
            guess.doubts.append(f"{seen} taken for the label: give them names in [aliases]")
        elif column in takes and "recording" not in guess.taken | parts.found:
            guess.taken.add("recording")
            guess.columns["recording"] = column.key
            guess.doubts.append(f"{seen} taken for the take: a recording ends where it changes")
        else:
            guess.doubts.append(
                f"{seen} no channel: if it is a sensor, add it to channels, and if it is the label, to columns"
            )
    if not labelled:
        guess.doubts.append("the label of a recording was not found: put {label} into paths, or give its column")


def _interval_files(base: Path, without: list[Path], guess: _PatternDraft) -> dict[Path, dict[str, str]]:
    """Return the files of intervals among those with other columns, and the names of their columns."""
    found: dict[Path, dict[str, str]] = {}
    moments = []
    for file in without if "label" not in guess.taken else ():
        lines = [line for line in _text(file, None, _HEAD).splitlines() if line.strip()]
        separator = max(",;\t", key=lines[0].count) if lines else ","
        names = [name.strip() for name in next(csv.reader(lines, delimiter=separator), [])]
        if len(lines) > 1 and (at := interval_columns(names)):
            found[file.relative_to(base)] = {role: names[k] for role, k in at.items()}
        elif {name.casefold() for name in names} & {*_LABEL_NAMES} and any("time" in n.casefold() for n in names):
            moments.append(file.relative_to(base).as_posix())
    if moments and not found:
        guess.doubts.append(
            f"files such as {moments[0]} have labels of single moments, which cannot be used: give each a start and an "
            "end (columns start, end, label)"
        )
    return found


def _intervals(found: dict[Path, dict[str, str]], samples: list[Path], parts: PathParts, guess: _PatternDraft) -> bool:
    """Use files of intervals for the labels; return whether their paths fit those of the samples."""
    patterns = {_place_of(path, samples, parts.patterns) for path in found}
    path, columns = next(iter(found.items()))
    pattern = patterns.pop()
    if patterns or pattern is None:
        guess.doubts.append(
            f"files such as {path.as_posix()} have intervals, but do not fit the paths of the samples: name them in "
            "intervals"
        )
        return False
    guess.keys["intervals"] = pattern
    guess.columns |= columns
    guess.doubts.append(f"the labels are the intervals in files such as {path.as_posix()}: '{columns['label']}'")
    return True


def _place_of(path: Path, samples: list[Path], patterns: list[str]) -> str | None:
    """Return the pattern of the path of a file of intervals, by the parts of a sample with the same texts."""
    text = path.as_posix()
    best: list[str] = []
    for sample in [s for s in samples if s.parent == path.parent] or samples:
        match = next((m for p in patterns if (m := path_expression(p).fullmatch(sample.as_posix()))), None)
        parts = {part: value for part, value in (match.groupdict() if match else {}).items() if value}
        if all(re.search(rf"(?<![^\W_]){re.escape(value)}(?![^\W_])", text) for value in parts.values()):
            made = re.sub("[{}*?]", "?", text)
            for part, value in sorted(parts.items(), key=lambda item: -len(item[1])):
                made = re.sub(rf"(?<![^\W_]){re.escape(value)}(?![^\W_])", f"{{{part}}}", made)
            best.append(made)
    return max(best, key=lambda made: made.count("{"), default=None)


def _exclude(without: list[Path], samples: list[Path], guess: _PatternDraft) -> None:
    """Leave out files with other columns, by their name if no file of samples has it."""
    if len(without) > _FEW:
        fit = [path_expression(text) for text in guess.keys["paths"]]
        excluded = [path for path in without if any(e.fullmatch(path.as_posix()) for e in fit)]
    else:
        excluded = without
    if not without:
        return
    names = {path.name for path in samples}
    many = len(excluded) > _FEW
    texts = [f"**/{path.name}" if many and path.name not in names else path.as_posix() for path in excluded]
    guess.keys["exclude"] = [re.sub("[{}?]", "?", text) for text in dict.fromkeys(texts)]
    listed = ", ".join(path.as_posix() for path in without[:_FEW]) + (", …" if len(without) > _FEW else "")
    guess.doubts.append(f"files without such rows are left out: {listed}")


def _clock(time: SampledColumn | None, guess: _PatternDraft) -> None:
    """Find the unit of the times, and the rate."""
    if time is None and "row_rate_hz" in guess.keys:
        return
    if time is None:
        guess.doubts.append(
            f"the files have no clock; micro:bit CreateAI has {guess.rate_hz:g} rows a second with this key (40: ID, "
            "50: id): if recordings of 1.8 s have about 92 rows, correct row_rate_hz and rate_hz to 50"
            if guess.rate_hz
            else f"the files have no clock: give the true rate as row_rate_hz and rate_hz, now {_USUAL_HZ:g}"
        )
        guess.keys["row_rate_hz"] = guess.rate_hz = guess.rate_hz or _USUAL_HZ
        return
    numbers = time.times
    if time.words and time.holds_dates:
        guess.keys["time_unit"], factor = "iso", 1000.0
    else:
        unit, stated = unit_of_time(time.name, numbers, _USUAL_HZ)
        factor = UNITS[unit]
        if not stated:
            guess.keys["time_unit"] = unit
            guess.doubts.append(f"the times in '{time.key}' are taken for {unit}")
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    period = float(np.median(steps)) * factor if len(steps) else 1000.0 / _USUAL_HZ
    guess.rate_hz = float(f"{min(max(1000.0 / period, 1.0), 10_000.0):.3g}")


def _channel(name: str, kind: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "unit": "", "kind": kind, **more}


def _measured(column: SampledColumn, guess: _PatternDraft) -> dict[str, Any]:
    """Return the channel of a column of numbers: its kind, and a step that keeps its decimals."""
    key = _AROUND.sub("", column.key) if guess.is_json else column.key
    # A channel has no number for a name, since it would look like a reading at the head of a table.
    key = f"c{key.lstrip('#')}" if not column.name or column.name.isdecimal() else key
    name = re.sub(r"\W+", "_", key.casefold()).strip("_") or f"channel{len(guess.channels) + 1}"
    if name != column.name.casefold() or column.key != column.name:
        guess.columns[name] = column.key
    values = column.values
    texts = [cell.strip().replace(",", ".") for cell in column.cells]
    digits = min(6, max((len(t.partition(".")[2]) for t in texts if is_number(t) and "e" not in t.lower()), default=0))
    is_acceleration = _ACCELERATION.search(name) is not None
    if set(values.tolist()) <= {0.0, 1.0} and not digits and not is_acceleration:
        return _channel(name, "binary", valid_min=0, valid_max=1)
    # Whole numbers of steps have to fit 32 bits, and the square of a magnitude of three axes 64.
    while digits and np.abs(values).max() * 10**digits > _MOST_STEPS:
        digits -= 1
    more: dict[str, Any] = {"step": float(f"1e-{digits}")} if digits else {}
    if is_acceleration:
        # A magnitude needs a range; twice the largest value is a guess at that of the sensor.
        limit = float(2 ** int(np.ceil(np.log2(max(2 * np.abs(values).max(), 1.0)))))
        return _channel(name, "acceleration", **more, valid_min=-limit, valid_max=limit)
    return _channel(name, "sensor", **more)


def _vectors(guess: _PatternDraft) -> None:
    """Find triples of accelerations whose names differ only in x, y and z, or that are a list of three in JSON."""
    by_stem: dict[str, dict[str, str]] = {}
    for channel in guess.channels:
        text = channel["name"].replace("_", " ")
        axis = re.search(r"(?:(?<![a-z])a?|acc|accel)([xyz])(?![a-z])|([xyz])$", text)
        if channel["kind"] == "acceleration" and axis is not None and (at := axis.lastindex):
            stem = channel["name"][: axis.start(at)] + "?" + channel["name"][axis.end(at) :]
            by_stem.setdefault(stem, {})[axis[at]] = channel["name"]
        elif (
            channel["kind"] == "acceleration"
            and guess.is_json
            and (item := re.fullmatch(r"(.+_)(\d+)", channel["name"]))
        ):
            by_stem.setdefault(item[1], {})[item[2]] = channel["name"]
    guess.vectors = [[axes[a] for a in sorted(axes)] for axes in by_stem.values() if set(axes) in _AXES]
    _ranges(guess)


def _ranges(guess: _PatternDraft) -> None:
    """Give the axes of one vector the same range, the largest of theirs, and the same step."""
    accelerations = {c["name"]: c for c in guess.channels if c["kind"] == "acceleration"}
    alone = [[name] for name in accelerations if not any(name in vector for vector in guess.vectors)]
    for names in [*guess.vectors, *alone]:
        limit = max(accelerations[name]["valid_max"] for name in names)
        step = min(accelerations[name].get("step", 1.0) for name in names)
        for name in names:
            accelerations[name] |= {"step": step} if step < 1.0 else {}
            accelerations[name] |= {"valid_min": -limit, "valid_max": limit}
        listed = ", ".join(f"'{name}'" for name in names)
        guess.doubts.append(f"the range of {listed} is guessed (±{limit:g}): give that of the sensor")


def _idle(guess: _PatternDraft) -> None:
    """Add a doubt about labels that may stand for idle time."""
    found = [label for label in guess.labels if plain_label(label) in _IDLE_LABELS]
    if "label" in guess.taken and found:
        guess.doubts.append(
            f"rows with the label {', '.join(map(repr, found))} are taken for a gesture: if nothing happens in them, "
            f"add  idle = {json.dumps(found, ensure_ascii=False)}"
        )


def _aliases(guess: _PatternDraft) -> None:
    """Find spellings of one label that differ in more than case, spaces and underlines."""
    groups: dict[str, Counter[str]] = {}
    for label, count in guess.labels.items():
        groups.setdefault(re.sub(r"[\W_]+", "", label.casefold()), Counter())[label] = count
    aliases = {}
    for spellings in groups.values():
        if len({plain_label(s) for s in spellings}) > 1:
            # The spelling with separate words reads best.
            best = max(spellings, key=lambda s: (len(s), spellings[s]))
            aliases[best] = sorted(s for s in spellings if s != best)
            guess.doubts.append(f"{', '.join(repr(s) for s in sorted(spellings))} are taken for one label")
    if aliases:
        guess.keys["aliases"] = aliases


def _value(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _toml(guess: _PatternDraft, name: str) -> str:
    """Return the TOML of a guess, with what is uncertain as comments at its beginning."""
    lines = [
        f"# Guessed from the files in {json.dumps(name)}. Look at it, then see ten rows with",
        "#   plushsense import SRC --pattern THIS.toml --dry-run",
        *(["# To check:"] if guess.doubts else []),
        *(f"# - {doubt}" for doubt in guess.doubts),
        "",
    ]
    aliases = guess.keys.pop("aliases", {})
    order = ["paths", *sorted(set(guess.keys) - {"paths"})]
    lines += [f"{key} = {_value(guess.keys[key])}" for key in order if guess.keys[key] not in (0, "", [])]
    for table, values in (("columns", guess.columns), ("aliases", aliases)):
        if values:
            lines += ["", f"[{table}]", *(f"{_key(key)} = {_value(value)}" for key, value in values.items())]
    gap_ms = max(100, round(4000 / guess.rate_hz))
    lines += ["", "[layout]", f"name = {_value(re.sub(r'[^A-Za-z0-9-]+', '-', name).strip('-') or 'imported')}"]
    lines += [f"rate_hz = {_value(guess.rate_hz)}", *([f"gap_ms = {gap_ms}"] if gap_ms > 100 else [])]
    lines += ["channels = [", *(f"    {_value(channel)}," for channel in guess.channels), "]"]
    if guess.vectors:
        lines.append(f"vectors = {_value(guess.vectors)}")
    return "\n".join(lines) + "\n"
