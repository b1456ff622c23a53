"""How much memory a process of the tests has, and in which file it passed the limit."""

from __future__ import annotations

import contextlib
from pathlib import Path

LIMIT_MB = 600


def memory_mb() -> tuple[float, float]:
    """Return in MB what this process has allocated now, and its most resident memory so far; 0 where it is not known.

    Resident memory also counts pages of libraries, of which twice as many are resident after a fresh installation.
    """
    with contextlib.suppress(OSError, IndexError):
        text = Path("/proc/self/status").read_text()
        now, most = (int(text.split(name)[1].split()[0]) / 1000 for name in ("RssAnon:", "VmHWM:"))
        return now, most
    return 0.0, 0.0
