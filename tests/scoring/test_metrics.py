"""Scores: against counts by hand and against scikit-learn where it is installed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.scoring import metrics

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
    assert found["mean"] == pytest.approx(values.mean())
    assert found["sd"] == pytest.approx(values.std(ddof=1))
    half = 1.96 * values.std() / np.sqrt(27)
    assert found["ci95"] == pytest.approx([values.mean() - half, values.mean() + half], abs=0.006)
    assert found == metrics.summary(values)


def test_summary_of_one_or_no_value_fits_json() -> None:
    assert metrics.summary([0.5]) == {"mean": 0.5, "sd": None, "ci95": None}
    assert metrics.summary([float("nan")]) == {"mean": None, "sd": None, "ci95": None}
    assert metrics.summary([0.5, float("nan")])["mean"] == 0.5
    json.dumps(metrics.summary([0.1, 0.2]), allow_nan=False)
