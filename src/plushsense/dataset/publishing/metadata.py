"""Create the metadata of a package besides Croissant: DataCite and the Frictionless Data Package.

``datacite.json`` is required for a DOI. ``datapackage.json`` and ``schemas/`` describe the tables
(https://specs.frictionlessdata.io): each CSV file is a resource with its size, checksum and columns. Valid ranges are
stated but not enforced, since the files contain values outside of them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from plushsense.dataset.about import Creator
from plushsense.dataset.publishing.description import Description, PackageTable, TableColumn

DATACITE_FILE = "datacite.json"
SCHEMA_VERSION = "http://datacite.org/schema/kernel-4"
# DataCite's code for an unknown value.
UNAVAILABLE = ":unav"


def datacite(d: Description) -> dict[str, object]:
    """Return the DataCite metadata (schema 4)."""
    document: dict[str, object] = {
        "schemaVersion": SCHEMA_VERSION,
        "types": {"resourceTypeGeneral": "Dataset", "resourceType": "Touch gesture recordings"},
        "creators": [_person(c) for c in d.creators],
        "contributors": [{"name": d.about.contact.name, "contributorType": "ContactPerson"}],
        "titles": [{"title": d.title}],
        "publisher": {"name": d.about.publisher or UNAVAILABLE},
        "publicationYear": d.published[:4],
        "dates": [{"date": d.published, "dateType": "Issued"}],
        "language": d.about.language,
        "subjects": [{"subject": word} for word in dict.fromkeys(d.keywords)],
        "descriptions": [{"description": d.text, "descriptionType": "Abstract"}],
        "rightsList": [
            {
                "rights": d.licence.title,
                "rightsUri": d.licence.url,
                "rightsIdentifier": d.licence.spdx,
                "rightsIdentifierScheme": "SPDX",
            }
        ],
        "formats": ["text/csv"],
        "sizes": [f"{len(d.dataset.recordings)} recordings"],
        "version": d.version,
    }
    if d.about.doi:
        document["doi"] = d.about.doi
    if d.about.paper:
        document["relatedIdentifiers"] = [
            {"relatedIdentifier": d.about.paper, "relatedIdentifierType": "DOI", "relationType": "IsDescribedBy"}
        ]
    if d.about.funding:
        document["fundingReferences"] = [
            {"funderName": f.funder} | ({"awardNumber": f.award} if f.award else {}) for f in d.about.funding
        ]
    return document


def _person(creator: Creator) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": creator.name}
    if ", " in creator.name:
        family, _, given = creator.name.partition(", ")
        entry |= {"nameType": "Personal", "familyName": family, "givenName": given}
    if creator.orcid:
        orcid = {"nameIdentifierScheme": "ORCID", "schemeUri": "https://orcid.org"}
        entry["nameIdentifiers"] = [{"nameIdentifier": f"https://orcid.org/{creator.orcid}"} | orcid]
    if creator.affiliation:
        entry["affiliation"] = [{"name": creator.affiliation}]
    return entry


DATAPACKAGE_FILE = "datapackage.json"
SCHEMAS = "schemas"


def schemas(d: Description) -> dict[str, dict[str, object]]:
    """Return the Frictionless schema of each table, by the path of its file."""
    return {_schema_path(table): _schema(table) for table in d.tables}


def datapackage(d: Description) -> dict[str, object]:
    """Return the Frictionless descriptor of the package; ``d.files`` must contain the tables."""
    resources = []
    for table in d.tables:
        for number, path in enumerate(table.paths):
            file = d.files[path]
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
    document: dict[str, object] = {
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


def _schema_path(table: PackageTable) -> str:
    return f"{SCHEMAS}/{table.name}.json"


def _schema(table: PackageTable) -> dict[str, object]:
    made: dict[str, object] = {"fields": [_field(table, c) for c in table.columns], "missingValues": [""]}
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


def _field(table: PackageTable, column: TableColumn) -> dict[str, Any]:
    made: dict[str, Any] = {"name": column.name, "type": column.kind, "description": column.text}
    if column.unit:
        made["unit"] = column.unit
    if column.valid:
        made["valid_min"], made["valid_max"] = column.valid
    if column.name == table.key:
        made["constraints"] = {"required": True, "unique": True}
    return made


def write_json(path: Path, table: dict[str, object]) -> None:
    """Write a JSON file of the package."""
    write_text(path, json.dumps(table, ensure_ascii=False, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file of the package, with the same line endings on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")
