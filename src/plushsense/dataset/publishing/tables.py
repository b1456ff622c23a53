"""Write the files of a package: the CSV tables beside the data (``tables.toml``), checksums, and the zip."""

from __future__ import annotations

import csv
import filecmp
import io
import re
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from importlib import resources
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.files import replacing_file, temporary_folder, work_folder
from plushsense.core.gestures import NOBODY
from plushsense.core.toml import load_table
from plushsense.dataset.files import list_package_files, sha256_of
from plushsense.dataset.importing.archives import UnpackLimits, unpack, zip_entry
from plushsense.dataset.publishing.contents import PackageContents
from plushsense.dataset.publishing.description import (
    CHECKSUMS,
    DATA,
    TEXT,
    PackageTable,
    sample_columns,
)
from plushsense.dataset.publishing.texts import changed_text, kind_of
from plushsense.dataset.store import HEAD, PEOPLE, RECORDINGS, STREAMS, UNKNOWN_SUBJECT, Dataset, PersonInfo

Row = Mapping[str, object]


def build_tables(contents: PackageContents) -> list[tuple[PackageTable, str]]:
    """Return the tables beside the data, each with its text in CSV."""
    d = contents.dataset
    rows = {
        "recordings": list(_recordings(d)),
        "subjects": list(_people(contents)),
        "gestures": list(_gestures(d)),
        "channels": list(_channels(d)),
        **({"streams": list(_streams(d))} if d.streams else {}),
    }
    text = resources.files("plushsense.dataset.publishing").joinpath("tables.toml").read_text("utf-8")
    known = tomllib.loads(text)
    made = []
    for name, its_rows in rows.items():
        table = load_table(known[name] | {"name": name}, PackageTable, "tables.toml", DatasetError)
        if name == "subjects":
            code, *given, recordings, sessions = table.columns
            given = [replace(c, kind=kind_of(str(row[c.name]) for row in its_rows)) for c in given]
            table = replace(table, columns=(code, *given, recordings, sessions))
        _refuse_changed(table, its_rows)
        made.append((table, _text(table, its_rows)))
    return made


def _refuse_changed(table: PackageTable, rows: Iterable[Row]) -> None:
    """Raise DatasetError for a text that pandas, and thus mlcroissant, would read as something else."""
    for column in table.columns:
        if column.kind == TEXT and (text := changed_text(_cell(row[column.name]) for row in rows)) is not None:
            where = PEOPLE if table.name == "subjects" else HEAD
            raise DatasetError(
                "'{file}' would have the {column} '{text}', which other programs read as a number, a truth value or "
                "no value: write it in other words, or leave it empty, in '{where}' of the data set.",
                file=table.file,
                column=column.name,
                text=text,
                where=where,
            )


def write_tables(root: Path, contents: PackageContents) -> tuple[PackageTable, ...]:
    """Write the tables beside the data; return them and the tables of all recordings' and streams' files."""
    d = contents.dataset
    made = []
    for table, text in build_tables(contents):
        (root / table.file).write_text(text, encoding="utf-8", newline="\n")
        made.append(table)
    columns = sample_columns(d.layout)
    if not d.layout.is_labelled:
        files = tuple(sorted({f"{DATA}/{r.file}" for r in d.recordings}))
        text = "the rows of every recording, all files one after the other"
        made.append(PackageTable("samples", text, columns, files=files, glob=f"{DATA}/{RECORDINGS}/**/*.csv"))
    if d.streams:
        files = tuple(sorted(f"{DATA}/{s.file}" for s in d.streams))
        text = "the rows of every session's stream, including those between the gestures"
        made.append(PackageTable("stream-samples", text, columns, files=files, glob=f"{DATA}/{STREAMS}/**/*.csv"))
    return tuple(made)


def _text(table: PackageTable, rows: Iterable[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([c.name for c in table.columns])
    for row in rows:
        writer.writerow([_cell(row[c.name]) for c in table.columns])
    return out.getvalue()


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return " | ".join(value)
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _recordings(d: Dataset) -> Iterable[Row]:
    files = {s.id: f"{DATA}/{s.file}" for s in d.streams}
    for r in d.recordings:
        located = r.stream_row >= 0 and r.stream in files
        gesture = d.gestures.find(r.gesture)
        yield vars(r) | {
            "affect": gesture.affect if gesture else "none",
            "file": f"{DATA}/{r.file}",
            "stream": files[r.stream] if located else "",
            "stream_row": r.stream_row if located else None,
            "seconds": (r.rows - 1) / r.rate_hz if r.rate_hz > 0 else None,
        }


def _streams(d: Dataset) -> Iterable[Row]:
    for s in d.streams:
        yield vars(s) | {"file": f"{DATA}/{s.file}"}


def _people(contents: PackageContents) -> Iterable[Row]:
    d = contents.dataset
    # List "none" and "unknown" too, so that every reference can be resolved.
    for code in sorted({r.subject for r in d.recordings} | {s.subject for s in d.streams}):
        mine = [r for r in d.recordings if r.subject == code]
        person = contents.people.get(code, PersonInfo(code))
        counts = {"recordings": len(mine), "sessions": len({r.session for r in mine})}
        yield vars(person) | {"subject": code} | counts


def _gestures(d: Dataset) -> Iterable[Row]:
    # List labels outside the gesture set too, so that every reference can be resolved.
    known = {g.label: vars(g) for g in d.gestures.gestures}
    unknown = {"affect": "none", "free_choice": False, "description": "not in the gesture set"}
    for label in (*known, *sorted({r.gesture for r in d.recordings} - set(known))):
        mine = [r for r in d.recordings if r.gesture == label]
        yield known.get(label, unknown | {"family": label}) | {
            "class": d.gestures.labels.index(label) if label in known else None,
            "gesture": label,
            "recordings": len(mine),
            "people": len({r.subject for r in mine} - ({NOBODY, UNKNOWN_SUBJECT} if label in known else set())),
        }


def _channels(d: Dataset) -> Iterable[Row]:
    for c in d.layout.channels:
        # As text with all digits, since floats are rounded to three.
        numbers = {key: repr(getattr(c, key)) for key in ("offset", "scale", "step", "valid_min", "valid_max")}
        yield vars(c) | {"channel": c.name} | numbers


_LINE = re.compile(r"(?P<sha>[0-9a-f]{64}) [ *](?P<path>.+)")
_LIMITS = UnpackLimits(total_bytes=64 * 2**30)


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
    """Read ``checksums.sha256`` as SHA-256 by path; raise DatasetError if it is missing or damaged."""
    path = root / CHECKSUMS
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"'{path}' cannot be read ({cause}).") from None
    sums = {}
    for number, line in enumerate(text.splitlines(), 1):
        if (match := _LINE.fullmatch(line)) is None:
            raise DatasetError(f"'{path}' line {number} is no checksum and path.")
        sums[match["path"]] = match["sha"]
    return sums


def write_zip(root: Path, target: Path, finishing: Callable[[], AbstractContextManager[None]] = nullcontext) -> None:
    """Write the package as the zip ``target``, completely or not at all; ``finishing`` is as in `replacing_file`.

    It has no top folder, since frictionless looks for ``datapackage.json`` at the root of a zip.

    Raises:
        DatasetError: if ``target`` exists with another content.
    """
    with work_folder(target) as work, replacing_file(target, within=work, finishing=finishing) as part:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
            for path in list_package_files(root):
                entry = zip_entry(path.relative_to(root).as_posix())
                archive.writestr(entry, path.read_bytes())
        if target.exists() and not filecmp.cmp(part, target, shallow=False):
            raise DatasetError("'{path}' is already there: nothing is overwritten, give another OUT.", path=target)


@contextmanager
def open_package(package: Path) -> Iterator[Path]:
    """Yield the folder of a package; a zip is unpacked into a temporary folder.

    Raises:
        DatasetError: if ``package`` is neither a folder nor a zip, or an entry of the zip is refused.
    """
    if package.is_dir():
        yield package
        return
    if not package.is_file() or not zipfile.is_zipfile(package):
        raise DatasetError(
            "'{path}' is no package: give the folder or the zip that  plushsense publish  made.", path=package
        )
    with temporary_folder() as scratch:
        target = scratch.resolve() / "package"
        target.mkdir()
        try:
            refused = unpack(package, target, _LIMITS)
        except OSError as cause:
            raise DatasetError(
                "'{path}' cannot be unpacked: {why}.", path=package, why=cause.strerror or cause
            ) from None
        if refused:
            name, reason = refused[0]
            raise DatasetError(
                "'{path}' is not used, since its entry '{entry}' is refused: {reason}.",
                path=package,
                entry=name,
                reason=reason,
            )
        inside = list(target.iterdir())
        yield inside[0] if len(inside) == 1 and inside[0].is_dir() else target
