"""All the rules together: what they are when nobody has said anything."""

from __future__ import annotations

from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import EventSettings


def test_the_defaults_say_the_best_class_of_every_step_and_doubt_nothing() -> None:
    rules = Rules()
    assert rules.events == EventSettings()
    assert not rules.gate.rules
    assert (rules.health.fault_ms, rules.health.still_ms, rules.health.low) == (0, 0, ())
