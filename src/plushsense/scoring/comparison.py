"""Compare models on the same people: paired permutation tests, effect sizes, correction for several tests, ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import BadInput
from plushsense.scoring.metrics import Summary, summary

# Up to this number of pairs, all assignments of signs are counted; above it, this many are drawn.
EXACT_PAIRS = 16
DRAWS = 100_000
SEED = 20_261
LEVEL = 0.05

Floats = NDArray[np.float64]


def paired_permutation_test(differences: ArrayLike) -> float:
    """Return the two-sided p-value of a mean difference (n,) between pairs, under random exchange within each pair.

    Exact for up to 16 pairs that differ, else from 100 000 random assignments of signs with a fixed seed, where the
    observed assignment counts as one, so that the p-value is never 0.
    """
    d = np.asarray(differences, dtype=np.float64)
    d = d[d != 0]
    if not len(d):
        return 1.0
    observed = abs(d.sum()) * (1 - 1e-12)
    if len(d) <= EXACT_PAIRS:
        sums = np.zeros(1)
        for value in d:
            sums = np.concatenate([sums + value, sums - value])
        return float((np.abs(sums) >= observed).mean())
    signs = np.random.default_rng(SEED).integers(0, 2, size=(DRAWS, len(d)), dtype=np.int8) * 2 - 1
    return float((1 + (np.abs(signs @ d) >= observed).sum()) / (1 + DRAWS))


def rank_biserial(differences: ArrayLike) -> float | None:
    """Return the matched-pairs rank-biserial correlation of differences (n,), from −1 to 1; None if all are 0.

    The sum of the ranks of |d| for d > 0 minus that for d < 0, as a share of all (Kerby 2014).
    """
    d = np.asarray(differences, dtype=np.float64)
    d = d[d != 0]
    if not len(d):
        return None
    ranks = average_ranks(np.abs(d)[None])[0]
    return float((ranks * np.sign(d)).sum() / ranks.sum())


def average_ranks(values: ArrayLike) -> Floats:
    """Return the ranks (n, k) of values within each row, from 1 for the smallest; equal values share their mean."""
    table = np.asarray(values, dtype=np.float64)
    below = (table[:, None, :] < table[:, :, None]).sum(axis=2)
    equal = (table[:, None, :] == table[:, :, None]).sum(axis=2)
    return np.asarray(below + (equal + 1) / 2, dtype=np.float64)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for several tests by Holm's method, in the given order."""
    order = np.argsort(p_values, kind="stable")
    steps = np.asarray(p_values, dtype=np.float64)[order] * np.arange(len(order), 0, -1)
    adjusted = np.empty(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(p) for p in adjusted]


@dataclass(frozen=True)
class PairResult:
    """The comparison of two models on the same people.

    ``difference`` is first minus second; ``better`` and ``worse`` count people; ``p_holm`` is ``p`` corrected for all
    pairs; ``effect`` is the rank-biserial correlation.
    """

    first: str
    second: str
    difference: Summary
    better: int
    worse: int
    p: float
    effect: float | None
    p_holm: float

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {**vars(self), "difference": self.difference.to_json()}


def compare_pairs(names: Sequence[str], scores: ArrayLike) -> list[PairResult]:
    """Compare all pairs of models on scores (people, models), person by person.

    Raises:
        BadInput: for fewer than two models or people.
    """
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 2 or min(table.shape) < 2 or table.shape[1] != len(names):
        raise BadInput(f"A comparison needs the scores of at least 2 models on 2 people; got {table.shape}.")
    pairs = [(names[i], names[j], table[:, i] - table[:, j]) for i, j in combinations(range(len(names)), 2)]
    p_values = [paired_permutation_test(d) for _, _, d in pairs]
    return [
        PairResult(first, second, summary(d), int((d > 0).sum()), int((d < 0).sum()), p, rank_biserial(d), corrected)
        for (first, second, d), p, corrected in zip(pairs, p_values, holm(p_values), strict=True)
    ]


def cliques(names: Sequence[str], pairs: Sequence[PairResult]) -> list[tuple[str, ...]]:
    """Return the longest runs of neighbours in ``names`` (ordered by rank) in which no two differ significantly."""
    differ = {frozenset((pair.first, pair.second)) for pair in pairs if pair.p_holm < LEVEL}
    runs: list[tuple[str, ...]] = []
    for start in range(len(names)):
        end = start + 1
        while end < len(names) and not any(frozenset((names[end], n)) in differ for n in names[start:end]):
            end += 1
        run = tuple(names[start:end])
        if len(run) > 1 and not any(set(run) <= set(other) for other in runs):
            runs.append(run)
    return runs
