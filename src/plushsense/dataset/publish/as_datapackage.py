"""The package as Frictionless Data Package (https://specs.frictionlessdata.io): ``datapackage.json`` and schemas.

Every CSV file is a resource with its size, checksum and the schema of its columns; valid ranges are told, not enforced,
since what a sensor read outside of them is kept.
"""

from __future__ import annotations

from typing import Any

from plushsense.dataset.publish.description import Column, Description, Table

FILE = "datapackage.json"
SCHEMAS = "schemas"


def schemas(d: Description) -> dict[str, dict[str, Any]]:
    """The table schemas by their files' paths."""
    return {_schema_path(table): _schema(table) for table in d.tables}


def datapackage(d: Description) -> dict[str, Any]:
    """The descriptor."""
    described = {f.path: f for f in d.files}
    resources = []
    for table in d.tables:
        for number, path in enumerate((table.file,) if table.file else table.files):
            file = described[path]
            resources.append(
                {
                    "name": table.name if table.file else f"{table.name}-{number:05d}",
                    "profile": "tabular-data-resource",
                    "type": "table",
                    "path": path,
                    "description": table.text,
                    "scheme": "file",
                    "format": "csv",
                    "mediatype": "text/csv",
                    "encoding": "utf-8",
                    "bytes": file.bytes,
                    "hash": f"sha256:{file.sha256}",
                    "schema": _schema_path(table),
                }
            )
    document: dict[str, Any] = {
        "profile": "tabular-data-package",
        "name": d.name,
        "title": d.title,
        "description": d.text,
        "version": d.version,
        "created": f"{d.published}T00:00:00Z",
        "licenses": [{"name": d.licence.spdx, "title": d.licence.title, "path": d.licence.url}],
        "contributors": [
            *({"title": c.name, "role": "author"} for c in d.creators),
            {"title": d.about.contact.name, "email": d.about.contact.email, "role": "contact"},
        ],
        "keywords": list(d.keywords),
        "resources": resources,
    }
    if d.url:
        document["homepage"] = d.url
    return document


def _schema_path(table: Table) -> str:
    return f"{SCHEMAS}/{table.name}.json"


def _schema(table: Table) -> dict[str, Any]:
    made: dict[str, Any] = {"fields": [_field(table, c) for c in table.columns], "missingValues": [""]}
    if table.key:
        made["primaryKey"] = [table.key]
    keys = [
        {"fields": [c.name], "reference": {"resource": c.refers.split(".")[0], "fields": [c.refers.split(".")[1]]}}
        for c in table.columns
        if c.refers
    ]
    if keys:
        made["foreignKeys"] = keys
    return made


def _field(table: Table, column: Column) -> dict[str, Any]:
    made: dict[str, Any] = {"name": column.name, "type": column.kind, "description": column.text}
    if column.unit:
        made["unit"] = column.unit
    if column.valid:
        made["valid_min"], made["valid_max"] = column.valid
    if column.name == table.key:
        made["constraints"] = {"required": True, "unique": True}
    return made
