"""Fitting the gate: which signals, terms and thresholds notice the energetic gestures of some people, and little else.

What is tried: each input's level, each input's jerk and the jerk of all inputs of a kind, at several lags and floors;
rules of one or two terms. A rule's thresholds are chosen so that on everything that is not energetic it would have
fired at most so often an hour; of the rules that then notice most, the quickest is taken. A further rule is added while
it finds energetic recordings that those before it miss.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.models.gate import GatePlan

Ints32 = NDArray[np.int32]


@dataclass(frozen=True)
class GateSpec:
    """How a gate is fitted; times in seconds.

    Attributes:
        false_alarms_per_hour: how often it may fire on what is not energetic.
        lags_s: of jerk; floors: as quantiles of a signal's deviation in all that was recorded.
        times_s: for how long a term must hold; within_s: how long it is remembered.
        deaf_s: after firing.
        rules: most rules of one affect.
        gain: a further rule must find this share of the energetic recordings, at least two.
    """

    false_alarms_per_hour: float = 1.0
    lags_s: tuple[float, ...] = (0.02, 0.05, 0.1)
    floors: tuple[float, ...] = (0.5, 0.9, 0.99)
    times_s: float = 0.02
    within_s: float = 0.05
    deaf_s: float = 0.5
    baseline_s: float = 1.28
    noise_s: float = 2.56
    rules: int = 3
    gain: float = 0.01


@dataclass(frozen=True)
class GateFit:
    """A fitted ``plan`` and, for people to read, what it was fitted on (``report``)."""

    plan: GatePlan
    report: dict[str, Any] = field(default_factory=dict)


def fit_gate(
    dataset: Dataset,
    gestures: GestureSet,
    subjects: Collection[str],
    *,
    false_alarms_per_hour: float = 1.0,
    spec: GateSpec | None = None,
) -> GateFit:
    """Fit a gate on ``subjects``' streams, and on their recordings where there is no stream.

    Args:
        gestures: the classes of the model that the gate stands beside; they say what is energetic, and its affect.
        false_alarms_per_hour: how often it may fire on all that is not energetic.

    An empty plan, with the reason in the report, where nothing energetic is to be noticed.
    """
    return GateFit(GatePlan(), {"reason": "not fitted yet"})
