"""Scan a source of any form: find its recordings and streams, and convert what is no CSV of the recorder.

To support another file format, add a function that scans a file to ``FORMATS``; another folder structure is a function
in `importing.folders`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name
from plushsense.core.sentences import Message
from plushsense.dataset.importing.archives import unpack
from plushsense.dataset.importing.folders import find_people, scan_folder
from plushsense.dataset.importing.intervals import read_intervals
from plushsense.dataset.importing.pattern import MARKERS_ROLE, STREAM_ROLE, ImportPattern, check_roles
from plushsense.dataset.importing.results import NO_PEOPLE_OF_PATTERN, group_flags
from plushsense.dataset.importing.saved_windows import read_windows, windows_layout, write_windows
from plushsense.dataset.importing.sources import (
    LEFT_OUT,
    PATTERN,
    WINDOWS,
    XDF_ENDINGS,
    ScanSpec,
    SourceFile,
    SourceScan,
    folder_name,
    is_simulation,
    printable_path,
    source_files,
    split_regular_files,
)
from plushsense.dataset.importing.tables import ABOUT_FILE, TableImport
from plushsense.dataset.importing.xdf import convert_xdf, is_xdf
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, UNKNOWN_SUBJECT

# Keys of a pattern that XDF has no use for.
_OF_TABLES = ("format", "separator", "missing", "between", "row_rate_hz", "time_unit", "intervals")


def scan_pattern(source: Path, spec: ScanSpec, *, around: Path | None = None) -> SourceScan:
    """Scan a folder or a file for the files that the pattern in ``spec`` describes, and convert them.

    ``around`` is as in `scan_folder`.
    """
    pattern = spec.pattern
    assert pattern is not None
    base = source if source.is_dir() else source.parent
    all_files = source_files(source) if source.is_dir() else [source]
    files, refused = split_regular_files(f for f in all_files if f.name != SIMULATION_MARK)
    scan = spec.begin_scan(PATTERN, files)
    check_roles(pattern.columns, scan.layout, "[columns] of the pattern: ")
    scan.simulated = is_simulation(around or base, all_files)
    scan.found = [replace(f, origin=printable_path(f.source.relative_to(base))) for f in refused]
    tables = TableImport(spec.new_folder("converted"), scan.layout, pattern)
    if any(map(is_xdf, files)) and (unused := [key for key in _OF_TABLES if getattr(pattern, key)]):
        scan.notes.append(Message("{keys} of the pattern are for tables, and not used for XDF", keys=", ".join(unused)))
    of_labels = {
        file: place
        for file in files
        if (place := pattern.interval_place(file.relative_to(base).as_posix())) is not None
    }
    for file, place in of_labels.items():
        name = printable_path(file.relative_to(base))
        with scan.refusing(file, name):
            tables.intervals.append(read_intervals(file, name, pattern, place))
            scan.found.append(SourceFile(file, LEFT_OUT, origin=name, reason="its intervals label other files"))
    places = {f: pattern.match(f.relative_to(base).as_posix()) for f in files if f not in of_labels}
    fitting = [file for file, parts in places.items() if parts is not None]
    chosen = set(fitting[:: max(1, len(fitting) // spec.most_files)] if spec.most_files else fitting)
    for file, parts in places.items():
        relative = file.relative_to(base)
        name = printable_path(relative)
        if parts is not None and file not in chosen:
            continue
        if parts is None:
            excluded = pattern.excluded_by(relative.as_posix())
            fits_none = f"fits no path of the pattern: {', '.join(pattern.paths)}"
            reason = f"excluded by '{excluded}'" if excluded else fits_none
            scan.found.append(SourceFile(file, LEFT_OUT, origin=name, reason=reason))
            continue
        person = spec.person or (UNKNOWN_SUBJECT if spec.person is None else None)
        if spec.mapping is not None:
            person = spec.mapped(relative)
        with scan.refusing(file, name):
            if is_xdf(file):
                own = (STREAM_ROLE, MARKERS_ROLE, *scan.layout.names)
                columns = {role: column for role, column in pattern.columns.items() if role in own}
                convert_xdf(file, name, person, replace(spec, columns=columns), scan, parts)
            else:
                scan.add(tables.convert(file, name, person, parts))
    scan.found += tables.origins()
    remarks = [n for n in scan.notes if isinstance(n, Message) and n.template == ABOUT_FILE]
    scan.notes = [note for note in scan.notes if note not in remarks]
    scan.notes += group_flags(((note.values["file"], note.values["note"]) for note in remarks), "files")
    if any(f.subject == UNKNOWN_SUBJECT for f in scan.found):
        scan.notes.append(NO_PEOPLE_OF_PATTERN)
    return scan


def scan_zip(path: Path, spec: ScanSpec) -> SourceScan:
    """Unpack a zip beside the new data set and scan it."""
    # As if the user had unpacked it: recordings at the top belong to the person with the name of the zip.
    folder = spec.new_folder("unpacked") / folder_name(path.stem)
    folder.mkdir()
    refused = unpack(path, folder, spec.limits)
    if any(folder.rglob(HEAD)):
        raise DatasetError("'{path}' holds a data set: unpack it and open the folder, it needs no import.", path=path)
    spec = replace(spec, person=spec.person or None)
    scan = (scan_folder if spec.pattern is None else scan_pattern)(folder, spec, around=path.resolve().parent)
    scan.found += [SourceFile(path, "", origin=printable_path(Path(name)), reason=reason) for name, reason in refused]
    return scan


def _scan_of_file(path: Path, shape: str, spec: ScanSpec, own: Layout | None = None) -> tuple[SourceScan, str | None]:
    """Begin the scan of a single file; return it, and the person whom the mapping names."""
    scan = spec.begin_scan(shape, [path], own)
    scan.simulated = is_simulation(path.resolve().parent, [])
    return scan, spec.mapped(Path(path.name))


def scan_xdf(path: Path, spec: ScanSpec) -> SourceScan:
    """Convert and scan an XDF file."""
    scan, person = _scan_of_file(path, "xdf", spec)
    convert_xdf(path, path.name, person or spec.person or None, spec, scan)
    return scan


def scan_table(path: Path, spec: ScanSpec) -> SourceScan:
    """Convert and scan a table with one row per sample."""
    if parse_name(path.name) is not None:
        raise DatasetError(f"'{path}' is one recording: give the folder that holds the people's folders.")
    scan, person = _scan_of_file(path, "table", spec)
    check_roles(spec.columns, scan.layout)
    tables = TableImport(spec.new_folder("converted"), scan.layout, ImportPattern(columns=dict(spec.columns)))
    scan.add(tables.convert(path, path.name, person or spec.person or None))
    return scan


def scan_windows(path: Path, spec: ScanSpec) -> SourceScan:
    """Convert and scan windows that MATLAB saved."""
    sets = read_windows(path, path.name)
    layout = windows_layout(sets[0].windows[0].shape[1], spec.layout, path.name)
    scan, person = _scan_of_file(path, WINDOWS, spec, layout)
    scan.simulated |= sets[0].simulated
    scan.add(write_windows(path, path.name, spec.new_folder("converted"), person, layout, sets))
    return scan


FORMATS: dict[str, Callable[[Path, ScanSpec], SourceScan]] = {
    ".zip": scan_zip,
    **dict.fromkeys(XDF_ENDINGS, scan_xdf),
    ".parquet": scan_table,
    ".csv": scan_table,
    ".mat": scan_windows,
}


def scan_source(source: Path, spec: ScanSpec) -> SourceScan:
    """Scan ``source``: a folder, or a file in one of the ``FORMATS``.

    Raises:
        DatasetError: if it is neither, cannot be read, or contains nothing to import.
    """
    ending = next((ending for ending in FORMATS if source.name.lower().endswith(ending)), "")
    try:
        if not source.is_dir() and not source.is_file():
            raise DatasetError(
                f"There is no '{source}': give the recorder's folder, or a file that ends in {', '.join(FORMATS)}."
            )
        if spec.pattern is not None and ending != ".zip":
            scan = scan_pattern(source, spec)
        elif source.is_dir():
            scan = scan_folder(source, spec)
        elif ending:
            scan = FORMATS[ending](source, spec)
        else:
            raise DatasetError(
                "'{source}' cannot be imported: give a folder, or a file that ends in {formats}.",
                source=source,
                formats=", ".join(FORMATS),
            )
    except OSError as cause:
        raise DatasetError(f"'{source}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    except FileFormatError as cause:
        raise FileFormatError("'{source}': {cause}.", source=source, cause=cause.message) from None
    if spec.streams is not None:
        find_people(scan, spec.streams, spec)
    if not any(f.kind in (RECORDINGS, STREAMS) for f in scan.found):
        raise _nothing_found(source, spec, scan)
    return scan


def _nothing_found(source: Path, spec: ScanSpec, scan: SourceScan) -> DatasetError:
    """Return the error that a source holds no recording."""
    first = next((f" The first: '{f.origin}': {f.reason.rstrip('.')}." for f in scan.found if f.reason), "")
    unknown = any(isinstance(f.reason, Message) and f.reason.values.get("needs") == "person" for f in scan.found)
    expected = "<label>_<epoch ms>_<rows>.csv in a folder per person"
    if spec.pattern is not None:
        expected = f"files that fit {', '.join(spec.pattern.paths)}"
    elif scan.shape == "labelled-rows":
        expected += " (or CSVs with a label column)"
    if spec.pattern is None:
        first += " Other files can be described with --pattern FILE.toml."
    return DatasetError(
        "'{source}' holds no recording: expected {expected}; found {n:other file}.{first}",
        source=source,
        expected=expected,
        n=len(scan.found),
        first=first,
        needs="person" if unknown else "files",
    )
