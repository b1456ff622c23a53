"""Save data sets and networks in one file, and open it in another home, where nothing that exists is changed.

A project is a zip of ``plushsense-project.json``, a backup of each data set in ``datasets/`` and the networks in
``bundles/``.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from plushsense.core.errors import BundleError, DatasetError, PlushSenseError
from plushsense.core.files import free_path, replacing_file, work_folder, write_file
from plushsense.core.sentences import Message
from plushsense.dataset.backup import backup, backup_people, restore
from plushsense.dataset.files import DATASETS, list_package_files
from plushsense.dataset.importing.archives import DAMAGED, UnpackLimits, unpack, zip_entry
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.dataset.store import HEAD, DatasetHead, Progress
from plushsense.models.bundle import Bundle, known_people

MANIFEST = "plushsense-project.json"
BUNDLES = "bundles"
VERSION = 1
_MANIFEST_BYTES = 1 << 24


@dataclass(frozen=True)
class ProjectResult:
    """Names of the data sets and networks that were saved or opened, and what was not opened, with the reason."""

    datasets: tuple[str, ...]
    networks: tuple[str, ...]
    refused: tuple[tuple[str, Message], ...] = ()


def is_project(file: str | Path) -> bool:
    """Return whether a file is a zip that holds the manifest of a project; it may be damaged otherwise."""
    try:
        with zipfile.ZipFile(file) as archive:
            return MANIFEST in archive.namelist()
    except DAMAGED:
        return False
    except OSError:
        return False


def project_people(file: str | Path) -> list[str]:
    """Return the people in the data sets of a project, and those whom its networks know, by its manifest."""
    try:
        with zipfile.ZipFile(file) as archive, archive.open(MANIFEST) as member:
            people = json.loads(member.read(_MANIFEST_BYTES))["people"]
            return [str(code) for code in people]
    except DAMAGED:
        return []
    except (OSError, KeyError, TypeError, RecursionError):
        return []


def save_project(
    file: str | Path, datasets: Sequence[Path], networks: Sequence[Path], progress: Progress = lambda done, total: None
) -> ProjectResult:
    """Write data sets and networks into the new file ``file``.

    Args:
        progress: called with (parts done, number of parts).

    Raises:
        DatasetError: if ``file`` exists, there is nothing to save, or as `plushsense.dataset.backup.backup`.
        BundleError: for a damaged network. OSError: for errors of the disk. No incomplete file is left.
    """
    target, parts = Path(file), len(datasets) + len(networks)
    if target.exists():
        raise DatasetError("'{path}' exists already: give a new name; nothing is replaced.", path=target)
    if not parts:
        raise DatasetError("There is no data set and no network to save yet.")
    target.parent.mkdir(parents=True, exist_ok=True)
    with work_folder(target) as work, replacing_file(target, within=work) as part:
        for kind in (DATASETS, BUNDLES):
            (work / kind).mkdir()
        people: set[str] = set()
        for done, source in enumerate((*datasets, *networks)):
            progress(done, parts)
            if done < len(datasets):
                stored = backup(source, _unused(work / DATASETS / f"{source.name}.zip"))
                people |= set(backup_people(stored.file))
            else:
                people |= known_people(Bundle.load(source).provenance)
                write_file(_unused(work / BUNDLES / source.name), source.read_bytes())
        with zipfile.ZipFile(part, "w") as archive:
            archive.writestr(zip_entry(MANIFEST), json.dumps({"version": VERSION, "people": sorted(people)}) + "\n")
            for path in _members(work):
                entry = zip_entry(path.relative_to(work).as_posix())
                entry.compress_type = zipfile.ZIP_STORED
                with path.open("rb") as file_in, archive.open(entry, "w", force_zip64=True) as member:
                    while chunk := file_in.read(1 << 20):
                        member.write(chunk)
        progress(parts, parts)
        names = [path.stem for path in _members(work) if path.suffix == ".zip"]
        return ProjectResult(tuple(names), tuple(path.stem for path in _members(work) if path.suffix == ".plush"))


def open_project(
    file: str | Path,
    home: str | Path,
    progress: Progress = lambda done, total: None,
    limits: UnpackLimits | None = None,
    readmit: bool = False,
) -> ProjectResult:
    """Restore the data sets of a project as new ones in ``home``, and add its networks; nothing there is changed.

    A part that is damaged, or must not come back, is left out and among the ``refused`` of the result.

    Args:
        progress: called with (parts done, number of parts).
        limits: limits for the whole and for each data set.
        readmit: whether to open parts of people who were removed from ``home``.

    Raises:
        DatasetError: for a file that is no project, or is larger than the limits. OSError: for errors of the disk.
    """
    path, place = Path(file), Path(home)
    if not is_project(path):
        raise DatasetError("'{path}' is no project of PlushSense, or a damaged one: get another copy.", path=path)
    datasets, networks = [], []
    place.mkdir(parents=True, exist_ok=True)
    with work_folder(place / "project") as work:
        refused = unpack(path, work / "parts", limits)
        members = list(_members(work / "parts"))
        for done, part in enumerate(members):
            progress(done, len(members))
            try:
                if part.parent.name == DATASETS:
                    datasets.append(_restore(part, place / DATASETS, limits, readmit))
                else:
                    networks.append(_add(part, place / BUNDLES, readmit))
            except PlushSenseError as refusal:
                refused.append((part.name, refusal.message))
        progress(len(members), len(members))
    return ProjectResult(tuple(datasets), tuple(networks), tuple(refused))


def _members(folder: Path) -> Iterator[Path]:
    """Yield the backups and networks of an unpacked project, and no other file."""
    for path in list_package_files(folder):
        if path.relative_to(folder).parent.as_posix() in (DATASETS, BUNDLES) and path.suffix in (".zip", ".plush"):
            yield path


def _unused(path: Path) -> Path:
    """Return ``path``, or a numbered one beside it if it exists."""
    number, free = 2, path
    while free.exists():
        number, free = number + 1, path.with_stem(f"{path.stem} {number}")
    return free


def _restore(part: Path, datasets: Path, limits: UnpackLimits | None, readmit: bool) -> str:
    dest = _unused(datasets / part.stem)
    restore(part, dest, limits=limits, readmit=readmit)
    taken = {DatasetHead.read(head.parent).name for head in datasets.glob(f"*/{HEAD}") if head.parent != dest}
    head = DatasetHead.read(dest)
    if head.name in taken:
        write_file(dest / HEAD, replace(head, name=dest.name).to_toml())
    return dest.name


def _add(part: Path, bundles: Path, readmit: bool) -> str:
    if part.suffix != ".plush":
        raise BundleError("'{path}' is no network.", path=part)
    people = known_people(Bundle.load(part).provenance)
    if not readmit:
        refuse_removed(bundles, people)
    place = free_path(bundles / part.name, content := part.read_bytes())
    if not place.exists():
        bundles.mkdir(parents=True, exist_ok=True)
        write_file(place, content)
    return place.stem
