"""Paired tests, ranks and corrections, against values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.scoring.comparison import (
    average_ranks,
    cliques,
    compare_pairs,
    holm,
    paired_permutation_test,
    rank_biserial,
)


def test_few_pairs_are_counted_exactly() -> None:
    # Of the 32 assignments of signs, two have a sum as large as the observed one.
    assert paired_permutation_test([1, 2, 3, 4, 5]) == 2 / 32
    assert paired_permutation_test([1, 1, -1, -1]) == 1.0
    assert paired_permutation_test([0.0, 0.0]) == 1.0
    # People without a difference do not change the test.
    assert paired_permutation_test([1, 2, 3, 4, 5, 0, 0]) == 2 / 32


def test_many_pairs_are_drawn_and_never_give_zero() -> None:
    rng = np.random.default_rng(0)
    assert 0 < paired_permutation_test(np.ones(25)) < 1e-4
    assert paired_permutation_test(rng.normal(0, 1, 27) - 0.0) > 0.01
    assert paired_permutation_test(rng.normal(1, 0.5, 27)) < 0.001


def test_effect_sizes() -> None:
    assert rank_biserial([1, 2, 3]) == 1.0
    assert rank_biserial([-1, -2, -3]) == -1.0
    assert rank_biserial([3, -1, -2, 0]) == 0.0
    assert rank_biserial([0, 0]) is None


def test_ranks_share_ties() -> None:
    assert average_ranks([[10, 30, 20], [5, 5, 1]]).tolist() == [[1, 3, 2], [2.5, 2.5, 1]]


def test_holm() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_pairs_and_cliques() -> None:
    rng = np.random.default_rng(1)
    base = rng.uniform(0.3, 0.9, 20)
    scores = np.stack([base + 0.1, base + 0.1 + rng.normal(0, 0.02, 20), base], axis=1)
    pairs = compare_pairs(("A", "B", "C"), scores)
    assert [(row.first, row.second) for row in pairs] == [("A", "B"), ("A", "C"), ("B", "C")]
    assert pairs[1].difference.mean == pytest.approx(0.1) and pairs[1].better == 20
    assert pairs[1].effect == 1.0 and pairs[1].p_holm < 0.001
    assert pairs[0].p_holm > 0.05
    assert cliques(("A", "B", "C"), pairs) == [("A", "B")]
    with pytest.raises(BadInput, match="at least 2 models on 2 people"):
        compare_pairs(("A",), scores[:, :1])


def test_people_without_a_difference_are_neither_better_nor_worse() -> None:
    (row,) = compare_pairs(["a", "b"], np.array([[0.5, 0.5], [0.7, 0.6], [0.8, 0.6], [0.1, 0.4]]))
    assert (row.better, row.worse) == (2, 1)
