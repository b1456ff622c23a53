"""A small data set, a trained bundle, and the command line as a user meets it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.cli.main import main
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from support.sharing import built_once
from support.trainings import train_apart

ACCEL = load_layout("accel-3")
GESTURES = {"Rest": 0.0, "Slow": 1.0, "Fast": 4.0}


@dataclass
class Ran:
    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """Standard output, which must be one JSON object and nothing else."""
        lines = self.out.splitlines()
        assert len(lines) == 1, self.out
        found: dict[str, Any] = json.loads(lines[0])
        return found


Cli = Callable[..., Ran]


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    def run(*words: object) -> Ran:
        status = main([str(w) for w in words])
        captured = capsys.readouterr()
        return Ran(status, captured.out, captured.err)

    return run


def session(folder: Path, seed: int) -> None:
    """One person waving at three speeds, two recordings each, between stretches of rest; with the stream."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    pieces, cuts, at = [], [], 0
    for label, hz in GESTURES.items():
        for _ in range(2):
            for name, speed, rows in (("", 0.0, 300), (label, hz * rng.uniform(0.9, 1.1), int(rng.integers(160, 330)))):
                t = np.arange(rows) / 100
                wave = 3000 * np.sin(2 * np.pi * speed * t + rng.uniform(0, 6)) if speed else np.zeros(rows)
                x = np.stack([wave, 0.5 * wave, 8000 + 0 * wave], axis=1) + rng.normal(0, 80, (rows, 3))
                pieces.append(np.round(x).astype(np.int64))
                if name:
                    cuts.append((name, at, rows))
                at += rows
    clock = np.arange(at, dtype=np.int64) * 10 + 1000
    stream = Frames(np.concatenate(pieces), clock, clock + 1_700_000_000_000)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    for label, first, rows in cuts:
        assert stream.host_ms is not None
        name = f"{label}_{int(stream.host_ms[first + rows - 1])}_{rows}.csv"
        write_recording(folder / name, stream.slice(first, first + rows), ACCEL)


@pytest.fixture(scope="session")
def make_session() -> Callable[[Path, int], None]:
    """``session``, for a test that needs people of its own."""
    return session


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # The data set takes its name from this folder. It must be the one that the shared `bundle` was trained on.
    folder = tmp_path_factory.mktemp("made") / "recordings"
    for person in range(5):
        session(folder / f"P{person + 1}", person)
    return folder


@pytest.fixture(scope="session")
def imported(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set of ``recordings``, to copy."""
    return import_recordings(recordings, tmp_path_factory.mktemp("imported") / "DS", layout="accel-3").dataset.path


@pytest.fixture
def dataset(imported: Path, tmp_path: Path) -> Dataset:
    """A data set of one's own: evaluations keep their folds in it."""
    return open_dataset(shutil.copytree(imported, tmp_path / "DS"))


@pytest.fixture(scope="session")
def bundle(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle trained on ``imported``, by a process of its own and for all workers; never to be changed."""

    def train(draft: Path) -> None:
        made = shutil.copytree(imported, draft / "DS")
        # With a patience there is no second training, on everybody, which takes time.
        # Slow and fast differ only in tempo, which the preset would change at random.
        augment = 'augment = ["random-gain:0.3", "random-tilt:8"]\nbatch = 64\n'
        (draft / "settings.toml").write_text(f"[training]\nepochs = 20\npatience = 20\n{augment}")
        settings = ("--config", str(draft / "settings.toml"), "--filters", "4,4,4", "--force")
        train_apart(made, draft / "model.plush", *settings)

    return built_once(tmp_path_factory, "small-bundle", train) / "model.plush"
