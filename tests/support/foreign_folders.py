"""Folders in the forms that data sets of other projects have; the readings are made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

PATTERNS = Path(__file__).parents[2] / "examples" / "import"


def _wave(rows: int, seed: int, low: float, high: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    touch = np.sin(np.linspace(0, (3 + seed % 3) * np.pi, rows)) ** 2
    return np.asarray(low + (high - low) * 0.8 * touch + (high - low) * 0.1 * rng.random(rows))


def touch_cells(src: Path) -> None:
    """Digits of eight touch cells, one file a touch, without header and clock."""
    for person, label, take in [(p, label, t) for p in ("S01", "S02") for label in ("pat", "long_hug") for t in (1, 2)]:
        folder = src / person
        folder.mkdir(parents=True, exist_ok=True)
        seed = len(label) + 10 * take + 100 * int(person[1:])
        cells = np.random.default_rng(seed).random((60, 8)) < 0.3
        cells[:, :6] &= (np.arange(60)[:, None] > 20) & (np.arange(60)[:, None] < 45)
        # The nose and the belly are seldom touched.
        cells[:, 6:] &= take == 2
        text = "".join(" ".join(map(str, row)) + "\n" for row in cells.astype(int))
        (folder / f"{label}_{take}.txt").write_text(text)
    (src / "S01" / "readme.txt").write_text("eight cells\n")


def multimeter(src: Path) -> None:
    """Byte order mark, names and units, decimal commas, OL, and cut rows; a row between two gestures has no label."""
    src.mkdir(parents=True)
    for seed, (person, session) in enumerate((("ana", 1), ("ana", 2), ("ben", 1))):
        a, b = _wave(240, seed, 20, 150), _wave(240, seed + 9, 20, 150)
        lines = ["Time;Sensor A;Sensor B;Event", "s;kOhm;kOhm;"]
        for k in range(240):
            label = "squeeze" if 20 <= k < 120 else "pull" if 130 <= k < 220 else ""
            cells = [f"{0.02 * k:.2f}", f"{a[k]:.1f}", "OL" if 60 <= k < 64 else f"{b[k]:.1f}", label]
            lines.append(";".join(cells).replace(".", ","))
        lines[50] = lines[50][:7]
        lines[-1] = lines[-1][:4]
        (src / f"{person}_{session}.csv").write_text("\n".join(lines), encoding="utf-8-sig")


def taps(src: Path) -> None:
    """One JSON object a tap, with lists of times and of pairs; one line is damaged."""
    src.mkdir(parents=True)
    lines = []
    for k in range(8):
        left, right = _wave(50 + k, k, 0, 900), _wave(50 + k, k + 20, 0, 900)
        tap = {
            "user": {"id": f"u{k % 2 + 1}", "age": 30 + k % 2},
            "kind": ("tap", "double tap")[k // 2 % 2],
            "t": [round(100 * k + 0.01 * i, 3) for i in range(len(left))],
            "pads": [[int(x), int(y)] for x, y in zip(left, right, strict=True)],
        }
        lines.append(json.dumps(tap))
    lines.insert(3, lines[3][:200])
    (src / "taps.jsonl").write_text("\n".join(lines) + "\n")


def strokes(src: Path) -> None:
    """The label as a folder in two spellings; in one file two rows came late."""
    spellings = {"subj03": ("StrokeSlow", "StrokeFast"), "subj04": ("stroke-slow", "stroke-fast")}
    for seed, (person, label, take) in enumerate(
        (p, s, t) for p, both in spellings.items() for s in both for t in (1, 2)
    ):
        folder = src / person / label
        folder.mkdir(parents=True, exist_ok=True)
        force = _wave(120, seed, 0, 20)
        rows = [f"{10 * k},{force[k]:.2f},{int(force[k] // 4)}" for k in range(120)]
        if seed == 0:
            rows[70], rows[71] = rows[71], rows[70]
        (folder / f"take {take}.csv").write_text("\n".join(["t_ms,force,count", *rows]) + "\n")


def phone_watch(src: Path) -> None:
    """Two devices in one row under the same names, nanoseconds since 1970, and a file of another sensor."""
    begin = 1_700_000_000_000_000_000
    for seed, person in enumerate(("P1", "P2")):
        folder = src / person
        folder.mkdir(parents=True)
        axes = [_wave(300, 6 * seed + k, -9, 9) for k in range(6)]
        lines = ["timestamp,x,y,z,x,y,z,activity"]
        for k in range(300):
            label = ("", "wave", "", "knock")[k // 75]
            lines.append(",".join([str(begin + 20_000_000 * k), *(f"{axis[k]:.3f}" for axis in axes), label]))
        (folder / "session 1.csv").write_text("\n".join(lines) + "\n")
        (folder / "gps.csv").write_text("timestamp,lat,lon\n")


FOLDERS: dict[str, Callable[[Path], None]] = {
    "touch-cells": touch_cells,
    "multimeter": multimeter,
    "taps": taps,
    "strokes": strokes,
    "phone-watch": phone_watch,
}


def glove(src: Path, people: tuple[str, ...] = ("S01", "S02", "S03")) -> Path:
    """Three people, four gestures, five takes, each a file; names of columns of its own, ``;`` and decimal commas."""
    for p, person in enumerate(people):
        (src / person).mkdir(parents=True)
        for g, gesture in enumerate(("hug", "poke", "stroke", "shake")):
            for take in range(1, 6):
                left, right = _wave(60, 100 * p + 10 * g + take, 0, 900), _wave(60, 7 * g + take, 100 * g, 100 * g + 90)
                rows = [f"{0.02 * k:.2f};{left[k]:.1f};{right[k]:.1f}".replace(".", ",") for k in range(60)]
                text = "\n".join(["Zeit;Druck links;Druck rechts", *rows]) + "\n"
                (src / person / f"{gesture}-take{take}.csv").write_text(text)
    return src


def diary(src: Path) -> Path:
    """One file a person, with the label in a column, and rest between the gestures."""
    src.mkdir(parents=True)
    for p, person in enumerate(("nora", "otto")):
        labels = [label for _ in range(3) for word in ("hug", "poke") for label in ["ruhe"] * 30 + [word] * 40]
        a, b = _wave(len(labels), p, 0, 900), _wave(len(labels), p + 5, 0, 90)
        rows = [f"{20 * k};{a[k]:.1f};{b[k]:.1f};{label}".replace(".", ",") for k, label in enumerate(labels)]
        (src / f"{person}.txt").write_text("\n".join(["zeitpunkt;S1;S2;aktion", *rows]) + "\n")
    return src
