"""All the rules together: what they are when nobody has said anything."""

from __future__ import annotations

from dataclasses import fields

import pytest

from plushsense.core.errors import BundleError
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import EventSettings
from plushsense.runtime.health import HealthSettings


def test_the_defaults_say_the_best_class_of_every_step_and_doubt_nothing() -> None:
    rules = Rules()
    assert rules.events == EventSettings()
    assert not rules.gate.rules
    assert (rules.health.fault_ms, rules.health.still_ms, rules.health.low) == (0, 0, ())


@pytest.mark.parametrize("name", [field.name for field in fields(EventSettings)])
def test_every_event_setting_at_the_ends_of_its_range(name: str) -> None:
    share, steps = name.startswith(("enter", "leave", "sure")), name in ("least", "switch", "end")
    low = -(1 << 14) if name == "known" else int(steps)
    high = 1 << 14 if name == "known" else (1 << 15) + 1 if share else 65535
    assert getattr(EventSettings(**{name: low}), name) == low and EventSettings(**{name: high})
    for wrong in (low - 1, high + 1, True, 1.0):
        with pytest.raises(BundleError, match=f"event setting {name} is {wrong}; accepted are {low} to {high}"):
            EventSettings(**{name: wrong})


@pytest.mark.parametrize("name", ["fault_ms", "still_ms", "recover_ms"])
def test_every_time_of_the_sensor_health_at_the_ends_of_its_range(name: str) -> None:
    assert getattr(HealthSettings(**{name: 0}), name) == 0 and getattr(HealthSettings(**{name: 60_000}), name) == 60_000
    with pytest.raises(BundleError, match=f"health setting {name} is 60001; accepted are 0 .off. to 60000 ms"):
        HealthSettings(**{name: 60_001})
    assert HealthSettings((-(1 << 31),), ((1 << 31) - 1,)).low and HealthSettings((3,), (3,)).high
    for low, high in (((0,), (1 << 31,)), ((-(1 << 31) - 1,), (0,)), ((4,), (3,)), ((), (1,))):
        with pytest.raises(BundleError, match="do not fit: train again"):
            HealthSettings(low, high)
    assert (HealthSettings().fault_ms, HealthSettings().still_ms, HealthSettings().recover_ms) == (500, 0, 300)


def test_what_is_reported_unless_settings_say_otherwise() -> None:
    events = EventSettings()
    assert (events.enter, events.leave, events.leave_affect, events.sure) == (0, 0, 0, 1 << 14)
    assert (events.enter_affect, events.known) == ((1 << 15) + 1, -(1 << 14))
    assert (events.least, events.switch, events.end, events.hold, events.rest, events.wait) == (1, 1, 1, 0, 0, 0)
