"""The package's README and licence note: what a stranger reads first."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from plushsense.dataset.publish.description import DATA, SIMULATION, Description
from plushsense.dataset.store import RECORDINGS, STREAMS

README = "README.md"
LICENCE = "LICENSE.txt"
REIDENTIFICATION = "reidentification.md"
REIDENTIFICATION_JSON = "reidentification.json"
NOT_LOOKED_AT = (
    "Whether the people can be told apart by their touch was **not looked at**: it was left out on request "
    "(`--no-reidentification`). Treat the recordings as personal data."
)


def licence_note(d: Description) -> str:
    """What stands in for a licence text that we did not write."""
    return (
        f"{d.title}, version {d.version}\n"
        f"Copyright {d.published[:4]} {'; '.join(c.name for c in d.creators)}\n\n"
        f"Licence: {d.licence.title} (SPDX: {d.licence.spdx})\n"
        f"Its text: {d.licence.url}\n"
    )


def readme(d: Description, reidentification: str | None) -> str:
    """The README, Markdown; ``reidentification`` is the report's short form, None where it was left out."""
    parts = [
        f"# {d.title}",
        f"**{SIMULATION}**" if d.simulated else "",
        d.text,
        _facts(d),
        "## How it was collected",
        d.about.collected or "Recorded with PlushSense or a recorder of its format, one gesture a recording.",
        f"Consent: {d.consent}",
        "## What is in it",
        _files(d, reidentification is not None),
        "## Columns",
        _columns(d),
        "## Gestures",
        _gestures(d),
        "## Times",
        _times(d),
        "## What was left out or changed",
        "\n".join(f"- {note}" for note in (*_always(d), *d.notes)),
        "## What the checks found",
        _findings(d),
        "## Can the people be recognised?",
        f"{reidentification} All of it: `{REIDENTIFICATION}`." if reidentification is not None else NOT_LOOKED_AT,
        "## How to load it",
        _loading(d),
        "## Limits",
        d.about.limits or "Nobody stated limits. Scores by people left out say more than scores over random windows.",
        "## How to cite",
        d.citation + (f"\n\nDescribed in: https://doi.org/{d.about.paper}" if d.about.paper else ""),
        "## Licence and contact",
        f"{d.licence.title} ({d.licence.spdx}): {d.licence.url}\n\n"
        f"{d.about.contact.name}, {d.about.contact.email}. Write there too if a recording of you should be withdrawn.",
        "\n".join(f"Funded by {f.funder}{f', {f.award}' if f.award else ''}." for f in d.about.funding),
    ]
    return "\n\n".join(p for p in parts if p) + "\n"


def _facts(d: Description) -> str:
    data = d.dataset
    seconds = sum(s.seconds for s in data.streams)
    rows = [
        ("version", f"{d.version}, {d.published}"),
        ("made by", "; ".join(c.name for c in d.creators)),
        ("people", str(len(data.subjects))),
        ("recordings", str(len(data.recordings))),
        ("gestures", f"{d.gestures_made}, of {len(data.gestures)} in the set"),
        ("session streams", f"{len(data.streams)}, {_duration(seconds)}" if data.streams else "none"),
        ("sensors", f"{data.layout.title}: {data.layout.n_channels} channels, nominally {data.layout.rate_hz:g} Hz"),
    ]
    return _table(("", ""), rows)


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.1f} min"


def _files(d: Description, reidentification: bool) -> str:
    rows = [(f"`{t.file or t.glob}`", t.text + (f", {len(t.files)} files" if t.files else "")) for t in d.tables]
    rows += [
        (f"`{DATA}/`", "a PlushSense data set: the recordings with layout, gesture set and marks"),
        ("`croissant.json`", "metadata for machine learning (Croissant 1.1)"),
        ("`datapackage.json`, `schemas/`", "metadata of the tables (Frictionless)"),
        ("`ro-crate-metadata.json`", "metadata of the files (RO-Crate 1.1)"),
        ("`datacite.json`, `datacite.xml`", "metadata for a DOI (DataCite 4.5)"),
        *([(f"`{REIDENTIFICATION}`, `.json`", "whether people can be recognised")] if reidentification else []),
        ("`checksums.sha256`", "of all files; check with  `sha256sum -c checksums.sha256`"),
    ]
    return _table(("file", "what"), rows)


def _columns(d: Description) -> str:
    samples = next(t for t in d.tables if t.files)
    return (
        "Of recordings and streams, CSV with a header line and commas:\n\n"
        + _table(("column", "unit", "what"), [(f"`{c.name}`", c.unit, c.text) for c in samples.columns])
        + "\n\nThe columns of the tables are described in `schemas/`."
    )


def _gestures(d: Description) -> str:
    rows = []
    for g in d.dataset.gestures.gestures:
        mine = [r for r in d.dataset.recordings if r.gesture == g.label]
        free = " (free choice: everybody did something else)" if g.free_choice else ""
        rows.append((g.label + free, g.affect, g.family, str(len(mine)), str(len({r.subject for r in mine}))))
    return _table(("gesture", "affect", "family", "recordings", "people"), rows)


def _times(d: Description) -> str:
    dates = (
        "All dates are fictitious: each person's recordings begin at a random instant of the year 2000, in file names "
        "and in the computer's clock alike. What lies between two times of one person is as it was, days between "
        "sessions included."
    )
    clock = (
        "The toy's clock (`device_ms`) is as recorded where it counts from when the toy was switched on. It tells how "
        "long the toy had been on, so people recorded without switching it off can be put in order; it tells no date. "
        "A toy's clock that holds dates is shifted like the computer's."
    )
    return f"{dates}\n\n{clock}"


def _always(d: Description) -> tuple[str, ...]:
    return (
        "Not here: the recorder's sidecar files and session logs, notes, device addresses, consent references, the "
        "original file and session names, and who made a mark, when and why.",
        "Files are written anew with plain columns; every value is the integer that was read, decimals in the steps of "
        "`channels.csv`. Lines that could not be read are left out.",
    )


def _findings(d: Description) -> str:
    found: Counter[str] = Counter()
    for flags in [r.flags for r in d.dataset.recordings] + [s.flags for s in d.dataset.streams]:
        found.update({_kind(flag) for flag in flags})
    if not found:
        return "Nothing."
    rows = [(kind, str(n)) for kind, n in found.most_common()]
    return "Known, and left as they are; which file is in the column `flags`.\n\n" + _table(
        ("finding", "recordings and streams"), rows
    )


def _kind(flag: str) -> str:
    """A finding without its numbers and names, so that like ones are counted together."""
    flag = re.sub(r"(the same content as) .*", r"\1 another", flag)
    return re.sub(r"\d[\d.]*", "n", flag.split(" (")[0]).replace("lines", "line").replace("gaps", "gap")


def _loading(d: Description) -> str:
    first = next(t for t in d.tables if t.files).files[0]
    many = d.dataset.layout.is_labelled
    places = f"{DATA}/{STREAMS}" if many else f"{DATA}/{RECORDINGS}"
    record_set = "stream-samples" if many else "samples"
    return f"""With PlushSense:

```python
import plushsense as ps
dataset = ps.open_dataset("{DATA}")
```

Without, all that is needed is in `recordings.csv` and below `{places}/`:

```python
import pandas as pd
recordings = pd.read_csv("recordings.csv")
one = pd.read_csv("{first}")
```

As Croissant:

```python
import mlcroissant as mlc
for row in mlc.Dataset("croissant.json").records("{record_set}"):
    ...
```"""


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    def line(cells: tuple[str, ...]) -> str:
        return "| " + " | ".join(c.replace("|", "\\|").replace("\n", " ") for c in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *(line(row) for row in rows)])
