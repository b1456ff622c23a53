"""Scan a source: find its recordings and streams, each with person, session and label, and convert what is no CSV.

To support another file format, add a function that scans a file to ``FORMATS``; another folder structure is a function
in `importing.sources`.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name, read_recording
from plushsense.core.sentences import Sentence, plural
from plushsense.dataset.importing.archives import UnpackLimits, unpack
from plushsense.dataset.importing.intervals import read_intervals
from plushsense.dataset.importing.pattern import ImportPattern, check_roles
from plushsense.dataset.importing.results import NO_PEOPLE_OF_PATTERN, group_flags
from plushsense.dataset.importing.saved_windows import read_windows, windows_layout, write_windows
from plushsense.dataset.importing.sources import (
    LEFT_OUT,
    PATTERN,
    WINDOWS,
    SourceFile,
    SourceScan,
    classify_files,
    classify_session_files,
    common_layout,
    folder_name,
    is_simulation,
    moved_note,
    people_of,
    printable_path,
    read_sessions,
    session_of,
    source_files,
    split_regular_files,
)
from plushsense.dataset.importing.streams import find_people
from plushsense.dataset.importing.tables import SessionTarget, TableImport
from plushsense.dataset.importing.truncation import find_truncation
from plushsense.dataset.importing.xdf import ENDINGS, is_xdf, person_and_session, read_xdf
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, UNKNOWN_SUBJECT

SHOWN = 5
_SAMPLED_FILES, _SAMPLED_BYTES = 3, 200_000
_SINCE_2001_MS = 978_307_200_000


def find_layout(files: Sequence[Path], guess: bool) -> tuple[Layout, Sentence]:
    """Return the built-in layout of ``files``, and a note that says by what it was found.

    Args:
        guess: whether to take the most probable layout that can read the files if their header names none or several.

    Raises:
        ConfigError: if there is none, or several fit.
    """
    found, why = _named_in_header(files), "the header of the files has its channels"
    if not found and (found := _without_header(files)):
        why = f"the files have its {len(found[0].csv.columns)} columns"
    if len({layout.csv.columns for layout in found}) == 1 < len(found):
        # They differ in the clock that the toy sends. Files without rows tell nothing, and are refused later.
        found = (readable_layouts(files, [layout.name for layout in found]) or found[::-1])[:1]
        why += f", the last one a {'clock' if DEVICE_MS in found[0].wire else 'delay'}"
    elif guess and len(found) != 1:
        found = readable_layouts(files, [layout.name for layout in found])[:1]
    if len(found) == 1:
        name = found[0].name
        return found[0], Sentence(f"the layout is '{name}', as {why}", reason="layout_guessed", layout=name)
    fit = f"The header of the files fits {' and '.join(layout.name for layout in found)}. " if found else ""
    raise ConfigError(
        f"--layout is needed: accepted are {', '.join(layout_names())}, or a TOML file of your own, which "
        f"names the channels (see docs/importing.md). {fit}For files of another form, let --guess FILE.toml write "
        "a pattern.",
        reason="layout_unknown",
    )


def _named_in_header(files: Iterable[Path]) -> list[Layout]:
    """Return the built-in layouts with most channels, all of which the header of the first fitting CSV file names."""
    layouts = [load_layout(name) for name in layout_names()]
    for path in files:
        if path.suffix.lower() == ".csv":
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                texts = {text.strip().strip('"').casefold() for text in re.split("[,;\t]", file.readline(4096))}
            found = [
                layout
                for layout in layouts
                for of in (dict(zip(layout.csv.columns, layout.csv.header, strict=True)),)
                if all({name.casefold(), of.get(name, name).casefold()} & texts for name in layout.names)
            ]
            # A layout of an accelerometer also fits files that have more channels.
            if found:
                most = max(layout.n_channels for layout in found)
                return [layout for layout in found if layout.n_channels == most]
    return []


def readable_layouts(files: Iterable[Path], names: Sequence[str] = ()) -> list[Layout]:
    """Return the built-in layouts (or those in ``names``) that read the first CSV files, the most probable first.

    Layouts that differ only in the firmware's clock read the same files; the files tell a clock from delays.
    """
    samples: list[tuple[Path, bytes]] = []
    for path in files:
        if path.suffix.lower() == ".csv" and len(samples) < _SAMPLED_FILES:
            with path.open("rb") as file:
                data = file.read(_SAMPLED_BYTES)
            samples.append((path, data if len(data) < _SAMPLED_BYTES else data[: data.rfind(b"\n") + 1]))
    ranked: list[tuple[int, int, str]] = []
    for name in names or layout_names():
        layout, read, delays = load_layout(name), 0, 0
        for path, data in samples:
            with contextlib.suppress(FileFormatError):
                delays += read_recording(path, layout, data).integrated
                read += 1
        if read:
            ranked.append((-read, (DEVICE_MS not in layout.wire) != (delays > 0), name))
    return [load_layout(name) for _, _, name in sorted(ranked)]


def _without_header(files: Iterable[Path]) -> list[Layout]:
    """Return the built-in layouts that read the first recordings of the authors' recorder which have no header.

    Their truncation script leaves such files. The column of the computer's time must hold times since 2001.
    """
    named = [path for path in files if parse_name(path.name) is not None][:_SAMPLED_FILES]

    def reads(layout: Layout, path: Path) -> bool:
        with contextlib.suppress(FileFormatError):
            host = read_recording(path, layout).frames.host_ms
            return host is not None and float(np.median(host)) > _SINCE_2001_MS
        return False

    return [layout for layout in map(load_layout, layout_names()) if named and all(reads(layout, f) for f in named)]


@dataclass(frozen=True)
class ScanSpec:
    """What a scan needs, with the files read that an import names; see `importers.ScanSettings`.

    ``mapping`` is from file to person; ``layout_origin`` describes the layout in messages; ``new_folder`` creates a
    temporary folder for unpacked or converted files.
    """

    layout: Layout | None
    gestures: GestureSet | None
    mapping: Mapping[str, str] | None
    new_folder: Callable[[str], Path]
    layout_origin: str = "the given layout"
    columns: Mapping[str, str] = field(default_factory=dict)
    limits: UnpackLimits = field(default_factory=UnpackLimits)
    person: str | None = None
    guess_layout: bool = False
    pattern: ImportPattern | None = None
    streams: Path | None = None

    def begin_scan(self, shape: str, files: Iterable[Path], own: Layout | None = None) -> SourceScan:
        """Begin the scan of a source with the layout ``own``, else the given one, else that of the files."""
        layout, notes = own or self.layout, list[str]()
        if layout is None:
            layout, note = find_layout(list(files), self.guess_layout)
            notes.append(note)
        gestures = self.gestures
        if gestures is None and layout.name.startswith("plush"):
            gestures = load_gestures("plush-18")
        return SourceScan(layout, gestures, shape, notes=notes)

    def mapped(self, relative: Path) -> str | None:
        """Return the person whom the mapping names for a file, by its path below the source, or by its name."""
        mapping = self.mapping or {}
        return mapping.get(relative.as_posix(), mapping.get(relative.name))

    def convert_xdf(self, path: Path, name: str, person: str | None, scan: SourceScan) -> tuple[str, str]:
        """Convert an XDF file, and add its recordings and notes to ``scan``; return the person and the session."""
        subject, session = person_and_session(path, person)
        if self.mapping is not None:
            subject = person
        if subject is None:
            raise FileFormatError(
                f"the person of '{name}' is not known: name the person with --subjects map.csv (file,subject), or call "
                "the file sub-<code>_ses-<session>.xdf as LabRecorder does",
                reason="person_unknown",
            )
        target = SessionTarget(self.new_folder("converted"), subject, session, scan.layout)
        scan.add(read_xdf(path, name, target, scan.gestures, self.columns, self.limits))
        return subject, session


def scan_folder(source: Path, spec: ScanSpec, *, around: Path | None = None) -> SourceScan:
    """Scan a folder for sessions of PlushSense's recorder, XDF files, and recordings by the folder structure.

    ``around`` is the folder of the zip if ``source`` was unpacked from one; a mark of a simulation counts there too.
    """
    all_files = source_files(source)
    regular, refused = split_regular_files(f for f in all_files if f.name != SIMULATION_MARK)
    script = find_truncation(source, regular)
    refused += [SourceFile(f, LEFT_OUT, reason=why) for f, why in script.left_out.items()]
    refused += [SourceFile(f, "", reason=why) for f, why in script.refused.items()]
    sessions = read_sessions(script.files)
    own = common_layout(sessions, spec.layout, spec.layout_origin)
    in_session = [f for f in script.files if sessions and session_of(f, sessions) is not None]
    rest = sorted(set(script.files) - set(in_session)) if in_session else script.files
    scan = spec.begin_scan("sessions", [*script.files, *script.originals.values()], own)
    plain = [f for f in rest if not is_xdf(f)]
    if spec.columns and len(plain) == len(rest):
        role = next(iter(spec.columns))
        raise ConfigError(
            f"--column {role}=… is for a table or XDF files; '{source}' is a folder: describe it with --pattern FILE."
        )
    shape = "labelled-rows" if scan.layout.is_labelled else "gesture-recorder"
    scan.shape = shape if rest else scan.shape
    mapping = None if spec.mapping is None else dict(spec.mapping)
    scan.found = [*refused, *classify_session_files(sessions, in_session)]
    for file in classify_files(shape, source, plain, mapping, scan.gestures, spec.person):
        original = script.originals.get(file.source) if file.kind == RECORDINGS else None
        scan.found.append(file if original is None else replace(file, source=original, cut=file.source))
    scan.found = [replace(f, origin=printable_path(f.source.relative_to(source))) for f in scan.found]
    scan.people, of_people = people_of(sessions)
    scan.notes += [*moved_note(scan.found), *of_people, *script.notes]
    scan.choices = script.choices
    _scan_xdf_files(source, list(filter(is_xdf, rest)), spec, scan, around)
    if mapping is not None:
        present = {name for f in rest for name in (f.name, f.relative_to(source).as_posix())}
        if missing := [name for name in mapping if name not in present]:
            listed = ", ".join(f"'{m}'" for m in missing[:SHOWN]) + (", …" if len(missing) > SHOWN else "")
            scan.notes.append(f"files that the mapping names do not exist ({len(missing)}): {listed}")
    scan.simulated = is_simulation(around or source, all_files)
    scan.simulated |= any(not isinstance(head, str) and head.simulated for head in sessions.values())
    return scan


def _scan_xdf_files(source: Path, files: list[Path], spec: ScanSpec, scan: SourceScan, around: Path | None) -> None:
    """Convert the XDF files of a folder; add their recordings, and a note on sessions with several files."""
    files_of: dict[tuple[str, str], list[str]] = {}
    for file in files:
        name = printable_path(file.relative_to(source))
        person = None if file.parent == around else file.parent.resolve().name
        if file.parent == source and spec.person is not None:
            person = spec.person or None
        if spec.mapping is not None:
            person = spec.mapped(file.relative_to(source))
        with scan.refusing(file, name):
            files_of.setdefault(spec.convert_xdf(file, name, person, scan), []).append(name)
    for (subject, session), names in files_of.items():
        if len(names) > 1:
            message = f"{len(names)} files are the session '{session}' of '{subject}': {', '.join(names[:SHOWN])}"
            values = {"n": len(names), "session": session, "person": subject, "files": ", ".join(names[:SHOWN])}
            scan.notes.append(Sentence(message, reason="session_shared", **values))


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
    for file in (f for f in files if f not in of_labels):
        relative = file.relative_to(base)
        name, parts = printable_path(relative), pattern.match(relative.as_posix())
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
            scan.add(tables.convert(file, name, person, parts))
    scan.found += tables.origins()
    remarks = [n for n in scan.notes if isinstance(n, Sentence) and n.reason == "about_file"]
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
        message = f"'{path}' holds a data set: unpack it and open the folder, it needs no import."
        raise DatasetError(message, reason="import_of_dataset", name=path.name)
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
    spec.convert_xdf(path, path.name, person or spec.person or None, scan)
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
    **dict.fromkeys(ENDINGS, scan_xdf),
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
                f"'{source}' cannot be imported: give a folder, or a file that ends in {', '.join(FORMATS)}.",
                reason="file_no_recording",
            )
    except OSError as cause:
        raise DatasetError(f"'{source}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    except FileFormatError as cause:
        raise FileFormatError(f"'{source}': {cause}.", reason=cause.reason, **cause.values) from None
    if spec.streams is not None:
        find_people(scan, spec.streams)
    if not any(f.kind in (RECORDINGS, STREAMS) for f in scan.found):
        raise _nothing_found(source, spec, scan)
    return scan


def _nothing_found(source: Path, spec: ScanSpec, scan: SourceScan) -> DatasetError:
    """Return the error that a source holds no recording."""
    first = next((f" The first: '{f.origin}': {f.reason.rstrip('.')}." for f in scan.found if f.reason), "")
    unknown = any(getattr(f.reason, "reason", "") == "person_unknown" for f in scan.found)
    expected = "<label>_<epoch ms>_<rows>.csv in a folder per person"
    if spec.pattern is not None:
        expected = f"files that fit {', '.join(spec.pattern.paths)}"
    elif scan.shape == "labelled-rows":
        expected += " (or CSVs with a label column)"
    return DatasetError(
        f"'{source}' holds no recording: expected {expected}; found {plural(len(scan.found), 'other file')}.{first}"
        + ("" if spec.pattern is not None else " Other files can be described with --pattern FILE.toml."),
        reason="person_unknown" if unknown else "import_nothing",
        n=len(scan.found),
    )
