"""Checksums of every file, and one zip for a repository: the same files make the same bytes."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from plushsense.core.errors import DatasetError
from plushsense.dataset.archives import DAMAGED, Limits, entry_of, refusal, unpack_member
from plushsense.dataset.freshness import sha256_of
from plushsense.dataset.publish.description import CHECKSUMS

_LINE = re.compile(r"(?P<sha>[0-9a-f]{64}) [ *](?P<path>.+)")
_LIMITS = Limits(total_bytes=64 * 2**30)
_BROKEN: tuple[type[Exception], ...] = (*DAMAGED, OSError)


def files_of(root: Path) -> list[Path]:
    """Every file below a folder, in the order of their paths."""
    found = [Path(place) / name for place, _, names in os.walk(root) for name in names]
    return sorted(found, key=lambda p: p.relative_to(root).as_posix())


def write_checksums(root: Path) -> int:
    """Write ``checksums.sha256`` as ``sha256sum`` reads it; returns the number of lines."""
    lines = [
        f"{sha256_of(path)}  {path.relative_to(root).as_posix()}\n" for path in files_of(root) if path.name != CHECKSUMS
    ]
    (root / CHECKSUMS).write_text("".join(lines), encoding="utf-8", newline="\n")
    return len(lines)


def read_checksums(root: Path) -> dict[str, str]:
    """Checksums by path.

    Raises:
        DatasetError: for a missing or damaged file.
    """
    path = root / CHECKSUMS
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"'{path}' cannot be read ({cause}).") from None
    sums = {}
    for number, line in enumerate(text.splitlines(), 1):
        found = _LINE.fullmatch(line)
        if found is None:
            raise DatasetError(f"'{path}' line {number} is no checksum and path.")
        sums[found["path"]] = found["sha"]
    return sums


def write_zip(root: Path, target: Path, folder: str) -> None:
    """Pack a package under one folder name; whole or not at all, and never in place of another file.

    Raises:
        DatasetError: when the file is there already.
    """
    if target.exists():
        raise DatasetError(f"'{target}' is already there: nothing is overwritten, give another OUT.")
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
            for path in files_of(root):
                entry = entry_of(f"{folder}/{path.relative_to(root).as_posix()}")
                archive.writestr(entry, path.read_bytes())
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def opened(package: Path) -> Iterator[Path]:
    """The folder of a package: itself, or a zip unpacked for as long as it is needed.

    Raises:
        DatasetError: for what is neither, or a zip whose entries would leave their folder.
    """
    if package.is_dir():
        yield package
        return
    if not package.is_file() or not zipfile.is_zipfile(package):
        raise DatasetError(f"'{package}' is no package: give the folder or the zip that  plushsense publish  made.")
    with TemporaryDirectory(prefix="plushsense-package-") as scratch:
        target = Path(scratch).resolve()
        try:
            with zipfile.ZipFile(package) as archive:
                members = [info for info in archive.infolist() if not info.is_dir()]
                if sum(info.file_size for info in members) > _LIMITS.total_bytes:
                    raise DatasetError(f"'{package}' would unpack to more than {_LIMITS.total_bytes // 2**30} GiB.")
                for info in members:
                    _unpack(archive, info, target, package)
        except _BROKEN as cause:
            raise DatasetError(f"'{package}' is a damaged zip ({cause}): fetch it again.") from None
        inside = list(target.iterdir())
        yield inside[0] if len(inside) == 1 and inside[0].is_dir() else target


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, package: Path) -> None:
    """Unpack one entry; a package comes out whole or not at all, so that a refused one refuses the package."""
    name = PurePosixPath(info.filename.replace("\\", "/"))
    outside = name.is_absolute() or ".." in name.parts or ":" in info.filename
    if reason := "it would be written outside" if outside else refusal(info, _LIMITS):
        raise DatasetError(
            f"'{package}' holds the entry '{info.filename}', which no package has: not unpacked ({reason})."
        )
    if (path := target.joinpath(*name.parts)).exists():
        raise DatasetError(f"'{package}' holds the entry '{info.filename}' twice: not unpacked.")
    unpack_member(archive, info, path, _LIMITS.total_bytes)
