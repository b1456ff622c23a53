"""Write files and folders atomically: complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import secrets
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout

from plushsense.core.errors import BadInput

PART = ".part"
"""Suffix of files being written; files with it that a killed program left behind can be deleted."""
_UNFINISHED = "-unfinished-"
_OWNER = "owner.lock"
_TEMPORARY = "plushsense"
_HEAD_BYTES = 4096
_STARTED_S = 3600.0  # after which a work folder with nothing in it is taken for abandoned


def unfinished(dest: Path) -> str:
    """Return the name prefix of the work folders for ``dest``, which lie beside it."""
    return f".{dest.resolve().name}{_UNFINISHED}"


def is_unfinished(name: str) -> bool:
    """Return whether ``name`` is the name of a work folder."""
    return name.startswith(".") and _UNFINISHED in name


def abandoned_folders(place: Path) -> list[Path]:
    """Return the work folders in ``place`` that no process uses any more, as a killed program leaves them."""
    found = []
    for entry in place.glob(f".*{_UNFINISHED}*"):
        # Those of other users cannot be read, their owners may delete them meanwhile, and a file is no folder.
        with contextlib.suppress(PermissionError, FileNotFoundError, NotADirectoryError):
            held = [file.name for file in entry.iterdir()]
            if (_OWNER in held or (not held and _is_old(entry))) and not is_in_use(entry):
                found.append(entry)
    return sorted(found)


def abandoned_temporary_folders() -> list[Path]:
    """Return the folders of `temporary_folder` that no process uses any more."""
    place = Path(tempfile.gettempdir())
    return [folder for folder in abandoned_folders(place) if folder.name.startswith(unfinished(place / _TEMPORARY))]


def is_in_use(folder: Path) -> bool:
    """Return whether a process uses a work folder; it cannot be known on a disk without locks, and is True there.

    Folders of earlier versions have no lock file and count as not in use.
    """
    try:
        held = [entry.name for entry in folder.iterdir()]
        # Nothing else is in it until its owner has locked it, nor when its owner was killed while deleting it.
        if held == [_OWNER] and not _is_old(folder):
            return True
        if _OWNER in held:
            with FileLock(folder / _OWNER, timeout=0):
                pass
    except (OSError, Timeout, NotImplementedError):
        return True
    return False


def _is_old(folder: Path) -> bool:
    """Return whether a program would have written into a work folder, or locked it, long ago."""
    return time.time() - folder.stat().st_mtime >= _STARTED_S


@contextlib.contextmanager
def work_folder(dest: Path) -> Iterator[Path]:
    """Yield a new folder beside ``dest`` for unfinished files, which is deleted when the block ends.

    It has a unique name and contains a lock file, which is held meanwhile. Those beside ``dest`` that killed programs
    left are deleted first.
    """
    place = dest.resolve().parent
    for left in abandoned_folders(place):
        shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=unfinished(dest), dir=place))
    lock = FileLock(folder / _OWNER)
    try:
        # On a disk without locks, nobody can take the folder for an abandoned one.
        with contextlib.suppress(OSError, NotImplementedError):
            lock.acquire()
        yield folder
    finally:
        lock.release()
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a `work_folder` in the system's folder for temporary files, for copies of personal data."""
    with work_folder(Path(tempfile.gettempdir()) / _TEMPORARY) as folder:
        yield folder


def read_bytes(path: Path, most: int) -> bytes:
    """Read a file of at most ``most`` bytes, so that a huge one, or an endless device, does not fill the memory.

    Raises:
        OSError: if the file cannot be read, or is longer.
    """
    with _open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most:,} bytes", str(path))
    return data


def _open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; raise OSError for a pipe or device, which may never end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.open("rb")


def foreign_link(folder: Path, entry: Path, error: type[BadInput]) -> BadInput:
    """Return the error for an entry of ``folder`` that is neither one of its files nor one of its folders."""
    return error(
        "'{entry}' is a link to another place, or neither a file nor a folder: put what it leads to in its place, or "
        "remove it.",
        entry=entry,
        file=entry.relative_to(folder).as_posix(),
    )


def refuse_special_files(folder: Path, error: type[BadInput]) -> None:
    """Raise ``error`` for a pipe or a device in a folder, since reading it in place of a file may never end."""
    for entry in folder.iterdir():
        if entry.exists() and not (entry.is_file() or entry.is_dir()):
            raise foreign_link(folder, entry, error)


def check_output_file(path: Path, mark: str, noun: str, error: type[BadInput], *, append: bool = False) -> None:
    """Check before the work that its result can be written to the file ``path``, and changes no other kind of file.

    Args:
        mark: text that each such file has among its first bytes. An empty file is accepted, too.
        noun: what such a file is, as in "a report of PlushSense".
        append: whether the result is added to an existing file, which then may also be a pipe or a device.

    Raises:
        error: for a folder, a file without ``mark``, and where nothing may be written; unless ``append``, for a device.
    """
    if path.is_dir():
        raise error(f"'{path}' is a folder: give a file.")
    try:
        if path.exists() and (path.is_file() or not append):
            with _open_regular(path) as file:
                head = file.read(_HEAD_BYTES)
            if head and mark.encode() not in head:
                raise error(f"'{path}' exists and is not {noun}: give another file, no other kind is changed.")
        if append and path.exists():
            return
        place = next((p for p in path.absolute().parents if p.exists()), None)
    except OSError as cause:
        raise error(f"'{path}' cannot be used ({cause.strerror or cause}): give another file.") from None
    if place is None or not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        raise error(f"'{path}' cannot be written: '{place or path}' is no folder in which you may write; give another.")


def write_file(path: Path, content: str | bytes, *, private: bool = False) -> None:
    """Write a file atomically (see `replacing_file`); text is encoded as UTF-8, with line ends unchanged."""
    with replacing_file(path, private=private) as part:
        part.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextlib.contextmanager
def replacing_file(
    path: Path,
    *,
    private: bool = False,
    within: Path | None = None,
    finishing: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; it replaces ``path`` when the block ends without an exception.

    Readers see either the old file or the new one, even after a power failure or with several writers at once. After
    an exception ``path`` is unchanged and nothing is left beside it; what a killed program left is deleted by the next
    one that writes ``path`` (not on Windows, nor on a disk without locks).

    Args:
        private: make the file readable by its owner only (mode 600, where the system has file modes).
        within: a folder on the same disk in which to write instead, such as a `work_folder` for large files.
        finishing: returns a context manager around the replacement, such as `dataset.store.Generation.writing`; what
            it raises prevents the replacement.

    Raises:
        OSError: when the file cannot be written; on Windows also while another program has ``path`` open.
    """
    place = within or path.parent
    _delete_abandoned_parts(place, path.name)
    part = place / f".{path.name}.{secrets.token_hex(4)}{PART}"
    owned = None
    try:
        owned = _create_part(part, 0o600 if private else 0o666)
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        with syncing_folder(path.parent) as sync, finishing():
            os.replace(part, path)
            sync()
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if owned is not None:
            os.close(owned)


def _create_part(part: Path, mode: int) -> int | None:
    """Create a part file, locked until the returned descriptor is closed; on Windows nothing is locked."""
    while True:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        if sys.platform == "win32":
            os.close(descriptor)
            return None
        import fcntl

        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor
        # Another program took it for an abandoned one before it was locked.
        os.close(descriptor)


def _delete_abandoned_parts(place: Path, name: str) -> None:
    """Delete the part files of ``name`` that no process locks any more, as a killed program leaves them."""
    if sys.platform == "win32":
        return
    import fcntl

    for part in place.glob(f".{glob.escape(name)}.*{PART}"):
        with contextlib.suppress(OSError):
            descriptor = os.open(part, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Otherwise another program deleted it, and a file of this name is one that its writer created again.
                if os.fstat(descriptor).st_nlink:
                    part.unlink()
            finally:
                os.close(descriptor)


@contextlib.contextmanager
def syncing_folder(folder: Path) -> Iterator[Callable[[], None]]:
    """Yield a function that flushes a folder's entries to the disk; on Windows it does nothing.

    The folder is opened first, so that opening cannot fail after a file has been renamed.
    """
    if os.name != "posix":
        yield lambda: None
        return
    descriptor = None
    # A folder without read permission cannot be opened, so it is not flushed.
    with contextlib.suppress(PermissionError):
        descriptor = os.open(folder, os.O_RDONLY)

    def sync() -> None:
        if descriptor is None:
            return
        try:
            os.fsync(descriptor)
        except OSError as cause:
            # Some file systems cannot flush folders.
            if cause.errno not in (errno.EINVAL, errno.ENOTSUP):
                raise

    try:
        yield sync
    finally:
        if descriptor is not None:
            os.close(descriptor)


@contextlib.contextmanager
def new_folder(
    dest: Path,
    error: type[BadInput],
    last: str = "",
    finishing: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> Iterator[Path]:
    """Yield a folder in a `work_folder` that becomes ``dest`` when the block ends, and is deleted after an exception.

    If ``dest`` is an existing empty folder (such as ``.``, or a link to one), the files are moved into it, with the
    file ``last`` moved last. ``finishing`` is as in `replacing_file`, around the moves.

    Raises:
        error: when ``dest`` exists and is not an empty folder, or cannot be written.
    """
    try:
        if dest.is_symlink() and not dest.exists():
            raise error(f"'{dest}' is a broken link: give a new or empty folder.")
        real = dest.resolve()
        if real.exists() and (not real.is_dir() or any(real.iterdir())):
            raise error(
                "'{path}' already holds something: give a new or empty folder, nothing is overwritten.", path=dest
            )
        real.parent.mkdir(parents=True, exist_ok=True)
        with work_folder(real) as scratch:
            work = scratch / (real.name or "folder")
            work.mkdir()
            yield work
            with finishing():
                if real.is_dir():
                    for entry in sorted(work.iterdir(), key=lambda p: p.name == last):
                        os.replace(entry, real / entry.name)
                else:
                    os.replace(work, real)
            with syncing_folder(real.parent) as sync:
                sync()
    except OSError as cause:
        where, why = f" at '{cause.filename}'" if cause.filename else "", cause.strerror or str(cause)
        raise error(
            "'{path}' cannot be created ({why}{where}): check the path and the disk.", path=dest, why=why, where=where
        ) from None


def free_path(path: Path, content: bytes) -> Path:
    """Return ``path``, or a numbered path next to it if a file with other content exists there."""
    number, free = 2, path
    while free.exists() and not (free.is_file() and free.read_bytes() == content):
        free = path.with_stem(f"{path.stem} {number}")
        number += 1
    return free
