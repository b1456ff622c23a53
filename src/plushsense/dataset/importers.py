"""What can be imported, and the import: raw files are copied unchanged, and every file is accounted for.

A format is a function that finds recordings in a file, and one line in ``FORMATS``; a shape of folder is one in
`dataset.sources`.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.recfile import SIMULATION_MARK, parse_name
from plushsense.core.signal import Layout, layout_names, load_layout
from plushsense.dataset.adding import add
from plushsense.dataset.archives import Limits, unpack
from plushsense.dataset.copying import safe
from plushsense.dataset.index import Progress
from plushsense.dataset.making import ImportSummary, make
from plushsense.dataset.people import read_people
from plushsense.dataset.sessions import common_layout, find_sessions, people_of, read_sessions, session_of
from plushsense.dataset.sources import Found, Search, find, is_simulation, read_mapping, regular, shown, source_files
from plushsense.dataset.store import HEAD, DatasetHead
from plushsense.dataset.tables import STREAM_ROLE, check_roles, read_table
from plushsense.dataset.xdf import read_xdf, who

FOLDER = "folder"
SHOWN = 5


@dataclass(frozen=True)
class Ask:
    """What the user said about a source. ``layout``, ``gestures`` and ``mapping`` (file to person) may be open.

    ``of`` says whose layout it is; ``columns`` maps roles to column names; ``workplace`` makes a new folder for what
    has to be unpacked or converted.
    """

    layout: Layout | None
    gestures: GestureSet | None
    mapping: Mapping[str, str] | None
    workplace: Callable[[str], Path]
    of: str = "the layout that was asked for"
    columns: Mapping[str, str] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)

    def known_layout(self, found: Layout | None = None) -> Layout:
        """The layout that was asked for or found.

        Raises:
            ConfigError: when there is none.
        """
        if (layout := found or self.layout) is None:
            raise ConfigError(
                f"--layout is needed, for only sessions of plushsense record say what theirs is: accepted are "
                f"{', '.join(layout_names())}, or a TOML file of your own."
            )
        return layout

    def known_gestures(self, layout: Layout) -> GestureSet | None:
        """The gesture set; None when the labels shall make it."""
        if self.gestures is None and layout.name.startswith("plush"):
            return load_gestures("plush-18")
        return self.gestures


def from_folder(source: Path, ask: Ask, *, around: Path | None = None) -> Search:
    """Everything in a folder: sessions of our recorder, the folder's shape for the rest, and XDF files.

    ``around`` is where to look for the mark of a simulation, by default the folder itself.
    """
    files = source_files(source)
    simulated = is_simulation(around or source, files)
    files, refused = regular(f for f in files if f.name != SIMULATION_MARK)
    sessions = read_sessions(files)
    layout = ask.known_layout(common_layout(sessions, ask.layout, ask.of))
    gestures = ask.known_gestures(layout)
    in_session = [f for f in files if sessions and session_of(f, sessions) is not None]
    rest = sorted(set(files) - set(in_session)) if in_session else files
    convertible = [f for f in rest if f.suffix.lower() == ".xdf"]
    plain = [f for f in rest if f.suffix.lower() != ".xdf"]
    mapping = None if ask.mapping is None else dict(ask.mapping)
    shape = "labelled-rows" if layout.is_labelled else "gesture-recorder"
    found = refused + list(find_sessions(sessions, in_session)) + find(shape, source, plain, mapping, gestures)
    found = [replace(f, origin=shown(f.source.relative_to(source))) for f in found]
    people, notes = people_of(sessions)
    search = Search(layout, gestures, shape if rest else "sessions", found, people, notes=notes)
    for file in convertible:
        name = shown(file.relative_to(source))
        person = None if file.parent == around else file.parent.resolve().name
        if mapping is not None:
            person = mapping.get(name, mapping.get(file.name))
        try:
            _xdf(file, name, person, layout, gestures, ask, search)
        except FileFormatError as cause:
            search.found.append(Found(file, "", origin=name, reason=str(cause)))
    if mapping is not None:
        search.notes += _unused(mapping, source, rest)
    search.simulated = simulated or any(not isinstance(h, str) and h.simulated for h in sessions.values())
    return search


def from_zip(path: Path, ask: Ask) -> Search:
    """What a zip holds, unpacked beside the data set to be."""
    # The folder of recordings that lie at the top names their person, as it would had the user unpacked it.
    folder = ask.workplace("unpacked") / safe(path.stem)
    folder.mkdir()
    refused = unpack(path, folder, ask.limits)
    if any(folder.rglob(HEAD)):
        raise DatasetError(f"'{path}' holds a data set: unpack it and open the folder, it needs no import.")
    search = from_folder(folder, ask, around=path.resolve().parent)
    search.found += [Found(path, "", origin=shown(Path(name)), reason=reason) for name, reason in refused]
    return search


def from_xdf(path: Path, ask: Ask) -> Search:
    """What one XDF file holds."""
    layout = ask.known_layout()
    gestures = ask.known_gestures(layout)
    search = Search(layout, gestures, "xdf", [], simulated=is_simulation(path.resolve().parent, []))
    _xdf(path, path.name, (ask.mapping or {}).get(path.name), layout, gestures, ask, search)
    return search


def _xdf(
    path: Path, name: str, person: str | None, layout: Layout, gestures: GestureSet | None, ask: Ask, search: Search
) -> None:
    subject, session = who(path, person)
    if ask.mapping is not None:
        subject = person
    if subject is None:
        raise FileFormatError(
            f"whose '{name}' is, is not said: name the person with --subjects map.csv (file,subject), or call the file "
            "sub-<code>_ses-<session>.xdf as LabRecorder does"
        )
    folder = ask.workplace("converted") / "xdf"
    _take(read_xdf(path, name, folder, subject, session, layout, gestures, ask.columns.get(STREAM_ROLE, "")), search)


def from_table(path: Path, ask: Ask) -> Search:
    """What one table of everything holds."""
    if parse_name(path.name) is not None:
        raise DatasetError(f"'{path}' is one recording: give the folder that holds the people's folders.")
    layout = ask.known_layout()
    check_roles(ask.columns, layout)
    search = Search(layout, ask.known_gestures(layout), "table", [], simulated=is_simulation(path.resolve().parent, []))
    person = (ask.mapping or {}).get(path.name)
    _take(read_table(path, path.name, ask.workplace("converted"), person, layout, ask.columns), search)
    return search


def _take(laid_out: Iterable[Found | str], search: Search) -> None:
    for entry in laid_out:
        if isinstance(entry, str):
            search.notes.append(entry)
        else:
            search.found.append(entry)


FORMATS: dict[str, Callable[[Path, Ask], Search]] = {
    ".zip": from_zip,
    ".xdf": from_xdf,
    ".parquet": from_table,
    ".csv": from_table,
}


def _unused(mapping: dict[str, str], source: Path, files: Iterable[Path]) -> list[str]:
    """A sentence when the mapping names files that are not there."""
    there = {name for f in files for name in (f.name, f.relative_to(source).as_posix())}
    missing = [name for name in mapping if name not in there]
    if not missing:
        return []
    listed = ", ".join(f"'{m}'" for m in missing[:SHOWN]) + (", …" if len(missing) > SHOWN else "")
    return [f"files that the mapping names are not there ({len(missing)}): {listed}"]


@contextmanager
def _workplaces(dest: Path) -> Iterator[Callable[[str], Path]]:
    """Makes folders for unpacked and converted files, on the disk of the data set; they go at the end."""
    made: list[Path] = []

    def make_one(what: str) -> Path:
        real = dest.resolve()
        place = next(p for p in real.parents if p.is_dir())
        made.append(Path(tempfile.mkdtemp(prefix=f".{real.name}-{what}-", dir=place)))
        return made[-1]

    try:
        yield make_one
    finally:
        for folder in made:
            shutil.rmtree(folder, ignore_errors=True)


def search_source(source: Path, ask: Ask) -> Search:
    """What ``source`` holds: a folder, or a file of one of the ``FORMATS``.

    Raises:
        DatasetError: when it is neither, cannot be read, or holds nothing to import.
    """
    try:
        if source.is_dir():
            if strange := sorted(set(ask.columns) - {STREAM_ROLE}):
                raise ConfigError(f"--column {strange[0]}=… is for a table; '{source}' is a folder.")
            search = from_folder(source, ask)
        elif source.is_file():
            if source.suffix.lower() not in FORMATS:
                raise DatasetError(
                    f"'{source}' is of no kind that can be imported: give a folder, or a file that ends in "
                    f"{', '.join(FORMATS)}."
                )
            search = FORMATS[source.suffix.lower()](source, ask)
        else:
            raise DatasetError(
                f"There is no folder '{source}', nor such a file: give what the recorder wrote, or a file that ends in "
                f"{', '.join(FORMATS)}."
            )
    except OSError as cause:
        raise DatasetError(f"'{source}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    except FileFormatError as cause:
        raise FileFormatError(f"'{source}': {cause}.") from None
    if not any(f.kind in ("recordings", "streams") for f in search.found):
        first = next((f" The first: '{f.origin}': {f.reason.rstrip('.')}." for f in search.found if f.reason), "")
        raise DatasetError(
            f"'{source}' holds no recording: expected <label>_<epoch ms>_<rows>.csv in a folder a person"
            f"{' (or CSVs with a label column)' if search.shape == 'labelled-rows' else ''}; "
            f"found {len(search.found)} others.{first}"
        )
    return search


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
    limits: Limits | None = None,
) -> ImportSummary:
    """Make a data set at ``dest`` from recordings, or add them to the one that is there.

    Args:
        source: a folder as a recorder left it (sessions, a folder a person, a folder a label), a zip of one, an XDF
            file, or one table (.csv, .parquet).
        dest: the new data set; it must not exist yet, or be empty. With ``add_to`` the data set to add to.
        layout: the sensor layout, by name, path or as it is; sessions of our recorder and ``add_to`` need none.
        gestures: the gesture set; by default ``plush-18`` for plush layouts, else inferred from the labels.
        subjects: "folder" (the folder is the person) or the path of a mapping file ``file,subject``.
        simulated: these are recordings of the virtual toy; found out by itself where `plushsense simulate` wrote them.
        progress: called with (files done, files in all).
        people: the path of a people's table, see `dataset.people`.
        columns: which column of a table is what (``{"label": "activity"}``), or which ``stream`` of an XDF file.
        limits: how much a zip may unpack to.

    Returns:
        The summary; every source file is imported, imported with a warning, left out or rejected with a reason.

    Raises:
        DatasetError: when there is nothing to import, or ``dest`` holds something already.
    """
    began = time.perf_counter()
    source, dest = Path(source), Path(dest)
    given = layout if isinstance(layout, Layout) or layout is None else load_layout(layout)
    if gestures is not None and not isinstance(gestures, GestureSet):
        gestures = load_gestures(gestures)
    mapping = None if str(subjects) == FOLDER else read_mapping(Path(subjects))
    if people is not None and not Path(people).exists():
        raise DatasetError(f"There is no people's file '{people}': check the path.")
    told = {} if people is None else read_people(Path(people))
    if source.is_dir() and dest.resolve() != source.resolve() and dest.resolve().is_relative_to(source.resolve()):
        raise ConfigError(f"'{dest}' lies in '{source}', which is only read: give a place outside it for the data set.")
    head = None
    if add_to:
        head = DatasetHead.read(dest)
        if given is not None and given.to_dict() != head.layout.to_dict():
            raise DatasetError(
                f"'{dest}' has the layout '{head.layout.name}', and '{given.name}' was asked for: a data set has one "
                "layout, so leave --layout out or make another data set."
            )
        if name or licence or consent:
            raise ConfigError("--add keeps the name, licence and consent statement of the data set: leave them out.")
    # Labels that a set was inferred from do not say which markers of an XDF file are gestures.
    known = gestures if head is None or head.gestures.inferred else head.gestures
    with _workplaces(dest) as workplace:
        ask = Ask(
            given if head is None else head.layout,
            known,
            mapping,
            workplace,
            "the layout that was asked for" if head is None else "that of the data set",
            columns or {},
            limits or Limits(),
        )
        search = search_source(source, ask)
        search.simulated = search.simulated or simulated
        if head is None:
            done = make(source, dest, search, _new_head(source, search, name, licence, consent), told, progress)
        else:
            try:
                done = add(dest, search, gestures, told, progress)
            except OSError as cause:
                raise DatasetError(
                    f"'{dest}' cannot be added to ({cause.strerror or cause}, {cause.filename}): it is as valid as "
                    "before; check the disk and run it once more."
                ) from None
    done.seconds = time.perf_counter() - began
    return done


def _new_head(source: Path, search: Search, name: str | None, licence: str, consent: str) -> DatasetHead:
    return DatasetHead(
        name=name or (source.resolve().name if source.is_dir() else source.stem),
        layout=search.layout,
        gestures=search.gestures or GestureSet("inferred", (), inferred=True),
        licence=licence,
        consent=consent,
        source=search.shape,
        simulated=search.simulated,
    )
