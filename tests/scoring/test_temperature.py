"""The temperature: recovered where it is known, near 1 where little is known, and without effect on any answer."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.models.reference import softmax
from plushsense.scoring.temperature import fit_temperature, tempered


def answers(true: float, people: int = 100, windows: int = 100, classes: int = 5, seed: int = 0):
    """Probabilities of networks whose logits are ``true`` times too large, classes and people of the windows."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, (people * windows, classes))
    shares = softmax(logits)
    truth = (shares.cumsum(axis=1) < rng.random((len(shares), 1))).sum(axis=1)
    return softmax(true * logits), truth, np.repeat([f"P{i}" for i in range(people)], windows)


@pytest.mark.parametrize("true", [0.6, 1.0, 1.8, 3.0])
def test_a_known_temperature_is_found(true: float) -> None:
    assert fit_temperature(*answers(true)) == pytest.approx(true, rel=0.1)


def test_one_person_moves_it_less_than_ten() -> None:
    one, ten = (fit_temperature(*answers(3.0, people=n)) for n in (1, 10))
    assert 1 < one < ten < 3


@pytest.mark.parametrize("right", [True, False])
def test_answers_that_are_all_right_or_all_wrong_leave_it_bounded(right: bool) -> None:
    shares, _, person = answers(2.0, people=1)
    truth = shares.argmax(axis=1) if right else shares.argmin(axis=1)
    found = fit_temperature(shares, truth, person)
    assert 0.5 < found < 1 if right else 1 < found < 7.5
    certain = np.eye(3)[[0, 1, 1]]
    found = fit_temperature(certain, np.array([0, 1, 1 if right else 2]), np.array(["P1"] * 3))
    assert found == 1 if right else 1 < found < 7.5, "also with probabilities of 0"


def test_people_count_alike_and_nobody_not_at_all() -> None:
    shares, truth, person = answers(2.0, people=4)
    once = fit_temperature(shares, truth, person)
    first = person == "P0"
    doubled = [np.concatenate([part, part[first]]) for part in (shares, truth, person)]
    assert fit_temperature(*doubled) == pytest.approx(once)
    resting = [np.concatenate([part, part[first]]) for part in (shares, truth)]
    for nobody in ("none", "unknown"):
        assert fit_temperature(*resting, np.concatenate([person, [nobody] * first.sum()])) == once
    assert fit_temperature(shares, truth, np.full(len(person), "none")) == 1
    assert fit_temperature(shares[:0], truth[:0], person[:0]) == 1


def test_a_class_that_nobody_made_is_no_obstacle() -> None:
    shares, truth, person = answers(2.0)
    made = truth != 4
    assert 1.5 < fit_temperature(shares[made], truth[made], person[made]) < 2.5


def test_tempered_probabilities_are_those_of_divided_logits() -> None:
    logits = np.random.default_rng(1).normal(0, 4, (500, 6))
    for temperature in (0.5, 1.0, 2.5):
        found = tempered(softmax(logits).astype(np.float32), temperature)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, softmax(logits / temperature), atol=1e-6)
        assert (found.argmax(axis=1) == logits.argmax(axis=1)).all()
    assert np.isfinite(tempered(np.eye(3, dtype=np.float32), 7.0)).all()
