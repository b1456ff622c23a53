"""One recording while it is made, and what its sidecar says of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.devices.base import Counters, Frame
from plushsense.recording.protocol import Step
from plushsense.recording.sessionfile import FORMAT_VERSION, SessionHead

Ended = Literal["space", "auto", "longest", "toy", "cut"]
"""What ended a recording: the space bar, the recorder's own press (--auto), the protocol's longest_s, the toy's end;
or it was cut from a longer one afterwards."""


@dataclass
class Take:
    """A recording from its first row on.

    Attributes:
        row: of the session's stream, at which it begins.
        from_s: the computer's monotonic clock at its first row.
        before: the counters at that time; lines spoilt since then are this recording's.
        lost: frames that its own rows say are missing.
        gaps: see `gap_entry`.
    """

    step: Step
    row: int
    from_s: float
    before: Counters
    frames: list[Frame] = field(default_factory=list)
    lost: int = 0
    gaps: list[dict[str, Any]] = field(default_factory=list)


def gap_entry(rows: int, last: Frame, now: Frame | None, missing_ms: float, reason: str) -> dict[str, Any]:
    """A hole: after how many rows, both clocks before and after it, how long it was and why."""
    return {
        "after_row": rows,
        "device_ms": [last.device_ms, now.device_ms if now else None],
        "host_ms": [last.host_ms, now.host_ms if now else None],
        "missing_ms": round(missing_ms),
        "reason": reason,
    }


def measured_rate_hz(device_ms: Any) -> float:
    """Frames a second by the toy's clock, over the stretches without gaps; 0 where that cannot be said."""
    steps = np.diff(device_ms)
    even = steps[(steps >= 0) & (steps <= 1000)]
    return round(1000.0 * len(even) / float(even.sum()), 2) if even.sum() > 0 else 0.0


def sidecar(
    take: Take, frames: Frames, layout: Layout, head: SessionHead, counters: Counters, ended: Ended, **more: Any
) -> dict[str, Any]:
    """What stands beside a recording: whose, what, by which clocks, over which line, and what went wrong."""
    assert frames.host_ms is not None
    outside = (frames.values < layout.valid_min_int) | (frames.values > layout.valid_max_int)
    step = take.step
    return {
        "format": FORMAT_VERSION,
        "subject": head.subject,
        "session": head.session,
        "gesture": step.gesture,
        "repetition": step.repetition,
        "prompt": step.prompt,
        "protocol": head.protocol["name"],
        "words": head.protocol["words"],
        "rows": len(frames),
        "stream_row": take.row,
        "device_ms": [int(frames.device_ms[0]), int(frames.device_ms[-1])],
        "host_ms": [int(frames.host_ms[0]), int(frames.host_ms[-1])],
        "rate_hz": measured_rate_hz(frames.device_ms),
        "lost": take.lost,
        "malformed": counters.malformed - take.before.malformed,
        "garbage": int(outside.any(axis=1).sum()),
        "reconnects": counters.reconnects - take.before.reconnects,
        "gaps": take.gaps,
        "ended": ended,
        "auto_stopped": ended == "longest",
        "layout": layout.name,
        "wire": list(layout.wire),
        "device": head.device,
        "simulated": head.simulated,
    } | more
