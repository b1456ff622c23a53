"""Detect the onset and offset of a gesture in its recording from signal activity.

A recording consists of some rest, the gesture, and some rest. All quantities are relative to the device's own noise:

1. Activity: the speed of each sensor (change over 0.1 s, lightly smoothed), divided by its speed at rest; the axes of a
   vector are one sensor. For contact sensors (capacitive, proximity) also the distance from the level before the touch,
   since a hand that holds still is not rest. The activity of a row is that of the most active sensor.
2. Rest: the session's stream just before the recording (the countdown) if it is known, else the quietest stretch of the
   recording. The noise at rest is limited to 1.5 times that of the quietest stretch.
3. Contrast: the highest activity (95th percentile) divided by that at rest. Thresholds are a share of the way from rest
   to the highest activity on a logarithmic scale, so that they suit both a faint scratch and a throw.
4. Search outwards from the first and the last clear activity until the activity is low.

The confidence is lower for a low contrast, and for an onset that depends on the threshold (a slow start of the
gesture); it is 0 if no onset is visible. docs/trim.md reports the errors on real recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames

Floats: TypeAlias = NDArray[np.float64]

CONTEXT_S = 2.5
"""Seconds of the stream before a recording that count as rest: the countdown of 3 s without the key press at first."""

_CONTACT = ("capacitive", "proximity")


@dataclass(frozen=True)
class OnsetSpec:
    """Settings of the method. Shares are of the way from rest to the highest activity, on a logarithmic scale.

    The outward search ends when the activity stayed below ``onset_at`` (``offset_at``) for ``quiet_s``; activity above
    ``clear_at`` is clear. Below ``least_contrast`` there is no gesture; one shorter than ``least_s`` is a knock.
    """

    smooth_s: float = 0.05
    half_s: float = 0.05
    onset_at: float = 0.4
    offset_at: float = 0.5
    clear_at: float = 0.6
    quiet_s: float = 0.08
    stretch_s: float = 0.4
    level_s: float = 0.25
    join_s: float = 0.3
    least_share: float = 0.05
    least_s: float = 0.2
    least_contrast: float = 4.0
    noise_factor: float = 1.5


SPEC = OnsetSpec()


@dataclass(frozen=True)
class Suggestion:
    """Suggested trim: the gesture is in the rows from ``start`` to before ``stop`` of a recording.

    If no onset is visible (movement at the first row, or no activity at all), ``start`` and its confidence are 0; if no
    offset is visible, ``stop`` is the number of rows and its confidence 0. ``contrast`` is the highest activity divided
    by that at rest; ``why`` explains what is not visible.
    """

    start: int
    stop: int
    onset_visible: bool
    offset_visible: bool
    onset_confidence: float
    offset_confidence: float
    contrast: float
    why: str = ""


def suggest(frames: Frames, layout: Layout, before: Frames | None = None, spec: OnsetSpec = SPEC) -> Suggestion:
    """Suggest where the gesture in ``frames`` begins and ends.

    Args:
        frames: the whole recording, untrimmed.
        before: about `CONTEXT_S` of the stream just before it; rows before a gap are not used.
    """
    n = len(frames)
    nothing = Suggestion(0, n, False, False, 0.0, 0.0, 1.0, "too short")
    steps = np.diff(frames.device_ms)
    period_s = float(np.median(steps[steps > 0])) / 1000.0 if (steps > 0).any() else 0.01
    if n * period_s < 2 * spec.least_s or n < 5:
        return nothing
    rest, activity, floor = _activity(frames, layout, before, period_s, spec)
    contrast = float(np.quantile(activity, 0.95)) / floor
    nothing = replace(nothing, contrast=contrast, why="nothing stands out from the noise")
    if contrast < spec.least_contrast:
        return nothing
    first, last = _clear(activity, floor * contrast**spec.clear_at, period_s, spec)
    quiet = max(1, round(spec.quiet_s / period_s))

    def onset(share: float) -> int:
        return _walk_back(activity[: first + 1], rest, floor * contrast**share, quiet)

    def offset(share: float) -> int:
        return n - _walk_back(activity[last:][::-1], activity[:0], floor * contrast**share, quiet)

    start, stop = onset(spec.onset_at), offset(spec.offset_at)
    if (stop - start) * period_s < spec.least_s:
        return replace(nothing, why="only a knock")
    # An edge is sharp if its row hardly depends on the threshold.
    loose = [onset(spec.onset_at + d) for d in (-0.15, 0.1)], [offset(spec.offset_at + d) for d in (-0.1, 0.1)]
    spread = [period_s * (max(at, *moved) - min(at, *moved)) for at, moved in zip((start, stop), loose, strict=True)]
    trust = min(1.0, max(0.0, np.log(contrast / spec.least_contrast) / np.log(20.0 / spec.least_contrast)))
    reasons = {"it moves already at the first row": start == 0, "it moves still at the last row": stop == n}
    return Suggestion(
        start,
        stop,
        start > 0,
        stop < n,
        round(float(trust * np.exp(-spread[0] / 0.5)), 2) if start > 0 else 0.0,
        round(float(trust * np.exp(-spread[1] / 0.5)), 2) if stop < n else 0.0,
        contrast,
        "; ".join(text for text, applies in reasons.items() if applies),
    )


def _activity(
    frames: Frames, layout: Layout, before: Frames | None, period_s: float, spec: OnsetSpec
) -> tuple[Floats, Floats, float]:
    """Return the activity before and in the recording, (k,) and (n,), as multiples of the noise, and that at rest."""
    values = frames.values
    past = _unbroken(before, frames, layout, period_s) if before is not None else values[:0]
    k = len(past) if len(past) * period_s >= spec.stretch_s else 0
    if k:
        values = np.concatenate([past, values])
    smooth = _mean(_median3(_valid(values, layout)), max(1, round(spec.smooth_s / period_s)))
    n, half = len(smooth), max(1, round(spec.half_s / period_s))
    at = np.arange(n)
    ahead, behind = np.minimum(at + half, n - 1), np.maximum(at - half, 0)
    # The span is shorter at the edges: scale the change accordingly.
    change = (smooth[ahead] - smooth[behind]) * (2 * half / (ahead - behind))[:, None]
    speed = np.stack([np.sqrt((change[:, s] ** 2).mean(axis=1)) for s in _sensors(layout)], axis=1)
    calm = _quietest((speed / np.maximum(np.median(speed, axis=0), 0.5)).mean(axis=1), spec.stretch_s / period_s)
    # Movement in the countdown must not count as noise.
    quiet = np.median(speed[calm], axis=0)
    noise = np.minimum(np.median(speed[:k], axis=0), spec.noise_factor * quiet) if k else quiet
    # The noise is at least half a count, the resolution of an integer sensor.
    parts = [speed / np.maximum(noise, 0.5)]
    contact = [i for i, c in enumerate(layout.channels) if c.kind in _CONTACT]
    if contact:
        parts.append(_off_level(smooth[:, contact], parts[0].mean(axis=1), k, calm, period_s, spec))
    activity = np.concatenate(parts, axis=1).max(axis=1)
    still = float(np.median(activity[calm]))
    floor = min(float(np.median(activity[:k])), spec.noise_factor * still) if k else still
    return activity[:k], activity[k:], max(floor, 0.3)


def _off_level(x: Floats, busy: Floats, k: int, calm: slice, period_s: float, spec: OnsetSpec) -> Floats:
    """Return the distance of contact sensors from their level before the touch, as a multiple of their noise at rest.

    The level is measured at the calmest moment around the start, when a second hand already holds the toy.
    """
    width = max(3, round(spec.level_s / period_s))
    begin = max(0, k - round(0.7 / period_s))
    end = max(begin + width, k + min(round(1.0 / period_s), (len(x) - k) // 3))
    at = _quietest(busy[begin:end], width)
    level = np.median(x[begin + at.start : begin + at.stop], axis=0)
    rest = (x[:k] if k else x[calm])[:: max(1, width // 2)]
    wander = np.median(np.abs(np.diff(rest, axis=0)), axis=0) if len(rest) > 3 else np.ones(x.shape[1])
    return np.asarray(np.abs(x - level) / np.maximum(wander, 1.0))


def _unbroken(before: Frames, frames: Frames, layout: Layout, period_s: float) -> NDArray[np.int64]:
    """Return the last rows of ``before`` that are followed by ``frames`` without a gap or a clock reset."""
    if not len(before):
        return before.values
    steps = np.diff(np.append(before.device_ms, frames.device_ms[0]))
    breaks = np.flatnonzero((steps < 0) | (steps > max(layout.gap_ms, 3000 * period_s)))
    return before.values[int(breaks[-1]) + 1 if len(breaks) else 0 :]


def _valid(values: NDArray[np.int64], layout: Layout) -> Floats:
    """Replace invalid values by linear interpolation."""
    bad = (values < layout.valid_min_int) | (values > layout.valid_max_int)
    x = values.astype(np.float64)
    for c in np.flatnonzero(bad.any(axis=0)):
        good = np.flatnonzero(~bad[:, c])
        x[:, c] = np.interp(np.arange(len(x)), good, x[good, c]) if len(good) else 0.0
    return x


def _median3(x: Floats) -> Floats:
    """Return the running median of three rows, which removes single garbled rows."""
    around = np.stack([np.vstack([x[:1], x[:-1]]), x, np.vstack([x[1:], x[-1:]])])
    return np.asarray(np.median(around, axis=0))


def _sensors(layout: Layout) -> list[list[int]]:
    """Group channels by sensor: the axes of a vector together, every other channel alone."""
    vectors = [[layout.index(axis) for axis in vector] for vector in layout.vectors]
    taken = {i for vector in vectors for i in vector}
    return [*vectors, *([i] for i in range(layout.n_channels) if i not in taken)]


def _mean(x: Floats, width: int) -> Floats:
    """Return the centred moving mean over ``width`` rows; the edges are repeated."""
    padding = [(width // 2, width - 1 - width // 2), *[(0, 0)] * (x.ndim - 1)]
    sums = np.cumsum(np.insert(np.pad(x, padding, mode="edge"), 0, 0.0, axis=0), axis=0)
    return np.asarray((sums[width:] - sums[:-width]) / width)


def _quietest(busy: Floats, width: float) -> slice:
    """Return the stretch of ``width`` rows (at least 3) with the least activity."""
    w = min(len(busy), max(3, round(width)))
    sums = np.cumsum(np.insert(busy, 0, 0.0))
    at = int(np.argmin(sums[w:] - sums[:-w]))
    return slice(at, at + w)


def _clear(activity: Floats, threshold: float, period_s: float, spec: OnsetSpec) -> tuple[int, int]:
    """Return the first and last row of clear activity, without knocks such as the key that stops the recording."""
    hot = np.flatnonzero(activity >= threshold)
    breaks = np.flatnonzero(np.diff(hot) * period_s > spec.join_s)
    firsts, lasts = hot[np.append(0, breaks + 1)], hot[np.append(breaks, len(hot) - 1)]
    weight = np.add.reduceat(activity, np.stack([firsts, lasts + 1], 1).ravel().clip(max=len(activity) - 1))[::2]
    long_enough = (weight >= spec.least_share * weight.max()) & ((lasts - firsts + 1) * period_s >= 0.06)
    if not long_enough.any():
        long_enough = weight == weight.max()
    return int(firsts[long_enough][0]), int(lasts[long_enough][-1])


def _walk_back(activity: Floats, rest: Floats, threshold: float, quiet: int) -> int:
    """Return the last row of ``activity`` that follows ``quiet`` rows below ``threshold``; 0 if there is none.

    ``rest`` is the activity before the first row.
    """
    low = np.concatenate([rest[-quiet:], activity]) < threshold
    k = len(low) - len(activity)
    sums = np.cumsum(np.insert(low, 0, 0))
    at = np.arange(max(1, quiet - k), len(activity))
    quiet_before = np.flatnonzero(sums[at + k] - sums[at + k - quiet] == quiet)
    return int(at[quiet_before[-1]]) if len(quiet_before) else 0
