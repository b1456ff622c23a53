"""Trainings in a process of their own: what they take of memory is gone afterwards."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def train_apart(dataset: Path, out: Path, *options: str) -> None:
    """Run ``plushsense train`` in another process, so that the one of the tests neither loads PyTorch nor grows."""
    _run("train", dataset, out, *options)


def evaluate_apart(dataset: Path, out: Path, *options: str) -> None:
    """Run ``plushsense evaluate`` in another process, with one worker."""
    _run("evaluate", dataset, out, "--workers", "1", *options)


def _run(verb: str, dataset: Path, out: Path, *options: str) -> None:
    words = [sys.executable, "-m", "plushsense", verb, str(dataset), *options, "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
