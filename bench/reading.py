"""Measure the time of reading recordings, against `np.loadtxt` alone and within the whole import.

1326 recordings of 700 rows × 15 columns, as many as in the paper, are written once. In every round each method reads
all of them in turn. Ratios are of processor time and taken within a round, so that other programs and slow changes of
the machine's speed have little effect. The import (copying, checksums, checks, index) is timed in the same rounds.

    python bench/reading.py [--rounds 7] [--files 1326] [--folder RECORDINGS --layout NAME] [--json]

With ``--folder`` a folder of your own is read instead of the generated files.
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

ROWS = 700
PEOPLE = 26


def write(folder: Path, files: int, layout: Layout) -> None:
    """Write recordings with the noise of a toy at rest, because the time to parse a number depends on its digits."""
    rng = np.random.default_rng(0)
    for number in range(files):
        person = folder / f"P{number % PEOPLE:02d}"
        person.mkdir(exist_ok=True)
        clock = np.cumsum(rng.integers(9, 12, ROWS)) + number * 20_000
        values = rng.integers(-900, 4000, (ROWS, layout.n_channels))
        name = recording_filename(layout_gesture(number), 1_760_000_000_000 + number * 60_000, ROWS)
        write_recording(person / name, Frames(values, clock, clock + 1_760_000_000_000), layout)


def layout_gesture(number: int) -> str:
    """Return the gestures of plush-18 in turn."""
    return ("Tail pull", "Hold strong", "Back stroke 1", "Ear scratch 2")[number % 4]


def loadtxt_all(files: list[Path]) -> None:
    """Read with NumPy alone, with header and delimiter given, as a lower bound."""
    for path in files:
        with path.open() as file:
            separator = ";" if ";" in file.readline() else ","
        np.loadtxt(path, delimiter=separator, skiprows=1)


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Return seconds on the wall clock, and of the processor."""
    began, used = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - began, time.process_time() - used


def spread(seconds: list[float]) -> list[float]:
    """Return minimum, median and maximum."""
    return [round(s, 3) for s in (min(seconds), statistics.median(seconds), max(seconds))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--files", type=int, default=1326)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--layout", default="plush-15")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    layout = load_layout(args.layout)
    scratch = Path(tempfile.mkdtemp(prefix="reading-"))
    try:
        source = args.folder
        if source is None:
            source = scratch / "recordings"
            source.mkdir()
            write(source, args.files, layout)
        files = sorted(p for p in source.rglob("*.csv") if parse_name(p.name) is not None)

        def whole_import() -> None:
            import_recordings(source, scratch / "DS", layout=layout)
            shutil.rmtree(scratch / "DS")

        ways: dict[str, Callable[[], object]] = {
            "np.loadtxt alone": lambda: loadtxt_all(files),
            "read_recording": lambda: [read_recording(path, layout) for path in files],
            "whole import": whole_import,
        }
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
        for _ in range(args.rounds + 1):
            for name, work in ways.items():
                times[name].append(timed(work))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    # The first round fills the disk cache.
    floor = times["np.loadtxt alone"][1:]
    rows = [
        {
            "way": name,
            "files": len(files),
            "rounds": args.rounds,
            "seconds": spread([wall for wall, _ in mine[1:]]),
            "processor_seconds": spread([used for _, used in mine[1:]]),
            "speed_of_loadtxt": round(
                statistics.median(f / m for (_, f), (_, m) in zip(floor, mine[1:], strict=True)), 2
            ),
        }
        for name, mine in times.items()
    ]
    if args.json:
        print(json.dumps(rows))
        return
    print(
        f"{len(files)} files, {args.rounds} rounds; seconds on the wall clock, and of the processor (minimum / median /"
    )
    print("maximum); speed against np.loadtxt")
    for row in rows:
        numbers = [*row["seconds"], *row["processor_seconds"]]  # type: ignore[misc]
        print(f"{row['way']:<18} {' '.join(f'{s:7.3f}' for s in numbers)}   {row['speed_of_loadtxt']}")


if __name__ == "__main__":
    main()
