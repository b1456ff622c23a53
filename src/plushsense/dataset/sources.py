"""Finding recordings in a folder that somebody brings: which file is what, and whose.

Three shapes of folder are read: the sessions of our own recorder (`dataset.sessions`), the GestureRecorder's folders
(by person, or by label after the authors' anonymising step), and folders of CSVs with a label on every row. Outside a
session, the person is the folder nearest to the file.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.errors import BadInput, DatasetError
from plushsense.core.gestures import NOBODY, GestureSet, plain_label
from plushsense.core.recfile import SIMULATION_MARK, STREAM_NAME, parse_name
from plushsense.core.signal import Layout
from plushsense.core.tomlfile import read_toml
from plushsense.dataset.people import PersonInfo
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, UNKNOWN_SUBJECT

COMPANIONS = "companions"
LEFT_OUT = "left out"

_ASK = (
    "import from the folder that holds one folder a person, or name the people with --subjects map.csv (file,subject)"
)


@dataclass(frozen=True)
class Found:
    """One source file and where it goes.

    ``kind`` is recordings, streams, companions (kept beside another file, never read), left out (named, no fault), or
    "" with the reason it is refused. ``origin`` is how messages name it; by default its path below the source.
    ``beside`` is the file that a companion goes with; a companion of none lies with its session's stream. ``aside``:
    why the recorder does not want the recording used.
    """

    source: Path
    kind: str
    subject: str = ""
    reason: str = ""
    session: str = ""
    origin: str = ""
    beside: Path | None = None
    aside: str = ""


@dataclass
class Search:
    """What a source holds: every file of it once, and what its sessions say of themselves."""

    layout: Layout
    gestures: GestureSet | None
    shape: str
    found: list[Found]
    people: list[PersonInfo] = field(default_factory=list)
    simulated: bool = False
    notes: list[str] = field(default_factory=list)


def shown(path: Path) -> str:
    """A path as a message can show it: what is no text, or would act on a terminal, becomes escapes."""
    text = os.fsencode(path).decode("utf-8", "backslashreplace").replace(os.sep, "/")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def source_files(source: Path) -> list[Path]:
    """Every file below ``source`` in name order, and every link to a folder; the mark of a simulation is no file.

    Raises:
        DatasetError: when a data set is in there, which would be taken in again.
        OSError: when a folder cannot be listed.
    """

    def refuse(cause: OSError) -> None:
        raise cause

    files = []
    for place, folders, names in os.walk(source, onerror=refuse, followlinks=False):
        folders.sort()
        here = Path(place)
        if HEAD in names:
            what = (
                f"'{source}' is a data set already: open it as it is, with  plushsense info {source}"
                if here == source
                else f"'{here}' in '{source}' is a data set already: give the recorder's folder, or move it away first"
            )
            raise DatasetError(f"{what}; importing it again would mix its own copies with its people.")
        files += [here / name for name in sorted(names + [f for f in folders if (here / f).is_symlink()])]
    return files


def is_simulation(source: Path, files: Iterable[Path]) -> bool:
    """Whether the virtual toy made ``files``: its mark, or a simulated data set, is there or above."""
    if any(f.name == SIMULATION_MARK for f in files):
        return True
    for place in (source.resolve(), *source.resolve().parents):
        if (place / SIMULATION_MARK).is_file():
            return True
        try:
            if (place / HEAD).is_file() and read_toml(place / HEAD, "data set", DatasetError).get("simulated") is True:
                return True
        except BadInput:
            continue
    return False


def _not_a_file(path: Path) -> Found | None:
    if path.is_symlink():
        return Found(path, "", reason="a symbolic link is not followed")
    if not path.is_file():
        return Found(path, "", reason="not a regular file")
    if path.name.startswith("._"):
        return Found(path, "", reason="what macOS leaves beside a file, no recording")
    try:
        path.name.encode("utf-8")
    except UnicodeEncodeError:
        return Found(path, "", reason="its name is not UTF-8: rename it")
    if any(c < " " or c == "\x7f" for c in path.name):
        return Found(path, "", reason="its name holds a control character: rename it")
    return None


def regular(files: Iterable[Path]) -> tuple[list[Path], list[Found]]:
    """The files that can be looked into, and what is refused before: links, devices, names that are no text."""
    good, refused = [], []
    for path in files:
        odd = _not_a_file(path)
        if odd is None:
            good.append(path)
        else:
            refused.append(odd)
    return good, refused


def _is_by_label(source: Path, files: Iterable[Path]) -> bool:
    """Whether the folders are gestures, not people: every recording's label is its folder's name."""
    named = [(path, name) for path in files if (name := parse_name(path.name)) is not None]
    inside = [(path, name) for path, name in named if path.parent != source] or named
    return bool(inside) and all(plain_label(n.label) == plain_label(p.parent.resolve().name) for p, n in inside)


def _nobodys_folders(files: Iterable[Path], gestures: GestureSet | None) -> set[Path]:
    """Folders in which every recording is of a gesture that nobody makes (the toy at rest)."""
    by_folder: dict[Path, bool] = {}
    for path in files:
        name = parse_name(path.name)
        if name is not None and gestures is not None:
            gesture = gestures.find(name.label)
            nobody = gesture is not None and gesture.nobody
            by_folder[path.parent] = by_folder.get(path.parent, True) and nobody
    return {folder for folder, nobody in by_folder.items() if nobody}


def _refuse_unclear_people(source: Path, found: Iterable[Found], *, nested: bool) -> None:
    """Refuse folders that leave open who the person is, rather than merge people or split one.

    ``nested``: a folder of recordings inside another one is unclear too.
    """
    folders: dict[str, Path] = {}
    for f in found:
        if not f.kind or f.subject in (NOBODY, UNKNOWN_SUBJECT):
            continue
        other = folders.setdefault(f.subject.casefold(), f.source.parent)
        if other != f.source.parent:
            a, b = (p.relative_to(source).as_posix() for p in (other, f.source.parent))
            raise DatasetError(
                f"Who the person is is not clear: '{a}' and '{b}' in '{source}' have the same name: {_ASK}."
            )
    places = set(folders.values())
    for place in sorted(places) if nested else ():
        above = next((p for p in place.parents if p in places), None)
        if above is not None:
            raise DatasetError(
                f"Who the person is is not clear: '{place}' lies in '{above}', both hold recordings: {_ASK}."
            )


def _mapped(path: Path, source: Path, subjects: dict[str, str]) -> str | None:
    """The person that a mapping names for a file, by its path below ``source`` or by its name alone."""
    return subjects.get(path.relative_to(source).as_posix(), subjects.get(path.name))


def find_gesture_recorder(
    source: Path, files: list[Path], subjects: dict[str, str] | None, gestures: GestureSet | None
) -> Iterator[Found]:
    """Recordings and streams as the GestureRecorder leaves them.

    ``subjects`` maps file names (or paths below ``source``) to people; without it the nearest folder is the person,
    or nobody where it holds nothing but gestures that nobody makes.
    """
    by_label = subjects is None and _is_by_label(source, files)
    nobodys = _nobodys_folders(files, gestures)
    for path in files:
        if subjects is not None:
            # A mapping of people need not list what nobody touched.
            subject = _mapped(path, source, subjects) or (NOBODY if path.parent in nobodys else None)
        elif path.parent in nobodys:
            subject = NOBODY
        elif by_label:
            subject = UNKNOWN_SUBJECT
        else:
            subject = path.parent.resolve().name
        if path.name.casefold() == STREAM_NAME.casefold():
            if by_label or subject is None:
                yield Found(path, "", reason="a session stream whose person is not known")
            else:
                yield Found(path, STREAMS, subject)
        elif parse_name(path.name) is None:
            yield Found(path, "", reason="not a recording: its name is not <label>_<epoch ms>_<rows>.csv")
        elif subject is None:
            yield Found(path, "", reason="not named in the mapping file of --subjects")
        else:
            yield Found(path, RECORDINGS, subject)


def find_labelled_rows(
    source: Path, files: list[Path], subjects: dict[str, str] | None, gestures: GestureSet | None
) -> Iterator[Found]:
    """CSVs with a label on every row: each file is a stream, and its runs of equal labels are the recordings."""
    one_person = all(path.parent == source for path in files)
    for path in files:
        if subjects is not None:
            subject = _mapped(path, source, subjects)
        else:
            subject = path.parent.resolve().name if one_person or path.parent != source else None
        if path.suffix.lower() != ".csv":
            yield Found(path, "", reason="not a CSV file")
        elif subject is None:
            reason = (
                "not in the folder of a person" if subjects is None else "not named in the mapping file of --subjects"
            )
            yield Found(path, "", reason=reason)
        else:
            yield Found(path, STREAMS, subject)


Finder = Callable[[Path, list[Path], dict[str, str] | None, GestureSet | None], Iterator[Found]]

FINDERS: dict[str, Finder] = {
    "gesture-recorder": find_gesture_recorder,
    "labelled-rows": find_labelled_rows,
}


def find(
    shape: str, source: Path, files: list[Path], subjects: dict[str, str] | None, gestures: GestureSet | None
) -> list[Found]:
    """What each of ``files`` is (regular ones); every one of them comes back once.

    Raises:
        DatasetError: when the folders leave open who the person is.
    """
    found = list(FINDERS[shape](source, files, subjects, gestures))
    if subjects is None:
        _refuse_unclear_people(source, found, nested=shape == "gesture-recorder")
    return found


def read_mapping(path: Path) -> dict[str, str]:
    """File name to person, from a CSV with the columns ``file`` and ``subject``."""
    mapping: dict[str, str] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            sample = file.readline()
            file.seek(0)
            reader = csv.DictReader(file, delimiter=";" if ";" in sample else ",")
            columns = [c.strip().casefold() for c in reader.fieldnames or ()]
            if columns[:2] != ["file", "subject"]:
                raise DatasetError(
                    f"The mapping file '{path}' begins with the columns {', '.join(columns) or 'nothing'}; "
                    "it needs  file,subject"
                )
            reader.fieldnames = columns
            for row in reader:
                name = (row["file"] or "").strip().replace("\\", "/")
                subject = (row["subject"] or "").strip()
                if not name or not subject:
                    raise DatasetError(
                        f"The mapping file '{path}' line {reader.line_num} names no {'subject' if name else 'file'}: "
                        "each line is  file,subject"
                    )
                if mapping.setdefault(name, subject) != subject:
                    raise DatasetError(
                        f"The mapping file '{path}' gives '{name}' to '{mapping[name]}' and '{subject}'."
                    )
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise DatasetError(f"The mapping file '{path}' cannot be read: {cause}.") from None
    return mapping
