"""Keys of ``dataset.toml``, and its table ``[about]``: description, authors and contact, needed to publish.

    [about]
    title = "Touch on a plush companion"
    keywords = ["touch", "plush toy"]
    creators = [{ name = "Curie, Marie", orcid = "0000-0002-1825-0097", affiliation = "University of Paris" }]
    contact = { name = "Marie Curie", email = "marie@example.org" }

Every key is optional; older data sets have no such table.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from typing import Any

from plushsense.core.errors import DatasetError

_EMAIL = re.compile(r"[^@\s<>]+@[^@\s<>]+\.[^@\s<>]+")
_DOI = re.compile(r"10\.\d{4,9}/\S+")
_ORCID = re.compile(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]")
_CONTACT = re.compile(r"\s*(?P<name>[^<>]*?)\s*<\s*(?P<email>[^<>]+?)\s*>\s*")


@dataclass(frozen=True)
class HeadFile:
    """The keys of ``dataset.toml``, besides ``format``, the version of the data set's form.

    Attributes:
        name: name of the data set.
        layout: table with the keys of a layout file.
        gesture_set: table with the keys of a gesture set file.
        version: version of the data set.
        licence: SPDX name of the licence, such as ``CC-BY-4.0``; needed to publish.
        consent: statement on the consent of the people; needed to publish.
        source: where the recordings came from; the import writes it.
        simulated: whether the people are virtual; every page that shows a score of theirs says so.
        about: description, authors and contact, which is needed to publish.
    """

    name: str
    layout: dict[str, Any]
    gesture_set: dict[str, Any]
    version: str = "1.0.0"
    licence: str = ""
    consent: str = ""
    source: str = ""
    simulated: bool = False
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Creator:
    """Author to be cited.

    Attributes:
        name: ``Family, Given``, or the name of an organisation.
        orcid: ORCID iD, such as ``0000-0002-1825-0097``.
        affiliation: organisation that the author works for.
    """

    name: str
    orcid: str = ""
    affiliation: str = ""

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise DatasetError("a creator has no name: give one.")
        if self.orcid and not _is_orcid(self.orcid):
            raise DatasetError(
                "'{orcid}' is no ORCID iD: sixteen digits like 0000-0002-1825-0097, the last one a check digit.",
                orcid=self.orcid,
            )


@dataclass(frozen=True)
class Contact:
    """Person who answers questions about the data set; false if the name or the address is missing.

    Attributes:
        name: name of the person.
        email: e-mail address.
    """

    name: str = ""
    email: str = ""

    def __post_init__(self) -> None:
        if self.email and not _EMAIL.fullmatch(self.email):
            raise DatasetError("'{mail}' is no e-mail address: name@place.tld is accepted.", mail=self.email)

    def __bool__(self) -> bool:
        return bool(self.name and self.email)

    @classmethod
    def parse(cls, text: str) -> Contact:
        """Parse a contact of the form ``Name <address>``; raise DatasetError for any other form."""
        match = _CONTACT.fullmatch(text)
        if match is None or not match["name"] or not _EMAIL.fullmatch(match["email"]):
            raise DatasetError(
                f"The contact '{text}' cannot be used: write it as  \"Marie Curie <marie@example.org>\"."
            )
        return cls(match["name"], match["email"])


@dataclass(frozen=True)
class Funding:
    """Funder of the data set.

    Attributes:
        funder: name of the funder.
        award: number of the award.
    """

    funder: str
    award: str = ""

    def __post_init__(self) -> None:
        if not self.funder.strip():
            raise DatasetError("a funding has no funder: name one.")


@dataclass(frozen=True)
class About:
    """Description of a data set for its users.

    Attributes:
        title: title of the data set.
        description: what it contains, in a few sentences.
        keywords: words to find it by.
        creators: authors to be cited, in order.
        contact: person who answers questions about it.
        publisher: organisation that publishes it.
        doi: DOI of the data set, without ``https://doi.org/``.
        homepage: web address of the data set or project.
        paper: DOI of the publication that describes it.
        funding: funders.
        collected: how the recordings were made.
        limits: what the data should not be used for.
        language: code of the language of the texts.
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
                raise DatasetError(f"{key} is '{value}': a bare DOI is accepted, like 10.5281/zenodo.1234.")
        if self.homepage and not re.fullmatch(r"https?://\S+", self.homepage):
            raise DatasetError(f"homepage is '{self.homepage}': an address that begins with https:// is accepted.")
        if not re.fullmatch(r"[a-zA-Z]{2,3}(-[a-zA-Z0-9]{2,8})*", self.language):
            raise DatasetError(f"language is '{self.language}': a code like en is accepted.")

    def to_table(self) -> dict[str, object]:
        """Return plain values for TOML, without those that have the default."""
        defaults = asdict(About())
        return {k: _without_blanks(v) for k, v in asdict(self).items() if v != defaults[k]}


def _without_blanks(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: v for k, v in value.items() if v != ""}
    return [_without_blanks(v) for v in value] if isinstance(value, list | tuple) else value


def _is_orcid(text: str) -> bool:
    """Return whether ``text`` is an ORCID iD with a correct check digit (ISO 7064, MOD 11-2)."""
    if not _ORCID.fullmatch(text):
        return False
    total = 0
    for digit in text.replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    return text[-1] == "0123456789X"[(12 - total % 11) % 11]
