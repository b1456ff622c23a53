"""Redact the texts of a data set: session files, marks, the people's table and ``dataset.toml``.

Names and codes are replaced, dates shifted, logins become roles, and addresses of toys and computers are removed.
"""

from __future__ import annotations

import bz2
import gzip
import html
import json
import lzma
import re
import unicodedata
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any, cast
from urllib.parse import unquote

import numpy as np
import tomli_w

from plushsense.core.errors import DatasetError, MissingExtraError, need
from plushsense.core.sentences import Message
from plushsense.core.toml import loads_json, read_toml
from plushsense.dataset.files import normalize_code
from plushsense.dataset.privacy.pseudonyms import FIRST_MS, shifted_number, shifted_text
from plushsense.dataset.store import HEAD, PersonInfo

_BEFORE, _AFTER = r"(?<![^\W_])", r"(?![^\W_])"
_PIECES = re.compile(r"[^\W\d_]+|\d+")

# Identifiers of one computer or toy: addresses, ports, home folders.
_ADDRESSES = re.compile(
    r"(?P<scheme>\b(?:serial|ble|tcp|lsl|replay|file)://)[^\s\"']*"
    r"|\b[0-9A-Fa-f]{2}(?:[:-][0-9A-Fa-f]{2}){5}\b"
    r"|\b[0-9A-Fa-f]{8}-(?:[0-9A-Fa-f]{4}-){3}[0-9A-Fa-f]{12}\b"
    r"|\bCOM\d+\b"
    r"|(?<![\w/.:])/(?:dev|home|Users|tmp|media|mnt|root|var|private)/[^\s\"']*"
    r"|\b[A-Za-z]:\\[^\s\"']*"
)
NO_ADDRESS = "[address]"


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
    """Replaces whole words in texts, in any letter case and with any ``_``, ``-`` or spaces between their parts.

    ``too_short`` lists the words that are not searched for (`is_searchable`).
    """

    def __init__(self, instead: Mapping[str, str]) -> None:
        self.too_short = sorted(word for word in instead if not is_searchable(word))
        words = sorted((w for w in instead if is_searchable(w)), key=len, reverse=True)
        self._instead = {normalize_code(unicodedata.normalize("NFC", word)): instead[word] for word in reversed(words)}
        alternatives = "|".join(_pattern(word) for word in words)
        self._any = re.compile(f"{_BEFORE}(?:{alternatives}){_AFTER}", re.IGNORECASE) if words else None

    def replace(self, text: str) -> tuple[str, list[str]]:
        """Replace the words in a text; return the new text and the replacements in order."""
        if self._any is None:
            return text, []
        replacements: list[str] = []

        def one(match: re.Match[str]) -> str:
            replacements.append(self._instead.get(normalize_code(match.group()), "[name]"))
            return replacements[-1]

        normalized = unicodedata.normalize("NFC", text)
        changed = self._any.sub(one, normalized)
        return (changed, replacements) if replacements else (text, replacements)

    def find_in(self, text: str) -> list[str]:
        """Return all occurrences of the words in a text, as they are written there."""
        if self._any is None:
            return []
        return [m.group() for m in self._any.finditer(unicodedata.normalize("NFC", text))]


def without_addresses(text: str) -> str:
    """Remove ports, radio addresses, unique ids and home folders from a text; the scheme of a device URL stays."""
    return _ADDRESSES.sub(lambda m: m["scheme"] or NO_ADDRESS, text)


ON_FILE = "on file"
ORIGIN = "origin.json"
"""File in which the importer stores the name and hash of the original of a converted file."""
_MENDED = "mended"
LOGINS = frozenset({"who", "by", "user", "author", "leader", "operator", "recorded_by"})
_SUBJECT, _CONSENT = "subject", "consent"
_PLACES = frozenset({"device", "former", "port", "address", "url", "mac", "hostname", "computer", "serial_number"})
PROSE = frozenset({"why", "text", "note", "notes", "comment", "comments", "said", "description"})
_SECONDS = ("_s", "timestamp", "epoch")
# Marks can be signed by programs, whose names identify nobody.
_PROGRAMS = re.compile(r"plushsense.*|recorder", re.IGNORECASE | re.DOTALL)
_FILE = re.compile(
    r"^(?P<label>.+)_(?P<epoch>\d{1,18})_(?P<rows>\d{1,12}(?: \(\d{1,4}\))?(?:\.\w+)?(?:#.*)?)$", re.DOTALL
)


@dataclass
class ReviewNotes:
    """Notes for manual review: file (new path), line (0: the whole file) and message."""

    found: list[dict[str, Any]] = field(default_factory=list)
    prose: int = 0

    def add(self, file: str, message: Message, line: int = 0) -> None:
        """Add a note."""
        self.found.append({"file": file, "line": line, "message": message})

    def merged(self) -> list[dict[str, Any]]:
        """Return all notes, equal ones merged; ``sentence`` is `Message.to_json` of the message of one of them."""
        times = Counter((f["file"], f["line"], f["message"]) for f in self.found)
        return [
            {
                "file": file,
                "line": line,
                "message": message if n == 1 else f"{n} times: {message}",
                "times": n,
                "sentence": message.to_json(),
            }
            for (file, line, message), n in times.items()
        ]


@dataclass(frozen=True)
class Redactor:
    """Redacts the texts of one person (or nobody). ``roles`` maps case-folded logins to roles."""

    names: NamePatterns
    roles: dict[str, str]
    code: str
    shift_ms: int
    findings: ReviewNotes
    drop_notes: bool = False

    def text(self, text: str, where: tuple[str, int] | None = None) -> str:
        """Replace names, addresses and dates in a text; add a note for ``where`` if a name was replaced."""
        new, replacements = self.names.replace(shifted_text(without_addresses(text), self.shift_ms))
        if replacements and where is not None:
            for word, times in Counter(replacements).items():
                self.findings.add(
                    where[0],
                    Message("a name or code in the text was replaced by '{word}' ({n}×): read it", word=word, n=times),
                    where[1],
                )
        return new

    def name(self, name: str) -> str:
        """Shift the time in a file name or in the last part of an id, without redacting the label."""
        match = _FILE.match(name)
        if match is None:
            return self.text(name)
        return f"{match['label']}_{shifted_number(int(match['epoch']), self.shift_ms)}_{match['rows']}"

    def role(self, login: str) -> str:
        """Return a role such as ``person-1`` for a login; names of programs are returned unchanged."""
        if not login or _PROGRAMS.fullmatch(login):
            return login
        return self.roles.setdefault(login.casefold(), f"person-{len(self.roles) + 1}")

    def value(self, value: Any, key: str = "", where: tuple[str, int] = ("", 0)) -> Any:
        """Redact a value of JSON or TOML recursively."""
        if isinstance(value, dict):
            # The text of a mended line is a fragment, in which dates cannot be recognised.
            torn = value.get("what") == _MENDED
            remaining = {k: v for k, v in value.items() if not (torn and k == "text")}
            return {self.text(str(k)): self.value(v, str(k), where) for k, v in remaining.items()}
        if isinstance(value, list):
            return [self.value(v, key, where) for v in value]
        if isinstance(value, str):
            return self._string(value, key.casefold(), where)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return self._number(value, key.casefold())
        return value

    def _string(self, value: str, key: str, where: tuple[str, int]) -> str:
        if not value:
            return value
        if key in LOGINS:
            return self.role(value)
        if key in (_SUBJECT, _CONSENT):
            return self.code if key == _SUBJECT else ON_FILE
        if key in _PLACES:
            return without_addresses(value) if "://" in value else ""
        if key in PROSE:
            if self.drop_notes:
                return ""
            self.findings.prose += 1
        return self.text(value, where)

    def _number(self, value: float, key: str) -> float:
        if key.endswith(_SECONDS) and FIRST_MS / 1000 <= value < FIRST_MS / 60:
            return value + self.shift_ms // 1000
        if isinstance(value, int):
            return shifted_number(value, self.shift_ms)
        return value + (shifted_number(int(value), self.shift_ms) - int(value)) if abs(value) < 2.0**53 else value


def logins_in(value: Any, key: str = "") -> Iterator[str]:
    """Yield every login in a JSON value."""
    if isinstance(value, dict):
        for k, v in value.items():
            yield from logins_in(v, str(k).casefold())
    elif isinstance(value, list):
        for v in value:
            yield from logins_in(v, key)
    elif isinstance(value, str) and key in LOGINS and value and not _PROGRAMS.fullmatch(value):
        yield value


def subject_in(value: Any) -> str:
    """Return the person's code in the head of a session; "" if there is none."""
    subject = value.get(_SUBJECT) if isinstance(value, dict) else None
    return subject if isinstance(subject, str) else ""


def read_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield (line number, value) of a JSON-lines file, or (1, value) of a JSON file; None for invalid JSON."""
    data = path.read_bytes()
    pieces = data.split(b"\n") if path.suffix.lower() == ".jsonl" else [data]
    for number, piece in enumerate(pieces, 1):
        if not piece.strip():
            continue
        try:
            yield number, loads_json(piece.decode("utf-8-sig"))
        except (ValueError, RecursionError):
            yield number, None


_CHUNK = 1 << 20
_LONGEST_NAME = 256
# Text in a binary file: in UTF-8, and in UTF-16 of either byte order.
_RUNS = re.compile(rb"[\x20-\x7e\x80-\xff]{2,}")
_WIDE = {"utf-16-le": re.compile(rb"(?:[^\0][\0-\x04]){2,}"), "utf-16-be": re.compile(rb"(?:[\0-\x04][^\0]){2,}")}
_ESCAPED = re.compile(r"\\u([0-9a-fA-F]{4})")
_NUMBERS = b"0123456789;,.+- \t\r\n"
_MAX_UNPACKED = 1 << 33
# First bytes of files whose text is compressed in a way that is not read here: zstd, 7z, rar, PDF.
_UNREAD = (b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"%PDF")
_UNPACK: dict[bytes, Callable[[IO[bytes]], IO[bytes]]] = {
    b"\x1f\x8b": lambda file: cast("IO[bytes]", gzip.open(file)),
    b"BZh": lambda file: cast("IO[bytes]", bz2.open(file)),
    b"\xfd7zXZ": lambda file: cast("IO[bytes]", lzma.open(file)),
}


def texts_in(path: Path) -> Iterator[str]:
    """Yield the text in a file of any kind, piece by piece.

    Characters that are escaped as in JSON, HTML or an address are there plainly, too. Of binary files that is what is
    printable in them, of compressed files and zips what is packed in them, of Parquet
    and NumPy files the cells that are texts.

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
    unpack = next((call for magic, call in _UNPACK.items() if begin.startswith(magic)), None)
    try:
        if unpack is not None:
            yield from _texts(unpack(file), depth + 1)
        elif begin.startswith(b"PK\x03\x04"):
            yield from _packed_texts(file, depth)
        elif begin.startswith((b"PAR1", b"\x93NUMPY")):
            yield from _cells(file, begin.startswith(b"PAR1"))
        else:
            yield from _pieces(file)
    except (EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as cause:
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


def redact_json(path: Path, new: str, words: Redactor) -> str | None:
    """Return the redacted text of a session file; None if it cannot be read.

    Lines that are not JSON (because of a crash, for example) are left out and reported.
    """
    lines = path.suffix.lower() == ".jsonl"
    out = []
    for number, value in read_lines(path):
        if value is None:
            message = Message("left out: this is no JSON (torn by a crash?)")
            words.findings.add(new, message, number if lines else 0)
            continue
        changed = words.value(value, where=(new, number if lines else 0))
        out.append(json.dumps(changed, ensure_ascii=False, indent=None if lines else 1) + "\n")
    return "".join(out) if out or lines else None


def redact_marks(
    path: Path, words_of: Callable[[str], Redactor | None], renamed: Callable[[str], str], findings: ReviewNotes
) -> str:
    """Return the redacted marks, sorted by new id, because the old order could reveal identities.

    For a recording's id, ``words_of`` returns the redactor, or None if its person is unknown; ``renamed`` the new id.
    """
    out: list[tuple[str, str]] = []
    for number, table in read_lines(path):
        identity = table.get("recording") if isinstance(table, dict) else None
        words = words_of(identity) if isinstance(identity, str) else None
        if words is None or not isinstance(identity, str):
            findings.add(
                path.name, Message("a mark was left out: it is torn, or nobody is known by its recording"), number
            )
            continue
        new = renamed(identity)
        # A label is or names a gesture, which is no personal data.
        kept = {k: v for k, v in table.items() if k in ("label", "gesture")}
        rest = {k: v for k, v in table.items() if k not in ("recording", *kept)}
        line = {"recording": new} | words.value(rest, where=(path.name, 0)) | kept
        out.append((new, json.dumps(line, ensure_ascii=False) + "\n"))
    return "".join(line for _, line in sorted(out, key=lambda pair: pair[0]))


def redact_people(people: Iterable[PersonInfo], words_of: Callable[[str], Redactor], file: str) -> Iterator[PersonInfo]:
    """Yield people with their new codes; consent references become "on file", as they lead to signed names."""
    for person in people:
        words = words_of(person.subject)
        redact = partial(words.text, where=(file, 0))
        more = {key: redact(value) for key, value in person.more.items()}
        consent = ON_FILE if person.consent else ""
        yield PersonInfo(words.code, redact(person.age_group), redact(person.gender), consent, more)


def redact_head(folder: Path, words: Redactor) -> str:
    """Return the redacted ``dataset.toml``; layout and gesture set are not changed."""
    table = read_toml(folder / HEAD, "data set", DatasetError)
    unchanged = ("layout", "gesture_set", "format")
    return tomli_w.dumps({k: v if k in unchanged else _redact_texts(v, words) for k, v in table.items()})


def _redact_texts(value: Any, words: Redactor) -> Any:
    """Redact all texts in a value of ``dataset.toml``; names of authors are kept."""
    if isinstance(value, dict):
        return {key: _redact_texts(v, words) for key, v in value.items()}
    if isinstance(value, list):
        return [_redact_texts(v, words) for v in value]
    return words.text(value, (HEAD, 0)) if isinstance(value, str) else value
