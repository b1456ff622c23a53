"""Import recordings into a new or existing data set; raw files are copied unchanged.

An import scans the source (`importing.scanning`), makes or extends the data set (`importing.build`), and measures what
would fit the recordings better (`importing.proposals`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, Unpack

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError
from plushsense.core.files import temporary_folder, work_folder, write_file
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, parse_name, read_recording, read_stream
from plushsense.core.sentences import Message
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.build import add_to_dataset, create_dataset, label_notes
from plushsense.dataset.importing.counters import counters_note
from plushsense.dataset.importing.pattern import ImportPattern, read_pattern
from plushsense.dataset.importing.proposals import (
    SELF_CALIBRATION,
    WINDOW,
    Proposal,
    adopt,
    find_sensors,
    propose_settings,
)
from plushsense.dataset.importing.results import FileReason, ImportPreview, ImportResult, PreviewRow, group_flags
from plushsense.dataset.importing.scanning import scan_source
from plushsense.dataset.importing.sources import LEFT_OUT, ScanSpec, SourceFile, SourceScan, folder_name, read_mapping
from plushsense.dataset.index import rebuild_index
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.dataset.quality.measurements import Examination
from plushsense.dataset.quality.recordings import clock_still
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    STREAMS,
    DatasetHead,
    Generation,
    PersonInfo,
    Progress,
    read_people,
)

FOLDER = "folder"
# Recordings in which channels that are no readings are looked for.
_SAMPLED = 40
_PREVIEWED_ROWS, _PREVIEWED_FILES = 10, 5


class ScanSettings(TypedDict, total=False):
    """Settings by which a source is read; none is needed.

    Attributes:
        layout: the sensor layout, its name or path; not needed with ``add_to``, for sessions of PlushSense, and for
            files whose header names all channels of one built-in layout.
        gestures: the gesture set; by default ``plush-18`` for plush layouts, else inferred from the labels.
        subjects: "folder" (the folder is the person) or the path of a mapping file ``file,subject``.
        columns: the column of a table by role (``{"label": "activity"}``); in XDF files the ``stream`` and the
            ``markers`` by name or ``#number``, and the labels of channels.
        limits: limits of unpacking a zip.
        person: the person of files that name none: those directly in ``source``, in folders of gestures, and XDF files
            and tables without a person. "" refuses them; None takes the name of the folder where there is one.
        guess_layout: if no layout is given or stated, take the most probable built-in one that can read the files.
        pattern: description of files of other projects, or the path of its TOML file.
        streams: folders of people, each with its ``fulldatastream.csv``, in which recordings without a known person are
            found: they get the person and the place in the stream, which undoes their anonymisation.
        most_files: with a pattern, read only about so many of the files that fit, for a preview; 0 reads all.
    """

    layout: Layout | str | Path | None
    gestures: GestureSet | str | Path | None
    subjects: str | Path
    columns: Mapping[str, str]
    limits: UnpackLimits
    person: str | None
    guess_layout: bool
    pattern: ImportPattern | str | Path | None
    streams: str | Path | None
    most_files: int


class ImportSettings(ScanSettings, total=False):
    """Settings of an import: those of `ScanSettings`, and what is said about the data set.

    Attributes:
        name: name of the data set; by default that of the source.
        licence: licence of the data set.
        consent: statement on the consent of the people.
        simulated: whether the virtual toy made the recordings; detected in folders that `plushsense simulate` wrote.
        people: the path of a people's table, see `dataset.store.read_people`.
        adopt_proposals: whether the layout of a new data set takes what its recordings prove (see `propose_settings`):
            rate, gap, offsets, units, valid ranges, self-calibration (default). False: nothing; True: also what is only
            probable, such as the self-calibration of channels whose rest differs between sessions.
        readmit: whether to take in people who were removed from the home that the data set lies in.
    """

    name: str | None
    licence: str
    consent: str
    simulated: bool
    people: str | Path | None
    adopt_proposals: bool | None
    readmit: bool


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


def _scan_spec(new_folder: Callable[[str], Path], given: ScanSettings) -> ScanSpec:
    """Load the files that settings name; a layout, gestures or columns override those of the pattern."""
    layout, gestures, pattern = given.get("layout"), given.get("gestures"), given.get("pattern")
    columns, streams, subjects = given.get("columns") or {}, given.get("streams"), given.get("subjects", FOLDER)
    if streams is not None and (str(subjects) != FOLDER or given.get("person") or pattern is not None):
        raise ConfigError("--streams tells the people of recordings: leave --subjects, --pattern and a person out.")
    if pattern is not None and not isinstance(pattern, ImportPattern):
        pattern = read_pattern(pattern)
    if pattern is not None:
        pattern = replace(pattern, columns={**pattern.columns, **columns})
        layout = pattern.known_layout() if layout is None else layout
        gestures = pattern.known_gestures() if gestures is None else gestures
    return ScanSpec(
        layout if isinstance(layout, Layout) or layout is None else load_layout(layout),
        gestures if isinstance(gestures, GestureSet) or gestures is None else load_gestures(gestures),
        None if str(subjects) == FOLDER else read_mapping(Path(subjects)),
        new_folder,
        columns=columns,
        limits=given.get("limits") or UnpackLimits(),
        person=given.get("person"),
        guess_layout=given.get("guess_layout", False),
        pattern=pattern,
        streams=None if streams is None else Path(streams),
        most_files=given.get("most_files", 0),
    )


def preview_import(source: str | Path, **settings: Unpack[ScanSettings]) -> ImportPreview:
    """Return what `import_recordings` would understand of ``source``; nothing is written.

    Raises:
        DatasetError: if there is nothing to import.
    """
    with temporary_folder() as place, _temporary_folders(place / "new") as folder:
        return _preview(scan_source(Path(source), _scan_spec(folder, settings)))


def _preview(scan: SourceScan) -> ImportPreview:
    """Read some rows of the files that a scan has found."""
    files = [f for f in scan.found if f.kind in (RECORDINGS, STREAMS)]
    recordings = [f for f in files if f.kind == RECORDINGS]
    named = {f.source: f.gesture or name.label for f in recordings if (name := parse_name(f.source.name)) is not None}
    some = recordings or files
    # One further each time, since the files of every person may be in the same order of gestures.
    places = range(0, len(some), max(1, len(some) // _PREVIEWED_FILES))
    some = [some[min(at + k, len(some) - 1)] for k, at in enumerate(places)][:_PREVIEWED_FILES]
    rows, frames, flags = list[PreviewRow](), list[Frames](), list[tuple[str, str]]()
    rejected = [FileReason(f.origin, f.reason) for f in scan.found if not f.kind]
    for file in some:
        try:
            read = (read_stream if file.kind == STREAMS else read_recording)(file.source, scan.layout)
        except FileFormatError as cause:
            rejected.append(FileReason(file.origin, str(cause)))
            continue
        frames.append(read.frames)
        first = read.frames.slice(0, -(-_PREVIEWED_ROWS // len(some)))
        rows += _preview_rows(file, named.get(file.source, ""), first, scan.layout)
        flags += [(file.origin, issue.message) for issue in clock_still(Examination(read.frames, scan.layout))]
    notes = [*scan.notes, *counters_note(scan.layout, frames), *group_flags(flags)]
    notes += label_notes(scan.gestures, named.values())
    return ImportPreview(
        scan.layout.name,
        len(recordings),
        len(files) - len(recordings),
        sorted({f.subject for f in files}),
        dict(sorted(Counter(named.values()).items())),
        tuple(rows[:_PREVIEWED_ROWS]),
        tuple(rejected),
        tuple(FileReason(f.origin, f.reason) for f in scan.found if f.kind == LEFT_OUT),
        tuple(notes),
    )


def _preview_rows(file: SourceFile, gesture: str, frames: Frames, layout: Layout) -> Iterator[PreviewRow]:
    low, high = layout.valid_min_int, layout.valid_max_int
    steps = [c.step for c in layout.channels]
    for k, row in enumerate(frames.values):
        valid = ((row >= low) & (row <= high)).tolist()
        values = [float(f"{v * s:.9g}") if ok else None for v, s, ok in zip(row.tolist(), steps, valid, strict=True)]
        label = gesture if frames.labels is None else str(frames.labels[k])
        named = dict(zip(layout.names, values, strict=True))
        yield PreviewRow(file.origin, file.subject, file.session, label, int(frames.device_ms[k]), named)


def import_recordings(
    source: str | Path,
    dest: str | Path,
    *,
    add_to: bool = False,
    progress: Progress | None = None,
    **settings: Unpack[ImportSettings],
) -> ImportResult:
    """Create a data set at ``dest`` from recordings, or add them to an existing one.

    Args:
        source: a folder that a recorder wrote (sessions, a folder per person or per label), a zip of one, an XDF file,
            one table (.csv, .parquet), or windows that MATLAB saved (.mat).
        dest: a new or empty folder for the data set; with ``add_to`` the existing data set.
        progress: called with (files done, number of files).
        settings: see `ImportSettings` and `ScanSettings`.

    Returns:
        The result. Every source file is imported (possibly with warnings), left out, or rejected with a reason.

    Raises:
        DatasetError: if there is nothing to import, or ``dest`` is not empty.
    """
    began = time.perf_counter()
    source, dest = Path(source), Path(dest)
    if source.is_dir() and dest.resolve() != source.resolve() and dest.resolve().is_relative_to(source.resolve()):
        raise ConfigError(f"'{dest}' lies in '{source}', which is only read: give a folder outside of it.")
    if not add_to and (dest / HEAD).is_file():
        raise DatasetError(
            "'{path}' is a data set already: add to it with --add (Python: add_to=True), or give another folder; "
            "nothing is overwritten.",
            path=dest,
        )
    with _temporary_folders(dest) as new_folder:
        run = _add if add_to else _create
        result = run(source, dest, _scan_spec(new_folder, settings), settings, progress)
    return replace(result, seconds=time.perf_counter() - began)


def _read_people(settings: ImportSettings) -> Mapping[str, PersonInfo]:
    people = settings.get("people")
    if people is not None and not Path(people).exists():
        raise DatasetError(f"There is no people's file '{people}': check the path.")
    return {} if people is None else read_people(Path(people))


def _admitted(scan: SourceScan, dest: Path, settings: ImportSettings) -> SourceScan:
    """Return the scan; raise DatasetError if it has people who were removed from the home of ``dest``."""
    if not settings.get("readmit"):
        refuse_removed(dest, {folder_name(file.subject) for file in scan.found if file.kind})
    return scan


def _create(
    source: Path, dest: Path, spec: ScanSpec, settings: ImportSettings, progress: Progress | None
) -> ImportResult:
    """Create a data set from a source."""
    people = _read_people(settings)
    scan = _admitted(scan_source(source, spec), dest, settings)
    head = DatasetHead(
        name=settings.get("name") or (source.resolve().name if source.is_dir() else source.stem),
        layout=scan.layout,
        gestures=scan.gestures or GestureSet("inferred", (), inferred=True),
        licence=settings.get("licence", ""),
        consent=settings.get("consent", ""),
        source=scan.shape,
        simulated=scan.simulated or settings.get("simulated", False),
    )
    return propose(create_dataset(source, dest, scan, head, people, progress), settings.get("adopt_proposals"))


def _add(source: Path, dest: Path, spec: ScanSpec, settings: ImportSettings, progress: Progress | None) -> ImportResult:
    """Add a source to a data set."""
    if any(settings.get(key) for key in ("adopt_proposals", "name", "licence", "consent", "streams")):
        raise ConfigError(
            "--add keeps the layout, name, licence, consent statement and people of the data set: leave "
            "--adopt, --name, --licence, --consent and --streams out."
        )
    people, generation, head = _read_people(settings), Generation.of(dest), DatasetHead.read(dest)
    _check_layout(dest, head.layout, spec.layout, named=settings.get("layout") is not None)
    # An inferred set cannot decide which markers of an XDF file are gestures.
    of_set = spec.gestures if head.gestures.inferred else head.gestures
    of_dataset = replace(spec, layout=head.layout, gestures=of_set, layout_origin="that of the data set")
    scan = _admitted(scan_source(source, of_dataset), dest, settings)
    scan.simulated |= settings.get("simulated", False)
    try:
        result = add_to_dataset(dest, scan, spec.gestures or scan.gestures, people, progress, generation)
    except OSError as cause:
        generation.check()
        raise DatasetError(
            f"'{dest}' cannot be written ({cause.strerror or cause}, {cause.filename}), but is as valid as "
            "before: check the disk and import again."
        ) from None
    return propose(result, added=True)


def _grid(layout: Layout) -> list[tuple[str, float]]:
    """Return the name and the step of each channel."""
    return [(channel.name, channel.step) for channel in layout.channels]


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


_OF_ADDED = (SELF_CALIBRATION, "valid_min", "valid_max")


def propose(result: ImportResult, adopting: bool | None = False, added: bool = False) -> ImportResult:
    """Measure the data set of an import; return its result with what fits it better, and adopt that.

    A layout adopts nothing (``adopting`` False), what is proven (None) or all (True), and a note says what that was.
    Warn of channels that are no readings.

    If recordings were ``added``, only failed readings and sensors that differ are proposed on: the layout has been
    chosen.
    """
    dataset, used = result.dataset, result.dataset.used
    some = used[:: max(1, len(used) // _SAMPLED)][:_SAMPLED]
    notes = counters_note(dataset.layout, [dataset.read(recording) for recording in some])
    sensors = find_sensors(dataset)
    found = [p for p in propose_settings(dataset, sensors) if not added or p.key in _OF_ADDED]
    layout = dataset.layout if adopting is False else adopt(dataset.layout, found, doubtful=adopting is True)
    taken = [adopting is not False and (p.proven or adopting is True) and _is_adopted(p, layout) for p in found]
    proposals = [replace(p, adopted=adopted) for p, adopted in zip(found, taken, strict=True)]
    if adopted := [p for p in proposals if p.adopted]:
        notes.append(_note_of_adopted(adopted))
    if layout != dataset.layout:
        head = replace(dataset.head, layout=layout)
        write_file(dataset.path / HEAD, head.to_toml())
        dataset = rebuild_index(dataset.path, head).dataset
    return replace(
        result, dataset=dataset, notes=(*result.notes, *notes), proposals=tuple(proposals), sensors=tuple(sensors)
    )


def _is_adopted(proposal: Proposal, layout: Layout) -> bool:
    """Return whether ``layout``, which adopted what it could, has the proposed setting; no layout has a window."""
    if proposal.key == SELF_CALIBRATION:
        return set(proposal.value) <= set(layout.self_calibration)
    return proposal.key != WINDOW


ADOPTED = "adopted in the layout (--no-adopt keeps it as given): {listed}"


def _note_of_adopted(adopted: Sequence[Proposal]) -> Message:
    """Return the note that says what a layout adopted, by reason."""
    by_reason: dict[str, list[str]] = {}
    for p in adopted:
        by_reason.setdefault(p.reason, []).append(p.setting)
    settings = [f"{', '.join(texts)} ({reason})" for reason, texts in by_reason.items()]
    return Message(
        ADOPTED, listed="; ".join(settings), settings=[text for texts in by_reason.values() for text in texts]
    )
