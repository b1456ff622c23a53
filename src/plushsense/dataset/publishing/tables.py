"""Files of a package: the CSV tables beside the data, checksums, and packing and unpacking its zip."""

from __future__ import annotations

import csv
import io
import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from plushsense.core.errors import DatasetError
from plushsense.core.files import replacing_file
from plushsense.core.gestures import NOBODY
from plushsense.dataset.files import sha256_of
from plushsense.dataset.importing.archives import DAMAGED, UnpackLimits, refusal, unpack_member, zip_entry
from plushsense.dataset.publishing.contents import PackageContents
from plushsense.dataset.publishing.description import (
    CHANNELS_TABLE,
    CHECKSUMS,
    DATA,
    GESTURES_TABLE,
    INTEGER,
    NUMBER,
    RECORDINGS_TABLE,
    STREAMS_TABLE,
    SUBJECTS_TABLE,
    TEXT,
    YES_NO,
    PackageTable,
    TableColumn,
    sample_columns,
)
from plushsense.dataset.store import RECORDINGS, STREAMS, UNKNOWN_SUBJECT, Dataset

Row = tuple[object, ...]

_SUBJECT = TableColumn("subject", TEXT, "code of the person; none: nobody touched the toy; unknown: not known who")
_RECORDINGS = (
    TableColumn("id", TEXT, "the recording"),
    TableColumn("subject", TEXT, "who made it", refers="subjects.subject"),
    TableColumn("session", TEXT, "the person's session"),
    TableColumn("gesture", TEXT, "what was done", refers="gestures.gesture"),
    TableColumn("affect", TEXT, "what the gesture carries: positive, neutral, negative, or none where nobody said"),
    TableColumn("file", TEXT, "the file, from the root of the package"),
    TableColumn("first_row", INTEGER, "row of the file at which it begins, from 0", "row"),
    TableColumn("rows", INTEGER, "how many rows it has", "row"),
    TableColumn("start", INTEGER, "first row, counted from first_row, that remains after trimming", "row"),
    TableColumn("stop", INTEGER, "row before which the trimmed recording ends", "row"),
    TableColumn("excluded", YES_NO, "whether it is not to be used"),
    TableColumn("stream", TEXT, "file of the session's stream in which it stands; empty: not found in one"),
    TableColumn("stream_row", INTEGER, "row of that stream at which it begins, from 0", "row"),
    TableColumn("seconds", NUMBER, "how long it takes by the toy's clock, gaps and restarts left out", "s"),
    TableColumn("rate_hz", NUMBER, "measured rate", "Hz"),
    TableColumn("flags", TEXT, "what the checks at the door found, parted by |"),
    TableColumn("sha256", TEXT, "SHA-256 of the file"),
)
_STREAMS = (
    TableColumn("file", TEXT, "the file, from the root of the package"),
    TableColumn("subject", TEXT, "whose session it is", refers="subjects.subject"),
    TableColumn("session", TEXT, "the person's session"),
    TableColumn("rows", INTEGER, "how many rows it has", "row"),
    TableColumn("seconds", NUMBER, "how long it takes by the toy's clock, gaps and restarts left out", "s"),
    TableColumn("restarts", INTEGER, "how often the clock fell or left a gap"),
    TableColumn("flags", TEXT, "what the checks at the door found, parted by |"),
    TableColumn("sha256", TEXT, "SHA-256 of the file"),
)
_GESTURES = (
    TableColumn("class", INTEGER, "class index, from 0"),
    TableColumn("gesture", TEXT, "its label"),
    TableColumn("affect", TEXT, "what it carries: positive, neutral, negative, or none where nobody said"),
    TableColumn("family", TEXT, "its family of look-alikes"),
    TableColumn("free_choice", YES_NO, "whether everybody did something else under this label"),
    TableColumn("recordings", INTEGER, "how many recordings there are"),
    TableColumn("people", INTEGER, "by how many people"),
    TableColumn("description", TEXT, "how it is made"),
)
_CHANNELS = (
    TableColumn("channel", TEXT, "its name: the column of recordings and streams"),
    TableColumn("kind", TEXT, "what it measures"),
    TableColumn("unit", TEXT, "unit of the physical value"),
    TableColumn("offset", NUMBER, "physical value = (raw - offset) * scale"),
    TableColumn("scale", NUMBER, "see offset"),
    TableColumn("step", NUMBER, "smallest difference of raw values"),
    TableColumn("valid_min", NUMBER, "smallest valid raw value; what is below is sensor garbage"),
    TableColumn("valid_max", NUMBER, "largest valid raw value; what is above is sensor garbage"),
)


def build_tables(contents: PackageContents) -> list[tuple[PackageTable, str]]:
    """Return the tables beside the data, and the text of each."""
    d = contents.dataset
    people = _people_columns(contents)
    made = [
        (PackageTable("recordings", "one line a recording", _RECORDINGS, RECORDINGS_TABLE, key="id"), _recordings(d)),
        (PackageTable("subjects", "one line a person", people, SUBJECTS_TABLE, key="subject"), _people(contents)),
        (PackageTable("gestures", "one line a gesture", _GESTURES, GESTURES_TABLE, key="gesture"), _gestures(d)),
        (PackageTable("channels", "one line a channel", _CHANNELS, CHANNELS_TABLE, key="channel"), _channels(d)),
    ]
    if d.streams:
        made.append(
            (PackageTable("streams", "one line a session's stream", _STREAMS, STREAMS_TABLE, key="file"), _streams(d))
        )
    return [(table, _text(table, rows)) for table, rows in made]


def write_tables(root: Path, contents: PackageContents) -> tuple[PackageTable, ...]:
    """Write the tables beside the data, and describe them and the data's files."""
    d = contents.dataset
    made = []
    for table, text in build_tables(contents):
        (root / table.file).write_text(text, encoding="utf-8", newline="\n")
        made.append(table)
    labelled = d.layout.is_labelled
    columns = sample_columns(d.layout, labelled)
    if not labelled:
        files = tuple(sorted({f"{DATA}/{r.file}" for r in d.recordings}))
        made.append(
            PackageTable(
                "samples",
                "the rows of every recording, all files one after the other",
                columns,
                files=files,
                glob=f"{DATA}/{RECORDINGS}/**/*.csv",
            )
        )
    if d.streams:
        files = tuple(sorted(f"{DATA}/{s.file}" for s in d.streams))
        text = "the rows of every session's stream, what lay between the gestures included"
        made.append(PackageTable("stream-samples", text, columns, files=files, glob=f"{DATA}/{STREAMS}/**/*.csv"))
    return tuple(made)


def _text(table: PackageTable, rows: Iterable[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([c.name for c in table.columns])
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return out.getvalue()


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _recordings(d: Dataset) -> Iterable[Row]:
    files = {s.id: f"{DATA}/{s.file}" for s in d.streams}
    for r in d.recordings:
        found = r.stream_row >= 0 and r.stream in files
        gesture = d.gestures.find(r.gesture)
        yield (
            r.id,
            r.subject,
            r.session,
            r.gesture,
            gesture.affect if gesture else "none",
            f"{DATA}/{r.file}",
            r.first_row,
            r.rows,
            r.start,
            r.stop,
            r.excluded,
            files[r.stream] if found else "",
            r.stream_row if found else None,
            (r.rows - 1) / r.rate_hz if r.rate_hz > 0 else None,
            r.rate_hz,
            " | ".join(r.flags),
            r.sha256,
        )


def _streams(d: Dataset) -> Iterable[Row]:
    for s in d.streams:
        yield f"{DATA}/{s.file}", s.subject, s.session, s.rows, s.seconds, s.restarts, " | ".join(s.flags), s.sha256


def _people_columns(contents: PackageContents) -> tuple[TableColumn, ...]:
    more = dict.fromkeys(key for p in contents.people.values() for key in p.more)
    return (
        _SUBJECT,
        TableColumn("age_group", TEXT, "as given; empty: not said"),
        TableColumn("gender", TEXT, "as given; empty: not said"),
        *(TableColumn(key, TEXT, "as given by those who recorded") for key in more),
        TableColumn("recordings", INTEGER, "how many recordings there are"),
        TableColumn("sessions", INTEGER, "in how many sessions"),
    )


def _people(contents: PackageContents) -> Iterable[Row]:
    d = contents.dataset
    more = list(dict.fromkeys(key for p in contents.people.values() for key in p.more))
    # "none" and "unknown" are listed too, so that every reference resolves.
    for code in sorted({r.subject for r in d.recordings} | {s.subject for s in d.streams}):
        mine = [r for r in d.recordings if r.subject == code]
        person = contents.people.get(code)
        groups = (person.age_group, person.gender) if person else ("", "")
        own = [person.more.get(key, "") if person else "" for key in more]
        yield code, *groups, *own, len(mine), len({r.session for r in mine})


def _gestures(d: Dataset) -> Iterable[Row]:
    for index, g in enumerate(d.gestures.gestures):
        mine = [r for r in d.recordings if r.gesture == g.label]
        people = {r.subject for r in mine} - {NOBODY, UNKNOWN_SUBJECT}
        yield index, g.label, g.affect, g.family, g.free_choice, len(mine), len(people), g.description
    # Labels outside the gesture set are listed too, so that every reference resolves.
    for label in sorted({r.gesture for r in d.recordings} - set(d.gestures.labels)):
        mine = [r for r in d.recordings if r.gesture == label]
        yield None, label, "none", label, False, len(mine), len({r.subject for r in mine}), "not in the gesture set"


def _channels(d: Dataset) -> Iterable[Row]:
    for c in d.layout.channels:
        yield c.name, c.kind, c.unit, *(repr(v) for v in (c.offset, c.scale, c.step, c.valid_min, c.valid_max))


_LINE = re.compile(r"(?P<sha>[0-9a-f]{64}) [ *](?P<path>.+)")
_LIMITS = UnpackLimits(total_bytes=64 * 2**30)
_BROKEN: tuple[type[Exception], ...] = (*DAMAGED, OSError)


def list_package_files(root: Path) -> list[Path]:
    """Return every file below a folder, in the order of their paths."""
    found = [Path(place) / name for place, _, names in os.walk(root) for name in names]
    return sorted(found, key=lambda p: p.relative_to(root).as_posix())


def write_checksums(root: Path) -> int:
    """Write ``checksums.sha256`` in the format of ``sha256sum`` and return the number of lines."""
    lines = [
        f"{sha256_of(path)}  {path.relative_to(root).as_posix()}\n"
        for path in list_package_files(root)
        if path.name != CHECKSUMS
    ]
    (root / CHECKSUMS).write_text("".join(lines), encoding="utf-8", newline="\n")
    return len(lines)


def read_checksums(root: Path) -> dict[str, str]:
    """Read the checksums by path.

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
    """Pack a package under one folder name, completely or not at all; an existing file is never replaced.

    Raises:
        DatasetError: when the file is there already.
    """
    if target.exists():
        raise DatasetError(f"'{target}' is already there: nothing is overwritten, give another OUT.")
    with replacing_file(target) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for path in list_package_files(root):
            entry = zip_entry(f"{folder}/{path.relative_to(root).as_posix()}")
            archive.writestr(entry, path.read_bytes())


@contextmanager
def open_package(package: Path) -> Iterator[Path]:
    """Yield the folder of a package: itself, or a zip unpacked into a temporary folder.

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
    """Unpack one entry; a refused entry refuses the whole package."""
    name = PurePosixPath(info.filename.replace("\\", "/"))
    outside = name.is_absolute() or ".." in name.parts or ":" in info.filename
    if reason := "it would be written outside" if outside else refusal(info, _LIMITS):
        raise DatasetError(
            f"'{package}' holds the entry '{info.filename}', which no package has: not unpacked ({reason})."
        )
    if (path := target.joinpath(*name.parts)).exists():
        raise DatasetError(f"'{package}' holds the entry '{info.filename}' twice: not unpacked.")
    unpack_member(archive, info, path, _LIMITS.total_bytes)
