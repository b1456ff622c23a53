"""Back up a data set to one zip with a manifest, verified after writing and while restoring.

The zip contains all files (raw files, session files, marks, people's table, evaluations) except ``cache/`` and the
index, which can be rebuilt, and working files. Backups of the same data set are equal byte by byte.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from plushsense.core.errors import DatasetError
from plushsense.core.files import new_folder, replacing_file, work_folder
from plushsense.core.toml import load_table
from plushsense.dataset.files import list_files
from plushsense.dataset.importing.archives import DAMAGED, UnpackLimits, zip_entry
from plushsense.dataset.index import open_dataset, rebuild_index
from plushsense.dataset.store import HEAD, Dataset, Progress

MANIFEST = "plushsense-backup.json"
FORMAT = "plushsense-backup"
VERSION = 1
_CHUNK = 1 << 20
_LEFT_OUT = ("cache", "index", "working")
# A manifest has about 150 bytes per file.
_MANIFEST_LIMIT = 1 << 28
# Exceptions for a damaged zip, or a member of the manifest that is missing.
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

    def to_json(self) -> bytes:
        """Return the text in the zip."""
        table = {"format": FORMAT, "version": VERSION, **asdict(self)}
        return f"{json.dumps(table, ensure_ascii=False, indent=0)}\n".encode()


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
        paths = [f.path for f in listed if f.kind != "link"]
        _refuse_names(folder, paths)
        finishing = source.generation.writing
        with work_folder(target) as work, replacing_file(target, within=work, finishing=finishing) as part:
            manifest = _write(part, source, paths, progress or (lambda done, total: None))
            _refuse_existing(target, "appeared meanwhile")
    except OSError as cause:
        raise DatasetError(
            f"The backup '{target}' cannot be written ({cause.strerror or cause}; '{cause.filename or target}'): "
            "check the path and the disk.",
            reason="system",
            where=f" ('{cause.filename or target}')",
            why=cause.strerror or str(cause),
        ) from None
    return _summary(target, manifest, tuple(f.path.as_posix() for f in listed if f.kind == "link"))


def _refuse_existing(target: Path, state: str) -> None:
    if target.exists() or target.is_symlink():
        message = f"'{target}' {state}: a backup never replaces another; give a new name."
        raise DatasetError(message, reason="name_exists", name=target.name)


def _refuse_names(folder: Path, paths: Iterable[PurePosixPath]) -> None:
    for path in paths:
        if _name_refusal(path.as_posix()):
            name = path.as_posix().encode(errors="backslashreplace").decode()
            message = f"'{name}' in '{folder}' has a name that a backup cannot hold on every system: rename it."
            raise DatasetError(message, reason="backup_name", file=name)


def _write(part: Path, source: Dataset, paths: Sequence[PurePosixPath], progress: Progress) -> Manifest:
    """Write the zip ``part``, and verify it; half of the progress is the verification."""
    folder = source.path
    total, done = 2 * sum((folder / path).stat().st_size for path in paths), 0
    files = []
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            files.append(_store(archive, folder, path))
            done += files[-1].bytes
            progress(done, total)
        people = len(source.subjects)
        manifest = Manifest(source.head.name, len(source.recordings), people, source.hash, tuple(files))
        archive.writestr(zip_entry(MANIFEST), manifest.to_json())
    _verify(part, lambda n: progress(total // 2 + n, total))
    return manifest


def check_backup(file: str | Path, progress: Progress | None = None) -> BackupResult:
    """Verify that a backup contains exactly the files of its manifest, each unchanged.

    Raises:
        DatasetError: if a file is missing or damaged, or ``file`` is no backup; the message names the cause.
    """
    path = Path(file)
    total = path.stat().st_size if path.is_file() else 0
    manifest = _verify(path, lambda n: progress(min(n, total), total) if progress is not None else None)
    return _summary(path, manifest)


def is_backup(file: str | Path) -> bool:
    """Return whether a file is a zip that holds the manifest of a backup; it may be damaged otherwise."""
    try:
        with zipfile.ZipFile(file) as archive:
            return MANIFEST in archive.namelist()
    except _NO_MANIFEST:
        return False


def restore(
    file: str | Path, dest: str | Path, progress: Progress | None = None, limits: UnpackLimits | None = None
) -> Dataset:
    """Restore a data set into a new or empty folder, completely or not at all.

    Args:
        limits: limits of the number of files and of their size; the expansion ratio is not limited.

    Raises:
        DatasetError: for a damaged backup, for one with paths outside of ``dest`` or beyond the ``limits``, or if
            ``dest`` is not empty.
    """
    path, folder = Path(file), Path(dest)
    with _open_backup(path) as (archive, manifest):
        total = sum(entry.bytes for entry in manifest.files)
        (limits or UnpackLimits()).check(path, len(manifest.files), total, folder)
        done = 0
        with new_folder(folder, DatasetError, last=HEAD) as work:
            for entry in manifest.files:
                target = work / entry.path
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as out:
                    _read(path, archive, entry, out)
                done += entry.bytes
                if progress is not None:
                    progress(done, total)
            again = rebuild_index(work).dataset
            if again.hash != manifest.hash:
                raise DatasetError(
                    f"The backup '{path}' restores another data set than the saved one ({len(again.recordings)} "
                    f"recordings of {manifest.recordings}): restore it with the PlushSense that wrote it.",
                    reason="backup_other",
                    name=path.name,
                )
    return open_dataset(folder)


def _store(archive: zipfile.ZipFile, folder: Path, path: PurePosixPath) -> BackupFile:
    digest = hashlib.sha256()
    size = 0
    with (folder / path).open("rb") as file:
        before = os.fstat(file.fileno())
        with archive.open(zip_entry(path.as_posix()), "w", force_zip64=before.st_size >= 1 << 31) as member:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
                size += len(chunk)
                member.write(chunk)
        after = os.fstat(file.fileno())
    if size != before.st_size or (before.st_mtime_ns, before.st_size) != (after.st_mtime_ns, after.st_size):
        message = f"'{folder / path}' changed while it was saved: back up when nothing is recorded."
        raise DatasetError(message, reason="backup_changed", file=path.name)
    return BackupFile(path.as_posix(), size, digest.hexdigest())


def _summary(file: Path, manifest: Manifest, left_out: tuple[str, ...] = ()) -> BackupResult:
    m, total = manifest, sum(entry.bytes for entry in manifest.files)
    return BackupResult(str(file), m.name, len(m.files), total, m.recordings, m.subjects, m.hash, left_out)


def _damaged(path: Path, why: object) -> DatasetError:
    message = f"The backup '{path}' is damaged ({why}): use another copy of it."
    return DatasetError(message, reason="backup_damaged", name=path.name)


@contextmanager
def _open_backup(path: Path) -> Iterator[tuple[zipfile.ZipFile, Manifest]]:
    """Open a backup and check that its members are those of its manifest."""
    if path.exists() and not path.is_file():
        raise DatasetError(f"'{path}' is no file: give a backup.", reason="backup_damaged", name=path.name)
    try:
        archive = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise DatasetError(
            f"There is no backup '{path}': check the path.", reason="file_gone", name=path.name
        ) from None
    except OSError as cause:
        message = f"The backup '{path}' cannot be read ({cause.strerror or cause})."
        raise DatasetError(message, reason="backup_damaged", name=path.name) from None
    except _BROKEN as cause:
        message = f"'{path}' is no backup of PlushSense, or a damaged one ({cause})."
        raise DatasetError(message, reason="backup_damaged", name=path.name) from None
    with archive:
        members = archive.infolist()
        names = [info.filename for info in members]
        if MANIFEST not in names:
            message = f"'{path}' is no backup of PlushSense (it holds no {MANIFEST}), or a damaged one."
            raise DatasetError(message, reason="backup_damaged", name=path.name)
        for info in members:
            if reason := _refusal(info):
                message = f"The backup '{path}' is not used: '{info.filename}' in it is {reason}."
                raise DatasetError(message, reason="backup_damaged", name=path.name)
        if len(set(names)) != len(names):
            raise _damaged(path, "it holds a name twice")
        manifest = _manifest_of(path, archive)
        listed = {entry.path for entry in manifest.files}
        if odd := sorted(listed ^ (set(names) - {MANIFEST})):
            reason = "is missing" if odd[0] in listed else "is not in the manifest"
            raise _damaged(path, f"'{odd[0]}' {reason}")
        yield archive, manifest


def _name_refusal(name: str) -> str:
    """Return the reason why a path cannot be in a backup; "" if it can."""
    if name.startswith("/") or "\\" in name or re.match(r"[A-Za-z]:", name) or "\0" in name:
        return "an absolute path or one of another system"
    if any(part in ("", ".", "..") for part in name.split("/")):
        return "a folder, or a path that leaves its place"
    if name.encode(errors="replace").decode() != name:
        return "a name that is no text"
    return ""


def _refusal(info: zipfile.ZipInfo) -> str:
    """Return the reason why a member must not be unpacked; "" if it may."""
    # zipfile cuts a name at a zero byte; ``orig_filename`` keeps it.
    if reason := _name_refusal(info.orig_filename if "\0" in info.orig_filename else info.filename):
        return reason
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        return "a link or no plain file"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return "compressed by a method that PlushSense does not use: damaged, or changed by another program"
    return ""


def _manifest_of(path: Path, archive: zipfile.ZipFile) -> Manifest:
    try:
        if archive.getinfo(MANIFEST).file_size > _MANIFEST_LIMIT:
            raise ValueError("its manifest is too long")
        table: dict[str, Any] = json.loads(archive.read(MANIFEST))
        if table.pop("format") != FORMAT:
            raise ValueError("its manifest has another format")
        if (version := table.pop("version")) != VERSION:
            raise DatasetError(
                f"The backup '{path}' has version {version!r}; this PlushSense reads {VERSION}: update it.",
                reason="backup_version",
                name=path.name,
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


def _read(path: Path, archive: zipfile.ZipFile, entry: BackupFile, out: IO[bytes] | None = None) -> None:
    """Read a member, write it to ``out`` if given, and raise DatasetError if it differs from the manifest."""
    digest = hashlib.sha256()
    size = 0
    try:
        with archive.open(entry.path) as member:
            while chunk := member.read(_CHUNK):
                size += len(chunk)
                if size > entry.bytes:
                    break
                digest.update(chunk)
                if out is not None:
                    out.write(chunk)
    except _BROKEN as cause:
        raise _damaged(path, f"'{entry.path}': {cause}") from None
    if size != entry.bytes or digest.hexdigest() != entry.sha256:
        raise _damaged(path, f"'{entry.path}' differs from the saved file")


def _verify(path: Path, progress: Callable[[int], None]) -> Manifest:
    with _open_backup(path) as (archive, manifest):
        done = 0
        for entry in manifest.files:
            _read(path, archive, entry)
            done += entry.bytes
            progress(done)
    return manifest
