"""Show what an import would understand: some rows, the number of recordings, and what it leaves out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from plushsense.core.errors import FileFormatError
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames, parse_name, read_recording, read_stream
from plushsense.dataset.importing.build import group_flags, unknown_labels
from plushsense.dataset.importing.counters import counters_note
from plushsense.dataset.importing.sources import LEFT_OUT, SourceFile, SourceScan
from plushsense.dataset.quality.measurements import Examination
from plushsense.dataset.quality.recordings import clock_still
from plushsense.dataset.store import RECORDINGS, STREAMS

ROWS, _RECORDINGS = 10, 5


@dataclass(frozen=True)
class PreviewRow:
    """One sample of a previewed recording; ``values`` are in the units of the file, None where a value is invalid."""

    file: str
    subject: str
    session: str
    gesture: str
    time_ms: int
    values: dict[str, float | None]


@dataclass(frozen=True)
class ImportPreview:
    """Result of a dry run of an import: sample rows, counts of recordings by gesture, and what would be left out.

    ``recordings`` and ``streams`` count files; recordings that are parts of a labelled stream are not counted.
    """

    layout: str
    recordings: int
    streams: int
    subjects: list[str]
    gestures: dict[str, int]
    rows: list[PreviewRow]
    rejected: list[dict[str, str]]
    left_out: list[dict[str, str]]
    warnings: list[str]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def preview(search: SourceScan) -> ImportPreview:
    """Read some rows of the files that a search has found."""
    files = [f for f in search.found if f.kind in (RECORDINGS, STREAMS)]
    recordings = [f for f in files if f.kind == RECORDINGS]
    named = {f.source: f.gesture or name.label for f in recordings if (name := parse_name(f.source.name)) is not None}
    shown = _spread(recordings or files)
    rows: list[PreviewRow] = []
    frames: list[Frames] = []
    flags: list[tuple[str, str]] = []
    rejected = [{"file": f.origin, "reason": f.reason} for f in search.found if not f.kind]
    for file in shown:
        try:
            read = (read_stream if file.kind == STREAMS else read_recording)(file.source, search.layout)
        except FileFormatError as cause:
            rejected.append({"file": file.origin, "reason": str(cause)})
            continue
        frames.append(read.frames)
        count = -(-ROWS // len(shown))
        rows += _rows(file, named.get(file.source, ""), read.frames.slice(0, count), search.layout)
        examined = Examination(read.frames, search.layout)
        flags += [(file.origin, str(issue.message)) for issue in clock_still(examined)]
    counts = Counter(named.values())
    notes = [*search.notes, *counters_note(search.layout, frames), *group_flags(flags)]
    if search.gestures is not None and (note := unknown_labels(search.gestures, named.values())):
        notes.append(note)
    return ImportPreview(
        search.layout.name,
        len(recordings),
        len(files) - len(recordings),
        sorted({f.subject for f in files}),
        dict(sorted(counts.items())),
        rows[:ROWS],
        rejected,
        [{"file": f.origin, "reason": f.reason} for f in search.found if f.kind == LEFT_OUT],
        notes,
    )


def _spread(files: Sequence[SourceFile]) -> list[SourceFile]:
    """Return some of the files, spread evenly over all of them."""
    step = max(1, len(files) // _RECORDINGS)
    return list(files[::step][:_RECORDINGS])


def _rows(file: SourceFile, gesture: str, frames: Frames, layout: Layout) -> list[PreviewRow]:
    low, high = layout.valid_min_int, layout.valid_max_int
    steps = [c.step for c in layout.channels]
    made = []
    for k, row in enumerate(frames.values):
        valid = ((row >= low) & (row <= high)).tolist()
        values = [float(f"{v * s:.9g}") if ok else None for v, s, ok in zip(row.tolist(), steps, valid, strict=True)]
        label = gesture if frames.labels is None else str(frames.labels[k])
        time_ms = int(frames.device_ms[k])
        named = dict(zip(layout.names, values, strict=True))
        made.append(PreviewRow(file.origin, file.subject, file.session, label, time_ms, named))
    return made
