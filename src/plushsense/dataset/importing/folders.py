"""Scan a folder of recordings: kind, person and session of each file.

Three folder structures are supported: sessions of PlushSense's recorder, folders of the GestureRecorder (by person, or
by label after the authors' anonymising step), and folders of CSVs with a label on every row. Outside a session, the
name of the nearest folder is the person. `find_people` finds anonymised recordings in the streams of their sessions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from plushsense.core.errors import BadInput, ConfigError, DatasetError, FileFormatError
from plushsense.core.gestures import NOBODY, Gesture, GestureSet, plain_label
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import (
    SIMULATION_MARK,
    STREAM_NAME,
    ReadResult,
    parse_name,
    read_recording,
    read_stream,
)
from plushsense.core.sentences import Message, join_names, plural
from plushsense.dataset.importing.sources import (
    COMPANIONS,
    LEFT_OUT,
    SHOWN,
    ScanSpec,
    SourceFile,
    SourceScan,
    is_simulation,
    printable_path,
    source_files,
    split_regular_files,
)
from plushsense.dataset.importing.truncation import BACKUP, CHOICES, CHOSEN, ORIGINAL, Choice, read_choices
from plushsense.dataset.importing.xdf import convert_xdf, is_xdf
from plushsense.dataset.index import RowLookup, locate
from plushsense.dataset.store import RECORDINGS, STREAMS, UNKNOWN_SUBJECT, PersonInfo
from plushsense.recording.writer import SESSION_HEAD, SESSION_LOG, SIDECAR, SessionHead, discarded_recordings

_ASK = (
    "import from the folder that holds one folder a person, or name the people with --subjects map.csv (file,subject)"
)


def scan_folder(source: Path, spec: ScanSpec, *, around: Path | None = None) -> SourceScan:
    """Scan a folder for sessions of PlushSense's recorder, XDF files, and recordings by the folder structure.

    ``around`` is the folder of the zip if ``source`` was unpacked from one; a mark of a simulation counts there too.
    """
    all_files = source_files(source)
    simulated = is_simulation(around or source, all_files)
    regular, refused = split_regular_files(f for f in all_files if f.name != SIMULATION_MARK)
    originals = [f for f in regular if any(map(BACKUP.fullmatch, f.relative_to(source).parts[:-1]))]
    of_choices = [f for f in regular if f.name.casefold() == CHOICES and f not in originals]
    refused += [SourceFile(f, LEFT_OUT, reason=ORIGINAL) for f in originals]
    choices, choices_files = _read_choices(source, of_choices)
    files = [f for f in regular if f not in {*originals, *of_choices}]
    sessions = read_sessions(files)
    own = common_layout(sessions, spec.layout, spec.layout_origin)
    in_session = [f for f in files if sessions and session_of(f, sessions) is not None]
    rest = sorted(set(files) - set(in_session))
    scan = spec.begin_scan("sessions", files, own)
    scan.gestures = _with_own_gestures(scan.gestures, sessions)
    plain = [f for f in rest if not is_xdf(f)]
    if spec.columns and len(plain) == len(rest):
        role = next(iter(spec.columns))
        raise ConfigError(
            f"--column {role}=… is for a table or XDF files; '{source}' is a folder: describe it with --pattern FILE."
        )
    shape = "labelled-rows" if scan.layout.is_labelled else "gesture-recorder"
    scan.shape = shape if rest else scan.shape
    scan.found = [*refused, *classify_session_files(sessions, in_session)]
    scan.found += classify_files(shape, source, plain, spec, scan.gestures)
    scan.found = [replace(f, origin=printable_path(f.source.relative_to(source))) for f in scan.found]
    scan.people, of_people = people_of(sessions)
    scan.notes += [*moved_note(scan.found), *of_people]
    scan.choices = choices
    scan.add(choices_files)
    _scan_xdf_files(source, list(filter(is_xdf, rest)), spec, scan)
    present = {name for f in rest for name in (f.name, f.relative_to(source).as_posix())}
    if missing := [name for name in spec.mapping or () if name not in present]:
        listed = join_names(map(repr, missing), most=SHOWN)
        scan.notes.append(f"files that the mapping names do not exist ({len(missing)}): {listed}")
    scan.simulated = simulated or any(not isinstance(head, str) and head.simulated for head in sessions.values())
    return scan


def _read_choices(source: Path, files: Iterable[Path]) -> tuple[list[Choice], list[SourceFile | str]]:
    """Read the choices of the truncation script in ``files`` of ``source``, or beside it, where the script writes them.

    Returns:
        The choices, and what became of each file; of one beside the source, a note if it cannot be read.
    """
    choices, about = list[Choice](), list[SourceFile | str]()
    beside = source.resolve().parent / CHOICES
    for path in [*files] or ([beside] if beside.is_file() else []):
        name = None if path == beside else printable_path(path.relative_to(source))
        try:
            choices += read_choices(path)
            about += [SourceFile(path, LEFT_OUT, origin=name, reason=CHOSEN)] if name else []
        except DatasetError as cause:
            note = Message("no trims are taken from the file beside the folder: {cause}", cause=cause, file=path.name)
            about.append(SourceFile(path, "", origin=name, reason=cause.message) if name else note)
    return choices, about


def _scan_xdf_files(source: Path, files: list[Path], spec: ScanSpec, scan: SourceScan) -> None:
    """Convert the XDF files of a folder; add their recordings, and a note on sessions with several files."""
    files_of: dict[tuple[str, str], list[str]] = {}
    for file in files:
        name = printable_path(file.relative_to(source))
        with scan.refusing(file, name):
            found = convert_xdf(file, name, _person_of(file, source, spec), spec, scan)
            files_of.setdefault(found, []).append(name)
    for (subject, session), names in files_of.items():
        if len(names) > 1:
            scan.notes.append(
                Message(
                    "{n} files are the session '{session}' of '{person}': {files}",
                    n=len(names),
                    session=session,
                    person=subject,
                    files=names[:SHOWN],
                )
            )


def _person_of(path: Path, source: Path, spec: ScanSpec) -> str | None:
    """Return the person of a file by the mapping, else by its folder; directly in ``source`` it is ``spec.person``."""
    if spec.mapping is not None:
        return spec.mapped(path.relative_to(source))
    if path.parent == source and spec.person is not None:
        return spec.person or None
    return path.parent.resolve().name


def _label_folders(labels: Mapping[Path, str], gestures: GestureSet | None) -> dict[Path, str]:
    """Return the folders that are named like a gesture, and its label; ``labels`` are those in the names of files.

    A gesture is one of the set, or a label of any file. The authors' scripts move recordings into such folders, and
    read the label from there.
    """
    known = set(map(plain_label, labels.values()))
    found: dict[Path, str] = {}
    for place in {path.parent for path in labels}:
        name = place.resolve().name
        gesture = gestures.find(name) if gestures is not None else None
        if gesture is not None or plain_label(name) in known:
            found[place] = name if gesture is None else gesture.label
    return found


def _same_gesture(one: str, other: str, gestures: GestureSet | None) -> bool:
    """Return whether two labels are of one gesture."""
    found = gestures.find(one) if gestures is not None else None
    same = found is not None and gestures is not None and found == gestures.find(other)
    return same or plain_label(one) == plain_label(other)


def _nobodys_folders(labels: Mapping[Path, str], gestures: GestureSet | None) -> set[Path]:
    """Return the folders in which every recording is of a gesture without a person (the toy at rest)."""
    by_nobody: dict[bool, set[Path]] = {True: set(), False: set()}
    for path, label in labels.items():
        gesture = gestures.find(label) if gestures is not None else None
        by_nobody[gesture is not None and gesture.nobody].add(path.parent)
    return by_nobody[True] - by_nobody[False]


def _refuse_unclear_people(source: Path, files: Iterable[SourceFile], *, nested: bool) -> None:
    """Raise DatasetError if two folders have the same name, so that people are neither merged nor split.

    With ``nested``, also raise it for a folder of recordings inside another one.
    """
    folders: dict[str, Path] = {}
    for f in files:
        other = folders.setdefault(f.subject.casefold(), f.source.parent)
        if other != f.source.parent:
            a, b = (p.relative_to(source).as_posix() for p in (other, f.source.parent))
            raise DatasetError(
                "The person is not clear: '{a}' and '{b}' in '{source}' have the same name: {ask}.",
                a=a,
                b=b,
                source=source,
                ask=_ASK,
            )
    places = set(folders.values())
    for place in sorted(places) if nested else ():
        if above := next((p for p in place.parents if p in places), None):
            raise DatasetError(
                "The person is not clear: '{a}' lies in '{b}', and both hold recordings: {ask}.",
                a=place,
                b=above,
                ask=_ASK,
            )


def _without_person(path: Path, spec: ScanSpec) -> SourceFile:
    """Return a file that is refused since its person is not known."""
    where = "in the folder of a person" if spec.mapping is None else "named in the mapping file of --subjects"
    return SourceFile(path, "", reason=Message("not {where}", where=where, needs="person"))


def _classify_gesture_recorder(
    source: Path, files: list[Path], spec: ScanSpec, gestures: GestureSet | None
) -> Iterator[SourceFile]:
    """Classify the files in the folders of the GestureRecorder.

    Without a mapping the nearest folder is the person, or nobody if all its recordings are of the toy at rest. A folder
    that is named like a gesture is no person: its people are not known, and its label is that of all its recordings, as
    a label is corrected by moving the file.
    """
    named = {path: name.label for path in files if (name := parse_name(path.name)) is not None}
    label_folders = _label_folders(named, gestures)
    labels = {path: label_folders.get(path.parent, label) for path, label in named.items()}
    nobodys = _nobodys_folders(labels, gestures)
    left_behind: set[Path] = set()
    if label_folders.keys() - nobodys:
        # Streams that the anonymising step has left behind belong to recordings that no longer name their person, and
        # the folder of all gestures is no person either.
        left_behind = {path.parent for path in files} - ({path.parent for path in named} - nobodys) | {source}
    for path in files:
        by_label = path.parent in label_folders or path.parent in left_behind
        subject = _person_of(path, source, spec)
        if path.parent in nobodys:
            # A mapping need not list recordings of the untouched toy.
            subject = NOBODY if spec.mapping is None or subject is None else subject
        elif by_label and spec.mapping is None:
            subject = spec.person or UNKNOWN_SUBJECT
        if path.name.casefold() == STREAM_NAME.casefold():
            if (by_label and not spec.person) or subject is None:
                note = Message("a session stream whose person is not known", needs="person")
                yield SourceFile(path, "", reason=note)
            else:
                yield SourceFile(path, STREAMS, subject)
        elif parse_name(path.name) is None:
            note = Message("not a recording: its name is not <label>_<epoch ms>_<rows>.csv")
            yield SourceFile(path, "", reason=note)
        elif subject is None:
            yield _without_person(path, spec)
        else:
            moved = not _same_gesture(named[path], labels[path], gestures)
            yield SourceFile(path, RECORDINGS, subject, gesture=labels[path] if moved else "")


def _classify_labelled_rows(source: Path, files: list[Path], spec: ScanSpec) -> Iterator[SourceFile]:
    """Classify CSVs with a label on every row: each file is a stream, and runs of equal labels are recordings."""
    one_person = spec.mapping is not None or all(path.parent == source for path in files)
    for path in files:
        known = one_person or path.parent != source or spec.person
        subject = _person_of(path, source, spec) if known else None
        if path.suffix.lower() != ".csv":
            yield SourceFile(path, "", reason=Message("not a CSV file"))
        else:
            yield _without_person(path, spec) if subject is None else SourceFile(path, STREAMS, subject)


def classify_files(
    shape: str, source: Path, files: list[Path], spec: ScanSpec, gestures: GestureSet | None
) -> list[SourceFile]:
    """Classify regular files of the folder structure ``shape``, labelled-rows or gesture-recorder; each once.

    Raises:
        DatasetError: if the folders do not identify the people.
    """
    by_rows = shape == "labelled-rows"
    found = (
        _classify_labelled_rows(source, files, spec)
        if by_rows
        else _classify_gesture_recorder(source, files, spec, gestures)
    )
    classified = list(found)
    if spec.mapping is None:
        # A person that was named may have recordings in several folders of gestures.
        people = [f for f in classified if f.kind and f.subject not in (spec.person, NOBODY, UNKNOWN_SUBJECT)]
        _refuse_unclear_people(source, people, nested=not by_rows)
    return classified


# Suffixes of files that the recorder leaves behind if it is killed, or is still running.
_UNFINISHED = Message("not finished when the recorder stopped; its rows are in the session's stream")
LEFT_OVER = {
    ".part": _UNFINISHED,
    ".new": _UNFINISHED,
    ".torn": Message("damaged by a crash and renamed by the recorder; its rows are in the session's stream"),
    ".lock": Message("a lock of the recorder"),
}

Sessions = dict[Path, SessionHead | str]


def read_sessions(files: Iterable[Path]) -> Sessions:
    """Return for each session folder among ``files`` its head, or the reason why that cannot be used."""
    sessions: Sessions = {}
    for path in files:
        if path.name != SESSION_HEAD:
            continue
        try:
            head = SessionHead.read(path.parent)
            if head is not None and head.subject.strip():
                Layout.from_dict(head.layout, "layout")
        except (BadInput, RecursionError) as cause:
            sessions[path.parent] = Message("its {file} cannot be used: {cause}", file=SESSION_HEAD, cause=cause)
            continue
        if head is not None:
            nobody = Message("its {session_head} names no subject", session_head=SESSION_HEAD, needs="person")
            sessions[path.parent] = head if head.subject.strip() else nobody
    return sessions


def session_of(path: Path, sessions: Mapping[Path, object]) -> Path | None:
    """Return the nearest session folder that contains a file; None if there is none."""
    return next((place for place in path.parents if place in sessions), None)


def common_layout(sessions: Sessions, given: Layout | None, of: str) -> Layout | None:
    """Return the layout that all sessions and ``given`` share; ``of`` describes ``given`` in messages.

    Raises:
        DatasetError: if two layouts differ, or sessions have a layout with a label on every row.
    """
    agreed = given
    for place, head in sessions.items():
        if isinstance(head, str):
            continue
        own = Layout.from_dict(head.layout, f"layout of the session '{place.name}'")
        if agreed is None:
            agreed, of = own, f"session '{place.name}'"
        elif own.to_dict() != agreed.to_dict():
            other = f"'{own.name}'" if own.name != agreed.name else f"another '{own.name}'"
            raise DatasetError(
                "Session '{session}' was recorded with the layout {differing}, but {of} is '{other}': a data set has "
                "one layout, so import them apart.",
                session=place.name,
                differing=other,
                of=of,
                other=agreed.name,
                layout=own.name,
            )
    if agreed is not None and agreed.is_labelled and any(isinstance(h, SessionHead) for h in sessions.values()):
        raise DatasetError(
            f"Layout '{agreed.name}' has a label on every row, unlike sessions: remove 'label' from its csv.columns."
        )
    return agreed


def classify_session_files(sessions: Sessions, files: Iterable[Path]) -> Iterator[SourceFile]:
    """Classify those of ``files`` that are in session folders."""
    by_session: dict[Path, list[Path]] = {}
    for path in files:
        place = session_of(path, sessions)
        if place is not None:
            by_session.setdefault(place, []).append(path)
    for place, mine in by_session.items():
        head = sessions[place]
        if isinstance(head, str):
            yield from (SourceFile(path, "", reason=head) for path in mine)
        else:
            yield from _find(place, head, mine)


def _find(place: Path, head: SessionHead, files: list[Path]) -> Iterator[SourceFile]:
    try:
        discarded = discarded_recordings(place)
    except (BadInput, OverflowError, RecursionError) as cause:
        # Without the log it is unknown which recordings were discarded.
        note = Message("its {file} cannot be used: {cause}", file=SESSION_LOG, cause=cause)
        yield from (SourceFile(path, "", reason=note) for path in files)
        return
    stream = place / STREAM_NAME
    mains = {p.with_suffix("").as_posix(): p for p in files if p == stream or parse_name(p.name) is not None}
    for path in files:
        of_session = partial(SourceFile, path, subject=head.subject, session=head.session or place.name)
        name = path.name
        if path == stream:
            yield of_session(STREAMS)
        elif parse_name(name) is not None:
            yield of_session(RECORDINGS, set_aside=discarded.get(name, ""))
        elif path.parent == place and name in (SESSION_HEAD, SESSION_LOG):
            yield of_session(COMPANIONS, beside=stream if stream in files else None)
        elif path.suffix in LEFT_OVER:
            yield of_session(LEFT_OUT, reason=LEFT_OVER[path.suffix])
        elif name.endswith(SIDECAR):
            main = mains.get(path.with_suffix("").as_posix())
            if main is None:
                note = Message("the sidecar of a recording that is missing")
                yield of_session(LEFT_OUT, reason=note)
            else:
                yield of_session(COMPANIONS, beside=main)
        else:
            note = Message("no file of a session: expected are recordings, sidecars, stream and log")
            yield of_session("", reason=note)


def moved_note(files: Iterable[SourceFile]) -> list[Message]:
    """Return a note on recordings that get the label of their folder, and not that of their name."""
    moved = [f for f in files if f.gesture]
    if not moved:
        return []
    first = f"'{moved[0].source.name}' in '{moved[0].gesture}'"
    return [
        Message(
            "{n:recording} in the folder of another gesture than the name says (the first: {file}): the folder's "
            "label is taken by a mark, as the authors' scripts read the label from the folder",
            n=len(moved),
            file=first,
        )
    ]


def _with_own_gestures(given: GestureSet | None, sessions: Sessions) -> GestureSet | None:
    """Return the gesture set with the gestures that protocols of the sessions add, and their affects."""
    heads = [h for h in sessions.values() if isinstance(h, SessionHead)]
    own = {label: affect for h in heads for label, affect in dict(h.protocol.get("affects") or {}).items()}
    if given is None or not own:
        return given
    new = tuple(Gesture(label, affect) for label, affect in own.items() if given.find(label) is None)
    return GestureSet(given.name, given.gestures + new, given.inferred)


def people_of(sessions: Sessions) -> tuple[list[PersonInfo], list[str]]:
    """Return the people of the sessions, with the latest value of each field, and a note for each changed value."""
    people: dict[str, PersonInfo] = {}
    notes: list[str] = []
    heads = sorted((h for h in sessions.values() if isinstance(h, SessionHead)), key=lambda h: h.started_ms)
    for head in heads:
        values = {key: _plain(getattr(head, key)) for key in ("age_group", "gender", "consent")}
        before = people.get(head.subject)
        for key, value in values.items() if before is not None else ():
            earlier = getattr(before, key)
            if earlier and value and earlier != value:
                notes.append(
                    Message(
                        "the sessions of '{person}' differ in {key} ('{old}', '{new}'): the latest is kept",
                        person=head.subject,
                        key=key.replace("_", " "),
                        old=earlier,
                        new=value,
                    )
                )
            values[key] = value or earlier
        people[head.subject] = PersonInfo(head.subject, values["age_group"], values["gender"], values["consent"])
    return list(people.values()), notes


def _plain(text: str) -> str:
    """Return ``text`` as one printable line."""
    text = text.encode("utf-8", "replace").decode("utf-8")
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


Stream = tuple[str, ReadResult, RowLookup]
"""Person, content and lookup of a stream."""


def find_people(scan: SourceScan, folder: Path, spec: ScanSpec) -> None:
    """Give the recordings of ``scan`` whose people are not known the people in whose streams they are.

    ``a_move_labelled_data.m`` moves the recordings of all people to folders of labels, under random names, and leaves
    the stream of each person where it was; a recording is a part of it, with the same clocks. The streams in ``folder``
    are added to the scan, and notes on how many recordings were found.

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
        scan.notes.append(f"in none of the streams, so without a person ({len(lost)}): {join_names(lost, most=SHOWN)}")
    several = [f"{f.origin} ({join_names(mine)})" for f in unknown if len(mine := people[f.source]) > 1]
    if several:
        listed = join_names(several, most=SHOWN)
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
