"""Rows of numbers out of the bytes of a CSV: fast where every line is good, and no slower than it must be elsewhere."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError

LIMIT = 2.0**53
LONGEST_LINE = 1_000_000
LONGEST_LABEL = 200
_FULL_LINE = re.compile(rb"\S[^\n]*")
_BLOCK = 1000


def separator_of(line: bytes) -> str | None:
    """``;`` or ``,`` where a line has one, else None for white space."""
    return ";" if b";" in line else "," if b"," in line else None


def _cells(line: bytes, separator: str | None, width: int) -> list[bytes]:
    """The fields of a line, none of one without end; a separator too many at its end is none."""
    if len(line) > LONGEST_LINE:
        return []
    if separator is None:
        return line.split()
    cells = [c.strip() for c in line.split(separator.encode())]
    while len(cells) > width and not cells[-1]:
        cells.pop()
    return cells


def _parse_slowly(
    lines: list[bytes], separator: str | None, width: int, label_at: int | None
) -> tuple[list[list[float]], list[str], int]:
    """Rows, labels and the number of malformed lines, for lines that the fast reader refuses."""
    rows, labels, malformed = [], [], 0
    for line in lines:
        if not line.strip():
            continue
        cells = _cells(line, separator, width)
        try:
            if len(cells) != width:
                raise ValueError
            text = cells.pop(label_at).decode("utf-8", "replace") if label_at is not None else ""
            # Python alone takes 1_000 for a number.
            row = [float(c) if b"_" not in c else np.nan for c in cells]
            if not all(abs(v) < LIMIT for v in row) or len(text) > LONGEST_LABEL:
                raise ValueError
        except ValueError:
            malformed += 1
            continue
        rows.append(row)
        labels.append(text)
    return rows, labels, malformed


def _parse_fast(data: bytes, separator: str | None, skip: int, width: int) -> NDArray[Any] | None:
    """Numbers (T, width), or None when one line or value does not fit; int64 where all are whole, else float."""
    begin = data.find(b"\n") + 1 if skip else 0
    # Whole numbers read in two thirds of the time; some versions of NumPy would cut a fraction off without a word.
    whole = not any(data.find(sign, begin) >= 0 for sign in (b".", b"e", b"E"))
    for dtype in (np.int64, np.float64) if whole else (np.float64,):
        try:
            table = np.loadtxt(
                io.BytesIO(data), dtype=dtype, delimiter=separator, skiprows=skip, ndmin=2, comments=None
            )
        except ValueError:
            continue
        # NaN compares as false; the smallest int64 has no absolute value.
        fits = table.shape[1] == width and bool(np.all((table > -LIMIT) & (table < LIMIT)))
        return table if fits else None
    return None


def _parse_in_blocks(lines: list[bytes], separator: str | None, width: int) -> tuple[list[NDArray[Any]], int]:
    """Blocks of rows and the number of malformed lines: one bad line makes its own block slow, not the whole file."""
    blocks, malformed = [], 0
    for at in range(0, len(lines), _BLOCK):
        block = lines[at : at + _BLOCK]
        if not any(line.strip() for line in block):
            continue
        table = _parse_fast(b"\n".join(block), separator, 0, width)
        if table is None:
            rows, _, bad = _parse_slowly(block, separator, width, None)
            malformed += bad
            table = np.array(rows).reshape(-1, width)
        blocks.append(table)
    return blocks, malformed


def parse_table(
    data: bytes, keys: list[str], skip: int, path: Path
) -> tuple[NDArray[Any], NDArray[np.str_] | None, int]:
    """All numeric columns (T, columns), the labels where there are any, and how many lines were malformed."""
    label_at = keys.index("label") if "label" in keys else None
    row = _FULL_LINE.search(data, data.find(b"\n") + 1 if skip else 0)
    separator = separator_of(row[0]) if row else None
    malformed = 0
    if label_at is None:
        table = _parse_fast(data, separator, skip, len(keys))
        if table is not None:
            return table, None, 0
        blocks, malformed = _parse_in_blocks(data.split(b"\n")[skip:], separator, len(keys))
        table = np.concatenate(blocks) if blocks else np.empty((0, len(keys)))
        if len(table):
            return table, None, malformed
    else:
        lines = data.split(b"\n")[skip:]
        if label_at == len(keys) - 1 and separator:
            parts = [line.rsplit(separator.encode(), 1) for line in lines if line.strip()]
            try:
                texts = [p[1].strip().decode() for p in parts]
                table = _parse_fast(b"\n".join(p[0] for p in parts), separator, 0, len(keys) - 1)
                if table is not None and len(table) == len(texts) and max(map(len, texts)) <= LONGEST_LABEL:
                    return table, np.array(texts), 0
            except (ValueError, IndexError):
                pass
        rows, labels, malformed = _parse_slowly(lines, separator, len(keys), label_at)
        if rows:
            return np.array(rows), np.array(labels), malformed
    raise FileFormatError(f"'{path.name}' has no usable row: each must hold {len(keys)} numbers ({', '.join(keys)}).")
