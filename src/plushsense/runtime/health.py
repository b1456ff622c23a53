"""Sensor health, in integers only: suspect frames and sensor faults.

This module is the specification that ``deploy/c/plushsense.c`` implements. It checks frames before resampling.

- A channel is *wrong* in a frame if its value is outside its valid range, or if it is the same as in the frame before
  and outside ``low`` to ``high``, the range of values in the recordings: a saturated sensor.
- The toy is *still* while all channels repeat the frame before. Working sensors are noisy; ones that hang are not.
- A frame is *suspect* if a channel is wrong, or the toy was still for ``still_ms`` / 2. No event begins at it.
- A *fault* begins when for ``fault_ms`` every frame had a wrong channel (not always the same one), or the toy was still
  for ``still_ms``. Frames are then ignored until none was suspect for ``recover_ms``; after that a new stream
  begins.
- After a gap or a reset of the clock, all these times are counted from 0 (`Health.clear`), also during a fault.
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
    """Settings of `Health`.

    Attributes:
        low: smallest value of each measured channel in the recordings, in integer steps; a value below it that
            repeats is a saturated sensor (default: not known, so that only the layout's valid ranges are checked).
        high: largest value of each measured channel, as many as ``low`` (default: not known).
        fault_ms: time for which every frame has a wrong channel until a fault is reported; 0: never (0 to 60000).
        still_ms: time for which all channels repeat the frame before until a fault is reported; 0: never (0 to 60000).
        recover_ms: time without suspect frames after which a fault ends; 0: with the first good frame (0 to 60000).

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
    """Checks the sensor health of one stream of frames; ``inside`` has the usual values (low, high) of each channel."""

    def __init__(self, settings: HealthSettings, layout: Layout) -> None:
        self.settings = settings
        self._valid = [(int(a), int(b)) for a, b in zip(layout.valid_min_int, layout.valid_max_int, strict=True)]
        usual = list(zip(settings.low, settings.high, strict=True)) or self._valid
        if len(usual) != len(self._valid):
            raise BundleError(
                f"The health limits are of {len(usual)} channels, the layout has {len(self._valid)}: train again."
            )
        self.inside = [(max(a, c), min(b, d)) for (a, b), (c, d) in zip(self._valid, usual, strict=True)]
        self.reset()

    def reset(self) -> None:
        """Begin a new stream and set the number of faults to 0."""
        self.faults = 0
        self.fault = False
        self.clear()

    def clear(self) -> None:
        """Discard earlier frames, as after a gap; a fault continues until it has recovered."""
        self.suspect = False
        self._last: list[int] | None = None
        self._wrong: int | None = None  # ms at the first of the wrong frames in sequence
        self._still: int | None = None
        self._good: int | None = None

    def push(self, ms: int, values: Sequence[int]) -> str:
        """Check one frame; ``ms`` must not be earlier than in the frame before, unless `clear` was called.

        Returns ``"fault"`` if a fault begins with this frame, ``"recovered"`` if one ends, else ``""``.
        """
        settings, last = self.settings, self._last
        wrong = False
        for i, (value, (low, high)) in enumerate(zip(values, self.inside, strict=True)):
            # For most values only the first comparison is evaluated.
            if not low <= value <= high and (
                not self._valid[i][0] <= value <= self._valid[i][1] or (last is not None and value == last[i])
            ):
                wrong = True
                break
        if not wrong:
            self._wrong = None
        elif self._wrong is None:
            self._wrong = ms
        wrong_too_long = self._wrong is not None and settings.fault_ms > 0 and ms - self._wrong >= settings.fault_ms
        now = list(values)
        still = last is not None and settings.still_ms > 0 and now == last
        if not still:
            self._still = ms
        still_for = ms - (self._still if self._still is not None else ms)
        self._last = now
        self.suspect = wrong or (still and 2 * still_for >= settings.still_ms)
        if self.fault:
            if self.suspect:
                self._good = None
            elif self._good is None:
                self._good = ms
            if self._good is None or ms - self._good < settings.recover_ms:
                return ""
            self.fault, self._good = False, None
            return "recovered"
        if wrong_too_long or (still and still_for >= settings.still_ms):
            self.faults += 1
            self.fault, self._good = True, None
            return "fault"
        return ""
