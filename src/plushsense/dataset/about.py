"""Who made a data set and whom to ask about it: the table ``[about]`` of ``dataset.toml``, which publishing needs.

    [about]
    title = "Touch on a plush companion"
    keywords = ["touch", "plush toy"]
    creators = [{ name = "Curie, Marie", orcid = "0000-0002-1825-0097", affiliation = "University of Paris" }]
    contact = { name = "Marie Curie", email = "marie@example.org" }

Every key may be left out; an older data set has no such table.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, TypeVar

from plushsense.core.errors import DatasetError
from plushsense.core.tomlfile import refuse_unknown

_EMAIL = re.compile(r"[^@\s<>]+@[^@\s<>]+\.[^@\s<>]+")
_DOI = re.compile(r"10\.\d{4,9}/\S+")
_ORCID = re.compile(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]")
_CONTACT = re.compile(r"\s*(?P<name>[^<>]*?)\s*<\s*(?P<email>[^<>]+?)\s*>\s*")


@dataclass(frozen=True)
class Creator:
    """One who made the data set, as it is to be cited: "Family, Given", or an organisation's name."""

    name: str
    orcid: str = ""
    affiliation: str = ""

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("a creator has no name")
        if self.orcid and not _is_orcid(self.orcid):
            raise ValueError(
                f"'{self.orcid}' is no ORCID iD: sixteen digits like 0000-0002-1825-0097, the last one a check digit"
            )


@dataclass(frozen=True)
class Contact:
    """Whom to write to about the data set."""

    name: str = ""
    email: str = ""

    def __post_init__(self) -> None:
        if self.email and not _EMAIL.fullmatch(self.email):
            raise ValueError(f"'{self.email}' is no e-mail address: name@place.tld is accepted")

    def __bool__(self) -> bool:
        return bool(self.name and self.email)

    @classmethod
    def parse(cls, text: str) -> Contact:
        """A contact from ``Name <mail>``.

        Raises:
            DatasetError: for another form.
        """
        found = _CONTACT.fullmatch(text)
        if found is None or not found["name"] or not _EMAIL.fullmatch(found["email"]):
            raise DatasetError(
                f"The contact '{text}' cannot be used: write it as  \"Marie Curie <marie@example.org>\"."
            )
        return cls(found["name"], found["email"])


@dataclass(frozen=True)
class Funding:
    """Who paid, and the number of the award."""

    funder: str
    award: str = ""


@dataclass(frozen=True)
class About:
    """What a stranger needs to know about a data set; ``paper`` is the DOI of the publication that describes it.

    ``collected`` says in a few words how the recordings came about, ``limits`` what they should not be used for.
    """

    title: str = ""
    description: str = ""
    keywords: tuple[str, ...] = ()
    creators: tuple[Creator, ...] = ()
    contact: Contact = Contact()
    publisher: str = ""
    doi: str = ""
    homepage: str = ""
    paper: str = ""
    funding: tuple[Funding, ...] = ()
    collected: str = ""
    limits: str = ""
    language: str = "en"

    def __post_init__(self) -> None:
        for key in ("doi", "paper"):
            value = getattr(self, key)
            if value and not _DOI.fullmatch(value):
                raise ValueError(f"{key} is '{value}': a bare DOI is accepted, like 10.5281/zenodo.1234")
        if self.homepage and not re.fullmatch(r"https?://\S+", self.homepage):
            raise ValueError(f"homepage is '{self.homepage}': an address that begins with https:// is accepted")
        if not re.fullmatch(r"[a-zA-Z]{2,3}(-[a-zA-Z0-9]{2,8})*", self.language):
            raise ValueError(f"language is '{self.language}': a code like en is accepted")

    def to_table(self) -> dict[str, Any]:
        """Plain values for TOML; what was left out stays out."""
        table = {}
        plain = About()
        for f in fields(self):
            if getattr(self, f.name) != getattr(plain, f.name):
                table[f.name] = _without_blanks(asdict(self)[f.name])
        return table

    @classmethod
    def from_table(cls, table: object, where: str) -> About:
        """The table of a TOML file.

        Raises:
            DatasetError: for an unknown key, with the nearest known one, or a value that does not fit.
        """
        known = _mapping(table, where)
        refuse_unknown(known, [f.name for f in fields(cls)], where, DatasetError)
        values: dict[str, Any] = {}
        try:
            for key, value in known.items():
                match key:
                    case "creators":
                        values[key] = tuple(_part(Creator, v, f"{where}, creators") for v in _list(value, key))
                    case "funding":
                        values[key] = tuple(_part(Funding, v, f"{where}, funding") for v in _list(value, key))
                    case "contact":
                        values[key] = _part(Contact, value, f"{where}, contact")
                    case "keywords":
                        values[key] = tuple(_text(v, key) for v in _list(value, key))
                    case _:
                        values[key] = _text(value, key)
            return cls(**values)
        except ValueError as cause:
            raise DatasetError(f"{where[0].upper()}{where[1:]} cannot be used: {cause}.") from None


P = TypeVar("P", Creator, Contact, Funding)


def _part(kind: type[P], table: object, where: str) -> P:
    given = _mapping(table, where)
    refuse_unknown(given, [f.name for f in fields(kind)], where, DatasetError)
    for f in fields(kind):
        if f.default is MISSING and f.name not in given:
            raise ValueError(f"an entry of {where.rsplit(', ', 1)[-1]} lacks '{f.name}'")
    return kind(**{key: _text(value, key) for key, value in given.items()})


def _mapping(table: object, where: str) -> Mapping[str, Any]:
    if not isinstance(table, dict):
        raise DatasetError(f"{where[0].upper()}{where[1:]} is {table!r}; it must be a table.")
    return table


def _list(value: object, key: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{key} is {value!r}; it must be a list")
    return value


def _text(value: object, key: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{key} is {value!r}; it must be a text")
    return value


def _without_blanks(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: v for k, v in value.items() if v != ""}
    return [_without_blanks(v) for v in value] if isinstance(value, list | tuple) else value


def _is_orcid(text: str) -> bool:
    """Whether the check digit fits (ISO 7064, MOD 11-2)."""
    if not _ORCID.fullmatch(text):
        return False
    total = 0
    for digit in text.replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    return text[-1] == "0123456789X"[(12 - total % 11) % 11]
