"""Guess the pattern of an import from the files of a folder: separator, header, columns, clock, and parts of the paths.

A guess is a TOML file with comments for a person to look through, not a decision: what is uncertain is listed.
"""

from __future__ import annotations

import csv
import json
import math
import re
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
from plushsense.dataset.importing.pattern import ENDINGS, PARTS, ROLES, UNITS, ImportPattern
from plushsense.dataset.importing.sources import source_files, split_regular_files
from plushsense.dataset.importing.table_files import (
    date_ms,
    is_between,
    is_text,
    json_cells,
    number_blocks,
    unit_of_time,
)
from plushsense.dataset.quality.measurements import rows_at_one_time

_FILES, _LINES = 12, 400
_USUAL_HZ = 50.0
# The first with which the rows have the same number of cells; a comma may also be in decimals.
_SEPARATORS = ("\t", ";", "|", ",", " ")
_MOST_LABELS = 60
_MOST_STEPS = 1e7
_LEAST_ROWS, _COUNTED = 20, 200
_IDLE_LABELS = frozenset(("0", "null", "null class", "none", "idle", "nothing", "background", "no gesture", "noise"))
_PERSON = re.compile(r"(s|p|subj|subject|sub|participant|person|user|u|id|child|kid)[-_ ]?\d+", re.IGNORECASE)
_SESSION = re.compile(r"(session|ses|day|visit|run)[-_ ]?\d*", re.IGNORECASE)
# Words in paths that are no persons: devices, sensors, sides and parts of a data set.
_NO_PERSON = frozenset(
    ("phone", "watch", "accel", "acc", "gyro", "left", "right", "train", "test", "raw", "data", "csv", "wrist", "ankle")
)
_LABEL_NAMES = ("label", "gesture", "activity", "class", "event", "action", "touch", "kind", "movement")
_PERSON_NAMES = ("subject", "participant", "person", "user", "child", "who")
_NO_CHANNEL = re.compile(r"(index|row|frame|sample|no|nr|id|count_?er|unnamed.*|#)?", re.IGNORECASE)


@dataclass
class _Column:
    """A column of the samples: its ``key`` for the pattern and its cells."""

    name: str
    key: str
    cells: list[str]
    decimal: str = "."
    numbers: list[float] = field(default_factory=list)
    words: Counter[str] = field(default_factory=Counter)
    of_recording: bool = False
    """Whether there is one cell for each recording, beside columns with many."""

    def __post_init__(self) -> None:
        for cell in self.cells:
            text = cell.strip().replace(",", ".") if self.decimal == "," else cell.strip()
            if _is_number(text) and "," not in text:
                self.numbers.append(float(text))
            elif text:
                self.words[text] += 1

    @property
    def is_numeric(self) -> bool:
        words = sum(self.words.values())
        return len(self.numbers) > 0.6 * (len(self.numbers) + words) and len(self.words) <= 3

    @property
    def is_bits(self) -> bool:
        lengths = {len(cell.strip()) for cell in self.cells}
        digits = all(re.fullmatch("[01]+", cell.strip()) for cell in self.cells)
        return digits and len(lengths) == 1 and max(lengths) > 1 and any(c.strip()[:1] == "0" for c in self.cells)

    @property
    def is_date(self) -> bool:
        return len(self.words) > 3 and self.holds_dates

    @property
    def holds_dates(self) -> bool:
        return not any(map(math.isnan, map(date_ms, self.words)))

    @property
    def times(self) -> np.ndarray:
        """Times as numbers: dates in seconds."""
        if self.words and self.holds_dates:
            return np.array([date_ms(cell) / 1000.0 for cell in self.cells if cell.strip()])
        return np.array(self.numbers)

    @property
    def rises(self) -> bool:
        steps = np.diff(self.numbers)
        return len(steps) > 3 and float(np.mean(steps > 0)) > 0.8


@dataclass(frozen=True)
class GuessedPattern:
    """The TOML of a pattern, and sentences about what a person should check in it."""

    toml: str
    doubts: list[str]

    def write(self, path: str | Path) -> None:
        """Write the TOML file; raise ConfigError if the file exists."""
        if Path(path).exists():
            message = f"'{path}' exists already: give the name of a new file."
            raise ConfigError(message, reason="name_exists", name=Path(path).name)
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
    width: int = 1
    separator: str = ""
    in_blocks: bool = False
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
    if sum(parse_name(f.name) is not None for f in mine) > 0.8 * len(mine):
        raise DatasetError(f"'{source}' holds recordings of the GestureRecorder: import it without a pattern.")
    guess = _PatternDraft()
    if others := len(files) - len(of_ending):
        guess.doubts.append(f"files that do not end in '{ending}' are left out: {others}")
    samples = [text for f in mine[:: max(1, len(mine) // _FILES)][:_FILES] if (text := _lines(f, guess))]
    is_json = ENDINGS.get(ending) == "json" or samples[0][0].lstrip()[:1] in ("{", "[")
    columns = _json_columns(samples) if is_json else _text_columns(samples, guess)
    if is_json and ENDINGS.get(ending) != "json":
        guess.keys["format"] = "json"
    if not is_json:
        mine = [f for f in mine if _has_rows(f, guess.width, guess.separator)] or mine
    if without := sorted({f.relative_to(base).as_posix() for f in set(of_ending) - set(mine)}):
        guess.keys["exclude"] = without
        guess.doubts.append(f"files without such rows are left out: {', '.join(without[:5])}")
    _roles(columns, guess)
    if not guess.channels:
        listed = ", ".join(column.name.strip()[:30] for column in columns[:20])
        raise DatasetError(f"No column of numbers that could be a channel was found in '{source}'; it has {listed}.")
    _paths([f.relative_to(base) for f in mine], ending, guess)
    if "row_rate_hz" in guess.keys and "label" not in guess.taken and not is_json:
        _equal_recordings(mine, guess)
    _idle(guess)
    _aliases(guess)
    # Names in the files may hold characters that no line of text can show.
    guess.doubts = ["".join(c if c.isprintable() else " " for c in doubt) for doubt in guess.doubts]
    return GuessedPattern(_toml(guess, source.resolve().stem), guess.doubts)


def _is_text(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(4096)
    return bool(head.strip()) and b"\x00" not in head and path.suffix.lower() not in (".md", ".toml", ".py", ".pdf")


def _has_rows(path: Path, width: int = 1, separator: str = "") -> bool:
    """Return whether the first lines of a file hold a row of ``width`` cells with a number, or a JSON value."""
    with path.open("rb") as file:
        lines = file.read(4096).decode("utf-8-sig", "replace").splitlines()
    if width > 1:
        return any(len(row) == width and any(map(_is_number, row)) for row in _cells(lines, separator))
    return any(line.lstrip()[:1] in ("{", "[") or any(map(_is_number, re.split(r"[,;\t| ]", line))) for line in lines)


def _lines(path: Path, guess: _PatternDraft) -> list[str]:
    with path.open("rb") as file:
        raw = file.read(400_000)
    try:
        text = raw.decode("utf-8-sig", "strict" if len(raw) < 400_000 else "ignore")
    except UnicodeDecodeError:
        guess.keys["encoding"] = "latin-1"
        text = raw.decode("latin-1")
    return text.splitlines()[:_LINES]


def _is_number(text: str) -> bool:
    return bool(re.fullmatch(r"\s*[-+]?(\d{1,30}([.,]\d*)?|[.,]\d+)([eE][-+]?\d{1,2})?\s*", text))


def _text_columns(samples: list[list[str]], guess: _PatternDraft) -> list[_Column]:
    """Find separator, lines before and after the names, and the columns of tables of text."""
    body = [line for lines in samples for line in lines[5:] if line.strip()] or samples[0]
    width, separator = 1, ""
    for candidate in _SEPARATORS:
        widths = Counter(len(row) for row in _cells(body, candidate))
        usual, count = widths.most_common(1)[0]
        # A separator at the end of every line only ends it.
        ends_line = usual == 2 and all(line.rstrip().endswith(candidate) for line in body)
        if count >= 0.8 * len(body) and usual > 1 and not ends_line:
            width, separator = usual, candidate
            break
    guess.width, guess.separator = width, separator
    # The header is that of the file with the most such rows; others may be lists of people and the like.
    samples = sorted(samples, key=lambda lines: -sum(len(row) == width for row in _cells(lines, separator)))
    rows = list(_cells(samples[0], separator))
    if separator and separator != ",":
        guess.keys["separator"] = separator
    if separator == ";" and any(re.fullmatch(r"-?\d+,\d+", cell) for row in rows for cell in row):
        guess.keys["decimal"] = ","
    begin = next((k for k, row in enumerate(rows) if len(row) == width and any(map(_is_number, row))), 0)
    heads = [k for k in range(begin) if len(rows[k]) == width and any(cell.strip() for cell in rows[k])]
    if heads:
        names = [cell.strip() for cell in rows[heads[0]]]
        guess.keys |= {"skip_before": heads[0], "skip_after": begin - heads[0] - 1}
    else:
        names = [f"c{k + 1}" for k in range(width)]
        guess.keys |= {"names": names, "skip_before": begin}
        guess.doubts.append("the files have no line of column names: give the columns their names in names")
    counts = Counter(name.casefold() for name in names)
    seen: Counter[str] = Counter()
    columns = []
    head = rows[heads[0]] if heads else []
    data = [row for lines in samples for row in list(_cells(lines, separator))[begin:] if len(row) == width]
    data = [row for row in data if not is_between(row, head, ImportPattern()) and not _is_marker(row)]
    _row_blocks(samples, head, guess)
    for k, name in enumerate(names):
        seen[name.casefold()] += 1
        key = f"{name}#{seen[name.casefold()]}" if counts[name.casefold()] > 1 else name or f"#{k + 1}"
        columns.append(_Column(name, key, [row[k] for row in data], guess.keys.get("decimal", ".")))
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
                rows += len(row) == guess.width and any(map(_is_number, row))
        blocks = max(blocks, int(number_blocks(between, rows).max(initial=0)) + 1)
    if blocks > 1:
        guess.doubts.append(
            "empty lines, comments or repeated column names separate blocks of rows: each block is taken for a "
            f'recording (up to {blocks} in the first lines of a file); if they are no recordings, add  between = "none"'
        )
        guess.in_blocks = True
    if markers:
        line = markers.most_common(1)[0][0][:40]
        guess.doubts.append(
            f"lines of text stand between rows, such as '{line}': if they separate recordings, describe them with a "
            f"regular expression, such as  between = '{re.escape(line.split()[0])}.*'"
        )


def _is_marker(row: Sequence[str]) -> bool:
    """Return whether a line has text in its first cell only."""
    return bool(row) and bool(row[0].strip()) and is_text(row) and not any(cell.strip() for cell in row[1:])


def _equal_recordings(files: Sequence[Path], guess: _PatternDraft) -> None:
    """Add a doubt if the numbers of rows of the files suggest recordings of equal length, one after the other."""
    if guess.in_blocks:
        return
    counts, separator = set[int](), guess.separator.strip().encode() or None
    for file in files[:_COUNTED]:
        with file.open("rb") as opened:
            cells = (line.split(separator, 1)[0].decode("latin-1") for line in opened if line.strip())
            counts.add(sum(map(_is_number, cells)))
    common = math.gcd(*counts)
    if common >= _LEAST_ROWS and len(counts) > 1:
        listed = ", ".join(str(n) for n in sorted(counts)[:4]) + (", …" if len(counts) > 4 else "")
        guess.doubts.append(
            f"the files have {listed} rows, all of them multiples of {common}: if recordings of a fixed number of rows "
            "follow one another, give it as recording_rows"
        )


def _cells(lines: Iterable[str], separator: str) -> Iterable[list[str]]:
    if separator != ";":
        lines = (line.rstrip("; ") for line in lines)
    if separator in (" ", ""):
        return (line.split() if separator else [line.strip()] for line in lines if line.strip())
    return csv.reader((line for line in lines if line.strip()), delimiter=separator)


def _json_columns(samples: list[list[str]]) -> list[_Column]:
    """Return the values of JSON objects as columns, by their path within an object."""
    cells: dict[str, list[str]] = {}
    lists: set[str] = set()
    for lines in samples:
        for key, (found, in_list) in json_cells("\n".join(lines)).items():
            cells.setdefault(key, []).extend(found)
            lists |= {key} if in_list else set()
    return [_Column(key, key, found, of_recording=bool(lists) and key not in lists) for key, found in cells.items()]


def _named(columns: Sequence[_Column], names: Iterable[str]) -> _Column | None:
    """Return the first column whose name is, or else contains, one of ``names``."""
    known = tuple(names)
    plain = [(c, c.name.strip().casefold()) for c in columns]
    exact = next((c for c, name in plain if {name, *name.split(".")} & set(known)), None)
    return exact or next((c for c, name in plain if any(k in name for k in known if len(k) > 3)), None)


def _roles(columns: list[_Column], guess: _PatternDraft) -> None:
    """Decide which columns are time, person, label and channels."""
    left = list(columns)

    def take(role: str, column: _Column | None) -> _Column | None:
        if column is not None:
            left.remove(column)
            guess.taken.add(role)
            if column.name.casefold() not in ROLES[role] or column.key != column.name:
                guess.columns[role] = column.key
        return column

    if bits := [c for c in columns if c.is_bits]:
        guess.keys["bits"] = [c.key for c in bits]
        left = [c for c in left if c not in bits]
        n = sum(len(c.cells[0].strip()) for c in bits)
        guess.channels += [_channel(f"cell{k + 1}", "binary", valid_min=0, valid_max=1) for k in range(n)]
        guess.doubts.append(f"{n} binary channels are named cell1 to cell{n}: give them the names of the cells")
    dates = next((c for c in left if c.is_date), None)
    numeric = [c for c in left if c.is_numeric]
    time = dates or _named(numeric, (*ROLES["time"], "time", "stamp")) or next((c for c in numeric if c.rises), None)
    unread = _named([c for c in left if not c.is_numeric and c.words], (*ROLES["time"], "time", "stamp"))
    if time is None and unread is not None and unread.holds_dates:
        time = unread
    if time is not None and (still := rows_at_one_time(time.times)):
        left.remove(time)
        guess.doubts.append(
            f"the clock in '{time.key}' stands still ({still} rows in turn have the same time), as where a spreadsheet "
            "or float32 cut digits off: export its times again, or let row_rate_hz stand instead of it"
        )
        time = None
    elif time is None and unread is not None and re.search(r"\d", next(iter(unread.words))):
        left.remove(unread)
        guess.doubts.append(
            f"the times in '{unread.key}', such as '{next(iter(unread.words))[:30]}', cannot be read: write them as "
            "2026-03-01 12:01:02.5, as 12:01:02.5, or as numbers"
        )
    _clock(take("time", time), guess)
    texts = [c for c in left if not c.is_numeric and c.words]
    take("subject", _named([*texts, *left], (*ROLES["subject"], *_PERSON_NAMES)) if len(columns) > 1 else None)
    texts = [c for c in texts if c in left]
    few = [c for c in texts if 1 < len(c.words) <= _MOST_LABELS]
    label = take("label", _named(texts, (*ROLES["label"], *_LABEL_NAMES)) or next(iter(few), None))
    if label is not None:
        guess.labels = label.words
    for role in ("session", "recording"):
        take(role, next((c for c in left if c.name.casefold() in ROLES[role]), None))
    missing: Counter[str] = Counter()
    for column in [c for c in left if c.is_numeric and not c.of_recording]:
        if _NO_CHANNEL.fullmatch(column.name.strip()):
            guess.doubts.append(f"the column '{column.key}' is taken for a number of the row, not for a channel")
            continue
        if column.rises and re.search("time|stamp", column.name.casefold()):
            guess.doubts.append(f"the column '{column.key}' is taken for a second clock, not for a channel")
            continue
        missing += column.words
        guess.channels.append(_measured(column, guess))
    if missing:
        guess.keys["missing"] = sorted(missing)
        guess.doubts.append(f"the words {', '.join(sorted(missing))} are taken for missing values")
    _vectors(guess)


def _clock(time: _Column | None, guess: _PatternDraft) -> None:
    """Find the unit of the times, and the rate."""
    if time is None:
        guess.keys["row_rate_hz"] = guess.rate_hz = _USUAL_HZ
        guess.doubts.append(
            f"the files have no clock: give the true rate as row_rate_hz and rate_hz, now {_USUAL_HZ:g}"
        )
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


def _measured(column: _Column, guess: _PatternDraft) -> dict[str, Any]:
    """Return the channel of a column of numbers: its kind, and a step that keeps its decimals."""
    name = re.sub(r"\W+", "_", column.key.casefold()).strip("_") or f"channel{len(guess.channels) + 1}"
    if name != column.name.casefold() or column.key != column.name:
        guess.columns[name] = column.key
    values = np.array(column.numbers)
    texts = [cell.strip().replace(",", ".") for cell in column.cells]
    digits = min(6, max((len(t.partition(".")[2]) for t in texts if _is_number(t) and "e" not in t.lower()), default=0))
    if set(values.tolist()) <= {0.0, 1.0}:
        return _channel(name, "binary", valid_min=0, valid_max=1)
    # Whole numbers of steps have to fit 32 bits, and the square of a magnitude of three axes 64.
    while digits and np.abs(values).max() * 10**digits > _MOST_STEPS:
        digits -= 1
    more: dict[str, Any] = {"step": float(f"1e-{digits}")} if digits else {}
    if "acc" in name or re.fullmatch(r"[xyz](_\d+)?", name):
        # A magnitude needs a range; twice the largest value is a guess at that of the sensor.
        limit = float(2 ** int(np.ceil(np.log2(max(2 * np.abs(values).max(), 1.0)))))
        guess.doubts.append(f"the range of '{name}' is guessed (±{limit:g}): give that of the sensor")
        return _channel(name, "acceleration", **more, valid_min=-limit, valid_max=limit)
    return _channel(name, "sensor", **more)


def _vectors(guess: _PatternDraft) -> None:
    """Find triples of accelerations whose names differ only in x, y and z."""
    by_stem: dict[str, dict[str, str]] = {}
    for channel in guess.channels:
        axis = re.search(r"(?<![a-z])[xyz](?![a-z])|[xyz]$", channel["name"].replace("_", " "))
        if channel["kind"] == "acceleration" and axis is not None:
            stem = channel["name"][: axis.start()] + "?" + channel["name"][axis.end() :]
            by_stem.setdefault(stem, {})[axis[0]] = channel["name"]
    guess.vectors = [[axes[a] for a in "xyz"] for axes in by_stem.values() if len(axes) == 3]


def _paths(files: list[Path], ending: str, guess: _PatternDraft) -> None:
    """Find out which parts of the paths are person, session, label and take."""
    depth = _usual_least([len(f.parts) for f in files])
    before = "**/" if any(len(f.parts) > depth for f in files) else ""
    split = [[*f.parts[-depth:-1], f.name[: len(f.name) - len(ending)]] for f in files if len(f.parts) >= depth]
    named = [(parts, re.split(r"([_\-. ]+)", parts[-1])) for parts in split]
    least = _usual_least([len(name) for _, name in named])
    if others := len(files) - sum(len(name) >= least for _, name in named):
        guess.doubts.append(f"files whose paths are not like the others do not fit paths: {others}")
    # Extra separators belong to the first piece, since labels may hold them.
    pieces = [
        [*parts[:-1], "".join(n[: len(n) - least + 1]), *n[len(n) - least + 1 :]]
        for parts, n in named
        if len(n) >= least
    ]
    taken = guess.taken
    roles: list[str] = []
    for k in range(len(pieces[0])):
        texts = [row[k] for row in pieces]
        roles.append(_role(texts, len(pieces) > 1, taken | set(roles), k))
    if "recording" in roles and "label" not in roles:
        # The files hold several recordings each, so that their number is rather that of a session.
        roles[roles.index("recording")] = "session" if "session" not in roles else "*"
    if "subject" not in taken | set(roles):
        values = {k: {row[k] for row in pieces} for k, role in enumerate(roles) if role in ("*", "session")}
        several = {k: texts for k, texts in values.items() if len(texts) > 1 and not texts & _NO_PERSON}
        if several:
            k = max(several, key=lambda k: (len(several[k]), pieces[0][k][0].isalpha()))
            roles[k] = "subject"
            guess.doubts.append(f"'{pieces[0][k]}' in the path is taken for a person")
        else:
            guess.doubts.append("the person of a recording was not found: put {subject} into paths, or give its column")
    for k, role in enumerate(roles[: depth - 1]):
        if role == "*":
            listed = ", ".join(sorted({row[k] for row in pieces})[:5])
            guess.doubts.append(
                f"all of the folders {listed} are imported: if they hold other sensors, name one in paths"
            )
    if "label" in roles:
        at = roles.index("label")
        guess.labels = Counter(row[at] for row in pieces)
    elif not guess.labels:
        guess.doubts.append("the label of a recording was not found: put {label} into paths, or give its column")
    # What is the same in all paths stands there as it is, but for the characters of patterns; a name of all files tells
    # nothing apart, and the next recording may have another.
    texts = [
        f"{{{role}}}" if role in PARTS else role or re.sub("[{}*?]", "?", pieces[0][k]) for k, role in enumerate(roles)
    ]
    folders = "".join(f"{text}/" for text in texts[: depth - 1])
    name = "*" if len({parts[-1] for parts in split}) == 1 else "".join(texts[depth - 1 :])
    guess.keys["paths"] = [(before + folders + name if len(pieces) > 1 else "*") + ending]


def _usual_least(numbers: Sequence[int]) -> int:
    """Return the largest number that nine of ten ``numbers`` reach."""
    return sorted(numbers)[len(numbers) // 10]


def _role(texts: list[str], several: bool, taken: set[str], at: int) -> str:
    """Return the part that a piece of all paths is; "" for text that is the same everywhere, * for anything else."""
    distinct = set(texts)
    if not any(c.isalnum() for c in texts[0]):
        return "" if len(distinct) == 1 else "*"
    if len(distinct) == 1:
        return "" if several else "*"
    if all(_PERSON.fullmatch(t) for t in texts) and "subject" not in taken:
        return "subject"
    if all(_SESSION.fullmatch(t) for t in texts) and "session" not in taken:
        return "session"
    if all(t.isdecimal() for t in texts):
        return "recording" if "recording" not in taken and at else "*"
    if "label" not in taken and 1 < len(distinct) <= min(_MOST_LABELS, max(2, len(texts) // 2)):
        return "label"
    return "*"


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
