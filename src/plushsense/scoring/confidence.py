"""Confidence of answers: its measures, the risk-coverage curve, and how well it tells known from unknown gestures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput

Floats = NDArray[np.float64]


def confidences(logits: ArrayLike, smoothed: ArrayLike, known: ArrayLike, sure: float) -> dict[str, Floats]:
    """Compute several confidence measures of n answers, (n,) each, by name; higher is more confident.

    Args:
        logits: (n, K) logits, not smoothed.
        smoothed: (n, K) smoothed probabilities.
        known: (n,) smoothed known scores (`plushsense.runtime.fixed.known_score`).
        sure: threshold on smoothed probabilities for the conformal set, whose size is a measure; empty is lowest.
    """
    z = np.asarray(logits, dtype=np.float64)
    p = np.asarray(smoothed, dtype=np.float64)
    peak = z.max(axis=1)
    energy = peak + np.log(np.exp(z - peak[:, None]).sum(axis=1))
    two = np.sort(p, axis=1)[:, -2:]
    size = (p >= sure).sum(axis=1)
    return {
        "softmax": np.exp(peak - energy),
        "softmax, smoothed": two[:, 1].copy(),
        "margin, smoothed": two[:, 1] - two[:, 0],
        "set size": -np.where(size == 0, p.shape[1] + 1, size).astype(np.float64),
        "logit": peak,
        "known score": peak - np.sort(z, axis=1)[:, -min(3, z.shape[1])],
        "known score, smoothed": np.array(known, dtype=np.float64),
        "energy": energy,
    }


@dataclass(frozen=True)
class RelativeMahalanobis:
    """Score of how typical features (N, F) are of the training classes, by the relative Mahalanobis distance.

    It is the squared Mahalanobis distance from the mean of all training features, less that from the nearest
    class mean, with the covariance within classes; higher is more typical. Ren et al. 2021, *A Simple Fix to
    Mahalanobis Distance for Improving Near-OOD Detection*, arXiv 2106.09022.

    Attributes:
        means: (K', F) means of the classes that occur; ``mean`` (F,) is that of all features.
        within, whole: (F, F) inverse covariances within classes and of all features.
    """

    means: Floats
    mean: Floats
    within: Floats
    whole: Floats

    @classmethod
    def fit(cls, features: Floats, y: NDArray[np.int64]) -> RelativeMahalanobis:
        """Estimate means and covariances; a hundredth of the mean variance is added to each variance."""
        labels, place = np.unique(y, return_inverse=True)
        means = np.stack([features[y == label].mean(axis=0) for label in labels])
        within, whole = (np.atleast_2d(np.cov(x.T)) for x in (features - means[place], features))
        ridge = max(0.01 * float(np.trace(within)) / len(within), 1e-9) * np.eye(len(within))
        inverses = (np.asarray(np.linalg.inv(matrix + ridge), dtype=np.float64) for matrix in (within, whole))
        return cls(means, features.mean(axis=0), *inverses)

    def scores(self, features: Floats) -> Floats:
        """Return the score (N,) of each row."""
        nearest = np.min([_quadratic(features - mean, self.within) for mean in self.means], axis=0)
        return np.asarray(_quadratic(features - self.mean, self.whole) - nearest)


def _quadratic(x: Floats, matrix: Floats) -> Floats:
    return np.asarray(np.einsum("nf,fg,ng->n", x, matrix, x))


@dataclass(frozen=True)
class RiskCoverage:
    """Risk-coverage curve: error rate ``risk`` (n,) of the share ``coverage`` (n,) of the most confident answers.

    ``area`` is the area under the curve (AURC), ``oracle`` that of a perfect confidence, ``random`` of a random one.
    """

    coverage: Floats
    risk: Floats
    area: float
    oracle: float
    random: float

    @property
    def gain(self) -> float:
        """Gain over a random confidence, as a share of the oracle's gain; NaN if the oracle gains nothing."""
        return (self.random - self.area) / (self.random - self.oracle) if self.random > self.oracle else float("nan")

    def coverage_at(self, risk: float) -> float:
        """Return the largest coverage with at most this risk; 0 if there is none."""
        fits = np.flatnonzero(self.risk <= risk + 1e-12)
        return float(self.coverage[fits[-1]]) if len(fits) else 0.0


def risk_coverage(confidence: ArrayLike, right: ArrayLike) -> RiskCoverage:
    """Compute the risk-coverage curve of n answers from their ``confidence`` and whether each is ``right``.

    The area is the mean of the risk over the coverages 1/n to 1 (Geifman, Uziel and El-Yaniv 2019).
    """
    sure, good = np.asarray(confidence, dtype=np.float64), np.asarray(right, dtype=bool)
    if sure.shape != good.shape or sure.ndim != 1 or not len(sure) or np.isnan(sure).any():
        raise BadInput(f"A risk-coverage curve needs a confidence for each answer: {sure.shape} for {good.shape}.")
    n = len(sure)
    risk = _wrong(sure, good) / np.arange(1, n + 1)
    best = _wrong(good.astype(np.float64), good) / np.arange(1, n + 1)
    return RiskCoverage(np.arange(1, n + 1) / n, risk, float(risk.mean()), float(best.mean()), float((~good).mean()))


def _wrong(sure: Floats, good: NDArray[np.bool_]) -> Floats:
    """Return the expected number of errors (n,) in the 1 to n most confident answers, over all orders of ties."""
    order = np.argsort(-sure)
    ranked, wrong = sure[order], (~good[order]).astype(np.float64)
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    sizes = np.diff(np.append(starts, len(ranked)))
    each = np.add.reduceat(wrong, starts) / sizes
    return np.cumsum(np.repeat(each, sizes))


def auroc(known: ArrayLike, unknown: ArrayLike) -> float:
    """Return the probability that a score in ``known`` is above one in ``unknown``, ties half; NaN if one is empty."""
    a, b = np.asarray(known, dtype=np.float64), np.sort(np.asarray(unknown, dtype=np.float64))
    if not len(a) or not len(b):
        return float("nan")
    below, upto = np.searchsorted(b, a, side="left"), np.searchsorted(b, a, side="right")
    return float((below + upto).mean() / (2 * len(b)))
