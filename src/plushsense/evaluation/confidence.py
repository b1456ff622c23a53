"""How sure the networks of an evaluation are, compared with how often they are right, and whether a temperature helps.

A temperature is tried without further trainings: that of a fold is fitted to the answers of all other folds, so not to
the people who are scored in it. What is proposed for a network that is trained on everybody is fitted to all folds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import NOBODY
from plushsense.evaluation.scores import Predictions
from plushsense.scoring.metrics import calibration_error, calibration_interval
from plushsense.scoring.temperature import fit_temperature, tempered

# The error of one network differs by as much between seeds (makeability, har-phone).
_WORTH = 0.02


@dataclass(frozen=True)
class ConfidenceResult:
    """Confidence (the highest probability) and correctness over all windows of people.

    Attributes:
        mean: the mean confidence.
        error: the expected calibration error (`plushsense.scoring.metrics.calibration_error`); ``ci95`` its interval
            over people; ``error_int8`` that of the networks in 8 bits, if they were evaluated.
        temperature: for `plushsense.workflow.api.train`; None if temperatures do not clearly lower the error, and for
            a split that does not leave people out.
        error_tempered: the error with the temperature of each fold; None where none were fitted.
    """

    mean: float
    error: float
    ci95: tuple[float, float] | None
    error_int8: float | None
    temperature: float | None
    error_tempered: float | None

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {**vars(self), "ci95": None if self.ci95 is None else list(self.ci95)}


def assess_confidence(predictions: Predictions, deployed: Predictions | None, apart: bool) -> ConfidenceResult | None:
    """Compare confidence and correctness; None if no window is of a person.

    Args:
        deployed: the predictions in 8 bits, if there are any.
        apart: whether no person is in both training and test.
    """
    people = predictions.subject != NOBODY
    if not people.any():
        return None
    shares, truth, person = (
        part[people] for part in (predictions.probabilities, predictions.truth, predictions.subject)
    )
    error, temperature, error_tempered = calibration_error(shares, truth), None, None
    folds = predictions.fold[people]
    if apart and len(np.unique(folds)) > 1:
        error_tempered = calibration_error(_cross_fitted(shares, truth, person, folds), truth)
        if error_tempered <= error - _WORTH:
            temperature = fit_temperature(shares, truth, person)
    return ConfidenceResult(
        mean=float(shares.max(axis=1).mean()),
        error=error,
        ci95=calibration_interval(shares, truth, person),
        error_int8=None if deployed is None else calibration_error(deployed.probabilities[people], truth),
        temperature=temperature,
        error_tempered=error_tempered,
    )


def _cross_fitted(
    shares: NDArray[np.float32], truth: NDArray[np.int64], person: NDArray[np.str_], folds: NDArray[np.str_]
) -> NDArray[np.float32]:
    """Return the probabilities (N, K) with the temperature that is fitted to all folds but that of the window."""
    out = shares.copy()
    for fold in np.unique(folds):
        own, others = folds == fold, folds != fold
        out[own] = tempered(shares[own], fit_temperature(shares[others], truth[others], person[others]))
    return out
