"""Measure the time of reading recordings, against `np.loadtxt` alone and within the whole import.

1326 recordings of 700 rows × 15 columns, as many as in the paper, are written once. In every round each method reads
all of them in turn. Ratios are of processor time and taken within a round, so that other programs and slow changes of
the machine's speed have little effect. The import (copying, checksums, checks, index) is timed in the same rounds.

    python bench/reading.py [--rounds 7] [--folder RECORDINGS --layout NAME] [--json]
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, parse_name, read_recording, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings

FILES, ROWS, PEOPLE = 1326, 700, 26
GESTURES = ("Tail pull", "Hold strong", "Back stroke 1", "Ear scratch 2")


def write(folder: Path, layout: Layout) -> None:
    """Write recordings with the noise of a toy at rest, because the time to parse a number depends on its digits."""
    rng = np.random.default_rng(0)
    for number in range(FILES):
        person = folder / f"P{number % PEOPLE:02d}"
        person.mkdir(parents=True, exist_ok=True)
        clock = np.cumsum(rng.integers(9, 12, ROWS)) + number * 20_000
        values = rng.integers(-900, 4000, (ROWS, layout.n_channels))
        name = recording_filename(GESTURES[number % 4], 1_760_000_000_000 + number * 60_000, ROWS)
        write_recording(person / name, Frames(values, clock, clock + 1_760_000_000_000), layout)


def loadtxt(path: Path) -> None:
    """Read with NumPy alone, with header and delimiter given, as a lower bound."""
    with path.open() as file:
        separator = ";" if ";" in file.readline() else ","
    np.loadtxt(path, delimiter=separator, skiprows=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--layout", default="plush-15")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    layout = load_layout(args.layout)
    with tempfile.TemporaryDirectory(prefix="reading-") as scratch:
        source, dest = args.folder or Path(scratch) / "recordings", Path(scratch) / "DS"
        if args.folder is None:
            write(source, layout)
        files = sorted(p for p in source.rglob("*.csv") if parse_name(p.name) is not None)

        def whole_import() -> None:
            import_recordings(source, dest, layout=layout)
            shutil.rmtree(dest)

        ways: dict[str, Callable[[], object]] = {
            "np.loadtxt alone": lambda: [loadtxt(path) for path in files],
            "read_recording": lambda: [read_recording(path, layout) for path in files],
            "whole import": whole_import,
        }
        times: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(args.rounds + 1):
            for name, work in ways.items():
                began = time.process_time()
                work()
                times[name].append(time.process_time() - began)
    # The first round fills the disk cache.
    floor = times["np.loadtxt alone"][1:]
    rows = [
        {
            "way": name,
            "files": len(files),
            "rounds": args.rounds,
            "processor_seconds": [round(s, 3) for s in (min(mine), statistics.median(mine), max(mine))],
            "speed_of_loadtxt": round(statistics.median(f / m for f, m in zip(floor, mine, strict=True)), 2),
        }
        for name, mine in ((name, of[1:]) for name, of in times.items())
    ]
    print(json.dumps(rows, indent=None if args.json else 1))


if __name__ == "__main__":
    main()
