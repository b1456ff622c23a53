"""Publish a data set as a package: require a complete description, write all files, and validate them.

`copy_dataset` writes only the data set of a package, for people who work with PlushSense.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import date
from functools import partial
from pathlib import Path

from plushsense.core.errors import DatasetError, need
from plushsense.core.files import new_folder
from plushsense.core.gestures import NOBODY
from plushsense.core.recorder_csv import SIMULATION_MARK
from plushsense.core.sentences import Message
from plushsense.dataset.about import Contact
from plushsense.dataset.files import list_package_files
from plushsense.dataset.index import open_dataset, write_index_files
from plushsense.dataset.publishing.checking import EXTRA, StageProgress, ValidationResult, check_folder
from plushsense.dataset.publishing.contents import (
    ContentsSpec,
    ContentsWriter,
    PackageContents,
    person_codes,
    refuse_traces,
)
from plushsense.dataset.publishing.croissant import CROISSANT_FILE, croissant
from plushsense.dataset.publishing.description import (
    DATA,
    LICENCE,
    README,
    REIDENTIFICATION,
    REIDENTIFICATION_JSON,
    SIMULATION,
    Description,
    file_entry,
    fill_template,
    find_licence,
    readme,
)
from plushsense.dataset.publishing.metadata import (
    DATACITE_FILE,
    DATAPACKAGE_FILE,
    datacite,
    datapackage,
    schemas,
    write_json,
    write_text,
)
from plushsense.dataset.publishing.tables import write_checksums, write_tables, write_zip
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, Dataset, DatasetHead, PersonInfo

# In smaller groups, age group and gender alone could identify a person.
FEWEST_ALIKE = 3
_VERSION = re.compile(r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)([-+][0-9A-Za-z.+-]+)?")
_LICENCE_FILES = ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "LICENCE.txt", "COPYING")


@dataclass(frozen=True)
class Reidentification:
    """Result of the test whether people can be recognised: a report, its short form, and its figures."""

    report: str
    short: str
    figures: dict[str, object]


@dataclass
class PublishResult:
    """Result of publishing; ``zip`` is None if the package is not valid."""

    folder: Path
    zip: Path | None
    files: int
    bytes: int
    description: Description
    checked: ValidationResult
    seconds: float
    warnings: list[Message] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Whether every validator accepts the package."""
        return self.checked.valid

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        d = self.description
        return {
            "package": str(self.folder),
            "zip": str(self.zip) if self.zip else None,
            "files": self.files,
            "bytes": self.bytes,
            "zip_bytes": self.zip.stat().st_size if self.zip else None,
            "recordings": len(d.dataset.recordings),
            "subjects": len(d.dataset.subjects),
            "streams": len(d.dataset.streams),
            "simulated": d.simulated,
            "notes": list(d.notes),
            "warnings": self.warnings,
            "sentences": [sentence.to_json() for sentence in (*self.warnings, *d.notes)],
            "seconds": round(self.seconds, 1),
            **self.checked.to_dict(),
        }


def complete_head(
    head: DatasetHead, where: Path, licence: str = "", contact: str = "", consent: str = ""
) -> DatasetHead:
    """Return ``head`` with the given values that are not empty; ``where`` is its folder in messages.

    Raises:
        DatasetError: if licence, contact or consent statement is missing, or a value invalid.
    """
    about = replace(head.about, contact=Contact.parse(contact)) if contact else head.about
    head = replace(head, about=about, licence=licence or head.licence, consent=consent.strip() or head.consent)
    contact_line = 'in a table [about]  contact = { name = "Your Name", email = "you@example.org" }'
    hints = [
        (head.licence, 'licence = "CC-BY-4.0"', "--licence CC-BY-4.0"),
        (head.consent.strip(), 'consent = "what the people agreed to"', '--consent "what the people agreed to"'),
        (head.about.contact, contact_line, '--contact "Your Name <you@example.org>"'),
    ]
    if missing := [(line, flag) for value, line, flag in hints if not value]:
        lines, flags = zip(*missing, strict=True)
        raise DatasetError(
            "'{where}' cannot be published without licence, contact and consent statement: set in '{path}'  {lines}  "
            "or give  {flags}",
            where=where,
            path=where / HEAD,
            lines="  and  ".join(lines),
            flags=" ".join(flags),
        )
    if not _VERSION.fullmatch(head.version):
        raise DatasetError(
            "'{path}' has the version '{version}': three numbers are accepted, like 1.0.0.",
            path=where / HEAD,
            version=head.version,
        )
    return replace(head, licence=find_licence(head.licence).spdx)


def missing_statements(head: DatasetHead) -> list[str]:
    """Return which of title, description, creators, licence, contact and consent a data set does not state yet.

    A package can be made without the first three, but then nobody is cited but the contact (see `PublishResult`).
    """
    about = head.about
    given = {
        "title": about.title.strip(),
        "description": about.description.strip(),
        "creators": about.creators,
        "licence": head.licence,
        "contact": about.contact,
        "consent": head.consent.strip(),
    }
    return [key for key, value in given.items() if not value]


def require_validators() -> None:
    """Raise MissingExtraError if a validator is not installed."""
    for module in ("mlcroissant", "frictionless", "datacite", "jinja2"):
        need(module, EXTRA)


def check_output_folder(dataset: Dataset, out: Path, repeatable: bool = True) -> Path:
    """Check the target folder ``out`` and return the path of the zip beside it.

    Args:
        repeatable: whether the zip may exist, because the package may have the same bytes. Without a key it cannot.

    Raises:
        DatasetError: if ``out`` is not empty or lies in the data set, or the zip exists and may not.
    """
    real = _refuse_place(dataset, out)
    target = real.with_name(real.name + ".zip")
    if target.exists() and not repeatable:
        raise DatasetError(
            "'{path}' exists without its folder: give another OUT, or delete this zip if an interrupted publication "
            "has left it; nothing is overwritten.",
            path=target,
        )
    return target


def _refuse_place(dataset: Dataset, out: Path) -> Path:
    """Return the resolved ``out``; raise DatasetError if it is not empty or lies in the data set."""
    real = out.resolve()
    if real.exists() and (not real.is_dir() or any(real.iterdir())):
        raise DatasetError(
            "'{path}' already holds something: give a new or empty folder, nothing is overwritten.", path=out
        )
    if dataset.path.resolve() in (real, *real.parents):
        raise DatasetError(f"'{out}' lies in the data set itself: give a folder elsewhere.")
    return real


@dataclass(frozen=True)
class PackageSpec:
    """What to write into a package.

    Attributes:
        contents: what to publish of the data set.
        reidentification: None leaves the report out, which the README then states.
        published: the day of publication in ISO format; today by default.
    """

    contents: ContentsSpec = field(default_factory=ContentsSpec)
    reidentification: Reidentification | None = None
    published: str = ""


def publish(
    dataset: Dataset,
    out: Path,
    head: DatasetHead,
    spec: PackageSpec | None = None,
    progress: StageProgress | None = None,
) -> PublishResult:
    """Write the package into the new folder ``out``, validate it, and pack it as ``out.zip`` if it is valid.

    The folder appears last, so that the same call can be given again until it does.

    Args:
        head: the head from `complete_head`.
        progress: called with the name of the stage, the work done and its total.

    Raises:
        DatasetError: as in `check_output_folder`, or if the data set cannot be published.
        MissingExtraError: if a validator is not installed.
    """
    began = time.perf_counter()
    require_validators()
    spec = spec or PackageSpec()
    progress = progress or (lambda step, done, total: None)
    target = check_output_folder(dataset, out)
    with ExitStack() as failed:
        with new_folder(out, DatasetError, finishing=dataset.generation.writing) as work:
            contents = ContentsWriter(dataset, work / DATA, head, spec.contents, partial(progress, "writing")).write()
            d = _write_metadata(work, dataset, contents, spec)
            if spec.contents.pseudonyms:
                refuse_traces(work, person_codes(dataset))
            checked = check_folder(work, progress=progress)
            if checked.valid:
                existed = target.exists()
                write_zip(work, target, dataset.generation.writing)
                if not existed:
                    # A zip without its folder would be in the way of the next call, or have a person removed since.
                    failed.callback(target.unlink, missing_ok=True)
        failed.pop_all()
    files = list_package_files(out)
    return PublishResult(
        out,
        target if checked.valid else None,
        len(files),
        sum(f.stat().st_size for f in files),
        d,
        checked,
        time.perf_counter() - began,
        _warnings(dataset, d, contents.people),
    )


@dataclass(frozen=True)
class CopyResult:
    """Copy of a data set with shifted times; ``notes`` state what was left out or changed."""

    dataset: Dataset
    files: int
    notes: tuple[Message, ...]

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "out": str(self.dataset.path),
            "subjects": len(self.dataset.subjects),
            "recordings": len(self.dataset.recordings),
            "streams": len(self.dataset.streams),
            "files": self.files,
            "notes": list(self.notes),
            "sentences": [sentence.to_json() for sentence in self.notes],
        }


def copy_dataset(dataset: Dataset, out: Path, spec: ContentsSpec, progress: StageProgress | None = None) -> CopyResult:
    """Write the data set that a package would contain into the new folder ``out``, without metadata and validators.

    Raises:
        DatasetError: as in `publish`.
    """
    _refuse_place(dataset, out)
    steps = partial(progress, "writing") if progress is not None else lambda done, total: None
    with new_folder(out, DatasetError, last=HEAD, finishing=dataset.generation.writing) as work:
        contents = ContentsWriter(dataset, work, dataset.head, spec, steps).write()
        if spec.pseudonyms:
            refuse_traces(work, person_codes(dataset))
        files = len(list_package_files(work))
        # Without an index, opening the copy would write one, and leave the file of its lock there.
        write_index_files(contents.dataset)
    return CopyResult(open_dataset(out), files, contents.notes)


def _write_metadata(work: Path, source: Dataset, contents: PackageContents, spec: PackageSpec) -> Description:
    """Write tables, texts and metadata files; each file exists before another one lists it."""
    head = contents.dataset.head
    d = Description(
        contents.dataset,
        find_licence(head.licence),
        head.about,
        head.consent,
        spec.published or date.today().isoformat(),
        write_tables(work, contents),
        contents.notes,
    )
    _write_texts(work, d, source, spec.reidentification)
    for path, schema in schemas(d).items():
        (work / path).parent.mkdir(exist_ok=True)
        write_json(work / path, schema)
    listed = replace(d, files={path: file_entry(work / path) for table in d.tables for path in table.paths})
    write_json(work / CROISSANT_FILE, croissant(listed))
    write_json(work / DATAPACKAGE_FILE, datapackage(listed))
    write_json(work / DATACITE_FILE, datacite(listed))
    write_checksums(work)
    return d


def _write_texts(work: Path, d: Description, source: Dataset, reidentification: Reidentification | None) -> None:
    write_text(work / README, readme(d, reidentification.short if reidentification else None))
    own = next((source.path / name for name in _LICENCE_FILES if (source.path / name).is_file()), None)
    text = own.read_text(encoding="utf-8", errors="replace") if own else fill_template("LICENSE.txt.j2", d)
    write_text(work / LICENCE, text)
    if d.simulated:
        write_text(work / SIMULATION_MARK, f"{SIMULATION}\n")
    if reidentification is not None:
        banner = f"**{SIMULATION}**\n\n" if d.simulated else ""
        write_text(work / REIDENTIFICATION, banner + reidentification.report)
        write_json(work / REIDENTIFICATION_JSON, reidentification.figures)


def _warnings(source: Dataset, d: Description, people: dict[str, PersonInfo]) -> list[Message]:
    groups = Counter((p.age_group, p.gender) for p in people.values() if p.age_group or p.gender)
    rare = sum(n for n in groups.values() if n < FEWEST_ALIKE)
    without_digit = [s for s in d.dataset.subjects if not any(c.isdigit() for c in s)]
    subjects = {r.subject for r in d.dataset.recordings}
    own_licence = any((source.path / name).is_file() for name in _LICENCE_FILES)
    warnings = {
        Message(
            "{n} people have an age group and gender that fewer than {least} people share, which alone may "
            "identify them: use coarser groups in subjects.csv",
            n=rare,
            least=FEWEST_ALIKE,
        ): rare > 0,
        Message(
            "subject codes are published as they are, and {n} hold no digit ('{code}'): if they are names, give "
            "--pseudonyms",
            n=len(without_digit),
            code=next(iter(without_digit), ""),
        ): bool(without_digit),
        Message(
            "{licence} requires its text in every copy: put it into the data set as LICENSE.txt", licence=d.licence.spdx
        ): d.licence.travels and not own_licence,
        Message(
            "the published title is the data set's name, '{name}', often that of the imported folder: check it, "
            "or set title in [about] in dataset.toml",
            name=source.head.name,
        ): not d.about.title,
        Message(
            "nobody is named as creator, so the contact is: add creators to [about] in dataset.toml"
        ): not d.about.creators,
        Message("the people of some recordings are not known, so they share one time shift"): UNKNOWN_SUBJECT
        in subjects,
        Message("no recording has a known person"): not subjects - {NOBODY, UNKNOWN_SUBJECT},
    }
    return [warning for warning, applies in warnings.items() if applies]
