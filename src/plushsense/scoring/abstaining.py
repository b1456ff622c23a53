"""How well a model knows when it does not know: risk against coverage, and known against unknown.

A *confidence* (n,) ranks answers, the surest first. Among equal ones every order is as likely: figures are the mean
over them, so that a confidence that says nothing is as good as chance, not as good as the order of the file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput

Floats = NDArray[np.float64]


def confidences(logits: ArrayLike, smoothed: ArrayLike, highest: ArrayLike, sure: float) -> dict[str, Floats]:
    """The confidences that are compared, (n,) each.

    Args:
        logits: (n, K) of the step itself.
        smoothed: (n, K) smoothed probabilities; ``highest`` (n,) the smoothed highest logit.
        sure: the conformal threshold on smoothed probabilities; an empty set is the least sure of all.
    """
    z = np.asarray(logits, dtype=np.float64)
    p, top = np.asarray(smoothed, dtype=np.float64), np.asarray(highest, dtype=np.float64)
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
        "logit, smoothed": top.copy(),
        "energy": energy,
    }


@dataclass(frozen=True)
class RiskCoverage:
    """Of the surest answers, ``coverage`` (n,) what share of all they are, and ``risk`` (n,) the share of them that
    is wrong. ``area`` under it (AURC), ``oracle`` that of whoever knows what is wrong, ``random`` that of chance."""

    coverage: Floats
    risk: Floats
    area: float
    oracle: float
    random: float

    @property
    def gain(self) -> float:
        """Of what the oracle gains over chance, the share that the confidence gains; NaN where there is nothing to."""
        return (self.random - self.area) / (self.random - self.oracle) if self.random > self.oracle else float("nan")

    def coverage_at(self, risk: float) -> float:
        """The largest coverage at which at most this share is wrong; 0 where there is none."""
        fits = np.flatnonzero(self.risk <= risk + 1e-12)
        return float(self.coverage[fits[-1]]) if len(fits) else 0.0


def risk_coverage(confidence: ArrayLike, right: ArrayLike) -> RiskCoverage:
    """Risk against coverage of answers ``right`` (n,) or not.

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
    """(n,) how many of the k surest answers are wrong, over all orders of equal ones."""
    order = np.argsort(-sure, kind="stable")
    ranked, wrong = sure[order], (~good[order]).astype(np.float64)
    starts = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    sizes = np.diff(np.append(starts, len(ranked)))
    each = np.add.reduceat(wrong, starts) / sizes
    return np.cumsum(np.repeat(each, sizes))


def auroc(known: ArrayLike, unknown: ArrayLike) -> float:
    """The chance that something known scores higher than something unknown, equal ones half; NaN without either."""
    a, b = np.asarray(known, dtype=np.float64), np.sort(np.asarray(unknown, dtype=np.float64))
    if not len(a) or not len(b):
        return float("nan")
    below, upto = np.searchsorted(b, a, side="left"), np.searchsorted(b, a, side="right")
    return float((below + upto).mean() / (2 * len(b)))
