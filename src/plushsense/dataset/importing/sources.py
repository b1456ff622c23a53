"""The files of a source, what an import knows about it before it reads them, and the result of its scan."""

from __future__ import annotations

import contextlib
import gzip
import html
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plushsense.core.errors import BadInput, ConfigError, DatasetError, FileFormatError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name, read_recording
from plushsense.core.sentences import Message
from plushsense.core.toml import read_toml
from plushsense.dataset.importing.archives import DEVICE_NAME, UnpackLimits
from plushsense.dataset.importing.pattern import ImportPattern
from plushsense.dataset.importing.truncation import Choice
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, PersonInfo, read_csv_rows

XDF_ENDINGS = (".xdf", ".xdfz", ".xdf.gz")
COMPANIONS = "companions"
LEFT_OUT = "left out"
PATTERN, WINDOWS = "pattern", "windows"
SHOWN = 5
_SAMPLED_FILES, _SAMPLED_BYTES = 3, 200_000
_SINCE_2001_MS = 978_307_200_000

LAYOUT_GUESSED = "the layout is '{layout}', as {why}"


@dataclass(frozen=True)
class SourceFile:
    """File of a source, and its destination in the data set.

    ``kind`` is recordings, streams, companions (copied beside another file but not read), left out (not needed), or ""
    for a refused file with its ``reason``. ``origin`` is its name in messages. ``beside`` is the file that a companion
    belongs to, None for its session's folder. ``set_aside`` is the reason why the recorder discarded the recording.
    ``gesture`` is the label of the folder of a recording whose name has another one.
    """

    source: Path
    kind: str
    subject: str = ""
    reason: str = ""
    session: str = ""
    origin: str = ""
    beside: Path | None = None
    set_aside: str = ""
    gesture: str = ""


@dataclass
class SourceScan:
    """Result of a scan of a source: every file once (``found``), and layout, gestures and people of its sessions.

    ``choices`` are those of the authors' truncation script. ``streams_named`` is whether streams were searched for the
    people.
    """

    layout: Layout
    gestures: GestureSet | None
    shape: str
    found: list[SourceFile] = field(default_factory=list)
    people: list[PersonInfo] = field(default_factory=list)
    simulated: bool = False
    notes: list[str] = field(default_factory=list)
    choices: list[Choice] = field(default_factory=list)
    streams_named: bool = False

    def add(self, entries: Iterable[SourceFile | str]) -> None:
        """Add files to those found, and texts to the notes."""
        for entry in entries:
            if isinstance(entry, str):
                self.notes.append(entry)
            else:
                self.found.append(entry)

    @contextmanager
    def refusing(self, file: Path, name: str) -> Iterator[None]:
        """Add ``file`` as refused, with the reason, if it turns out to be unreadable; ``name`` is that in messages."""
        try:
            yield
        except FileFormatError as cause:
            self.found.append(SourceFile(file, "", origin=name, reason=cause.message))


def folder_name(code: str, otherwise: str = UNKNOWN_SUBJECT) -> str:
    """Return a folder name for ``code`` that is valid on any system and inside the data set."""
    name = "".join(c if c.isalnum() or c in "-_. " else "_" for c in code).strip(" .")
    return f"{name}_" if DEVICE_NAME.match(name) else name or otherwise


def printable_path(path: Path) -> str:
    """Return a path as text in which characters that are not printable, such as control characters, are escaped."""
    text = os.fsencode(path).decode("utf-8", "backslashreplace").replace(os.sep, "/")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def source_files(source: Path) -> list[Path]:
    """Return every file and every link to a folder below ``source``, sorted by name in each folder.

    Raises:
        DatasetError: if ``source`` is or contains a data set.
        OSError: if a folder cannot be listed.
    """

    def refuse(cause: OSError) -> None:
        raise cause

    files = []
    for place, folders, names in os.walk(source, onerror=refuse, followlinks=False):
        folders.sort()
        here = Path(place)
        if HEAD in names:
            problem = (
                f"'{source}' is a data set already: open it as it is, with  plushsense info {source}"
                if here == source
                else f"'{here}' in '{source}' is a data set already: give the recorder's folder, or move it away first"
            )
            raise DatasetError(
                "{problem}; importing it again would mix its copies of files with its people.",
                problem=problem,
                name=here.name,
            )
        files += [here / name for name in sorted(names + [f for f in folders if (here / f).is_symlink()])]
    return files


def is_simulation(source: Path, files: Iterable[Path]) -> bool:
    """Return whether ``files`` are a simulation: its mark or a simulated data set is in or above ``source``."""
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


def split_regular_files(files: Iterable[Path]) -> tuple[list[Path], list[SourceFile]]:
    """Split files into those to import and those refused: links, devices, unusable names."""
    good, refused = [], []
    for path in files:
        if reason := _refusal(path):
            refused.append(SourceFile(path, "", reason=reason))
        else:
            good.append(path)
    return good, refused


def _refusal(path: Path) -> str:
    """Return the reason to refuse a file by its kind or name; "" if there is none."""
    if path.is_symlink():
        return Message("a symbolic link is not followed")
    if not path.is_file():
        return Message("not a regular file")
    if path.name.startswith("._"):
        return Message("metadata of macOS, no recording")
    try:
        path.name.encode("utf-8")
    except UnicodeEncodeError:
        return Message("its name is not UTF-8: rename it")
    if any(c < " " or c == "\x7f" for c in path.name):
        return Message("its name holds a control character: rename it")
    return ""


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
    most_files: int = 0

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


def find_layout(files: Sequence[Path], guess: bool) -> tuple[Layout, Message]:
    """Return the built-in layout of ``files``, and a note that says by what it was found.

    Args:
        guess: whether to take the most probable layout that can read the files if their header names none or several.

    Raises:
        ConfigError: if there is none, or several fit.
    """
    found, why = _named_in_header(files), "the header of the files has its channels"
    if not found and (found := _without_header(files)):
        why = f"the files have its {len(found[0].csv.columns)} columns"
    if found and not any(path.suffix.lower() == ".csv" for path in files):
        # In XDF, layouts that differ in the clock that the toy sends are the same.
        found, why = found[-1:], "a stream of the files has its channels"
    if len({layout.csv.columns for layout in found}) == 1 < len(found):
        # They differ in the clock that the toy sends. Files without rows tell nothing, and are refused later.
        found = (readable_layouts(files, [layout.name for layout in found]) or found[::-1])[:1]
        why += f", the last one a {'clock' if DEVICE_MS in found[0].wire else 'delay'}"
    elif guess and len(found) != 1:
        found = readable_layouts(files, [layout.name for layout in found])[:1]
    if len(found) == 1:
        name = found[0].name
        return found[0], Message(LAYOUT_GUESSED, layout=name, why=why)
    fit = f"The header of the files fits {' and '.join(layout.name for layout in found)}. " if found else ""
    raise ConfigError(
        "--layout is needed: accepted are {layout_names}, or a TOML file of your own, which names the channels (see "
        "docs/importing.md). {fit}For files of another form, let --guess FILE.toml write a pattern.",
        layout_names=", ".join(layout_names()),
        fit=fit,
        needs="layout",
    )


def _named_in_header(files: Iterable[Path]) -> list[Layout]:
    """Return the built-in layouts with most channels, all of which the first fitting CSV or XDF file names."""
    layouts = [load_layout(name) for name in layout_names()]
    for path in files:
        texts = _header_texts(path)
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


def _header_texts(path: Path) -> set[str]:
    """Return the names of the columns of a CSV file, or the labels of channels at the beginning of an XDF file."""
    name = path.name.lower()
    if name.endswith(".csv"):
        with path.open(encoding="utf-8-sig", errors="replace") as text:
            return {cell.strip().strip('"').casefold() for cell in re.split("[,;\t]", text.readline(4096))}
    if not name.endswith(XDF_ENDINGS):
        return set()
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    head = b""
    with gzip.open(path) if packed else path.open("rb") as whole, contextlib.suppress(EOFError, OSError, zlib.error):
        head = whole.read(_SAMPLED_BYTES)
    labels = re.findall(r"<label>([^<]*)</label>", head.decode("utf-8", "replace"))
    return {html.unescape(label).strip().casefold() for label in labels}


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


MAPPING_COLUMNS = {
    "file": "name of a recording's file, or its path below the source; must be the first column",
    "subject": "code of the person; must be the second column",
}


def read_mapping(path: Path) -> dict[str, str]:
    """Read a mapping from file name to person, a CSV with the columns ``file`` and ``subject``."""
    mapping: dict[str, str] = {}
    try:
        columns, rows = read_csv_rows(path, "mapping file")
    except FileNotFoundError:
        raise DatasetError(f"There is no mapping file '{path}': check the path.") from None
    if columns[:2] != [*MAPPING_COLUMNS]:
        raise DatasetError(
            f"The mapping file '{path}' has the columns {', '.join(columns) or 'nothing'}; it needs  file,subject"
        )
    for line, cells in rows:
        name, subject = cells["file"].replace("\\", "/"), cells["subject"]
        if not name or not subject:
            raise DatasetError(
                f"The mapping file '{path}' line {line} has no {'subject' if name else 'file'}: it needs  file,subject"
            )
        if mapping.setdefault(name, subject) != subject:
            raise DatasetError(f"The mapping file '{path}' gives '{name}' to '{mapping[name]}' and '{subject}'.")
    return mapping
