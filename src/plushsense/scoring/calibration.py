"""Calibration of probabilities: reliability table, expected calibration error, temperature."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput

BINS = 10
_TEMPERATURES = np.geomspace(0.2, 10.0, 118)
_TINY = 1e-7

Floats = NDArray[np.float64]


def reliability(probabilities: ArrayLike, truth: NDArray[np.int64], bins: int = BINS) -> dict[str, Any]:
    """Compute how far the highest probability of predictions (n, K) is from the share of correct ones.

    Returns:
        ``ece``, the expected calibration error: the difference of confidence and accuracy, averaged over bins of equal
        width by their predictions (Guo et al. 2017); ``confidence`` and ``accuracy``, the means; ``log_loss`` in nats;
        ``bins``: {low, high, n, confidence, accuracy} of each, the last two None in an empty bin.

    Raises:
        BadInput: without predictions.
    """
    p = np.asarray(probabilities, dtype=np.float64)
    if not len(p):
        raise BadInput("Calibration needs at least one prediction.")
    confidence, right = p.max(axis=1), p.argmax(axis=1) == truth
    place = np.minimum((confidence * bins).astype(np.int64), bins - 1)
    rows: list[dict[str, Any]] = []
    error = 0.0
    for b in range(bins):
        mine = place == b
        row: dict[str, Any] = {"low": b / bins, "high": (b + 1) / bins, "n": int(mine.sum())}
        row |= {"confidence": None, "accuracy": None}
        if mine.any():
            row |= {"confidence": float(confidence[mine].mean()), "accuracy": float(right[mine].mean())}
            error += row["n"] * abs(row["confidence"] - row["accuracy"]) / len(p)
        rows.append(row)
    return {
        "ece": error,
        "confidence": float(confidence.mean()),
        "accuracy": float(right.mean()),
        "log_loss": _log_loss(p, truth),
        "bins": rows,
    }


def with_temperature(probabilities: ArrayLike, temperature: float | Floats) -> Floats:
    """Return the probabilities (n, K) that a softmax gives if its logits are divided by ``temperature`` (or (n,))."""
    logs = np.log(np.maximum(np.asarray(probabilities, dtype=np.float64), _TINY))
    logs /= np.reshape(temperature, (-1, 1))
    p = np.exp(logs - logs.max(axis=1, keepdims=True))
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def fit_temperature(probabilities: ArrayLike, truth: NDArray[np.int64]) -> float:
    """Return the temperature from 0.2 to 10 with the smallest log loss on predictions (n, K)."""
    losses = [_log_loss(with_temperature(probabilities, float(t)), truth) for t in _TEMPERATURES]
    return float(_TEMPERATURES[int(np.argmin(losses))])


def cross_fitted_temperature(
    probabilities: ArrayLike, truth: NDArray[np.int64], group: NDArray[np.str_]
) -> tuple[Floats, dict[str, float]]:
    """Scale each group's probabilities (a person's, (n, K)) by a temperature fitted on all other groups.

    Returns:
        the scaled probabilities (n, K), and the temperature of each group.
    """
    p = np.asarray(probabilities, dtype=np.float64)
    temperatures, chosen = np.ones(len(p)), {}
    for name in np.unique(group):
        mine = group == name
        if not mine.all():
            chosen[str(name)] = fit_temperature(p[~mine], truth[~mine])
            temperatures[mine] = chosen[str(name)]
    return with_temperature(p, temperatures), chosen


def _log_loss(p: Floats, truth: NDArray[np.int64]) -> float:
    return float(-np.log(np.maximum(p[np.arange(len(p)), truth], _TINY)).mean())
