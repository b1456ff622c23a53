"""The key of a pseudonymised data set: who got which code, and by how much their dates were moved.

A CSV file ``original,code,shift_s``. Whoever holds it can undo the pseudonyms, so it is kept apart from every data
set, readable by its owner alone where the system knows how. It is only ever added to: a person keeps code and shift.
"""

from __future__ import annotations

import csv
import io
import os
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.contents import squashed
from plushsense.dataset.store import UNKNOWN_SUBJECT

COLUMNS = ["original", "code", "shift_s"]
# Without letters and digits that a hand confuses. A code always holds a letter first and four of these.
_SIGNS = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
_DAY_S = 86_400
# Into a time when nobody recorded anything: a moved date is seen to be none, and a date of today to be a mistake.
_FIRST_DAY, _DAYS = 120 * 365, 100 * 365
KEPT = (NOBODY, UNKNOWN_SUBJECT)
"""Folders that are no person: their name stays, their dates are moved."""


@dataclass(frozen=True)
class Pseudonym:
    """One person's code, and by how many seconds (days and seconds, drawn at random) their dates are moved."""

    original: str
    code: str
    shift_s: int

    @property
    def shift_ms(self) -> int:
        """The shift in milliseconds."""
        return self.shift_s * 1000


def is_drawn(code: str) -> bool:
    """Whether a person's code looks like one that was drawn here, and not like one that somebody thought of."""
    return len(code) == 5 and code[0] == "S" and all(sign in _SIGNS for sign in code[1:])


def read_key(path: Path) -> dict[str, Pseudonym]:
    """The pseudonyms of a key file by original; none where there is no such file.

    Raises:
        DatasetError: for a file that is no key, or names a person or a code twice.
    """
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise DatasetError(f"The key file '{path}' cannot be read ({cause}): bring it back from a copy.") from None
    if not rows or rows[0] != COLUMNS:
        raise DatasetError(
            f"'{path}' is no key file (it does not begin with {','.join(COLUMNS)}): name a file that is not there yet, "
            "or the key of an earlier run; nothing is overwritten."
        )
    key: dict[str, Pseudonym] = {}
    codes: set[str] = set()
    for number, row in enumerate(rows[1:], 2):
        if len(row) != 3 or not row[0] or not row[1] or not row[2].lstrip("-").isdigit():
            raise DatasetError(f"The key file '{path}' line {number} is no  {','.join(COLUMNS)}: bring it back whole.")
        if row[0] in key or (row[1].casefold() in codes):
            raise DatasetError(f"The key file '{path}' line {number} names '{row[0]}' or its code twice.")
        codes.add(row[1].casefold())
        key[row[0]] = Pseudonym(row[0], row[1], int(row[2]))
    return key


def extended(key: dict[str, Pseudonym], people: Iterable[str]) -> dict[str, Pseudonym]:
    """The key with everybody in ``people``: who is in it stays as they are; codes of the others are drawn at random."""
    out = dict(key)
    # A new code is no old code or name, in any spelling.
    taken = {squashed(w) for p in out.values() for w in (p.original, p.code)} | {squashed(p) for p in people}
    for person in people:
        if person in out:
            continue
        code = person
        while person not in KEPT and squashed(code) in taken:
            code = "S" + "".join(secrets.choice(_SIGNS) for _ in range(4))
        taken.add(squashed(code))
        shift_s = (_FIRST_DAY + secrets.randbelow(_DAYS)) * _DAY_S + secrets.randbelow(_DAY_S)
        out[person] = Pseudonym(person, code, shift_s)
    return out


def write_key(path: Path, key: dict[str, Pseudonym]) -> None:
    """Put the key in its place, whole or not at all, for its owner's eyes only (mode 600 where the system knows it).

    Raises:
        DatasetError: when the place cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([p.original, p.code, p.shift_s] for p in key.values())
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(out.getvalue().encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as cause:
        raise DatasetError(
            f"The key file '{path}' cannot be written ({cause.strerror or cause}): choose another place for it."
        ) from None
    finally:
        part.unlink(missing_ok=True)
