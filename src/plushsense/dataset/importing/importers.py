"""Import recordings into a new or existing data set; raw files are copied unchanged.

To support another file format, add a function that scans a file to ``FORMATS``; another folder structure is a function
in `importing.sources`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError
from plushsense.core.files import temporary_folder, work_folder, write_file
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name
from plushsense.core.sentences import Message
from plushsense.dataset.importing.adding import add_to_dataset
from plushsense.dataset.importing.archives import UnpackLimits, unpack
from plushsense.dataset.importing.build import (
    PATTERN,
    WINDOWS,
    ImportSummary,
    create_dataset,
    folder_name,
    group_flags,
)
from plushsense.dataset.importing.counters import counters_note
from plushsense.dataset.importing.intervals import read_intervals
from plushsense.dataset.importing.pattern import ImportPattern, check_roles, read_pattern
from plushsense.dataset.importing.preview import ImportPreview, preview
from plushsense.dataset.importing.proposals import (
    SELF_CALIBRATION,
    adopt,
    find_sensors,
    matching_layouts,
    propose_settings,
    readable_layouts,
    recorded_layouts,
)
from plushsense.dataset.importing.saved_windows import read_windows, windows_layout, write_windows
from plushsense.dataset.importing.sources import (
    LEFT_OUT,
    SourceFile,
    SourceScan,
    classify_files,
    classify_session_files,
    common_layout,
    is_simulation,
    moved_note,
    needs_person,
    people_of,
    printable_path,
    read_mapping,
    read_sessions,
    session_of,
    source_files,
    split_regular_files,
)
from plushsense.dataset.importing.streams import find_people
from plushsense.dataset.importing.tables import TableImport
from plushsense.dataset.importing.truncation import CHOSEN, REPLACED, Backups, choices_of
from plushsense.dataset.importing.xdf import ENDINGS, is_xdf, person_and_session, read_xdf
from plushsense.dataset.index import rebuild_index
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    UNKNOWN_SUBJECT,
    DatasetHead,
    Generation,
    Progress,
    read_people,
)

FOLDER = "folder"
SHOWN = 5
# Recordings in which channels that are no readings are looked for.
_SAMPLED = 40
LAYOUT_GUESSED = "the layout is '{layout}', as {why}"
ADOPTED = "adopted in the layout (--no-adopt keeps it as given): {listed}"
NO_PEOPLE_OF_PATTERN = Message(
    "the pattern finds no person, so the people are not known, and splits by subject are not possible: put {subject} "
    "into paths, give its column, or import again with --subjects map.csv (columns file,subject)"
)


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import; ``layout``, ``gestures`` and ``mapping`` (file to person) may be None.

    ``person``, ``guess_layout`` and ``streams`` are as in `import_recordings`.

    ``layout_origin`` describes the layout in messages; ``columns`` maps roles to column names; ``new_folder`` creates
    a temporary folder for unpacked or converted files.
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

    def known_layout(self, own: Layout | None, files: Iterable[Path]) -> tuple[Layout, list[str]]:
        """Return the layout ``own`` of the source, else the given one, else the one that the header of a file names.

        The second value are notes. Raises ConfigError if there is none, or several fit.
        """
        if (layout := own or self.layout) is not None:
            return layout, []
        files = list(files)
        found, why = matching_layouts(files), "the header of the files has its channels"
        if not found and (found := recorded_layouts(files)):
            why = f"the files have its {len(found[0].csv.columns)} columns"
        if len({layout.csv.columns for layout in found}) == 1 < len(found):
            # They differ in the clock that the toy sends. Files without rows tell nothing, and are refused later.
            found = (readable_layouts(files, [layout.name for layout in found]) or found[::-1])[:1]
            why += f", the last one a {'clock' if DEVICE_MS in found[0].wire else 'delay'}"
        elif self.guess_layout and len(found) != 1:
            found = readable_layouts(files, [layout.name for layout in found])[:1]
        if len(found) == 1:
            name = found[0].name
            return found[0], [Message(LAYOUT_GUESSED, layout=name, why=why)]
        fit = f"The header of the files fits {' and '.join(layout.name for layout in found)}. " if found else ""
        raise ConfigError(
            "--layout is needed: accepted are {layout_names}, or a TOML file of your own, which names the channels "
            "(see docs/importing.md). {fit}For files of another form, let --guess FILE.toml write a pattern.",
            layout_names=", ".join(layout_names()),
            fit=fit,
            needs="layout",
        )

    def known_gestures(self, layout: Layout) -> GestureSet | None:
        """Return the gesture set; None if it is to be inferred from the labels."""
        if self.gestures is None and layout.name.startswith("plush"):
            return load_gestures("plush-18")
        return self.gestures


def scan_folder(source: Path, options: ImportOptions, *, around: Path | None = None) -> SourceScan:
    """Search a folder for sessions of PlushSense's recorder, XDF files, and recordings by the folder structure.

    ``around`` is the folder of the zip if ``source`` was unpacked from one; a mark of a simulation counts there too.
    """
    all_files = source_files(source)
    simulated = is_simulation(around or source, all_files)
    files, refused = split_regular_files(f for f in all_files if f.name != SIMULATION_MARK)
    backups = Backups.among(source, files)
    choices, of_choices, unread = choices_of(source, backups.kept)
    files = [f for f in backups.kept if f not in of_choices]
    restored = {choice.name.casefold() for choice in backups.choices}
    choices = [choice for choice in choices if choice.name.casefold() not in restored] + backups.choices
    refused += [SourceFile(f, LEFT_OUT, reason=why) for f, why in backups.left_out.items()]
    refused += [SourceFile(f, LEFT_OUT, reason=REPLACED) for f in backups.originals]
    refused += [SourceFile(f, "" if why else LEFT_OUT, reason=why or CHOSEN) for f, why in of_choices.items()]
    sessions = read_sessions(files)
    own = common_layout(sessions, options.layout, options.layout_origin)
    layout, notes = options.known_layout(own, [*files, *backups.originals.values()])
    gestures = options.known_gestures(layout)
    in_session = [f for f in files if sessions and session_of(f, sessions) is not None]
    rest = sorted(set(files) - set(in_session)) if in_session else files
    plain = [f for f in rest if not is_xdf(f)]
    if options.columns and len(plain) == len(rest):
        role = next(iter(options.columns))
        raise ConfigError(
            f"--column {role}=… is for a table or XDF files; '{source}' is a folder: describe it with --pattern FILE."
        )
    mapping = None if options.mapping is None else dict(options.mapping)
    shape = "labelled-rows" if layout.is_labelled else "gesture-recorder"
    classified = (
        refused
        + list(classify_session_files(sessions, in_session))
        + classify_files(shape, source, plain, mapping, gestures, options.person)
    )
    classified = [
        replace(f, source=backups.originals[f.source], cut=f.source)
        if f.kind == RECORDINGS and f.source in backups.originals
        else f
        for f in classified
    ]
    classified = [replace(f, origin=printable_path(f.source.relative_to(source))) for f in classified]
    notes += moved_note(classified)
    people, more = people_of(sessions)
    notes += [*more, *unread]
    search = SourceScan(
        layout, gestures, shape if rest else "sessions", classified, people, notes=notes, choices=choices
    )
    files_of: dict[tuple[str, str], list[str]] = {}
    for file in filter(is_xdf, rest):
        name = printable_path(file.relative_to(source))
        person = None if file.parent == around else file.parent.resolve().name
        if file.parent == source and options.person is not None:
            person = options.person or None
        if mapping is not None:
            person = mapping.get(name, mapping.get(file.name))
        try:
            files_of.setdefault(_add_xdf(file, name, person, options, search), []).append(name)
        except FileFormatError as cause:
            search.found.append(SourceFile(file, "", origin=name, reason=cause.message))
    for (subject, session), names in files_of.items():
        if len(names) > 1:
            search.notes.append(
                Message(
                    "{n} files are the session '{session}' of '{person}': {files}",
                    n=len(names),
                    session=session,
                    person=subject,
                    files=names[:SHOWN],
                )
            )
    if mapping is not None:
        present = {name for f in rest for name in (f.name, f.relative_to(source).as_posix())}
        if missing := [name for name in mapping if name not in present]:
            listed = ", ".join(f"'{m}'" for m in missing[:SHOWN]) + (", …" if len(missing) > SHOWN else "")
            search.notes.append(f"files that the mapping names do not exist ({len(missing)}): {listed}")
    search.simulated = simulated or any(not isinstance(h, str) and h.simulated for h in sessions.values())
    return search


def scan_pattern(source: Path, options: ImportOptions, *, around: Path | None = None) -> SourceScan:
    """Search a folder or a file for the files that the pattern in ``options`` describes, and convert them.

    ``around`` is as in `scan_folder`.
    """
    pattern = options.pattern
    assert pattern is not None
    base = source if source.is_dir() else source.parent
    all_files = source_files(source) if source.is_dir() else [source]
    files, refused = split_regular_files(f for f in all_files if f.name != SIMULATION_MARK)
    layout, notes = options.known_layout(None, files)
    check_roles(pattern.columns, layout, "[columns] of the pattern: ")
    search = SourceScan(layout, options.known_gestures(layout), PATTERN, [], notes=notes)
    search.simulated = is_simulation(around or base, all_files)
    search.found += [replace(f, origin=printable_path(f.source.relative_to(base))) for f in refused]
    tables = TableImport(options.new_folder("converted"), layout, pattern)
    remarks: list[tuple[str, str]] = []
    of_labels = _add_intervals(base, files, pattern, tables, search)
    for file in (f for f in files if f not in of_labels):
        relative = file.relative_to(base).as_posix()
        name = printable_path(file.relative_to(base))
        place = pattern.match(relative)
        if place is None:
            excluded = pattern.excluded_by(relative)
            reason = (
                f"excluded by '{excluded}'" if excluded else f"fits no path of the pattern: {', '.join(pattern.paths)}"
            )
            search.found.append(SourceFile(file, LEFT_OUT, origin=name, reason=reason))
            continue
        person = options.person or (UNKNOWN_SUBJECT if options.person is None else None)
        if options.mapping is not None:
            person = options.mapping.get(relative, options.mapping.get(file.name))
        try:
            for entry in tables.convert(file, name, person, place):
                if isinstance(entry, Message):
                    remarks.append((entry.values["file"], entry.values["note"]))
                else:
                    search.found.append(entry)
        except FileFormatError as cause:
            search.found.append(SourceFile(file, "", origin=name, reason=cause.message))
    search.found += tables.origins()
    search.notes += group_flags(remarks, "files")
    if any(f.subject == UNKNOWN_SUBJECT for f in search.found):
        search.notes.append(NO_PEOPLE_OF_PATTERN)
    return search


def _add_intervals(
    base: Path, files: Iterable[Path], pattern: ImportPattern, tables: TableImport, search: SourceScan
) -> set[Path]:
    """Read the files of intervals that the pattern describes; return their paths."""
    found: set[Path] = set()
    for file in files:
        place = pattern.interval_place(file.relative_to(base).as_posix())
        if place is None:
            continue
        found.add(file)
        name = printable_path(file.relative_to(base))
        try:
            tables.intervals.append(read_intervals(file, name, pattern, place))
        except FileFormatError as cause:
            search.found.append(SourceFile(file, "", origin=name, reason=cause.message))
        else:
            search.found.append(SourceFile(file, LEFT_OUT, origin=name, reason="its intervals label other files"))
    return found


def scan_zip(path: Path, options: ImportOptions) -> SourceScan:
    """Unpack a zip beside the new data set and search it."""
    # As if the user had unpacked it: recordings at the top belong to the person with the name of the zip.
    folder = options.new_folder("unpacked") / folder_name(path.stem)
    folder.mkdir()
    refused = unpack(path, folder, options.limits)
    if any(folder.rglob(HEAD)):
        raise DatasetError("'{path}' holds a data set: unpack it and open the folder, it needs no import.", path=path)
    options = replace(options, person=options.person or None)
    scan = scan_folder if options.pattern is None else scan_pattern
    search = scan(folder, options, around=path.resolve().parent)
    search.found += [SourceFile(path, "", origin=printable_path(Path(name)), reason=reason) for name, reason in refused]
    return search


def scan_xdf(path: Path, options: ImportOptions) -> SourceScan:
    """Convert and search an XDF file."""
    search = _scan_of_file(path, "xdf", options)
    person = (options.mapping or {}).get(path.name) or options.person or None
    _add_xdf(path, path.name, person, options, search)
    return search


def _scan_of_file(path: Path, shape: str, options: ImportOptions, own: Layout | None = None) -> SourceScan:
    layout, notes = options.known_layout(own, [path])
    simulated = is_simulation(path.resolve().parent, [])
    return SourceScan(layout, options.known_gestures(layout), shape, [], notes=notes, simulated=simulated)


def _add_xdf(path: Path, name: str, person: str | None, options: ImportOptions, search: SourceScan) -> tuple[str, str]:
    """Convert an XDF file, and add its recordings and notes to ``search``; return the person and the session."""
    subject, session = person_and_session(path, person)
    if options.mapping is not None:
        subject = person
    if subject is None:
        raise FileFormatError(
            "the person of '{name}' is not known: name the person with --subjects map.csv (file,subject), or call "
            "the file sub-<code>_ses-<session>.xdf as LabRecorder does",
            name=name,
            needs="person",
        )
    folder = options.new_folder("converted")
    choices, limits = options.columns, options.limits
    _add(read_xdf(path, name, folder, subject, session, search.layout, search.gestures, choices, limits), search)
    return subject, session


def scan_table(path: Path, options: ImportOptions) -> SourceScan:
    """Convert and search a table with one row per sample."""
    if parse_name(path.name) is not None:
        raise DatasetError(f"'{path}' is one recording: give the folder that holds the people's folders.")
    search = _scan_of_file(path, "table", options)
    check_roles(options.columns, search.layout)
    person = (options.mapping or {}).get(path.name) or options.person or None
    pattern = ImportPattern(columns=dict(options.columns))
    tables = TableImport(options.new_folder("converted"), search.layout, pattern)
    _add(tables.convert(path, path.name, person), search)
    return search


def scan_windows(path: Path, options: ImportOptions) -> SourceScan:
    """Convert and search windows that MATLAB saved."""
    sets = read_windows(path, path.name)
    layout = windows_layout(sets[0].windows[0].shape[1], options.layout, path.name)
    search = _scan_of_file(path, WINDOWS, options, layout)
    search.simulated = search.simulated or sets[0].simulated
    person = (options.mapping or {}).get(path.name)
    _add(write_windows(path, path.name, options.new_folder("converted"), person, search.layout, sets), search)
    return search


def _add(entries: Iterable[SourceFile | str], search: SourceScan) -> None:
    """Add ``entries`` to ``search``: files to its files, texts to its notes."""
    for entry in entries:
        if isinstance(entry, str):
            search.notes.append(entry)
        else:
            search.found.append(entry)


FORMATS: dict[str, Callable[[Path, ImportOptions], SourceScan]] = {
    ".zip": scan_zip,
    **dict.fromkeys(ENDINGS, scan_xdf),
    ".parquet": scan_table,
    ".csv": scan_table,
    ".mat": scan_windows,
}


@contextmanager
def _temporary_folders(dest: Path) -> Iterator[Callable[[str], Path]]:
    """Yield a function that creates folders beside ``dest`` for unpacked or converted files; remove them at the end."""
    real = dest.resolve()
    with ExitStack() as stack:

        def create(purpose: str) -> Path:
            place = next(p for p in real.parents if p.is_dir())
            folder = stack.enter_context(work_folder(place / real.name)) / purpose
            folder.mkdir()
            return folder

        yield create


def scan_source(source: Path, options: ImportOptions) -> SourceScan:
    """Search ``source``: a folder, or a file in one of the ``FORMATS``.

    Raises:
        DatasetError: if it is neither, cannot be read, or contains nothing to import.
    """
    try:
        if options.pattern is not None and source.exists() and source.suffix.lower() != ".zip":
            search = scan_pattern(source, options)
        elif source.is_dir():
            search = scan_folder(source, options)
        elif source.is_file():
            scan = next((scan for ending, scan in FORMATS.items() if source.name.lower().endswith(ending)), None)
            if scan is None:
                raise DatasetError(
                    "'{source}' cannot be imported: give a folder, or a file that ends in {formats}.",
                    source=source,
                    formats=", ".join(FORMATS),
                )
            search = scan(source, options)
        else:
            raise DatasetError(
                f"There is no '{source}': give the recorder's folder, or a file that ends in {', '.join(FORMATS)}."
            )
    except OSError as cause:
        raise DatasetError(f"'{source}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    except FileFormatError as cause:
        raise FileFormatError("'{source}': {cause}.", source=source, cause=cause.message) from None
    if options.streams is not None:
        find_people(search, options.streams)
    if not any(f.kind in ("recordings", "streams") for f in search.found):
        first = next((f" The first: '{f.origin}': {f.reason.rstrip('.')}." for f in search.found if f.reason), "")
        unknown = any(needs_person(f.reason) for f in search.found)
        expected = "<label>_<epoch ms>_<rows>.csv in a folder per person"
        if options.pattern is not None:
            expected = f"files that fit {', '.join(options.pattern.paths)}"
        elif search.shape == "labelled-rows":
            expected += " (or CSVs with a label column)"
        if options.pattern is None:
            first += " Other files can be described with --pattern FILE.toml."
        raise DatasetError(
            "'{source}' holds no recording: expected {expected}; found {n:other file}.{first}",
            source=source,
            expected=expected,
            n=len(search.found),
            first=first,
            **({"needs": "person"} if unknown else {}),
        )
    return search


_OF_ADDED = (SELF_CALIBRATION, "valid_min", "valid_max")


def propose(done: ImportSummary, adopting: bool = False, added: bool = False) -> None:
    """Measure the data set of an import; add what fits it better to the summary, and if ``adopting`` to its layout.

    A layout adopts only what is proven, and a note says what that was. Warn of channels that are no readings.

    If recordings were ``added``, only failed readings and sensors that differ are proposed on: the layout has been
    chosen.
    """
    used = done.dataset.used
    some = used[:: max(1, len(used) // _SAMPLED)][:_SAMPLED]
    done.notes += counters_note(done.dataset.layout, [done.dataset.read(recording) for recording in some])
    sensors = find_sensors(done.dataset)
    done.sensors = [sensor.to_dict() for sensor in sensors]
    found = [p for p in propose_settings(done.dataset, sensors) if not added or p.key in _OF_ADDED]
    head = done.dataset.head
    layout = adopt(head.layout, found) if adopting else head.layout
    reasons: dict[str, list[str]] = {}
    for p in found:
        adopted = adopting and p.proven and (p.key != SELF_CALIBRATION or set(p.value) <= set(layout.self_calibration))
        done.proposals.append({**p.to_dict(), "advice": p.advice(adopted), "adopted": adopted})
        if adopted:
            reasons.setdefault(p.reason, []).append(p.setting)
    if reasons:
        settings = [f"{', '.join(texts)} ({reason})" for reason, texts in reasons.items()]
        what = [text for texts in reasons.values() for text in texts]
        done.notes.append(
            Message(
                ADOPTED,
                listed="; ".join(settings),
                settings=what,
            )
        )
    if layout != head.layout:
        head = replace(head, layout=layout)
        write_file(done.dataset.path / HEAD, head.to_toml())
        done.dataset = rebuild_index(done.dataset.path, head).dataset


def _options(
    new_folder: Callable[[str], Path],
    layout: Layout | str | Path | None = None,
    gestures: GestureSet | str | Path | None = None,
    subjects: str | Path = FOLDER,
    columns: Mapping[str, str] | None = None,
    limits: UnpackLimits | None = None,
    person: str | None = None,
    guess_layout: bool = False,
    pattern: ImportPattern | str | Path | None = None,
    streams: str | Path | None = None,
) -> ImportOptions:
    """Load the files that options of an import name; a layout, gestures or columns override those of the pattern."""
    if streams is not None and (str(subjects) != FOLDER or person or pattern is not None):
        raise ConfigError("--streams tells the people of recordings: leave --subjects, --pattern and a person out.")
    if pattern is not None and not isinstance(pattern, ImportPattern):
        pattern = read_pattern(pattern)
    if pattern is not None:
        pattern = replace(pattern, columns={**pattern.columns, **(columns or {})})
        layout = pattern.known_layout() if layout is None else layout
        gestures = pattern.known_gestures() if gestures is None else gestures
    return ImportOptions(
        layout if isinstance(layout, Layout) or layout is None else load_layout(layout),
        gestures if isinstance(gestures, GestureSet) or gestures is None else load_gestures(gestures),
        None if str(subjects) == FOLDER else read_mapping(Path(subjects)),
        new_folder,
        columns=columns or {},
        limits=limits or UnpackLimits(),
        person=person,
        guess_layout=guess_layout,
        pattern=pattern,
        streams=None if streams is None else Path(streams),
    )


def _grid(layout: Layout) -> list[tuple[str, float]]:
    """Return the name and the step of each channel."""
    return [(channel.name, channel.step) for channel in layout.channels]


def preview_import(source: str | Path, **given: Any) -> ImportPreview:
    """Return what `import_recordings` would understand of ``source``; nothing is written.

    Args:
        given: layout, gestures, subjects, columns, limits, person, guess_layout, pattern and streams of
            `import_recordings`.

    Raises:
        DatasetError: if there is nothing to import.
    """
    with temporary_folder() as place, _temporary_folders(place / "new") as folder:
        return preview(scan_source(Path(source), _options(folder, **given)))


def _check_layout(dest: Path, own: Layout, given: Layout | None, named: bool) -> None:
    """Raise DatasetError if a data set with the layout ``own`` cannot take recordings of the layout ``given``.

    Args:
        named: whether the user named the layout; otherwise it is that of a pattern.
    """
    # Rate, gap, offsets and others may have been adopted from the recordings.
    if named and given is not None and not (own.name == given.name and own.reads_as(given)):
        raise DatasetError(f"'{dest}' has the layout '{own.name}', not '{given.name}': leave --layout out.")
    if not named and given is not None and _grid(given) != _grid(own):
        raise DatasetError(
            f"'{dest}' has the channels {', '.join(own.names)}, but the pattern has {', '.join(given.names)}, or other "
            "steps: a data set has one layout, so import them apart."
        )


def import_recordings(
    source: str | Path,
    dest: str | Path,
    *,
    layout: Layout | str | Path | None = None,
    gestures: GestureSet | str | Path | None = None,
    subjects: str | Path = FOLDER,
    name: str | None = None,
    licence: str = "",
    consent: str = "",
    simulated: bool = False,
    progress: Progress | None = None,
    add_to: bool = False,
    people: str | Path | None = None,
    columns: Mapping[str, str] | None = None,
    limits: UnpackLimits | None = None,
    adopt_proposals: bool | None = None,
    person: str | None = None,
    guess_layout: bool = False,
    pattern: ImportPattern | str | Path | None = None,
    streams: str | Path | None = None,
) -> ImportSummary:
    """Create a data set at ``dest`` from recordings, or add them to an existing one.

    Args:
        source: a folder that a recorder wrote (sessions, a folder per person or per label), a zip of one, an XDF file,
            one table (.csv, .parquet), or windows that MATLAB saved (.mat).
        dest: a new or empty folder for the data set; with ``add_to`` the existing data set.
        layout: the sensor layout, its name or path; not needed with ``add_to``, for sessions of PlushSense, and for
            files whose header names all channels of one built-in layout.
        gestures: the gesture set; by default ``plush-18`` for plush layouts, else inferred from the labels.
        subjects: "folder" (the folder is the person) or the path of a mapping file ``file,subject``.
        simulated: whether the virtual toy made the recordings; detected in folders that `plushsense simulate` wrote.
        progress: called with (files done, number of files).
        people: the path of a people's table, see `dataset.store.read_people`.
        columns: the column of a table by role (``{"label": "activity"}``); in XDF files the ``stream`` and the
            ``markers`` by name or ``#number``, and the labels of channels.
        limits: limits of unpacking a zip.
        adopt_proposals: whether the layout of a new data set takes what its recordings prove (see `propose_settings`):
            rate, gap, offsets, units, valid ranges, self-calibration. Everything else is only reported.
        person: the person of files that name none: those directly in ``source``, in folders of gestures, and XDF files
            and tables without a person. "" refuses them; None takes the name of the folder where there is one.
        guess_layout: if no layout is given or stated, take the most probable built-in one that can read the files.
        pattern: description of files of other projects, or the path of its TOML file.
        streams: folders of people, each with its ``fulldatastream.csv``, in which recordings without a known person are
            found: they get the person and the place in the stream, which undoes their anonymisation.

    Returns:
        The summary. Every source file is imported (possibly with warnings), left out, or rejected with a reason.

    Raises:
        DatasetError: if there is nothing to import, or ``dest`` is not empty.
    """
    began = time.perf_counter()
    source, dest = Path(source), Path(dest)
    if people is not None and not Path(people).exists():
        raise DatasetError(f"There is no people's file '{people}': check the path.")
    people_info = {} if people is None else read_people(Path(people))
    if source.is_dir() and dest.resolve() != source.resolve() and dest.resolve().is_relative_to(source.resolve()):
        raise ConfigError(f"'{dest}' lies in '{source}', which is only read: give a folder outside of it.")
    if not add_to and (dest / HEAD).is_file():
        raise DatasetError(
            "'{path}' is a data set already: add to it with --add (Python: add_to=True), or give another folder; "
            "nothing is overwritten.",
            path=dest,
        )
    with _temporary_folders(dest) as new_folder:
        options = _options(
            new_folder, layout, gestures, subjects, columns, limits, person, guess_layout, pattern, streams
        )
        known, head = options.gestures, None
        generation = Generation.of(dest)
        if add_to:
            if adopt_proposals or name or licence or consent or streams:
                raise ConfigError(
                    "--add keeps the layout, name, licence, consent statement and people of the data set: leave "
                    "--adopt, --name, --licence, --consent and --streams out."
                )
            head = DatasetHead.read(dest)
            _check_layout(dest, head.layout, options.layout, named=layout is not None)
            # An inferred set cannot decide which markers of an XDF file are gestures.
            of_set = known if head.gestures.inferred else head.gestures
            options = replace(options, layout=head.layout, gestures=of_set, layout_origin="that of the data set")
        search = scan_source(source, options)
        search.simulated = search.simulated or simulated
        if head is None:
            new_head = DatasetHead(
                name=name or (source.resolve().name if source.is_dir() else source.stem),
                layout=search.layout,
                gestures=search.gestures or GestureSet("inferred", (), inferred=True),
                licence=licence,
                consent=consent,
                source=search.shape,
                simulated=search.simulated,
            )
            done = create_dataset(source, dest, search, new_head, people_info, progress)
            propose(done, adopt_proposals is not False)
        else:
            try:
                done = add_to_dataset(dest, search, known, people_info, progress, generation)
            except OSError as cause:
                generation.check()
                raise DatasetError(
                    f"'{dest}' cannot be written ({cause.strerror or cause}, {cause.filename}), but is as valid as "
                    "before: check the disk and import again."
                ) from None
            propose(done, added=True)
    done.seconds = time.perf_counter() - began
    return done
