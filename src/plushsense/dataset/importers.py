"""Bringing recordings in: raw files are copied unchanged, and every file is accounted for.

Two shapes of folder are read: the GestureRecorder's (by person, or by label after the authors' anonymising step), and
folders of CSVs with a label on every row.
"""

from __future__ import annotations

import csv
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.recfile import SIMULATION_MARK, STREAM_NAME, parse_name
from plushsense.core.signal import Layout, load_layout
from plushsense.dataset.index import Progress, rebuild, sha256_of
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, UNKNOWN_SUBJECT, Dataset, DatasetHead

FOLDER = "folder"


@dataclass(frozen=True)
class Found:
    """One source file and where it goes: ``kind`` is recordings or streams, or "" with the reason it is refused."""

    source: Path
    kind: str
    subject: str = ""
    reason: str = ""


@dataclass
class ImportSummary:
    """What an import did; ``rejected`` and ``warnings`` name each file."""

    dataset: Dataset
    recordings: int
    subjects: int
    gestures: list[str]
    streams: int
    rejected: list[dict[str, str]]
    warnings: list[str]
    seconds: float
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "recordings": self.recordings,
            "subjects": self.subjects,
            "gestures": self.gestures,
            "streams": self.streams,
            "rejected": self.rejected,
            "warnings": self.notes + self.warnings,
            "seconds": round(self.seconds, 2),
            "hash": self.dataset.hash,
        }


def _files(source: Path) -> Iterator[Path]:
    for folder, folders, names in os.walk(source, followlinks=False):
        folders.sort()
        for name in sorted(names):
            yield Path(folder) / name


def _refuse_link(path: Path) -> Found | None:
    return Found(path, "", reason="a symbolic link is not followed") if path.is_symlink() else None


def _is_by_label(source: Path) -> bool:
    """Whether the folders are gestures, not people: every recording's label is its folder's name."""
    seen = False
    for path in _files(source):
        name = parse_name(path.name)
        if name is None or path.parent == source:
            continue
        if name.label.replace("_", " ").strip().casefold() != path.parent.name.replace("_", " ").strip().casefold():
            return False
        seen = True
    return seen


def find_gesture_recorder(source: Path, subjects: dict[str, str] | None) -> Iterator[Found]:
    """Recordings and streams as the GestureRecorder leaves them.

    ``subjects`` maps file names (or paths below ``source``) to people; without it the folder is the person.
    """
    by_label = subjects is None and _is_by_label(source)
    for path in _files(source):
        refused = _refuse_link(path)
        if refused is not None:
            yield refused
            continue
        relative = path.relative_to(source).as_posix()
        if subjects is not None:
            subject = subjects.get(relative, subjects.get(path.name))
        elif by_label:
            subject = UNKNOWN_SUBJECT
        else:
            subject = source.resolve().name if path.parent == source else path.relative_to(source).parts[0]
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


def find_labelled_rows(source: Path, subjects: dict[str, str] | None) -> Iterator[Found]:
    """CSVs with a label on every row: each file is a stream, and its runs of equal labels are the recordings."""
    for path in _files(source):
        refused = _refuse_link(path)
        if refused is not None:
            yield refused
            continue
        relative = path.relative_to(source).as_posix()
        if subjects is not None:
            subject = subjects.get(relative, subjects.get(path.name))
        else:
            subject = path.relative_to(source).parts[0] if path.parent != source else None
        if path.suffix.lower() != ".csv":
            yield Found(path, "", reason="not a CSV file")
        elif subject is None:
            yield Found(path, "", reason="not in the folder of a person")
        else:
            yield Found(path, STREAMS, subject)


Importer = Callable[[Path, dict[str, str] | None], Iterator[Found]]

IMPORTERS: dict[str, Importer] = {
    "gesture-recorder": find_gesture_recorder,
    "labelled-rows": find_labelled_rows,
}


def read_mapping(path: Path) -> dict[str, str]:
    """File name to person, from a CSV with the columns ``file`` and ``subject``."""
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
            return {row["file"].strip().replace("\\", "/"): row["subject"].strip() for row in reader}
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"The mapping file '{path}' cannot be read: {cause}.") from None


def _safe(code: str) -> str:
    """A subject code as a folder name that cannot leave the data set."""
    kept = "".join(c if c.isalnum() or c in "-_. " else "_" for c in code).strip(" .")
    return kept or UNKNOWN_SUBJECT


def _copy(found: Found, work: Path) -> Path | None:
    """Copy a raw file unchanged; None when the same content is already there under that name."""
    folder = work / found.kind / _safe(found.subject)
    target = folder / found.source.name
    again = 1
    while target.exists():
        if sha256_of(target) == sha256_of(found.source):
            return None
        again += 1
        target = folder / f"again-{again}" / found.source.name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(found.source, target)
    return target


def import_recordings(
    source: str | Path,
    dest: str | Path,
    *,
    layout: Layout | str | Path,
    gestures: GestureSet | str | Path | None = None,
    subjects: str | Path = FOLDER,
    name: str | None = None,
    licence: str = "",
    consent: str = "",
    simulated: bool = False,
    progress: Progress | None = None,
) -> ImportSummary:
    """Make a data set at ``dest`` from a folder of recordings.

    Args:
        source: a folder as the recorder left it: a folder a person, or a folder a label.
        dest: the new data set; it must not exist yet, or be empty.
        layout: the sensor layout, by name, path or as it is.
        gestures: the gesture set; by default ``plush-18`` for plush layouts, else inferred from the labels.
        subjects: "folder" (the folder is the person) or the path of a mapping file ``file,subject``.
        simulated: these are recordings of the virtual toy; found out by itself where `plushsense simulate` wrote them.
        progress: called with (files done, files in all).

    Returns:
        The summary; every source file is imported, imported with a warning, or rejected with a reason.

    Raises:
        DatasetError: when there is nothing to import, or ``dest`` holds something already.
    """
    began = time.perf_counter()
    source, dest = Path(source), Path(dest)
    if not isinstance(layout, Layout):
        layout = load_layout(layout)
    if not source.is_dir():
        raise DatasetError(f"There is no folder '{source}': give the folder that the recorder wrote.")
    if dest.exists() and (not dest.is_dir() or any(dest.iterdir())):
        raise DatasetError(f"'{dest}' already holds something: give a new or empty folder, nothing is overwritten.")
    mapping = None if str(subjects) == FOLDER else read_mapping(Path(subjects))
    importer = "labelled-rows" if "label" in layout.csv.columns else "gesture-recorder"
    found = [f for f in IMPORTERS[importer](source, mapping) if f.source.name != SIMULATION_MARK]
    simulated = simulated or any((place / SIMULATION_MARK).is_file() for place in (source, source.resolve().parent))
    rejected = [{"file": f.source.relative_to(source).as_posix(), "reason": f.reason} for f in found if not f.kind]
    kept = [f for f in found if f.kind]
    if not kept:
        raise DatasetError(
            f"'{source}' holds no recording: expected <label>_<epoch ms>_<rows>.csv in a folder a person"
            f"{' (or CSVs with a label column)' if importer == 'labelled-rows' else ''}; found {len(found)} others."
        )
    if gestures is None and layout.name.startswith("plush"):
        gestures = "plush-18"
    if gestures is not None and not isinstance(gestures, GestureSet):
        gestures = load_gestures(gestures)
    work = dest.with_name(dest.name + ".importing")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        sources: dict[str, str] = {}
        for f in kept:
            relative = f.source.relative_to(source).as_posix()
            target = _copy(f, work)
            if target is None:
                rejected.append({"file": relative, "reason": "the same file was already imported"})
            else:
                sources[target.relative_to(work).as_posix()] = relative
        head = DatasetHead(
            name=name or source.resolve().name,
            layout=layout,
            gestures=gestures
            or GestureSet.infer(n.label for f in kept if (n := parse_name(f.source.name)) is not None),
            licence=licence,
            consent=consent,
            source=importer,
            simulated=simulated,
        )
        built = rebuild(work, head, progress)
        for file, reason in built.unreadable.items():
            rejected.append({"file": sources[file], "reason": reason})
            (work / file).unlink()
        if gestures is None:
            made = GestureSet.infer(r.gesture for r in built.dataset.recordings)
            head = DatasetHead(**{**head.__dict__, "gestures": made})
        elif unknown := sorted({r.gesture for r in built.dataset.recordings} - set(gestures.labels)):
            extended = GestureSet(gestures.name, gestures.gestures + GestureSet.infer(unknown).gestures)
            head = DatasetHead(**{**head.__dict__, "gestures": extended})
        if not built.dataset.recordings:
            raise DatasetError(
                f"'{source}' holds no recording that layout '{layout.name}' can read. "
                f"The first: {next(iter(built.unreadable.values()), 'none')}"
            )
        (work / HEAD).write_text(head.to_toml(), encoding="utf-8")
        dest.parent.mkdir(parents=True, exist_ok=True)
        if dest.exists():
            dest.rmdir()
        os.replace(work, dest)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    dataset = Dataset(dest, head, built.dataset.recordings, built.dataset.streams)
    notes = (
        ["these recordings are of the virtual toy: scores on them say nothing about a real one"] if simulated else []
    )
    if any(r.subject == UNKNOWN_SUBJECT for r in dataset.recordings):
        notes.append(
            "the folders are gestures, so the people are not known: splits by subject are not possible; "
            "import again with --subjects map.csv (columns file,subject) if a mapping exists"
        )
    flagged = [(s.id, s.flags) for s in dataset.streams] + [(r.id, r.flags) for r in dataset.recordings]
    warnings = [f"{identity}: {flag}" for identity, flags in flagged for flag in flags]
    return ImportSummary(
        dataset,
        len(dataset.recordings),
        len(dataset.subjects),
        sorted({r.gesture for r in dataset.recordings}),
        len(dataset.streams),
        rejected,
        warnings,
        time.perf_counter() - began,
        notes,
    )
