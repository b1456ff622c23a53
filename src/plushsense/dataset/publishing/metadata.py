"""Create the metadata of a package besides Croissant: RO-Crate, DataCite, Frictionless Data Package and Motion-BIDS.

``ro-crate-metadata.json`` describes every file (https://w3id.org/ro/crate), ``datacite.json`` and ``.xml`` are required
for a DOI, ``datapackage.json`` and ``schemas/`` describe the tables (https://specs.frictionlessdata.io): each CSV file
is a resource with its size, checksum and columns. Valid ranges are stated but not enforced, since the files contain
values outside of them.

``bids/`` is a tree similar to Motion-BIDS (Jeung et al., Scientific Data 2024):
``sub-P01/[ses-1/]motion/sub-P01_task-backstroke1_tracksys-toy_run-1_motion.tsv`` is one trimmed recording without a
header: one column per channel, and the time since its start. Beside it are ``_channels.tsv`` and ``_motion.json``. The
README in the tree lists the `DEVIATIONS` from the standard.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from plushsense.core.layouts import Channel
from plushsense.dataset.about import Creator
from plushsense.dataset.publishing.description import Description, PackageTable, TableColumn, fill_template
from plushsense.dataset.store import RecordingInfo

CRATE_FILE = "ro-crate-metadata.json"
_CRATE_CONFORMS_TO = "https://w3id.org/ro/crate/1.1"
_CONTACT = "#contact"


def crate(d: Description) -> dict[str, Any]:
    """Return the RO-Crate metadata as JSON-LD, with the files ``d.files``."""
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
        {"@id": _CONTACT, "@type": "ContactPoint", "contactType": "data set"} | asdict(d.about.contact),
    ]
    for identity, creator in creators:
        affiliation = {"affiliation": creator.affiliation} if creator.affiliation else {}
        graph.append({"@id": identity, "@type": "Person", "name": creator.name} | affiliation)
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
    """Return the DataCite metadata (schema 4)."""
    document: dict[str, Any] = {
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


def schemas(d: Description) -> dict[str, dict[str, Any]]:
    """Return the Frictionless schema of each table, by the path of its file."""
    return {_schema_path(table): _schema(table) for table in d.tables}


def datapackage(d: Description) -> dict[str, Any]:
    """Return the Frictionless descriptor of the package; ``d.files`` must contain the tables."""
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


BIDS = "bids"
BIDS_VERSION = "1.9.0"
TRACKSYS = "toy"
DEVIATIONS = (
    "each gesture is a task and each recording a run of it, where BIDS thinks of one long recording with events",
    "rows are as the toy sent them, not evenly spaced: the LATENCY channel says when, in seconds since the first row",
    "touch channels are of type MISC, since BIDS knows no touch; values are raw readings",
    "the toy's axes are relative to the toy, not to a person's body: no placement is given",
    "session streams are not here, only recordings; excluded recordings are not here, and trimmed rows are left out",
)
_TYPES = {"acceleration": "ACCEL", "angular rate": "GYRO"}


def write_bids(root: Path, d: Description) -> int:
    """Write the Motion-BIDS tree into ``root/bids`` and return the number of its recordings."""
    top = root / BIDS
    used = d.dataset.used
    people = sorted({r.subject for r in used})
    names = _letters(people, "x")
    tasks = _letters(list(dict.fromkeys(r.gesture for r in used)), "task")

    def by_number(session: str) -> tuple[int, str]:
        return int("".join(c for c in session if c.isdigit()) or 0), session

    sessions = {p: sorted({r.session for r in used if r.subject == p}, key=by_number) for p in people}
    runs: Counter[tuple[str, str, str]] = Counter()
    for r in used:
        several = len(sessions[r.subject]) > 1
        key = (r.subject, r.session, r.gesture)
        runs[key] += 1
        sub = f"sub-{names[r.subject]}"
        ses = f"ses-{sessions[r.subject].index(r.session) + 1}" if several else ""
        folder = top / sub / ses / "motion"
        folder.mkdir(parents=True, exist_ok=True)
        parts = (sub, ses, f"task-{tasks[r.gesture]}", f"tracksys-{TRACKSYS}", f"run-{runs[key]}")
        _write_run(folder / "_".join(filter(None, parts)), r, d)
    write_json(
        top / "dataset_description.json",
        {
            "Name": d.title,
            "BIDSVersion": BIDS_VERSION,
            "DatasetType": "raw",
            "License": d.licence.spdx,
            "Authors": [c.name for c in d.creators],
            "HowToAcknowledge": d.citation,
        },
    )
    rows = [f"sub-{names[p]}\t{p}" for p in people]
    write_text(top / "participants.tsv", "participant_id\tsubject\n" + "".join(row + "\n" for row in rows))
    write_json(
        top / "participants.json",
        {"subject": {"Description": "the person's code in subjects.csv, which describes the person"}},
    )
    write_text(top / "README", fill_template("bids_readme.txt.j2", d, deviations=DEVIATIONS))
    return len(used)


def _write_run(stem: Path, r: RecordingInfo, d: Description) -> None:
    """Write the three files of a recording, whose paths begin with ``stem``."""
    layout, frames = d.dataset.layout, d.dataset.read(r)
    since = (frames.device_ms - frames.device_ms[:1]) / 1000.0
    digits = [max(0, -int(np.floor(np.log10(c.step)))) for c in layout.channels]
    lines = []
    for time, row in zip(since.tolist(), frames.values.tolist(), strict=True):
        cells = [f"{v * c.step:.{n}f}" for v, c, n in zip(row, layout.channels, digits, strict=True)]
        lines.append("\t".join([*cells, f"{time:.3f}"]) + "\n")
    write_text(Path(f"{stem}_motion.tsv"), "".join(lines))
    table = ["name\tcomponent\ttype\ttracked_point\tunits\n"]
    table += [
        f"{c.name}\t{_component(c)}\t{_TYPES.get(c.kind, 'MISC')}\ttoy\t{c.unit or 'n/a'}\n" for c in layout.channels
    ]
    table.append("latency\tn/a\tLATENCY\tn/a\ts\n")
    write_text(Path(f"{stem}_channels.tsv"), "".join(table))
    counts = Counter(_TYPES.get(c.kind, "MISC") for c in layout.channels)
    write_json(
        Path(f"{stem}_motion.json"),
        {
            "TaskName": r.gesture,
            "TaskDescription": g.description if (g := d.dataset.gestures.find(r.gesture)) else "",
            "SamplingFrequency": layout.rate_hz,
            "SamplingFrequencyEffective": round(r.rate_hz, 3),
            "TrackingSystemName": TRACKSYS,
            "Manufacturer": "n/a",
            "DeviceSerialNumber": "n/a",
            "RecordingType": "discontinuous",
            "MotionChannelCount": layout.n_channels + 1,
            "LATENCYChannelCount": 1,
            **{f"{kind}ChannelCount": counts[kind] for kind in ("ACCEL", "GYRO", "MISC")},
        },
    )


def _component(channel: Channel) -> str:
    axis = next((part for part in channel.name.lower().split("_") if part in ("x", "y", "z")), "")
    return axis if axis and channel.kind in _TYPES else "n/a"


def _letters(words: list[str], empty: str) -> dict[str, str]:
    """Return for each word a distinct BIDS label of letters and digits; ``empty`` if nothing of the word is left."""
    labels: dict[str, str] = {}
    for word in words:
        plain = "".join(c for c in word if c.isascii() and c.isalnum()) or empty
        label, number = plain, 2
        while label.casefold() in {v.casefold() for v in labels.values()}:
            label, number = f"{plain}x{number}", number + 1
        labels[word] = label
    return labels


def write_json(path: Path, table: dict[str, Any]) -> None:
    """Write a JSON file of the package."""
    write_text(path, json.dumps(table, ensure_ascii=False, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file of the package, with the same line endings on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")
