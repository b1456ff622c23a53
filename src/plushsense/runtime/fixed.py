"""The arithmetic of a deployed model: fixed point, in integers of 32 bits, the same here and in the toy's C.

Every rule is stated once, here; ``deploy/c/plushsense.c`` repeats it. ``>>`` is a floor division by a power of two
also of negative numbers, so that nothing depends on a language's rounding of quotients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BundleError

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

LOGIT_LIMIT = 1 << 14  # logits are held within ±64 in steps of 1/256
PROBABILITY_BITS = 15
SMOOTH_EXTRA_BITS = 12
_MULTIPLIER_BITS = 15


def exponentials() -> tuple[Ints, Ints]:
    """Return the two tables of exp(-d / 256).

    Round(65535 exp(-i / 4)) and round(65535 exp(-i / 256)), each for i in 0..63.
    """
    i = np.arange(64)
    return (
        np.rint(65535 * np.exp(-i / 4.0)).astype(np.int64),
        np.rint(65535 * np.exp(-i / 256.0)).astype(np.int64),
    )


_COARSE, _FINE = exponentials()


class _Table:
    """Columns of integers, one a row; the ranges are what 32 bits can hold at every step."""

    RANGES: dict[str, tuple[int, int]]

    def __post_init__(self) -> None:
        rows: int | None = None
        for name, (low, high) in self.RANGES.items():
            given = np.asarray(getattr(self, name))
            values = given.astype(np.int64) if given.dtype.kind in "iu" or not given.size else None
            if values is None or values.ndim != 1 or (values.size and not low <= values.min() <= values.max() <= high):
                raise BundleError(
                    f"A fixed-point scale has {name} {given.tolist()}; accepted are whole numbers from {low} to {high}."
                )
            rows = len(values) if rows is None else rows
            if len(values) != rows:
                raise BundleError(f"A fixed-point scale has {len(values)} {name} for {rows} rows: give one for each.")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.RANGES))))


@dataclass(frozen=True, eq=False)
class InputScale(_Table):
    """Raw inputs to 8 bits, a channel each.

    ``d = x - offset`` held within ± (2^(15 + before) - 1); ``((d >> before) * multiplier + bias) >> after`` held
    within 0 and 255. The rounding half is in ``bias``.
    """

    offset: Ints
    before: Ints
    multiplier: Ints
    bias: Ints
    after: Ints

    RANGES = {  # noqa: RUF012, RUF100
        "offset": (-(1 << 31), (1 << 31) - 1),
        "before": (0, 16),
        "multiplier": (0, (1 << 15) - 1),
        "bias": (-(1 << 30), (1 << 30) - 1),
        "after": (0, 30),
    }

    def apply(self, x: ArrayLike) -> Bytes:
        """Return raw inputs (..., C) as the network reads them, (..., C) uint8."""
        limit = (1 << (15 + self.before)) - 1
        d = np.clip(np.asarray(x, dtype=np.int64) - self.offset, -limit, limit)
        read: Bytes = np.clip(((d >> self.before) * self.multiplier + self.bias) >> self.after, 0, 255).astype(np.uint8)
        return read


@dataclass(frozen=True, eq=False)
class _SumScale(_Table):
    """Scale of sums of 32 bits, a row for each filter or class."""

    before: Ints
    multiplier: Ints
    after: Ints

    RANGES = {"before": (0, 30), "multiplier": (0, (1 << 15) - 1), "after": (0, 30)}  # noqa: RUF012, RUF100

    def _scaled(self, t: Ints) -> Ints:
        return np.asarray((t * self.multiplier + ((1 << self.after) >> 1)) >> self.after)


class Requantize(_SumScale):
    """ReLU and sums to 8 bits, a filter each.

    A sum up to 0 gives 0; else ``t = sum >> before``, at most 65535; ``(t * multiplier + half) >> after``, at most
    255, where half is ``2^after >> 1``.
    """

    def apply(self, sums: Ints) -> Bytes:
        """Requantize sums (..., F) of 32 bits to activations (..., F) uint8."""
        t = np.minimum(np.maximum(sums, 0) >> self.before, 65535)
        return np.minimum(self._scaled(t), 255).astype(np.uint8)


class LogitScale(_SumScale):
    """Sums of the dense layer to logits in steps of 1/256, a class each.

    ``t = sum >> before`` held within -32768 and 32767; ``(t * multiplier + half) >> after`` held within ±16384.
    """

    def apply(self, sums: Ints) -> Ints:
        """Scale sums (..., K) of 32 bits to logits (..., K)."""
        t = np.clip(sums >> self.before, -32768, 32767)
        return np.clip(self._scaled(t), -LOGIT_LIMIT, LOGIT_LIMIT)


def split_ratio(ratio: float, highest: float, most_after: int = 30, most_before: int = 30) -> tuple[int, int, int]:
    """Return (before, multiplier, after) that multiply by ``ratio``; arguments reach up to ``highest``.

    ``before`` shifts ``highest`` under 2^15, so that only bits of no weight are lost; the multiplier has 15 bits. A
    ratio beyond what they can hold gives the largest multiplier: with it every whole number saturates.
    """
    if not (ratio > 0 and np.isfinite(ratio) and highest >= 0 and np.isfinite(highest)):
        return 0, 0, 0
    before = min(max(int(highest).bit_length() - _MULTIPLIER_BITS, 0), most_before)
    multiplier, after = ratio * 2.0**before, 0
    while multiplier < 1 << 14 and after < most_after:
        multiplier, after = multiplier * 2, after + 1
    if round(multiplier) >= 1 << _MULTIPLIER_BITS:
        if after == 0:
            return before, (1 << _MULTIPLIER_BITS) - 1, 0
        multiplier, after = multiplier / 2, after - 1
    return before, min(round(multiplier), (1 << _MULTIPLIER_BITS) - 1), after


def integer_logits(logits: NDArray[Any]) -> Ints:
    """Return float logits (..., K) rounded to steps of 1/256 and held within the limit, as a toy holds them."""
    return np.clip(np.rint(np.asarray(logits, dtype=np.float64) * 256), -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.int64)


def softmax(logits: Ints) -> Ints:
    """Return probabilities (K,) in steps of 2^-15 from logits (K,) in steps of 1/256.

    ``d = max - logit``; from 4096 on the probability is 0; else ``e = (coarse[d >> 6] * fine[d & 63]) >> 16``. The
    probability is ``((e << 15) + (sum >> 1)) / sum``, rounded down.
    """
    d = int(logits.max()) - logits
    inside = np.minimum(d, 4095)
    e = np.where(d < 4096, (_COARSE[inside >> 6] * _FINE[inside & 63]) >> 16, 0)
    total = int(e.sum())
    return np.asarray(((e << PROBABILITY_BITS) + (total >> 1)) // total)


def smoothing_weight(seconds: float, step_s: float) -> int:
    """Return the weight of a new step in an exponential mean with this time constant, in steps of 2^-15; at least 1."""
    full = 1 << PROBABILITY_BITS
    return full if seconds == 0 else max(1, round(-float(np.expm1(-step_s / seconds)) * full))


def smooth(mean: Ints | None, probabilities: Ints, weight: int) -> Ints:
    """Return the exponential mean (K,) in steps of 2^-27 after a step of probabilities (K,); the first starts it.

    ``d = (probability << 12) - mean``; the mean grows by ``(d * weight + 2^14) >> 15``.
    """
    now = probabilities << SMOOTH_EXTRA_BITS
    return now if mean is None else mean + (((now - mean) * weight + (1 << 14)) >> 15)
