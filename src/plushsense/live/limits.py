"""What sensors show while people touch the toy: the limits beyond which they are not believed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.store import Dataset
from plushsense.models.health import MOST_MS, HealthPlan

_MARGIN = 0.1  # of what people showed
_SAFETY = 2  # nothing seen may last longer than this part of what makes a fault
_STILL_MS = 500
_STILL_MOST_MS = 10_000
_INT32 = -(1 << 31), (1 << 31) - 1

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class HealthFit:
    """``plan`` with limits from data; ``widened`` names channels whose people reach their end stop, so that a sensor
    that hangs there is only noticed when all of them do; ``still_ms`` the longest stretch of frames that repeat."""

    plan: HealthPlan
    frames: int
    seconds: float
    widened: tuple[str, ...]
    still_ms: int


def frames_of(dataset: Dataset, subjects: Iterable[str]) -> Iterator[Frames]:
    """The streams of some people; of those who have none, their recordings."""
    people = set(subjects)
    streams = [s for s in dataset.streams if s.subject in people]
    with_stream = {s.subject for s in streams}
    for stream in streams:
        yield dataset.read_stream(stream.id)
    for recording in dataset.used:
        if recording.subject in people - with_stream:
            yield dataset.read(recording)


def fit_health(dataset: Dataset, subjects: Iterable[str], plan: HealthPlan | None = None) -> HealthFit:
    """Limits with which the sensors of ``subjects`` are never at fault.

    A channel's limits are the lowest and the highest valid value that anybody showed, and a tenth of the range between
    further out, for people who touch harder. Where that is no longer within what the sensor can send, people reach its
    end stop, and the limit is one step inside what they showed: touch stays there for a frame or two, a broken sensor
    for good. Where somebody's values repeated beyond them for half of ``fault_ms``, they are moved to hold them.
    ``still_ms`` is twice the longest time in which every channel repeated, at least 500 ms; when that is more than
    10 s, the toy really is still, and the rule is off.

    Args:
        plan: the times to keep (``fault_ms``, ``recover_ms``); the defaults when left out.
    """
    plan = plan or HealthPlan()
    layout = dataset.layout
    parts = [f for f in frames_of(dataset, subjects) if len(f)]
    if not parts:
        return HealthFit(plan, 0, 0.0, (), 0)
    values = np.concatenate([f.values for f in parts])
    valid = np.stack([np.maximum(layout.valid_min_int, _INT32[0]), np.minimum(layout.valid_max_int, _INT32[1])])
    valid = valid.astype(np.int64)
    low, high = (edge.copy() for edge in valid)
    for c in range(values.shape[1]):
        mine = values[:, c]
        mine = mine[(mine >= valid[0, c]) & (mine <= valid[1, c])]
        if len(mine):
            first, last = int(mine.min()), int(mine.max())
            margin = int(np.ceil(_MARGIN * (last - first)))
            inside = 1 if last - first > 1 else 0
            low[c] = first - margin if first - margin > valid[0, c] else first + inside
            high[c] = last + margin if last + margin < valid[1, c] else last - inside
    usual = low.copy(), high.copy()
    for frames in parts:
        for rows, wrong in _held(frames, usual, valid, plan.fault_ms / _SAFETY, layout.gap_ms):
            low = np.minimum(low, np.where(wrong, rows, low).min(axis=0))
            high = np.maximum(high, np.where(wrong, rows, high).max(axis=0))
    moved = (low != usual[0]) | (high != usual[1])
    widened = [name for name, other in zip(layout.names, moved.tolist(), strict=True) if other]
    still = max(_longest(f.device_ms, _repeats(f.values, f.device_ms, layout.gap_ms)) for f in parts)
    still_ms = max(_STILL_MS, _SAFETY * still)
    fitted = replace(
        plan,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        still_ms=still_ms if still_ms <= min(_STILL_MOST_MS, MOST_MS) else 0,
    )
    return HealthFit(fitted, len(values), _seconds(parts, layout), tuple(widened), still)


def _seconds(parts: Iterable[Frames], layout: Layout) -> float:
    steps = [np.diff(f.device_ms) for f in parts]
    return float(sum(int(s[(s > 0) & (s <= layout.gap_ms)].sum()) for s in steps)) / 1000


def _repeats(values: NDArray[np.int64], ms: NDArray[np.int64], gap_ms: int) -> Bools:
    """(T,) frames that repeat the one before in every channel of ``values``; none over a gap or a reset."""
    out = np.zeros(len(values), dtype=bool)
    step = np.diff(ms)
    out[1:] = (values[1:] == values[:-1]).all(axis=1) & (step >= 0) & (step <= gap_ms)
    return out


def _runs(at: Bools) -> list[tuple[int, int]]:
    """(first, last) of every stretch of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _longest(ms: NDArray[np.int64], repeats: Bools) -> int:
    """The longest time of a stretch of repeats, counted from the frame that they repeat."""
    return max((int(ms[b] - ms[a - 1]) for a, b in _runs(repeats)), default=0)


def _held(
    frames: Frames, usual: tuple[Ints, Ints], valid: Ints, longest_ms: float, gap_ms: int
) -> Iterator[tuple[Ints, NDArray[np.bool_]]]:
    """The frames (n, C) of each stretch of ``longest_ms`` with some channel wrong all along, and where in them
    a channel repeated a valid value beyond the ``usual``."""
    x, ms = frames.values, frames.device_ms
    step = np.diff(ms, prepend=ms[:1])
    invalid = (x < valid[0]) | (x > valid[1])
    again = np.zeros(x.shape, dtype=bool)
    again[1:] = (x[1:] == x[:-1]) & ((step[1:] >= 0) & (step[1:] <= gap_ms))[:, None]
    beyond = again & ((x < usual[0]) | (x > usual[1])) & ~invalid
    for a, b in _runs((invalid | beyond).any(axis=1)):
        if ms[b] - ms[a] >= longest_ms:
            yield x[a : b + 1], beyond[a : b + 1]
