"""Little bundles to export, what lies in an export, and how to break one."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.deploy.quantize import calibrated
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler


def bundle_of(**changes: str) -> Bundle:
    """A little network out of thin air; ``padding="causal"`` cannot be exported."""
    arch = Arch.parse("5d1_4d3", "4,6", channels=3, classes=18, window=48, **changes)
    scaler = Scaler(np.array([0.0, 5.0, 10.0]), np.array([0.01, 0.02, 0.03]))
    bundle = Bundle(arch, random_weights(arch, 1), load_layout("accel-3"), scaler, load_gestures("plush-18"))
    x = np.random.default_rng(1).normal(scale=80, size=(9, 3, 60)).round().astype(np.int64)
    return bundle if changes else calibrated(bundle, x)


def sums(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder."""
    files = (p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def flip(path: Path) -> None:
    """Another number in the middle of the model's data: one byte of the weights."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [n for n, line in enumerate(lines) if line.strip()[:1].isdigit()]
    at = rows[len(rows) // 2]
    first, _, rest = lines[at].strip().partition(",")
    lines[at] = f"    {int(first) ^ 1},{rest}"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
