"""Remember which people were removed from a home, so that nobody is taken in again unasked.

A home is the folder of a studio, with its data sets in ``datasets/``. ``removed.json`` in it has a random salt and a
salted hash of each code. The hash is slow, but codes are few: whoever has the file can try them all.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file
from plushsense.core.sentences import join_names
from plushsense.dataset.files import DATASETS, normalize_code

REMOVED = "removed.json"
CONSENT = "consent"
"""What a refusal states as ``needs`` if people would come back who were removed."""
_ROUNDS = 20_000


def comparable(code: str) -> str:
    """Return a code without case, punctuation and leading zeros, so that ``S01``, ``s-1`` and ``S1`` are equal."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", normalize_code(code))


@lru_cache(4096)
def _hash(salt: str, code: str) -> str:
    return hashlib.pbkdf2_hmac("sha256", comparable(code).encode(), bytes.fromhex(salt), _ROUNDS).hex()


@dataclass(frozen=True)
class RemovedCodes:
    """The codes that were removed from a home; ``code in removed`` ignores case, punctuation and leading zeros."""

    salt: str = field(default_factory=lambda: secrets.token_hex(16), repr=False)
    hashes: tuple[str, ...] = ()

    @classmethod
    def read(cls, home: Path) -> RemovedCodes:
        """Read the codes of a home.

        Raises:
            DatasetError: if the file is damaged.
        """
        try:
            table = json.loads((home / REMOVED).read_text(encoding="utf-8"))
            bytes.fromhex(table["salt"])
            return cls(table["salt"], tuple(map(str, table["hashes"])))
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, KeyError, TypeError) as cause:
            raise DatasetError(
                "'{file}', which remembers who was removed, cannot be read ({why}): restore it from a copy, or delete "
                "it if nobody may come back by it.",
                file=home / REMOVED,
                why=cause,
            ) from None

    def __contains__(self, code: str) -> bool:
        return bool(self.hashes) and _hash(self.salt, code) in self.hashes


def home_of(dataset: Path) -> Path | None:
    """Return the home that a data set lies in, None if it lies in no folder ``datasets``."""
    place = dataset.resolve().parent
    return place.parent if place.name == DATASETS else None


def remember_removed(home: Path, code: str) -> None:
    """Remember that a person was removed from a home."""
    removed = RemovedCodes.read(home)
    if code not in removed:
        hashes = sorted((*removed.hashes, _hash(removed.salt, code)))
        write_file(home / REMOVED, json.dumps({"salt": removed.salt, "hashes": hashes}) + "\n")


def remembers_removed(place: Path) -> Path | None:
    """Return the home that ``place`` lies in, None if it lies in none that remembers removed people."""
    return next((folder for folder in place.resolve().parents if (folder / REMOVED).is_file()), None)


def may_be_suggested(home: Path, code: str) -> bool:
    """Return whether a person was not removed from a home; False if that cannot be read."""
    try:
        return code not in RemovedCodes.read(home)
    except DatasetError:
        return False


def removed_of(place: Path, people: Iterable[str]) -> list[str]:
    """Return those of ``people`` who were removed from the home that ``place`` lies in."""
    home = remembers_removed(place)
    if home is None:
        return []
    removed = RemovedCodes.read(home)
    return sorted({code for code in people if code in removed})


def refuse_removed(place: Path, people: Iterable[str]) -> None:
    """Raise DatasetError if one of ``people`` was removed from the home that ``place`` lies in."""
    if back := removed_of(place, people):
        raise DatasetError(
            "{people} was removed from '{home}' for good: take recordings of this code in again only if the person "
            "agreed anew, or if it is somebody else (--readmit; Python: readmit=True).",
            people=join_names(back),
            home=remembers_removed(place),
            needs=CONSENT,
        )
