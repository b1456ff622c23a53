"""Self-calibration: offset and scale of channels, estimated from the samples so far, without labels.

In integers, and causal. A channel of ``Layout.self_calibration`` becomes ``(reading - offset) * UNIT / scale``, so that
readings with another gain above 0 and another offset give the same numbers but for rounding. Until the first block of
about 0.3 s is complete, the output is 0. The state survives gaps and resets of the clock; a new stream and a reboot
(rule 4 of `plushsense.windows.clock`) clear it. Quotients are rounded toward 0. ``deploy/c/plushsense.c`` computes the
same.

Samples are taken in blocks. A block gives the mean m of each axis and their variance within the block. Its weight is
``(level / (variance + level))²``; the level follows the variance of the stillest blocks: it falls by 1/4 where a block
is stiller, else rises by 1/32, so that a sixth of the blocks is.

**Accelerometers** (`SphereFit`). Held still, an accelerometer reads a vector of 1 g, whatever its direction: readings
lie on a sphere whose centre is the offset of the sensor and whose radius is 1 g (autocalibration, van Hees et al. 2014,
10.1152/japplphysiol.00421.2014):

1. Weighted sums of m, of the products of its components, of ``q = |m|²``, ``q m`` and ``q²`` are kept; all are halved
   when the sum of weights exceeds `MOST_WEIGHT`. With d the distance of the centre from the weighted mean of m, least
   squares ask for ``A d = b``: A is the covariance of m, b half the covariance of ``|m - mean|²`` and m. While the
   sensor has hardly been turned, noise makes such a sphere too small. So the variance of the distances from the sphere
   is subtracted from the diagonal of A (total least squares, as in the fit of Taubin 1991, 10.1109/34.103273). It is
   that of the previous centre, and at most the determinant of A divided by the sum of its principal minors of order
   two, which is not above the smallest eigenvalue. Each block makes eight Gauss-Seidel sweeps from the previous centre,
   so that a direction which nothing is known of keeps what it had.
2. The square of the radius is the mean of ``|m - centre|²``, but at least `LEAST_RADIUS` times the level, so that a
   sensor that was not turned yet does not show its noise as movement.

**Other channels** (`RunningQuantiles`), each alone, but the three axes of a vector together, with one scale:

1. Of each interval, the mean of the block with the greatest weight is kept. An interval is one block at first. Whenever
   `KEPT` means have come, the one with the greater weight of every two stays, and intervals become twice as long, up to
   `MOST_INTERVAL` blocks.
2. The offset, rest, is the median of these means, each with its weight: at most half of them, by weight, may be touch.
3. The distance of a block from rest is the root mean square of its samples. The scale, spread, is a high quantile of
   the distances, by stochastic approximation: it rises to the distance of a block that is farther away, but at most to
   twice itself, and falls by 1 / 1024 in other blocks. Blocks nearer than the least spread, without touch and
   movement, change nothing: how long a sensor rests between touches does not matter.
4. The least spread is the root of `LEAST_SPREAD` times the level, so that a sensor that only rested does not show its
   noise as touch.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import ACCELERATION, Layout
from plushsense.windows.clock import Segment

UNIT = 2048  # of the output: 1 g, or the spread
MOST_OUTPUT = 32767
MEAN_BITS = 12  # magnitude of the components of m: larger ones raise the exponent of all sums
WEIGHT_BITS = 14
MOST_WEIGHT = 1 << 22
SQUARE_BITS = 6  # q is |m|² without these bits
LEAST_RADIUS = 256
FRACTION_BITS = 8  # of mean, covariance and centre
OFFSET_BITS = 4  # fraction bits of the offset that is subtracted
_MOST_VARIANCE = (1 << 47) - 1
_VARIANCE_OF_STEPS = 256  # three times that of rounding to whole numbers, in the units of the variance
_SWEEPS = 8
KEPT = 8  # means of still blocks
MOST_INTERVAL = 128  # blocks of 0.3 s
LEAST_SPREAD = 64  # its square, as a multiple of the level
_SPREAD_BITS = 10  # fraction bits of the spread, and binary logarithm of its slowness
_MINOR_BITS = 20  # magnitude of the covariance from which determinant and minors are computed
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_PLACE = ((0, 3, 4), (3, 1, 5), (4, 5, 2))  # of the product of two components among the pairs

Ints = NDArray[np.int64]


def _quotient(a: int, b: int) -> int:
    """Return a / b for b > 0, rounded toward 0, as C does."""
    return a // b if a >= 0 else -(-a // b)


class SensorFit(ABC):
    """Offset and scale of a sensor with A axes, estimated anew from each complete block of samples."""

    def __init__(self, axes: int, shift: int) -> None:
        self._axes = axes
        self._shift = shift  # binary logarithm of the samples in a block
        self._base: list[int] = []  # the first sample, from which all is measured
        self._count = 0
        self._sum, self._squares = [0] * axes, 0
        self._level = 0
        self.offset = [0] * axes  # with `OFFSET_BITS`
        self.multiplier = 0  # 0 before the first block, else 16 bits
        self.down = 1

    @property
    def left(self) -> int:
        """Number of samples until the block is complete."""
        return (1 << self._shift) - self._count

    def output(self, axis: int, x: int) -> int:
        """Return a reading of an axis in steps of 1 / `UNIT` of the scale."""
        scaled = ((x << OFFSET_BITS) - self.offset[axis]) * self.multiplier + (1 << (self.down - 1)) >> self.down
        return min(max(scaled, -MOST_OUTPUT), MOST_OUTPUT)

    def outputs(self, x: Ints) -> Ints:
        """Return readings (n, A) in steps of 1 / `UNIT` of the scale, with the current offset and scale."""
        scaled = ((x << OFFSET_BITS) - np.array(self.offset)) * self.multiplier + (1 << (self.down - 1)) >> self.down
        return np.asarray(np.clip(scaled, -MOST_OUTPUT, MOST_OUTPUT), dtype=np.int64)

    def add(self, x: Sequence[int]) -> None:
        """Add one sample (A,)."""
        self._base = self._base or list(x)
        y = [a - b for a, b in zip(x, self._base, strict=True)]
        self._take(y, sum(v * v for v in y), 1)

    def add_all(self, x: Ints) -> None:
        """Add samples (n, A) of one block, at most those that are `left`."""
        self._base = self._base or x[0].tolist()
        y = x - np.array(self._base)
        self._take(y.sum(axis=0).tolist(), int((y * y).sum()), len(y))

    def _take(self, total: list[int], squares: int, n: int) -> None:
        self._sum = [a + b for a, b in zip(self._sum, total, strict=True)]
        self._squares += squares
        self._count += n
        if self._count >> self._shift:
            self._end_block()
            self._count, self._sum, self._squares = 0, [0] * self._axes, 0

    @abstractmethod
    def _end_block(self) -> None:
        """Estimate offset and scale with the block that is complete now."""

    @property
    def _variance(self) -> int:
        """The variance of the block's samples, in units of the square of one over their number."""
        return (self._squares << self._shift) - sum(v * v for v in self._sum)

    def _weight_of(self, variance: int) -> int:
        """Return the weight of a block with this variance, and let the level follow."""
        variance = min(variance, _MOST_VARIANCE)
        level = self._level or variance
        share = (level << WEIGHT_BITS) // (variance + level)
        self._level = level - (level >> 2) if variance < level else level + (level >> 5)
        return share * share >> WEIGHT_BITS


class SphereFit(SensorFit):
    """The state of one accelerometer: sums over blocks, and the offset and scale that follow from them."""

    def __init__(self, shift: int) -> None:
        super().__init__(3, shift)
        self._exponent = 0
        self._weight = 0
        self._first, self._second = [0] * 3, [0] * 6
        self._square, self._third, self._fourth = 0, [0] * 3, 0
        self._centre = [0, 0, 0]

    def _end_block(self) -> None:
        self._add_mean(self._weight_of(self._variance + _VARIANCE_OF_STEPS))
        self._fit()

    def _add_mean(self, w: int) -> None:
        while max(map(abs, self._sum)) >> (self._exponent + MEAN_BITS):
            self._exponent += 1
            self._first = [_quotient(v, 2) for v in self._first]
            self._second = [_quotient(v, 4) for v in self._second]
            self._square = _quotient(self._square, 4)
            self._third = [_quotient(v, 8) for v in self._third]
            self._fourth = _quotient(self._fourth, 16)
            self._centre = [_quotient(v, 2) for v in self._centre]
        m = [_quotient(v, 1 << self._exponent) for v in self._sum]
        square = sum(v * v for v in m) >> SQUARE_BITS
        self._weight += w
        for i in range(3):
            self._first[i] += w * m[i]
            self._third[i] += w * m[i] * square
        for i, (one, other) in enumerate(_PAIRS):
            self._second[i] += w * m[one] * m[other]
        self._square += w * square
        self._fourth += w * square * square
        if self._weight > MOST_WEIGHT:
            odd, n = self._weight & 1, self._weight

            def halved(v: int) -> int:
                return _quotient(v - odd * _quotient(v, n), 2)

            self._weight >>= 1
            self._first = [halved(v) for v in self._first]
            self._second = [halved(v) for v in self._second]
            self._square = halved(self._square)
            self._third = [halved(v) for v in self._third]
            self._fourth = halved(self._fourth)

    def _fit(self) -> None:
        """Move the centre toward the solution, and derive offset and scale."""
        one = 1 << FRACTION_BITS
        n = max(self._weight, 1)
        mean = [_quotient(v * one * one, n) for v in self._first]
        whole = [_quotient(v, n) for v in self._first]
        rest = [v - w * n for v, w in zip(self._first, whole, strict=True)]
        a = [
            _quotient((s - whole[i] * self._first[j] - _quotient(rest[i] * self._first[j], n)) * one, n)
            for s, (i, j) in zip(self._second, _PAIRS, strict=True)
        ]
        square = self._square // n
        over = self._square - square * n
        # Covariance of q and m, half of that of |m - mean|² and m, and the centre from the mean.
        k = [
            _quotient((third - square * first - _quotient(over * first, n)) * one, n)
            for third, first in zip(self._third, self._first, strict=True)
        ]
        b = [
            k[i] * (one << (SQUARE_BITS - 1)) - _quotient(sum(a[_PLACE[i][j]] * mean[j] for j in range(3)), one)
            for i in range(3)
        ]
        mean = [_quotient(v, one) for v in mean]
        d = [c - m for c, m in zip(self._centre, mean, strict=True)]
        noise = min(self._noise(a, b, k, d, square, over, n), _least_eigenvalue(a))
        most = 4 << (MEAN_BITS + FRACTION_BITS)
        for _ in range(_SWEEPS):
            for i in range(3):
                j, other = (i + 1) % 3, (i + 2) % 3
                left = b[i] - a[_PLACE[i][j]] * d[j] - a[_PLACE[i][other]] * d[other]
                d[i] = min(max(_quotient(left, max(a[i] - noise, 0) + 1), -most), most)
        self._centre = [m + v for m, v in zip(mean, d, strict=True)]
        least = min(self._level >> (2 * self._exponent), 1 << 36) * LEAST_RADIUS * one * one
        radius = math.isqrt(max(sum(a[:3]) * one + sum(v * v for v in d), least, one * one))
        bits = radius.bit_length()
        self.multiplier = (1 << (bits + 15)) // radius
        self.down = bits + self._exponent - self._shift
        to_raw = FRACTION_BITS + self._shift - OFFSET_BITS
        self.offset = [
            (x << OFFSET_BITS) + _quotient(c << self._exponent, 1 << to_raw)
            for x, c in zip(self._base, self._centre, strict=True)
        ]

    def _noise(self, a: list[int], b: list[int], k: list[int], d: list[int], square: int, over: int, n: int) -> int:
        """Return the variance of the distances from the sphere around the previous centre, with `FRACTION_BITS`."""
        one = 1 << FRACTION_BITS
        spread = _quotient(self._fourth - square * self._square - square * over, n)  # the variance of q
        left = (spread << (2 * SQUARE_BITS - 5)) * one  # 1 / 32 of the variance of |m - centre|²
        for i in range(3):
            turned = sum(a[_PLACE[i][j]] * d[j] for j in range(3))
            part = _quotient(k[i] * (one << (SQUARE_BITS - 1)) + b[i] - turned, one * one * 8)
            left -= self._centre[i] * part
        radius = (sum(a[:3]) * one + sum(v * v for v in d)) >> (2 * FRACTION_BITS)
        return 8 * max(left, 0) // max(radius, 1)


def _least_eigenvalue(a: list[int]) -> int:
    """Return a third of the smallest eigenvalue of the covariance ``a`` or more, but not above it."""
    down = max(max(a[:3]).bit_length() - _MINOR_BITS, 0)
    xx, yy, zz, xy, xz, yz = (_quotient(v, 1 << down) for v in a)
    minors = [yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy]
    determinant = xx * minors[0] - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return max(determinant, 0) // max(sum(minors), 1) << down


class RunningQuantiles(SensorFit):
    """The state of one channel, or of the three axes of a vector: means of still blocks, and the spread."""

    def __init__(self, axes: int, shift: int) -> None:
        super().__init__(axes, shift)
        self._kept: list[tuple[int, list[int]]] = []  # weight and sum of blocks, the last of the interval at hand
        self._interval, self._blocks = 1, 0
        self._rest = [0] * axes  # as the sum of a block
        self._spread = 0  # as the sum of a block, with `_SPREAD_BITS`

    def _end_block(self) -> None:
        variance = self._variance
        # An eighth of a step's square for each axis: more than that of rounding, and never 0.
        self._keep(self._weight_of(variance + (self._axes << (2 * self._shift - 3))))
        distance = math.isqrt(variance + sum((v - rest) ** 2 for v, rest in zip(self._sum, self._rest, strict=True)))
        least = max(math.isqrt(LEAST_SPREAD * self._level), 1)
        spread = max(self._spread >> _SPREAD_BITS, least)
        if distance > spread:
            self._spread = min(distance, 2 * spread) << _SPREAD_BITS
        elif distance > least:
            self._spread -= self._spread >> _SPREAD_BITS
        spread = max(self._spread >> _SPREAD_BITS, least)
        bits = spread.bit_length()
        self.multiplier = (1 << (bits + 15)) // spread
        self.down = bits + 8 - self._shift
        self.offset = [
            (x << OFFSET_BITS) + _quotient(rest << OFFSET_BITS, 1 << self._shift)
            for x, rest in zip(self._base, self._rest, strict=True)
        ]

    def _keep(self, weight: int) -> None:
        """Keep the block if it is the stillest of its interval so far; at the end of an interval, derive rest."""
        if self._blocks == 0:
            self._kept.append((weight, self._sum))
        elif weight > self._kept[-1][0]:
            self._kept[-1] = weight, self._sum
        self._blocks += 1
        if self._blocks < self._interval:
            return
        self._blocks = 0
        if len(self._kept) == KEPT:
            pairs = zip(self._kept[::2], self._kept[1::2], strict=True)
            self._kept = [other if other[0] > one[0] else one for one, other in pairs]
            self._interval = min(2 * self._interval, MOST_INTERVAL)
        whole = sum(weight for weight, _ in self._kept)
        for axis in range(self._axes):
            values = [(kept[axis], weight) for weight, kept in self._kept]
            self._rest[axis] = min(
                value for value, _ in values if 2 * sum(w for other, w in values if other <= value) >= whole
            )


class SelfCalibration:
    """The self-calibration of all sensors that a layout names."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._zeros = layout.zero_int.tolist()
        self._sensors = layout.calibrated_sensors
        self.reset()

    def reset(self) -> None:
        """Forget all samples, as at the beginning of a new stream."""
        shift, kinds = self._layout.calibration_shift, [c.kind for c in self._layout.channels]
        self._fits: list[SensorFit] = [
            SphereFit(shift) if kinds[axes[0]] == ACCELERATION else RunningQuantiles(len(axes), shift)
            for axes in self._sensors
        ]

    def copy(self) -> SelfCalibration:
        """Return an independent copy with the same state."""
        return copy.deepcopy(self)

    def push(self, sample: list[int]) -> list[int]:
        """Return one sample (C,) with calibrated channels, around the offsets of the layout."""
        for axes, fit in zip(self._sensors, self._fits, strict=True):
            x = [sample[axis] for axis in axes]
            sample = list(sample)
            for number, axis in enumerate(axes):
                sample[axis] = self._zeros[axis] + fit.output(number, x[number])
            fit.add(x)
        return sample

    def calibrated(self, segment: Segment) -> Segment:
        """Return the next segment of a stream with calibrated channels."""
        if segment.rebooted:
            self.reset()
        return replace(segment, data=self.apply(segment.data))

    def apply(self, data: Ints) -> Ints:
        """Return consecutive samples (T, C) with calibrated channels; the same as `push` of each."""
        if not self._sensors:
            return data
        out = data.copy()
        for axes, fit in zip(self._sensors, self._fits, strict=True):
            columns, at = list(axes), 0
            x = data[:, columns]
            while at < len(x):
                part = x[at : at + fit.left]
                out[at : at + len(part), columns] = fit.outputs(part) + self._layout.zero_int[columns]
                at += len(part)
                fit.add_all(part)
        return out
