"""Sensor health, in integers only: suspect frames and sensor faults.

This module defines it; ``deploy/c/plushsense.c`` repeats it. It sees every frame before the clock does.

- A channel is *wrong* in a frame when its value is out of its valid range, or when it repeats exactly a value beyond
  ``low`` to ``high``, the range that touches reached in the recordings: a sensor at its end stop.
- The toy is *still* while every channel repeats the frame before. Real sensors are noisy; one that hangs is not.
- A frame is *suspect* while a channel is wrong, or the toy was still for ``still_ms`` / 2. Nothing begins on it.
- A *fault* begins when in every frame for ``fault_ms`` some channel was wrong (not always the same one), or the toy was
  still for ``still_ms``. Then frames are not read, until for ``recover_ms`` none was suspect; after that everything
  begins again.
- After a gap or a reset of the clock all times are counted anew (`Health.clear`), also within a fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from plushsense.core.errors import BundleError
from plushsense.core.layouts import Layout

MOST_MS = 60_000
_INT32 = -(1 << 31), (1 << 31) - 1


@dataclass(frozen=True)
class HealthSettings:
    """The settings of `Health`; ``low`` and ``high`` (C,) of each measured channel, empty: not known, so that a value
    may stay wherever it is valid. ``fault_ms`` or ``still_ms`` of 0 switches its rule off; with a ``recover_ms`` of 0
    the first good frame ends a fault.

    Raises:
        BundleError: for a value out of its range.
    """

    low: tuple[int, ...] = ()
    high: tuple[int, ...] = ()
    fault_ms: int = 500
    still_ms: int = 0
    recover_ms: int = 300

    def __post_init__(self) -> None:
        for name in ("fault_ms", "still_ms", "recover_ms"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MOST_MS:
                raise BundleError(f"The health setting {name} is {value!r}; accepted are 0 (off) to {MOST_MS} ms.")
        if len(self.low) != len(self.high) or any(
            not _INT32[0] <= a <= b <= _INT32[1] for a, b in zip(self.low, self.high, strict=False)
        ):
            raise BundleError(f"The health limits {self.low} to {self.high} do not fit: train again.")


class Health:
    """Follows one stream of frames."""

    def __init__(self, plan: HealthSettings, layout: Layout) -> None:
        self.plan = plan
        self._valid = [(int(a), int(b)) for a, b in zip(layout.valid_min_int, layout.valid_max_int, strict=True)]
        usual = list(zip(plan.low, plan.high, strict=True)) or self._valid
        if len(usual) != len(self._valid):
            raise BundleError(
                f"The health limits are of {len(usual)} channels, the layout has {len(self._valid)}: train again."
            )
        self._inside = [(max(a, c), min(b, d)) for (a, b), (c, d) in zip(self._valid, usual, strict=True)]
        self.reset()

    def reset(self) -> None:
        """Begin a new stream, with no fault counted."""
        self.faults = 0
        self.fault = False
        self.clear()

    def clear(self) -> None:
        """Forget the past, as after a gap; a fault goes on until it has recovered."""
        self.suspect = False
        self._last: list[int] | None = None
        self._wrong: int | None = None  # since when, in every frame
        self._still: int | None = None
        self._good: int | None = None

    def push(self, ms: int, values: Sequence[int]) -> str:
        """Read one frame at a time ``ms`` that does not run backwards (`clear` first).

        Returns ``"fault"`` when a fault begins with it, ``"recovered"`` when one ends, else ``""``.
        """
        plan, last = self.plan, self._last
        wrong = False
        for i, (value, (low, high)) in enumerate(zip(values, self._inside, strict=True)):
            # Mostly this one comparison is all there is to do.
            if not low <= value <= high and (
                not self._valid[i][0] <= value <= self._valid[i][1] or (last is not None and value == last[i])
            ):
                wrong = True
                break
        if not wrong:
            self._wrong = None
        elif self._wrong is None:
            self._wrong = ms
        broken = self._wrong is not None and plan.fault_ms > 0 and ms - self._wrong >= plan.fault_ms
        now = list(values)
        still = last is not None and plan.still_ms > 0 and now == last
        if not still:
            self._still = ms
        quiet = ms - (self._still if self._still is not None else ms)
        self._last = now
        self.suspect = wrong or (still and 2 * quiet >= plan.still_ms)
        if self.fault:
            if self.suspect:
                self._good = None
            elif self._good is None:
                self._good = ms
            if self._good is None or ms - self._good < plan.recover_ms:
                return ""
            self.fault, self._good = False, None
            return "recovered"
        if broken or (still and quiet >= plan.still_ms):
            self.faults += 1
            self.fault, self._good = True, None
            return "fault"
        return ""
