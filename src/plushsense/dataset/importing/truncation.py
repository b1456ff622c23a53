"""Read what the authors' truncation script leaves: the folder of uncut originals, and ``truncate_choices.csv``.

``c_training_data_truncation.m`` shows every recording, asks how many of its first rows to cut off, and writes the
answers to ``truncate_choices.csv``. It then copies the recordings to ``Training Data - backup <time>`` and overwrites
them with what remains; it skips those of which nothing would remain.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

from plushsense.core.errors import DatasetError
from plushsense.core.recorder_csv import parse_name
from plushsense.core.sentences import Sentence
from plushsense.dataset.marks import BY_HAND, Mark, MarkState
from plushsense.dataset.store import RecordingInfo, read_csv_rows

CHOICES = "truncate_choices.csv"
_BACKUP = re.compile(r"training data - backup \d{4}-\d\d-\d\d_\d{6}", re.IGNORECASE)
# The person who chose is not in the files.
IMPORTER = "plushsense import"
CHOSEN = Sentence("no recording: its choices become marks of the recordings", "choices_read")
REPLACED = Sentence("cut by the truncation script: its uncut original is imported, and the cut is a mark", "cut_copy")
_COLUMNS = ("filename", "fullpath", "length", "truncaten")


@dataclass(frozen=True)
class Choice:
    """Answer for one recording: its file and folder, its number of rows, and how many of the first ones to cut off.

    ``where`` tells where the answer stands.
    """

    name: str
    folder: str
    rows: int
    cut: int
    where: str = CHOICES


@dataclass
class Truncation:
    """What the truncation script has left in a source.

    Attributes:
        files: the files to import; a cut recording stands for its original.
        originals: the uncut original to import in place of each cut recording.
        left_out: why other files of the script are not imported.
        refused: why files of choices cannot be read.
        choices: how many rows the script has cut off, or the user has chosen to.
        notes: a note if the file of choices beside the source cannot be read.
    """

    files: list[Path]
    originals: dict[Path, Path] = field(default_factory=dict)
    left_out: dict[Path, Sentence] = field(default_factory=dict)
    refused: dict[Path, Sentence] = field(default_factory=dict)
    choices: list[Choice] = field(default_factory=list)
    notes: list[Sentence] = field(default_factory=list)

    def match_backups(self, source: Path) -> None:
        """Match the recordings in backup folders below ``source`` with the cut ones, by name.

        Of several backups of a recording, the oldest is its original. One without a cut recording is kept as it is.
        """
        folders = {path: folder for path in self.files if (folder := _backup_of(path, source))}
        self.files = [path for path in self.files if path not in folders]
        present: dict[str, list[Path]] = {}
        for path in self.files:
            if parse_name(path.name):
                present.setdefault(path.name.casefold(), []).append(path)
        for path in sorted(folders, key=lambda p: (folders[p], p)):
            named = present.get(path.name.casefold(), [])
            cut = next((p for p in named if p.parent.name == path.parent.name), named[0] if named else None)
            if cut is None:
                self.files.append(path)
                if parse_name(path.name):
                    present[path.name.casefold()] = [path]
            elif cut in folders or cut in self.originals or (counts := _rows_before(cut, path)) is None:
                message = f"a copy, in '{folders[path]}', of a recording that is imported"
                self.left_out[path] = Sentence(message, "backup_copy", folder=folders[path])
            else:
                self.originals[cut] = path
                where = f"the cut copy in '{cut.parent.name}'"
                self.choices.append(Choice(path.name, path.parent.name, counts[0], counts[1], where))
        self.files.sort()
        self.left_out |= dict.fromkeys(self.originals, REPLACED)

    def add_choices(self, source: Path) -> None:
        """Read the choices in ``source``, or beside it, where the script writes them; a backup overrides them."""
        inside = [f for f in self.files if f.name.casefold() == CHOICES]
        beside = source.resolve().parent / CHOICES
        restored, read = {choice.name.casefold() for choice in self.choices}, list[Choice]()
        for path in inside or ([beside] if beside.is_file() else []):
            try:
                read += read_choices(path)
            except DatasetError as cause:
                if inside:
                    self.refused[path] = Sentence.of(cause)
                else:
                    message = f"no trims are taken from the file beside the folder: {cause}"
                    self.notes.append(Sentence(message, "choices_unread", file=path.name))
        self.choices = [choice for choice in read if choice.name.casefold() not in restored] + self.choices
        self.left_out |= {path: CHOSEN for path in inside if path not in self.refused}
        self.files = [path for path in self.files if path not in inside]


def find_truncation(source: Path, files: Iterable[Path]) -> Truncation:
    """Return what the truncation script has left among the ``files`` of a source."""
    found = Truncation(list(files))
    found.match_backups(source)
    found.add_choices(source)
    return found


def _backup_of(path: Path, source: Path) -> str:
    """Return the name of the backup folder below ``source`` that contains a file; "" if there is none."""
    return next((part for part in path.relative_to(source).parts[:-1] if _BACKUP.fullmatch(part)), "")


def _rows_before(cut: Path, original: Path) -> tuple[int, int] | None:
    """Return the rows of ``original``, and how many of them come before those of ``cut``; None if it is no part."""
    (rows, whole), (kept, part) = _ends(original, 0), _ends(cut, 0)
    before = rows - kept
    if part is None or before < 0 or whole is None or whole[1] != part[1]:
        return None
    first = _ends(original, before)[1]
    return (rows, before) if first is not None and first[0] == part[0] else None


def _ends(path: Path, start: int) -> tuple[int, tuple[list[float], list[float]] | None]:
    """Return the number of rows of a recording, and its row ``start`` and last row; None if they are not numbers."""
    try:
        lines = [line for line in path.read_bytes().splitlines() if line.strip()]
        rows = lines[bool(lines) and any(c.isalpha() for c in lines[0].decode("latin-1")) :]
        row, last = ([float(cell) for cell in rows[at].split(b";")] for at in (start, -1))
    except (OSError, ValueError, IndexError):
        return 0, None
    return len(rows), (row, last)


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
        choices.append(Choice(name, PureWindowsPath(full).parent.name, int(numbers[0]), int(numbers[1])))
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
        recordings: recordings of the data set; those with a trim in ``states``, or an undone one, stay as they are.
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
        now = (states or {}).get(info.id, MarkState())
        if not mine or now.trimmed or now.trim_by:
            continue
        choice = mine[-1]
        if choice.cut >= choice.rows:
            results["would leave nothing, so that recordings stay whole, as the script leaves them"] += 1
        elif info.rows == choice.rows:
            why = f"{choice.where}: the first {choice.cut} of {choice.rows} rows cut off"
            marks.append(Mark(info.id, "trim", IMPORTER, why, start=choice.cut, how=BY_HAND))
            results["trim their recordings by a mark"] += 1
        elif info.rows == choice.rows - choice.cut:
            why = f"{choice.where}: the first {choice.cut} of {choice.rows} rows were cut off before the import"
            marks.append(Mark(info.id, "trim", IMPORTER, why, how=BY_HAND))
            results["were carried out before the import"] += 1
        else:
            results["do not fit, because the recording has another number of rows: no mark"] += 1
    here = {path.name.casefold() for path in origin.values()}
    if absent := sum(name not in here for name in by_name):
        results["are of recordings that are not in the source (a backup lacks those that the script skipped)"] = absent
    return marks, list(_notes(results))


def _notes(results: Mapping[str, int]) -> Iterator[str]:
    if results:
        parts = "; ".join(f"{count} {result}" for result, count in results.items())
        yield f"cuts of the truncation script, how many rows to cut off at the beginning: {parts}"
