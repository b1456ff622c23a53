"""Bringing recordings in: raw files are copied unchanged, and every file is accounted for."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.folders import whole_folder
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.recfile import SIMULATION_MARK, parse_name
from plushsense.core.signal import Layout, load_layout
from plushsense.dataset.index import AGAIN, Progress, build, write
from plushsense.dataset.sources import Found, find, is_simulation, read_mapping, source_files
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, Dataset, DatasetHead

FOLDER = "folder"
SHOWN = 5


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


def _safe(code: str) -> str:
    """A subject code as a folder name that cannot leave the data set."""
    kept = "".join(c if c.isalnum() or c in "-_. " else "_" for c in code).strip(" .")
    return kept or UNKNOWN_SUBJECT


def _copy(found: Found, work: Path, taken: dict[str, bytes]) -> tuple[Path | None, str]:
    """Copy a raw file unchanged: its new path, or None and the reason.

    ``taken`` holds the paths given out, as file systems that ignore case see them, without suffix: these are ids.
    """
    try:
        raw = found.source.read_bytes()
    except OSError as cause:
        return None, f"cannot be read: {cause.strerror or cause}"
    content = hashlib.sha256(raw).digest()
    folder = work / found.kind / _safe(found.subject)
    target = folder / found.source.name
    again = 1
    while (key := target.with_suffix("").as_posix().casefold()) in taken:
        if taken[key] == content:
            return None, "the same file was already imported"
        again += 1
        target = folder / f"{AGAIN}{again}" / found.source.name
    taken[key] = content
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(raw)
    return target, ""


def _refuse_merged_people(found: Iterable[Found]) -> None:
    """Refuse codes that become one folder name, rather than make one person of two."""
    codes: dict[str, str] = {}
    for f in found:
        first = codes.setdefault(_safe(f.subject).casefold(), f.subject)
        if first != f.subject:
            raise DatasetError(
                f"The people '{first}' and '{f.subject}' would share the folder '{_safe(first)}': rename one of them."
            )


def _unused(mapping: dict[str, str], source: Path, files: Iterable[Path]) -> list[str]:
    """A sentence when the mapping names files that are not there."""
    there = {name for f in files for name in (f.name, f.relative_to(source).as_posix())}
    missing = [name for name in mapping if name not in there]
    if not missing:
        return []
    shown = ", ".join(f"'{m}'" for m in missing[:SHOWN]) + (", …" if len(missing) > SHOWN else "")
    return [f"files that the mapping names are not there ({len(missing)}): {shown}"]


def _all_gestures(given: GestureSet | None, dataset: Dataset) -> GestureSet:
    """The given set with every label that it lacks, or the set that the recordings imply."""
    if given is None:
        return GestureSet.infer(r.gesture for r in dataset.recordings)
    unknown = sorted(r.gesture for r in dataset.recordings if given.find(r.gesture) is None)
    if not unknown:
        return given
    return GestureSet(given.name, given.gestures + GestureSet.infer(unknown).gestures)


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
    if gestures is None and layout.name.startswith("plush"):
        gestures = "plush-18"
    if gestures is not None and not isinstance(gestures, GestureSet):
        gestures = load_gestures(gestures)
    if not source.is_dir():
        raise DatasetError(f"There is no folder '{source}': give the folder that the recorder wrote.")
    mapping = None if str(subjects) == FOLDER else read_mapping(Path(subjects))
    shape = "labelled-rows" if "label" in layout.csv.columns else "gesture-recorder"
    try:
        files = source_files(source)
        simulated = simulated or is_simulation(source, files)
        files = [f for f in files if f.name != SIMULATION_MARK]
        found = find(shape, source, files, mapping, gestures)
    except OSError as cause:
        raise DatasetError(f"'{source}' cannot be read: {cause.strerror or cause} ({cause.filename}).") from None
    kept = [f for f in found if f.kind]
    if not kept:
        raise DatasetError(
            f"'{source}' holds no recording: expected <label>_<epoch ms>_<rows>.csv in a folder a person"
            f"{' (or CSVs with a label column)' if shape == 'labelled-rows' else ''}; found {len(found)} others."
        )
    _refuse_merged_people(kept)
    rejected = [{"file": f.source.relative_to(source).as_posix(), "reason": f.reason} for f in found if not f.kind]
    with whole_folder(dest, DatasetError, last=HEAD) as work:
        sources: dict[str, str] = {}
        taken: dict[str, bytes] = {}
        for f in kept:
            relative = f.source.relative_to(source).as_posix()
            target, reason = _copy(f, work, taken)
            if target is None:
                rejected.append({"file": relative, "reason": reason})
            else:
                sources[target.relative_to(work).as_posix()] = relative
        head = DatasetHead(
            name=name or source.resolve().name,
            layout=layout,
            gestures=gestures
            or GestureSet.infer(n.label for f in kept if (n := parse_name(f.source.name)) is not None),
            licence=licence,
            consent=consent,
            source=shape,
            simulated=simulated,
        )
        built = build(work, head, progress)
        for file, reason in built.unreadable.items():
            rejected.append({"file": sources[file], "reason": reason})
            (work / file).unlink()
        if not built.dataset.recordings:
            raise DatasetError(
                f"'{source}' holds no recording that layout '{layout.name}' can read. "
                f"The first: {next(iter(built.unreadable.values()), 'none')}"
            )
        made = _all_gestures(gestures, built.dataset)
        head = replace(head, gestures=made)
        if {r.gesture for r in built.dataset.recordings} - set(made.labels):
            # Spellings were merged: the recordings are named once more by the whole set.
            built = build(work, head)
        (work / HEAD).write_text(head.to_toml(), encoding="utf-8")
        dataset = Dataset(work, head, built.dataset.recordings, built.dataset.streams)
        write(dataset)
        imported = {r.file for r in dataset.recordings} | {s.file for s in dataset.streams}
        assert len(imported) + len(rejected) == len(found), "every source file is imported or rejected"
    dataset = Dataset(dest, head, dataset.recordings, dataset.streams)
    notes = (
        ["these recordings are of the virtual toy: scores on them say nothing about a real one"] if simulated else []
    )
    notes += _unused(mapping, source, files) if mapping is not None else []
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
