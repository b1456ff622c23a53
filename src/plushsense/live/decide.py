"""From one step's probabilities to a decision that does not flicker: smoothing by a time constant."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.tomlfile import refuse_unknown


@dataclass(frozen=True)
class DecideSpec:
    """How decisions are made.

    ``smoothing_s`` is the time constant of an exponential mean of the probabilities, in seconds: a change has
    reached 63 % after it. 0 switches it off.
    """

    smoothing_s: float = 0.3

    def __post_init__(self) -> None:
        value = self.smoothing_s
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 60.0:
            raise ConfigError(f"smoothing_s is {value!r}; accepted are 0 (off) to 60 seconds.")

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> DecideSpec:
        """A spec from plain values (a bundle, a configuration file); what is left out keeps its default.

        Raises:
            ConfigError: for an unknown key or a value out of range.
        """
        refuse_unknown(dict(table), cls.__dataclass_fields__, "decision settings", ConfigError)
        return cls(**table)


class Smoother:
    """Exponential mean of probabilities (K,) that come every ``step_s`` seconds; the first one starts it."""

    def __init__(self, spec: DecideSpec, step_s: float) -> None:
        self.weight = 1.0 if spec.smoothing_s == 0 else -math.expm1(-step_s / spec.smoothing_s)
        self._mean: NDArray[np.float64] | None = None

    def update(self, probabilities: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take one step's probabilities in; the smoothed ones, which again sum to 1."""
        mean = self._mean
        self._mean = probabilities if mean is None else mean + self.weight * (probabilities - mean)
        return self._mean

    def reset(self) -> None:
        """Forget the past: after a restart."""
        self._mean = None
