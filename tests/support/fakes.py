"""Windows whose content says who they are, and trainers that remember what they saw; importable by fresh processes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import TrainingError
from plushsense.evaluation.crossval import FoldOutput
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import InputUnits

LABELS = ("At rest", "Back stroke", "Tail hit")
AFFECTS = ("neutral", "positive", "negative")
ROWS = 100


def plain_units(inputs: int) -> InputUnits:
    """Units of inputs whose values are integers."""
    return InputUnits(np.ones(inputs), np.zeros(inputs), ("count",) * inputs)


def study(
    people: int = 6, repetitions: int = 2, windows: int = 2, nobody: int = 6, context: str = "stream"
) -> WindowSet:
    """Recordings one after the other in a stream a person, ``windows`` each; a window reaches into the one before.

    ``x[:, 0]`` holds the class, ``x[:, 1]`` the number of the recording.
    """
    made = [
        (f"P{p:02d}", 1 + g, p, (p * 2 * repetitions + g * repetitions + n))
        for p in range(people)
        for g in range(2)
        for n in range(repetitions)
    ]
    made += [("none", 0, people, people * 2 * repetitions + n) for n in range(nobody)]
    ids = tuple(f"{who}/{number:03d}" for who, _, _, number in made)
    order = np.argsort(ids)
    place = np.empty(len(ids), dtype=np.int64)
    place[order] = np.arange(len(ids))
    rows = []
    for (who, label, _, number), at in zip(made, place, strict=True):
        for w in range(windows):
            first = number * ROWS
            real = context == "stream"
            rows.append(
                (
                    int(at), label, who, number, "stream" if real else "loop", f"s-{who}" if real else "",
                    (first - 20 + 40 * w, first + 60 + 40 * w) if real else (-1, -1),
                    (first, first + ROWS) if real else (-1, -1),
                )
            )  # fmt: skip
    rows.sort(key=lambda row: row[0])
    y = np.array([row[1] for row in rows], dtype=np.int64)
    x = np.zeros((len(rows), 2, 4), dtype=np.int32)
    x[:, 0, :] = y[:, None]
    x[:, 1, :] = np.array([row[3] for row in rows])[:, None]
    return WindowSet(
        integers=x,
        units=plain_units(2),
        y=y,
        labels=LABELS,
        affects=AFFECTS,
        families=LABELS,
        recording=np.array([row[0] for row in rows], dtype=np.int64),
        recording_ids=tuple(sorted(ids)),
        subject=np.array([row[2] for row in rows]),
        context=np.array([row[4] for row in rows]),
        stream=np.array([row[5] for row in rows]),
        window_rows=np.array([row[6] for row in rows], dtype=np.int64),
        recording_rows=np.array([row[7] for row in rows], dtype=np.int64),
        rate_hz=100.0,
        inputs=("class", "recording"),
    )


@dataclass(frozen=True)
class Oracle:
    """Reads the class off the window; people in ``confused`` one class too far. Leaves a mark a training."""

    folder: str
    confused: tuple[str, ...] = ()
    epochs: int = 3
    pause: float = 0.0

    def __call__(self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: Any, /) -> FoldOutput:
        people = "+".join(sorted(set(test.subject) - {"none"}))
        with Path(self.folder, f"trained-{people}").open("a") as file:
            file.write("x")
        history = []
        for epoch in range(1, self.epochs + 1):
            time.sleep(self.pause)
            row = {"epoch": epoch, "train_loss": 1.0 / epoch}
            history.append(row)
            progress(epoch, self.epochs, row)
        read = (test.integers[:, 0, 0] + np.isin(test.subject, self.confused)) % len(LABELS)
        probabilities = np.full((len(test), len(LABELS)), 0.1, dtype=np.float32)
        probabilities[np.arange(len(test)), read] = 0.8
        return FoldOutput(probabilities, history, 0.25, self.epochs)


@dataclass(frozen=True)
class Deploying:
    """Reads the class off the window; once deployed, one class too far for the people in ``spoilt``."""

    folder: str
    spoilt: tuple[str, ...] = ()

    def __call__(self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: Any, /) -> FoldOutput:
        before = Oracle(self.folder)(train, validation, test, progress)
        after = Oracle(self.folder, self.spoilt)(train, validation, test, progress)
        return replace(before, deployed=after.probabilities)


@dataclass(frozen=True)
class Memory:
    """Knows a recording only if it was trained on: a leak shows as a high score."""

    def __call__(self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: Any, /) -> FoldOutput:
        seen = np.isin(test.integers[:, 1, 0], np.concatenate([train.integers[:, 1, 0], validation.integers[:, 1, 0]]))
        read = np.where(seen, test.y, (test.y + 1) % len(LABELS))
        return FoldOutput(np.eye(len(LABELS), dtype=np.float32)[read])


def refuses(train: WindowSet, validation: WindowSet, test: WindowSet, progress: Any, /) -> FoldOutput:
    raise TrainingError("The loss is no longer a number.")


def misshapen(train: WindowSet, validation: WindowSet, test: WindowSet, progress: Any, /) -> FoldOutput:
    return FoldOutput(np.zeros((1, 3), dtype=np.float32))


def rhythms(n: int = 60, seed: int = 0, classes: int = 3, samples: int = 50) -> WindowSet:
    """Windows of three rhythms and strengths with noise, on two channels."""
    rng = np.random.default_rng(seed)
    y = np.arange(n) % classes
    time = np.arange(samples) + rng.integers(0, 30, (n, 1))
    wave = (300 + 250 * y[:, None]) * np.sin(2 * np.pi * time / (8 + 12 * y[:, None]))
    x = wave[:, None, :] * np.array([1.0, 0.5])[:, None] + rng.normal(0, 60, (n, 2, samples))
    none = np.full((n, 2), -1, dtype=np.int64)
    labels = tuple(f"gesture {k}" for k in range(classes))
    return WindowSet(
        integers=x.astype(np.int32), units=plain_units(2), y=y.astype(np.int64), labels=labels,
        affects=("none",) * classes, families=labels,
        recording=np.arange(n, dtype=np.int64), recording_ids=tuple(f"P/{i:03d}" for i in range(n)),
        subject=np.array([f"P{i % 5}" for i in range(n)]), context=np.full(n, "inside"), stream=np.full(n, ""),
        window_rows=none, recording_rows=none, rate_hz=100.0, inputs=("a", "b"),
    )  # fmt: skip
