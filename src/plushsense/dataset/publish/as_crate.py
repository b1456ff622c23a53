"""The package as RO-Crate 1.1 (https://www.researchobject.org/ro-crate/1.1/): ``ro-crate-metadata.json``."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from plushsense.dataset.publish.description import Description

FILE = "ro-crate-metadata.json"
CONFORMS_TO = "https://w3id.org/ro/crate/1.1"
_CONTACT = "#contact"


def crate(d: Description) -> dict[str, Any]:
    """The metadata as JSON-LD; every file but this one and the checksums is part of the crate."""
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
        {"@id": FILE, "@type": "CreativeWork", "conformsTo": {"@id": CONFORMS_TO}, "about": {"@id": "./"}},
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
    return {"@context": f"{CONFORMS_TO}/context", "@graph": graph}
