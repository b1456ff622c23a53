"""Create the Croissant metadata of a package (``croissant.json``), and compare what mlcroissant loads with the files.

Each loaded value of a table is compared with its text, each row of a recording or stream with what PlushSense reads.
"""

from __future__ import annotations

import csv
import glob
import itertools
import json
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.layouts import DEVICE_MS, HOST_MS
from plushsense.core.recorder_csv import Frames, read_stream
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
from plushsense.dataset.store import Dataset

CROISSANT_FILE = "croissant.json"
CONTEXT = "croissant_context.json"
CROISSANT_CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
FILE_FIELD = "file"

_TYPES = {INTEGER: "cr:Int64", NUMBER: "cr:Float64", TEXT: "sc:Text", YES_NO: "sc:Boolean"}


def croissant(d: Description) -> dict[str, Any]:
    """Return the metadata as JSON-LD; ``d.files`` must contain the tables, whose checksums are included."""
    people = [
        {"@type": "sc:Person", "name": c.name}
        | ({"url": f"https://orcid.org/{c.orcid}"} if c.orcid else {})
        | ({"description": c.affiliation} if c.affiliation else {})
        for c in d.creators
    ]
    document: dict[str, Any] = {
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


def compare_records(
    loaded: Any, root: Path, dataset: Dataset, stream_rows: int | None, report: ReportProblem
) -> dict[str, int]:
    """Load every record set, compare it with the files, and return the number of compared records of each.

    Args:
        loaded: the `mlcroissant.Dataset` of the package; which files its streams include is changed.
        stream_rows: number of rows to compare from the beginning of each stream; None for all.
        report: called with a file and its problem.
    """
    by_id = {node.uuid: node for node in loaded.metadata.distribution}
    compared = {}
    loaded_files: set[str] = set()
    for record_set in loaded.metadata.record_sets:
        name = record_set.uuid
        source = by_id[next(f.source.uuid for f in record_set.fields)]
        if type(source).__name__ == "FileObject":
            compared[name] = _table(name, loaded.records(name), root / source.content_url, report)
            continue
        files = _files(dataset, name)
        loaded_files |= {file for file, _ in files}
        if stream_rows is None or name == "samples":
            compared[name] = _rows(name, loaded.records(name), files, dataset, None, report)
            continue
        compared[name] = 0
        for file in files:
            # Load one file at a time, so that only its beginning is parsed.
            source.includes = [glob.escape(file[0])]
            records = itertools.islice(iter(loaded.records(name)), stream_rows)
            compared[name] += _rows(name, records, [file], dataset, stream_rows, report)
    expected = {f for name in ("samples", "stream-samples") for f, _ in _files(dataset, name)}
    for absent in sorted(expected - loaded_files):
        report(absent, "is in no record set of croissant.json")
    return compared


def _files(dataset: Dataset, name: str) -> list[tuple[str, Path]]:
    streams = {s.file for s in dataset.streams}
    files = {r.file for r in dataset.recordings} - streams if name == "samples" else streams
    return [(f"{DATA}/{file}", dataset.path / file) for file in sorted(files)]


def _table(name: str, records: Iterable[dict[str, Any]], path: Path, report: ReportProblem) -> int:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    number = 0
    for number, record in enumerate(records, 1):
        if number > len(rows):
            continue
        problem = ""
        for key, value in record.items():
            column = key.rpartition("/")[2]
            text = rows[number - 1].get(column)
            if text is None or not _same(value, text):
                problem = f"row {number} has {column} {text!r}; as a record of '{name}' it is {_plain(value)!r}"
                break
        if not problem and len(record) != len(rows[0]):
            problem = f"has {len(rows[0])} columns; a record of '{name}' has {len(record)}"
        if problem:
            report(path.name, problem)
            return number
    if number != len(rows):
        report(path.name, f"holds {len(rows)} rows; '{name}' loads {number} records")
    return number


def _plain(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _same(value: Any, text: str) -> bool:
    value = _plain(value)
    if value is None:
        return text == ""
    if isinstance(value, bool | np.bool_):
        return text == ("true" if value else "false")
    if isinstance(value, str):
        return value == text
    try:
        return bool(value == (int(text) if isinstance(value, int | np.integer) else float(text)))
    except ValueError:
        return False


def _rows(
    name: str,
    records: Iterable[dict[str, Any]],
    files: list[tuple[str, Path]],
    dataset: Dataset,
    limit: int | None,
    report: ReportProblem,
) -> int:
    """Compare the rows of recordings or streams by file, in any order of files; return their number."""
    remaining = dict(files)
    compared = 0
    key = f"{name}/{FILE_FIELD}"
    for value, group in itertools.groupby(records, key=lambda record: record[key]):
        file = str(_plain(value))
        place = remaining.pop(file, None)
        rows = list(group)
        compared += len(rows)
        if place is None:
            report(file, f"'{name}' loads it, but it is not in the data")
            continue
        problem = _difference(rows, name, read_stream(place, dataset.layout).frames, dataset, limit)
        if problem:
            report(file, problem)
    for file in remaining:
        report(file, f"'{name}' does not load it")
    return compared


def _difference(
    rows: list[dict[str, Any]], name: str, frames: Frames, dataset: Dataset, limit: int | None
) -> str | None:
    """Return how the records ``rows`` differ from ``frames``; None if they are equal."""
    layout = dataset.layout
    n = len(frames) if limit is None else min(limit, len(frames))
    if len(rows) != n:
        return f"'{name}' loads {len(rows)} of its {n} rows"
    clocks = {DEVICE_MS: frames.device_ms, HOST_MS: frames.host_ms, "label": frames.labels}
    expected: dict[str, Any] = clocks | dict(zip(layout.names, frames.values.T, strict=True))
    steps = {c.name: c.step for c in layout.channels}
    for column, values in expected.items():
        if values is None:
            continue
        key = f"{name}/{column}"
        if key not in rows[0]:
            return f"'{name}' has no field '{column}'"
        loaded = [row[key] for row in rows]
        if column == "label":
            same = [_plain(v) for v in loaded] == values[:n].tolist()
        elif any(v is None for v in loaded):
            same = False
        elif steps.get(column, 1.0) == 1.0:
            same = np.array_equal(np.array(loaded, dtype=np.int64), values[:n])
        else:
            same = np.array_equal(np.round(np.array(loaded) / steps[column]), values[:n])
        if not same:
            return f"'{name}' loads other values of {column} than the file holds"
    return None
