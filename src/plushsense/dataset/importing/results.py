"""Results of an import: the new data set, what became of each file, and warnings for the user."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from plushsense.core.sentences import Message
from plushsense.dataset.importing.proposals import Proposal, Sensor
from plushsense.dataset.store import Dataset


@dataclass(frozen=True)
class FileReason:
    """A file that is left out or rejected, as messages name it, and the reason."""

    file: str
    reason: str

    def to_json(self) -> dict[str, str]:
        """Return plain values for JSON."""
        return {"file": self.file, "reason": self.reason}


@dataclass(frozen=True)
class ImportResult:
    """Result of an import.

    Attributes:
        dataset: the data set after the import.
        rejected: files that cannot be used.
        left_out: files that are not needed.
        warnings: one for each kind of flag of new recordings and streams.
        notes: what else the user should know.
        companions: number of copied sidecars, session heads and logs.
        excluded: number of new recordings that are excluded.
        added_recordings: number of new recordings.
        added_streams: number of new streams.
        already_there: number of files that existed already.
        trimmed: number of trims by the choices of the authors' truncation script.
        proposals: settings that fit the recordings better than those of the layout.
        sensors: the accelerometers of the sessions.
        seconds: duration of the import.
    """

    dataset: Dataset
    rejected: tuple[FileReason, ...]
    left_out: tuple[FileReason, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    companions: int = 0
    excluded: int = 0
    added_recordings: int = 0
    added_streams: int = 0
    already_there: int = 0
    trimmed: int = 0
    proposals: tuple[Proposal, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    seconds: float = 0.0

    @property
    def recordings(self) -> int:
        """Number of recordings of the data set."""
        return len(self.dataset.recordings)

    @property
    def subjects(self) -> int:
        """Number of people of the data set."""
        return len(self.dataset.subjects)

    @property
    def gestures(self) -> list[str]:
        """Gestures of the recordings of the data set."""
        return sorted({r.gesture for r in self.dataset.recordings})

    @property
    def streams(self) -> int:
        """Number of streams of the data set."""
        return len(self.dataset.streams)

    @property
    def messages(self) -> tuple[str, ...]:
        """Notes and warnings."""
        return self.notes + self.warnings

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "recordings": self.recordings,
            "subjects": self.subjects,
            "gestures": self.gestures,
            "streams": self.streams,
            "rejected": [entry.to_json() for entry in self.rejected],
            "left_out": [entry.to_json() for entry in self.left_out],
            "companions": self.companions,
            "excluded": self.excluded,
            "added": {"recordings": self.added_recordings, "streams": self.added_streams},
            "already_there": self.already_there,
            "proposals": [proposal.to_json() for proposal in self.proposals],
            "sensors": [sensor.to_json() for sensor in self.sensors],
            "trimmed": self.trimmed,
            "warnings": list(self.messages),
            "seconds": round(self.seconds, 2),
            "hash": self.dataset.hash,
        }


@dataclass(frozen=True)
class PreviewRow:
    """A row of the table that a dry run prints: one sample of a recording, before it is imported.

    ``values`` are in the units of the file by channel, None where a value is invalid.
    """

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
    rows: tuple[PreviewRow, ...]
    rejected: tuple[FileReason, ...]
    left_out: tuple[FileReason, ...]
    messages: tuple[str, ...]
    proposals: tuple[Proposal, ...] = ()
    sensors: tuple[Sensor, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "layout": self.layout,
            "recordings": self.recordings,
            "streams": self.streams,
            "subjects": self.subjects,
            "gestures": self.gestures,
            "rows": [vars(row) for row in self.rows],
            "rejected": [entry.to_json() for entry in self.rejected],
            "left_out": [entry.to_json() for entry in self.left_out],
            "warnings": list(self.messages),
        }


_PARTS = re.compile(r"\([^()]*\)|'[^']*'|(?<= as ).+|[+-]?\d+(?:\.\d+)?( \w+?)?s?\b")


_SEVERAL = {
    "files": "{n} files, for instance {file}: {note}",
    "recordings or streams": "{n} recordings or streams, for instance {file}: {note}",
}


def group_flags(flags: Iterable[tuple[str, str]], noun: str = "recordings or streams") -> list[Message]:
    """Return one warning for each kind of flag.

    Args:
        flags: the id of a recording or stream, and the message of a check. Messages are of one kind if they differ
            only in numbers, names in quotes or at the end behind "as", and remarks in brackets.
        noun: what the ids are of.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for identity, flag in flags:
        kinds.setdefault(_PARTS.sub(lambda part: f"#{part[1] or ''}", flag), []).append((identity, flag))
    return [
        Message(
            _SEVERAL[noun] if len(found) > 1 else "{file}: {note}", n=len(found), file=found[0][0], note=found[0][1]
        )
        for found in kinds.values()
    ]


SIMULATED = Message("these recordings are a simulation: scores on them say nothing about a real toy")
NO_PEOPLE = Message(
    "the folders are gestures, so the people are not known: splits by subject are not possible; import again with "
    "--streams DIR if the fulldatastream.csv of each person is there, or with --subjects map.csv (columns "
    "file,subject) if a mapping is"
)
NO_PEOPLE_OF_WINDOWS = (
    "the windows do not name the people, so splits by subject are not possible: import the recordings, if they exist"
)
NO_PEOPLE_OF_PATTERN = Message(
    "the pattern finds no person, so the people are not known, and splits by subject are not possible: put {subject} "
    "into paths, give its column, or import again with --subjects map.csv (columns file,subject)"
)
