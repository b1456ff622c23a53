"""The package as Croissant 1.1 (https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html): ``croissant.json``.

Record sets are the tables and, file by file, the rows of all recordings and streams. Join `recordings` to `samples` by
the file's path; no join is declared there, since a reader would then have to hold every row in memory.
"""

from __future__ import annotations

from typing import Any

from plushsense.dataset.publish.description import (
    INTEGER,
    NUMBER,
    TEXT,
    YES_NO,
    Column,
    Description,
    FileEntry,
    Table,
)

FILE = "croissant.json"
CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
FILE_FIELD = "file"

_TYPES = {INTEGER: "cr:Int64", NUMBER: "cr:Float64", TEXT: "sc:Text", YES_NO: "sc:Boolean"}
# The context that the specification gives, written out, so that no reader has to fetch it.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def croissant(d: Description) -> dict[str, Any]:
    """The metadata as JSON-LD; the tables' checksums come from ``d.files``."""
    files = {f.path: f for f in d.files}
    people = [_creator(c.name, c.orcid, c.affiliation) for c in d.creators]
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": d.title,
        "description": d.text,
        "conformsTo": CONFORMS_TO,
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
        "distribution": [_distribution(t, files) for t in d.tables],
        "recordSet": [_record_set(t) for t in d.tables],
    }
    if d.url:
        document["url"] = d.url
    if d.about.publisher:
        document["publisher"] = {"@type": "sc:Organization", "name": d.about.publisher}
    return document


def _creator(name: str, orcid: str, affiliation: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"@type": "sc:Person", "name": name}
    if orcid:
        entry["url"] = f"https://orcid.org/{orcid}"
    if affiliation:
        entry["description"] = affiliation
    return entry


def _source_id(table: Table) -> str:
    return table.file or f"{table.name}-files"


def _distribution(table: Table, files: dict[str, FileEntry]) -> dict[str, Any]:
    if not table.file:
        return {
            "@type": "cr:FileSet",
            "@id": _source_id(table),
            "name": _source_id(table),
            "description": table.text,
            "encodingFormat": "text/csv",
            "includes": table.glob,
        }
    return {
        "@type": "cr:FileObject",
        "@id": _source_id(table),
        "name": table.file,
        "description": table.text,
        "contentUrl": table.file,
        "contentSize": f"{files[table.file].bytes} B",
        "encodingFormat": "text/csv",
        "sha256": files[table.file].sha256,
    }


def _record_set(table: Table) -> dict[str, Any]:
    fields = [_field(table, column) for column in table.columns]
    if not table.file:
        path = Column(FILE_FIELD, TEXT, "the file in which the row stands, from the root of the package")
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


def _field(table: Table, column: Column, extract: dict[str, str] | None = None) -> dict[str, Any]:
    unit = f" [{column.unit}]" if column.unit else ""
    made: dict[str, Any] = {
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
    if column.refers:
        other, _, name = column.refers.partition(".")
        made["references"] = {"field": {"@id": f"{other}/{name}"}}
    return made
