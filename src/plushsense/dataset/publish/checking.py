"""Whether a package holds what it promises: every validator over every file, without the network.

checksums    every file is there, unchanged, and no other
data         the recordings read, the tables say what they hold, and what does not leave is not there
times        no time of the true day is left
metadata     title, version, licence and day are the same in every metadata file
croissant    mlcroissant accepts the metadata and loads back, bit for bit, what the files hold
frictionless frictionless accepts the descriptor and every cell has the type that its schema says
ro-crate     rocrate opens the crate, and it lists every file as it is
datacite     the metadata fit DataCite's own schema
"""

from __future__ import annotations

import json
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from plushsense.core.errors import MissingExtraError, PlushSenseError
from plushsense.core.extras import need
from plushsense.core.recfile import parse_name, read_stream
from plushsense.dataset.freshness import sha256_of
from plushsense.dataset.index import Rebuilt, build
from plushsense.dataset.people import PEOPLE
from plushsense.dataset.publish import as_crate, as_croissant, as_datacite, as_datapackage
from plushsense.dataset.publish.agreement import compare_metadata, compare_tables, find_private
from plushsense.dataset.publish.archive import files_of, opened, read_checksums
from plushsense.dataset.publish.croissant_records import compare_records
from plushsense.dataset.publish.description import CHECKSUMS, DATA
from plushsense.dataset.publish.shifting import LATEST_MS, WALL_CLOCK_MS
from plushsense.dataset.store import DatasetHead

Tell = Callable[[str, int, int], None]
EXTRA = "publish"
# Of each stream, the rows that the slow readers read unless they are asked for all.
STREAM_ROWS = 1000
SHOWN = 50
# What PlushSense itself puts into the data folder when somebody opens it.
_OWN = re.compile(rf"{DATA}/(recordings\.csv|streams\.csv|index\.json|[^/]+\.lock|cache/.*|evaluations/.*)")


@dataclass(frozen=True)
class Problem:
    """What a validator found, and in which file ("" for the package as a whole)."""

    validator: str
    file: str
    problem: str

    def __str__(self) -> str:
        return f"{self.validator}: {f'{self.file}: ' if self.file else ''}{self.problem}"


@dataclass
class Checked:
    """What all validators said; ``validators`` with what each looked at and how long it took."""

    problems: list[Problem] = field(default_factory=list)
    validators: list[dict[str, Any]] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Whether no validator found anything."""
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"valid": self.valid, "validators": self.validators, "problems": [vars(p) for p in self.problems]}


@dataclass
class Package:
    """A package's folder as the validators see it; what is slow to find out is found out once."""

    root: Path
    thorough: bool = False
    packed: bool = False
    found: list[tuple[str, str]] = field(default_factory=list)
    looked_at: str = ""

    def say(self, file: str, problem: str) -> None:
        """Note a problem; of very many alike, only the first are kept."""
        if len(self.found) < SHOWN:
            self.found.append((file, problem))

    def load(self, file: str) -> Any:
        """A JSON file of the package; None, and a problem, when it cannot be read."""
        try:
            return json.loads((self.root / file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as cause:
            self.say(file, f"cannot be read: {cause}")
            return None

    @cached_property
    def sums(self) -> dict[str, str]:
        """SHA-256 of every file that is there."""
        return {p.relative_to(self.root).as_posix(): sha256_of(p) for p in files_of(self.root)}

    @cached_property
    def built(self) -> Rebuilt:
        """The data folder, read anew from its raw files."""
        return build(self.root / DATA, DatasetHead.read(self.root / DATA))

    def is_own(self, path: str) -> bool:
        """Whether PlushSense may have put a file into the data folder since; not into a zip."""
        return not self.packed and _OWN.fullmatch(path) is not None

    def is_local(self, path: object) -> bool:
        """Whether a path of a metadata file stays in the package and off the network."""
        if not isinstance(path, str) or not path or ":" in path or "\\" in path:
            return False
        plain = PurePosixPath(path)
        return not plain.is_absolute() and ".." not in plain.parts


def validate_package(package: str | Path, *, thorough: bool = False, tell: Tell | None = None) -> Checked:
    """Let every validator read a package, a folder or a zip.

    Args:
        thorough: also the slow ones read every row of the streams, not only the first thousand of each.

    Raises:
        DatasetError: for what is no package.
        MissingExtraError: without the validators.
    """
    with opened(Path(package)) as root:
        return check_folder(root, thorough=thorough, packed=Path(package).is_file(), tell=tell)


def check_folder(root: Path, *, thorough: bool = False, packed: bool = False, tell: Tell | None = None) -> Checked:
    """As `validate_package`, for a folder; ``packed``: it came out of a zip, which nobody has opened as a data set."""
    checked = Checked()
    package = Package(root, thorough, packed)
    for number, (name, validator) in enumerate(VALIDATORS.items()):
        if tell is not None:
            tell(f"validating: {name}", number, len(VALIDATORS))
        began = time.perf_counter()
        package.found, package.looked_at = [], ""
        try:
            validator(package)
        except MissingExtraError:
            raise
        except PlushSenseError as cause:
            package.say("", str(cause))
        except Exception as cause:  # noqa: BLE001 - a damaged package may make a foreign validator fail in any way
            package.say("", f"the validator gave up: {type(cause).__name__}: {_short(cause)}")
        checked.problems += [Problem(name, file, problem) for file, problem in package.found]
        checked.validators.append(
            {
                "validator": name,
                "looked_at": package.looked_at,
                "problems": len(package.found),
                "seconds": round(time.perf_counter() - began, 2),
            }
        )
    if tell is not None:
        tell("validating", len(VALIDATORS), len(VALIDATORS))
    return checked


def _short(cause: BaseException) -> str:
    inner = cause
    while inner.__cause__ is not None:
        inner = inner.__cause__
    return " ".join(str(inner).split())[:300]


# ---- what we check ourselves


def _checksums(p: Package) -> None:
    listed = read_checksums(p.root)
    for path, expected in listed.items():
        if path not in p.sums:
            p.say(path, "is missing")
        elif p.sums[path] != expected:
            p.say(path, f"was changed: its SHA-256 is {p.sums[path][:12]}…, not {expected[:12]}…")
        if (p.root / path).is_symlink():
            p.say(path, "is a link, which may lead out of the package")
    for path in sorted(p.sums.keys() - listed.keys()):
        if path != CHECKSUMS and not p.is_own(path):
            p.say(path, "is not listed in the checksums")
    p.looked_at = f"{len(listed)} files"


def _data(p: Package) -> None:
    for file, reason in p.built.unreadable.items():
        p.say(f"{DATA}/{file}", reason)
    dataset = p.built.dataset
    compare_tables(p.root, dataset, p.say)
    find_private(dataset, p.say)
    p.looked_at = f"{len(dataset.recordings)} recordings, {len(dataset.streams)} streams"


def _metadata(p: Package) -> None:
    compared = compare_metadata(p.root, p.built.dataset, p.load, p.say)
    p.looked_at = f"{compared} statements"


def _times(p: Package) -> None:
    dataset = p.built.dataset
    for path in p.sums:
        name = parse_name(path) if path.startswith(f"{DATA}/") else None
        if name is not None and name.epoch_ms >= LATEST_MS:
            p.say(path, f"its name holds the time {name.epoch_ms}, which is not shifted")
    for file in sorted({r.file for r in dataset.recordings} | {s.file for s in dataset.streams}):
        frames = read_stream(dataset.path / file, dataset.layout).frames
        if frames.host_ms is not None and int(frames.host_ms.max()) >= LATEST_MS:
            p.say(f"{DATA}/{file}", f"the computer's clock says {int(frames.host_ms.max())}, which is not shifted")
        latest = int(frames.device_ms.max())
        if latest >= WALL_CLOCK_MS and latest >= LATEST_MS:
            p.say(f"{DATA}/{file}", f"the toy's clock says {latest}, which is not shifted")
    p.looked_at = "every name and row"


# ---- what others check


def _croissant(p: Package) -> None:
    document = p.load(as_croissant.FILE)
    if not isinstance(document, dict):
        return
    if not isinstance(document.get("@context"), dict):
        p.say(as_croissant.FILE, "its @context must be written out: an address would be fetched")
        return
    if document.get("conformsTo") != as_croissant.CONFORMS_TO:
        p.say(as_croissant.FILE, f"it conforms to {document.get('conformsTo')!r}, not to {as_croissant.CONFORMS_TO}")
    for entry in document.get("distribution", []):
        place = entry.get("contentUrl", entry.get("includes"))
        if not p.is_local(place):
            p.say(as_croissant.FILE, f"'{entry.get('@id')}' lies at {place!r}, which is no path of the package")
        elif "sha256" in entry and p.sums.get(place) != entry["sha256"]:
            p.say(str(place), "has another SHA-256 than croissant.json says")
    if p.found:
        return
    mlcroissant = need("mlcroissant", EXTRA)
    need("absl.logging", EXTRA).set_verbosity("error")
    metadata = mlcroissant.Dataset(str(p.root / as_croissant.FILE)).metadata
    for issue in sorted({*metadata.ctx.issues.errors, *metadata.ctx.issues.warnings}, key=str):
        p.say(as_croissant.FILE, str(issue))
    records = compare_records(mlcroissant, p.root, p.built.dataset, None if p.thorough else STREAM_ROWS, p.say)
    p.looked_at = ", ".join(f"{n} records of {name}" for name, n in records.items())


def _frictionless(p: Package) -> None:
    descriptor = p.load(as_datapackage.FILE)
    if not isinstance(descriptor, dict):
        return
    for resource in descriptor.get("resources", []):
        for key in ("path", "schema"):
            if not p.is_local(resource.get(key)):
                p.say(
                    as_datapackage.FILE, f"a resource has the {key} {resource.get(key)!r}: a path of the package only"
                )
    if p.found:
        return
    frictionless = need("frictionless", EXTRA)
    package = frictionless.Package(str(p.root / as_datapackage.FILE))
    rows = 0
    for resource in package.resources:
        limit = None
        if resource.path.startswith(f"{DATA}/streams/") and not p.thorough:
            # Part of a file has another checksum: that of the whole is looked at elsewhere.
            limit, resource.hash, resource.bytes = STREAM_ROWS, None, None
        report = resource.validate(limit_rows=limit) if limit else resource.validate()
        for task in report.tasks:
            rows += task.stats.get("rows", 0)
            for error in [*task.errors][:SHOWN]:
                p.say(resource.path, error.message)
        for error in report.errors:
            p.say(resource.path, error.message)
    covered = {r.path for r in package.resources}
    for path in p.sums:
        if path.endswith(".csv") and path not in covered and not p.is_own(path) and path != f"{DATA}/{PEOPLE}":
            p.say(path, "is no resource of datapackage.json")
    p.looked_at = f"{len(package.resources)} resources, {rows} rows"


def _crate(p: Package) -> None:
    document = p.load(as_crate.FILE)
    if document is None:
        return
    rocrate = need("rocrate.rocrate", EXTRA)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        crate = rocrate.ROCrate(str(p.root))
    for warning in said:
        p.say(as_crate.FILE, str(warning.message))
    for key in ("name", "description", "datePublished", "license"):
        if not crate.root_dataset.get(key):
            p.say(as_crate.FILE, f"the crate has no {key}")
    listed = set()
    for entity in crate.data_entities:
        path = unquote(str(entity.id))
        listed.add(path)
        if not p.is_local(path):
            p.say(as_crate.FILE, f"it lists {path!r}, which is no path of the package")
        elif path not in p.sums:
            p.say(path, "is listed in the crate but is not there")
        elif entity.get("sha256") != p.sums[path]:
            p.say(path, "has another SHA-256 than the crate says")
        elif str(entity.get("contentSize")) != str((p.root / path).stat().st_size):
            p.say(path, "has another size than the crate says")
    for path in sorted(p.sums.keys() - listed - {as_crate.FILE, CHECKSUMS}):
        if not p.is_own(path):
            p.say(path, "is not listed in the crate")
    p.looked_at = f"{len(listed)} files"


def _datacite(p: Package) -> None:
    document = p.load(as_datacite.FILE)
    if document is None:
        return
    schema = need("datacite.schema45", EXTRA)
    for error in sorted(schema.validator.iter_errors(document), key=lambda e: list(map(str, e.absolute_path))):
        where = "/".join(map(str, error.absolute_path))
        p.say(as_datacite.FILE, f"{f'{where}: ' if where else ''}{error.message[:300]}")
    if not p.found:
        told = (p.root / as_datacite.XML_FILE).read_text(encoding="utf-8")
        if told != schema.tostring(document):
            p.say(as_datacite.XML_FILE, f"does not say what {as_datacite.FILE} says")
    p.looked_at = "schema 4.5"


Validator = Callable[[Package], None]
VALIDATORS: dict[str, Validator] = {
    "checksums": _checksums,
    "data": _data,
    "times": _times,
    "metadata": _metadata,
    "croissant": _croissant,
    "frictionless": _frictionless,
    "ro-crate": _crate,
    "datacite": _datacite,
}
