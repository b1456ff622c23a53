"""Compute a correlation by matrix products with three real matrices: y = A ((G w) · (D x)).

D x is the discrete Fourier transform of ``x`` at the L/2 frequencies k + ½ (the odd roots of z^L = −1: none of them is
real, so that no product is wasted), in two stages (L = short · long, Cooley and Tukey 1965), each complex number as the
three real ones that its product needs (Gauss; Karatsuba and Ofman 1962). G w is the conjugate transform of the
kernel, A the inverse. What wraps around, with its sign changed, affects only outputs that are not computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float32]

# Real products a complex one takes.
PLANES = 3

# Cost of a sample of transform length beside the multiplications (memory traffic), fitted to steps on two cores.
_LENGTH_COST = 40
_SHORT = range(1, 41)


@dataclass(frozen=True)
class Lengths:
    """A transform of ``short`` · ``long`` samples; ``long`` is even."""

    short: int
    long: int

    @property
    def samples(self) -> int:
        """The length L of the transform."""
        return self.short * self.long

    @property
    def pairs(self) -> int:
        """Number of frequencies of the first stage: half of ``long``, as the others are their conjugates."""
        return self.long // 2

    @property
    def planes(self) -> int:
        """Number of real products for each pair of channels: 3 L / 2."""
        return PLANES * self.samples // 2

    @property
    def macs(self) -> int:
        """Multiplications of one transform of one channel."""
        return self.samples * (self.long + PLANES * self.short)


@cache
def lengths_for(samples: int) -> Lengths:
    """Return the cheapest transform of at least ``samples`` samples; the same on every machine."""
    candidates = []
    for short in _SHORT:
        long = -(-samples // short)
        candidates.append(Lengths(short, long + long % 2))
    return min(candidates, key=lambda c: (c.macs + _LENGTH_COST * c.samples, c.short))


@dataclass(frozen=True)
class Matrices:
    """The stages as float32 matrices, h = ``long`` / 2, s = ``short``; planes are (h, 3, s) flattened.

    ``d1`` (long, long): ``x`` as (long, s) → (h, 2, s). ``d2`` (h, 3s, 2s): (h, 2s) → planes.
    ``g`` (planes, taps): a kernel → planes. ``a2`` (h, 2s, 3s): planes → (h, 2s).
    ``a1`` (rows, long + 1): (h, 2, s) and one more row → the first ``rows`` · s outputs, plus that row to each.
    """

    d1: Matrix
    d2: Matrix
    g: Matrix
    a2: Matrix
    a1: Matrix


@lru_cache(maxsize=64)
def matrices(lengths: Lengths, taps: int, rows: int) -> Matrices:
    """Return the matrices of a correlation with ``taps`` taps, computed in float64."""
    short, long, pairs = lengths.short, lengths.long, lengths.pairs
    coarse = 2.0 * np.pi * (np.arange(pairs) + 0.5)[:, None] / long * np.arange(long)
    first = np.stack([np.cos(coarse), -np.sin(coarse)], axis=1).reshape(long, long)
    # The frequencies that a first-stage frequency fans out into, (pairs, short), as angles a sample.
    fan = np.arange(pairs)[:, None] + long * np.arange(short)
    angle = 2.0 * np.pi * (fan + 0.5) / lengths.samples
    phase = angle[:, :, None] * np.arange(short)
    cos, sin = np.cos(phase), np.sin(phase)
    real, imag = np.concatenate([cos, sin], axis=2), np.concatenate([-sin, cos], axis=2)
    second = np.concatenate([real + imag, real, imag], axis=1)
    kernel = angle[:, :, None] * np.arange(taps)
    kernel_real, kernel_imag = np.cos(kernel), np.sin(kernel)
    g = np.concatenate([kernel_real, kernel_imag - kernel_real, kernel_real + kernel_imag], axis=1)
    # With p = Wr (Xr + Xi), q = Xr (Wi − Wr), r = Xi (Wr + Wi): the product is (p − r) + i (p + q).
    back_real = np.concatenate([cos - sin, -sin, -cos], axis=1)
    back_imag = np.concatenate([sin + cos, cos, -sin], axis=1)
    back = np.concatenate([back_real, back_imag], axis=2).transpose(0, 2, 1)
    last = first.T[:rows] * (2.0 / lengths.samples)
    return Matrices(
        d1=_single(first),
        d2=_single(second),
        g=_single(g.reshape(-1, taps)),
        a2=_single(back),
        a1=_single(np.concatenate([last, np.ones((rows, 1))], axis=1)),
    )


def _single(values: NDArray[np.float64]) -> Matrix:
    return np.ascontiguousarray(values, dtype=np.float32)
