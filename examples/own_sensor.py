"""Write a folder of CSV files as a sensor of your own might leave them, for docs/own-sensor.md.

Six made-up people each touch a cushion with two force sensors and an accelerometer, 50 times a second. Each file is a
session, with an empty label between the gestures; in one gesture of the third person rows are missing. The readings are
computed: scores on them say nothing about people, and the file SIMULATION.txt lets every page say so.
"""

import sys
from pathlib import Path

import numpy as np

RATE_HZ = 50
GESTURES = ("squeeze", "pat", "shake")


def touch(gesture: str, strength: float, tempo: float, draw: np.random.Generator) -> np.ndarray:
    """Return force left and right in N and acceleration x, y, z in g of one gesture, (T, 5)."""
    t = np.arange(int(draw.uniform(1.5, 3.0) * RATE_HZ)) / RATE_HZ
    out = np.zeros((len(t), 5))
    fade = np.minimum(1, 5 * np.minimum(t, t[-1] - t))
    if gesture == "squeeze":
        out[:, :2] = 8 * strength * (fade * (1 + 0.2 * np.sin(2 * np.pi * tempo * t)))[:, None]
    elif gesture == "pat":
        blow = np.maximum(0, np.sin(2 * np.pi * 2 * tempo * t)) ** 6
        side = int(draw.integers(2))
        out[:, side] = 5 * strength * blow
        out[:, 4] = 0.4 * strength * blow
    else:
        swing = fade * np.sin(2 * np.pi * 3 * tempo * t)
        out[:, :2] = 2 * strength
        out[:, 2], out[:, 3] = 1.2 * strength * swing, 0.5 * strength * swing
    return out


def session(person: int, takes: int) -> list[str]:
    """Return the lines of a session's file."""
    draw = np.random.default_rng(person)
    strength, tempo, tilt = draw.uniform(0.7, 1.4), draw.uniform(0.8, 1.3), draw.uniform(-0.3, 0.3)
    parts, labels = [], []
    for gesture in GESTURES * takes:
        pause = np.zeros((int(draw.uniform(1.0, 2.0) * RATE_HZ), 5))
        moves = touch(gesture, strength * draw.uniform(0.8, 1.2), tempo * draw.uniform(0.9, 1.1), draw)
        parts += [pause, moves]
        labels += [""] * len(pause) + [gesture] * len(moves)
    values = np.concatenate(parts)
    values[:, 2:] += (np.sin(tilt), 0.0, np.cos(tilt))
    values += draw.normal(0, (0.05, 0.05, 0.01, 0.01, 0.01), values.shape)
    rows = enumerate(zip(values, labels, strict=True))
    lines = [f"{n * 1000 // RATE_HZ};{';'.join(f'{v:.2f}' for v in row)};{label}" for n, (row, label) in rows]
    if person == 3:
        first = next(n for n, label in enumerate(labels) if label)
        del lines[first + 20 : first + 50]
    return ["time_ms;left;right;acc_x;acc_y;acc_z;gesture", *lines]


def main(words: list[str] | None = None, people: int = 6, takes: int = 6) -> int:
    out = Path((sys.argv[1:] if words is None else words)[0])
    for person in range(1, people + 1):
        folder = out / f"P{person:02}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "session1.csv").write_text("\n".join(session(person, takes)) + "\n", encoding="utf-8")
    (out / "SIMULATION.txt").write_text("made up by examples/own_sensor.py\n", encoding="utf-8")
    print(f"wrote {people} made-up sessions to {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
