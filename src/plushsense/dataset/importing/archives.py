"""Unpack zip archives of unknown origin safely, and create reproducible entries for the zips that PlushSense writes.

Every member is unpacked or refused with a reason. Refused are links, devices, paths outside of the folder, names that
are ambiguous or reserved on some file system, encrypted or damaged members, and extreme expansion ratios.
"""

from __future__ import annotations

import re
import shutil
import stat
import struct
import unicodedata
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.sentences import Message

_CHUNK = 1 << 20
# The earliest time that a zip can store.
_WHEN = (1980, 1, 1, 0, 0, 0)
_DEEPEST = 30
_LONGEST_NAME = 200
_LONGEST_PATH = 800
# Small files are exempt from the ratio, since a recording of zeros compresses well.
_SMALL_BYTES = 4_000_000
# Names that Windows reserves for devices, with any suffix.
DEVICE_NAME = re.compile(r"^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$)\s*(\.|$)", re.IGNORECASE)
_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f:*?"<>|]')
DAMAGED: tuple[type[Exception], ...] = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    struct.error,
    ValueError,
)
"""Exceptions that zipfile raises for a damaged zip, or for bytes that are no zip."""
try:
    import lzma

    DAMAGED = (*DAMAGED, lzma.LZMAError)
except ImportError:  # A Python that was built without lzma refuses such members itself.
    pass


@dataclass(frozen=True)
class UnpackLimits:
    """Limits of unpacking: total bytes, number of files, and expansion ratio (only for members over 4 MB)."""

    total_bytes: int = 8_000_000_000
    files: int = 200_000
    ratio: float = 150.0

    def __post_init__(self) -> None:
        for key in ("total_bytes", "files", "ratio"):
            if not 0 < getattr(self, key) < 2**60:
                raise ConfigError(f"The archive limit {key} is {getattr(self, key)}; it must be above 0.")

    @classmethod
    def of_gigabytes(cls, gigabytes: float | None) -> UnpackLimits:
        """Return the limits with a total of ``gigabytes``; None for the default."""
        if gigabytes is None:
            return cls()
        if not 0 < gigabytes < 1e6:
            raise ConfigError(f"--max-gb is {gigabytes:g}: give a number above 0.")
        return cls(total_bytes=int(gigabytes * 1e9))

    def check(self, path: Path, files: int, total_bytes: int, place: Path) -> None:
        """Raise DatasetError if unpacking the archive ``path`` into ``place`` needs more than is allowed or free."""
        if files > self.files or total_bytes > self.total_bytes:
            raise DatasetError(
                "'{path}' would unpack to {there} files and {total_bytes:.1f} GB; {files} files and {gb:g} GB are "
                "allowed: if you trust it, allow more (--max-gb) or unpack it yourself.",
                path=path,
                there=files,
                total_bytes=total_bytes / 1e9,
                files=self.files,
                gb=self.total_bytes / 1e9,
            )
        there = next(folder for folder in (place.resolve(), *place.resolve().parents) if folder.is_dir())
        if total_bytes > (free := shutil.disk_usage(there).free):
            raise DatasetError(
                "'{path}' would unpack to {total_bytes:.1f} GB, but the disk of '{place}' has only {free:.1f} GB: "
                "make room, or give another place.",
                path=path,
                total_bytes=total_bytes / 1e9,
                place=place,
                free=free / 1e9,
            )


def zip_entry(name: str) -> zipfile.ZipInfo:
    """Return a zip entry with constant time and mode, so that zips of the same files are equal byte by byte."""
    entry = zipfile.ZipInfo(name, _WHEN)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system = 3
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    return entry


def member_target(name: str) -> PurePosixPath | Message:
    """Return the path of a member below the target folder, or the reason why it is refused."""
    plain = name.replace("\\", "/")
    if plain.startswith("/") or re.match(r"^[A-Za-z]:", plain):
        return Message("its path is absolute: it would be written outside the target")
    parts = [p for p in plain.split("/") if p not in ("", ".")]
    if ".." in parts:
        return Message("its path holds '..': it would be written outside the target")
    if not parts or len(parts) > _DEEPEST or len(plain) > _LONGEST_PATH:
        return Message("its path is empty, too deep or too long")
    for part in parts:
        if _FORBIDDEN.search(part) or part != part.rstrip(" .") or len(part.encode("utf-8", "replace")) > _LONGEST_NAME:
            return Message("its name is not one that every file system can hold")
        if DEVICE_NAME.match(part):
            return Message("'{part}' is the name of a device on Windows", part=part[:20])
    try:
        plain.encode("utf-8")
    except UnicodeEncodeError:
        return Message("its name is not UTF-8")
    return PurePosixPath(*parts)


def refusal(info: zipfile.ZipInfo, limits: UnpackLimits) -> Message | None:
    """Return the reason to refuse a member by its directory entry; None if it may be unpacked."""
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        return Message("a symbolic link is not followed")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        return Message("not a regular file")
    if info.flag_bits & 0x41:
        return Message("it is encrypted: unpack the archive with its password and import the folder")
    if info.file_size > _SMALL_BYTES and info.file_size > limits.ratio * max(1, info.compress_size):
        return Message(
            "it would swell {file_size:.0f} times, more than the {ratio:g} that are allowed",
            file_size=info.file_size / max(1, info.compress_size),
            ratio=limits.ratio,
        )
    return None


def unpack_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, limit: int) -> int:
    """Write one member to the new file ``target`` and return its size.

    If the member is longer than its declared size or than ``limit`` bytes, it is removed and BadZipFile raised.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    try:
        with archive.open(info) as member, target.open("xb") as out:
            while chunk := member.read(_CHUNK):
                written += len(chunk)
                if written > min(info.file_size, limit):
                    raise zipfile.BadZipFile("it holds more data than its stated size")
                out.write(chunk)
    except BaseException as cause:
        target.unlink(missing_ok=True)
        # For damaged bytes bzip2 raises OSError without an error number, unlike errors of the disk.
        if isinstance(cause, OSError) and cause.errno is None:
            raise zipfile.BadZipFile(str(cause)) from None
        raise
    return written


def unpack(path: Path, folder: Path, limits: UnpackLimits | None = None) -> list[tuple[str, Message]]:
    """Unpack the zip ``path`` into the empty ``folder``; return the refused members, each with the reason.

    Raises:
        DatasetError: for a file that is no zip, or one with more files or bytes than ``limits`` allow.
        OSError: for errors of the disk.
    """
    limits = limits or UnpackLimits()
    refused: list[tuple[str, Message]] = []
    try:
        archive = zipfile.ZipFile(path)
    except DAMAGED as cause:
        raise DatasetError(
            "'{path}' is no zip, or a damaged one ({message}): get another copy.", path=path, message=_message(cause)
        ) from None
    with archive:
        members = [m for m in archive.infolist() if not m.filename.endswith("/")]
        limits.check(path, len(members), sum(m.file_size for m in members), folder)
        seen: set[str] = set()
        room = limits.total_bytes
        for info in members:
            name = info.filename.encode("utf-8", "backslashreplace").decode()
            target = member_target(info.orig_filename if "\x00" in info.orig_filename else info.filename)
            if isinstance(target, Message):
                refused.append((name, target))
                continue
            if (reason := refusal(info, limits)) is not None:
                refused.append((name, reason))
                continue
            key = unicodedata.normalize("NFC", str(target)).casefold()
            if key in seen:
                refused.append((name, Message("another member has the same name, but for case or accents")))
                continue
            seen.add(key)
            try:
                room -= unpack_member(archive, info, folder / target, room)
            except (FileExistsError, NotADirectoryError, IsADirectoryError):
                refused.append((name, Message("another member stands where its folder would be")))
            except DAMAGED as cause:
                refused.append((name, Message("it is damaged: {message}", message=_message(cause))))
    return refused


def _message(cause: BaseException) -> str:
    return " ".join(str(cause).split())[:120] or type(cause).__name__
