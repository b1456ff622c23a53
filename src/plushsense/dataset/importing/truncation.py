"""Read ``truncate_choices.csv`` of the authors' truncation script: how many of its first rows each recording loses.

``c_training_data_truncation.m`` shows every recording, asks how many of its first rows to cut off, and writes the
answers to this file. Its second part copies the recordings to ``Training Data - backup <time>`` and overwrites them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from plushsense.core.errors import DatasetError
from plushsense.core.sentences import Message
from plushsense.dataset.marks import BY_HAND, Mark, MarkState
from plushsense.dataset.store import RecordingInfo, read_csv_rows

CHOICES = "truncate_choices.csv"
# The person who chose is not in the files.
IMPORTER = "plushsense import"
BACKUP = re.compile(r"training data - backup \d{4}-\d\d-\d\d_\d{6}", re.IGNORECASE)
ORIGINAL = Message(
    "an uncut original in a backup of the truncation script: import that folder alone, in place of the cut recordings"
)
CHOSEN = Message("no recording: its choices become marks of the recordings")
_COLUMNS = ("filename", "fullpath", "length", "truncaten")


@dataclass(frozen=True)
class Choice:
    """Answer for one recording: its file and folder, its number of rows, and how many of the first ones to cut off."""

    name: str
    folder: str
    rows: int
    cut: int


def read_choices(path: Path) -> list[Choice]:
    """Read ``truncate_choices.csv``; recordings that the user did not come to (NaN) are left out.

    Raises:
        DatasetError: for a file without these columns, or with a number that is none.
    """
    columns, rows = read_csv_rows(path, "file of choices")
    names = {re.sub("[^a-z0-9]", "", column): column for column in columns}
    if missing := [name for name in _COLUMNS if name not in names]:
        raise DatasetError(
            f"'{path.name}' has no column {', '.join(missing)}: the truncation script writes "
            "FileName,FullPath,Length,TruncateN."
        )
    choices = []
    for line, cells in rows:
        name, full, length, cut = (cells[names[column]] for column in _COLUMNS)
        if "nan" in (length.casefold(), cut.casefold()) or not (length and cut):
            continue
        if not re.fullmatch(r"\d{1,12}(\.0*)?", length) or not re.fullmatch(r"\d{1,12}(\.0*)?", cut):
            raise DatasetError(
                f"'{path.name}' line {line} has Length '{length}' and TruncateN '{cut}': both must be whole numbers "
                "from 0 on, or NaN."
            )
        # The script ran on another computer, whose paths may have backslashes.
        choices.append(Choice(name, PureWindowsPath(full).parent.name, int(float(length)), int(float(cut))))
    return choices


def truncation_marks(
    choices: Iterable[Choice],
    recordings: Iterable[RecordingInfo],
    origin: Mapping[str, Path],
    states: Mapping[str, MarkState],
) -> tuple[list[Mark], list[str]]:
    """Return the trims that ``choices`` make of recordings, and notes on how many could be used.

    A recording with as many rows as when the script displayed it is trimmed. One from which the script has cut the rows
    gets a trim that keeps all rows, as its beginning has been decided. Any other recording of the same name is another
    one, or was changed since.

    Args:
        recordings: recordings of the data set; those with a trim in ``states``, or an undone one, stay as they are.
        origin: the source of each file of the data set.
    """
    by_name: dict[str, list[Choice]] = {}
    for choice in choices:
        by_name.setdefault(choice.name.casefold(), []).append(choice)
    marks: list[Mark] = []
    results: Counter[str] = Counter()
    for info in recordings:
        path, now = origin.get(info.file), states.get(info.id, MarkState())
        named = by_name.get(path.name.casefold(), []) if path is not None else []
        mine = [c for c in named if len(named) == 1 or (path is not None and c.folder == path.parent.name)]
        if not mine or now.trimmed or now.trim_by:
            continue
        choice = mine[-1]
        if choice.cut >= choice.rows:
            results["would leave nothing, so that recordings stay whole, as the script leaves them"] += 1
        elif info.rows in (choice.rows, choice.rows - choice.cut):
            whole = info.rows == choice.rows
            done = "" if whole else "were "
            when = "cut off" if whole else "cut off before the import"
            why = f"{CHOICES}: the first {choice.cut} of {choice.rows} rows {done}{when}"
            start = choice.cut if whole else 0
            marks.append(Mark(info.id, "trim", IMPORTER, why, start=start, how=BY_HAND))
            results["trim their recordings by a mark" if whole else "were carried out before the import"] += 1
        else:
            results["do not fit, because the recording has another number of rows: no mark"] += 1
    here = {path.name.casefold() for path in origin.values()}
    if absent := sum(name not in here for name in by_name):
        results["are of recordings that are not in the source (a backup lacks those that the script skipped)"] = absent
    if not results:
        return marks, []
    parts = "; ".join(f"{count} {result}" for result, count in results.items())
    return marks, [f"cuts of the truncation script, how many rows to cut off at the beginning: {parts}"]
