"""A small data set to review: waves that begin where it is known, rests, and two that stand out."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset

ACCEL = load_layout("accel-3")
ROW_S = 0.01


def recording(seed: int, size: float, begin_s: float = 0.5, rows: int = 250) -> Frames:
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 100
    moving = np.where((t >= begin_s) & (t < t[-1] - 0.4), size * np.sin(6 * np.pi * (t - begin_s)), 0.0)
    values = moving[:, None] * [1.0, 0.5, -0.5] + 5000 + rng.normal(0, 50, (rows, 3))
    clock = np.arange(rows, dtype=np.int64) * 10 + 100_000 * (seed + 1)
    return Frames(np.rint(values).astype(np.int64), clock, clock + 1_700_000_000_000)


def made(place: Path, people: int = 3, waves: int = 7) -> Dataset:
    """``people`` with so many waves and a rest each; the last wave of the last one lasts three times as long."""
    raw = place.parent / f"{place.name}-raw"
    for person in range(1, people + 1):
        folder = raw / f"P{person}"
        folder.mkdir(parents=True)
        for number in range(waves + 1):
            long = person == people and number == waves - 1
            rest = number == waves
            frames = recording(
                100 * person + number, 0 if rest else 6000, 0.3 + 0.07 * number, rows=750 if long else 250
            )
            assert frames.host_ms is not None
            name = recording_filename("Rest" if rest else "Wave", int(frames.host_ms[-1]), len(frames))
            write_recording(folder / name, frames, ACCEL)
    place.parent.mkdir(parents=True, exist_ok=True)
    made = import_recordings(raw, place, layout="accel-3").dataset
    shutil.rmtree(raw)
    return made


def streamed(place: Path) -> Path:
    """Two people with a stream of 20 s, in which a wave was recorded from 5 to 7.5 s."""
    raw = place.parent / f"{place.name}-raw"
    for person in (1, 2):
        folder = raw / f"P{person}"
        folder.mkdir(parents=True)
        frames = recording(person, 6000, 5.5, rows=2000)
        (folder / "fulldatastream.csv").write_text(format_rows(frames, ACCEL))
        part = frames.slice(500, 750)
        assert part.host_ms is not None
        write_recording(folder / recording_filename("Wave", int(part.host_ms[-1]), 250), part, ACCEL)
    place.parent.mkdir(parents=True, exist_ok=True)
    import_recordings(raw, place, layout="accel-3")
    shutil.rmtree(raw)
    return place


def marks(place: Path) -> list[dict[str, Any]]:
    """The lines of the marks file as they are."""
    path = place / "marks.jsonl"
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def raw_hash(place: Path) -> str:
    """Over every raw file, its name and its bytes."""
    digest = hashlib.sha256()
    for folder in ("recordings", "streams"):
        for path in sorted((place / folder).rglob("*")):
            if path.is_file():
                digest.update(path.relative_to(place).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
