"""Read and write the key file of pseudonyms, and shift dates in numbers, in text and in time columns of raw files.

A number counts as a date if, read as milliseconds since 1970, it is after 1990; a toy's counter since it was switched
on never gets that high.
"""

from __future__ import annotations

import csv
import io
import re
import secrets
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Layout
from plushsense.core.recorder_csv import column_keys
from plushsense.dataset.files import normalize_code
from plushsense.dataset.store import UNKNOWN_SUBJECT

FIRST_MS = 631_152_000_000
"""1990-01-01."""
LAST_MS = 4_102_444_800_000
"""2100-01-01: all recordings are earlier."""
_BEYOND_MS = 10**14
# At least this many digits in a time column may be a fragment of a date.
_PIECE = 5
_LONGEST = 40

_WORD_BEFORE, _WORD_AFTER = r"(?<![^\W_])", r"(?![^\W_])"
_DIGITS = re.compile(rf"{_WORD_BEFORE}\d{{12,19}}{_WORD_AFTER}")
_ISO = re.compile(
    rf"{_WORD_BEFORE}(?:19|20|21|22|23)\d\d-[01]\d-[0-3]\d"
    rf"(?:[T ][0-2]\d:[0-5]\d(?::[0-5]\d(?:[.,]\d{{1,6}})?)?(?:Z|[+-]\d\d:?\d\d)?)?{_WORD_AFTER}"
)
_COMPACT = re.compile(
    rf"{_WORD_BEFORE}(?:19|20|21|22|23)\d\d[01]\d[0-3]\d(?:([T_ -]?)[0-2]\d[0-5]\d[0-5]\d)?(?!\d|[^\W_]{{2}})"
)
_OTHER = re.compile(rf"{_WORD_BEFORE}\d{{1,2}}([./-])\d{{1,2}}\1(?:19|20)\d\d{_WORD_AFTER}")
NO_DATE = "[date]"


def shifted_number(value: int, shift_ms: int) -> int:
    """Shift a date in ms, µs or ns since 1970 by ``shift_ms``; return other numbers unchanged."""
    for scale in (1, 10**3, 10**6):
        if FIRST_MS * scale <= value < _BEYOND_MS * scale:
            return value + shift_ms * scale
    return value


def _whole_days(shift_ms: int) -> timedelta:
    return timedelta(days=shift_ms // 86_400_000)


def _iso(text: str, shift_ms: int) -> str:
    try:
        when = datetime.fromisoformat(text.replace(",", "."))
    except ValueError:
        return text
    if len(text) == 10:
        return (when + _whole_days(shift_ms)).date().isoformat()
    moved = when + timedelta(seconds=shift_ms // 1000)
    # Keep the separator, precision and time zone.
    tail = re.search(r"(?::\d\d[.,](\d+))?(Z|[+-]\d\d:?\d\d)?$", text[11:])
    zone = (tail.group(2) if tail else "") or ""
    clock = text[11 : len(text) - len(zone)]
    shape = "%H:%M:%S" if clock.count(":") == 2 else "%H:%M"
    return moved.strftime(f"%Y-%m-%d{text[10]}{shape}") + clock[8:] + zone


def _compact(match: re.Match[str], shift_ms: int) -> str:
    text, between = match.group(), match.group(1)
    try:
        if between is None:
            return (datetime.strptime(text, "%Y%m%d") + _whole_days(shift_ms)).strftime("%Y%m%d")
        when = datetime.strptime(text, f"%Y%m%d{between}%H%M%S") + timedelta(seconds=shift_ms // 1000)
        return when.strftime(f"%Y%m%d{between}%H%M%S")
    except ValueError:
        return text


def shifted_text(text: str, shift_ms: int) -> str:
    """Shift every date in a text: numbers since 1970, ``2026-05-01``, ``2026-05-01T10:15:00+02:00``, ``20260501``.

    Dates in other notations (``1.5.2026``) become ``[date]``; dates in words are not found.
    """
    text = _DIGITS.sub(lambda m: str(shifted_number(int(m.group()), shift_ms)), text)
    text = _ISO.sub(lambda m: _iso(m.group(), shift_ms), text)
    text = _COMPACT.sub(lambda m: _compact(m, shift_ms), text)
    return _OTHER.sub(NO_DATE, text)


def dates_in(text: str) -> list[str]:
    """Return the dates in a text (numbers only from 1990 to 2100), without ambiguous ones such as ``20260501``."""
    numbers = [m.group() for m in _DIGITS.finditer(text)]
    real = [n for n in numbers if any(FIRST_MS * s <= int(n) < LAST_MS * s for s in (1, 10**3, 10**6))]
    real += [w for m in _ISO.finditer(text) if (w := m.group())[:2] in ("19", "20") and _is_day(w)]
    real += [w for m in _COMPACT.finditer(text) if m[1] and (w := m.group())[:2] in ("19", "20") and _is_day(w)]
    return real + [m.group() for m in _OTHER.finditer(text)]


def _is_day(text: str) -> bool:
    try:
        datetime.fromisoformat(text[:10] if text[4] == "-" else f"{text[:4]}-{text[4:6]}-{text[6:8]}")
    except ValueError:
        return False
    return True


def holds_dates(column: NDArray[np.int64] | None) -> bool:
    """Return whether a time column (T,) holds dates."""
    return column is not None and len(column) > 0 and bool(FIRST_MS <= np.median(column) < _BEYOND_MS)


_LINE = re.compile(rb"[^\r\n]+")
_TOKEN = re.compile(rb"[^;,\s]+")
_RUN = re.compile(rb"\d+")
_NUMBER = rb"[-+0-9.eE]+"
_BETWEEN = rb"[;,\t ]+"


def _cell(token: bytes, shift_ms: int) -> bytes:
    """Shift the date in a cell of a dated column; replace digits that may be a fragment of a date by zeros."""
    try:
        value = Decimal(token.decode("ascii") if len(token) <= _LONGEST else "NaN")
        if FIRST_MS <= value < _BEYOND_MS:
            return format(value + shift_ms, "f").encode()
    except (InvalidOperation, UnicodeDecodeError):
        pass
    return _RUN.sub(lambda m: b"0" * len(m.group()) if len(m.group()) >= _PIECE else m.group(), token)


def _stray(token: bytes, shift_ms: int) -> bytes:
    """Shift all dates in a cell of a malformed line, in which the columns are unknown."""

    def one(match: re.Match[bytes]) -> bytes:
        digits = match.group()
        if len(digits) > 14:
            return b"0" * len(digits)
        return str(int(digits) + shift_ms).encode() if FIRST_MS <= int(digits) < _BEYOND_MS else digits

    return _RUN.sub(one, token)


def _replaced(text: bytes, changes: Iterable[tuple[int, int, bytes]]) -> bytes:
    """Replace parts of a text, given as (start, end, new bytes) in ascending order."""
    parts, done = [], 0
    for start, end, new in changes:
        parts += [text[done:start], new]
        done = end
    return b"".join([*parts, text[done:]])


def shifted_rows(data: bytes, layout: Layout, columns: Collection[str], shift_ms: int, path: Path) -> bytes:
    """Return the bytes of a raw file with the dates in ``columns`` (of ``host_ms``, ``device_ms``) shifted.

    All other bytes stay the same: separators, header, line endings, other columns. In a malformed line, all dates are
    shifted; a fragment of a date becomes zeros.

    Raises:
        FileFormatError: if the columns of the file are not those of the layout.
    """
    if not columns:
        return data
    first = next((m for m in _LINE.finditer(data) if m.group().removeprefix(b"\xef\xbb\xbf").strip()), None)
    if first is None:
        return data
    keys, header = column_keys(first.group().removeprefix(b"\xef\xbb\xbf"), layout, path)
    at = [i for i, key in enumerate(keys) if key in columns and key in (HOST_MS, DEVICE_MS)]
    start = first.end() if header else first.start()
    last = b".*" if keys[-1] == "label" else _NUMBER
    cells = [_NUMBER] * (len(keys) - 1) + [last]
    usual = re.compile(
        rb"[\t ]*"
        + _BETWEEN.join(rb"(\d{12,14})(?:\.\d*)?" if i in at else c for i, c in enumerate(cells))
        + rb"[;,\t ]*"
    )
    groups = range(1, len(at) + 1)

    def line(match: re.Match[bytes]) -> bytes:
        text: bytes = match.group()
        well = usual.fullmatch(text)
        if well is not None and all(FIRST_MS <= int(well[g]) < _BEYOND_MS for g in groups):
            return _replaced(text, ((*well.span(g), str(int(well[g]) + shift_ms).encode()) for g in groups))
        tokens = list(_TOKEN.finditer(text))
        whole = len(tokens) == len(keys) or (keys[-1] == "label" and len(tokens) > len(keys))
        return _replaced(
            text,
            (
                (*token.span(), (_cell if i in at else _stray)(token.group(), shift_ms))
                for i, token in enumerate(tokens)
                if i in at or not whole
            ),
        )

    return data[:start] + _LINE.sub(line, data[start:])


COLUMNS = ["original", "code", "shift_s"]
# Without letters and digits that are easily confused. A code is an S and four of these.
_SIGNS = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
_DAY_S = 86_400
# Shift by 120 to 220 years, so that shifted dates are recognisable, and an unshifted one is seen to be a mistake.
_FIRST_DAY, _DAYS = 120 * 365, 100 * 365
KEPT = (NOBODY, UNKNOWN_SUBJECT)
"""Folders that are no person: they keep their names, but their dates are shifted."""


@dataclass(frozen=True)
class Pseudonym:
    """Random code of a person, and the random shift of the person's dates in seconds."""

    original: str
    code: str
    shift_s: int

    @property
    def shift_ms(self) -> int:
        """The shift in milliseconds."""
        return self.shift_s * 1000


def is_drawn(code: str) -> bool:
    """Return whether a code has the form of a random code of `extend_key`."""
    return len(code) == 5 and code[0] == "S" and all(sign in _SIGNS for sign in code[1:])


def read_key(path: Path) -> dict[str, Pseudonym]:
    """Read the pseudonyms of a key file by original code; empty if there is no such file.

    Raises:
        DatasetError: for a file that is no key, or contains a person or a code twice.
    """
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise DatasetError(
            "The key file '{file}' cannot be read ({cause}): restore it from a copy.", file=path, cause=cause
        ) from None
    if not rows or rows[0] != COLUMNS:
        raise DatasetError(
            "'{file}' is no key file (it does not begin with {columns}): name a new file, or the key of an earlier "
            "run; nothing is overwritten.",
            file=path,
            columns=",".join(COLUMNS),
        )
    key: dict[str, Pseudonym] = {}
    codes: set[str] = set()
    for number, row in enumerate(rows[1:], 2):
        if len(row) != 3 or not row[0] or not row[1] or not row[2].lstrip("-").isdigit():
            raise DatasetError(
                "The key file '{file}' line {number} is no  {columns}: restore it from a copy.",
                file=path,
                number=number,
                columns=",".join(COLUMNS),
            )
        if row[0] in key or (row[1].casefold() in codes):
            raise DatasetError(
                "The key file '{file}' line {number} names '{row}' or its code twice.",
                file=path,
                number=number,
                row=row[0],
            )
        codes.add(row[1].casefold())
        key[row[0]] = Pseudonym(row[0], row[1], int(row[2]))
    return key


def extend_key(key: dict[str, Pseudonym], people: Iterable[str]) -> dict[str, Pseudonym]:
    """Return ``key`` with a pseudonym for each of ``people``: those in ``key`` keep theirs, others get random ones."""
    out = dict(key)
    # A new code must differ from every existing code and name, in any spelling.
    taken = {normalize_code(w) for p in out.values() for w in (p.original, p.code)} | {
        normalize_code(p) for p in people
    }
    for person in people:
        if person in out:
            continue
        code = person
        while person not in KEPT and normalize_code(code) in taken:
            code = "S" + "".join(secrets.choice(_SIGNS) for _ in range(4))
        taken.add(normalize_code(code))
        shift_s = (_FIRST_DAY + secrets.randbelow(_DAYS)) * _DAY_S + secrets.randbelow(_DAY_S)
        out[person] = Pseudonym(person, code, shift_s)
    return out


def write_key(path: Path, key: dict[str, Pseudonym]) -> None:
    """Write the key file, completely or not at all, readable by its owner only (mode 600 where supported).

    Raises:
        DatasetError: if the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([p.original, p.code, p.shift_s] for p in key.values())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, out.getvalue(), private=True)
    except OSError as cause:
        raise DatasetError(
            "The key file '{file}' cannot be written ({why}): choose another place for it.",
            file=path,
            why=cause.strerror or cause,
        ) from None
