"""Validate a package by several validators, without network access; slow ones read only the first rows of streams.

checksums    every file exists and is unchanged, and there are no others
data         the recordings are readable, the tables agree with them, and nothing private is included
times        every time is shifted
metadata     title, version, licence and day are the same in every metadata file
croissant    mlcroissant accepts the metadata and loads exactly the values of the files
frictionless frictionless accepts the descriptor, and every cell has the type that its schema requires
datacite     the metadata agree with DataCite's schema
"""

from __future__ import annotations

import csv
import io
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from plushsense.core.errors import MissingExtraError, PlushSenseError, need
from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name, read_stream
from plushsense.dataset.files import list_package_files, sha256_of
from plushsense.dataset.index import IndexBuild, build_index
from plushsense.dataset.marks import MARKS
from plushsense.dataset.publishing.contents import LATEST_MS, WALL_CLOCK_MS, PackageContents
from plushsense.dataset.publishing.croissant import (
    CROISSANT_CONFORMS_TO,
    CROISSANT_FILE,
    compare_records,
)
from plushsense.dataset.publishing.description import CHECKSUMS, DATA, Description, find_licence
from plushsense.dataset.publishing.metadata import DATACITE_FILE, DATAPACKAGE_FILE
from plushsense.dataset.publishing.tables import build_tables, open_package, read_checksums
from plushsense.dataset.store import PEOPLE, DatasetHead, read_people

# Flags are not compared, since their wording may differ between versions.
_NOT_COMPARED = ("flags",)


def _keyed(file: Any, key: str) -> dict[str, dict[str, str]]:
    return {row.get(key) or "": row for row in csv.DictReader(file)}


def _get(table: Any, *path: str | int) -> Any:
    """Return a value in nested JSON; None if there is none."""
    for key in path:
        try:
            table = table[key]
        except (KeyError, IndexError, TypeError):
            return None
    return table


StageProgress = Callable[[str, int, int], None]
EXTRA = "publish"
# Number of rows of each stream that slow validators read.
STREAM_ROWS = 1000
SHOWN = 50
# Files that PlushSense may add to the data folder when it opens it.
_OWN = re.compile(rf"{DATA}/(recordings\.csv|streams\.csv|index\.json|[^/]+\.lock|cache/.*|evaluations/.*)")


@dataclass(frozen=True)
class Problem:
    """Problem that a validator found, and the file concerned ("" for the whole package)."""

    validator: str
    file: str
    problem: str

    def __str__(self) -> str:
        return f"{self.validator}: {f'{self.file}: ' if self.file else ''}{self.problem}"


@dataclass(frozen=True)
class ValidatorResult:
    """What a validator examined, the number of its problems, and its duration in s."""

    validator: str
    looked_at: str
    problems: int
    seconds: float


@dataclass
class ValidationResult:
    """Result of all validators."""

    problems: list[Problem] = field(default_factory=list)
    validators: list[ValidatorResult] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Whether no validator found a problem."""
        return not self.problems

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        validators, problems = ([vars(each) for each in listed] for listed in (self.validators, self.problems))
        return {"valid": self.valid, "validators": validators, "problems": problems}


@dataclass
class PackageView:
    """Package under validation, with the problems found by the current validator; slow results are cached."""

    root: Path
    packed: bool = False
    problems: list[tuple[str, str]] = field(default_factory=list)
    looked_at: str = ""

    def report(self, file: str, problem: str) -> None:
        """Add a problem, up to `SHOWN`."""
        if len(self.problems) < SHOWN:
            self.problems.append((file, problem))

    def load(self, file: str) -> Any:
        """Read a JSON file of the package; if it is unreadable, report a problem and return None."""
        try:
            return json.loads((self.root / file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as cause:
            self.report(file, f"cannot be read: {cause}")
            return None

    @cached_property
    def sums(self) -> dict[str, str]:
        """SHA-256 of every existing file by path."""
        return {p.relative_to(self.root).as_posix(): sha256_of(p) for p in list_package_files(self.root)}

    @cached_property
    def built(self) -> IndexBuild:
        """Index of the data folder, built from its raw files."""
        return build_index(self.root / DATA, DatasetHead.read(self.root / DATA))

    def is_own(self, path: str) -> bool:
        """Return whether PlushSense may have added a file when it opened the data folder; false for a zip."""
        return not self.packed and _OWN.fullmatch(path) is not None

    def is_local(self, path: object) -> bool:
        """Return whether a path in a metadata file is a relative path inside the package, not an address."""
        if not isinstance(path, str) or not path or ":" in path or "\\" in path:
            return False
        plain = PurePosixPath(path)
        return not plain.is_absolute() and ".." not in plain.parts


def validate_package(package: str | Path, *, progress: StageProgress | None = None) -> ValidationResult:
    """Validate a package (a folder or a zip); slow validators read the first `STREAM_ROWS` rows of each stream.

    Raises:
        DatasetError: if ``package`` is no package.
        MissingExtraError: if a validator is not installed.
    """
    with open_package(Path(package)) as root:
        return check_folder(root, packed=Path(package).is_file(), progress=progress)


def check_folder(root: Path, *, packed: bool = False, progress: StageProgress | None = None) -> ValidationResult:
    """Validate the folder of a package; ``packed`` is whether it was unpacked from a zip."""
    progress = progress or (lambda stage, done, total: None)
    checked = ValidationResult()
    package = PackageView(root, packed)
    for number, (name, validator) in enumerate(VALIDATORS.items()):
        progress(f"validating: {name}", number, len(VALIDATORS))
        began = time.perf_counter()
        package.problems, package.looked_at = [], ""
        try:
            validator(package)
        except MissingExtraError:
            raise
        except PlushSenseError as cause:
            package.report("", str(cause))
        except Exception as cause:  # noqa: BLE001, RUF100
            package.report("", f"the validator gave up: {type(cause).__name__}: {_short(cause)}")
        checked.problems += [Problem(name, file, problem) for file, problem in package.problems]
        seconds = round(time.perf_counter() - began, 2)
        checked.validators.append(ValidatorResult(name, package.looked_at, len(package.problems), seconds))
    progress("validating", len(VALIDATORS), len(VALIDATORS))
    return checked


def _short(cause: BaseException) -> str:
    inner = cause
    while inner.__cause__ is not None:
        inner = inner.__cause__
    return " ".join(str(inner).split())[:300]


def _checksums(p: PackageView) -> None:
    listed = read_checksums(p.root)
    for path, expected in listed.items():
        if path not in p.sums:
            p.report(path, "is missing")
        elif p.sums[path] != expected:
            p.report(path, f"was changed: its SHA-256 is {p.sums[path][:12]}…, not {expected[:12]}…")
        if (p.root / path).is_symlink():
            p.report(path, "is a link, which may lead out of the package")
    for path in sorted(p.sums.keys() - listed.keys()):
        if path != CHECKSUMS and not p.is_own(path):
            p.report(path, "is not listed in the checksums")
    p.looked_at = f"{len(listed)} files"


def _data(p: PackageView) -> None:
    for path, reason in p.built.unreadable.items():
        p.report(f"{DATA}/{path}", reason)
    dataset = p.built.dataset
    contents = PackageContents(dataset, read_people(dataset.path), {}, ())
    for table, expected in build_tables(contents):
        with (p.root / table.file).open(encoding="utf-8", newline="") as file:
            rows = _keyed(file, table.key)
        due_rows = _keyed(io.StringIO(expected), table.key)
        for key in due_rows.keys() - rows.keys():
            p.report(table.file, f"'{key}' is in the data but not in the table")
        for key, row in rows.items():
            if key not in due_rows:
                p.report(table.file, f"'{key}' is in the table but not in the data")
                continue
            for column in dict.fromkeys((*due_rows[key], *row)):
                value, due = row.get(column), due_rows[key].get(column)
                if value != due and column not in _NOT_COMPARED:
                    p.report(table.file, f"'{key}' has {column} {value!r}; the data say {due!r}")
    _report_private(p)
    p.looked_at = f"{len(dataset.recordings)} recordings, {len(dataset.streams)} streams"


def _report_private(p: PackageView) -> None:
    """Report private data: author, time and reason of marks, and references to consent forms."""
    folder = p.root / DATA
    if any(person.consent or person.more for person in read_people(folder).values()):
        p.report(f"{DATA}/{PEOPLE}", "holds references of consent forms, or other columns, which must not be published")
    path = folder / MARKS
    for number, line in enumerate(path.read_bytes().splitlines() if path.is_file() else (), 1):
        try:
            mark = json.loads(line)
            private = [key for key in ("who", "why", "when") if mark.get(key)]
        except (ValueError, AttributeError):
            p.report(f"{DATA}/{MARKS}", f"line {number} is no mark")
            continue
        if private:
            p.report(f"{DATA}/{MARKS}", f"line {number} holds {' and '.join(private)}, which must not be published")


_STATEMENTS: dict[str, dict[str, tuple[str | int, ...]]] = {
    CROISSANT_FILE: {"title": ("name",), "version": ("version",), "licence": ("license",), "day": ("datePublished",)},
    DATAPACKAGE_FILE: {
        "title": ("title",),
        "version": ("version",),
        "licence": ("licenses", 0, "name"),
        "day": ("created",),
    },
    DATACITE_FILE: {
        "title": ("titles", 0, "title"),
        "version": ("version",),
        "licence": ("rightsList", 0, "rightsIdentifier"),
    },
}


def _metadata(p: PackageView) -> None:
    """Compare title, version, licence and day in every metadata file with ``dataset.toml`` and each other."""
    dataset = p.built.dataset
    head = dataset.head
    d = Description(dataset, find_licence(head.licence), head.about, head.consent, "", ())
    documents = {file: p.load(file) for file in _STATEMENTS}
    day = _get(documents[DATACITE_FILE], "dates", 0, "date")
    for file, statements in _STATEMENTS.items():
        by_url = file == CROISSANT_FILE
        expected = {
            "title": d.title,
            "version": d.version,
            "licence": d.licence.url if by_url else d.licence.spdx,
            "day": day if by_url else f"{day}T00:00:00Z",
        }
        for key, path in statements.items():
            if (value := _get(documents[file], *path)) != expected[key]:
                p.report(file, f"its {key} is {value!r}; {DATA}/dataset.toml and the others state {expected[key]!r}")
    if (p.root / SIMULATION_MARK).is_file() != d.simulated:
        state = "is missing, though" if d.simulated else "exists, but"
        p.report(SIMULATION_MARK, f"{state} {DATA}/dataset.toml states simulated = {str(d.simulated).lower()}")
    p.looked_at = f"{sum(map(len, _STATEMENTS.values())) + 1} statements"


def _times(p: PackageView) -> None:
    dataset = p.built.dataset
    for path in p.sums:
        name = parse_name(path) if path.startswith(f"{DATA}/") else None
        if name is not None and name.epoch_ms >= LATEST_MS:
            p.report(path, f"its name contains the time {name.epoch_ms}, which is not shifted")
    for file in sorted({r.file for r in dataset.recordings} | {s.file for s in dataset.streams}):
        frames = read_stream(dataset.path / file, dataset.layout).frames
        if frames.host_ms is not None and int(frames.host_ms.max()) >= LATEST_MS:
            p.report(f"{DATA}/{file}", f"the computer's clock shows {int(frames.host_ms.max())}, which is not shifted")
        latest = int(frames.device_ms.max())
        if latest >= WALL_CLOCK_MS and latest >= LATEST_MS:
            p.report(f"{DATA}/{file}", f"the toy's clock shows {latest}, which is not shifted")
    p.looked_at = "every name and row"


def _croissant(p: PackageView) -> None:
    document = p.load(CROISSANT_FILE)
    if not isinstance(document, dict):
        return
    if not isinstance(document.get("@context"), dict):
        p.report(CROISSANT_FILE, "its @context must be written out: an address would be fetched")
        return
    if document.get("conformsTo") != CROISSANT_CONFORMS_TO:
        p.report(CROISSANT_FILE, f"it conforms to {document.get('conformsTo')!r}, not to {CROISSANT_CONFORMS_TO}")
    for entry in document.get("distribution", []):
        place = entry.get("contentUrl", entry.get("includes"))
        if not p.is_local(place):
            p.report(CROISSANT_FILE, f"'{entry.get('@id')}' lies at {place!r}, which is no path of the package")
        elif "sha256" in entry and p.sums.get(place) != entry["sha256"]:
            p.report(str(place), "has another SHA-256 than croissant.json states")
    if p.problems:
        return
    mlcroissant = need("mlcroissant", EXTRA)
    need("absl.logging", EXTRA).set_verbosity("error")
    loaded = mlcroissant.Dataset(str(p.root / CROISSANT_FILE))
    issues = loaded.metadata.ctx.issues
    for issue in sorted({*issues.errors, *issues.warnings}, key=str):
        p.report(CROISSANT_FILE, str(issue))
    records = compare_records(loaded, p.root, STREAM_ROWS, p.report)
    p.looked_at = ", ".join(f"{n} records of {name}" for name, n in records.items())


def _frictionless(p: PackageView) -> None:
    descriptor = p.load(DATAPACKAGE_FILE)
    if not isinstance(descriptor, dict):
        return
    for resource in descriptor.get("resources", []):
        for key in ("path", "schema"):
            if not p.is_local(resource.get(key)):
                p.report(
                    DATAPACKAGE_FILE, f"a resource has the {key} {resource.get(key)!r}: a path of the package only"
                )
    if p.problems:
        return
    frictionless = need("frictionless", EXTRA)
    package = frictionless.Package(str(p.root / DATAPACKAGE_FILE))
    rows = 0
    for resource in package.resources:
        limit = None
        if resource.path.startswith(f"{DATA}/streams/"):
            # Another validator checks the whole file; the checksum of its first rows would differ.
            limit, resource.hash, resource.bytes = STREAM_ROWS, None, None
        report = resource.validate(limit_rows=limit) if limit else resource.validate()
        for task in report.tasks:
            rows += task.stats.get("rows", 0)
            for error in [*task.errors][:SHOWN]:
                p.report(resource.path, error.message)
        for error in report.errors:
            p.report(resource.path, error.message)
    covered = {r.path for r in package.resources}
    for path in p.sums:
        if path.endswith(".csv") and path not in covered and not p.is_own(path) and path != f"{DATA}/{PEOPLE}":
            p.report(path, "is no resource of datapackage.json")
    p.looked_at = f"{len(package.resources)} resources, {rows} rows"


def _datacite(p: PackageView) -> None:
    document = p.load(DATACITE_FILE)
    if document is None:
        return
    schema = need("datacite.schema45", EXTRA)
    for error in sorted(schema.validator.iter_errors(document), key=lambda e: list(map(str, e.absolute_path))):
        where = "/".join(map(str, error.absolute_path))
        p.report(DATACITE_FILE, f"{f'{where}: ' if where else ''}{error.message[:300]}")
    p.looked_at = "schema 4.5"


VALIDATORS: dict[str, Callable[[PackageView], None]] = {
    "checksums": _checksums,
    "data": _data,
    "times": _times,
    "metadata": _metadata,
    "croissant": _croissant,
    "frictionless": _frictionless,
    "datacite": _datacite,
}
