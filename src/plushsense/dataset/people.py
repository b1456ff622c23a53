"""People of a data set: ``subjects.csv`` in its folder, with codes and groups and never names.

The first columns are ``subject,age_group,gender,consent``; a user may add others (``handedness``, …), which are kept.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.files import write_file

PEOPLE = "subjects.csv"
COLUMNS = ("subject", "age_group", "gender", "consent")


@dataclass(frozen=True)
class PersonInfo:
    """One person by code; unknown values are "", ``more`` holds columns that the user added."""

    subject: str
    age_group: str = ""
    gender: str = ""
    consent: str = ""
    more: dict[str, str] = field(default_factory=dict)


def read_people(path: Path) -> dict[str, PersonInfo]:
    """Read the people of a file (or of the data set folder ``path``) by code; empty if there is no such file.

    Raises:
        DatasetError: for a file without a column ``subject``, a row without a code, or a code that stands there twice.
    """
    path = path / PEOPLE if path.is_dir() else path
    people: dict[str, PersonInfo] = {}
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        return people
    except (OSError, UnicodeDecodeError) as cause:
        raise DatasetError(f"The people's file '{path}' cannot be read ({cause}): give a CSV file in UTF-8.") from None
    first = text.partition("\n")[0]
    try:
        reader = csv.DictReader(io.StringIO(text), delimiter=";" if ";" in first else ",", strict=True)
        columns = [c.strip().casefold() for c in reader.fieldnames or ()]
        if "subject" not in columns or len(set(columns)) != len(columns):
            raise DatasetError(
                f"The people's file '{path}' has the columns {', '.join(columns) or 'nothing'}; it needs 'subject', "
                f"accepted besides are {', '.join(COLUMNS[1:])} and others of your own, each once."
            )
        reader.fieldnames = columns
        for row in reader:
            cells = {k: (v or "").strip() for k, v in row.items() if isinstance(k, str) and not isinstance(v, list)}
            code = cells.pop("subject")
            if not code or code in people:
                raise DatasetError(
                    f"The people's file '{path}' line {reader.line_num} "
                    + (f"names '{code}' again: one line a person." if code else "names no subject: fill in the code.")
                )
            known = {key: cells.pop(key, "") for key in COLUMNS[1:]}
            people[code] = PersonInfo(code, **known, more=cells)
    except csv.Error as cause:
        raise DatasetError(f"The people's file '{path}' is no CSV file: {cause}.") from None
    return people


def write_people(folder: Path, people: Iterable[PersonInfo]) -> None:
    """Replace the people's file of the data set in ``folder``, sorted by code."""
    listed = sorted(people, key=lambda p: p.subject)
    more = list(dict.fromkeys(key for p in listed for key in p.more))
    out = io.StringIO()
    writer = csv.DictWriter(out, [*COLUMNS, *more], lineterminator="\n", restval="")
    writer.writeheader()
    for p in listed:
        own = {"subject": p.subject, "age_group": p.age_group, "gender": p.gender, "consent": p.consent}
        writer.writerow(p.more | own)
    write_file(folder / PEOPLE, out.getvalue())
