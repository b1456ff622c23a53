"""Describe recordings of other projects in one TOML file: `ImportPattern` is its schema.

The parts of a recording (person, session, label, take) stand in the path of a file or in a column.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.gestures import GestureSet, load_gestures, plain_label
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Layout, load_layout
from plushsense.core.toml import load_table, read_toml

PARTS = ("subject", "session", "label", "recording")
"""Parts of a recording that may stand in a path or a column; ``recording`` tells takes of one label apart."""
INTERVAL = "interval_ms"
# Accepted column names by role.
ROLES: dict[str, tuple[str, ...]] = {
    "subject": ("subject", "participant", "person", "subject_id", "participant_id"),
    "session": ("session", "session_id"),
    "recording": ("recording", "recording_id", "trial"),
    "label": ("label", "gesture", "activity"),
    "time": (DEVICE_MS, "time", "timestamp", "time_ms", "time_s", "timestamp_ms", "timestamp_s", "t", "t_ms", "t_s"),
    HOST_MS: (HOST_MS,),
    # Only where a pattern names it.
    INTERVAL: (),
}
STREAM_ROLE, MARKERS_ROLE = "stream", "markers"
LABELS = ("class", "event", "action", "touch", "kind", "movement", "trial_type", "text")
"""Other usual names of columns of labels, which only a guess uses."""
# Accepted column names of files that label intervals of time, as Label Studio, BIDS and others call them.
INTERVAL_COLUMNS: dict[str, tuple[str, ...]] = {
    "start": ("start", "start_time", "begin", "onset", "from", "t_start"),
    "end": ("end", "end_time", "stop", "stop_time", "finish", "to", "t_end"),
    "duration": ("duration", "length"),
}
UNITS = {"ns": 1e-6, "us": 1e-3, "µs": 1e-3, "ms": 1.0, "s": 1000.0, "d": 86_400_000.0}
ENDINGS = {".parquet": "parquet", ".jsonl": "json", ".ndjson": "json", ".json": "json"}
"""Formats by the ending of a file; any other is a table of text, ``csv``."""

_PIECE = re.compile(r"\{(\w*)(?::((?:[^{}]|\{[^{}]*\})+))?\}|(\*\*/)|(\*\*)|(\*)|(\?)|([^*?{}]+)|([{}])")


@functools.cache
def path_expression(text: str) -> re.Pattern[str]:
    """Return the regular expression for a pattern of paths, such as ``{subject}/{label}_{recording}.csv``.

    ``{part}`` is a part of the name of one file or folder, as long as possible; ``{part:REGEX}`` limits it; a part that
    stands twice must be the same. ``*`` and ``?`` stand for any characters within a name, ``**`` also for folders.
    Upper and lower case are the same.

    Raises:
        ConfigError: for an unknown part or an expression that is not valid.
    """
    expression, seen = "", set[str]()
    for piece in _PIECE.finditer(text):
        part, limit, folders, anything, star, one, plain, brace = piece.groups()
        if part is not None:
            if part not in PARTS:
                raise ConfigError(
                    "{problem}",
                    problem=f"'{piece[0]}' in '{text}' is unknown: accepted are "
                    f"{', '.join(f'{{{p}}}' for p in PARTS)}, and * for anything else.{nearest(part, PARTS)}",
                    key="paths",
                )
            expression += f"(?P={part})" if part in seen else f"(?P<{part}>{limit or '[^/]+'})"
            seen.add(part)
        elif brace:
            raise ConfigError(
                "{problem}", problem=f"'{text}' has a '{brace}' without its partner: write {{subject}}.", key="paths"
            )
        else:
            expression += "(?:.*/)?" if folders else ".*" if anything else "[^/]*" if star else "[^/]" if one else ""
            expression += re.escape(plain or "")
    try:
        return re.compile(expression, re.IGNORECASE | re.DOTALL)
    except re.error as cause:
        raise ConfigError(
            "{problem}", problem=f"'{text}' has an expression that is not valid: {cause}.", key="paths"
        ) from None


@dataclass(frozen=True)
class ImportPattern:
    """Settings for importing files of other projects, as read from a TOML file.

    They say where person, session, label, take and channels are found in paths and columns.

    Attributes:
        layout: name of a built-in layout, path of a layout file beside this file, or a table with the keys of a layout
            file, where ``name`` and ``wire`` may be omitted (default: the built-in layout whose channels the header
            names).
        gestures: name of a built-in gesture set, path of a gesture set file beside this file, or a table with its keys,
            where ``name`` may be omitted (default: the labels are the gestures).
        paths: patterns of the files to import, below the source; the first that fits counts. ``{subject}``,
            ``{session}``, ``{label}`` and ``{recording}`` (the take) stand for a part of one name, as long as possible;
            ``{subject:EXPRESSION}`` limits a part by a regular expression. ``*`` and ``?`` stand for any characters
            within a name, ``**`` also for folders (default: all files).
        exclude: patterns of files that are left out all the same.
        format: ``csv`` for tables of text, ``json`` for JSON lines or a list of objects, ``parquet`` (default: by the
            ending of the file). XDF is always known by its ending.
        encoding: encoding of text files, such as ``utf-16`` or ``latin-1``. A byte order mark is never read as text.
        skip_before: lines before the line of column names (from 0).
        skip_after: lines after it, such as units (from 0).
        names: names of the columns of files that have no line of column names, or a wrong one in ``skip_before``.
        separator: one character between two columns; a space is any white space (default: found in the first line).
        decimal: sign before the decimals.
        missing: words in place of a value, such as ``OL``, or an empty text for an empty cell. The row stays, and the
            value counts as invalid, so that readers repeat the last valid one (default: such rows are left out).
        between: regular expression of whole lines that separate recordings, such as ``START.*``; ``none``: no line does
            (default: empty lines, rows of empty cells, comments with #, % or //, and repeated lines of column names).
        row_rate_hz: rows for each second, for files without a clock. Rows that are left out take their time, too; 0:
            there is a column of times (from 0).
        time_unit: unit of times; ``iso`` for dates and for times such as ``12:01:02.5``, ``d`` for days, as those of
            spreadsheets (default: by the name of the column, else by the rate).
        intervals: pattern of the paths of files that label the rows of other files: each of their rows has ``start``
            and ``end`` (or ``duration``), in the unit of the clock or in that of the column's name, and ``label``. A
            file belongs to the samples whose path has the same parts (default: there are none).
        columns: column of each channel, and of ``subject``, ``session``, ``recording``, ``label``, ``time``,
            ``host_ms``, ``interval_ms`` (ms to the next row, in place of a time), and ``start``, ``end`` and
            ``duration`` of intervals: its name, ``x#2`` for the second column ``x``, ``#3`` for the third column,
            ``a.b`` for a value within a JSON object (default: the columns of those names, as for one table). For XDF,
            the names of the streams of samples, ``stream``, and of ``markers``.
        idle: labels in a column that mean that nothing happens, such as ``null``: these rows belong to no recording,
            but to the stream of the session (default: none; a gesture with ``idle = true`` keeps such recordings).
        aliases: for each label, a list of other spellings of it in the source. Case, ``_`` and spaces never make a
            difference.
    """

    layout: str | dict[str, Any] = ""
    gestures: str | dict[str, Any] = ""
    paths: tuple[str, ...] = ("**",)
    exclude: tuple[str, ...] = ()
    format: Literal["", "csv", "json", "parquet"] = ""
    encoding: str = "utf-8"
    skip_before: int = 0
    skip_after: int = 0
    names: tuple[str, ...] = ()
    separator: str = ""
    decimal: Literal[".", ","] = "."
    missing: tuple[str, ...] = ()
    between: str = ""
    row_rate_hz: float = 0.0
    time_unit: Literal["", "d", "s", "ms", "us", "ns", "iso"] = ""
    intervals: str = ""
    columns: dict[str, str] = field(default_factory=dict)
    idle: tuple[str, ...] = ()
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, problem in self._problems():
            raise ConfigError(problem, key=key)

    def _problems(self) -> Iterator[tuple[str, str]]:
        for text in (*self.paths, *self.exclude, self.intervals):
            path_expression(text)
        for key in ("skip_before", "skip_after"):
            if getattr(self, key) < 0:
                yield key, f"{key} is {getattr(self, key)}: accepted are 0 and more lines."
        try:
            re.compile(self.between)
        except re.error as cause:
            yield "between", f"between is '{self.between}', an expression that is not valid: {cause}."
        if self.row_rate_hz < 0:
            yield "row_rate_hz", f"row_rate_hz is {self.row_rate_hz:g}: accepted is a number above 0."
        if self.row_rate_hz and (self.time_unit or {"time", INTERVAL} & set(self.columns)):
            yield (
                "row_rate_hz",
                "row_rate_hz is for files without a clock: leave it, or time_unit and columns.time, out.",
            )
        if len(self.separator) > 1 or self.separator in ("\n", "\r", '"', "."):
            yield "separator", f"separator is {self.separator!r}: accepted is one character such as ',', ';' or '\\t'."
        if self.separator and self.separator == self.decimal:
            yield "decimal", f"decimal and separator are both '{self.decimal}': they must differ."
        try:
            "".encode(self.encoding)
        except (LookupError, ValueError):
            yield "encoding", f"encoding is '{self.encoding}': accepted are names such as utf-8, utf-16 or latin-1."
        spellings: dict[str, str] = {}
        for label, others in self.aliases.items():
            for other in others:
                if spellings.setdefault(other, label) != label:
                    yield "aliases", f"'{other}' is an alias of '{spellings[other]}' and of '{label}': leave one out."

    @property
    def text_encoding(self) -> str:
        """Encoding of text files; a byte order mark at their beginning is no text."""
        return "utf-8-sig" if self.encoding.lower().replace("_", "-") in ("utf-8", "utf8") else self.encoding

    def format_of(self, path: Path) -> str:
        """Return the format of a file: csv, json or parquet."""
        return self.format or ENDINGS.get(path.suffix.lower(), "csv")

    def match(self, relative: str) -> dict[str, str] | None:
        """Return the parts in a path below the source, with ``/`` between folders; None if the file is not meant."""
        if self.excluded_by(relative):
            return None
        found = (path_expression(text).fullmatch(relative) for text in self.paths)
        match = next((m for m in found if m is not None), None)
        return None if match is None else {part: text.strip() for part, text in match.groupdict().items() if text}

    def interval_place(self, relative: str) -> dict[str, str] | None:
        """Return the parts in the path of a file of intervals; None for any other file."""
        match = path_expression(self.intervals).fullmatch(relative) if self.intervals else None
        return None if match is None else {part: text.strip() for part, text in match.groupdict().items() if text}

    def excluded_by(self, relative: str) -> str:
        """Return the pattern that excludes a path; "" if none does."""
        return next((text for text in self.exclude if path_expression(text).fullmatch(relative)), "")

    def label_of(self, text: str) -> str:
        """Return the label of which ``text`` is a spelling; other labels stay as they are."""
        return self._spellings.get(text) or self._spellings.get(plain_label(text), text)

    def names_gesture(self, label: str) -> bool:
        """Return whether ``label`` names a gesture, not idle time."""
        return bool(plain_label(label)) and plain_label(label) not in map(plain_label, self.idle)

    @functools.cached_property
    def _spellings(self) -> dict[str, str]:
        exact = {other: label for label, others in self.aliases.items() for other in others}
        return {plain_label(other): label for other, label in exact.items()} | exact

    def known_layout(self) -> Layout | None:
        """Return the layout that the pattern names or holds; None if it has none."""
        if isinstance(self.layout, str):
            return load_layout(self.layout) if self.layout else None
        channels = self.layout.get("channels")
        names = [c.get("name") for c in channels if isinstance(c, dict)] if isinstance(channels, list) else []
        return Layout.from_dict(
            {"name": "imported", "wire": [DEVICE_MS, *names], **self.layout}, "layout of the pattern"
        )

    def known_gestures(self) -> GestureSet | None:
        """Return the gesture set that the pattern names or holds; None if it has none."""
        if isinstance(self.gestures, str):
            return load_gestures(self.gestures) if self.gestures else None
        return GestureSet.from_dict({"name": "imported", **self.gestures}, "gesture set of the pattern")


def read_pattern(path: str | Path) -> ImportPattern:
    """Read the pattern of an import from a TOML file; files that it names lie beside it.

    Raises:
        ConfigError: for a file that cannot be read, an unknown key or an unfit value, with file and line.
    """
    path = Path(path)
    table = read_toml(path, "import pattern", ConfigError)
    text = path.read_text(encoding="utf-8-sig")
    pattern = load_table(table, ImportPattern, f"import pattern '{path}'", ConfigError, text=text)
    beside: dict[str, Any] = {
        key: str(path.parent / name)
        for key, name in (("layout", pattern.layout), ("gestures", pattern.gestures))
        if isinstance(name, str) and name.endswith(".toml")
    }
    return replace(pattern, **beside)


def check_roles(columns: Mapping[str, str], layout: Layout, where: str = "--column ") -> None:
    """Raise ConfigError for an unknown role in ``columns``; ``where`` stands before it in the message."""
    known = (*ROLES, STREAM_ROLE, MARKERS_ROLE, *INTERVAL_COLUMNS, *layout.names)
    for role in columns:
        if role not in known:
            raise ConfigError(f"{where}{role}=…: accepted are {', '.join(known)}.{nearest(role, known)}")
