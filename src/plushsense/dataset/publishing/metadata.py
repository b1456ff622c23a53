"""Metadata of a package beside Croissant: RO-Crate, DataCite and Frictionless Data Package.

``ro-crate-metadata.json`` describes every file (https://w3id.org/ro/crate), ``datacite.json`` and ``.xml`` are what a
DOI needs, ``datapackage.json`` and ``schemas/`` describe the tables (https://specs.frictionlessdata.io): each CSV file
is a resource with its size, checksum and columns. Valid ranges are stated and not enforced, since values that a sensor
read outside of them are kept.
"""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from plushsense.dataset.publishing.description import Description, PackageTable, TableColumn

CRATE_FILE = "ro-crate-metadata.json"
_CRATE_CONFORMS_TO = "https://w3id.org/ro/crate/1.1"
_CONTACT = "#contact"


def crate(d: Description) -> dict[str, Any]:
    """Return RO-Crate metadata as JSON-LD; every file but this one and the checksums is part of the crate."""
    creators = [
        (f"https://orcid.org/{c.orcid}" if c.orcid else f"#creator-{i}", c) for i, c in enumerate(d.creators, 1)
    ]
    root: dict[str, Any] = {
        "@id": "./",
        "@type": "Dataset",
        "name": d.title,
        "description": d.text,
        "datePublished": d.published,
        "version": d.version,
        "license": {"@id": d.licence.url},
        "keywords": ", ".join(d.keywords),
        "author": [{"@id": identity} for identity, _ in creators],
        "contactPoint": {"@id": _CONTACT},
        "hasPart": [{"@id": quote(f.path)} for f in d.files],
    }
    if d.url:
        root["url"] = d.url
    if d.about.doi:
        root["identifier"] = f"https://doi.org/{d.about.doi}"
    if d.about.paper:
        root["citation"] = {"@id": f"https://doi.org/{d.about.paper}"}
    graph: list[dict[str, Any]] = [
        {"@id": CRATE_FILE, "@type": "CreativeWork", "conformsTo": {"@id": _CRATE_CONFORMS_TO}, "about": {"@id": "./"}},
        root,
        {"@id": d.licence.url, "@type": "CreativeWork", "name": d.licence.title, "identifier": d.licence.spdx},
        {
            "@id": _CONTACT,
            "@type": "ContactPoint",
            "contactType": "data set",
            "name": d.about.contact.name,
            "email": d.about.contact.email,
        },
    ]
    for identity, creator in creators:
        entry = {"@id": identity, "@type": "Person", "name": creator.name}
        if creator.affiliation:
            entry["affiliation"] = creator.affiliation
        graph.append(entry)
    if d.about.paper:
        graph.append({"@id": f"https://doi.org/{d.about.paper}", "@type": "ScholarlyArticle", "name": d.about.paper})
    graph += [
        {
            "@id": quote(f.path),
            "@type": "File",
            "name": f.path,
            "description": f.text,
            "encodingFormat": f.media,
            "contentSize": str(f.bytes),
            "sha256": f.sha256,
        }
        for f in d.files
    ]
    return {"@context": f"{_CRATE_CONFORMS_TO}/context", "@graph": graph}


DATACITE_FILE = "datacite.json"
DATACITE_XML_FILE = "datacite.xml"
SCHEMA_VERSION = "http://datacite.org/schema/kernel-4"
# DataCite's code for an unknown value.
UNAVAILABLE = ":unav"


def datacite(d: Description) -> dict[str, Any]:
    """Return DataCite metadata."""
    document: dict[str, Any] = {
        "schemaVersion": SCHEMA_VERSION,
        "types": {"resourceTypeGeneral": "Dataset", "resourceType": "Touch gesture recordings"},
        "creators": [_person(c.name, c.orcid, c.affiliation) for c in d.creators],
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


def _person(name: str, orcid: str, affiliation: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": name}
    if ", " in name:
        family, _, given = name.partition(", ")
        entry |= {"nameType": "Personal", "familyName": family, "givenName": given}
    if orcid:
        entry["nameIdentifiers"] = [
            {
                "nameIdentifier": f"https://orcid.org/{orcid}",
                "nameIdentifierScheme": "ORCID",
                "schemeUri": "https://orcid.org",
            }
        ]
    if affiliation:
        entry["affiliation"] = [{"name": affiliation}]
    return entry


DATAPACKAGE_FILE = "datapackage.json"
SCHEMAS = "schemas"


def schemas(d: Description) -> dict[str, dict[str, Any]]:
    """Return the table schemas by their files' paths."""
    return {_schema_path(table): _schema(table) for table in d.tables}


def datapackage(d: Description) -> dict[str, Any]:
    """Return the Frictionless descriptor."""
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


def _schema_path(table: PackageTable) -> str:
    return f"{SCHEMAS}/{table.name}.json"


def _schema(table: PackageTable) -> dict[str, Any]:
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


def _field(table: PackageTable, column: TableColumn) -> dict[str, Any]:
    made: dict[str, Any] = {"name": column.name, "type": column.kind, "description": column.text}
    if column.unit:
        made["unit"] = column.unit
    if column.valid:
        made["valid_min"], made["valid_max"] = column.valid
    if column.name == table.key:
        made["constraints"] = {"required": True, "unique": True}
    return made
