"""The tables of a package: recordings, streams, people, gestures and channels, as plain CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

from plushsense.core.gestures import NOBODY
from plushsense.dataset.publish.contents import Contents
from plushsense.dataset.publish.description import (
    CHANNELS_TABLE,
    DATA,
    GESTURES_TABLE,
    INTEGER,
    NUMBER,
    RECORDINGS_TABLE,
    STREAMS_TABLE,
    SUBJECTS_TABLE,
    TEXT,
    YES_NO,
    Column,
    Table,
    sample_columns,
)
from plushsense.dataset.store import RECORDINGS, STREAMS, UNKNOWN_SUBJECT, Dataset

Row = tuple[object, ...]

_SUBJECT = Column("subject", TEXT, "code of the person; none: nobody touched the toy; unknown: not known who")
_RECORDINGS = (
    Column("id", TEXT, "the recording"),
    Column("subject", TEXT, "who made it", refers="subjects.subject"),
    Column("session", TEXT, "the person's session"),
    Column("gesture", TEXT, "what was done", refers="gestures.gesture"),
    Column("affect", TEXT, "what the gesture carries: positive, neutral, negative, or none where nobody said"),
    Column("file", TEXT, "the file, from the root of the package"),
    Column("first_row", INTEGER, "row of the file at which it begins, from 0", "row"),
    Column("rows", INTEGER, "how many rows it has", "row"),
    Column("start", INTEGER, "first row, counted from first_row, that remains after trimming", "row"),
    Column("stop", INTEGER, "row before which the trimmed recording ends", "row"),
    Column("excluded", YES_NO, "whether it is not to be used"),
    Column("stream", TEXT, "file of the session's stream in which it stands; empty: not found in one"),
    Column("stream_row", INTEGER, "row of that stream at which it begins, from 0", "row"),
    Column("seconds", NUMBER, "how long it takes by the toy's clock, gaps and restarts left out", "s"),
    Column("rate_hz", NUMBER, "measured rate", "Hz"),
    Column("flags", TEXT, "what the checks at the door found, parted by |"),
    Column("sha256", TEXT, "SHA-256 of the file"),
)
_STREAMS = (
    Column("file", TEXT, "the file, from the root of the package"),
    Column("subject", TEXT, "whose session it is", refers="subjects.subject"),
    Column("session", TEXT, "the person's session"),
    Column("rows", INTEGER, "how many rows it has", "row"),
    Column("seconds", NUMBER, "how long it takes by the toy's clock, gaps and restarts left out", "s"),
    Column("restarts", INTEGER, "how often the clock fell or left a gap"),
    Column("flags", TEXT, "what the checks at the door found, parted by |"),
    Column("sha256", TEXT, "SHA-256 of the file"),
)
_GESTURES = (
    Column("class", INTEGER, "class index, from 0"),
    Column("gesture", TEXT, "its label"),
    Column("affect", TEXT, "what it carries: positive, neutral, negative, or none where nobody said"),
    Column("family", TEXT, "its family of look-alikes"),
    Column("free_choice", YES_NO, "whether everybody did something else under this label"),
    Column("recordings", INTEGER, "how many recordings there are"),
    Column("people", INTEGER, "by how many people"),
    Column("description", TEXT, "how it is made"),
)
_CHANNELS = (
    Column("channel", TEXT, "its name: the column of recordings and streams"),
    Column("kind", TEXT, "what it measures"),
    Column("unit", TEXT, "unit of the physical value"),
    Column("offset", NUMBER, "physical value = (raw - offset) * scale"),
    Column("scale", NUMBER, "see offset"),
    Column("step", NUMBER, "smallest difference of raw values"),
    Column("valid_min", NUMBER, "smallest valid raw value; what is below is sensor garbage"),
    Column("valid_max", NUMBER, "largest valid raw value; what is above is sensor garbage"),
)


def tables_of(contents: Contents) -> list[tuple[Table, str]]:
    """The tables beside the data, and the text of each."""
    d = contents.dataset
    people = _people_columns(contents)
    made = [
        (Table("recordings", "one line a recording", _RECORDINGS, RECORDINGS_TABLE, key="id"), _recordings(d)),
        (Table("subjects", "one line a person", people, SUBJECTS_TABLE, key="subject"), _people(contents)),
        (Table("gestures", "one line a gesture", _GESTURES, GESTURES_TABLE, key="gesture"), _gestures(d)),
        (Table("channels", "one line a channel", _CHANNELS, CHANNELS_TABLE, key="channel"), _channels(d)),
    ]
    if d.streams:
        made.append((Table("streams", "one line a session's stream", _STREAMS, STREAMS_TABLE, key="file"), _streams(d)))
    return [(table, _text(table, rows)) for table, rows in made]


def write_tables(root: Path, contents: Contents) -> tuple[Table, ...]:
    """Write the tables beside the data, and describe them and the data's files."""
    d = contents.dataset
    made = []
    for table, text in tables_of(contents):
        (root / table.file).write_text(text, encoding="utf-8", newline="\n")
        made.append(table)
    labelled = d.layout.is_labelled
    columns = sample_columns(d.layout, labelled)
    if not labelled:
        files = tuple(sorted({f"{DATA}/{r.file}" for r in d.recordings}))
        made.append(
            Table(
                "samples",
                "the rows of every recording, all files one after the other",
                columns,
                files=files,
                glob=f"{DATA}/{RECORDINGS}/**/*.csv",
            )
        )
    if d.streams:
        files = tuple(sorted(f"{DATA}/{s.file}" for s in d.streams))
        text = "the rows of every session's stream, what lay between the gestures included"
        made.append(Table("stream-samples", text, columns, files=files, glob=f"{DATA}/{STREAMS}/**/*.csv"))
    return tuple(made)


def _text(table: Table, rows: Iterable[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([c.name for c in table.columns])
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return out.getvalue()


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _recordings(d: Dataset) -> Iterable[Row]:
    files = {s.id: f"{DATA}/{s.file}" for s in d.streams}
    for r in d.recordings:
        found = r.stream_row >= 0 and r.stream in files
        gesture = d.gestures.find(r.gesture)
        yield (
            r.id,
            r.subject,
            r.session,
            r.gesture,
            gesture.affect if gesture else "none",
            f"{DATA}/{r.file}",
            r.first_row,
            r.rows,
            r.start,
            r.stop,
            r.excluded,
            files[r.stream] if found else "",
            r.stream_row if found else None,
            (r.rows - 1) / r.rate_hz if r.rate_hz > 0 else None,
            r.rate_hz,
            " | ".join(r.flags),
            r.sha256,
        )


def _streams(d: Dataset) -> Iterable[Row]:
    for s in d.streams:
        yield f"{DATA}/{s.file}", s.subject, s.session, s.rows, s.seconds, s.restarts, " | ".join(s.flags), s.sha256


def _people_columns(contents: Contents) -> tuple[Column, ...]:
    more = dict.fromkeys(key for p in contents.people.values() for key in p.more)
    return (
        _SUBJECT,
        Column("age_group", TEXT, "as given; empty: not said"),
        Column("gender", TEXT, "as given; empty: not said"),
        *(Column(key, TEXT, "as given by those who recorded") for key in more),
        Column("recordings", INTEGER, "how many recordings there are"),
        Column("sessions", INTEGER, "in how many sessions"),
    )


def _people(contents: Contents) -> Iterable[Row]:
    d = contents.dataset
    more = list(dict.fromkeys(key for p in contents.people.values() for key in p.more))
    # Nobody and the unknown stand here too, so that every reference leads somewhere.
    for code in sorted({r.subject for r in d.recordings} | {s.subject for s in d.streams}):
        mine = [r for r in d.recordings if r.subject == code]
        person = contents.people.get(code)
        said = (person.age_group, person.gender) if person else ("", "")
        own = [person.more.get(key, "") if person else "" for key in more]
        yield code, *said, *own, len(mine), len({r.session for r in mine})


def _gestures(d: Dataset) -> Iterable[Row]:
    for index, g in enumerate(d.gestures.gestures):
        mine = [r for r in d.recordings if r.gesture == g.label]
        people = {r.subject for r in mine} - {NOBODY, UNKNOWN_SUBJECT}
        yield index, g.label, g.affect, g.family, g.free_choice, len(mine), len(people), g.description
    # Labels that came after the set was made stand here too, so that every reference leads somewhere.
    for label in sorted({r.gesture for r in d.recordings} - set(d.gestures.labels)):
        mine = [r for r in d.recordings if r.gesture == label]
        yield None, label, "none", label, False, len(mine), len({r.subject for r in mine}), "not in the gesture set"


def _channels(d: Dataset) -> Iterable[Row]:
    for c in d.layout.channels:
        yield c.name, c.kind, c.unit, *(repr(v) for v in (c.offset, c.scale, c.step, c.valid_min, c.valid_max))
