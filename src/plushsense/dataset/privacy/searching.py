"""Search texts of any file for words, such as the codes of people."""

from __future__ import annotations

import html
import json
import re
import unicodedata
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO
from urllib.parse import unquote

import numpy as np

from plushsense.core.errors import MissingExtraError, need
from plushsense.dataset.files import normalize_code

_BEFORE, _AFTER = r"(?<![^\W_])", r"(?![^\W_])"
_PIECES = re.compile(r"[^\W\d_]+|\d+")


def is_searchable(word: str) -> bool:
    """Return whether a word is long enough to search for it in texts: ``P1`` is, ``7`` and ``a`` are not."""
    key = normalize_code(word)
    return len(key) >= (5 if key.isdigit() else 2)


def _pattern(word: str) -> str:
    pieces = _PIECES.findall(unicodedata.normalize("NFC", word))
    if any(len(p) == 1 and p.isalpha() for p in pieces):
        # A single letter can be part of another word: "it's 1 o'clock" does not contain S1.
        return r"(?<![^\W_]['’])" + r"[\s_-]?".join(map(re.escape, pieces))
    return r"[\s_.'-]*".join(map(re.escape, pieces))


class NamePatterns:
    """Finds whole words in texts, in any letter case and with any ``_``, ``-`` or spaces between their parts.

    Words for which `is_searchable` is false are not found.
    """

    def __init__(self, words: Iterable[str]) -> None:
        known = sorted(filter(is_searchable, words), key=len, reverse=True)
        alternatives = "|".join(map(_pattern, known))
        self._any = re.compile(f"{_BEFORE}(?:{alternatives}){_AFTER}", re.IGNORECASE) if known else None

    def find_in(self, text: str) -> list[str]:
        """Return all occurrences of the words in a text, as they are written there."""
        if self._any is None:
            return []
        return [m.group() for m in self._any.finditer(unicodedata.normalize("NFC", text))]


_CHUNK = 1 << 20
_LONGEST_NAME = 256
# Text in a binary file: in UTF-8, and in UTF-16 of either byte order.
_RUNS = re.compile(rb"[\x20-\x7e\x80-\xff]{2,}")
_WIDE = {"utf-16-le": re.compile(rb"(?:[^\0][\0-\x04]){2,}"), "utf-16-be": re.compile(rb"(?:[\0-\x04][^\0]){2,}")}
_ESCAPED = re.compile(r"\\u([0-9a-fA-F]{4})")
_NUMBERS = b"0123456789;,.+- \t\r\n"
_MAX_UNPACKED = 1 << 33
# First bytes of files whose text is compressed in a way that is not read here: gzip, bzip2, xz, zstd, 7z, rar, PDF.
_UNREAD = (b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"%PDF")


def texts_in(path: Path) -> Iterator[str]:
    """Yield the text in a file of any kind, piece by piece.

    Characters that are escaped as in JSON, HTML or an address are there plainly, too. Of binary files that is what is
    printable in them, of zips what is packed in them, of Parquet and NumPy files the cells that are texts.

    Raises:
        OSError, ValueError: if the file cannot be read, or its text is packed in another way.
    """
    with path.open("rb") as file:
        yield from _texts(file)


def _texts(file: IO[bytes], depth: int = 0) -> Iterator[str]:
    begin = file.read(8)
    file.seek(0)
    if depth > 3 or begin.startswith(_UNREAD):
        raise ValueError("its text is packed")
    try:
        if begin.startswith(b"PK\x03\x04"):
            yield from _packed_texts(file, depth)
        elif begin.startswith((b"PAR1", b"\x93NUMPY")):
            yield from _cells(file, begin.startswith(b"PAR1"))
        else:
            yield from _pieces(file)
    except (EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error) as cause:
        raise ValueError(f"it is damaged or encrypted ({cause})") from None


def _packed_texts(file: IO[bytes], depth: int) -> Iterator[str]:
    with zipfile.ZipFile(file) as archive:
        if sum(member.file_size for member in archive.infolist()) > _MAX_UNPACKED:
            raise ValueError("it unpacks to more than 8 GB")
        for member in archive.infolist():
            yield member.filename
            with archive.open(member) as packed:
                yield from _texts(packed, depth + 1)


def _cells(file: IO[bytes], parquet: bool) -> Iterator[str]:
    """Yield the distinct texts of each column of a Parquet file, or of a NumPy array, one a line."""
    if not parquet:
        array = np.lib.format.read_array(file, allow_pickle=False)
        if array.dtype.kind in "SU":
            yield "\n".join(np.unique(array).astype(np.str_).tolist())
        elif array.dtype.itemsize == 1:
            yield _printable(array.tobytes())
        return
    try:
        polars = need("polars", extra="tables")
        table = polars.read_parquet(file)
    except MissingExtraError:
        raise ValueError("Parquet is not read without polars") from None
    except polars.exceptions.PolarsError as cause:
        raise ValueError(str(cause)) from None
    for column in table.iter_columns():
        yield column.name
        if not column.dtype.is_numeric():
            yield "\n".join(sorted({_cell_text(cell) for cell in column.to_list()}))


def _cell_text(cell: object) -> str:
    if isinstance(cell, bytes):
        return _printable(cell)
    return json.dumps(cell, ensure_ascii=False, default=str) if isinstance(cell, list | dict) else str(cell)


def _pieces(file: IO[bytes]) -> Iterator[str]:
    rest = b""
    while data := file.read(_CHUNK):
        yield _printable(rest + data)
        # A name across the edge is found in the next piece, but never the end of a longer word.
        rest = re.sub(rb"\A[^\s,;:\"'<>(){}\[\]]+", b"", (rest + data)[-_LONGEST_NAME:])


def _printable(data: bytes) -> str:
    text = data.decode("utf-8", "replace")
    # Characters may be cut at both ends.
    if "\0" in text or text.count("\ufffd") > 6:
        runs = [run.decode("utf-8", "replace") for run in _RUNS.findall(data)]
        runs += [run.decode(code, "replace") for code, wide in _WIDE.items() for run in wide.findall(data)]
        text = "\n".join(runs)
    elif "\ufffd" in text:
        text += "\n" + data.decode("cp1252", "replace")
    plain = _ESCAPED.sub(lambda match: chr(int(match[1], 16)), text) if "\\u" in text else text
    plain = unquote(plain) if "%" in plain else plain
    plain = html.unescape(plain) if "&" in plain else plain
    return text if plain == text else f"{text}\n{plain}"


def words_of_rows(data: bytes) -> str:
    """Return the distinct cells of a raw file that are not numbers, one a line: header, labels, garbled text."""
    cells: set[bytes] = set()
    if data.translate(None, _NUMBERS):
        for line in data.splitlines():
            if line.translate(None, _NUMBERS):
                cells.update(cell for cell in re.split(rb"[;,\t]", line) if cell.translate(None, _NUMBERS))
    return "\n".join(sorted(cell.decode("utf-8", "replace").strip() for cell in cells))
