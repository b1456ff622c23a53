"""Generation of a data set: keeps results of people who were removed from being written afterwards.

`forget` holds the data set's lock while it removes a person, and appends a line to ``forgotten.jsonl``. Code that
writes something derived from a data set takes the same lock and compares the number of these lines with that at the
time the data set was opened. This reads two small files and scans nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from plushsense.core.errors import DatasetError, ForgottenError
from plushsense.dataset.marks import MARKS

FORGOTTEN = "forgotten.jsonl"
UNDER_WAY = "forgetting.json"
LOCK = MARKS + ".lock"
# Far longer than the removal of a large cache from a slow disk.
_LOCK_S = 600.0


@dataclass(frozen=True)
class Generation:
    """A data set between two removals of people: its folder, and how many people had been taken out of it."""

    folder: Path
    removals: int

    @classmethod
    def of(cls, folder: Path) -> Generation:
        """Return the present generation of the data set in ``folder``; read it before any of the data."""
        try:
            return cls(folder, (folder / FORGOTTEN).read_bytes().count(b"\n"))
        except (FileNotFoundError, NotADirectoryError):
            return cls(folder, 0)

    def check(self) -> None:
        """Refuse to go on when a person was taken out of the data set since.

        Raises:
            ForgottenError: also while a removal is not finished.
        """
        if self.of(self.folder) != self:
            raise ForgottenError(
                f"A person was taken out of '{self.folder}' (plushsense forget) while this ran, so its results are "
                "not kept: run it again on the data set as it is now."
            )
        if (self.folder / UNDER_WAY).exists():
            raise ForgottenError(
                f"A person is being taken out of '{self.folder}' and that is not finished, so nothing was written: "
                "finish  plushsense forget  there, then run this again."
            )

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the data set's lock while something derived from it is written; do not nest.

        On a read-only disk, or one without locks, only `check` is made.

        Raises:
            ForgottenError: as `check`; DatasetError: when another program does not give the lock back.
        """
        lock = FileLock(self.folder / LOCK, timeout=_LOCK_S)
        try:
            lock.acquire()
        except Timeout:
            raise DatasetError(
                f"Another program has held '{self.folder / LOCK}' for {_LOCK_S / 60:.0f} minutes: end it, then run "
                "this again."
            ) from None
        except (OSError, NotImplementedError):
            pass
        try:
            self.check()
            yield
        finally:
            lock.release()
