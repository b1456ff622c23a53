"""Temperature of a network's probabilities: the number that divides its logits, so that its confidence is justified.

A network is surer of people whose recordings it was trained on than of others. Dividing all logits by one temperature
(Guo et al. 2017) changes no answer, only how sure it is, and needs no code in the toy: it is part of the dense layer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT

Floats = NDArray[np.float64]

_LEAST = 1e-38  # probability; float32 has no smaller one with all its digits
_MOST_LOG = 2.0
_REFINED = 3  # searches, each ten times as fine as the one before

TEMPERATURES = (float(np.exp(-_MOST_LOG)), float(np.exp(_MOST_LOG)))
"""The lowest and the highest temperature, 0.14 and 7.4."""


def check_temperature(value: float) -> None:
    """Raise ConfigError for a temperature outside `TEMPERATURES`."""
    low, high = TEMPERATURES
    if not low <= value <= high:
        raise ConfigError(f"The temperature is {value:g}: accepted are {low:.2f} to {high:.1f}; evaluate proposes one.")


def fit_temperature(
    probabilities: NDArray[np.floating[Any]], truth: NDArray[np.int64], person: NDArray[np.str_]
) -> float:
    """Fit a temperature to what a network answered to people whom it was not trained on.

    It minimises the mean negative log-likelihood of each person's windows, summed over people, with a standard normal
    prior of the temperature's logarithm. Ten people outweigh the prior; one or two hardly do, and should not: people
    differ so much that their own temperature is often worse for others than none.

    Args:
        probabilities: of the classes, (N, K).
        truth, person: class index and person of each window, (N,); windows of nobody do not count.

    Returns:
        a temperature within `TEMPERATURES`; 1 without people.
    """
    people = sorted(set(person.tolist()) - {NOBODY, UNKNOWN_SUBJECT})
    parts = [(_logarithms(probabilities[person == who]), truth[person == who]) for who in people]
    best = 0.0
    for step in (_MOST_LOG / 10 * 0.1**n for n in range(_REFINED if parts else 0)):
        tried = best + step * np.arange(-10, 11)
        best = float(tried[np.argmin([_loss(parts, value) for value in tried])])
    return float(np.exp(np.clip(best, -_MOST_LOG, _MOST_LOG)))


def _loss(parts: list[tuple[Floats, NDArray[np.int64]]], log_temperature: float) -> float:
    losses = [-_normalised(p / np.exp(log_temperature))[np.arange(len(y)), y].mean() for p, y in parts]
    return float(sum(losses) + 0.5 * log_temperature**2)


def _logarithms(probabilities: NDArray[np.floating[Any]]) -> Floats:
    return np.log(np.maximum(probabilities.astype(np.float64), _LEAST))


def _normalised(logits: Floats) -> Floats:
    """Return the logarithms of the softmax of logits (N, K)."""
    shifted = logits - logits.max(axis=1, keepdims=True)
    return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True)))


def tempered(probabilities: NDArray[np.floating[Any]], temperature: float) -> NDArray[np.float32]:
    """Return the probabilities (N, K) that a network has whose logits are divided by ``temperature``."""
    if temperature == 1.0:
        return probabilities.astype(np.float32)
    return np.exp(_normalised(_logarithms(probabilities) / temperature)).astype(np.float32)
