"""Abstaining's figures against cases computed by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.scoring.confidence import RelativeMahalanobis, auroc, confidences, risk_coverage


def test_a_curve_by_hand():
    # From the surest: right, wrong, right, wrong.
    curve = risk_coverage([0.9, 0.2, 0.8, 0.4], [True, False, False, True])
    assert curve.coverage.tolist() == [0.25, 0.5, 0.75, 1.0]
    assert curve.risk.tolist() == pytest.approx([0, 1 / 2, 1 / 3, 2 / 4])
    assert curve.area == pytest.approx((0 + 1 / 2 + 1 / 3 + 1 / 2) / 4)
    assert curve.oracle == pytest.approx((0 + 0 + 1 / 3 + 2 / 4) / 4)
    assert curve.random == 0.5
    assert curve.gain == pytest.approx((0.5 - curve.area) / (0.5 - curve.oracle))
    assert [curve.coverage_at(r) for r in (0.0, 0.34, 0.5)] == [0.25, 0.75, 1.0]
    assert risk_coverage([2, 1], [False, True]).coverage_at(0.1) == 0.0


def test_the_oracle_gains_all_its_contrary_less_than_nothing_and_what_says_nothing_nothing():
    right = np.array([True] * 6 + [False] * 4)
    assert risk_coverage(right, right).gain == pytest.approx(1.0)
    assert risk_coverage(~right, right).gain < 0
    for order in (right, right[::-1]):
        assert risk_coverage(np.ones(10), order).gain == pytest.approx(0.0)


def test_equal_confidences_are_the_mean_over_their_orders():
    sure, right = np.array([3, 2, 2, 2, 1]), np.array([False, True, False, True, True])
    areas = []
    for order in itertools.permutations(range(1, 4)):
        own = [0, *order, 4]
        areas.append(risk_coverage([5, 4, 3, 2, 1], right[own]).area)
    assert risk_coverage(sure, right).area == pytest.approx(np.mean(areas))


def test_all_right_has_nothing_to_gain():
    assert np.isnan(risk_coverage([1, 2], [True, True]).gain)
    assert np.isnan(risk_coverage([1, 2], [False, False]).gain)


@pytest.mark.parametrize(("sure", "right"), [([], []), ([1], [True, False]), ([np.nan], [True]), ([[1]], [[True]])])
def test_what_is_no_curve_is_refused(sure, right):
    with pytest.raises(BadInput, match="confidence"):
        risk_coverage(sure, right)


def test_auroc_by_hand():
    # Pairs: 3 > 1, 3 > 2, 2 > 1, 2 = 2, 0 < both: 3.5 of 6.
    assert auroc([3, 2, 0], [1, 2]) == pytest.approx(3.5 / 6)
    assert auroc([2, 3], [0, 1]) == 1.0
    assert auroc([1, 1], [1]) == 0.5
    assert np.isnan(auroc([], [1])) and np.isnan(auroc([1], []))


def test_confidences_by_hand():
    logits = np.log([[2.0, 1.0, 1.0], [6.0, 3.0, 1.0]])
    found = confidences(logits, [[0.5, 0.3, 0.2], [0.2, 0.1, 0.7]], [7.0, 8.0], 0.25)
    assert found["softmax"] == pytest.approx([0.5, 0.6])
    assert found["softmax, smoothed"] == pytest.approx([0.5, 0.7])
    assert found["margin, smoothed"] == pytest.approx([0.2, 0.5])
    assert found["set size"].tolist() == [-2, -1]
    assert found["logit"] == pytest.approx(np.log([2, 6]))
    assert found["known score, smoothed"].tolist() == [7, 8]
    assert found["known score"] == pytest.approx(np.log([2, 6]))
    assert found["energy"] == pytest.approx(np.log([4, 10]))
    assert confidences(logits, [[0.5, 0.25, 0.25]] * 2, [7.0, 8.0], 0.25)["set size"].tolist() == [-3, -3]
    empty = confidences(logits, [[0.5, 0.3, 0.2], [0.2, 0.1, 0.7]], [7.0, 8.0], 0.6)
    assert empty["set size"].tolist() == [-4, -1]


def test_typical_features_by_hand() -> None:
    # One feature: the classes have the means 0 and 10, and within them squares that sum to 4, over all to 104.
    fitted = RelativeMahalanobis.fit(np.array([[-1.0], [1.0], [9.0], [11.0]]), np.array([0, 0, 1, 1]))
    ridge = 0.01 * 4 / 3
    for x in (-2.0, 3.0, 5.0, 12.0):
        expected = (x - 5) ** 2 / (104 / 3 + ridge) - min(x**2, (x - 10) ** 2) / (4 / 3 + ridge)
        assert fitted.scores(np.array([[x]])) == pytest.approx([expected])


def test_typical_features_lie_near_a_class_and_not_merely_near_the_mean() -> None:
    draw = np.random.default_rng(0)
    y = np.repeat([0, 2], 300)
    centres = np.array([[4.0, 0.0, 0.0], [np.nan] * 3, [-4.0, 0.0, 0.0]])
    fitted = RelativeMahalanobis.fit(centres[y] + draw.normal(0, [1, 1, 5], (600, 3)), y)
    at_class, between, aside = fitted.scores(np.array([[4.0, 0, 0], [0.0, 0, 0], [4.0, 0, 40]])).tolist()
    assert at_class > between
    # A direction in which the classes vary as much as everything does says nothing.
    assert abs(at_class - aside) < 0.5 * (at_class - between)
    one = RelativeMahalanobis.fit(np.ones((5, 2)), np.zeros(5, dtype=np.int64))
    assert np.isfinite(one.scores(np.zeros((2, 2)))).all()
