"""Fixed-point arithmetic of a deployed model in 32-bit integers, with the same results here and in the toy's C.

This module is the specification that ``deploy/c/plushsense.c`` implements. ``>>`` is a floor division by a power of
two, also for negative numbers, so that no result depends on how a language rounds quotients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BundleError

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

LOGIT_LIMIT = 1 << 14  # logits are clamped to ±64, in steps of 1/256
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
    """Base of tables of equally long integer columns, each within ``RANGES``, so that nothing exceeds 32 bits."""

    RANGES: dict[str, tuple[int, int]]

    def __post_init__(self) -> None:
        rows: int | None = None
        for name, (low, high) in self.RANGES.items():
            raw = np.asarray(getattr(self, name))
            values = raw.astype(np.int64) if raw.dtype.kind in "iu" or not raw.size else None
            if values is None or values.ndim != 1 or (values.size and not low <= values.min() <= values.max() <= high):
                raise BundleError(
                    f"A fixed-point scale has {name} {raw.tolist()}; accepted are whole numbers from {low} to {high}."
                )
            rows = len(values) if rows is None else rows
            if len(values) != rows:
                raise BundleError(f"A fixed-point scale has {len(values)} {name} for {rows} rows: give one for each.")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.RANGES))))


@dataclass(frozen=True, eq=False)
class InputScale(_Table):
    """Scale from raw inputs to 8 bits, with a row for each channel.

    ``d = x - offset``, clamped to ± (2^(15 + before) - 1); then ``((d >> before) * multiplier + bias) >> after``,
    clamped to 0…255. ``bias`` includes the half for rounding.
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
        """Scale raw inputs (..., C) to the network's inputs (..., C) uint8."""
        low, high = self._limits
        # Not np.clip(), which takes several times as long for the few numbers of a step.
        d = np.minimum(np.maximum(np.asarray(x, dtype=np.int64) - self.offset, low), high)
        scaled = ((d >> self.before) * self.multiplier + self.bias) >> self.after
        out: Bytes = np.minimum(np.maximum(scaled, 0), 255).astype(np.uint8)
        return out

    @cached_property
    def _limits(self) -> tuple[Ints, Ints]:
        limit = (1 << (15 + self.before)) - 1
        return -limit, limit


@dataclass(frozen=True, eq=False)
class _SumScale(_Table):
    """Scale of 32-bit sums, with a row for each filter or class."""

    before: Ints
    multiplier: Ints
    after: Ints

    RANGES = {"before": (0, 30), "multiplier": (0, (1 << 15) - 1), "after": (0, 30)}  # noqa: RUF012, RUF100

    def _scaled(self, t: Ints) -> Ints:
        return np.asarray((t * self.multiplier + self._half) >> self.after)

    @cached_property
    def _half(self) -> Ints:
        return np.asarray((1 << self.after) >> 1)


class Requantize(_SumScale):
    """ReLU, and scale from sums to 8-bit activations, with a row for each filter.

    A sum of 0 or less gives 0; else ``t = sum >> before``, at most 65535; then ``(t * multiplier + half) >> after``, at
    most 255, where half is ``2^after >> 1``.
    """

    def apply(self, sums: Ints) -> Bytes:
        """Requantize sums (..., F) of 32 bits to activations (..., F) uint8."""
        t = np.minimum(np.maximum(sums, 0) >> self.before, 65535)
        return np.minimum(self._scaled(t), 255).astype(np.uint8)


class LogitScale(_SumScale):
    """Scale from sums of the dense layer to logits in steps of 1/256, with a row for each class.

    ``t = sum >> before``, clamped to 16 bits; then ``(t * multiplier + half) >> after``, clamped to ±16384.
    """

    def apply(self, sums: Ints) -> Ints:
        """Scale sums (..., K) of 32 bits to logits (..., K)."""
        t = np.minimum(np.maximum(sums >> self.before, -32768), 32767)
        return np.minimum(np.maximum(self._scaled(t), -LOGIT_LIMIT), LOGIT_LIMIT)


def split_ratio(ratio: float, highest: float, most_after: int = 30, most_before: int = 30) -> tuple[int, int, int]:
    """Return the (before, multiplier, after) that multiply numbers up to ``highest`` by ``ratio``.

    ``before`` shifts ``highest`` below 2^15, so that only insignificant bits are lost; the multiplier has 15 bits. A
    ratio that is too large gives the largest multiplier, with which every whole number saturates.
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
    """Round float logits (..., K) to steps of 1/256 and clamp them to the limit, like the toy."""
    return np.clip(np.rint(np.asarray(logits, dtype=np.float64) * 256), -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.int64)


def softmax(logits: Ints) -> Ints:
    """Compute probabilities (..., K) in steps of 2^-15 from logits (..., K) in steps of 1/256.

    ``d = max - logit``; from 4096 on the probability is 0; else ``e = (coarse[d >> 6] * fine[d & 63]) >> 16``. The
    probability is ``((e << 15) + (sum >> 1)) / sum``, rounded down.
    """
    d = logits.max(axis=-1, keepdims=True) - logits
    inside = np.minimum(d, 4095)
    e = np.where(d < 4096, (_COARSE[inside >> 6] * _FINE[inside & 63]) >> 16, 0)
    total = e.sum(axis=-1, keepdims=True)
    return np.asarray(((e << PROBABILITY_BITS) + (total >> 1)) // total)


def known_score(logits: Ints, idle: NDArray[np.bool_]) -> Ints:
    """Return how clearly the best gesture stands out (...,), from logits (..., K) in steps of 1/256.

    It is the highest logit of a gesture less the third highest, at most `LOGIT_LIMIT`. The second highest is often that
    of a gesture of the same family. Classes of ``idle`` (K,) are left out. Of fewer than three gestures, each missing
    one counts as ``-LOGIT_LIMIT``, so that without any gesture the result is 0.
    """
    lowest = np.full((*logits.shape[:-1], 3), -LOGIT_LIMIT, dtype=np.int64)
    ranked = np.sort(np.concatenate([lowest, logits[..., ~idle]], axis=-1), axis=-1)
    return np.asarray(np.minimum(ranked[..., -1] - ranked[..., -3], LOGIT_LIMIT))


def smoothing_weight(seconds: float, step_s: float) -> int:
    """Return the weight (at least 1, in steps of 2^-15) of a new step in an exponential mean over ``seconds``."""
    full = 1 << PROBABILITY_BITS
    return full if seconds == 0 else max(1, round(-float(np.expm1(-step_s / seconds)) * full))


def smooth(mean: Ints | None, probabilities: Ints, weight: int) -> Ints:
    """Update an exponential mean (K,) in steps of 2^-27 by new probabilities (K,); ``mean`` is None at the first step.

    ``d = (probability << 12) - mean``; the mean increases by ``(d * weight + 2^14) >> 15``.
    """
    now = probabilities << SMOOTH_EXTRA_BITS
    return now if mean is None else mean + (((now - mean) * weight + (1 << 14)) >> 15)
