"""Create the Croissant metadata of a package (``croissant.json``), and compare what mlcroissant loads with the files.

Each loaded value is compared with its text in the CSV file.
"""

from __future__ import annotations

import csv
import glob
import itertools
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.dataset.publishing.description import (
    DATA,
    INTEGER,
    NUMBER,
    TEXT,
    YES_NO,
    Description,
    FileEntry,
    PackageTable,
    TableColumn,
)
from plushsense.dataset.store import RECORDINGS, STREAMS

CROISSANT_FILE = "croissant.json"
CONTEXT = "croissant_context.json"
CROISSANT_CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
FILE_FIELD = "file"

_TYPES = {INTEGER: "cr:Int64", NUMBER: "cr:Float64", TEXT: "sc:Text", YES_NO: "sc:Boolean"}


def croissant(d: Description) -> dict[str, object]:
    """Return the metadata as JSON-LD; ``d.files`` must contain the tables, whose checksums are included."""
    people = [
        {"@type": "sc:Person", "name": c.name}
        | ({"url": f"https://orcid.org/{c.orcid}"} if c.orcid else {})
        | ({"description": c.affiliation} if c.affiliation else {})
        for c in d.creators
    ]
    document: dict[str, object] = {
        # The context in full instead of its address, so that readers need not fetch it.
        "@context": json.loads(resources.files("plushsense.dataset.publishing").joinpath(CONTEXT).read_text("utf-8")),
        "@type": "sc:Dataset",
        "name": d.title,
        "description": d.text,
        "conformsTo": CROISSANT_CONFORMS_TO,
        "license": d.licence.url,
        "version": d.version,
        "datePublished": d.published,
        "citeAs": d.citation,
        "creator": people,
        "keywords": list(d.keywords),
        "inLanguage": d.about.language,
        "isLiveDataset": False,
        "rai:dataCollection": d.about.collected or "Recorded with PlushSense: see README.md.",
        "rai:personalSensitiveInformation": (
            "None: a simulation." if d.simulated else f"Touch recordings of people under codes. Consent: {d.consent}"
        ),
        "rai:dataLimitations": " ".join([d.about.limits, *d.notes]).strip() or "See README.md.",
        "distribution": [_distribution(t, d.files) for t in d.tables],
        "recordSet": [_record_set(t) for t in d.tables],
    }
    if d.url:
        document["url"] = d.url
    if d.about.publisher:
        document["publisher"] = {"@type": "sc:Organization", "name": d.about.publisher}
    return document


def _source_id(table: PackageTable) -> str:
    return table.file or f"{table.name}-files"


def _distribution(table: PackageTable, files: Mapping[str, FileEntry]) -> dict[str, Any]:
    described = {"@id": _source_id(table), "name": _source_id(table), "description": table.text}
    if not table.file:
        return {"@type": "cr:FileSet"} | described | {"encodingFormat": "text/csv", "includes": table.glob}
    return {
        "@type": "cr:FileObject",
        **described,
        "contentUrl": table.file,
        "contentSize": f"{files[table.file].bytes} B",
        "encodingFormat": "text/csv",
        "sha256": files[table.file].sha256,
    }


def _record_set(table: PackageTable) -> dict[str, Any]:
    fields = [_field(table, column) for column in table.columns]
    if not table.file:
        path = TableColumn(FILE_FIELD, TEXT, "the file in which the row stands, from the root of the package")
        fields.insert(0, _field(table, path, {"fileProperty": "fullpath"}))
    made: dict[str, Any] = {
        "@type": "cr:RecordSet",
        "@id": table.name,
        "name": table.name,
        "description": table.text,
        "field": fields,
    }
    if table.key:
        made["key"] = {"@id": f"{table.name}/{table.key}"}
    return made


def _field(table: PackageTable, column: TableColumn, extract: dict[str, str] | None = None) -> dict[str, Any]:
    unit = f" [{column.unit}]" if column.unit else ""
    # No `references`, though `refers` names some: mlcroissant would load no records when they are read once more.
    return {
        "@type": "cr:Field",
        "@id": f"{table.name}/{column.name}",
        "name": column.name,
        "description": f"{column.text}{unit}",
        "dataType": _TYPES[column.kind],
        "source": {
            "fileObject" if table.file else "fileSet": {"@id": _source_id(table)},
            "extract": extract or {"column": column.name},
        },
    }


ReportProblem = Callable[[str, str], None]


def compare_records(loaded: Any, root: Path, stream_rows: int, report: ReportProblem) -> dict[str, int]:
    """Load every record set, compare each value with its text in the files, and return the number of compared records.

    Args:
        loaded: the `mlcroissant.Dataset` of the package in ``root``; which files its streams include is changed.
        stream_rows: number of rows to compare from the beginning of each stream.
        report: called with a file and its problem.
    """
    by_id = {node.uuid: node for node in loaded.metadata.distribution}
    unloaded, compared = {*_files(root, RECORDINGS), *_files(root, STREAMS)}, Counter[str]()
    for record_set in loaded.metadata.record_sets:
        name = record_set.uuid
        source = by_id[next(f.source.uuid for f in record_set.fields)]
        if type(source).__name__ == "FileObject":
            parts: list[list[str]] = [[source.content_url]]
        else:
            # Load one stream at a time, so that only its beginning is parsed.
            parts = [_files(root, RECORDINGS)] if name == "samples" else [[file] for file in _files(root, STREAMS)]
        for files in parts:
            limit = stream_rows if name == "stream-samples" else None
            if limit is not None:
                source.includes = [glob.escape(files[0])]
            records = itertools.islice(iter(loaded.records(name)), limit)
            compared[name] += _compare(name, records, root, files, limit, report)
            unloaded -= set(files)
    for file in sorted(unloaded):
        report(file, "is in no record set of croissant.json")
    return dict(compared)


def _files(root: Path, top: str) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in (root / DATA / top).rglob("*.csv"))


def _compare(
    name: str,
    records: Iterable[dict[str, Any]],
    root: Path,
    files: list[str],
    limit: int | None,
    report: ReportProblem,
) -> int:
    """Compare records with the rows of their files, in any order of files; return the number of records."""
    # The rows of a single file do not state it.
    key = f"{name}/{FILE_FIELD}" if set(files) - {f"{name}.csv"} else ""
    remaining, compared = set(files), 0
    for value, group in itertools.groupby(records, key=lambda record: record.get(key, files[0])):
        file = str(_plain(value))
        if file not in remaining:
            report(file, f"'{name}' loads it, but it is not in the data")
            continue
        remaining.remove(file)
        loaded = [{k.rpartition("/")[2]: v for k, v in record.items() if k != key} for record in group]
        compared += len(loaded)
        with (root / file).open(encoding="utf-8", newline="") as table:
            rows = list(itertools.islice(csv.DictReader(table), limit))
        if problem := _difference(name, loaded, rows):
            report(file, problem)
    for file in sorted(remaining):
        report(file, f"'{name}' does not load it")
    return compared


def _difference(name: str, loaded: list[dict[str, Any]], rows: list[dict[str, str]]) -> str:
    """Return how the records of a file differ from its rows; "" if they are equal."""
    if len(loaded) != len(rows):
        return f"holds {len(rows)} rows; '{name}' loads {len(loaded)} records"
    for number, (record, row) in enumerate(zip(loaded, rows, strict=True), 1):
        if record.keys() != row.keys():
            return f"has the columns {', '.join(map(str, row))}; a record of '{name}' has {', '.join(record)}"
        for column, value in record.items():
            if not _same(value, row[column]):
                return f"row {number} has {column} {row[column]!r}; as a record of '{name}' it is {_plain(value)!r}"
    return ""


def _plain(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _same(value: Any, text: str) -> bool:
    value = _plain(value)
    if value is None or text is None:
        return value is None and text == ""
    if isinstance(value, bool | np.bool_):
        return text == ("true" if value else "false")
    if isinstance(value, str):
        return value == text
    try:
        return bool(value == (int(text) if isinstance(value, int | np.integer) else float(text)))
    except ValueError:
        return False
