"""A person who has the export's folder alone and another sensor: the toy names what the computer names."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.deploy.golden import TRACKING, answers_of, column
from plushsense.deploy.package import ExportResult
from plushsense.deploy.quantize import integer_model
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import IntegerModel
from plushsense.workflow.export import export
from support.trainings import train_apart
from support.virtual_boards import WARNINGS, run

WIRED_C = Path(__file__).with_name("wired.c")
GESTURES = {"Rest": 0.0, "Stroke": 0.2, "Shake": 0.6}
RECORDED, ZERO = 8000, (40, -60, 30)
"""Counts a g, and zero, of the sensor of the recordings."""
WIRED, RATE_HZ, BURST = 16393, 104.0, 8


def acceleration(t: np.ndarray, size: np.ndarray | float, up: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Waves of ``size`` g at 2 Hz and some noise, in g, of a toy held with ``up`` upwards."""
    wave = size * np.sin(4 * np.pi * t)
    return up + np.stack([wave, 0.5 * wave, 0 * wave], axis=1) + rng.normal(0, 0.01, (len(t), 3))


def recorded(values: np.ndarray) -> np.ndarray:
    return np.rint(values * RECORDED + ZERO).astype(np.int64)


def record(folder: Path) -> Path:
    """Three people whose gestures differ in nothing but their size."""
    rng = np.random.default_rng(1)
    for person in range(3):
        (folder / f"P{person}").mkdir(parents=True)
        for n, (label, size) in enumerate(6 * list(GESTURES.items())):
            up = rng.normal(size=3)
            t = np.arange(320) / 100 + rng.uniform()
            values = recorded(acceleration(t, size * rng.uniform(0.9, 1.1), up / np.linalg.norm(up), rng))
            clock = np.arange(len(t), dtype=np.int64) * 10
            frames = Frames(values, clock, clock + 1_700_000_000_000)
            name = f"{label}_{1_700_000_000_000 + n}_{len(t)}.csv"
            write_recording(folder / f"P{person}" / name, frames, load_layout("accel-3"))
    return folder


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> ExportResult:
    made = tmp_path_factory.mktemp("wired")
    import_recordings(record(made / "recordings"), made / "DS", layout="accel-3")
    (made / "s.toml").write_text("[training]\nepochs = 30\npatience = 30\n")
    train_apart(made / "DS", made / "model.plush", "--config", str(made / "s.toml"), "--filters", "4,4,4")
    return export(made / "model.plush", made / "out")


def named(model: IntegerModel, frames: np.ndarray) -> list[str]:
    """The computer's answers, as the program of ``wired.c`` prints them."""
    answers = answers_of(model, frames)
    state, ms, gesture = (column(answers, name).tolist() for name in ("state", "ms", "gesture"))
    labels = model.gestures.labels
    return [f"{at} {labels[g]}" for s, at, g in zip(state, ms, gesture, strict=True) if s == TRACKING]


def test_a_sensor_of_another_scale_and_rate_gets_the_names_of_the_computer(
    exported: ExportResult, tmp_path: Path, c_compiler: str
) -> None:
    out, model = exported.folder, integer_model(Bundle.load(exported.folder / "model.plush"))
    (known,) = exported.facts.rest
    assert known.steps == pytest.approx(RECORDED, rel=0.01) and not known.is_estimated
    rng = np.random.default_rng(4)

    def moved(t: np.ndarray) -> np.ndarray:
        sizes = np.array([*GESTURES.values()])[(t / 6 % 3).astype(int)]
        return acceleration(t, sizes, np.array([0.6, 0.0, 0.8]), rng)

    t = np.arange(int(36 * RATE_HZ) // BURST * BURST) / RATE_HZ
    counts = np.rint(moved(t) * WIRED).astype("<i2")
    # An interrupt comes with the last reading of a burst.
    stamps = np.floor(t[BURST - 1 :: BURST] * 1000).astype(np.int64)
    pieces = zip(stamps.tolist(), counts.reshape(-1, BURST, 3), strict=True)
    fifo = b"".join(np.array([ms, BURST], dtype="<u4").tobytes() + burst.tobytes() for ms, burst in pieces)
    program = tmp_path / "wired"
    sources = [WIRED_C, out / "plushsense.c", out / "plush_model.c"]
    run(c_compiler, "-std=c99", *WARNINGS, f"-I{out}", *sources, "-o", program)
    done = subprocess.run([program], input=fifo, capture_output=True, check=True)

    ms = (stamps[:, None] - np.arange(BURST)[::-1] * 9_615_385 // 1_000_000).ravel()
    read = np.trunc(counts.astype(np.int64) * known.steps / WIRED).astype(np.int64) + known.zero
    expected = named(model, np.column_stack([ms, read]))
    assert done.stdout.decode().splitlines() == expected
    assert {line.split()[1] for line in expected} == set(GESTURES)
    even = np.arange(0, t[-1], 0.01)
    as_recorded = named(model, np.column_stack([np.arange(len(even)) * 10, recorded(moved(even))]))
    unscaled = named(model, np.column_stack([ms, counts.astype(np.int64)]))
    same, other = (np.mean([a == b for a, b in zip(expected, lines, strict=True)]) for lines in (as_recorded, unscaled))
    assert same > 0.97 and other < 0.8, "the same names as at the recordings' own scale and rate, but not unscaled"
