"""The package as DataCite 4.5 metadata (https://schema.datacite.org/meta/kernel-4.5): what a DOI is registered with."""

from __future__ import annotations

from typing import Any

from plushsense.dataset.publish.description import Description

FILE = "datacite.json"
XML_FILE = "datacite.xml"
SCHEMA_VERSION = "http://datacite.org/schema/kernel-4"
# DataCite's own word for what nobody said.
UNAVAILABLE = ":unav"


def datacite(d: Description) -> dict[str, Any]:
    """The metadata as JSON."""
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
