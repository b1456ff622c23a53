"""What classical programs read of a window in place of its samples: eight statistics of each channel, 88 of eleven.

They are those of the paper (section 3.4), whose text gives names and no formulas. Which formula each name has here, of
the T samples x of one channel, and where MATLAB's function of that name differs:

- mean, minimum, maximum: as they are called;
- standard deviation: √(Σ (x − mean)² / T); MATLAB's ``std`` divides by T − 1, the same to a constant factor;
- RMS √(Σ x² / T) and energy Σ x², the mean left in, as ``rms`` and ``sum(x.^2)`` do;
- band power: the part of the mean square, in squared units, that lies in low ≤ f < high, from the one-sided
  periodogram of x less its mean: a sine of amplitude A within a band gives A²/2. MathWorks documents ``bandpower`` as a
  *modified* periodogram (of x times a window function) integrated by rectangles between the nearest frequencies that
  there are, and says of no mean taken off first: there a channel's level stands in its lowest band once more, and a
  frequency between two bands may count in both. Here the level is in five other statistics already.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput

BANDS_HZ = ((0.0, 1.0), (1.0, 3.0))
NAMES = ("mean", "sd", "min", "max", "rms", "energy", *(f"power {low:g}-{high:g} Hz" for low, high in BANDS_HZ))


def statistics(x: NDArray[np.integer[Any]] | NDArray[np.floating[Any]], rate_hz: float) -> NDArray[np.float64]:
    """The statistics of windows (N, C, T) at even samples: (N, 8 C), all channels' means first, then all their sd …

    Raises:
        BadInput: for windows of no samples, of which nothing can be said.
    """
    if x.ndim != 3 or x.shape[2] == 0:
        raise BadInput(f"Statistics are taken of windows (windows, channels, samples); these have the shape {x.shape}.")
    values = x.astype(np.float64)
    samples = values.shape[2]
    mean = values.mean(axis=2)
    power = np.abs(np.fft.rfft(values - mean[:, :, None], axis=2)) ** 2 * (2.0 / samples**2)
    if samples % 2 == 0:
        # Half the sampling rate has no twin at negative frequencies.
        power[:, :, -1] *= 0.5
    frequency = np.fft.rfftfreq(samples, 1.0 / rate_hz)
    bands = [power[:, :, (frequency >= low) & (frequency < high)].sum(axis=2) for low, high in BANDS_HZ]
    energy = (values**2).sum(axis=2)
    rms = np.sqrt(energy / samples)
    spread, low, high = values.std(axis=2), values.min(axis=2), values.max(axis=2)
    return np.concatenate([mean, spread, low, high, rms, energy, *bands], axis=1)


def statistic_names(channels: Sequence[str]) -> tuple[str, ...]:
    """What each column of `statistics` is: "x mean", "y mean", …"""
    return tuple(f"{channel} {name}" for name in NAMES for channel in channels)
