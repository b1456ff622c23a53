"""Rows of the report's evaluation."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from plushsense.reports import evaluation, figures
from plushsense.reports.table import DASH


def luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return sum(
        w * (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4)
        for w, c in zip((0.2126, 0.7152, 0.0722), parts, strict=True)
    )


@pytest.mark.parametrize("share", np.linspace(0, 1, 41))
def test_text_on_every_shade_is_legible(share):
    background, ink = figures.shade(share)
    low, high = sorted((luminance(background), luminance(ink)))
    assert (high + 0.05) / (low + 0.05) >= 4.5


def test_shades_darken_with_the_share_even_in_grey():
    tones = [luminance(figures.shade(s)[0]) for s in np.linspace(0, 1, 11)]
    assert all(a > b for a, b in itertools.pairwise(tones))


def test_rows_are_shares_of_the_truth_and_an_empty_one_stays_zero():
    assert figures.row_shares(np.array([[1, 3], [0, 0]])).tolist() == [[0.25, 0.75], [0.0, 0.0]]


def test_confusion_cells():
    made = evaluation.confusion_rows({"labels": ["a", "b"], "counts": [[999, 1], [0, 4]]})
    assert made is not None
    first, second = (row["cells"] for row in made["rows"])
    assert [c["percent"] for c in first] == ["100", "<1"]
    assert [c["count"] for c in second] == ["·", "4"] and [c["right"] for c in second] == [False, True]
    assert evaluation.confusion_rows(None) is None
    assert evaluation.confusion_rows({"labels": ["a"], "counts": [[1, 2]]}) is None


def test_a_matrix_of_many_gestures_is_a_list_of_its_most_frequent_confusions():
    labels = [f"g{i}" for i in range(300)]
    counts = np.ones((300, 300), dtype=int)
    counts[7, 2], counts[1, 5] = 299, 50
    case = {"confusion": {"labels": labels, "counts": counts}}
    frequent = evaluation.frequent_confusions(case["confusion"])
    assert frequent is not None and len(frequent.rows) == 60
    assert frequent.cells()[:2] == [["g7", "g2", "299", "50.0 %"], ["g1", "g5", "50", "14.3 %"]]
    page = evaluation.render(title="T", dataset={}, evaluations=[case], models=[], simulated=False)
    assert len(page) < 50_000 and "<td>g2</td>" in page
    assert evaluation.frequent_confusions({"labels": ["a"], "counts": [[1]]}) is None


def test_people_in_natural_order_and_dashes_where_one_is_missing():
    one = {"subjects": [{"subject": "P10", "accuracy": 0.5}, {"subject": "P2", "accuracy": 0.25}]}
    rows = evaluation.subject_rows([one, {"subjects": [{"subject": "P2", "accuracy": 1.0}]}, {}])
    assert [row["subject"] for row in rows] == ["P2", "P10"]
    assert [[cell["accuracy"] for cell in row["cells"]] for row in rows] == [
        ["0.25", "1.00", "—"],
        ["0.50", "—", "—"],
    ]
    mixed = evaluation.subject_rows([{"subjects": [{"subject": s} for s in ("none", "7", "P1a", "")]}])
    assert len(mixed) == 4


def test_the_card_gives_seconds_beside_samples_and_dashes_for_what_is_missing(study):
    card = dict(evaluation.model_rows(study["models"][0]))
    assert card["Receptive field"] == "122 samples = 1.22 s"
    assert card["Input"] == "11 channels at 100 Hz"
    assert card["Training people"].startswith("25: P01")
    assert card["Data hash"].startswith("9f2c")
    assert set(dict(evaluation.model_rows({})).values()) == {"—"}


def test_what_deploying_costs_is_shown_where_it_was_asked():
    row = {"subject": "P01", "accuracy": 0.6, "accuracy_int8": 0.59, "macro_f1": 0.5, "macro_f1_int8": 0.498}
    means = {"mean": 0.002, "sd": 0.01, "ci95": [-0.001, 0.005]}
    asked = {"over": "subjects", "rows": [row], "loss": {"macro_f1": means}, "agreement": 0.987}
    values = evaluation.deployed_values({"int8": asked})
    assert values is not None
    assert values["table"].cells() == [["P01", "0.600", "0.590", "0.500", "0.498", DASH, DASH]]
    assert (values["loss"], values["interval"]) == ("0.002 ± 0.010", "-0.001 to 0.005")
    assert (values["table"].columns[0].head, values["macro_f1"]) == ("Person", DASH)
    assert evaluation.deployed_values({}) is None
