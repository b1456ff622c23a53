"""Abstaining's table from answers that were kept: computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.experiments.abstention import FoldAnswers, summarise

LABELS = ("a", "b", "c")


def told(fold, withheld, rows, covered=(0.8,), known=1.0):
    """``rows``: (label, person, what the network says, how high its logit is)."""
    labels = tuple(name for name in LABELS if name != withheld)
    logits = np.zeros((len(rows), len(labels)))
    for i, (_, _, said, height) in enumerate(rows):
        logits[i, labels.index(said)] = height
    shares = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return FoldAnswers(
        fold,
        withheld,
        labels,
        {
            "people": [f"{fold}{i}" for i in range(len(covered))],
            "covered": list(covered),
            "size": [2.0] * len(covered),
            "sure": 0.3,
            "known": known,
            "logits": logits,
            "shares": shares,
            "score": logits.max(axis=1),
            "typical": logits.max(axis=1),
            "label": np.array([r[0] for r in rows]),
            "person": np.array([r[1] for r in rows]),
        },
    )


FIRST = told(
    "1",
    "",
    [("a", "P1", "a", 4.0), ("b", "P1", "c", 1.0), ("c", "P1", "c", 3.0), ("other", "P1", "c", 2.0)],
    (0.7, 0.9),
)
SECOND = told("2", "", [("a", "P2", "a", 5.0), ("b", "P2", "a", 2.0)], (1.0,))


def test_known_answers_make_the_curve_and_what_was_never_to_be_known_is_held_against_them():
    table = summarise([FIRST, SECOND], 0.9, 0.95).to_dict()
    assert (table["recordings"], table["people"], table["accuracy"]) == (5, 2, pytest.approx(3 / 5))
    rows = {row["confidence"]: row for row in table["confidences"]}
    # Every right answer is surer than every wrong one.
    assert rows["softmax"]["gain"] == pytest.approx(1.0)
    assert rows["logit"]["auroc_right"] == 1.0
    assert rows["softmax"]["gain_by_person"]["n"] == 2
    stated = table["stated_coverage"]
    assert stated["by_person"]["mean"] == pytest.approx((0.7 + 0.9 + 1.0) / 3)
    assert (stated["least"], stated["by_fold"]) == (0.7, pytest.approx([0.8, 1.0]))
    free = table["free_choice"]
    # Logits 4, 1, 3 of the known ones against 2 of the other; only the first fold has any.
    assert (free["recordings"], free["folds"]) == (1, 1)
    assert free["auroc"]["logit"]["mean"] == pytest.approx(2 / 3)
    assert free["unknown_caught"]["mean"] == 0.0
    assert table["withheld"] == {} and table["withheld_mean"] == {}


def test_a_withheld_gesture_is_held_against_those_the_network_knows():
    without_c = told(
        "1",
        "c",
        [("a", "P1", "a", 4.0), ("b", "P1", "b", 2.0), ("c", "P1", "a", 3.0), ("x", "P1", "a", 9.0)],
        known=3.5,
    )
    again = told("2", "c", [("a", "P2", "a", 4.0), ("c", "P2", "b", 3.0)], known=3.5)
    without_a = told("1", "a", [("a", "P1", "b", 1.0), ("b", "P1", "b", 2.0)], known=None)
    table = summarise([FIRST, SECOND, without_c, again, without_a], 0.9, 0.95).to_dict()
    assert table["recordings"] == 5  # the whole networks' only
    row = table["withheld"]["c"]
    # "x" is of neither side; 4 and 2 against 3, then 4 against 3.
    assert row["auroc"]["logit"] == pytest.approx({"mean": 0.75, "sd": np.std([0.5, 1.0], ddof=1), "n": 2})
    assert row["known_passed"]["mean"] == pytest.approx((1 / 2 + 1) / 2)
    assert row["unknown_caught"]["mean"] == 1.0
    assert table["withheld"]["a"]["unknown_caught"]["mean"] is None
    assert table["withheld_mean"]["logit"]["mean"] == pytest.approx((0.75 + 1.0) / 2)
