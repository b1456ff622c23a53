"""Making a folder whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from plushsense.core.errors import BadInput


@contextmanager
def whole_folder(dest: Path, error: type[BadInput], last: str = "") -> Iterator[Path]:
    """A work folder beside ``dest`` that becomes ``dest`` at the end, and is removed when anything fails.

    Its name is new each time, so no folder of the user's is touched, and what a killed run leaves does no harm. An
    empty ``dest`` (also ``.``, or a link to an empty folder) is filled rather than replaced; the file ``last`` comes
    last.

    Raises:
        error: when ``dest`` holds something already, or the disk refuses (no permission, no room).
    """
    scratch: Path | None = None
    try:
        if dest.is_symlink() and not dest.exists():
            raise error(f"'{dest}' is a link that leads nowhere: give a new or empty folder.")
        real = dest.resolve()
        if real.exists() and (not real.is_dir() or any(real.iterdir())):
            raise error(f"'{dest}' already holds something: give a new or empty folder, nothing is overwritten.")
        real.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{real.name}-unfinished-", dir=real.parent))
        work = scratch / (real.name or "folder")
        work.mkdir()
        yield work
        if real.is_dir():
            for entry in sorted(work.iterdir(), key=lambda p: p.name == last):
                os.replace(entry, real / entry.name)
        else:
            os.replace(work, real)
    except OSError as cause:
        where = f" at '{cause.filename}'" if cause.filename else ""
        raise error(
            f"'{dest}' cannot be made ({cause.strerror or cause}{where}): check the path and the disk."
        ) from None
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
