"""Read what the authors' truncation script leaves: the folder of uncut originals, and ``truncate_choices.csv``.

``c_training_data_truncation.m`` shows every recording, asks how many of its first rows to cut off, and writes the
answers to ``truncate_choices.csv``. It then copies all recordings to ``Training Data - backup <time>`` and overwrites
them with what remains.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from plushsense.core.errors import DatasetError
from plushsense.core.recorder_csv import parse_name
from plushsense.core.sentences import Sentence
from plushsense.dataset.marks import BY_HAND, Mark, MarkState
from plushsense.dataset.store import RecordingInfo, read_csv_rows

CHOICES = "truncate_choices.csv"
_BACKUP = re.compile(r"training data - backup \d{4}-\d\d-\d\d_\d{6}", re.IGNORECASE)
# The author of the choices is not in the file.
_WHO = "plushsense import"
CHOSEN = Sentence("no recording: its choices become marks of the recordings", "choices_read")
_COLUMNS = ("filename", "fullpath", "length", "truncaten")


@dataclass(frozen=True)
class Choice:
    """Answer for one recording: its file and folder, its number of rows, and how many of the first ones to cut off."""

    name: str
    folder: str
    rows: int
    cut: int


def split_backups(source: Path, files: Iterable[Path]) -> tuple[list[Path], dict[Path, str]]:
    """Split off the originals in backup folders below ``source`` of which the cut recording is among ``files`` too.

    An original without that is kept as a recording; of several backups of it, the oldest is kept. The second value
    is, by file, the name of the backup folder.
    """
    files = list(files)
    backups = {path: backup for path in files if (backup := _backup_of(path, source))}
    present = {path.name.casefold() for path in files if path not in backups and parse_name(path.name)}
    kept, originals = [path for path in files if path not in backups], {}
    for path in sorted(backups, key=lambda p: (backups[p], p)):
        if path.name.casefold() in present:
            originals[path] = backups[path]
            continue
        kept.append(path)
        if parse_name(path.name):
            present.add(path.name.casefold())
    return sorted(kept), originals


def _backup_of(path: Path, source: Path) -> str:
    """Return the name of the backup folder below ``source`` that contains a file; "" if there is none."""
    return next((part for part in path.relative_to(source).parts[:-1] if _BACKUP.fullmatch(part)), "")


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
        try:
            numbers = [float(length), float(cut)]
            if any(number != int(number) or number < 0 for number in numbers):
                raise ValueError
        except (ValueError, OverflowError):
            raise DatasetError(
                f"'{path.name}' line {line} has Length '{length}' and TruncateN '{cut}': both must be whole numbers "
                "from 0 on, or NaN."
            ) from None
        # The script ran on another computer, whose paths may have backslashes.
        choices.append(Choice(name, PureWindowsPath(full).parent.name, *(int(number) for number in numbers)))
    return choices


def truncation_marks(
    choices: Iterable[Choice],
    recordings: Iterable[RecordingInfo],
    origin: Mapping[str, Path],
    states: Mapping[str, MarkState] | None = None,
) -> tuple[list[Mark], list[str]]:
    """Return the trims that ``choices`` make of recordings, and notes on how many could be used.

    A recording with as many rows as when the script displayed it is trimmed. One from which the script has cut the rows
    gets a trim that keeps all rows, as its beginning has been decided. Any other recording of the same name is another
    one, or was changed since.

    Args:
        recordings: recordings of the data set; those with a trim in ``states`` are left as they are.
        origin: the source of each file of the data set.
    """
    by_name: dict[str, list[Choice]] = {}
    for choice in choices:
        by_name.setdefault(choice.name.casefold(), []).append(choice)
    marks: list[Mark] = []
    results: Counter[str] = Counter()
    for info in recordings:
        path = origin.get(info.file)
        named = by_name.get(path.name.casefold(), ()) if path is not None else ()
        mine = [c for c in named if len(named) == 1 or (path is not None and c.folder == path.parent.name)]
        if not mine or (states or {}).get(info.id, MarkState()).trimmed:
            continue
        choice = mine[-1]
        if choice.cut >= choice.rows:
            results["cut off everything, which the script skips too: left out"] += 1
        elif info.rows == choice.rows:
            why = f"{CHOICES}: the first {choice.cut} of {choice.rows} rows cut off"
            marks.append(Mark(info.id, "trim", _WHO, why, start=choice.cut, how=BY_HAND))
            results["trim their recordings by a mark"] += 1
        elif info.rows == choice.rows - choice.cut:
            why = f"{CHOICES}: the first {choice.cut} of {choice.rows} rows were cut off before the import"
            marks.append(Mark(info.id, "trim", _WHO, why, how=BY_HAND))
            results["were carried out before the import"] += 1
        else:
            results["do not fit, because the recording has another number of rows: left out"] += 1
    return marks, list(_notes(results))


def _notes(results: Mapping[str, int]) -> Iterator[str]:
    if results:
        parts = "; ".join(f"{count} {result}" for result, count in results.items())
        yield f"choices of {CHOICES}, how many rows to cut off at the beginning: {parts}"


def original_of(backup: str) -> Sentence:
    """Return why a recording in the folder ``backup`` is left out."""
    return Sentence(
        f"the uncut original, in '{backup}', of a recording that is imported: import that folder alone to have all its "
        "rows",
        "uncut_original",
        folder=backup,
    )


def choices_of(source: Path, files: Iterable[Path]) -> tuple[list[Choice], dict[Path, Sentence | None], list[Sentence]]:
    """Read the choices of the truncation script in ``source``, or beside it, where the script writes them.

    Returns:
        The choices; for each such file in ``source`` why it cannot be read, None if it can; a note if the one beside
        ``source`` cannot be read.
    """
    inside = [f for f in files if f.name.casefold() == CHOICES]
    beside = source.resolve().parent / CHOICES
    choices: list[Choice] = []
    read: dict[Path, Sentence | None] = dict.fromkeys(inside)
    notes: list[Sentence] = []
    for path in inside or ([beside] if beside.is_file() else []):
        try:
            choices += read_choices(path)
        except DatasetError as cause:
            if path in read:
                read[path] = Sentence.of(cause)
            else:
                message = f"no trims are taken from the file beside the folder: {cause}"
                notes.append(Sentence(message, "choices_unread", file=path.name))
    return choices, read, notes
