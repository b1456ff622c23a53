"""Scores: against counts by hand and against scikit-learn where it is installed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.scoring import metrics

pytestmark = pytest.mark.apart("reidentification")

# Truth in rows: class 2 is never there but once read; class 3 is there and never read.
COUNTS = np.array([[8, 2, 0, 0], [1, 5, 1, 0], [0, 0, 0, 0], [2, 1, 0, 0]])


def test_confusion_counts_truth_in_rows() -> None:
    truth, read = np.array([0, 0, 1, 2]), np.array([0, 1, 1, 0])
    assert metrics.confusion(truth, read, 3).tolist() == [[1, 1, 0], [0, 1, 0], [1, 0, 0]]
    with pytest.raises(BadInput, match="prediction is out of range"):
        metrics.confusion(truth, read + 5, 3)


def test_figures_by_hand() -> None:
    assert metrics.accuracy(COUNTS) == pytest.approx(13 / 20)
    assert metrics.macro_recall(COUNTS) == pytest.approx((8 / 10 + 5 / 7 + 0) / 3)
    f1 = [16 / 21, 10 / 15, 0.0]
    assert metrics.macro_f1(COUNTS) == pytest.approx(sum(f1) / 3)
    assert metrics.macro_f1(COUNTS, all_classes=True) == pytest.approx(sum(f1) / 4)
    by_class = metrics.class_scores(COUNTS)
    assert by_class.precision == pytest.approx([8 / 11, 5 / 8, 0, 0])
    assert by_class.support.tolist() == [10, 7, 0, 3]


def test_figures_agree_with_scikit_learn() -> None:
    sklearn = pytest.importorskip("sklearn.metrics", reason="scikit-learn is not installed (extra baselines)")
    rng = np.random.default_rng(3)
    truth = rng.integers(0, 5, 300)
    read = np.where(rng.random(300) < 0.6, truth, rng.integers(0, 5, 300))
    counts = metrics.confusion(truth, read, 7)
    assert metrics.macro_f1(counts) == pytest.approx(sklearn.f1_score(truth, read, average="macro"))
    assert metrics.macro_recall(counts) == pytest.approx(sklearn.balanced_accuracy_score(truth, read))
    every = sklearn.f1_score(truth, read, average="macro", labels=range(7), zero_division=0)
    assert metrics.macro_f1(counts, all_classes=True) == pytest.approx(every)


def test_without_any_window_there_is_no_figure() -> None:
    nothing = np.zeros((3, 3), dtype=np.int64)
    figures = (metrics.accuracy(nothing), metrics.macro_recall(nothing), metrics.macro_f1(nothing))
    assert np.isnan(figures).all()
    assert np.isnan(metrics.macro_f1(nothing, all_classes=True))


def test_groups_add_up_their_classes() -> None:
    names, counts = metrics.grouped(COUNTS, ("neutral", "positive", "positive", "negative"))
    assert names == ("neutral", "positive", "negative")
    assert counts.tolist() == [[8, 2, 0], [1, 6, 0], [2, 1, 0]]


def test_a_recording_is_what_its_windows_say_on_average() -> None:
    probabilities = np.array([[0.6, 0.4], [0.1, 0.9], [0.9, 0.1], [0.6, 0.4]], dtype=np.float32)
    ids, read = metrics.vote(probabilities, np.array([7, 7, 3, 7]))
    assert ids.tolist() == [3, 7]
    # Two of three windows say 0, but together they weigh less.
    assert read.tolist() == [0, 1]


def test_summary_is_mean_sd_and_a_bootstrap_interval() -> None:
    values = np.random.default_rng(1).normal(0.6, 0.1, 27)
    found = metrics.summary(values)
    assert found.mean == pytest.approx(values.mean())
    assert found.sd == pytest.approx(values.std(ddof=1))
    half = 1.96 * values.std() / np.sqrt(27)
    assert found.ci95 == pytest.approx([values.mean() - half, values.mean() + half], abs=0.006)
    assert found == metrics.summary(values)


def test_summary_of_one_or_no_value_fits_json() -> None:
    assert metrics.summary([0.5]) == (0.5, None, None)
    assert metrics.summary([float("nan")]) == (None, None, None)
    assert metrics.summary([0.5, float("nan")]).mean == 0.5
    json.dumps(metrics.summary([0.1, 0.2]).to_json(), allow_nan=False)


def test_accuracy_over_people_counts_each_person_alike_and_nobody_not() -> None:
    truth, read = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 0, 1, 1, 0, 2])
    subject = np.array(["P1", "P1", "P1", "P1", "P2", "none"])
    assert metrics.accuracy_over_people(truth, read, subject) == pytest.approx((3 / 4 + 0) / 2)
    assert metrics.accuracy_over_people(truth, read, np.full(6, "none")) is None


def test_calibration_error_by_hand() -> None:
    p = np.array([[0.95, 0.05], [0.95, 0.05], [0.65, 0.35], [0.35, 0.65], [1.0, 0.0]])
    # Of the highest bin, two predictions at 0.95 and one at 1.0, two are right; of two at 0.65, both.
    error = metrics.calibration_error(p, np.array([0, 1, 0, 1, 0]))
    assert error == pytest.approx((abs(2.9 - 2) + 2 * 0.35) / 5)
    assert np.isnan(metrics.calibration_error(p[:0], np.zeros(0, np.int64)))


def test_the_interval_of_the_calibration_error_is_over_people() -> None:
    # One person is always right, one never, at the same confidence: the error depends on whom a resample has.
    p = np.full((20, 2), [0.6, 0.4])
    truth, person = np.repeat([0, 1], 10), np.repeat(["P1", "P2"], 10)
    assert metrics.calibration_error(p, truth) == pytest.approx(0.1)
    low, high = metrics.calibration_interval(p, truth, person)
    assert (low, high) == (pytest.approx(0.1), pytest.approx(0.6))
    assert metrics.calibration_interval(p[:10], truth[:10], person[:10]) is None


def test_a_class_index_below_0_is_refused_and_the_highest_accepted() -> None:
    top, low = np.array([2]), np.array([-1])
    assert metrics.confusion(top, top, 3)[2, 2] == 1
    assert metrics.confusion(top[:0], top[:0], 3).sum() == 0
    with pytest.raises(BadInput, match="truth is out of range: accepted are 0 to 2"):
        metrics.confusion(low, top, 3)
    with pytest.raises(BadInput, match="truth is out of range"):
        metrics.confusion(np.array([3]), top, 3)


def test_rows_and_scores_by_key() -> None:
    rows = metrics.class_results(COUNTS, "abcd")
    assert rows[1] == ("b", 5 / 8, 5 / 7, pytest.approx(10 / 15), 7)
    assert [row.label for row in rows] == ["a", "b", "c", "d"]
    scores = metrics.scores_of(COUNTS)
    assert scores == {key: metric.function(COUNTS) for key, metric in metrics.METRICS.items()}
    assert scores["accuracy"] == metrics.accuracy(COUNTS)
    assert metrics.macro_recall(COUNTS, all_classes=True) == pytest.approx((8 / 10 + 5 / 7) / 4)
    assert np.isnan(metrics.macro_recall(COUNTS * 0, all_classes=True))
    assert metrics.METRICS["macro_f1"].title == "Macro-F1"
    assert {"accuracy", "macro_f1"} <= metrics.column_metrics().keys() <= metrics.METRICS.keys()


def test_the_pareto_front_keeps_equal_rows_and_those_that_nothing_beats() -> None:
    rows = [(0.9, 10.0, 5.0), (0.9, 10.0, 5.0), (0.8, 10.0, 5.0), (0.5, 9.0, 5.0), (0.9, 10.0, 6.0), (0.95, 20.0, 9.0)]
    assert metrics.pareto_front(rows) == [True, True, False, True, False, True]


def test_accuracy_by_the_logarithm_of_the_parameters() -> None:
    assert metrics.accuracy_complexity_ratio(0.75, 10_000) == pytest.approx(0.1875)
    assert metrics.accuracy_complexity_ratio(0.5, 2) == pytest.approx(0.5 / np.log10(2))
    assert metrics.accuracy_complexity_ratio(0.5, 1) is None
    assert metrics.accuracy_complexity_ratio(None, 100) is None
