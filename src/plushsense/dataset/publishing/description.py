"""Describe a package: the common source of its metadata files, and of its texts (templates beside this file)."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError, nearest
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Channel, Layout
from plushsense.core.sentences import Message
from plushsense.core.templates import fill_text
from plushsense.dataset.about import About, Creator
from plushsense.dataset.files import sha256_of
from plushsense.dataset.store import RECORDINGS, STREAMS, Dataset


@dataclass(frozen=True)
class Licence:
    """Licence: SPDX name, title, and the address of its text."""

    spdx: str
    title: str
    url: str
    travels: bool = False
    """Whether every copy must include its text."""


LICENCES: dict[str, Licence] = {
    spdx: Licence(spdx, **values)
    for spdx, values in tomllib.loads(
        resources.files("plushsense.dataset.publishing").joinpath("licences.toml").read_text("utf-8")
    ).items()
}


def find_licence(spdx: str) -> Licence:
    """Return the licence with an SPDX name, whose case is ignored.

    Raises:
        DatasetError: for a name that is not in `LICENCES`; the message suggests the nearest one.
    """
    for name, licence in LICENCES.items():
        if name.casefold() == spdx.strip().casefold():
            return licence
    raise DatasetError(
        "'{licence}' is no licence that can be published under: accepted are the SPDX names {licences}.{hint}",
        licence=spdx,
        licences=", ".join(LICENCES),
        hint=nearest(spdx.replace(" ", "-"), LICENCES),
    )


INTEGER, NUMBER, TEXT, YES_NO = "integer", "number", "string", "boolean"
SIMULATION = "SIMULATION: recordings of a virtual toy. Nobody touched anything; they say nothing about a real toy."

DATA = "data"
CHECKSUMS = "checksums.sha256"


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: its kind (`INTEGER`, …), meaning (``text``), unit, and range of valid values."""

    name: str
    kind: str
    text: str
    unit: str = ""
    valid: tuple[float, float] | None = None
    refers: str = ""
    """Foreign key: the ``table.column`` that the values refer to."""


@dataclass(frozen=True)
class PackageTable:
    """Table of the package: one ``file``, or many ``files`` with the same columns; ``key`` is the primary key."""

    name: str
    text: str
    columns: tuple[TableColumn, ...]
    file: str = ""
    files: tuple[str, ...] = ()
    glob: str = ""
    key: str = ""

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the files of the table, from the root of the package."""
        return (self.file,) if self.file else self.files


@dataclass(frozen=True)
class FileEntry:
    """Size and checksum of a file of the package."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Description:
    """Description of a package: authors, terms, tables and files; ``published`` is the day in ISO format."""

    dataset: Dataset
    licence: Licence
    about: About
    consent: str
    published: str
    tables: tuple[PackageTable, ...]
    notes: tuple[Message, ...] = ()
    """Notes on what was left out or changed, one sentence each."""
    files: Mapping[str, FileEntry] = field(default_factory=dict)
    """The files of the tables by path."""

    @property
    def name(self) -> str:
        """Short ASCII name for files and identifiers."""
        plain = "".join(c if c.isascii() and c.isalnum() else "-" for c in self.dataset.head.name.lower())
        return "-".join(part for part in plain.split("-") if part) or "dataset"

    @property
    def version(self) -> str:
        """Version of the data set, MAJOR.MINOR.PATCH."""
        return self.dataset.head.version

    @property
    def simulated(self) -> bool:
        """Whether the recordings are of the virtual toy."""
        return self.dataset.head.simulated

    @property
    def title(self) -> str:
        """Title of the data set; begins with SIMULATION for recordings of the virtual toy."""
        title = self.about.title or self.dataset.head.name
        return f"SIMULATION: {title}" if self.simulated and not title.startswith("SIMULATION") else title

    @property
    def gestures_made(self) -> int:
        """Number of gestures with recordings; the gesture set may contain more."""
        return len({r.gesture for r in self.dataset.recordings})

    @property
    def text(self) -> str:
        """Description of the data set in one paragraph."""
        d = self.dataset
        counted = (
            f"{len(d.recordings)} recordings of {self.gestures_made} gestures by {len(d.subjects)} people on "
            f"'{d.layout.title}': {d.layout.n_channels} channels at about {d.layout.rate_hz:g} Hz"
            f"{f', and {len(d.streams)} whole session streams' if d.streams else ''}."
        )
        parts = [SIMULATION if self.simulated else "", self.about.description, counted]
        return " ".join(p for p in parts if p)

    @property
    def keywords(self) -> tuple[str, ...]:
        """Keywords, with "simulation" for recordings of the virtual toy."""
        return (*self.about.keywords, *(("simulation",) if self.simulated else ())) or ("touch gestures",)

    @property
    def creators(self) -> tuple[Creator, ...]:
        """Authors of the data set; the contact if there are none."""
        return self.about.creators or (Creator(self.about.contact.name),)

    @property
    def citation(self) -> str:
        """Citation of the data set in one line."""
        names = "; ".join(c.name for c in self.creators)
        where = f" https://doi.org/{self.about.doi}" if self.about.doi else f" {self.about.homepage}".rstrip()
        return f"{names} ({self.published[:4]}): {self.title}, version {self.version} [data set].{where}"

    @property
    def url(self) -> str:
        """Address of the data set; "" if unknown."""
        return f"https://doi.org/{self.about.doi}" if self.about.doi else self.about.homepage


def file_entry(path: Path) -> FileEntry:
    """Return the size and checksum of a file."""
    return FileEntry(path.stat().st_size, sha256_of(path))


def sample_columns(layout: Layout) -> tuple[TableColumn, ...]:
    """Return the columns of the files of recordings and streams, in file order."""
    others = {
        HOST_MS: TableColumn(
            HOST_MS, INTEGER, "time at which the computer received the row; shifted, the date is fictitious", "ms"
        ),
        DEVICE_MS: TableColumn(
            DEVICE_MS, INTEGER, "the toy's clock: the truth for rate, gaps and losses; a fall is a restart", "ms"
        ),
        "label": TableColumn("label", TEXT, "gesture at this row"),
    }
    return tuple(others.get(key) or _channel_column(layout.channels[layout.index(key)]) for key in layout.csv.columns)


def _channel_column(channel: Channel) -> TableColumn:
    """Return the column of a measured channel."""
    text = f"{channel.kind}, raw reading"
    if (channel.offset, channel.scale) != (0.0, 1.0):
        text += f"; physical value = (raw - {channel.offset:g}) * {channel.scale:g} {channel.unit}"
    if channel.step != 1.0:
        text += f"; in steps of {channel.step:g}"
    limits = (channel.valid_min, channel.valid_max)
    low, high = (int(v) if v == int(v) else v for v in limits)
    text += f"; valid from {low} to {high}, values outside are kept as they were read"
    return TableColumn(channel.name, INTEGER if channel.step == 1.0 else NUMBER, text, channel.unit, limits)


README = "README.md"
LICENCE = "LICENSE.txt"
REIDENTIFICATION = "reidentification.md"
REIDENTIFICATION_JSON = "reidentification.json"


def fill_template(template: str, d: Description, **values: Any) -> str:
    """Fill a template of this folder with the description and ``values``."""
    return fill_text("plushsense.dataset.publishing", template, d=d, SIMULATION=SIMULATION, **values)


def readme(d: Description, reidentification: str | None) -> str:
    """Return the README in Markdown; ``reidentification`` is the short form of that report, None if left out."""
    samples = next(t for t in d.tables if t.files)
    return fill_template(
        "README.md.j2",
        d,
        findings=_findings(d),
        reidentification=reidentification,
        samples=samples,
        samples_table="streams.csv" if d.dataset.layout.is_labelled else "recordings.csv",
        sample_folder=f"{DATA}/{STREAMS if d.dataset.layout.is_labelled else RECORDINGS}",
        dtypes={INTEGER: "int64", NUMBER: "float64", TEXT: "string"},
        DATA=DATA,
        REIDENTIFICATION=REIDENTIFICATION,
    )


def _findings(d: Description) -> list[tuple[str, str]]:
    counts: Counter[str] = Counter()
    for flags in [r.flags for r in d.dataset.recordings] + [s.flags for s in d.dataset.streams]:
        counts.update({_kind(flag) for flag in flags})
    return [(kind, str(n)) for kind, n in counts.most_common()]


def _kind(flag: str) -> str:
    """Return a flag without its numbers and names, so that similar flags are counted together."""
    flag = re.sub(r"(the same content as) .*", r"\1 another", flag)
    return re.sub(r"\d[\d.]*", "n", flag.split(" (")[0]).replace("lines", "line").replace("gaps", "gap")
