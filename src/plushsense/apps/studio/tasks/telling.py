"""How far work is and how long it still takes, from the share that is done."""

from __future__ import annotations

import time
from typing import Any


class Clock:
    """Told the share of the work that is done, says ``share`` and ``left_s`` (None while there is nothing to go by).

    What was done before, by an earlier run, comes at once and is no measure: time counts from the first share that took
    any.
    """

    def __init__(self, instant_s: float = 0.02) -> None:
        self._instant_s = instant_s
        self._last_s = self._began_s = time.monotonic()
        self._from = 0.0

    def at(self, share: float) -> dict[str, Any]:
        """Where the work stands now."""
        now = time.monotonic()
        if self._from == 0.0 or (now - self._last_s < self._instant_s and now - self._began_s < 1.0):
            self._from, self._began_s = share, now
        self._last_s = now
        gone = share - self._from
        left = (now - self._began_s) / gone * (1.0 - share) if gone > 0 else None
        return {"share": round(share, 4), "left_s": None if left is None else round(left, 1)}
