"""All the rules together: what they are when nobody has said anything."""

from __future__ import annotations

from plushsense.models.events import EventPlan
from plushsense.models.rules import Rules


def test_the_defaults_say_the_best_class_of_every_step_and_doubt_nothing() -> None:
    rules = Rules()
    assert rules.events == EventPlan()
    assert not rules.gate.rules
    assert (rules.health.fault_ms, rules.health.still_ms, rules.health.low) == (0, 0, ())
