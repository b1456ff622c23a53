"""Moving dates by a constant: in numbers, in text, and in the time columns of raw files, where all else stays.

A number is a date when it is milliseconds since 1970 and lies after 1990; what a toy counts since it was switched on
never is.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from datetime import datetime, timedelta
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import column_keys
from plushsense.core.signal import DEVICE_MS, HOST_MS, Layout

FIRST_MS = 631_152_000_000
"""1990-01-01."""
LAST_MS = 4_102_444_800_000
"""2100-01-01: whatever was recorded lies before."""
_BEYOND_MS = 10**14
# Of a number in a time column that is no date, so many digits can be a piece of one.
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
    """A date in ms, µs or ns since 1970, moved; any other number as it is."""
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
    # Written as it was: the same separator, the same precision, the same zone.
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
    """Every date in a text moved: numbers since 1970, ``2026-05-01``, ``2026-05-01T10:15:00+02:00``, ``20260501``.

    Dates in other words (``1.5.2026``) become ``[date]``; those in plain language are not found.
    """
    text = _DIGITS.sub(lambda m: str(shifted_number(int(m.group()), shift_ms)), text)
    text = _ISO.sub(lambda m: _iso(m.group(), shift_ms), text)
    text = _COMPACT.sub(lambda m: _compact(m, shift_ms), text)
    return _OTHER.sub(NO_DATE, text)


def dates_in(text: str) -> list[str]:
    """The dates from 1990 to 2100 that stand in a text; eight digits alone can be anything and are none."""
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


def dated(column: NDArray[np.int64] | None) -> bool:
    """Whether a time column (T,) holds dates."""
    return column is not None and len(column) > 0 and bool(FIRST_MS <= np.median(column) < _BEYOND_MS)


_LINE = re.compile(rb"[^\r\n]+")
_TOKEN = re.compile(rb"[^;,\s]+")
_RUN = re.compile(rb"\d+")
_NUMBER = rb"[-+0-9.eE]+"
_BETWEEN = rb"[;,\t ]+"


def _cell(token: bytes, shift_ms: int) -> bytes:
    """A cell of a dated column: moved, or made zeros where it is a piece of a date."""
    try:
        value = Decimal(token.decode("ascii") if len(token) <= _LONGEST else "NaN")
        if FIRST_MS <= value < _BEYOND_MS:
            return format(value + shift_ms, "f").encode()
    except (InvalidOperation, UnicodeDecodeError):
        pass
    return _RUN.sub(lambda m: b"0" * len(m.group()) if len(m.group()) >= _PIECE else m.group(), token)


def _stray(token: bytes, shift_ms: int) -> bytes:
    """A cell of a malformed line, where a date can stand anywhere."""

    def one(match: re.Match[bytes]) -> bytes:
        digits = match.group()
        if len(digits) > 14:
            return b"0" * len(digits)
        return str(int(digits) + shift_ms).encode() if FIRST_MS <= int(digits) < _BEYOND_MS else digits

    return _RUN.sub(one, token)


def shifted_rows(data: bytes, layout: Layout, columns: Collection[str], shift_ms: int, path: Path) -> bytes:
    """A raw file's bytes with the dates in ``columns`` (of ``host_ms``, ``device_ms``) moved.

    All else is the same byte for byte: separators, header, line ends, other columns. In a malformed line dates are
    moved wherever they stand, and a piece of a date becomes zeros.

    Raises:
        FileFormatError: when the columns are not those of the layout.
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
            out, done = [], 0
            for g in groups:
                out += [text[done : well.start(g)], str(int(well[g]) + shift_ms).encode()]
                done = well.end(g)
            return b"".join([*out, text[done:]])
        tokens = list(_TOKEN.finditer(text))
        whole = len(tokens) == len(keys) or (keys[-1] == "label" and len(tokens) > len(keys))
        out, done = [], 0
        for i, token in enumerate(tokens):
            change: Callable[[bytes, int], bytes] | None = _cell if i in at else None if whole else _stray
            if change is not None:
                out += [text[done : token.start()], change(token.group(), shift_ms)]
                done = token.end()
        return b"".join([*out, text[done:]])

    return data[:start] + _LINE.sub(line, data[start:])
