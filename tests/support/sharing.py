"""Folders that all workers of a test run share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from support.apart import SHARED


def built_once(tmp_path_factory: pytest.TempPathFactory, name: str, build: Callable[[Path], None]) -> Path:
    """Return a folder that the first worker of this run fills with ``build``; read only."""
    base = tmp_path_factory.getbasetemp()
    if SHARED in os.environ:
        base = Path(os.environ[SHARED])
    elif "PYTEST_XDIST_WORKER" in os.environ:
        # The folder of a worker lies in that of the run.
        base = base.parent
    folder = base / f"shared-{name}"
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            draft = folder.with_name(f"draft-{name}")
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir()
            build(draft)
            draft.rename(folder)
    return folder
