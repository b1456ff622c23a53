"""What the publish page knows without a browser: data sets and packages in plain values, and what is still missing."""

from __future__ import annotations

import importlib.util
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.apps.studio.house import PACKAGES, House
from plushsense.core.errors import PlushSenseError
from plushsense.core.recfile import SIMULATION_MARK
from plushsense.dataset.index import open_dataset
from plushsense.dataset.keyfile import is_drawn
from plushsense.dataset.people import read_people
from plushsense.dataset.publish import as_croissant
from plushsense.dataset.publish.archive import files_of
from plushsense.dataset.publish.contents import PUBLIC_COLUMNS
from plushsense.dataset.publish.description import CHECKSUMS
from plushsense.dataset.publish.readme import REIDENTIFICATION_JSON

KEYS = "keys"
"""Folder of the house for secrets: neither in a data set nor in a package."""
# Dates under pseudonyms lie beyond (`dataset.keyfile`).
_MOVED_MS = 4_102_444_800_000
_TOOLS = {
    "publish": ("mlcroissant", "frictionless", "rocrate", "datacite"),
    "baselines": ("sklearn",),
}


@dataclass(frozen=True)
class DatasetFacts:
    """A data set in plain values; ``problem``: why it cannot be read.

    ``own_codes``: people whose codes were not drawn by ``pseudonymise``; ``own_dates``: its dates may be the true ones.
    """

    path: Path
    problem: str = ""
    name: str = ""
    version: str = ""
    simulated: bool = False
    people: int = 0
    recordings: int = 0
    excluded: int = 0
    streams: int = 0
    licence: str = ""
    contact_name: str = ""
    contact_mail: str = ""
    consent: str = ""
    columns: tuple[str, ...] = ()
    own_codes: tuple[str, ...] = ()
    own_dates: bool = False

    @classmethod
    def of(cls, path: Path) -> DatasetFacts:
        """Read it; a broken one becomes its ``problem``."""
        try:
            dataset = open_dataset(path)
            people = read_people(path)
        except PlushSenseError as refusal:
            return cls(path, problem=str(refusal))
        head = dataset.head
        columns = {c for p in people.values() for c in p.more} - set(PUBLIC_COLUMNS)
        return cls(
            path,
            name=head.name,
            version=head.version,
            simulated=head.simulated,
            people=len(dataset.subjects),
            recordings=len(dataset.recordings),
            excluded=len(dataset.recordings) - len(dataset.used),
            streams=len(dataset.streams),
            licence=head.licence,
            contact_name=head.about.contact.name,
            contact_mail=head.about.contact.email,
            consent=head.consent,
            columns=tuple(sorted(columns)),
            own_codes=tuple(s for s in dataset.subjects if not is_drawn(s)),
            own_dates=any(0 < r.epoch_ms < _MOVED_MS for r in dataset.recordings),
        )


@dataclass(frozen=True)
class PackageFacts:
    """A package of the house: its folder, its zip, or both.

    ``contents``: folders (with "/") and files of the top with (files, bytes). ``reidentification``: the figures of the
    report; {} where nobody looked.
    """

    name: str
    folder: Path | None
    zip: Path | None
    citation: str = ""
    title: str = ""
    simulated: bool = False
    reidentification: dict[str, Any] = field(default_factory=dict)
    contents: dict[str, tuple[int, int]] = field(default_factory=dict)
    made_s: float = 0.0

    @property
    def place(self) -> Path:
        """What is proved: the zip, which is what leaves, where there is one."""
        found = self.zip or self.folder
        assert found is not None
        return found

    @classmethod
    def of(cls, house: House, name: str) -> PackageFacts:
        """Read it; what cannot be read is left empty, and the validators say why."""
        folder, packed = house.folder / PACKAGES / name, house.folder / PACKAGES / f"{name}.zip"
        there = folder if (folder / CHECKSUMS).is_file() else None
        zipped = packed if packed.is_file() else None
        croissant = _load(there, zipped, as_croissant.FILE)
        made = [p.stat().st_mtime for p in (there, zipped) if p is not None]
        return cls(
            name,
            there,
            zipped,
            str(croissant.get("citeAs", "")),
            str(croissant.get("name", "")),
            _has(there, zipped, SIMULATION_MARK),
            _load(there, zipped, REIDENTIFICATION_JSON),
            _contents(there, zipped),
            max(made, default=0.0),
        )


def packages_of(house: House) -> list[str]:
    """The packages of the house by name, the newest first."""
    root = house.folder / PACKAGES
    found = {p.parent.name: p.stat().st_mtime for p in root.glob(f"*/{CHECKSUMS}") if not p.parent.name.startswith(".")}
    found |= {p.stem: p.stat().st_mtime for p in root.glob("*.zip") if p.is_file()}
    return sorted(found, key=lambda name: -found[name])


def missing_extras() -> list[str]:
    """The extras that are not installed here: ``publish``, without which nothing is published; ``baselines``, without
    which nobody looks whether people can be recognised."""
    return [extra for extra, modules in _TOOLS.items() if not all(importlib.util.find_spec(m) for m in modules)]


def _files(folder: Path | None, packed: Path | None) -> dict[str, int]:
    """Files below the package's top and their sizes."""
    if folder is not None:
        return {p.relative_to(folder).as_posix(): p.stat().st_size for p in files_of(folder)}
    if packed is not None:
        try:
            with zipfile.ZipFile(packed) as archive:
                return {i.filename.partition("/")[2]: i.file_size for i in archive.infolist() if not i.is_dir()}
        except (OSError, zipfile.BadZipFile):
            return {}
    return {}


def _contents(folder: Path | None, packed: Path | None) -> dict[str, tuple[int, int]]:
    grouped: dict[str, tuple[int, int]] = {}
    for path, size in _files(folder, packed).items():
        parts = path.split("/")
        # What is in the data folder is the point of it all: one level more.
        depth = min(len(parts) - 1, 2)
        top = "/".join(parts[:depth]) + "/" if depth else path
        files, total = grouped.get(top, (0, 0))
        grouped[top] = (files + 1, total + size)
    return dict(sorted(grouped.items(), key=lambda item: (not item[0].endswith("/"), item[0])))


def _has(folder: Path | None, packed: Path | None, file: str) -> bool:
    return (folder / file).is_file() if folder is not None else file in _files(None, packed)


def _load(folder: Path | None, packed: Path | None, file: str) -> dict[str, Any]:
    try:
        if folder is not None:
            found = json.loads((folder / file).read_text(encoding="utf-8"))
        elif packed is not None:
            with zipfile.ZipFile(packed) as archive:
                name = next(n for n in archive.namelist() if n.partition("/")[2] == file)
                found = json.loads(archive.read(name))
        else:
            return {}
    except (OSError, ValueError, StopIteration, zipfile.BadZipFile):
        return {}
    return found if isinstance(found, dict) else {}
