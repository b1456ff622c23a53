"""Do to folders of recordings what the published scripts of the paper do: record, move, truncate, save.

The scripts are ``PlushSamples.pde``, ``a_move_labelled_data.m``, ``c_training_data_truncation.m`` and
``d_data_preparation.m``; each function here names the one whose files it writes. People are virtual.
"""

from __future__ import annotations

import csv
import random
import re
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recorder_csv import SIMULATION_MARK, STREAM_NAME
from plushsense.recording.simulate import SimulationSpec, simulate
from support.matlab_files import write_mat

SESSIONS, LABELLED, CHOICES = "Training Data", "Training Data - labelled", "truncate_choices.csv"
BACKUP = "Training Data - backup 2025-05-06_101112"
GESTURES = ("Back stroke 1", "Tail pull", "Tail tap 2")
_NAME = re.compile(r"^(?P<label>[^_]+)_(?P<number>\d+)_(?P<rows>\d+)\.csv$")


def record(
    root: Path,
    *,
    people: int = 3,
    repetitions: int = 2,
    at_rest: int = 0,
    integers: int = 15,
    seed: int = 3,
) -> Path:
    """Write a folder for each person, as ``PlushSamples.pde``; with 14 ``integers`` the last column is the delay."""
    sessions = root / SESSIONS
    simulate(
        sessions,
        SimulationSpec(
            people=people,
            repetitions=repetitions,
            at_rest=at_rest,
            seed=seed,
            gestures=GESTURES,
            layout=f"plush-{integers}",
        ),
    )
    for path in sessions.rglob("*.csv"):
        lines = path.read_text().splitlines()
        head = [] if path.name == STREAM_NAME else lines[:1]
        rows = [[_without_garbage(cell) for cell in line.split("; ")] for line in lines[len(head) :]]
        path.write_text("\n".join([*head, *("; ".join(row) for row in rows)]) + "\n")
    shutil.move(sessions / SIMULATION_MARK, root / SIMULATION_MARK)
    return sessions


def _without_garbage(cell: str) -> str:
    """Replace a value under -2000 by 0, in whichever column it is: ``if(data[i] < -2000) data[i] = 0``."""
    return "0" if int(cell) < -2000 else cell


def move_by_label(root: Path, *, seed: int = 3, rename: bool = True) -> Path:
    """Move the recordings into a folder for each label and ``rename`` them, as ``a_move_labelled_data.m`` does.

    A name that exists gets " (1)" and so on; such a name is not renamed, as the script's pattern does not match it.
    The script leaves "At rest" and the streams where they are; recordings at rest are moved here as by hand.
    """
    labelled = root / LABELLED
    labelled.mkdir(exist_ok=True)
    for path in sorted((root / SESSIONS).rglob("*.csv")):
        match = _NAME.match(path.name)
        if match is None:
            continue
        folder = labelled / match["label"]
        folder.mkdir(exist_ok=True)
        target, n = folder / path.name, 0
        while target.exists():
            n += 1
            target = folder / f"{path.stem} ({n}){path.suffix}"
        path.rename(target)
    drawn = random.Random(seed)
    for path in sorted(labelled.rglob("*.csv")) if rename else ():
        match = _NAME.match(path.name)
        if match is not None:
            path.rename(path.with_name(f"{match['label']}_{drawn.randint(10**6, 10**7 - 1)}_{match['rows']}.csv"))
    return labelled


def choose(root: Path, *, cut: int = 40, every: int = 2) -> dict[str, tuple[int, int]]:
    r"""Write ``truncate_choices.csv`` as the first half of ``c_training_data_truncation.m`` does; return rows and cut.

    Every second recording gets ``cut`` rows, the others 0; the last one was not reached (NaN). Paths are of Windows.
    """
    chosen: dict[str, tuple[int, int]] = {}
    lines: list[list[object]] = [["FileName", "FullPath", "Length", "TruncateN"]]
    files = sorted((root / LABELLED).rglob("*.csv"))
    for at, path in enumerate(files):
        full = "C:\\study\\" + str(path.relative_to(root)).replace("/", "\\")
        rows = len(_rows(path))
        if path == files[-1]:
            lines.append([path.name, full, "NaN", "NaN"])
            continue
        chosen[path.name] = (rows, cut if at % every == 0 else 0)
        lines.append([path.name, full, *chosen[path.name]])
    with (root / CHOICES).open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    return chosen


def truncate(root: Path, chosen: dict[str, tuple[int, int]], *, backup: str = BACKUP) -> Path:
    """Copy every chosen file into the backup folder and overwrite it, as the second half of the script does.

    All files lose their header, also those of which nothing is cut, and get the separator ``;``.
    """
    for path in sorted((root / LABELLED).rglob("*.csv")):
        cut = chosen.get(path.name, (0, 0))[1]
        kept = root / backup / path.relative_to(root / LABELLED)
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, kept)
        path.write_text("".join(";".join(row) + "\n" for row in _rows(path)[cut:]))
    return root / backup


def _rows(path: Path) -> list[list[str]]:
    """Return the rows that ``readmatrix`` reads: without the header, split at the separator."""
    lines = path.read_text().splitlines()
    cells = [[cell.strip() for cell in line.split(";")] for line in lines]
    return cells[1:] if any(not cell.lstrip("-").isdigit() for cell in cells[0]) else cells


def cut_windows(root: Path, *, length: int = 250, hop: int = 50) -> tuple[list[NDArray[np.float64]], list[str]]:
    """Return windows (T, 11) of the labelled recordings and their labels, as ``d_data_preparation.m`` cuts them."""
    windows, labels = [], []
    for path in sorted((root / LABELLED).rglob("*.csv")):
        table = np.array([[float(cell) for cell in row[:13]] for row in _rows(path)])
        signal = np.column_stack([table[:, :10], np.sqrt(np.square(table[:, 10:]).sum(axis=1))])
        if len(signal) < length:
            signal = np.tile(signal, (-(-length // len(signal)), 1))[:length]
        found = [signal[at : at + length] for at in range(0, len(signal) - length + 1, hop)]
        windows += found
        labels += [path.parent.name] * len(found)
    return windows, labels


def save_windows(root: Path, *, categorical: bool = True) -> tuple[Path, int]:
    """Write ``plush_train_data_<n>.mat`` as the authors save it for their experiment; return it and the windows.

    ``splitlabels`` without "randomized" takes the first 70 % of each label for training, then 15 % for validation.
    """
    windows, labels = cut_windows(root)
    sets: dict[str, list[int]] = {"train": [], "val": [], "test": []}
    for label in sorted(set(labels)):
        mine = [i for i, text in enumerate(labels) if text == label]
        first, second = round(0.7 * len(mine)), round(0.85 * len(mine))
        for name, part in zip(sets, (mine[:first], mine[first:second], mine[second:]), strict=True):
            sets[name] += part
    path = root / f"plush_train_data_{len(windows)}.mat"
    write_mat(
        path,
        {f"{name}data": [windows[i] for i in mine] for name, mine in sets.items()},
        {f"{name}labels": [labels[i] for i in mine] for name, mine in sets.items()},
        sorted(set(labels)),
        categorical=categorical,
    )
    return path, len(windows)
