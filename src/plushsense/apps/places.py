"""Where results go, and where they were made: asked before hours of training, not after."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from plushsense.core.errors import ConfigError


def check_folder(out: Path, what: str) -> None:
    """Whether ``out`` is a folder that may be written in, or can become one; ``what`` as in "A sweep".

    Raises:
        ConfigError: where it cannot.
    """
    there = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    if not there.is_dir():
        raise ConfigError(f"{what} cannot be written to '{out}': '{there}' is a file; give a folder.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{what} cannot be written to '{out}': you may not write in '{there}'.")


def machine(*more: str) -> str:
    """The processor, ``more`` and the system in plain words, without the host's name."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return ", ".join((processor, *more, platform.system()))
