"""Find anonymised recordings in the streams of their sessions, which name the people.

``a_move_labelled_data.m`` moves the recordings of all people to folders of labels, under random names, and leaves the
stream of each person where it was. A recording is a part of it, with the same clocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.core.gestures import NOBODY
from plushsense.core.recorder_csv import STREAM_NAME, ReadResult, read_recording, read_stream
from plushsense.core.sentences import join_names, plural
from plushsense.dataset.importing.folders import classify_files
from plushsense.dataset.importing.sources import (
    ScanSpec,
    SourceFile,
    SourceScan,
    is_simulation,
    printable_path,
    source_files,
    split_regular_files,
)
from plushsense.dataset.index import RowLookup, locate
from plushsense.dataset.store import RECORDINGS, UNKNOWN_SUBJECT

_NAMED = 5
Stream = tuple[str, ReadResult, RowLookup]
"""Person, content and lookup of a stream."""


def find_people(scan: SourceScan, folder: Path, spec: ScanSpec) -> None:
    """Give the recordings of ``scan`` whose people are not known the people in whose streams they are.

    The streams in ``folder`` are added to the scan, and notes on how many recordings were found.

    Args:
        folder: folders of people, each with its ``fulldatastream.csv``.

    Raises:
        DatasetError: if ``folder`` has no stream, none of the recordings is in one, or ``scan`` has no recording
            without a known person.
    """
    if not folder.is_dir():
        raise DatasetError(f"There is no folder '{folder}': --streams names the folder of the people's folders.")
    files = source_files(folder)
    regular, _ = split_regular_files(f for f in files if f.name.casefold() == STREAM_NAME.casefold())
    found = classify_files("gesture-recorder", folder, regular, replace(spec, person=None), None)
    if not found:
        raise DatasetError(f"'{folder}' has no {STREAM_NAME}: --streams names the folder of the people's folders.")
    unknown = [f for f in scan.found if f.kind == RECORDINGS and f.subject in (UNKNOWN_SUBJECT, NOBODY)]
    if not any(f.subject == UNKNOWN_SUBJECT for f in unknown):
        raise DatasetError("--streams is for recordings whose people are not known; the source has none: leave it out.")
    streams = [s for f in found if (s := _read(f, scan)) is not None]
    people = {f.source: _people_of(f, streams, scan) for f in unknown}
    named = {path: mine[0] for path, mine in people.items() if len(mine) == 1}
    if not any(people.values()):
        raise DatasetError(
            f"None of {plural(len(people), 'recording')} is in a stream of '{folder}': give --streams the folder of "
            "the people who made them, or leave it out."
        )
    theirs = {path.resolve() for path in regular}
    scan.found = [
        replace(f, subject=named.get(f.source, f.subject)) for f in scan.found if f.source.resolve() not in theirs
    ]
    scan.found += [replace(f, origin=printable_path(f.source.relative_to(folder))) for f in found]
    scan.simulated = scan.simulated or is_simulation(folder, files)
    scan.streams_named = True
    note = f"{len(named)} of {len(people)} recordings are found in the streams of '{folder.name}'"
    if named:
        note += ", and have their people from there: this undoes the anonymisation of the recordings"
    scan.notes.append(note)
    lost = [f.origin for f in unknown if not people[f.source]]
    if lost:
        scan.notes.append(f"in none of the streams, so without a person ({len(lost)}): {join_names(lost, most=_NAMED)}")
    several = [f"{f.origin} ({join_names(mine)})" for f in unknown if len(mine := people[f.source]) > 1]
    if several:
        listed = join_names(several, most=_NAMED)
        scan.notes.append(f"in the streams of several people, so without a person ({len(several)}): {listed}")


def _read(file: SourceFile, scan: SourceScan) -> Stream | None:
    """Read a stream; None if it cannot be read, which the import says when it reads the copy."""
    try:
        read = read_stream(file.source, scan.layout)
    except FileFormatError:
        return None
    return file.subject, read, RowLookup.of(read.frames)


def _people_of(file: SourceFile, streams: Sequence[Stream], scan: SourceScan) -> list[str]:
    """Return the people in whose streams most of a recording is; several if equally many of its rows are in each."""
    try:
        recording = read_recording(file.source, scan.layout)
    except FileFormatError:
        return []
    rows: dict[str, int] = {}
    for person, stream, lookup in streams:
        rows[person] = max(rows.get(person, 0), locate(recording, stream, lookup)[1])
    most = max(rows.values(), default=0)
    return [person for person, n in rows.items() if n == most] if 2 * most > len(recording.frames) else []
