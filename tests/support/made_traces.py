"""Streams that a network is said to have answered: logits, samples and suspect samples as a test wants them."""

from __future__ import annotations

import numpy as np

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.models.arch import Arch
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.trace import Part, Trace

GESTURES = GestureSet(
    "touches",
    (
        Gesture("Rest", "neutral", idle=True),
        Gesture("Hug", "positive", "Hold"),
        Gesture("Squeeze", "positive", "Hold"),
        Gesture("Hit", "negative", energetic=True),
    ),
)
REST, HUG, SQUEEZE, HIT = range(4)
ARCH = Arch.parse("5d1_4d3", (6, 5), channels=3, classes=4, padding="stream", window=48, step=5)
STEP_S = 0.05


def made_trace(logits: list[np.ndarray], inputs: np.ndarray | None = None, suspect: tuple[int, ...] = ()) -> Trace:
    """A stream that a network answered with ``logits``, a part each; one of None is too short for any answer."""
    parts, now = [], 0
    for rows in logits:
        n = len(rows)
        samples = ARCH.span + ARCH.step * (n - 1) + 3 if n else ARCH.span - 6
        values = np.zeros((samples, 3), dtype=np.int64) if inputs is None else inputs[:samples]
        doubt = np.zeros(samples, dtype=np.bool_)
        doubt[[at for at in suspect if at < samples]] = True
        parts.append(Part(now, now + (samples - 1) * 10_000 + 3_000, values, doubt, rows.astype(np.int64)))
        now += samples * 10_000 + 500_000
    return Trace(ARCH, 10_000, GESTURES, 0, tuple(parts), 0)


GATE = GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=40),), (Rule((Term(0, 40),), 3, HIT, deaf=9),))
