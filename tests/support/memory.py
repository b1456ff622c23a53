"""How much memory a process of the tests has, and in which file it passed the limit."""

from __future__ import annotations

import contextlib
from pathlib import Path

LIMIT_MB = 600


def memory_mb() -> tuple[float, float]:
    """Return the resident memory of this process in MB, now and the most so far; 0 where the system does not say it."""
    with contextlib.suppress(OSError, IndexError):
        text = Path("/proc/self/status").read_text()
        now, most = (int(text.split(name)[1].split()[0]) / 1000 for name in ("VmRSS:", "VmHWM:"))
        return now, most
    return 0.0, 0.0
