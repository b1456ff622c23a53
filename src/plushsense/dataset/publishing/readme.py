"""The texts of a package, from the templates beside this file: README, licence note, README of the BIDS tree."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

from plushsense.core.templates import fill_text
from plushsense.dataset.publishing.description import DATA, SIMULATION, Description
from plushsense.dataset.store import RECORDINGS, STREAMS

README = "README.md"
LICENCE = "LICENSE.txt"
REIDENTIFICATION = "reidentification.md"
REIDENTIFICATION_JSON = "reidentification.json"

Rows = Sequence[tuple[str, ...]]


def licence_note(d: Description) -> str:
    """Return the text of LICENSE.txt where the data set brings no licence text of its own."""
    return _fill("LICENSE.txt.j2", d)


def bids_readme(d: Description, deviations: Sequence[str]) -> str:
    """Return the README of the BIDS tree, which lists how it deviates from the standard."""
    return _fill("bids_readme.txt.j2", d, deviations=deviations)


def readme(d: Description, reidentification: str | None) -> str:
    """Return the README in Markdown; ``reidentification`` is the report's short form, None if it was left out."""
    samples = next(t for t in d.tables if t.files)
    return _fill(
        "README.md.j2",
        d,
        facts=_facts(d),
        files=_files(d, reidentification is not None),
        columns=[(f"`{c.name}`", c.unit, c.text) for c in samples.columns],
        gestures=_gestures(d),
        findings=_findings(d),
        reidentification=reidentification,
        samples=samples,
        sample_folder=f"{DATA}/{STREAMS if d.dataset.layout.is_labelled else RECORDINGS}",
        DATA=DATA,
        REIDENTIFICATION=REIDENTIFICATION,
    )


def _facts(d: Description) -> Rows:
    data = d.dataset
    seconds = sum(s.seconds for s in data.streams)
    duration = f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.1f} min"
    return [
        ("version", f"{d.version}, {d.published}"),
        ("made by", "; ".join(c.name for c in d.creators)),
        ("people", str(len(data.subjects))),
        ("recordings", str(len(data.recordings))),
        ("gestures", f"{d.gestures_made}, of {len(data.gestures)} in the set"),
        ("session streams", f"{len(data.streams)}, {duration}" if data.streams else "none"),
        ("sensors", f"{data.layout.title}: {data.layout.n_channels} channels, nominally {data.layout.rate_hz:g} Hz"),
    ]


def _files(d: Description, reidentification: bool) -> Rows:
    rows = [(f"`{t.file or t.glob}`", t.text + (f", {len(t.files)} files" if t.files else "")) for t in d.tables]
    return [
        *rows,
        (f"`{DATA}/`", "a PlushSense data set: the recordings with layout, gesture set and marks"),
        ("`croissant.json`", "metadata for machine learning (Croissant 1.1)"),
        ("`datapackage.json`, `schemas/`", "metadata of the tables (Frictionless)"),
        ("`ro-crate-metadata.json`", "metadata of the files (RO-Crate 1.1)"),
        ("`datacite.json`, `datacite.xml`", "metadata for a DOI (DataCite 4.5)"),
        *([(f"`{REIDENTIFICATION}`, `.json`", "whether people can be recognised")] if reidentification else []),
        ("`checksums.sha256`", "of all files; check with  `sha256sum -c checksums.sha256`"),
    ]


def _gestures(d: Description) -> Rows:
    rows = []
    for g in d.dataset.gestures.gestures:
        mine = [r for r in d.dataset.recordings if r.gesture == g.label]
        free = " (free choice: everybody did something else)" if g.free_choice else ""
        rows.append((g.label + free, g.affect, g.family, str(len(mine)), str(len({r.subject for r in mine}))))
    return rows


def _findings(d: Description) -> Rows:
    counts: Counter[str] = Counter()
    for flags in [r.flags for r in d.dataset.recordings] + [s.flags for s in d.dataset.streams]:
        counts.update({_kind(flag) for flag in flags})
    return [(kind, str(n)) for kind, n in counts.most_common()]


def _kind(flag: str) -> str:
    """Return a finding without its numbers and names, so that like ones are counted together."""
    flag = re.sub(r"(the same content as) .*", r"\1 another", flag)
    return re.sub(r"\d[\d.]*", "n", flag.split(" (")[0]).replace("lines", "line").replace("gaps", "gap")


def _fill(template: str, d: Description, **values: Any) -> str:
    return fill_text("plushsense.dataset.publishing", template, d=d, SIMULATION=SIMULATION, **values)
