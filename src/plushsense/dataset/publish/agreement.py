"""Whether a package agrees with itself: its tables with its data, its metadata files with one another.

Checksums can be made anew by whoever changes a file; what two places say of one thing must be changed in both.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from plushsense.core.recfile import SIMULATION_MARK
from plushsense.dataset.marks import MARKS
from plushsense.dataset.people import PEOPLE, read_people
from plushsense.dataset.publish import as_crate, as_croissant, as_datacite, as_datapackage
from plushsense.dataset.publish.contents import Contents
from plushsense.dataset.publish.description import DATA, Description
from plushsense.dataset.publish.licences import find_licence
from plushsense.dataset.publish.tables import tables_of
from plushsense.dataset.store import Dataset

Say = Callable[[str, str], None]
# A later PlushSense may word its findings otherwise.
_NOT_COMPARED = ("flags",)


def compare_tables(root: Path, dataset: Dataset, say: Say) -> None:
    """Every cell of the tables against what the data folder says."""
    contents = Contents(dataset, read_people(dataset.path), {}, ())
    for table, expected in tables_of(contents):
        with (root / table.file).open(encoding="utf-8", newline="") as file:
            have = _keyed(file, table.key)
        want = _keyed(io.StringIO(expected), table.key)
        for key in want.keys() - have.keys():
            say(table.file, f"'{key}' is in the data but not in the table")
        for key, row in have.items():
            if key not in want:
                say(table.file, f"'{key}' is in the table but not in the data")
                continue
            for column in [*want[key], *(c for c in row if c not in want[key])]:
                said, due = row.get(column), want[key].get(column)
                if said != due and column not in _NOT_COMPARED:
                    say(table.file, f"'{key}' has {column} {said!r}; the data say {due!r}")


def _keyed(file: Any, key: str) -> dict[str, dict[str, str]]:
    return {row.get(key) or "": row for row in csv.DictReader(file)}


def find_private(dataset: Dataset, say: Say) -> None:
    """What never leaves in a package that PlushSense made: who marked, when and why; references of consent forms."""
    if any(p.consent for p in read_people(dataset.path).values()):
        say(f"{DATA}/{PEOPLE}", "holds references of consent forms, which do not leave")
    path = dataset.path / MARKS
    for number, line in enumerate(path.read_bytes().splitlines() if path.is_file() else (), 1):
        try:
            mark = json.loads(line)
            told = [key for key in ("who", "why", "when") if mark.get(key)]
        except (ValueError, AttributeError):
            say(f"{DATA}/{MARKS}", f"line {number} is no mark")
            continue
        if told:
            say(f"{DATA}/{MARKS}", f"line {number} says {' and '.join(told)} of a mark, which does not leave")


def compare_metadata(root: Path, dataset: Dataset, load: Callable[[str], Any], say: Say) -> int:
    """Title, version, licence and day in every metadata file, against ``dataset.toml`` and one another.

    Returns:
        How many statements were compared.
    """
    head = dataset.head
    d = Description(dataset, find_licence(head.licence), head.about, head.consent, "", ())
    croissant, package, cited = (load(f) for f in (as_croissant.FILE, as_datapackage.FILE, as_datacite.FILE))
    crate = next((e for e in _get(load(as_crate.FILE), "@graph") or () if _get(e, "@id") == "./"), None)
    day = _get(cited, "dates", 0, "date")
    told = {
        as_croissant.FILE: {
            "title": (_get(croissant, "name"), d.title),
            "version": (_get(croissant, "version"), d.version),
            "licence": (_get(croissant, "license"), d.licence.url),
            "day": (_get(croissant, "datePublished"), day),
        },
        as_datapackage.FILE: {
            "title": (_get(package, "title"), d.title),
            "version": (_get(package, "version"), d.version),
            "licence": (_get(package, "licenses", 0, "name"), d.licence.spdx),
            "day": (_get(package, "created"), f"{day}T00:00:00Z"),
        },
        as_crate.FILE: {
            "title": (_get(crate, "name"), d.title),
            "version": (_get(crate, "version"), d.version),
            "licence": (_get(crate, "license", "@id"), d.licence.url),
            "day": (_get(crate, "datePublished"), day),
        },
        as_datacite.FILE: {
            "title": (_get(cited, "titles", 0, "title"), d.title),
            "version": (_get(cited, "version"), d.version),
            "licence": (_get(cited, "rightsList", 0, "rightsIdentifier"), d.licence.spdx),
        },
    }
    for file, statements in told.items():
        for what, (said, due) in statements.items():
            if said != due:
                say(file, f"its {what} is {said!r}; {DATA}/dataset.toml and the others say {due!r}")
    if (root / SIMULATION_MARK).is_file() != d.simulated:
        say(SIMULATION_MARK, f"{'is missing, though' if d.simulated else 'is there, but'} {DATA}/dataset.toml says "
            f"simulated = {str(d.simulated).lower()}")  # fmt: skip
    return sum(map(len, told.values())) + 1


def _get(table: Any, *path: str | int) -> Any:
    """A value in nested JSON; None where there is none."""
    for key in path:
        try:
            table = table[key]
        except (KeyError, IndexError, TypeError):
            return None
    return table
