"""A network within a budget of time: what is chosen, what is cut, and what a learning curve promises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from plushsense.dataset.store import Dataset
from plushsense.workflow import budget
from plushsense.workflow.budget import TrainingCost, choose_plan, curve_sizes, make_network, plan_s
from plushsense.workflow.config import from_settings
from plushsense.workflow.learning import learning_curve
from plushsense.workflow.reporting import load_evaluation

pytestmark = pytest.mark.apart("trainings")


def test_a_plan_uses_the_time_for_folds_and_the_learning_curve_first() -> None:
    cost = TrainingCost(window_epoch_s=1e-4, windows=6000, side_by_side=2)
    training_s = cost.training_s(60)
    assert training_s == pytest.approx(36.0)
    plans = {minutes: choose_plan(cost, 27, 60, 60 * minutes) for minutes in (60, 10, 5, 3, 2, 0.5, 0.01)}
    assert [(p.split, bool(p.sizes), p.epochs) for p in plans.values()] == [
        ("leave-one-subject-out", True, 60),
        ("by-subject:10", True, 60),
        ("by-subject:5", True, 60),
        ("by-subject:5", False, 60),
        ("by-subject:3", False, 60),
        ("by-subject:3", False, 21),
        ("by-subject:3", False, 10),
    ]
    for minutes, plan in plans.items():
        assert plan_s(cost, plan) <= 60 * minutes or plan.epochs == 10
    assert choose_plan(cost, 3, 60, 600).split == "leave-one-subject-out"
    assert choose_plan(cost, 1, 60, 600).split == "by-recording:5"
    assert (curve_sizes(26), curve_sizes(5), curve_sizes(2)) == ((9, 17), (2, 3), ())
    # The training took three times as long as estimated: fewer folds are left.
    slow = budget._adjusted(plans[10], cost, 3 * training_s, 480 - 3 * training_s)
    assert (slow.split, slow.sizes, slow.epochs, slow.usual_epochs) == ("by-subject:5", (), 60, 60)


def test_a_training_as_long_as_estimated_cuts_no_folds(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cost = TrainingCost(window_epoch_s=1e-3, windows=100, networks=4 / 3)
    plan = choose_plan(cost, len(dataset.subjects), 2, 600)
    done = SimpleNamespace(seconds=cost.training_s(2), bundle=SimpleNamespace(to_bytes=lambda: b""))
    done.save = lambda path: path
    monkeypatch.setattr(budget, "train", lambda *_, **__: done)
    nothing = lambda _: None  # noqa: E731
    making = budget._Making(dataset, tmp_path / "n", 600, from_settings(), nothing, nothing)
    _, training_s = making._train(plan)
    left_s = plan_s(cost, plan) - cost.training_s(2)
    assert budget._adjusted(plan, cost, training_s, left_s + 1e-9) == plan


def test_what_more_people_would_add_has_an_uncertainty_or_is_not_named() -> None:
    people = [f"P{i}" for i in range(8)]
    points = {m: {p: 0.2 + 0.1 * k + 0.01 * i for i, p in enumerate(people)} for k, m in enumerate((4, 8, 16))}
    found = learning_curve(points)
    assert found is not None
    # Each doubling adds a tenth to everybody: three more than 16 add a fraction of it, and all agree.
    assert found.gain == pytest.approx(0.1 * 0.24793, rel=1e-3)
    assert found.ci95 == pytest.approx([found.gain] * 2)
    assert [point.people for point in found.points] == [4, 8, 16]
    noisy = {m: {p: 0.3 + 0.2 * ((i + k) % 2) for i, p in enumerate(people)} for k, m in enumerate((4, 8, 16))}
    unsure = learning_curve(noisy)
    assert unsure is not None and unsure.ci95[0] <= 0 <= unsure.ci95[1]
    assert learning_curve({16: points[16]}) is None
    assert learning_curve({m: dict(list(row.items())[:2]) for m, row in points.items()}) is None


def test_it_resumes_with_the_same_plan_and_trains_nothing_twice(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget, "_measured", lambda *_: TrainingCost(1e-9, 100))
    config = from_settings(context="stream", epochs=2, filters=(4, 4, 4), workers=1)
    stages: list[str] = []

    def interrupt(at: budget.BudgetProgress) -> None:
        stages.append(at.stage)
        if at.stage == budget.EVALUATING and at.row["done"] == 2:
            raise KeyboardInterrupt

    made: dict[str, Any] = {"dataset": dataset, "out": tmp_path / "n.plush", "budget_s": 600.0, "config": config}
    with pytest.raises(KeyboardInterrupt):
        make_network(**made, progress=interrupt)
    first = (tmp_path / "n.plush").read_bytes()
    assert list(dict.fromkeys(stages)) == [budget.TRAINING, budget.DECIDING, budget.EVALUATING]
    # A slower computer would choose another plan; a resumed run keeps its own.
    monkeypatch.setattr(budget, "_measured", lambda *_: TrainingCost(1.0, 100))
    seen: list[budget.BudgetProgress] = []
    done = make_network(**made, progress=seen.append)
    assert {at.stage for at in seen} == {budget.EVALUATING, budget.LEARNING_CURVE}
    assert [at.share for at in seen] == sorted(at.share for at in seen) and seen[-1].share == pytest.approx(1.0)
    assert {at.bundle for at in seen} == {str(tmp_path / "n.plush")}
    assert (tmp_path / "n.plush").read_bytes() == first
    assert done.plan.split == "leave-one-subject-out" and done.cut == ()
    assert done.plan.workers == 1, "processes of their own would take longer than the folds"
    stored = load_evaluation(done.evaluation)
    assert stored["learning"] == done.learning.to_json() and len(stored["learning"]["points"]) == 3
    # The last point of the curve is the score of the evaluation itself.
    assert stored["learning"]["points"][-1]["accuracy"] == pytest.approx(stored["accuracy"]["mean"])
    # A further network of the same name does not replace it.
    other = make_network(**made | {"config": replace(config, training=replace(config.training, seed=1))})
    assert other.bundle.name == "n 2.plush"
    assert (tmp_path / "n.plush").read_bytes() == first
