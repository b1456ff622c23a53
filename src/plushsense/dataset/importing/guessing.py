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
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError
from plushsense.core.files import temporary_folder, write_file
from plushsense.core.recorder_csv import parse_name
from plushsense.core.sentences import Message
from plushsense.core.toml import load_table, loads_json
from plushsense.dataset.importing.archives import UnpackLimits, unpack
from plushsense.dataset.importing.column_parts import (
    LABEL_NAMES,
    GuessSpec,
    PatternDraft,
    doubt_idle,
    ends_in,
    guess_aliases,
    guess_codes,
    guess_columns,
)
from plushsense.dataset.importing.columns import (
    SampledColumn,
    find_form,
    is_number,
)
from plushsense.dataset.importing.intervals import interval_columns
from plushsense.dataset.importing.path_parts import COLUMN, Candidate, PathParts, guess_paths
from plushsense.dataset.importing.pattern import (
    ENDINGS,
    INTERVAL,
    MARKERS_ROLE,
    STREAM_ROLE,
    ImportPattern,
    path_expression,
)
from plushsense.dataset.importing.sources import folder_name, source_files, split_regular_files
from plushsense.dataset.importing.table_files import (
    is_between,
    is_parquet,
    is_text,
    json_cells,
    json_objects,
    number_blocks,
    one_recording_each,
    parquet_columns,
    parquet_objects,
)
from plushsense.dataset.importing.xdf import XdfSample, is_xdf, sample_xdf, xdf_stem

_FILES, _LINES, _FEW = 12, 2000, 5
_HEAD, _MOST_BYTES, _MOST_JSON = 16_384, 400_000, 64 << 20
# The first with which the rows have the same number of cells; a comma may also be in decimals.
_SEPARATORS = ("\t", ";", "|", ",", " ")
# The share of its rows that a recording of the GestureRecorder keeps when it is cut is above 1 / this.
_MOST_CUT = 20
# Files of micro:bit CreateAI name no rate; older ones write ID, newer ones id.
_MICROBIT_HZ = {"recordings.ID": 40.0, "recordings.id": 50.0}


@dataclass(frozen=True)
class GuessedPattern:
    """The TOML of a pattern, and sentences about what a person should check in it.

    Attributes:
        doubts: the value ``about`` of each is what it is about: a part, ``time``, ``channels``, ``rows`` or ``files``.
        candidates: the pieces of the paths and the columns, with what they are taken for.
        labels: some of the labels.
        time_unit: unit of the times, "" without a clock.
        rate_hz: rate of the layout.
    """

    toml: str
    doubts: list[Message]
    candidates: tuple[Candidate, ...] = ()
    labels: tuple[str, ...] = ()
    time_unit: str = ""
    rate_hz: float = 0.0

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON; the doubts stay messages."""
        return vars(self) | {"candidates": [asdict(candidate) for candidate in self.candidates]}

    @property
    def pattern(self) -> ImportPattern:
        """The pattern itself, as `importers.preview_import` takes it."""
        return load_table(tomllib.loads(self.toml), ImportPattern, "guessed pattern", ConfigError)

    def write(self, path: str | Path) -> None:
        """Write the TOML file; raise ConfigError if the file exists."""
        if Path(path).exists():
            raise ConfigError("'{path}' exists already: give the name of a new file.", path=Path(path))
        write_file(Path(path), self.toml)


def guess_pattern(
    source: str | Path, given: GuessSpec | None = None, limits: UnpackLimits | None = None
) -> GuessedPattern:
    """Look at the files of a folder or zip, or at one file, and return the pattern that they suggest.

    Args:
        given: what is known already.
        limits: limits of unpacking a zip.

    Raises:
        DatasetError: for a folder without tables.
    """
    source, given = Path(source), given or GuessSpec()
    if not source.exists():
        raise DatasetError(f"There is no '{source}': a pattern is guessed from a folder, or from one file.")
    with ExitStack() as stack:
        base, found = source.parent, [source]
        if source.suffix.lower() == ".zip":
            # As `scanning.scan_zip` does.
            base = stack.enter_context(temporary_folder()) / folder_name(source.stem)
            base.mkdir()
            unpack(source, base, limits)
        elif source.is_dir():
            base = source
        if base != source.parent or source.is_dir():
            found = source_files(base)
        return _guess(source, base, found, given, limits or UnpackLimits())


def _tables(source: Path, found: Iterable[Path], given: GuessSpec) -> tuple[list[Path], list[Path], int, str]:
    """Return the tables with the ending of most bytes, all files with it, the number of others, and the ending."""
    files = [f for f in split_regular_files(found)[0] if not f.name.startswith(".") and _is_table(f)]
    if not files:
        raise DatasetError(
            "'{source}' holds no table: a pattern is guessed from text, JSON, Parquet and XDF.", source=source
        )
    sizes: Counter[str] = Counter()
    for file in files:
        sizes[_ending(file)] += file.stat().st_size
    ending = sizes.most_common(1)[0][0]
    of_ending = [f for f in files if _ending(f) == ending]
    mine = [f for f in of_ending if _has_rows(f)]
    if not mine:
        raise DatasetError(
            "'{source}' holds no table: its files that end in '{ending}' have no row with a number.",
            source=source,
            ending=ending,
        )
    some = _sample(mine)
    if not given.recorded and sum(_is_recorded(f) for f in some) > 0.8 * len(some):
        raise DatasetError(
            "'{source}' holds recordings of the GestureRecorder: import it without a pattern.", source=source
        )
    return mine, of_ending, len(files) - len(of_ending), ending


def _ending(path: Path) -> str:
    """Return the ending of a file's name, ``.xdf`` for all of XDF, compressed or not."""
    return ".xdf" if is_xdf(path) else path.suffix.lower()


def _sample(files: list[Path]) -> list[Path]:
    """Return files in equal steps through all of them, at most `_FILES`."""
    return files[:: max(1, len(files) // _FILES)][:_FILES]


def _columns(
    files: list[Path], ending: str, guess: PatternDraft, limits: UnpackLimits
) -> tuple[list[SampledColumn], list[Path]]:
    """Return the columns of most of the tables ``files``, and the files that have them."""
    some = _sample(files)
    form = _format(some[0], ending)
    guess.is_json = form in ("json", "parquet")
    if guess.is_json and ENDINGS.get(ending) != form:
        guess.keys["format"] = form
    if form == "xdf":
        return _xdf_columns(some, guess, limits), files
    if form == "json":
        return _json_columns([json_objects(_json_text(f, guess)) for f in some], guess), files
    if form == "parquet":
        there = {file: parquet_columns(file) for file in files}
        usual = Counter(filter(None, there.values())).most_common(1)
        files = [file for file in files if usual and there[file] == usual[0][0]] or files
        objects = [parquet_objects(f, _LINES) for f in _sample(files)]
        kept = {name for rows in objects for _, row in rows[:1] for name in row}
        if kept and (nested := [name for name in there[files[0]] if name not in kept]):
            guess.doubt(
                "the cells of {listed} are neither values nor lists of values: they are left out",
                "channels",
                listed=", ".join(nested[:_FEW]),
            )
        return _json_columns(objects, guess), files
    columns = _text_columns([lines for f in some if (lines := _text(f, guess).splitlines()[:_LINES])], guess)
    return columns, [f for f in files if _fits(_text(f, None, _HEAD).splitlines(), guess)] or files


def _guess(source: Path, base: Path, found: list[Path], given: GuessSpec, limits: UnpackLimits) -> GuessedPattern:
    """Guess the pattern of the files ``found`` below ``base``."""
    mine, of_ending, others, ending = _tables(source, found, given)
    guess = PatternDraft(given=given)
    if others:
        guess.doubt("files that do not end in '{ending}' are left out: {n}", "files", ending=ending, n=others)
    columns, mine = _columns(mine, ending, guess, limits)
    without = sorted(set(of_ending) - set(mine))
    guess_columns(columns, guess)
    if not guess.channels:
        listed = ", ".join(column.name.strip()[:30] for column in columns[:20]) or "no columns of one length"
        raise DatasetError(
            "No column of numbers that could be a channel was found in '{source}'; it has {listed}.",
            source=source,
            listed=listed,
        )
    parts = _paths(base, mine, without, ending, guess)
    guess.doubts += parts.doubts
    if parts.labels:
        guess.labels = parts.labels
    guess_codes(parts, guess)
    doubt_idle(guess)
    guess_aliases(guess)
    if given.idle:
        guess.keys["idle"] = list(given.idle)
    # Names in the files may hold characters that no line of text can show.
    doubts = [Message(d.template, **{k: _printable(v) for k, v in d.values.items()}) for d in guess.doubts]
    guess.doubts = doubts
    of_columns = [
        Candidate.of(
            f"{COLUMN}:{c.key}",
            guess.roles.get(c.key, ""),
            (cell.strip() for cell in c.cells if cell.strip()),
            numeric=c.is_numeric and not c.of_recording,
        )
        for c in columns
    ]
    return GuessedPattern(
        _toml(guess, given.name or source.resolve().stem),
        doubts,
        (*parts.candidates, *of_columns),
        tuple(sorted(guess.labels)),
        guess.time_unit,
        guess.rate_hz,
    )


def _printable(value: Any) -> Any:
    """Return a value without the characters that no line of text can show."""
    return "".join(c if c.isprintable() else " " for c in value) if isinstance(value, str) else value


def _paths(base: Path, mine: list[Path], without: list[Path], ending: str, guess: PatternDraft) -> PathParts:
    """Find the parts of the paths of the tables ``mine``, and files of intervals among those ``without`` such rows."""
    relative = [f.relative_to(base) for f in mine]
    of_labels = _interval_files(base, without, guess)
    taken = guess.taken | ({"label"} if of_labels else set())
    stated = guess.given.parts
    named, endings = relative, [ending]
    if is_xdf(mine[0]):
        named = [path.with_name(xdf_stem(path) + ending) for path in relative]
        endings = sorted({path.name[len(xdf_stem(path)) :].lower() for path in relative})
    parts = guess_paths(named, ending, taken, set(guess.labels), dotted=INTERVAL in guess.columns, stated=stated)
    if of_labels and _intervals(of_labels, relative, parts, guess):
        without = [file for file in without if file.relative_to(base) not in of_labels]
    elif of_labels:
        parts = guess_paths(named, ending, guess.taken, stated=stated)
    guess.keys["paths"] = [text.removesuffix(ending) + each for text in parts.patterns for each in endings]
    _exclude([f.relative_to(base) for f in without], relative, guess)
    return parts


def _is_table(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(4096)
    is_text = b"\x00" not in head and path.suffix.lower() not in (".md", ".toml", ".py", ".pdf")
    return bool(head.strip()) and (is_text or is_parquet(path) or is_xdf(path))


def _format(path: Path, ending: str) -> str:
    """Return the format of a table: csv, json, parquet or xdf."""
    if is_parquet(path) or is_xdf(path):
        return "parquet" if is_parquet(path) else "xdf"
    return "json" if ENDINGS.get(ending) == "json" or _text(path, None, _HEAD).lstrip()[:1] in ("{", "[") else "csv"


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
    """Return whether a file is Parquet or XDF, or its first lines hold a row with a number, or a JSON value."""
    if is_parquet(path) or is_xdf(path):
        return True
    with path.open("rb") as file:
        lines = file.read(4096).decode("utf-8-sig", "replace").splitlines()
    return any(line.lstrip()[:1] in ("{", "[") or any(map(is_number, re.split(r"[,;\t| ]", line))) for line in lines)


def _text(path: Path, guess: PatternDraft | None = None, most: int = _MOST_BYTES) -> str:
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


def _json_text(path: Path, guess: PatternDraft) -> str:
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


def _fits(lines: list[str], guess: PatternDraft) -> bool:
    """Return whether a file begins with the columns that were found, and has a row of them."""
    rows = list(_cells(lines, guess.separator))
    form = find_form(rows, guess.width)
    return guess.form is not None and form.begin < len(rows) and _same(form.names, guess.form.names)


def _separator(samples: list[list[str]], given: str) -> tuple[int, str]:
    """Return the number of cells of most rows, and the separator with which each file has rows of one width."""
    for separator in given or _SEPARATORS:
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


def _text_columns(samples: list[list[str]], guess: PatternDraft) -> list[SampledColumn]:
    """Find separator, lines before and after the names, and the columns of tables of text.

    Files with other columns than most rows have are not used: they may be lists of people or labels.
    """
    width, separator = _separator(samples, guess.given.separator)
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
    comma = separator in (";", "\t") and any(re.fullmatch(r"-?\d+,\d+", cell) for row in rows for cell in row)
    if (guess.given.decimal or "," * comma) == "," != separator:
        guess.keys["decimal"] = ","
    names = list(form.names)
    if form.head is not None:
        guess.keys |= {"skip_before": form.head, "skip_after": form.begin - form.head - 1}
    else:
        names = [f"c{k + 1}" for k in range(width)]
        guess.keys |= {"names": names, "skip_before": form.begin}
        guess.doubt("the files have no line of column names: give the columns their names in names", "channels")
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


def _row_blocks(samples: list[list[str]], head: list[str], guess: PatternDraft) -> None:
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
        guess.doubt(
            "empty lines, comments or repeated column names separate blocks of rows: each block is taken for a "
            'recording (up to {n} in the first lines of a file); if they are no recordings, add  between = "none"',
            "recording",
            n=blocks,
        )
    if markers:
        line = markers.most_common(1)[0][0][:40]
        guess.doubt(
            "lines of text stand between rows, such as '{line}': if they separate recordings, describe them with a "
            "regular expression, such as  between = '{expression}.*'",
            "recording",
            line=line,
            expression=re.escape(line.split()[0]),
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


def _json_columns(samples: list[list[tuple[int, Any]]], guess: PatternDraft) -> list[SampledColumn]:
    """Return the values of JSON objects as columns, by their path within an object."""
    cells: dict[str, list[list[str]]] = {}
    lists: set[str] = set()
    objects = recordings = 0
    for whole in samples:
        each = one_recording_each(whole)
        objects, recordings = objects + len(whole), recordings + len(each)
        for key, (parts, in_list) in json_cells(each).items():
            cells.setdefault(key, []).extend(parts)
            lists |= {key} if in_list else set()
    if recordings > objects:
        guess.doubt(
            "lists within objects are taken for recordings: {n} in {objects} objects",
            "recording",
            n=recordings,
            objects=objects,
        )
    guess.rate_hz = next((rate for key, rate in _MICROBIT_HZ.items() if any(ends_in(k, key) for k in cells)), 0.0)
    return [
        SampledColumn(key, key, parts, of_recording=bool(lists) and key not in lists) for key, parts in cells.items()
    ]


def _xdf_columns(files: list[Path], guess: PatternDraft, limits: UnpackLimits) -> list[SampledColumn]:
    """Return the channels of the stream that may be the toy as columns, with its times and what the markers name.

    Raises:
        FileFormatError: if no file can be read.
    """
    samples: list[XdfSample] = []
    refused: list[FileFormatError] = []
    with temporary_folder() as folder:
        for k, file in enumerate(files):
            try:
                samples.append(sample_xdf(file, _LINES, folder / str(k), limits))
            except FileFormatError as cause:
                refused.append(cause)
    if not samples:
        raise refused[0]
    usual = Counter(tuple(sample.columns) for sample in samples).most_common(1)[0][0]
    alike = [sample for sample in samples if tuple(sample.columns) == usual]
    first = alike[0]
    if first.others:
        guess.columns[STREAM_ROLE] = first.stream
        guess.doubt(
            "the channels are those of the stream '{name}'; there are also {others}: if one of them is the toy, name "
            "it as stream under [columns]",
            "channels",
            name=first.stream,
            others=", ".join(first.others[:_FEW]),
        )
    if first.repeated:
        guess.doubt(
            "several channels have the name {listed}, so that they cannot be told apart: they are left out",
            "channels",
            listed=", ".join(first.repeated[:_FEW]),
        )
    are_codes = bool(first.labels) and all(map(is_number, first.labels))
    if first.other_markers or are_codes:
        guess.columns[MARKERS_ROLE] = first.markers
    if are_codes:
        guess.doubt(
            "the stream '{name}' has the numbers {listed}, which are taken for the labels: give them names in "
            "[aliases]",
            "label",
            name=first.markers,
            listed=", ".join(sorted(set(first.labels))[:_FEW]),
        )
    if first.other_markers:
        guess.doubt(
            "the labels are those of the stream '{name}'; there are also {others}: if one of them names the gestures, "
            "name it as markers under [columns]",
            "label",
            name=first.markers,
            others=", ".join(first.other_markers[:_FEW]),
        )
    elif first.labels and not are_codes:
        listed = ", ".join(repr(label) for label in list(dict.fromkeys(first.labels))[:2])
        guess.doubt("the stream '{name}' names the labels: {listed}", "label", name=first.markers, listed=listed)
    columns = [SampledColumn(key, key, [sample.columns[key] for sample in alike]) for key in usual]
    labels = [sample.labels for sample in alike if sample.labels]
    return [*columns, *([SampledColumn("label", "label", labels, of_recording=True)] if labels else [])]


def _interval_files(base: Path, without: list[Path], guess: PatternDraft) -> dict[Path, dict[str, str]]:
    """Return the files of intervals among those with other columns, and the names of their columns."""
    found: dict[Path, dict[str, str]] = {}
    moments = []
    for file in without if "label" not in guess.taken else ():
        lines = [line for line in _text(file, None, _HEAD).splitlines() if line.strip()]
        separator = max(",;\t", key=lines[0].count) if lines else ","
        names = [name.strip() for name in next(csv.reader(lines, delimiter=separator), [])]
        if len(lines) > 1 and (at := interval_columns(names)):
            found[file.relative_to(base)] = {role: names[k] for role, k in at.items()}
        elif {name.casefold() for name in names} & {*LABEL_NAMES} and any("time" in n.casefold() for n in names):
            moments.append(file.relative_to(base).as_posix())
    if moments and not found:
        guess.doubt(
            "files such as {file} have labels of single moments, which cannot be used: give each a start and an end "
            "(columns start, end, label)",
            "label",
            file=moments[0],
        )
    return found


def _intervals(found: dict[Path, dict[str, str]], samples: list[Path], parts: PathParts, guess: PatternDraft) -> bool:
    """Use files of intervals for the labels; return whether their paths fit those of the samples."""
    patterns = {_place_of(path, samples, parts.patterns) for path in found}
    path, columns = next(iter(found.items()))
    pattern = patterns.pop()
    if patterns or pattern is None:
        guess.doubt(
            "files such as {file} have intervals, but do not fit the paths of the samples: name them in intervals",
            "label",
            file=path.as_posix(),
        )
        return False
    guess.keys["intervals"] = pattern
    guess.columns |= columns
    guess.doubt(
        "the labels are the intervals in files such as {file}: '{column}'",
        "label",
        file=path.as_posix(),
        column=columns["label"],
    )
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


def _exclude(without: list[Path], samples: list[Path], guess: PatternDraft) -> None:
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
    guess.doubt("files without such rows are left out: {listed}", "files", listed=listed)


def _value(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def _toml(guess: PatternDraft, name: str) -> str:
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


def reusable(toml: str) -> str:
    """Return the TOML of a guess for further files: without comments, paths of single files and folders around all."""
    lines = []
    for line in toml.splitlines(keepends=True):
        key, _, value = line.partition(" = ")
        if key == "paths":
            paths = [re.sub(r"^(?!\*\*/)([^{/]*/)*", "**/", path) for path in json.loads(value)]
            line = f"paths = {_value(paths)}\n"
        single = key == "exclude" and not all(path.startswith("**/") for path in json.loads(value))
        if not line.startswith("#") and not single:
            lines.append(line)
    return "".join(lines).lstrip()
