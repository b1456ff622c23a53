"""Back up a data set to one zip with a manifest, verified after writing and while restoring.

The zip contains all files (raw files, session files, marks, people's table, evaluations) except ``cache/`` and the
index, which can be rebuilt, and working files. Backups of the same data set are equal byte by byte.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from plushsense.core.errors import DatasetError
from plushsense.core.files import new_folder, replacing_file, work_folder
from plushsense.core.toml import load_table
from plushsense.dataset.files import list_files
from plushsense.dataset.importing.archives import DAMAGED, UnpackLimits, member_target, refusal, zip_entry
from plushsense.dataset.index import open_dataset, rebuild_index
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, Dataset, Progress

MANIFEST = "plushsense-backup.json"
FORMAT = "plushsense-backup"
VERSION = 1
_CHUNK = 1 << 20
_LEFT_OUT = ("cache", "index", "working")
# A manifest has about 150 bytes per file.
_MANIFEST_LIMIT = 1 << 28
# The manifest has the size of each file, so that the expansion ratio needs no limit.
_ANY_RATIO = UnpackLimits(ratio=2**59)
# Exceptions for a damaged zip, or a manifest that is none.
_BROKEN: tuple[type[Exception], ...] = (*DAMAGED, KeyError, IndexError)
_NO_MANIFEST: tuple[type[Exception], ...] = (*_BROKEN, TypeError, AttributeError, OSError, RecursionError)


@dataclass(frozen=True)
class BackupFile:
    """File in a backup, by its path in the data set."""

    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """List of the files of a backup; ``hash`` is that of the data set."""

    name: str
    recordings: int
    subjects: int
    hash: str
    files: tuple[BackupFile, ...]

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(file.bytes for file in self.files)


@dataclass(frozen=True)
class BackupResult:
    """Summary of a backup; ``hash`` is that of the data set, ``left_out`` lists links, which are not backed up."""

    file: str
    name: str
    files: int
    bytes: int
    recordings: int
    subjects: int
    hash: str
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, file: Path, m: Manifest, left_out: tuple[str, ...] = ()) -> BackupResult:
        """Summarise the backup ``file`` with the manifest ``m``."""
        return cls(str(file), m.name, len(m.files), m.bytes, m.recordings, m.subjects, m.hash, left_out)


def backup(dataset: str | Path, file: str | Path, progress: Progress | None = None) -> BackupResult:
    """Write a data set into one new zip file, and read the zip again to verify it.

    Args:
        progress: called with (bytes done, number of bytes); the second half is the verification.

    Raises:
        DatasetError: if ``file`` exists or lies in the data set, a file changes during the backup, or the verification
            fails. No incomplete zip is left.
    """
    folder, target = Path(dataset), Path(file)
    _refuse_existing(target, "exists already")
    if folder.resolve() in target.resolve().parents:
        raise DatasetError(f"'{target}' lies in the data set itself: give a place outside of '{folder}'.")
    source = open_dataset(folder)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        listed = [f for f in list_files(folder) if f.kind not in _LEFT_OUT]
        links, paths = ([f.path.as_posix() for f in listed if (f.kind == "link") is link] for link in (True, False))
        if odd := next((path for path in paths if not _is_portable(path)), None):
            name = odd.encode(errors="backslashreplace").decode()
            raise DatasetError(
                "'{file}' in '{folder}' has a name that a backup cannot hold on every system: rename it.",
                file=name,
                folder=folder,
            )
        finishing = source.generation.writing
        with work_folder(target) as work, replacing_file(target, within=work, finishing=finishing) as part:
            manifest = _write(part, source, paths, progress or (lambda done, total: None))
            _refuse_existing(target, "appeared meanwhile")
    except OSError as cause:
        raise DatasetError(
            "The backup '{target}' cannot be written ({why}; '{file}'): check the path and the disk.",
            target=target,
            why=cause.strerror or cause,
            file=cause.filename or target,
            where=f" ('{cause.filename or target}')",
        ) from None
    return BackupResult.of(target, manifest, tuple(links))


def _refuse_existing(target: Path, state: str) -> None:
    if target.exists() or target.is_symlink():
        raise DatasetError(
            "'{path}' {state}: a backup never replaces another; give a new name.", path=target, state=state
        )


def _is_portable(name: str) -> bool:
    """Return whether a file of this name in a zip can be unpacked on every system, to the place that it names."""
    target = member_target(name)
    return not isinstance(target, str) and target.as_posix() == name


def _write(part: Path, source: Dataset, paths: list[str], progress: Progress) -> Manifest:
    """Write the zip ``part``, and verify it; half of the progress is the verification."""
    total, done = 2 * sum((source.path / path).stat().st_size for path in paths), 0
    files = []
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            files.append(_store(archive, source.path, path))
            done += files[-1].bytes
            progress(done, total)
        people = len(source.subjects)
        manifest = Manifest(source.head.name, len(source.recordings), people, source.hash, tuple(files))
        table = {"format": FORMAT, "version": VERSION, **asdict(manifest)}
        archive.writestr(zip_entry(MANIFEST), f"{json.dumps(table, ensure_ascii=False, indent=0)}\n".encode())
    _verify(part, lambda n: progress(total // 2 + n, total))
    return manifest


def _store(archive: zipfile.ZipFile, folder: Path, path: str) -> BackupFile:
    with (folder / path).open("rb") as file:
        before = os.fstat(file.fileno())
        with archive.open(zip_entry(path), "w", force_zip64=before.st_size >= 1 << 31) as member:
            size, sha256 = _copy(file, member)
        after = os.fstat(file.fileno())
    if size != before.st_size or (before.st_mtime_ns, before.st_size) != (after.st_mtime_ns, after.st_size):
        raise DatasetError(
            "'{folder}' changed while it was saved: back up when nothing is recorded.",
            folder=folder / path,
            file=Path(path).name,
        )
    return BackupFile(path, size, sha256)


def _copy(file: IO[bytes], out: IO[bytes] | None, limit: float = float("inf")) -> tuple[int, str]:
    """Copy a file, to nowhere if ``out`` is None, until more than ``limit`` bytes; return its size and SHA-256."""
    digest, size = hashlib.sha256(), 0
    while size <= limit and (chunk := file.read(_CHUNK)):
        digest.update(chunk)
        size += len(chunk)
        if out is not None:
            out.write(chunk)
    return size, digest.hexdigest()


def check_backup(file: str | Path, progress: Progress | None = None) -> BackupResult:
    """Verify that a backup contains exactly the files of its manifest, each unchanged.

    Raises:
        DatasetError: if a file is missing or damaged, or ``file`` is no backup; the message names the cause.
    """
    path = Path(file)
    total = path.stat().st_size if path.is_file() else 0
    return BackupResult.of(path, _verify(path, lambda n: progress(min(n, total), total) if progress else None))


def _verify(path: Path, progress: Callable[[int], None]) -> Manifest:
    with _open_backup(path) as (archive, manifest):
        done = 0
        for entry in manifest.files:
            _read(path, archive, entry)
            done += entry.bytes
            progress(done)
    return manifest


def is_backup(file: str | Path) -> bool:
    """Return whether a file is a zip that holds the manifest of a backup; it may be damaged otherwise."""
    try:
        with zipfile.ZipFile(file) as archive:
            return MANIFEST in archive.namelist()
    except _NO_MANIFEST:
        return False


def backup_people(file: str | Path) -> list[str]:
    """Return the people of whom a backup has recordings or streams, by its manifest."""
    with _open_backup(Path(file)) as (_, manifest):
        return _people_of(manifest)


def _people_of(manifest: Manifest) -> list[str]:
    paths = [file.path.split("/") for file in manifest.files]
    return sorted({parts[1] for parts in paths if len(parts) > 2 and parts[0] in (RECORDINGS, STREAMS)})


def restore(
    file: str | Path,
    dest: str | Path,
    progress: Progress | None = None,
    limits: UnpackLimits | None = None,
    readmit: bool = False,
) -> Dataset:
    """Restore a data set into a new or empty folder, completely or not at all.

    Args:
        limits: limits of the number of files and of their size; the expansion ratio is not limited.
        readmit: whether to restore people who were removed from the home that ``dest`` lies in.

    Raises:
        DatasetError: for a damaged backup, for one with paths outside of ``dest`` or beyond the ``limits``, if
            ``dest`` is not empty, or for removed people.
    """
    path, folder = Path(file), Path(dest)
    with _open_backup(path) as (archive, manifest):
        (limits or UnpackLimits()).check(path, len(manifest.files), manifest.bytes, folder)
        if not readmit:
            refuse_removed(folder, _people_of(manifest))
        done = 0
        with new_folder(folder, DatasetError, last=HEAD) as work:
            for entry in manifest.files:
                target = work / entry.path
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as out:
                    _read(path, archive, entry, out)
                done += entry.bytes
                if progress is not None:
                    progress(done, manifest.bytes)
            again = rebuild_index(work).dataset
            if again.hash != manifest.hash:
                raise DatasetError(
                    "The backup '{path}' restores another data set than the saved one ({n} recordings of "
                    "{recordings}): restore it with the PlushSense that wrote it.",
                    path=path,
                    n=len(again.recordings),
                    recordings=manifest.recordings,
                )
    return open_dataset(folder)


def _read(path: Path, archive: zipfile.ZipFile, entry: BackupFile, out: IO[bytes] | None = None) -> None:
    """Read a member, write it to ``out`` if given, and raise DatasetError if it differs from the manifest."""
    try:
        with archive.open(entry.path) as member:
            copied = _copy(member, out, entry.bytes)
    except _BROKEN as cause:
        raise _damaged(path, f"'{entry.path}': {cause}") from None
    if copied != (entry.bytes, entry.sha256):
        raise _damaged(path, f"'{entry.path}' differs from the saved file")


def _damaged(path: Path, why: object) -> DatasetError:
    return DatasetError("The backup '{path}' is damaged ({why}): use another copy of it.", path=path, why=why)


@contextmanager
def _open_backup(path: Path) -> Iterator[tuple[zipfile.ZipFile, Manifest]]:
    """Open a backup and check that its members are those of its manifest."""
    if not path.is_file():
        raise DatasetError("There is no backup '{path}': check the path.", path=path)
    try:
        archive = zipfile.ZipFile(path)
    except OSError as cause:
        raise DatasetError(
            "The backup '{path}' cannot be read ({why}).", path=path, why=cause.strerror or cause
        ) from None
    except _BROKEN as cause:
        raise DatasetError(
            "'{path}' is no backup of PlushSense, or a damaged one ({cause}).", path=path, cause=cause
        ) from None
    with archive:
        members = archive.infolist()
        names = [info.filename for info in members]
        if MANIFEST not in names:
            raise DatasetError(
                "'{path}' is no backup of PlushSense (it holds no {manifest}), or a damaged one.",
                path=path,
                manifest=MANIFEST,
            )
        for info in members:
            if reason := _refusal(info):
                raise DatasetError(
                    "The backup '{path}' is not used: '{info}' in it is {reason}.",
                    path=path,
                    info=info.filename,
                    reason=reason,
                )
        manifest = _manifest_of(path, archive)
        listed = [MANIFEST, *(entry.path for entry in manifest.files)]
        if sorted(listed) != sorted(names):
            odd = next(iter({*listed} ^ {*names}), "")
            reason = "is missing" if odd in listed else "is not in the manifest"
            raise _damaged(path, f"'{odd}' {reason}" if odd else "it holds a name twice")
        yield archive, manifest


def _refusal(info: zipfile.ZipInfo) -> str:
    """Return the reason why a member must not be unpacked; "" if it may."""
    # zipfile cuts a name at a zero byte; ``orig_filename`` keeps it.
    if not _is_portable(info.orig_filename if "\0" in info.orig_filename else info.filename):
        return "a path that leaves its place, or that not every system can hold"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return "compressed by a method that PlushSense does not use: damaged, or changed by another program"
    return "a link or no plain file" if refusal(info, _ANY_RATIO) else ""


def _manifest_of(path: Path, archive: zipfile.ZipFile) -> Manifest:
    try:
        if archive.getinfo(MANIFEST).file_size > _MANIFEST_LIMIT:
            raise ValueError("its manifest is too long")
        table = json.loads(archive.read(MANIFEST))
        if table.pop("format") != FORMAT:
            raise ValueError("its manifest has another format")
        if (version := table.pop("version")) != VERSION:
            raise DatasetError(
                "The backup '{path}' has version {version!r}; this PlushSense reads {known}: update it.",
                path=path,
                version=version,
                known=VERSION,
            )
    except _NO_MANIFEST as cause:
        raise _damaged(path, cause) from None
    try:
        manifest = load_table(table, Manifest, "its manifest", DatasetError)
    except DatasetError as cause:
        raise _damaged(path, cause) from None
    if any(entry.bytes < 0 for entry in manifest.files):
        raise _damaged(path, "a file in its manifest has less than 0 bytes")
    return manifest
