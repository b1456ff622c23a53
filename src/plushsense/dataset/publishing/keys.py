"""Read and write the key of a publication: the secret of the time shifts, and the new codes of people.

The secret stands in the first line, in hexadecimal. If people get new codes, a table of them follows:

    9656b0a4454a6caf621784db20577a68
    original,code
    P01,S7K2Q
"""

from __future__ import annotations

import csv
import io
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.dataset.files import normalize_code
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT

KEY_BYTES = 32
KEPT = (NOBODY, UNKNOWN_SUBJECT)
"""Folders that are no person, and keep their names."""
_COLUMNS = ["original", "code"]
# Without letters and digits that are easily confused. A code is an S and four of these.
_SIGNS = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"


@dataclass(frozen=True)
class PublicationKey:
    """Secret from which the time shifts are derived, and the new codes of people by their original ones."""

    secret: bytes = field(default_factory=lambda: secrets.token_bytes(KEY_BYTES), repr=False)
    codes: Mapping[str, str] = field(default_factory=dict)

    def with_people(self, people: Iterable[str]) -> PublicationKey:
        """Return the key with a code for each of ``people``: those in it keep theirs, others get random ones."""
        people, codes = list(people), dict(self.codes)
        # A new code must differ from every existing code and name, in any spelling.
        taken = set(map(normalize_code, (*codes, *codes.values(), *people)))
        for person in people:
            if person in codes or person in KEPT:
                continue
            code = person
            while normalize_code(code) in taken:
                code = "S" + "".join(secrets.choice(_SIGNS) for _ in range(4))
            taken.add(normalize_code(code))
            codes[person] = code
        return replace(self, codes=codes)

    def write(self, path: Path) -> None:
        """Write the key, completely or not at all, readable by its owner only (mode 600 where supported).

        Raises:
            DatasetError: if the file cannot be written.
        """
        out = io.StringIO()
        out.write(self.secret.hex() + "\n")
        if self.codes:
            csv.writer(out, lineterminator="\n").writerows([_COLUMNS, *self.codes.items()])
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, out.getvalue(), private=True)
        except OSError as cause:
            raise _unusable(path, cause) from None


def _unusable(path: Path, cause: OSError) -> DatasetError:
    return DatasetError(
        "The key '{file}' cannot be read or written ({why}): choose another place for it.",
        file=path,
        why=cause.strerror or cause,
    )


def is_drawn(code: str) -> bool:
    """Return whether a code has the form of a new code of `PublicationKey.with_people`."""
    return len(code) == 5 and code[0] == "S" and all(sign in _SIGNS for sign in code[1:])


def open_key(path: Path, *apart_from: Path) -> PublicationKey:
    """Read a key; if there is no such file, create it with a new secret.

    Raises:
        DatasetError: for a file that is no key, that cannot be used, or that lies in a data set or in one of the
            folders ``apart_from``.
    """
    above = path.resolve().parents
    inside = next((p for p in above if p in {a.resolve() for a in apart_from} or (p / HEAD).is_file()), None)
    if inside is not None:
        raise DatasetError(f"The key '{path}' lies in '{inside}': store it elsewhere.")
    try:
        if path.exists():
            return _parse(path.read_text(encoding="utf-8-sig"))
    except (ValueError, csv.Error) as cause:
        raise DatasetError(
            "'{file}' is not a key of plushsense publish ({cause}): give a file that does not exist yet, or restore "
            "the key from a copy.",
            file=path,
            cause=cause,
        ) from None
    except OSError as cause:
        raise _unusable(path, cause) from None
    key = PublicationKey()
    key.write(path)
    return key


def _parse(text: str) -> PublicationKey:
    first, _, table = text.partition("\n")
    secret = bytes.fromhex(first)
    if len(secret) < KEY_BYTES // 2:
        raise ValueError("its secret is too short")
    codes: dict[str, str] = {}
    rows = list(csv.reader(io.StringIO(table), strict=True))
    if rows and rows[0] != _COLUMNS:
        raise ValueError(f"line 2 is not {','.join(_COLUMNS)}")
    for number, row in enumerate(rows[1:], 3):
        if len(row) != 2 or not all(row):
            raise ValueError(f"line {number} is no {','.join(_COLUMNS)}")
        original, code = row
        if original in codes or code.casefold() in map(str.casefold, codes.values()):
            raise ValueError(f"line {number} names '{original}' or its code twice")
        codes[original] = code
    return PublicationKey(secret, codes)
