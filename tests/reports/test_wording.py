"""Sentences of the reports."""

from __future__ import annotations

import pytest

from plushsense.evaluation.leakage import KINDS
from plushsense.reports import wording


@pytest.mark.parametrize(
    ("split", "said"),
    [
        ("leave-one-subject-out", "never saw the person"),
        ("by-subject:5", "5 folds"),
        ("by-recording:4", "people are known"),
        ("windows:3", "at random"),
        ("windows:holdout", "70 %"),
        ("something-new", "“something-new”"),
    ],
)
def test_every_split_is_told_in_words(split, said):
    assert said in wording.describe_split(split)[0]


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
    assert said in wording.describe_spread(evaluation)
    assert ("too narrow" in wording.describe_spread(evaluation)) == ("3 folds;" in said)


def test_the_two_contexts_are_told_apart():
    told = dict(
        wording.describe_protocol({"split": "by-subject:5", "context": "stream", "train_context": "loop", "folds": []})
    )
    assert told["Trained on"].startswith("looped") and told["Scored on"].startswith("real context")
    assert "overlaps" in told["Leak"]
    audit = {"windows": 4, "overlapping": 1}
    shared = dict(
        wording.describe_protocol({"split": "by-recording:5", "leakage": {**dict.fromkeys(KINDS, 0), **audit}})
    )
    assert "25.0 % of the scored windows" in shared["Leak"]
    assert "At rest" not in told
    assert "Leak" not in dict(wording.describe_protocol({"split": "windows:5", "leaky": True}))
    title = wording.evaluation_title({"split": "by-subject:5", "context": "stream", "train_context": "loop"})
    assert title == "by-subject:5, trained on loops, scored on real context"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "error over 15 bins is 0.192 (95 % interval over people 0.120 to 0.310). With temperatures"),
        ({}, "it is 0.066; for a network of everybody: train --temperature 1.75."),
        ({"temperature": None, "error_tempered": 0.19}, "Temperatures do not clearly lower it (0.190)."),
        ({"temperature": None, "error_tempered": None, "ci95": None, "error_int8": 0.2}, "0.192, in 8 bits 0.200."),
    ],
)
def test_how_sure_the_networks_are(changes, said):
    found = {"mean": 0.743, "error": 0.192, "ci95": [0.12, 0.31], "error_int8": None, "temperature": 1.75}
    sentence = wording.describe_confidence(found | {"error_tempered": 0.066} | changes)
    assert said in sentence and ("--temperature" in sentence) == (changes == {})
    assert dict(wording.describe_protocol({"confidence": found | {"error_tempered": 0.066} | changes}))["Confidence"]


def test_recordings_at_rest_are_named_apart_only_where_they_are() -> None:
    people = {"over": "subjects", "subjects": [{}, {}], "nobody": {"recordings": 2}, "split": "by-subject:2"}
    assert "2 people, without recordings at rest;" in wording.describe_spread(people)
    assert "with recordings at rest" in wording.describe_spread(people)
    folds = people | {"over": "folds", "folds": [{}, {}], "split": "by-recording:2"}
    assert "recordings at rest" not in wording.describe_spread(folds)
    answers = [dict(wording.describe_protocol(one))["At rest"] for one in (people, folds)]
    assert [answer.rpartition(" and ")[2] for answer in answers] == ["reported apart.", "counted like all others."]


def test_what_more_people_would_add_stands_in_the_protocol_if_it_was_measured() -> None:
    assert "More people" not in dict(wording.describe_protocol({"split": "by-subject:5", "learning": None}))
    points = [{"people": m, "accuracy": 0.4} for m in (7, 13, 20)]
    learning = {"points": points, "more": 2, "gain": 0.012, "ci95": [-0.004, 0.031]}
    answer = dict(wording.describe_protocol({"split": "by-subject:5", "learning": learning}))["More people"]
    assert "by +0.012 (95 % interval -0.004 to +0.031)" in answer and "over 7, 13, 20 people" in answer


def test_what_marks_and_the_layout_changed() -> None:
    dataset = {"recordings": 1200, "excluded": 24, "trimmed": 310, "offsets": {"x": 330.0, "y": 331.5}}
    answers = dict(wording.describe_protocol({"split": "by-subject:5", "dataset": dataset}))
    told = "Readings that stand for zero: x 330, y 331.5."
    of = "1\N{NARROW NO-BREAK SPACE}200"
    assert answers["Data"] == f"Decisions on single recordings leave out 24 and trim 310 of {of}. {told}"
    # As earlier versions stored it.
    assert "Data" not in dict(wording.describe_protocol({"split": "by-subject:5", "dataset": {"recordings": 3}}))
