"""Rows of the report's evaluation."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from plushsense.reports import evaluation, figures


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


def test_the_card_gives_seconds_beside_samples_and_dashes_for_what_is_missing(study):
    card = dict(evaluation.model_rows(study["models"][0]))
    assert card["Receptive field"] == "122 samples = 1.22 s"
    assert card["Input"] == "11 channels at 100 Hz"
    assert card["Training people"].startswith("25: P01")
    assert card["Data hash"].startswith("9f2c")
    assert set(dict(evaluation.model_rows({})).values()) == {"—"}
