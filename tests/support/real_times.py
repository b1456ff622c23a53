"""Make recordings of the virtual toy count as real ones, for tests of what happens without the mark of a simulation."""

from __future__ import annotations

import shutil
from pathlib import Path

from plushsense.core.recorder_csv import SIMULATION_MARK


def as_if_real(folder: Path) -> None:
    """Remove the mark from a folder, and from the times of the rows of layout plush-15 or plush-14: 3 ms are added."""
    (folder / SIMULATION_MARK).unlink(missing_ok=True)
    for path in folder.rglob("*.csv"):
        lines = []
        for line in path.read_text().splitlines():
            cells = line.split("; ")
            if cells[0][-1:].isdigit():
                cells[13] = str(int(cells[13]) + 3)
            lines.append("; ".join(cells))
        path.write_text("\n".join(lines) + "\n")


def copied_as_if_real(folder: Path, target: Path) -> Path:
    """Copy a folder, and apply `as_if_real` to the copy."""
    shutil.copytree(folder, target)
    as_if_real(target)
    return target
