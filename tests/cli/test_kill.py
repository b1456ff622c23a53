"""An evaluation that is killed loses no finished fold."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.store import Dataset

COMMAND = [sys.executable, "-m", "plushsense"]


@pytest.mark.exhaustive
def test_kill_9_in_the_middle(dataset: Dataset, cli: Callable[..., Any]) -> None:
    words = ["evaluate", str(dataset.path), "--filters", "4,4,4", "--epochs", "10", "--json", "--workers"]
    process = subprocess.Popen([*COMMAND, *words, "2"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folds = dataset.path / "cache" / "folds"
    deadline = time.monotonic() + 90

    def whole() -> list[Path]:
        # Beside finished folds: one that is being written, and claims on those that are trained.
        return list(folds.glob("[!.]*.npz")) if folds.is_dir() else []

    while not whole() and time.monotonic() < deadline:
        assert process.poll() is None, "it was to be killed in the middle"
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    finished = {p.name: p.read_bytes() for p in whole()}
    assert finished
    done = cli(*words, "1")
    assert done.status == 0, done.err
    assert "from before" in done.err
    assert all((folds / name).read_bytes() == content for name, content in finished.items()), "not trained again"
    assert len(done.json["folds"]) == 5
