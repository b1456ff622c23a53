"""Recordings of virtual people in the form of the paper's published archive, as the authors' scripts leave it."""

from __future__ import annotations

import csv
import random
from pathlib import Path

from plushsense.core.recorder_csv import SIMULATION_MARK, parse_name
from plushsense.recording.simulate import SimulationSpec, simulate

DELAYS = "Tail pull"


def make_archive(
    folder: Path,
    *,
    people: int = 3,
    gestures: tuple[str, ...] = ("Back stroke 1", "Tail pull", "Tail tap 2"),
    repetitions: int = 2,
    top: str = "",
    underscores: bool = False,
    seed: int = 3,
) -> Path:
    """Write ``folder/archive`` and ``folder/map.csv`` (file,subject; nobody's are not in it); returns the archive.

    As `a_move_labelled_data` and `c_training_data_truncation` do: a folder a label, the time in the name replaced by a
    random number of 7 digits, `;` and no header, the beginning cut off some files. A third of the files ends its lines
    with CRLF, and those of `DELAYS` hold the delay in the last column, as older firmware sent it.
    """
    drawn = random.Random(seed)
    simulate(folder / "sessions", SimulationSpec(people=people, repetitions=repetitions, seed=seed, gestures=gestures))
    found = [(p.parent.name, p) for p in (folder / "sessions").rglob("*.csv") if parse_name(p.name) is not None]
    drawn.shuffle(found)
    archive = folder / "archive"
    numbers = drawn.sample(range(1_000_000, 10_000_000), len(found))
    mapping = []
    for at, ((person, path), number) in enumerate(zip(found, numbers, strict=True)):
        name = parse_name(path.name)
        assert name is not None
        rows = [line.split("; ") for line in path.read_text().splitlines()[1:]]
        if name.label == DELAYS:
            clock = [int(row[-1]) for row in rows]
            for row, before, now in zip(rows, [clock[0] - 10, *clock], clock, strict=False):
                row[-1] = str(now - before)
        if at % 4 == 0:
            rows = rows[min(40, len(rows) // 3) :]
        label = name.label.replace(" ", "_") if underscores else name.label
        place = archive / top / label
        place.mkdir(parents=True, exist_ok=True)
        end = "\r\n" if at % 3 == 0 else "\n"
        target = place / f"{label}_{number}_{len(rows)}.csv"
        target.write_bytes("".join(";".join(row) + end for row in rows).encode())
        if person != "none":
            mapping.append((target.name, person))
    (archive / SIMULATION_MARK).write_text("Virtual people; nobody touched anything.\n")
    with (folder / "map.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("file", "subject"), *mapping])
    return archive
