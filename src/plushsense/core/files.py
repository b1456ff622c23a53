"""Write files and folders atomically: complete or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from plushsense.core.errors import BadInput

PART = ".part"
"""Suffix of unfinished files; those of a killed program can be deleted."""
_UNFINISHED = "-unfinished-"


def unfinished(dest: Path) -> str:
    """Return the prefix of the names of work folders for ``dest``, which are beside it."""
    return f".{dest.resolve().name}{_UNFINISHED}"


def is_unfinished(name: str) -> bool:
    """Return whether a file name is that of a work folder."""
    return name.startswith(".") and _UNFINISHED in name


def write_file(path: Path, content: str | bytes, *, private: bool = False) -> None:
    """Write a file in one step (see `replacing_file`); text as UTF-8 with unchanged line ends."""
    with replacing_file(path, private=private) as part:
        part.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextlib.contextmanager
def replacing_file(path: Path, *, private: bool = False) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; it replaces ``path`` when the block ends without an exception.

    Readers see the old file or the new one, also after a power failure and with several writers at once. After an
    exception ``path`` is unchanged and nothing is left beside it.

    Args:
        private: only the owner can read the file (mode 600, where the system has modes).

    Raises:
        OSError: when the file cannot be written; on Windows also while another program reads ``path``.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART}")
    try:
        if private:
            os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        with syncing_folder(path.parent) as sync:
            os.replace(part, path)
            sync()
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def syncing_folder(folder: Path) -> Iterator[Callable[[], None]]:
    """Yield a function that flushes the names in a folder to the disk, which Windows does by itself.

    The folder is opened at the start, so that no error occurs after a file has been renamed.
    """
    if os.name != "posix":
        yield lambda: None
        return
    descriptor = None
    # A folder without read permission cannot be flushed.
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
def new_folder(dest: Path, error: type[BadInput], last: str = "") -> Iterator[Path]:
    """Yield a work folder beside ``dest`` that becomes ``dest`` when the block ends, and is deleted after an exception.

    The name of the work folder is new each time. An empty ``dest`` (also ``.``, or a link to an empty folder) is filled
    rather than replaced, the file ``last`` at the end.

    Raises:
        error: when ``dest`` is not empty, or cannot be written.
    """
    scratch: Path | None = None
    try:
        if dest.is_symlink() and not dest.exists():
            raise error(f"'{dest}' is a broken link: give a new or empty folder.")
        real = dest.resolve()
        if real.exists() and (not real.is_dir() or any(real.iterdir())):
            raise error(f"'{dest}' already holds something: give a new or empty folder, nothing is overwritten.")
        real.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=unfinished(real), dir=real.parent))
        work = scratch / (real.name or "folder")
        work.mkdir()
        yield work
        if real.is_dir():
            for entry in sorted(work.iterdir(), key=lambda p: p.name == last):
                os.replace(entry, real / entry.name)
        else:
            os.replace(work, real)
        with syncing_folder(real.parent) as sync:
            sync()
    except OSError as cause:
        where = f" at '{cause.filename}'" if cause.filename else ""
        raise error(
            f"'{dest}' cannot be created ({cause.strerror or cause}{where}): check the path and the disk."
        ) from None
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
