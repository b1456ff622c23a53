"""An evaluation that is killed loses no finished fold."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

from plushsense.dataset.store import Dataset

COMMAND = [sys.executable, "-m", "plushsense.cli.main", "evaluate"]


def test_kill_9_in_the_middle(dataset: Dataset, tmp_path: Path) -> None:
    words = [str(dataset.path), "--filters", "4,4,4", "--epochs", "40", "--workers", "2", "--json"]
    process = subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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
    done = subprocess.run([*COMMAND, *words], capture_output=True, text=True, check=False, timeout=180)
    assert done.returncode == 0, done.stderr
    assert "from before" in done.stderr
    assert all((folds / name).read_bytes() == content for name, content in finished.items()), "not trained again"
    assert len(json.loads(done.stdout)["folds"]) == 5
