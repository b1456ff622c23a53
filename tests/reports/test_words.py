"""Protocols in words; figures with their spread."""

from __future__ import annotations

import math

import pytest

from plushsense.reports import words


@pytest.mark.parametrize("value", [None, math.nan, math.inf, "0.5", True, [1.0]])
def test_what_is_no_number_is_a_dash(value):
    assert words.number(value) == words.DASH


def test_counts():
    assert words.count(13262).replace("\u202f", " ") == "13 262"
    assert words.count(["a", "b"]) == "2"
    assert words.count(0, "bytes") == "0 bytes"
    assert words.count(None, "bytes") == words.count("many") == words.DASH


def test_mean_and_interval():
    metric = {"mean": 0.5614, "sd": 0.1259, "ci95": [0.512, 0.607]}
    assert words.mean_sd(metric) == "0.561 ± 0.126"
    assert words.interval(metric) == "0.512 to 0.607"
    assert words.mean_sd({"mean": None, "sd": 0.1}) == words.interval({"ci95": [None, 1.0]}) == words.DASH


@pytest.mark.parametrize(
    ("split", "said"),
    [
        ("leave-one-subject-out", "never saw the person"),
        ("by-subject:5", "5 folds"),
        ("by-recording:4", "people are known"),
        ("windows:3", "at random"),
        ("holdout", "70 %"),
        ("something-new", "“something-new”"),
    ],
)
def test_every_split_is_told_in_words(split, said):
    assert said in words.split_words(split)[0]


@pytest.mark.parametrize(
    ("evaluation", "said"),
    [
        ({"over": "subjects", "subjects": [{}] * 7, "folds": [{}] * 3}, "over 7 people;"),
        ({"over": "folds", "subjects": [{}] * 7, "folds": [{}] * 3}, "over 3 folds;"),
        ({"split": "by-subject:3", "subjects": [{}] * 7, "folds": [{}] * 3}, "over 7 people;"),
        ({"split": "by-recording:3", "subjects": [{}] * 7, "folds": [{}] * 3}, "over 3 folds;"),
        ({"over": "folds", "subjects": [{}] * 7, "folds": [{}]}, "Of 1 fold: there is no spread"),
        ({"over": "subjects", "subjects": []}, "over the people;"),
    ],
)
def test_over_what_a_mean_is_taken(evaluation, said):
    assert said in words.spread_words(evaluation)
    assert ("too narrow" in words.spread_words(evaluation)) == ("3 folds;" in said)


def test_the_two_contexts_are_told_apart():
    told = dict(words.protocol({"split": "by-subject:5", "context": "stream", "train_context": "loop", "folds": []}))
    assert told["Trained on"].startswith("looped") and told["Scored on"].startswith("real context")
    assert "overlaps" in told["Leak"]
    assert "At rest" not in told
    assert "Leak" not in dict(words.protocol({"split": "windows:5", "leaky": True}))
    title = words.title_of({"split": "by-subject:5", "context": "stream", "train_context": "loop"})
    assert title == "by-subject:5, trained on loops, scored on real context"
